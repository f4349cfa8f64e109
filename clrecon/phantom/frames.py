"""Directions of the slices of a phantom in the patient."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]


def _rotation(oblique: tuple[float, float, float]) -> Float64Array:
    """Return the rotation about x, then y, then z, degrees."""
    matrix = np.eye(3)
    for axis, angle in enumerate(oblique):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[[first, second], [first, second]] = c
        turn[first, second], turn[second, first] = -s, s
        matrix = turn @ matrix
    return matrix


def slice_directions(
    tilt_deg: float, oblique: tuple[float, float, float], prone: bool, gap_mm: float = 1.0
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return the directions of a phantom's axes in the patient.

    tilt_deg: Gantry tilt.
    oblique: (about_x, about_y, about_z). Degrees by which the frame is then rotated.
    prone: Rows and columns are turned by half a turn.
    gap_mm: Distance of two slices along their normal.

    Returns:
    row, column: ndarray, shape (3,). Unit vectors along i and j, LPS.
    step: ndarray, shape (3,). Slice step in mm: longer than the gap where the gantry is tilted.
    """
    tilt = math.radians(tilt_deg)
    rotation = _rotation(oblique)
    if prone:
        rotation = rotation @ np.diag((-1.0, -1.0, 1.0))
    row = rotation @ (1.0, 0.0, 0.0)
    column = rotation @ (0.0, math.cos(tilt), -math.sin(tilt))
    return row, column, rotation @ (0.0, 0.0, gap_mm / math.cos(tilt))
