"""Pictures and contours of a comparison, between the processes that made them and the page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.jobs.compare.contours import Plane, cut_mesh, draw_plane
from clrecon.jobs.compare.findings import SAME_MM
from clrecon.jobs.compare.methods import COMPARED
from clrecon.jobs.compare.paper import along_slices, measure_against_slice
from clrecon.jobs.compare.pictures import compare_pictures, difference_of, save_png
from clrecon.jobs.compare.report import MethodRecord
from clrecon.jobs.compare.request import load_array, load_mesh

COLORS = dict(
    zip(
        COMPARED,
        ("#ff3b30", "#9a9a9a", "#ffd60a", "#ff9f0a", "#c46a3a", "#0a84ff", "#bf5af2", "#30d158", "#64d2ff", "#a2845e",
         "#ff7ac6", "#8e8cff", "#b8b04a"),
        strict=True,
    )
)  # fmt: skip
"""Of each method, in plots and contours."""


@dataclass
class Figures:
    """The pictures of a comparison.

    work: Folder with the arrays of the methods.
    box: ndarray, shape (2, 3)
    views: The picture of each method from the one camera.
    contours: For each plane the lines of each method.
    images: What is written as PNG, by file name without extension.
    same: Methods whose surface is that of the reference.
    """

    work: Path
    volume: Volume
    level: float
    reference: str
    planes: list[Plane] = field(default_factory=list)
    box: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 3)))
    views: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    contours: list[dict[str, NDArray[np.float64]]] = field(default_factory=list)
    images: dict[str, Any] = field(default_factory=dict)
    same: set[str] = field(default_factory=set)
    paper: dict[str, Any] | None = None

    def complete(self, records: Sequence[MethodRecord]) -> list[MethodRecord]:
        """Return the records with what pictures say, and the files of pictures."""
        likeness = compare_pictures(
            {name: view for name, view in self.views.items() if self._is_like(name)}, self.reference
        )
        return [
            record.changed(
                pictures=likeness.get(record.name),
                picture=f"{record.name}.png" if record.name in self.images else None,
                difference=f"{record.name}-difference.png" if f"{record.name}-difference" in self.images else None,
            )
            for record in records
        ]

    def _is_like(self, name: str) -> bool:
        """True where the picture has the size of the reference's."""
        return self.reference in self.views and self.views[name].shape == self.views[self.reference].shape

    def slice_entries(self) -> list[dict[str, Any]]:
        """Return the entries of the report on slices."""
        return [
            {
                "name": plane.name,
                "axis": "ijk"[plane.axis],
                "index": plane.at,
                "file": f"slice-{'ijk'[plane.axis]}.png",
                "detail": f"slice-{'ijk'[plane.axis]}-detail.png",
                "lines": {name: len(lines) for name, lines in own.items()},
            }
            for plane, own in zip(self.planes, self.contours, strict=True)
        ]

    def compare_with_slice(self) -> None:
        """Compare the pictures that look along the slices with the middle one."""
        found = {name: load_array(self.work, name, "along") for name in self.views}
        pictures = {name: picture for name, picture in found.items() if picture is not None}
        width, height = along_slices(self.volume)["size"]
        self.paper = measure_against_slice(self.volume, pictures, (width, height))


def collect_figures(figures: Figures, records: Sequence[MethodRecord]) -> None:
    """Load the pictures of methods, and cut their meshes with the planes."""
    names = [record.name for record in records if record.is_done]
    figures.same = {
        record.name
        for record in records
        if record.name != figures.reference and record.surfaces and record.surfaces["hd95_mm"] < SAME_MM
    }
    figures.contours = [{} for _ in figures.planes]
    for name in names:
        view = load_array(figures.work, name, "view")
        if view is not None:
            figures.views[name] = figures.images[name] = view
        mesh = load_mesh(figures.work, name)
        if mesh is not None:
            for plane, own in zip(figures.planes, figures.contours, strict=True):
                own[name] = cut_mesh(mesh, figures.volume, plane)
    reference = figures.views.get(figures.reference)
    for name, view in figures.views.items():
        if reference is not None and name != figures.reference and view.shape == reference.shape:
            figures.images[f"{name}-difference"] = difference_of(view, reference)
    for plane, own in zip(figures.planes, figures.contours, strict=True):
        order = sorted(own, key=lambda name: name != figures.reference)  # which lies below all others
        lines = {name: own[name] for name in order if name not in figures.same}
        whole, detail = draw_plane(figures.volume, plane, figures.box, lines, COLORS, figures.reference)
        figures.images[f"slice-{'ijk'[plane.axis]}"] = whole
        figures.images[f"slice-{'ijk'[plane.axis]}-detail"] = detail


def draw_figures(figures: Figures, folder: Path) -> None:
    """Write all pictures as PNG."""
    for name, image in figures.images.items():
        save_png(image, folder / f"{name}.png")
