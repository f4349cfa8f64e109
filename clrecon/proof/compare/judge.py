"""The process that measures what methods made: against a reference, the HU of the scan, and a phantom's truth."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import ClreconError
from clrecon.jobs.run import to_json
from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import ReferenceSurface, summarise_distances
from clrecon.proof.compare.mesh_cells import GridCells, find_mesh_cells, measure_cells
from clrecon.proof.compare.mesh_slices import ScanSlices
from clrecon.proof.compare.mesh_truth import REACH_MM, measure_truth
from clrecon.proof.compare.processes import load_array, load_mesh, load_volume
from clrecon.proof.phantom import phantom_truth

_SAMPLES = 20_000
"""Points on each surface, and of a cloud: the 95th percentile is based on the 1000 largest distances."""


class Judge:
    """Measures of one scan, one level and one reference.

    The message has the ``folder`` with the arrays; ``reference``, name of a method, None where it failed;
    ``iso_value``; ``closed``; ``truth``, the folder of a phantom, or None; ``measures``, names of `MEASURES`.
    """

    def __init__(self, message: Mapping[str, Any]):
        self._folder = Path(message["folder"])
        self._reference: str | None = message["reference"]
        self._truth = message["truth"]
        self._measures = message["measures"]
        self._volume = load_volume(self._folder)
        self._slices = ScanSlices(self._volume, float(message["iso_value"]), bool(message["closed"]))

    @cached_property
    def truth(self) -> Any:
        return phantom_truth(self._truth)

    @cached_property
    def reference(self) -> Mesh | None:
        return None if self._reference is None else load_mesh(self._folder, self._reference)

    @cached_property
    def cells(self) -> GridCells:
        assert self.reference is not None
        return find_mesh_cells(self.reference, self._volume, name=self._reference or "")

    @cached_property
    def surface(self) -> ReferenceSurface:
        assert self.reference is not None
        return ReferenceSurface(self.reference, _SAMPLES)

    def measure(self, method: str) -> dict[str, Any]:
        """Measure the result of a method: each measure, None where it has none, and ``reasons`` of failures."""
        mesh = self.reference if method == self._reference else load_mesh(self._folder, method)
        takers = self._take_mesh(mesh) if mesh is not None else {}
        points = load_array(self._folder, method, "points")
        if points is not None:
            takers = {"points": lambda: self._measure_points(points)}
        measures: dict[str, Any] = dict.fromkeys(self._measures)
        reasons: dict[str, str] = {}
        for name in [name for name in measures if name in takers]:
            try:
                measures[name] = takers[name]()
            except (ClreconError, MemoryError) as error:
                reasons[name] = str(error) or "out of memory"
        return {**measures, "reasons": reasons}

    def _take_mesh(self, mesh: Mesh) -> dict[str, Callable[[], Any]]:
        reference, volume = self.reference, self._volume
        takers: dict[str, Callable[[], Any]] = {
            "quality": lambda: _facts_of_quality(mesh),
            "slices": lambda: self._slices.measure(mesh),
        }
        if reference is not None:
            takers["cells"] = lambda: measure_cells(
                self.cells if mesh is reference else mesh, self.cells, volume, reference_name=self._reference
            )
            takers["surfaces"] = lambda: self.surface.compare(mesh)
        if self._truth is not None:
            takers["truth"] = lambda: measure_truth(mesh, self.truth, grid=volume)
        return takers

    def _measure_points(self, points: Any) -> dict[str, Any]:
        """Measure points of a cloud: distances from the reference, and signed ones from the true surface."""
        sample = np.asarray(points[:: max(1, len(points) // _SAMPLES)], dtype=np.float64)
        figures: dict[str, Any] = {"samples": len(sample), "to_reference_mm": None, "bias_mm": None, "scatter_mm": None}
        if self.reference is not None:
            figures["to_reference_mm"] = summarise_distances(self.surface.distance(sample))
        if self._truth is not None:
            signed = self.truth.signed_distance(sample)
            signed = signed[np.abs(signed) <= REACH_MM]
            if len(signed):
                figures["bias_mm"], figures["scatter_mm"] = float(signed.mean()), float(signed.std())
        return figures


def _facts_of_quality(mesh: Mesh) -> dict[str, Any]:
    quality = mesh.quality()
    names = ("closed", "manifold", "components", "euler_number", "area_mm2", "volume_ml", "outward")
    return {name: getattr(quality, name) for name in names}


def main() -> None:
    """Measure the methods that the JSON object on stdin names, and write a line of JSON for each."""
    lines = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)
    data = json.load(sys.stdin)
    judge = Judge(data)
    for method in data["methods"]:
        lines.write(to_json(judge.measure(method), indent=None) + "\n")


if __name__ == "__main__":
    main()
