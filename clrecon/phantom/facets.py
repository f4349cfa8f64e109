"""Facet joints that nearly touch: upper articular processes that are widened up to a gap of the vertebra above."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clrecon.phantom.levels import level_number
from clrecon.phantom.nearest import nearest_on_surface
from clrecon.phantom.parts import Vertebra
from clrecon.phantom.vertebra import upper_facet_seats, vertebra_distance

Float64Array = NDArray[np.float64]

LARGEST_GAP_MM = 1.5
"""Largest gap: the shapes themselves lie farther apart."""

_LARGEST_BALL_MM = 6.0
_ROUNDS = 40


def _directions() -> Float64Array:
    """Return unit vectors (26, 3): the neighbours in a cube."""
    grid = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.any(grid != 0.0, axis=1)]
    return grid / np.linalg.norm(grid, axis=1)[:, None]


def _distance_to(vertebra: Vertebra, points: Float64Array) -> Float64Array:
    """Return the distance from points (n, 3) outside of a vertebra and near it, in mm of the plan, to its surface."""

    def surface(local: Float64Array) -> Float64Array:
        return np.asarray(vertebra_distance(vertebra, *local.T), dtype=np.float64)

    local = (points - vertebra.center) @ vertebra.axes.T
    ways = _directions()
    # starts at three distances in all directions: the processes of the vertebra may lie on any side
    starts = np.concatenate([local[:, None] + reach * ways for reach in (2.0, 4.0, 7.0)], axis=1)
    targets = np.repeat(local, starts.shape[1], axis=0)
    found = nearest_on_surface(surface, targets, starts.reshape(-1, 3), _ROUNDS)
    return found.reshape(len(points), -1).min(axis=1)


def close_facets(vertebrae: Sequence[Vertebra], gap_mm: float) -> list[Vertebra]:
    """Widen the upper articular processes by balls whose distance from the vertebra above is `gap_mm`.

    vertebrae: From top to bottom; neighbours in this sequence that are not neighbours in the spine stay as they are.
    """
    closed = list(vertebrae[:1])
    for lower in vertebrae[1:]:
        upper = closed[-1]
        if level_number(lower.name) == level_number(upper.name) + 1:
            seats = np.array([(side * x, y, z) for x, y, z in upper_facet_seats(lower) for side in (1.0, -1.0)])
            free = _distance_to(upper, lower.center + seats @ lower.axes)
            radii = np.minimum(free - gap_mm, _LARGEST_BALL_MM)
            lower = dataclasses.replace(lower, facets=np.column_stack((seats, radii))[radii > 0.5])
        closed.append(lower)
    return closed
