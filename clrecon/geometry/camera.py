"""`Camera`: from where, in which direction and how large a picture is taken, in LPS mm and with VTK's meanings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array

__all__ = ["Camera", "CameraBasis"]

DEFAULT_VIEW_ANGLE = 30.0
"""Degrees from the bottom to the top of a perspective picture, as in VTK."""


class CameraBasis(NamedTuple):
    """Unit vectors in LPS: to the right of the picture, to its top, and into it."""

    right: Float64Array
    up: Float64Array
    forward: Float64Array


def _vector(what: str, value: ArrayLike) -> tuple[float, float, float]:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise UsageError(f"the {what} of a camera is three finite numbers in LPS mm, not {value!r}")
    return float(array[0]), float(array[1]), float(array[2])


@dataclass(frozen=True)
class Camera:
    """Where a picture is taken from.

    Attributes
    ----------
    position : (float, float, float)
        LPS mm.  Depths are measured from here: along the ray of each pixel in a perspective picture, and from the
        plane through here across the view direction in a parallel one.
    focal_point : (float, float, float)
        LPS mm, in the middle of the picture.
    up : (float, float, float)
        Direction in LPS that points to the top of the picture; need not be perpendicular to the view.
    view_angle : float or None
        Degrees from the bottom to the top of a perspective picture; None where `parallel_scale` is given, and 30
        where neither is.
    parallel_scale : float or None
        Half the height of a parallel picture in mm; None makes it a perspective one.

    Raises
    ------
    UsageError
        Not three finite numbers each, position and focal point in one place, `up` along the view, an angle beyond
        0.001 to 179 degrees, a scale that is not positive, or both of them.
    """

    position: tuple[float, float, float]
    focal_point: tuple[float, float, float]
    up: tuple[float, float, float]
    view_angle: float | None = None
    parallel_scale: float | None = None

    def __post_init__(self) -> None:
        for name in ("position", "focal_point", "up"):
            object.__setattr__(self, name, _vector(name.replace("_", " "), getattr(self, name)))
        if self.view_angle is not None and self.parallel_scale is not None:
            raise UsageError("a camera has a view angle (perspective) or a parallel scale, not both")
        if self.parallel_scale is None:
            angle = DEFAULT_VIEW_ANGLE if self.view_angle is None else self.view_angle
            if not 1e-3 <= angle <= 179.0:
                raise UsageError(f"the view angle of a camera lies between 0.001 and 179 degrees, not at {angle!r}")
            object.__setattr__(self, "view_angle", float(angle))
        elif not (0.0 < self.parallel_scale < np.inf):
            raise UsageError(f"the parallel scale of a camera is a length in mm, not {self.parallel_scale!r}")
        self.basis()

    @property
    def is_parallel(self) -> bool:
        """True for parallel projection."""
        return self.parallel_scale is not None

    @property
    def distance(self) -> float:
        """From position to focal point, mm."""
        return float(np.linalg.norm(np.subtract(self.focal_point, self.position)))

    def basis(self) -> CameraBasis:
        """Unit vectors right, up and forward of the picture, LPS.

        Raises
        ------
        UsageError
            Position and focal point are in one place, or `up` runs along the view.
        """
        forward = np.subtract(self.focal_point, self.position)
        length = np.linalg.norm(forward)
        if length < 1e-6:
            raise UsageError("position and focal point of a camera lie in one place: there is no direction to look in")
        forward /= length
        up = np.array(self.up)
        size = np.linalg.norm(up)
        right = np.cross(forward, up)
        if size < 1e-12 or np.linalg.norm(right) < 1e-6 * size:
            raise UsageError("the up direction of a camera runs along its view: name another one")
        right /= np.linalg.norm(right)
        return CameraBasis(right, np.cross(right, forward), forward)

    def half_height(self) -> float:
        """Half the height of the picture: mm, or for perspective mm per mm of distance along the view."""
        if self.parallel_scale is not None:
            return self.parallel_scale
        assert self.view_angle is not None
        return float(np.tan(np.radians(0.5 * self.view_angle)))
