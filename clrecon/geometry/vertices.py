"""Where vertices lie: on which fraction of a crossed edge of the sample grid, and in which floating-point type.

A table far from the origin of the frame, or the frame of another machine, can put patients tens of metres away: at 1e5
mm the step of float32 is 8e-3 mm.  Vertices of such volumes are computed in float32 relative to a point near the
volume's centre, and that point is added in float64.

Sources: Lorensen and Cline 1987 (linear); Liu et al. 2019, "Vertebrae CT Images 3D Reconstruction with Improve Marching
Cubes Algorithm", J. Harbin Inst. Technol. (New Series) 26(6), eq. 6-11 (golden section); Catmull and Rom 1974; Kiefer
1953 (golden-section search).
"""

from __future__ import annotations

import math
from itertools import product
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import VertexRule, name_parameter

_VERTEX_RULES: tuple[str, ...] = get_args(VertexRule)

GOLDEN = 0.6180340
"""(sqrt(5) - 1) / 2 in the digits of the paper, which float32 holds to its last place."""

SEARCH_STEPS = 24
"""Cuts of an edge: the last part is 0.618^24, 1e-5 of it."""


def check_vertex_rule(vertex_rule: str, topology: str = "separated") -> None:
    if vertex_rule not in _VERTEX_RULES:
        raise UsageError(f"{name_parameter('vertex_rule')} is one of {', '.join(_VERTEX_RULES)}, not {vertex_rule!r}")
    if vertex_rule != "linear" and topology == "trilinear":
        raise UsageError(
            f"{name_parameter('vertex_rule', vertex_rule)} and {name_parameter('topology', 'trilinear')} exclude each"
            " other: the trilinear field is linear along edges"
        )


def warnings_of_rule(vertex_rule: str) -> list[str]:
    """Return the warning for a rule that does not follow the HU, none for the others."""
    if vertex_rule != "golden":
        return []
    return [
        "vertices lie at 0.618 of their edges whatever the HU, as the paper has it: 0.22 voxels from the surface in the"
        f" root mean square, 0.6 at most; {name_parameter('vertex_rule', 'linear')} is within 0.02"
    ]


def linear_fraction(value: ArrayLike, next_value: ArrayLike, level: ArrayLike) -> NDArray[np.float64]:
    """Return where values that are linear along an edge cross the level: (level - f0) / (f1 - f0)."""
    first, last = np.asarray(value, np.float64), np.asarray(next_value, np.float64)
    return np.asarray((np.asarray(level) - first) / (last - first))


def golden_fraction(value: ArrayLike) -> NDArray[np.float64]:
    """Return the constant of eq. 6-8 for every edge, whatever its values."""
    return np.full(np.shape(value), GOLDEN)


def point_on_edge(corner: ArrayLike, axis: int, fraction: ArrayLike) -> NDArray[np.float64]:
    """Return the point at a fraction of the edge from a corner (x, y, z) along an axis: eq. 6 to 8 for `GOLDEN`."""
    placed = np.array(corner, np.float64)
    placed[..., axis] += np.asarray(fraction, np.float64)
    return placed


def normal_on_edge(normal: ArrayLike, next_normal: ArrayLike, fraction: ArrayLike) -> NDArray[np.float64]:
    """Return the normal at a fraction of an edge, not yet of length 1: eq. 9 to 11, N0 + t (N1 - N0), one an axis."""
    first = np.asarray(normal, np.float64)
    return np.asarray(first + np.asarray(fraction)[..., None] * (np.asarray(next_normal, np.float64) - first))


def cubic_value(
    before: ArrayLike, value: ArrayLike, next_value: ArrayLike, after: ArrayLike, fraction: ArrayLike
) -> NDArray[np.float64]:
    """Return the cubic of Catmull and Rom through four values one step apart, at a fraction between the middle two."""
    f0, f1 = np.asarray(value, np.float64), np.asarray(next_value, np.float64)
    t = np.asarray(fraction)
    rise, next_rise = (f1 - np.asarray(before)) / 2.0, (np.asarray(after) - f0) / 2.0
    second, third = 3.0 * (f1 - f0) - 2.0 * rise - next_rise, 2.0 * (f0 - f1) + rise + next_rise
    return np.asarray(f0 + t * (rise + t * (second + t * third)))


def search_fraction(
    before: ArrayLike, value: ArrayLike, next_value: ArrayLike, after: ArrayLike, level: ArrayLike
) -> NDArray[np.float64]:
    """Return where the cubic through four values crosses the level between the middle two, by golden sections."""
    levels, rises = np.asarray(level), np.asarray(next_value) > np.asarray(value)
    low = np.zeros(np.broadcast(value, levels).shape)
    high = np.ones_like(low)
    for _ in range(SEARCH_STEPS):
        cut = low + GOLDEN * (high - low)
        beyond = (cubic_value(before, value, next_value, after, cut) >= levels) == rises
        low, high = np.where(beyond, low, cut), np.where(beyond, cut, high)
    return 0.5 * (low + high)


FAR_MM = 4096.0
"""Coordinates from here on count as far: the step of float32, at most 2.4e-4 mm below, is 4.9e-4 mm or more."""


def is_far(points: NDArray[np.floating]) -> bool:
    """True where a coordinate in mm lies so far from the origin that float32 is too coarse for it."""
    return points.size > 0 and bool(max(-points.min(), points.max()) >= FAR_MM)


def float32_step(largest: float) -> float:
    """Distance in mm from one float32 to the next at a coordinate of `largest` mm."""
    return float(np.spacing(np.float32(largest)))


def largest_coordinate(volume: Volume, origin: Float64Array | None = None, border: int = 1) -> float:
    """Largest coordinate in mm in the volume's slices, relative to `origin`, with `border` layers around it."""
    ni, nj, _ = volume.shape_ijk
    steps = np.array(list(product((-border, ni - 1 + border), (-border, nj - 1 + border))), dtype=np.float64)
    corners = volume.slice_origins(border)[:, None] + steps @ volume.affine[:3, :2].T
    return float(np.abs(corners if origin is None else corners - origin).max())


def warnings_of_far(volume: Volume) -> list[str]:
    """Return the warning that goes with `find_vertex_origin`; no warning for a volume that is near."""
    largest = largest_coordinate(volume)
    if largest < FAR_MM:
        return []
    return [
        f"the volume reaches {largest:.0f} mm from the origin, where float32 comes in steps of"
        f" {float32_step(largest):.2g} mm: vertices are float64"
    ]


def find_vertex_origin(volume: Volume) -> Float64Array | None:
    """Return whole mm (3,), LPS, that float32 vertices count from if the volume reaches `FAR_MM`, else None."""
    if largest_coordinate(volume) < FAR_MM:
        return None
    centre = (np.array(volume.shape_ijk, dtype=np.float64) - 1.0) / 2.0
    return np.rint(volume.ijk_to_lps(centre[None])[0])


def power_of_two_over(largest: float) -> float:
    """Return a power of two that scales `largest` to 1 or below, as far as float32 reaches."""
    _, exponent = math.frexp(largest)
    return 2.0 ** min(max(-exponent, -126), 126)
