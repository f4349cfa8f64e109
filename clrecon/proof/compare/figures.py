"""Pictures of a comparison: from one camera, slices with the contours of all methods, and those of a paper's table.

Pictures of each method are compared with a slice, by MSE and SSIM, beside pictures of nothing.  Reference: "CPU-GPU
Rendering of CT Scan Images for Vertebra Reconstruction from CT Scan Images with a Calibration Policy", Table 1 and
Figures 10 and 11."""

from __future__ import annotations

import base64
import contextlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import ClreconError
from clrecon.geometry import Volume
from clrecon.operators.rays.mesh_pictures import box_around
from clrecon.proof.compare.findings import SAME_MM, MethodRecord
from clrecon.proof.compare.methods import COMPARED
from clrecon.proof.compare.processes import load_array, load_mesh
from clrecon.rendering.pictures.likeness import make_control_pictures, measure_pictures
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.rendering.views.camera import Camera
from clrecon.system.arguments import DirectionName

WINDOW_HU = (-200.0, 800.0)
BETWEEN = 0.487
"""Place of a plane between two slices: on a slice, vertices lie in the plane."""

PIXELS, _DETAIL_MM = 560, 24.0
MARGIN_MM = 8.0
_OVERSAMPLING = 2
_WIDEST, THINNEST = {"whole": 3.4, "detail": 7.0}, {"whole": 1.1, "detail": 1.6}
"""Pixels of the first line, which lies below, and of the last one: lines at one place are seen as bands."""

Segments = NDArray[np.float64]
"""Ends of lines in index coordinates across and down the picture, shape (n, 2, 2)."""


@dataclass(frozen=True)
class Plane:
    """A plane across an `axis` (i, j, k) at an index; `across` runs to the right and `down` down, with `flip` up."""

    name: str
    axis: int
    at: float
    across: int
    down: int
    flip: bool


def find_planes(volume: Volume, iso_value: float) -> tuple[list[Plane], NDArray[np.float64]]:
    """Choose two planes through the middle of what is inside; return its box too: lowest and highest (i, j, k)."""
    box = inside_box(volume, iso_value)
    middle = np.floor(box.mean(axis=0))
    wanted = (("across the body", 2, 0, 1, False), ("from the side", 0, 1, 2, bool(volume.affine[2, 2] > 0)))
    planes = [
        Plane(name, axis, float(min(middle[axis], volume.shape_ijk[axis] - 2)) + BETWEEN, across, down, flip)
        for name, axis, across, down, flip in wanted
        if volume.shape_ijk[axis] > 1
    ]
    return planes, box


def inside_box(volume: Volume, iso_value: float) -> NDArray[np.float64]:
    """Return the lowest and the highest index (i, j, k) of voxels at the level and above, shape (2, 3)."""
    marks = [np.zeros(n, bool) for n in volume.shape_ijk]
    for k, layer in enumerate(volume.voxels):
        inside = layer >= iso_value
        if inside.any():
            marks[0] |= inside.any(axis=0)
            marks[1] |= inside.any(axis=1)
            marks[2][k] = True
    places = [np.flatnonzero(mark) for mark in marks]
    return np.array([[float(each[0]) for each in places], [float(each[-1]) for each in places]])


def cut_triangles(ijk: NDArray[np.float64], triangles: NDArray[np.uint32], plane: Plane) -> Segments:
    height = ijk[:, plane.axis] - plane.at
    above = (height > 0.0)[triangles]
    crossing = np.flatnonzero(above.any(axis=1) & ~above.all(axis=1))
    corners, above = triangles[crossing], above[crossing]
    # The lone corner of each triangle is the one whose two edges are cut.
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    rows = np.arange(len(corners))
    lone_corner = corners[rows, lone]
    ends = []
    for step in (1, 2):
        next_corner = corners[rows, (lone + step) % 3]
        share = (height[lone_corner] / (height[lone_corner] - height[next_corner]))[:, None]
        ends.append((ijk[lone_corner] + share * (ijk[next_corner] - ijk[lone_corner]))[:, [plane.across, plane.down]])
    return np.stack(ends, axis=1)


def read_plane(volume: Volume, plane: Plane) -> NDArray[np.uint8]:
    """Return the HU in a plane as grey values, shape (down, across)."""
    first = int(plane.at)
    take: list[Any] = [slice(None)] * 3
    layers = []
    for index in (first, first + 1):
        take[2 - plane.axis] = index
        layers.append(volume.voxels[tuple(take)].astype(np.float64))
    share = plane.at - first
    values = (1.0 - share) * layers[0] + share * layers[1]
    if plane.across > plane.down:  # voxels are [k, j, i]: the later axis comes first
        values = values.T
    return to_grey(values)


def to_grey(values: NDArray[Any]) -> NDArray[np.uint8]:
    low, high = WINDOW_HU
    return np.rint(255.0 * np.clip((values - low) / (high - low), 0.0, 1.0)).astype(np.uint8)


def draw_plane(
    volume: Volume,
    plane: Plane,
    box: NDArray[np.float64],
    contours: Mapping[str, Segments],
    colors: Mapping[str, str],
    reference: str,
) -> tuple[Any, Any]:
    """Draw a plane with the contours of all methods, as a whole and the detail where there is most to see."""
    grey = read_plane(volume, plane)
    steps = np.array([volume.spacing[plane.across], volume.spacing[plane.down]])
    axes = [plane.across, plane.down]
    low, high = box[0, axes] - MARGIN_MM / steps, box[1, axes] + MARGIN_MM / steps
    low, high = np.maximum(low, -0.5), np.minimum(high, np.array([grey.shape[1], grey.shape[0]]) - 0.5)
    drawn = [(segments, colors[name]) for name, segments in contours.items()]
    whole = _draw_slice(grey, plane, steps, low, high, "whole", drawn)
    middle = _find_detail(contours.get(reference, np.empty((0, 2, 2))), steps, 0.5 * (low + high))
    half = 0.5 * _DETAIL_MM / steps
    return whole, _draw_slice(grey, plane, steps, middle - half, middle + half, "detail", drawn)


def _find_detail(segments: Segments, steps: NDArray[np.float64], default: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the middle of the square with the most lines."""
    if not len(segments):
        return default
    middles = segments.mean(axis=1)
    squares = np.floor(middles * steps / (0.5 * _DETAIL_MM)).astype(np.int64)
    distinct, counts = np.unique(squares, axis=0, return_counts=True)
    return np.asarray(middles[(squares == distinct[int(np.argmax(counts))]).all(axis=1)].mean(axis=0))


def _draw_slice(
    grey: NDArray[np.uint8],
    plane: Plane,
    steps: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    which: str,
    contours: Sequence[tuple[Segments, str]],
) -> Any:
    """Draw a part of a plane with contours, each in its colour."""
    load_pillow()
    from PIL import Image, ImageDraw

    extent = (high - low) * steps
    scale = _OVERSAMPLING * PIXELS / float(extent.max())  # pixels a mm
    width, height = (max(1, int(round(scale * side))) for side in extent)
    whole = Image.fromarray(grey)
    # Index coordinates count from the centres of pixels, Pillow's from their corners.
    part = whole.transform(
        (width, height), Image.Transform.EXTENT,
        (low[0] + 0.5, low[1] + 0.5, high[0] + 0.5, high[1] + 0.5), Image.Resampling.BILINEAR,
    ).convert("RGB")  # fmt: skip
    canvas = ImageDraw.Draw(part)
    lines = np.linspace(_WIDEST[which], THINNEST[which], max(len(contours), 2))
    for (segments, color), line in zip(contours, lines.tolist(), strict=False):
        thick = max(1, round(_OVERSAMPLING * line))
        ends = (segments - low) * steps * scale
        seen = ((ends > -50) & (ends < [width + 50, height + 50])).all(axis=(1, 2))
        for (x, y), (to_x, to_y) in ends[seen].tolist():
            canvas.line((x, y, to_x, to_y), fill=color, width=thick)
    if plane.flip:
        part = part.transpose(Image.Transpose.FLIP_TOP_BOTTOM)
    return part.resize((width // _OVERSAMPLING or 1, height // _OVERSAMPLING or 1), Image.Resampling.LANCZOS)


MOST_PIXELS = 512

PAPER = {
    "skimage": {"method": "marching cubes, CPU", "seconds": 300.0},
    "vtk-mc": {"method": "marching cubes, GPU", "seconds": 2.0},
    "cloud": {"method": "affine point cloud", "seconds": 3.0},
    "rays": {"method": "ray casting, GPU", "seconds": 10.0, "later_s": 2.0},
    "rays-cpu": {"method": "ray casting, CPU", "seconds": 300.0},
}
"""What the paper says of its own methods, on its own machine and scan."""

CONTROLS = {
    "black": "all black",
    "white": "all white",
    "noise": "noise",
    "next": "the next slice",
    "shifted": "the slice, moved by 5 pixels",
}


def along_slices(volume: Volume) -> dict[str, Any]:
    """Return camera and size of a picture along the slices from before the first, pixel for pixel the middle one."""
    ni, nj, nk = volume.shape_ijk
    di, dj, _ = volume.spacing
    width = min(ni, MOST_PIXELS)
    height = max(7, round(nj * dj / (ni * di) * width))
    middle = volume.ijk_to_lps([[(ni - 1) / 2, (nj - 1) / 2, nk // 2]])[0]
    right, down = volume.affine[:3, 0] / di, volume.affine[:3, 1] / dj
    forward = np.cross(right, down)
    corners = list(product((0, ni - 1), (0, nj - 1), (0, nk - 1)))
    away = 1.5 * float(np.linalg.norm(volume.ijk_to_lps(corners) - middle, axis=1).max()) + 10.0
    camera = {
        "position": [float(x) for x in middle - away * forward],
        "focal_point": [float(x) for x in middle],
        "up": [float(x) for x in -down],
        "parallel_scale": 0.5 * nj * dj,
    }
    return {"camera": camera, "size": [width, height]}


def middle_slice(volume: Volume, size: tuple[int, int], offset: int = 0) -> NDArray[np.uint8]:
    """Return the middle slice, or one beside it, as grey values of the size of the pictures."""
    load_pillow()
    from PIL import Image

    nk = volume.shape_ijk[2]
    grey = to_grey(volume.voxels[min(nk // 2 + offset, nk - 1)].astype(np.float64))
    return np.asarray(Image.fromarray(grey).resize(size, Image.Resampling.BILINEAR))


def measure_likeness(picture: NDArray[np.uint8], reference: NDArray[np.uint8], **choice: bool) -> dict[str, float]:
    likeness = measure_pictures(picture, reference, **choice)
    return {"ssim": likeness.ssim, "mse": likeness.mse}


def measure_against_slice(
    volume: Volume, pictures: Mapping[str, NDArray[np.uint8]], size: tuple[int, int]
) -> dict[str, Any]:
    """Compare pictures of methods, and some that show what that is worth, with the middle slice: ssim and mse."""
    wanted = middle_slice(volume, size)
    controls = make_control_pictures(wanted, middle_slice(volume, size, 1))

    greys = {name: np.rint(picture.mean(axis=2)).astype(np.uint8) for name, picture in pictures.items()}
    return {
        "window_hu": list(WINDOW_HU),
        "slice": volume.shape_ijk[2] // 2,
        "methods": {name: measure_likeness(grey, wanted, whole=True) for name, grey in greys.items()},
        "controls": {name: measure_likeness(controls[name], wanted, whole=True) for name in CONTROLS},
    }


VIEW: DirectionName = "anterior"
SIZE = (480, 480)
_QUALITY = 80
"""Of WebP; PNG beside the page is exact."""

Image = NDArray[np.uint8]


def choose_camera(volume: Volume, box: NDArray[np.float64]) -> dict[str, Any]:
    """Return the parameters of the camera that looks at what is inside; its box is that of `find_planes`."""
    low, high = box
    ends = np.stack([low - 1.0, high + 1.0])
    places = volume.ijk_to_lps([[ends[bit >> axis & 1, axis] for axis in range(3)] for bit in range(8)])
    return asdict(Camera.fit(box_around([places]), VIEW, size=SIZE))


def difference_of(picture: Image, reference: Image) -> Image:
    """Return where two pictures differ, shape (h, w): black where they do not, white from a quarter of the range on."""
    apart = np.abs(picture.astype(np.int16) - reference).max(axis=2)
    return np.asarray(np.minimum(4 * apart, 255), dtype=np.uint8)


def embed(image: Any) -> str:
    """Return a picture as the address of a WebP inside the page."""
    stream = io.BytesIO()
    _as_pillow(image).save(stream, "WEBP", quality=_QUALITY, method=4)
    return "data:image/webp;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def _as_pillow(image: Any) -> Any:
    load_pillow()
    from PIL import Image as Pillow

    return Pillow.fromarray(image) if isinstance(image, np.ndarray) else image


COLORS = dict(
    zip(
        COMPARED,
        ("#ff3b30", "#9a9a9a", "#ffd60a", "#ff9f0a", "#c46a3a", "#0a84ff", "#bf5af2", "#30d158", "#64d2ff", "#00b8a9",
         "#a2845e", "#ff7ac6", "#8e8cff", "#b8b04a"),
        strict=True,
    )
)  # fmt: skip
"""Of each method, in plots and contours."""


@dataclass
class Figures:
    """The pictures of a comparison, of which `images` are written as PNG, by file name without extension.

    views, contours: The picture of each method from the one camera; for each plane the lines of each method.
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
        reference, likeness = self.views.get(self.reference), {}
        for name, view in self.views.items():
            if reference is not None and view.shape == reference.shape:
                with contextlib.suppress(ClreconError):  # nothing is drawn in either
                    likeness[name] = measure_likeness(view, reference)
        return [
            record.changed(
                pictures=likeness.get(record.name),
                picture=f"{record.name}.png" if record.name in self.images else None,
                difference=f"{record.name}-difference.png" if f"{record.name}-difference" in self.images else None,
            )
            for record in records
        ]

    def slice_entries(self) -> list[dict[str, Any]]:
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
        arrays = {name: load_array(self.work, name, "along") for name in self.views}
        pictures = {name: picture for name, picture in arrays.items() if picture is not None}
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
            ijk = figures.volume.lps_to_ijk(mesh.vertices)
            for plane, contours in zip(figures.planes, figures.contours, strict=True):
                contours[name] = cut_triangles(ijk, mesh.triangles, plane)
    reference = figures.views.get(figures.reference)
    for name, view in figures.views.items():
        if reference is not None and name != figures.reference and view.shape == reference.shape:
            figures.images[f"{name}-difference"] = difference_of(view, reference)
    for plane, contours in zip(figures.planes, figures.contours, strict=True):
        order = sorted(contours, key=lambda name: name != figures.reference)  # which lies below all others
        lines = {name: contours[name] for name in order if name not in figures.same}
        whole, detail = draw_plane(figures.volume, plane, figures.box, lines, COLORS, figures.reference)
        figures.images[f"slice-{'ijk'[plane.axis]}"] = whole
        figures.images[f"slice-{'ijk'[plane.axis]}-detail"] = detail


def draw_figures(figures: Figures, folder: Path) -> None:
    for name, image in figures.images.items():
        _as_pillow(image).save(folder / f"{name}.png", "PNG")
