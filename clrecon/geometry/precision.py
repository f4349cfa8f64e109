"""How far from the origin float32 millimetres are precise enough, and what is done beyond.

A table far from the origin of the frame, or the frame of another machine, can put patients tens of metres away: at 1e5
mm the step of float32 is 8e-3 mm.  Vertices of such volumes are computed in float32 relative to a point near the
volume's centre, and that point is added in float64.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry.affine import Float64Array

if TYPE_CHECKING:
    from clrecon.geometry.volume import Volume

FAR_MM = 4096.0
"""Coordinates from here on count as far.  Below, the step of float32 is at most 2.4e-4 mm; from here on it is 4.9e-4 mm
or more."""


def is_far(points: NDArray[np.floating]) -> bool:
    """True where a coordinate in mm lies so far from the origin that float32 is too coarse for it."""
    return points.size > 0 and bool(max(-points.min(), points.max()) >= FAR_MM)


def float32_step(largest: float) -> float:
    """Distance in mm from one float32 to the next at a coordinate of `largest` mm."""
    return float(np.spacing(np.float32(largest)))


def largest_coordinate(volume: Volume, origin: Float64Array | None = None, border: int = 1) -> float:
    """Largest coordinate in mm in the volume's slices, relative to `origin`, with `border` layers around it."""
    ni, nj, _ = volume.shape_ijk
    steps = np.array([(i, j) for i in (-border, ni - 1 + border) for j in (-border, nj - 1 + border)], dtype=np.float64)
    origins = volume.slice_origins(border)
    corners = origins[:, None] + steps @ volume.affine[:3, :2].T
    return float(np.abs(corners if origin is None else corners - origin).max())


def describe_far(volume: Volume) -> list[str]:
    """Return the warning that goes with `find_vertex_origin`; no warning for a volume that is near."""
    largest = largest_coordinate(volume)
    if largest < FAR_MM:
        return []
    return [
        f"the volume reaches {largest:.0f} mm from the origin, where float32 comes in steps of"
        f" {float32_step(largest):.2g} mm: vertices are float64"
    ]


def find_vertex_origin(volume: Volume) -> Float64Array | None:
    """Return the point in LPS mm that float32 vertices of a volume are counted from; None for the origin of the frame.

    Returns: ndarray, shape (3,), float64, or None. Whole millimetres near the centre of a volume that reaches `FAR_MM`
        or more.
    """
    if largest_coordinate(volume) < FAR_MM:
        return None
    centre = (np.array(volume.shape_ijk, dtype=np.float64) - 1.0) / 2.0
    return np.rint(volume.ijk_to_lps(centre[None])[0])


def power_of_two_over(largest: float) -> float:
    """Return a power of two that scales `largest` to 1 or below, as far as float32 reaches."""
    _, exponent = math.frexp(largest)
    return 2.0 ** min(max(-exponent, -126), 126)
