"""`Clip`: the part of space that a picture shows, as planes in LPS mm."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, checked_points
from clrecon.rendering.views.directions import checked_vector
from clrecon.system.base_classes import Message


class Clip(Message):
    """The part of space on the inner side of every plane; without planes, all of space.

    >>> Clip.box((-50, -50, 900), (50, 50, 1000)) & Clip.plane(point=(0, 0, 0), normal=(0, 1, 0))

    Parameters
    ----------
    planes : array_like, shape (n, 4)
        Normal and offset of each plane: a point p in LPS mm is kept where ``normal . p >= offset``. Normals may have
        any length; they are scaled to unit vectors, and the offsets with them.

    Raises
    ------
    UsageError
        The planes are not n times four finite numbers, or a normal has length 0.
    """

    def __init__(self, planes: ArrayLike = ()):
        try:
            table = np.array(planes, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise UsageError(f"clip planes are (normal, offset), four numbers each: {error}") from error
        table = table.reshape(0, 4) if table.size == 0 else table
        if table.ndim != 2 or table.shape[1] != 4:
            raise UsageError(f"clip planes are (normal, offset), shape (n, 4); these have shape {table.shape}")
        if not np.isfinite(table).all():
            raise UsageError("a clip plane holds NaN or infinite numbers")
        largest = np.abs(table[:, :3]).max(axis=1, initial=0.0, keepdims=True)
        lengths = largest * np.linalg.norm(table[:, :3] / np.maximum(largest, 1e-12), axis=1, keepdims=True)
        if len(table) and lengths.min() < 1e-12:
            raise UsageError(f"clip plane {int(lengths.argmin())} has a normal of length 0: it has no inner side")
        self._planes: Float64Array = table / lengths + 0.0  # no -0.0, so that equal clips have equal bytes
        self._planes.flags.writeable = False

    @classmethod
    def box(cls, low: ArrayLike, high: ArrayLike) -> Clip:
        """Keep a box along the axes of the patient.

        Parameters
        ----------
        low, high : array_like, shape (3,)
            LPS mm; infinite numbers leave a side open.

        Raises
        ------
        UsageError
            Not three numbers each, or ``low`` is not below ``high``.
        """
        try:
            corners = np.array([low, high], dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            corners = np.empty(0)
        if corners.shape != (2, 3) or np.isnan(corners).any():
            raise UsageError(f"a clip box has two corners of three numbers in LPS mm, not {low!r} and {high!r}")
        for axis, (below, above) in zip("xyz", corners.T, strict=True):
            if not below < above:
                raise UsageError(f"the clip box runs from {below:g} to {above:g} mm along {axis}: it holds nothing")
        planes = np.vstack([np.column_stack([np.eye(3), corners[0]]), np.column_stack([-np.eye(3), -corners[1]])])
        return cls(planes[np.isfinite(planes[:, 3])])

    @classmethod
    def plane(cls, point: ArrayLike, normal: ArrayLike) -> Clip:
        """Keep the side of a plane that its normal points to.

        Parameters
        ----------
        point : array_like, shape (3,)
            A point of the plane, LPS mm.
        normal : array_like, shape (3,)
            Vector of any length except 0.

        Raises
        ------
        UsageError
            Not three finite numbers each, or a normal of length 0.
        """
        through = checked_vector("the point of a clip plane", point)
        inwards = checked_vector("the normal of a clip plane", normal)
        with np.errstate(over="ignore", invalid="ignore"):  # an offset that is not finite is refused
            return cls([(*inwards, float(np.dot(inwards, through)))])

    @property
    def planes(self) -> Float64Array:
        """Unit normals and offsets in mm, shape (n, 4), float64, read-only."""
        return self._planes

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return which points (n, 3), LPS mm, are kept: shape (n,), bool."""
        heights = checked_points(points) @ self._planes[:, :3].T
        return np.asarray((heights >= self._planes[:, 3]).all(axis=1))

    def __and__(self, other: Clip) -> Clip:
        """Keep only points that both keep."""
        if not isinstance(other, Clip):
            return NotImplemented
        return Clip(np.vstack([self._planes, other._planes]))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Clip) and np.array_equal(self._planes, other._planes)

    def __hash__(self) -> int:
        return hash(self._planes.tobytes())

    def __repr__(self) -> str:
        return f"Clip({self._planes.tolist()})"
