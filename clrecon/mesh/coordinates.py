"""The type that coordinates of vertices are kept in."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.precision import is_far

__all__ = ["as_stored"]


def as_stored(points: NDArray[Any]) -> NDArray[np.floating]:
    """Coordinates as a `Mesh` keeps them.

    Parameters
    ----------
    points : ndarray, shape (n, 3), mm

    Returns
    -------
    ndarray, shape (n, 3), C-contiguous
        float32; float64 where they are not float32 already and lie so far from the origin that float32 would round
        them by more than 2e-4 mm, see `clrecon.geometry.precision`.
    """
    dtype = np.float64 if points.dtype != np.float32 and is_far(points) else np.float32
    return np.ascontiguousarray(points, dtype=dtype)
