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

DIRECTIONS_DIFFER = 1e-4
"""Largest difference between direction cosines; the gate of a CT series allows as much between slices."""

SAME_PLACE_MM = 1e-3
OFF_GRID_MM = 0.05
"""Distance of a frame from the even stack.  Writers round positions to 0.01 mm or to seven digits."""

MOST_SLICES = 100_000

_UNSAID = "says neither SpacingBetweenSlices nor SliceThickness"


@dataclass(frozen=True)
class FrameStack:
    """The evenly spaced stack that frames form.

    affine: ndarray, shape (4, 4), float64. Index (i, j, k) to LPS mm.
    places: Slice index k of each frame.
    warnings: What the header leaves open about the step between slices.
    """

    affine: Float64Array
    places: list[int]
    slices: int
    warnings: tuple[str, ...] = ()


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

    shared: Shared functional groups.
    groups: Per-frame functional groups.
    name: Name of the file, for messages.
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
    stated = (_stated_mm(measures[0], keyword) for keyword in ("SpacingBetweenSlices", "SliceThickness"))
    gap, warnings = _choose_gap(positions @ normal, *stated)
    step, places, origin = _fit_stack(positions, normal, gap, name)
    (dj, di) = spacings[0]
    try:
        affine = checked_affine(compose_affine(row * di, column * dj, step, origin))
    except UsageError as error:
        raise RefusedInputError(f"the frames of {name} cannot be placed: {error}") from error
    return FrameStack(affine, places, max(places) + 1, warnings)


def _stated_mm(measures: Any, keyword: str) -> float | None:
    """Return a length of the pixel measures, None where there is none."""
    value = measures.get(keyword)
    length = float("nan") if value in (None, "") else float(value)
    return length if np.isfinite(length) and length > SAME_PLACE_MM else None


def _choose_gap(
    along: NDArray[np.float64], spacing: float | None, thickness: float | None
) -> tuple[float, tuple[str, ...]]:
    """Return the step between slices in mm, and warnings about it.

    The step is the smallest gap between frames, divided by a whole number where no two frames are neighbours: by
    SpacingBetweenSlices, or where that is absent by SliceThickness.
    """
    stated = thickness if spacing is None else spacing
    gaps = np.diff(np.sort(along))
    gaps = gaps[gaps > SAME_PLACE_MM]
    if not len(gaps):
        return (1.0, (f"its one slice {_UNSAID}: a thickness of 1 mm is assumed",)) if stated is None else (stated, ())
    gap = float(gaps.min())
    if stated is None:
        return gap, (f"its header {_UNSAID}: the smallest distance of two frames, {gap:g} mm, is taken as the step",)
    parts = max(1, round(gap / stated))
    even = abs(gap - parts * stated) <= OFF_GRID_MM
    step = gap / parts if even else gap
    if spacing is None and (gap < stated or (even and parts == 1)):
        return step, ()  # slices may overlap
    if spacing is not None and even:
        return step, ()
    keyword = "SpacingBetweenSlices" if spacing is not None else "SliceThickness, and there is no SpacingBetweenSlices"
    return step, (
        f"its frames are {gap:g} mm apart, its header says {stated:g} mm ({keyword}): the step is {step:g} mm",
    )


def _fit_stack(
    positions: NDArray[np.float64], normal: NDArray[np.float64], gap: float, name: str
) -> tuple[NDArray[np.float64], list[int], NDArray[np.float64]]:
    """Return the slice step, the slice index of each frame, and the position of slice 0."""
    along = positions @ normal
    heights = np.sort(along)
    if np.diff(heights).max(initial=0.0) <= SAME_PLACE_MM:
        return normal * gap, [0] * len(positions), positions[0]
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
