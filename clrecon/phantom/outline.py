"""Outline of a body that is no straight trunk: with a neck, or bent with its spine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.phantom.chain import Chain

Float64Array = NDArray[np.float64]

NECK_HALF_WIDTH, NECK_HALF_DEPTH = 62.0, 66.0
NECK_BEHIND_MM = 2.0
"""The middle of the neck lies this far behind the middle of the vertebral bodies."""
_NECK_SHARE = {"C7": 0.45, "C6": 0.85}
"""Share of the neck in the outline at the height of a level: 1 above, 0 below."""


@dataclass(frozen=True)
class Outline:
    """Ellipses that follow each other along z.

    z: ndarray, shape (n,). Heights in mm, ascending.
    rows: ndarray, shape (5, n). Middle x and y, half width and half depth in mm, and the share of the neck, at these
        heights; between them linear, beyond them constant.
    """

    z: Float64Array
    rows: Float64Array

    def at(self, z: NDArray[np.floating]) -> list[NDArray[np.float32]]:
        """Return middle x, middle y, half width, half depth and share of the neck at heights of any shape."""
        return [np.interp(z, self.z, row).astype(np.float32) for row in self.rows]


def plan_outline(chain: Chain, half_width: float, half_depth: float) -> Outline | None:
    """Plan the outline round a chain.

    half_width, half_depth: Half axes of the trunk, mm.

    Returns: None round a straight trunk: its ellipse has its middle at x = y = 0 at all heights.
    """
    with_neck = chain.names[0] == "C1"
    if not with_neck and not chain.moved.any():
        return None
    rows = np.empty((5, len(chain.names)))
    for n, name in enumerate(chain.names):
        share = _NECK_SHARE.get(name, 1.0 if name[0] == "C" else 0.0)
        neck_x, neck_y = chain.centres[n, 0], chain.centres[n, 1] + NECK_BEHIND_MM
        rows[:, n] = (
            chain.moved[n, 0] + share * (neck_x - chain.moved[n, 0]),
            chain.moved[n, 1] + share * (neck_y - chain.moved[n, 1]),
            half_width + share * (NECK_HALF_WIDTH - half_width),
            half_depth + share * (NECK_HALF_DEPTH - half_depth),
            share,
        )
    order = np.argsort(chain.centres[:, 2])
    return Outline(chain.centres[order, 2], rows[:, order])
