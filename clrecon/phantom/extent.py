"""How far vertebrae reach along a direction, and where a choice of them has to lie in a volume."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.phantom.chain import SpineChoice
from clrecon.phantom.parts import Vertebra
from clrecon.phantom.vertebra import local_bounds, vertebra_distance

Float64Array = NDArray[np.float64]

_STEP_MM = 3.0
_RIM_MM = 1.0
"""Bone is looked for on a lattice; thin ends between its points reach this much farther."""


def _body_reach(vertebra: Vertebra, direction: Float64Array) -> float:
    """Return how far a vertebral body, or the space in the ring of C1, reaches from its middle."""
    x, y, z = vertebra.axes @ direction
    across = np.hypot(x * vertebra.width, y * vertebra.depth)
    return float(across + abs(z) * vertebra.height) / 2.0


def body_extent(vertebrae: Sequence[Vertebra], direction: ArrayLike) -> tuple[float, float]:
    """Return the lowest and highest place of the vertebral bodies along a unit vector, mm."""
    along = np.asarray(direction, dtype=np.float64)
    middles = [float(v.center @ along) for v in vertebrae]
    reaches = [_body_reach(v, along) for v in vertebrae]
    return (
        min(m - r for m, r in zip(middles, reaches, strict=True)),
        max(m + r for m, r in zip(middles, reaches, strict=True)),
    )


def bone_points(vertebra: Vertebra) -> Float64Array:
    """Return the points (n, 3), mm of the plan, of a lattice of 3 mm that lie in a vertebra or up to 1 mm beside it."""
    low, high = local_bounds(vertebra)
    axes = [np.arange(a, b + _STEP_MM, _STEP_MM) for a, b in zip(low, high, strict=True)]
    x, y, z = (part.ravel() for part in np.meshgrid(*axes, indexing="ij"))
    bone = vertebra_distance(vertebra, x, y, z) > -_RIM_MM
    return vertebra.center + np.stack((x, y, z), axis=1)[bone] @ vertebra.axes


def bone_extent(vertebrae: Sequence[Vertebra], direction: ArrayLike) -> tuple[float, float]:
    """Return the lowest and highest place of whole vertebrae along a unit vector, mm, with a rim of about 1 mm."""
    along = np.asarray(direction, dtype=np.float64)
    places = np.concatenate([bone_points(vertebra) for vertebra in vertebrae]) @ along
    return float(places.min()) - _RIM_MM, float(places.max()) + _RIM_MM


def centring_shift(vertebrae: Sequence[Vertebra], choice: SpineChoice) -> Float64Array:
    """Return the shift along z that puts vertebrae into the middle of the volume.

    The whole bones are centred, or the bodies alone where the volume is too short for the bones.  Slices that run
    nearly along the spine do not decide where it lies along z.
    """
    normal = np.array(choice.normal)
    slope = float(normal[2])
    if abs(slope) < 0.5:
        normal, slope = np.array((0.0, 0.0, 1.0)), 1.0
    low, high = bone_extent(vertebrae, normal)
    if choice.length_mm is not None and high - low > choice.length_mm:
        low, high = body_extent(vertebrae, normal)
    return np.array((0.0, 0.0, -(low + high) / 2.0 / slope))
