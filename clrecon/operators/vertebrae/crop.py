"""The part of a volume and of its label map around one label, with slices across the patient's long axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume, column_spacing
from clrecon.geometry.affine import Float64Array
from clrecon.labels import LabelMap
from clrecon.labels.resample import check_together, warn_of_place
from clrecon.labels.solid import find_boxes

SPARE_VOXELS = 3
"""Voxels beyond the distances that are asked for, so that nothing round the label touches the end of the crop."""

AXIAL_COSINE = 0.7
"""Slices whose normal has at least this cosine with the patient's long axis are axial: up to 45 degrees off."""


@dataclass(frozen=True)
class LabelCrop:
    """A label with its surroundings.

    volume: The voxels around the label, at their places in the patient.  Axes are in the order that makes the slices as
        axial as they can be; only those of uneven stacks stay.
    labels: The same part of the label map, on its own grid.
    inside_share: Share of the label's voxels that lie in the whole volume, above 0.
    axial: The slices are axial within 45 degrees.
    """

    volume: Volume
    labels: LabelMap
    number: int
    name: str
    inside_share: float
    axial: bool
    warnings: tuple[str, ...]


def crop_label(volume: Volume, labels: LabelMap, label: int | str, margin_mm: float) -> LabelCrop:
    """Cut out one label with `margin_mm`, and some voxels more, around it."""
    shares = check_together(labels, volume)
    number = labels.find(label)
    share, called = shares[number], f"label {number} {labels.name(number)}"
    own = find_boxes(labels.voxels, (number,), (0, 0, 0))[number]
    low, high = (np.array([getattr(part, end) for part in own[::-1]]) for end in ("start", "stop"))
    corners = np.stack(np.meshgrid(*zip(low - 0.5, high - 0.5, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    places = labels.ijk_to_lps(corners)
    first, end = _window(volume, places, margin_mm)
    if share == 0.0 or (first >= end).any():
        raise RefusedInputError(f"{called} has no voxel in the CT: it lies outside")
    around = volume.ijk_to_lps(
        np.stack(np.meshgrid(*zip(first, end - 1, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    )
    cut_map = _cut_map(labels, *_window(labels, around, 0.0))
    cut, axial = _cut_volume(volume, first, end)
    warnings = [*labels.warnings, *warn_of_place(labels, volume)]
    if share < 1.0:
        warnings.append(
            f"{100 * (1 - share):.3g} % of {called} lie outside the CT: the vertebra ends where the CT does"
        )
    return LabelCrop(cut, cut_map, number, labels.name(number), share, axial, tuple(warnings))


def _window(
    grid: Volume | LabelMap, places: Float64Array, margin_mm: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the first voxel (i, j, k), and the one behind the last, of the box of a grid around places."""
    indices = grid.lps_to_ijk(places)
    # along an axis that is oblique to another the margin takes more steps: rows of the inverse have their lengths
    steps = np.linalg.norm(np.linalg.inv(grid.affine[:3, :3]), axis=1)
    if isinstance(grid, Volume) and grid.uneven:
        gaps = np.linalg.norm(np.diff(grid.slice_origins(), axis=0), axis=1)
        steps[2] *= grid.spacing[2] / max(float(gaps.min(initial=grid.spacing[2])), 1e-6)
    more = margin_mm * steps + SPARE_VOXELS
    first = np.clip(np.floor(indices.min(axis=0) - more), 0, grid.shape_ijk).astype(np.int64)
    end = np.clip(np.ceil(indices.max(axis=0) + more) + 1, 0, grid.shape_ijk).astype(np.int64)
    return first, end


def _cut_map(labels: LabelMap, first: NDArray[np.int64], end: NDArray[np.int64]) -> LabelMap:
    parts = tuple(slice(a, b) for a, b in zip(first[::-1], end[::-1], strict=True))
    affine = labels.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ first
    return LabelMap(labels.voxels[parts], affine, labels.names)


def _cut_volume(volume: Volume, first: NDArray[np.int64], end: NDArray[np.int64]) -> tuple[Volume, bool]:
    """Cut a box out of a volume and turn its axes; tell whether its slices are axial."""
    parts = tuple(slice(a, b) for a, b in zip(first[::-1], end[::-1], strict=True))
    affine = volume.affine.copy()
    affine[:3, 3] += affine[:3, :3] @ first
    voxels, origins = volume.voxels[parts], None
    if volume.uneven and end[2] - first[2] > 1:
        origins = volume.slice_origins()[first[2] : end[2]] + affine[:3, :2] @ first[:2]
    elif volume.uneven:
        affine[:3, 3] = volume.ijk_to_lps([first])[0]
    else:
        upright = int(np.argmax(np.abs(affine[2, :3]) / column_spacing(affine)))
        order = [axis for axis in range(3) if axis != upright] + [upright]
        affine[:3, :3] = affine[:3, order]
        voxels = voxels.transpose([2 - axis for axis in order[::-1]])
    normal = np.cross(affine[:3, 0], affine[:3, 1])
    axial = bool(abs(normal[2]) >= AXIAL_COSINE * np.linalg.norm(normal))
    return Volume(np.ascontiguousarray(voxels), affine, volume.report, origins), axial
