"""A flat sheet of triangles, and triangles over it whose witnesses are known."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["FLAT_BOUND", "FLAT_CASES", "flat_case", "sheet"]

FLAT_BOUND = 0.5
FLAT_CASES = ("one face", "middles", "names", "left", "no witness")


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


def flat_case(make: Callable[..., Any], case: str) -> tuple[Any, tuple[Any, ...], tuple[list[int], int]]:
    """Return a surface of 9 x 9 vertices, arguments of `find_witnesses`, and what it finds for one triangle."""
    vertices, triangles = sheet(9)
    upper = 64
    places = np.array([[1.2, 1.1, 0.4], [1.9, 1.3, 0.4], [1.8, 1.6, 0.4]])
    names, beside = np.array([10, 10, 10]), np.array([9, 9, 9])
    expected = [9] * 7
    left = 0
    if case != "one face":  # from the cell (1, 1) to (5, 1) and (5, 5)
        places = np.array([[1.2, 1.1, 0.4], [5.2, 1.1, 0.4], [5.9, 5.2, 0.4]])
        names, beside = np.array([10, 14, 50]), np.array([1 + 8, 5 + 8, 5 + 8 * 5])
        expected = [*beside.tolist(), *[int(beside[0])] * 4]
        left = 15
    if case == "middles":  # a face below all but the first corner, which lies 0.45 beside it, stands for the middles
        vertices = np.concatenate([vertices, [[1.65, 1.1, 0.0], [6.2, 1.0, 0.0], [5.7, 5.9, 0.0]]])
        triangles = np.concatenate([triangles, [[81, 82, 83]]]).astype(np.uint32)
        beside = np.array([9, 128, 128])
        expected, left = [9, 128, 128, 9, 9, 9, 9], 0
    elif case == "names":  # around other names lie the cells below the middles, which are found in this order
        # middles: (4.1, 2.47), (3.2, 1.1), (5.55, 3.15), (3.55, 3.15)
        names = np.array([3 + 9, 4 + 9 * 2, 5 + 9 * 3])
        expected = [*beside.tolist(), 4 + 8 * 2 + upper, 3 + 8, 5 + 8 * 3, int(beside[0])]
        left = 8
    elif case == "no witness":
        beside[1] = -1
        expected[1], left = -1, 0
    return make(vertices, triangles), (
        places.astype(np.float32), np.array([[0, 1, 2]], np.uint32), names, beside.astype(np.int32),
    ), (expected, left)  # fmt: skip
