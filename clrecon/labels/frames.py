"""The stack that the frames of a DICOM SEG form: evenly spaced slices, with holes where no frame was written.

Writers leave out frames without a labelled pixel, so a hole is a slice without labels, not an error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, compose_affine

__all__ = ["FrameStack", "place_frames"]

DIRECTIONS_DIFFER = 1e-4
"""Largest difference between direction cosines; the gate of a CT series allows as much between slices."""

SAME_PLACE_MM = 1e-3
OFF_GRID_MM = 0.05
"""Distance of a frame from the even stack.  Writers round positions to 0.01 mm or to seven digits."""

MOST_SLICES = 100_000


@dataclass(frozen=True)
class FrameStack:
    """The evenly spaced stack that frames form.

    Attributes
    ----------
    affine : ndarray, shape (4, 4), float64
        Index (i, j, k) to LPS mm.
    places : list of int
        Slice index k of each frame.
    slices : int
    """

    affine: Float64Array
    places: list[int]
    slices: int


def _numbers(value: Any, count: int) -> NDArray[np.float64]:
    numbers = np.array([float(number) for number in value], dtype=np.float64)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"{count} numbers are needed, there are {numbers.tolist()}")
    return numbers


def _group(shared: Any, group: Any, sequence: str) -> Any:
    for owner in (group, shared):
        if owner is not None and owner.get(sequence):
            return owner[sequence][0]
    raise ValueError(f"no {sequence}")


def place_frames(shared: Any, groups: list[Any], name: str) -> FrameStack:
    """Place the frames of a SEG by their own positions.

    Parameters
    ----------
    shared : pydicom.Dataset or None
        Shared functional groups.
    groups : list of pydicom.Dataset
        Per-frame functional groups.
    name : str
        Name of the file, for messages.

    Raises
    ------
    RefusedInputError
        Frames differ in direction or spacing, or are not evenly spaced.
    ValueError, AttributeError, KeyError
        A position, direction or spacing is missing or not made of numbers.
    """
    directions = np.stack(
        [_numbers(_group(shared, g, "PlaneOrientationSequence").ImageOrientationPatient, 6) for g in groups]
    )
    measures = [_group(shared, g, "PixelMeasuresSequence") for g in groups]
    spacings = np.stack([_numbers(m.PixelSpacing, 2) for m in measures])
    positions = np.stack([_numbers(_group(shared, g, "PlanePositionSequence").ImagePositionPatient, 3) for g in groups])
    if np.ptp(directions, axis=0).max() > DIRECTIONS_DIFFER or np.ptp(spacings, axis=0).max() > DIRECTIONS_DIFFER:
        raise RefusedInputError(f"the frames of {name} differ in direction or pixel spacing: they form no stack")
    row, column = directions[0, :3], directions[0, 3:]
    normal = np.cross(row, column)
    if max(abs(np.linalg.norm(v) - 1) for v in (row, column, normal)) > 1e-3 or spacings.min() <= 0:
        raise RefusedInputError(f"the frames of {name} cannot be placed: direction {directions[0].tolist()}, spacing"
                                f" {spacings[0].tolist()}")  # fmt: skip
    stated = [float(m.SpacingBetweenSlices) for m in measures[:1] if m.get("SpacingBetweenSlices")]
    step, places, origin = _fit_stack(positions, normal, stated[0] if stated else None, name)
    (dj, di) = spacings[0]
    try:
        affine = checked_affine(compose_affine(row * di, column * dj, step, origin))
    except UsageError as error:
        raise RefusedInputError(f"the frames of {name} cannot be placed: {error}") from error
    return FrameStack(affine, places, max(places) + 1)


def _fit_stack(
    positions: NDArray[np.float64], normal: NDArray[np.float64], stated_mm: float | None, name: str
) -> tuple[NDArray[np.float64], list[int], NDArray[np.float64]]:
    """Return the slice step, the slice index of each frame, and the position of slice 0."""
    along = positions @ normal
    heights = np.sort(along)
    gaps = np.diff(heights)
    gaps = gaps[gaps > SAME_PLACE_MM]
    usable = stated_mm is not None and np.isfinite(stated_mm) and stated_mm > SAME_PLACE_MM
    if not len(gaps):
        return normal * (stated_mm if usable and stated_mm else 1.0), [0] * len(positions), positions[0]
    gap = float(gaps.min())
    if usable and stated_mm and abs(gap / stated_mm - round(gap / stated_mm)) * stated_mm <= OFF_GRID_MM:
        gap = gap / max(1, round(gap / stated_mm))  # no two frames are neighbours
    if (heights[-1] - heights[0]) / gap > MOST_SLICES:
        raise RefusedInputError(
            f"the frames of {name} lie {gap:g} mm apart over {np.ptp(heights):g} mm: too many slices"
        )
    lowest = positions[int(np.argmin(along))]
    places = np.rint((along - heights[0]) / gap).astype(np.int64)
    # Fit a line through all positions: the rounding error of the smallest gap alone would add up over the stack.
    for _ in range(2):
        design = np.stack([np.ones(len(places)), places], axis=1)
        (origin, step), *_ = np.linalg.lstsq(design, positions, rcond=None)
        places = np.rint((along - origin @ normal) / (step @ normal)).astype(np.int64)
    residual = np.linalg.norm(positions - origin - places[:, None] * step, axis=1)
    worst = int(np.argmax(residual))
    if residual[worst] > OFF_GRID_MM or places.min() < 0:
        raise RefusedInputError(
            f"the frames of {name} do not lie evenly: the one at {along[worst]:.2f} mm along the normal is"
            f" {residual[worst]:.2f} mm off steps of {np.linalg.norm(step):.3f} mm from {lowest.round(2).tolist()}"
        )
    return step, [int(place) for place in places], origin
