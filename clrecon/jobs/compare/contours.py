"""Slices of the scan with the contours of all methods: where their surfaces cut a plane between two slices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.mesh import Mesh

WINDOW_HU = (-200.0, 800.0)
BETWEEN = 0.487
"""Place of a plane between two slices: on a slice, vertices lie in the plane."""

PIXELS, DETAIL_MM = 560, 24.0
MARGIN_MM = 8.0
OVERSAMPLING = 2
WIDEST, THINNEST = {"whole": 3.4, "detail": 7.0}, {"whole": 1.1, "detail": 1.6}
"""Pixels of the first line, which lies below, and of the last one: lines at one place are seen as bands."""

Segments = NDArray[np.float64]
"""Ends of lines in index coordinates across and down the picture, shape (n, 2, 2)."""


@dataclass(frozen=True)
class Plane:
    """A plane across an axis of the volume.

    axis: Of (i, j, k).
    at: Index coordinate along it.
    across, down: The axes that run to the right and down in the picture.
    flip: The axis `down` runs upward instead.
    """

    name: str
    axis: int
    at: float
    across: int
    down: int
    flip: bool


def find_planes(volume: Volume, iso_value: float) -> tuple[list[Plane], NDArray[np.float64]]:
    """Choose two planes through the middle of what is inside.

    Returns:
    box: ndarray, shape (2, 3). Lowest and highest index (i, j, k) of the voxels that are inside.
    """
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


def cut_mesh(mesh: Mesh, volume: Volume, plane: Plane) -> Segments:
    """Return the lines in which a mesh cuts a plane."""
    ijk = volume.lps_to_ijk(mesh.vertices)
    height = ijk[:, plane.axis] - plane.at
    above = height[mesh.triangles] > 0.0
    crossing = above.any(axis=1) & ~above.all(axis=1)
    corners, above = mesh.triangles[crossing], above[crossing]
    # The lone corner of each triangle is the one whose two edges are cut.
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    rows = np.arange(len(corners))
    own = corners[rows, lone]
    ends = []
    for step in (1, 2):
        other = corners[rows, (lone + step) % 3]
        share = (height[own] / (height[own] - height[other]))[:, None]
        ends.append((ijk[own] + share * (ijk[other] - ijk[own]))[:, [plane.across, plane.down]])
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
    """Return HU as grey values of the window."""
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
    shape = np.array([grey.shape[1], grey.shape[0]])
    low, high = np.maximum(low, -0.5), np.minimum(high, shape - 0.5)
    whole = _draw(grey, plane, steps, low, high, "whole", contours, colors)
    middle = _find_detail(contours.get(reference, np.empty((0, 2, 2))), steps, 0.5 * (low + high))
    half = 0.5 * DETAIL_MM / steps
    detail = _draw(grey, plane, steps, middle - half, middle + half, "detail", contours, colors)
    return whole, detail


def _find_detail(segments: Segments, steps: NDArray[np.float64], default: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the middle of the square with the most lines."""
    if not len(segments):
        return default
    middles = segments.mean(axis=1)
    squares = np.floor(middles * steps / (0.5 * DETAIL_MM)).astype(np.int64)
    found, counts = np.unique(squares, axis=0, return_counts=True)
    best = found[int(np.argmax(counts))]
    return np.asarray(middles[(squares == best).all(axis=1)].mean(axis=0))


def _draw(
    grey: NDArray[np.uint8],
    plane: Plane,
    steps: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    which: str,
    contours: Mapping[str, Segments],
    colors: Mapping[str, str],
) -> Any:
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    from PIL import Image, ImageDraw

    extent = (high - low) * steps
    scale = OVERSAMPLING * PIXELS / float(extent.max())  # pixels a mm
    width, height = (max(1, int(round(scale * side))) for side in extent)
    whole = Image.fromarray(grey)
    # Index coordinates count from the centres of pixels, Pillow's from their corners.
    part = whole.transform(
        (width, height), Image.Transform.EXTENT,
        (low[0] + 0.5, low[1] + 0.5, high[0] + 0.5, high[1] + 0.5), Image.Resampling.BILINEAR,
    ).convert("RGB")  # fmt: skip
    canvas = ImageDraw.Draw(part)
    lines = np.linspace(WIDEST[which], THINNEST[which], max(len(contours), 2))
    for (name, segments), line in zip(contours.items(), lines.tolist(), strict=False):
        thick = max(1, round(OVERSAMPLING * line))
        ends = (segments - low) * steps * scale
        seen = ((ends > -50) & (ends < [width + 50, height + 50])).all(axis=(1, 2))
        for (x, y), (to_x, to_y) in ends[seen].tolist():
            canvas.line((x, y, to_x, to_y), fill=colors[name], width=thick)
    if plane.flip:
        part = part.transpose(Image.Transpose.FLIP_TOP_BOTTOM)
    return part.resize((width // OVERSAMPLING or 1, height // OVERSAMPLING or 1), Image.Resampling.LANCZOS)
