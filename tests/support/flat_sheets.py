"""A flat sheet of triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def sheet(size: int) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Return a square of ``size * size`` vertices, 1 mm apart, in the plane z = 0.

    Cell (x, y) has the triangle ``x + (size - 1) * y``, beside its lower edge, and ``(size - 1) ** 2`` later the other.
    """
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(size), np.arange(size)))
    corner = (x + size * y)[(x < size - 1) & (y < size - 1)]
    lower = np.column_stack([corner, corner + 1, corner + size + 1])
    upper = np.column_stack([corner, corner + size + 1, corner + size])
    return np.column_stack([x, y, np.zeros(size * size)]).astype(float), np.concatenate([lower, upper]).astype(
        np.uint32
    )
