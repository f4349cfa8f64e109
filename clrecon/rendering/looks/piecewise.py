"""Piecewise linear functions with steps, the parts of transfer functions, and where they are steep.

A curve is `positions` (n,), ascending, and `values` (n, k), both float64; two points at one position are a step, where
the second counts from that position on.  Beyond its ends a curve is constant.  Where a transfer function is steep,
volume rendering divides its segments into parts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.system.light_dataclass import dataclass

_STRAIGHT_PARTS = 32
"""Number of straight parts that replace a bent one; the error is at most 0.003 of its rise."""


def check_ascending(title: str, unit: str, positions: Float64Array) -> None:
    """Refuse positions (n,) that descend, and more than two at one place."""
    back = np.flatnonzero(np.diff(positions) < 0)
    if back.size:
        n = int(back[0])
        raise UsageError(
            f"{title} goes back from {positions[n]:g} {unit} at point {n + 1} to {positions[n + 1]:g} {unit} at point"
            f" {n + 2}: order its points by {unit}"
        )
    thrice = np.flatnonzero(positions[2:] == positions[:-2])
    if thrice.size:
        n = int(thrice[0])
        raise UsageError(
            f"{title} has more than two points at {positions[n]:g} {unit}, from point {n + 1} on: a step has two"
        )


def check_share(title: str, value: float, n: int, advice: str = "") -> None:
    """Refuse a value of point `n` (from 0) that is not in 0..1."""
    if not 0.0 <= value <= 1.0:
        raise UsageError(f"{title} of point {n + 1} is {value:g}, and must lie between 0 and 1{advice}")


def evaluate_curve(
    positions: Float64Array, values: Float64Array, places: Float64Array, *, left: bool = False
) -> Float64Array:
    """Return values (..., k) of a curve at positions (...,); with `left`, a step has the value of its first point."""
    if left:  # mirrored, it is the second point
        positions = -positions[::-1]
        values = values[::-1]
        places = -places
    # np.interp uses the last of equal positions: it searches the place with positions[n] <= at < positions[n + 1].
    return np.stack([np.interp(places, positions, column) for column in values.T], axis=-1)


def merge_curves(first: tuple[Float64Array, Float64Array], second: tuple[Float64Array, Float64Array]) -> Float64Array:
    """Merge two curves over the same axis into points (n, 1 + k + l): position, values of the first, of the second."""
    steps = {at for positions, _ in (first, second) for at in positions[1:][positions[1:] == positions[:-1]].tolist()}
    rows = []
    for position in np.unique(np.concatenate([first[0], second[0]])):
        here = np.array([position])
        # Elsewhere both sides are equal except for rounding.
        for left in (True, False) if float(position) in steps else (False,):
            rows.append(
                np.concatenate(
                    [here, evaluate_curve(*first, here, left=left)[0], evaluate_curve(*second, here, left=left)[0]]
                )
            )
    return np.array(rows)


def _bend(sharpness: float) -> tuple[Float64Array, Float64Array]:
    """Return shares of the way and of the rise at which a bent part (vtkPiecewiseFunction) is broken.

    The rise is one half at 0.5. Breaks are evenly spaced in VTK's own parameter s, so they are dense where the way is
    steep, and towards its ends.
    """
    t = np.arange(1, _STRAIGHT_PARTS) / _STRAIGHT_PARTS
    s = np.where(t < 0.5, 2.0 * t * t, 1.0 - 2.0 * (1.0 - t) ** 2)
    root = 1.0 / (1.0 + 10.0 * sharpness)
    run = np.where(s < 0.5, 0.5 * (2.0 * s) ** root, 1.0 - 0.5 * (2.0 - 2.0 * s) ** root)
    rise = s * s * (3.0 - 2.0 * s) + (1.0 - sharpness) * s * (2.0 * s * s - 3.0 * s + 1.0)
    return run, np.clip(rise, 0.0, 1.0)


def straighten_curve(
    positions: Float64Array, values: Float64Array, midpoints: Float64Array, sharpness: Float64Array, steps: bool
) -> tuple[Float64Array, Float64Array]:
    """Make a curve from VTK's nodes: `midpoints` and `sharpness` (n,) bend the part from each node to the next one.

    Where sharpness is below 0.01, straight to the midpoint and straight on; else `_STRAIGHT_PARTS` straight parts.
    With `steps` (VTK's colours, not its opacities) there is a step at the midpoint above 0.99.
    """
    out_positions, out_values = [positions[:1]], [values[:1]]
    for n in range(positions.size - 1):
        middle, sharp = float(np.clip(midpoints[n], 1e-5, 1.0 - 1e-5)), float(sharpness[n])
        if positions[n + 1] == positions[n] or (sharp < 0.01 and middle == 0.5):
            run, rise = np.empty(0), np.empty(0)
        elif sharp > 0.99 and steps:
            run, rise = np.array([0.5, 0.5]), np.array([0.0, 1.0])
        elif sharp < 0.01:
            run, rise = np.array([0.5]), np.array([0.5])
        else:
            run, rise = _bend(sharp)
        run = np.where(run < 0.5, 2.0 * run * middle, middle + (2.0 * run - 1.0) * (1.0 - middle))
        out_positions += [positions[n] + run * (positions[n + 1] - positions[n]), positions[n + 1 : n + 2]]
        out_values += [values[n] + rise[:, np.newaxis] * (values[n + 1] - values[n]), values[n + 1 : n + 2]]
    return np.concatenate(out_positions), np.concatenate(out_values)


# The kernels have these three numbers too, in cl/rays/steep_segments.h; a test compares them.
PARTS = 4
"""Number of parts of a segment where the transfer function is steep."""

STEEP = 0.1
"""Change of opacity within a ray step from which on it is steep."""

DENSE = 0.7
"""Opacity of a ray step from which on only its front is visible."""

_STEEP_HU = 50.0
"""Widest range of HU for the change `STEEP`: over wider ones parts are no better than samples alone, and cost time."""


@dataclass(frozen=True)
class Steepness:
    """The steepness of a table of opacities over one ray step.

    changes: Shape (nodes,). Sum of the changes of opacity, up and down, from the first node to each node.
    narrow: Number of nodes within which the opacity changes by at most `STEEP`.
    has_dense: The opacity is above `DENSE` somewhere.
    is_steep: The opacity changes by more than `STEEP` within `_STEEP_HU` somewhere.
    """

    changes: NDArray[np.float64]
    narrow: float
    has_dense: bool
    is_steep: bool

    @classmethod
    def of(cls, opacities: NDArray[np.float32], nodes_per_hu: float) -> Steepness:
        """Compute the steepness of opacities (nodes,) over one ray step."""
        changes = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(opacities.astype(np.float64))))])
        ends = np.searchsorted(changes, changes + STEEP, side="right")
        reached = ends < len(changes)
        apart = (ends - np.arange(len(changes)))[reached]
        # Values this far apart may be rounded to nodes that are one more apart.
        narrow = float(max(apart.min() - 1, 0)) if len(apart) else float(len(changes))
        return cls(changes, narrow, bool((opacities > DENSE).any()), narrow <= _STEEP_HU * nodes_per_hu)
