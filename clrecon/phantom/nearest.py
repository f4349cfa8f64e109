"""Nearest points of a surface that is given as the zero of a function."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Float64Array = NDArray[np.float64]
Function = Callable[[Float64Array], Float64Array]

_DELTA_MM = 1e-5


def gradient_of(function: Function, points: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return values (n,) and gradients (n, 3) of a function at points (n, 3), by forward differences."""
    shifts = np.concatenate((np.zeros((1, 3)), _DELTA_MM * np.eye(3)))
    values = function((points + shifts[:, None]).reshape(-1, 3)).reshape(4, -1)
    return values[0], (values[1:] - values[0]).T / _DELTA_MM


def nearest_on_surface(
    function: Function, points: Float64Array, starts: Float64Array, rounds: int, damping: float = 0.5
) -> Float64Array:
    """Move `starts` over the surface towards `points`.

    function: Zero on the surface; its gradient is no zero near it.
    points, starts: ndarray, shape (n, 3). mm; a start near the surface for each point.
    damping: Share of the way along the tangent plane that a round goes.

    Returns: ndarray, shape (n,). Distance to the nearest point of the surface on the way; infinite where none was
        reached.
    """
    best = np.full(len(points), np.inf)
    at = starts
    for _ in range(rounds):
        value, gradient = gradient_of(function, at)
        square = np.maximum(np.einsum("ij,ij->i", gradient, gradient), 1e-6)
        off = np.abs(value) / np.sqrt(square)
        reached = off < 1e-3
        np.minimum(best, np.where(reached, np.linalg.norm(points - at, axis=1) + off, np.inf), out=best)
        way = points - at
        along = np.einsum("ij,ij->i", way, gradient) / square
        tangent = way - along[:, None] * gradient
        at = at + damping * tangent - (value / square)[:, None] * gradient
    return best
