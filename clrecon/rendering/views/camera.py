"""`Camera`: position, direction and scale of a picture, in LPS mm and with VTK's meanings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, checked_points
from clrecon.geometry.grid import Grid
from clrecon.rendering.views.directions import DEFAULT_SIZE, as_point, checked_size, checked_vector, find_up, find_view
from clrecon.system.arguments import DirectionName, explains_arguments, number_or_nan
from clrecon.system.light_dataclass import dataclass, replace

DEFAULT_VIEW_ANGLE = 30.0
"""Degrees from the bottom to the top of a perspective picture, as in VTK."""

_FIT_MARGIN = 1.02
"""Factor by which a fitted picture is larger than the volume."""

_TURN_STEP = 5
"""Step in degrees between the tested directions of a turning camera."""

_RADII_AWAY = 2.0
"""Distance of a parallel camera from the centre, in radii of the volume: outside, but near, as depths lose digits."""


class CameraBasis(NamedTuple):
    """Unit vectors in LPS: to the right of the picture, to its top, and into it."""

    right: Float64Array
    up: Float64Array
    forward: Float64Array


FARTHEST_MM = 1e9
"""Largest distance from a volume for float32 coordinates on a device; no patient is so large."""


def box_corners(volume: Grid) -> Float64Array:
    """Corners (n, 3) in LPS mm of the space that voxels fill, half a voxel beyond the outer centres.

    The first and the last four are those of the whole box; for uneven slices, those of every slice are between them.
    The volume lies in the convex hull of these points.
    """
    ni, nj, nk = volume.shape_ijk
    inner = np.arange(nk) if getattr(volume, "uneven", False) else np.empty(0)
    k, j, i = np.meshgrid([-0.5, *inner, nk - 0.5], (-0.5, nj - 0.5), (-0.5, ni - 0.5), indexing="ij")
    return volume.ijk_to_lps(np.column_stack([i.ravel(), j.ravel(), k.ravel()]))


_SMALLEST_SIDE_MM = 1e-3
"""Least side of a box, so that its affine can be inverted and a camera has a view direction and a height."""


def box_between(low: ArrayLike, high: ArrayLike) -> Grid:
    """Return the box between two corners, LPS mm, as a grid of one voxel, which `Camera.fit` places a camera for."""
    lowest, highest = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    affine = np.diag([*np.maximum(highest - lowest, _SMALLEST_SIDE_MM), 1.0])
    affine[:3, 3] = 0.5 * (lowest + highest)
    return Grid(np.zeros((1, 1, 1), np.int8), affine)


@dataclass(frozen=True)
class Camera:
    """The view of a picture.

    Attributes
    ----------
    position : (float, float, float)
        LPS mm.  Depths are measured from here: along the ray of each pixel in a perspective picture, and from the
        plane through here across the view direction in a parallel one.
    focal_point : (float, float, float)
        LPS mm; appears in the middle of the picture.
    up : (float, float, float)
        Direction in LPS that points to the top of the picture; need not be perpendicular to the view.
    view_angle : float or None
        Degrees from the bottom to the top of a perspective picture; None if ``parallel_scale`` is given, 30 if neither
        is.
    parallel_scale : float or None
        Half the height of a parallel picture in mm; None for a perspective one.

    Raises
    ------
    UsageError
        A vector is not three finite numbers; position and focal point coincide; ``up`` is along the view; the angle is
        outside 0.001 to 179 degrees; the scale is not positive; or both angle and scale are given.
    """

    position: tuple[float, float, float]
    focal_point: tuple[float, float, float]
    up: tuple[float, float, float]
    view_angle: float | None = None
    parallel_scale: float | None = None

    def __post_init__(self) -> None:
        for name in ("position", "focal_point", "up"):
            checked = checked_vector(f"the {name.replace('_', ' ')} of a camera", getattr(self, name))
            object.__setattr__(self, name, checked)
        for name in ("position", "focal_point"):
            if max(map(abs, getattr(self, name))) > FARTHEST_MM:
                raise UsageError(f"the {name.replace('_', ' ')} of a camera is within a thousand kilometres")
        if self.view_angle is not None and self.parallel_scale is not None:
            raise UsageError("a camera has a view angle (perspective) or a parallel scale, not both")
        if self.parallel_scale is None:
            angle = DEFAULT_VIEW_ANGLE if self.view_angle is None else number_or_nan(self.view_angle)
            if not 1e-3 <= angle <= 179.0:
                raise UsageError(
                    f"the view angle of a camera lies between 0.001 and 179 degrees, not at {self.view_angle!r}"
                )
            object.__setattr__(self, "view_angle", angle)
        else:
            scale = number_or_nan(self.parallel_scale)
            if not 0.0 < scale <= FARTHEST_MM:
                raise UsageError(
                    "the parallel scale of a camera is a length in mm, above 0 to a thousand kilometres, not"
                    f" {self.parallel_scale!r}"
                )
            object.__setattr__(self, "parallel_scale", scale)
        self.basis()

    @classmethod
    @explains_arguments
    def fit(
        cls,
        volume: Grid,
        view: DirectionName | Sequence[float] = "anterior",
        zoom: float = 1.0,
        *,
        up: str | ArrayLike | None = None,
        view_angle: float | None = None,
        size: Sequence[int] = DEFAULT_SIZE,
        turning: bool = False,
        center: ArrayLike | None = None,
    ) -> Camera:
        """Return a camera that looks at the middle of a volume from a side of the patient, so that the volume just
        fits.

        Parameters
        ----------
        volume : Volume or Grid
            May be sheared or uneven.
        view : str or (float, float)
            anterior, posterior, left, right, superior, inferior: the side where the camera stands; or azimuth and
            elevation in degrees, see ``clrecon.rendering.views.directions.find_view``.
        zoom : float
            2 shows everything twice as large, see `zoomed`.
        up : str or array_like, shape (3,), optional
            Side of the patient (by the names above), or a direction in LPS, at the top of the picture; default:
            superior, and anterior in views along the body.
        view_angle : float, optional
            View angle in degrees of a perspective camera; default: a parallel camera.
        size : (int, int)
            Width and height of the picture.
        turning : bool
            True: leave enough room that the volume stays inside the picture while the camera orbits about the axis of
            the body.
        center : array_like, shape (3,), optional
            LPS mm, in the middle of the picture in place of the middle of the volume; the scale stays the same.

        Raises
        ------
        UsageError
            Unknown view (the message lists them) or direction, ``up`` along the view, or impossible numbers.
        """
        width, height = checked_size(size)
        towards, default_up = find_view(view)
        up_lps = default_up if up is None else find_up(up)
        corners = box_corners(volume)
        middle = np.concatenate([corners[:4], corners[-4:]]).mean(axis=0)
        radius = float(np.linalg.norm(corners - middle, axis=1).max())
        parallel = view_angle is None
        scale = 1.0 if parallel else None
        near = cls(as_point(middle + towards), as_point(middle), as_point(up_lps), view_angle, scale)
        turns = range(0, 360, _TURN_STEP) if turning else (0,)
        needs = [near.orbit(turn)._room_for(corners - middle, width / height) for turn in turns]
        position = middle + (_RADII_AWAY * radius if parallel else max(needs)) * towards
        scale = max(needs) if parallel else None
        if center is not None:
            moved = checked_vector("the centre of a picture", center) - middle
            # A parallel camera stays outside of the volume, and a perspective one at its distance.
            away = max(0.0, float(moved @ -towards)) * towards if parallel else 0.0
            middle, position = middle + moved, position + moved + away
        return cls(as_point(position), as_point(middle), as_point(up_lps), view_angle, scale).zoomed(zoom)

    def _room_for(self, points: Float64Array, aspect: float) -> float:
        """Return the parallel scale, or the distance of a perspective camera, at which points about the focus fit."""
        right, up, forward = self.basis()
        across = np.maximum(np.abs(points @ up), np.abs(points @ right) / aspect) * _FIT_MARGIN
        if self.is_parallel:
            return float(across.max())
        return float((across / self.half_height() - points @ forward).max())

    @classmethod
    @explains_arguments
    def from_pyvista(cls, source: Any, size: Sequence[int] | None = None) -> Camera:
        """Return the camera of a PyVista plotter, a PyVista or a VTK camera, see ``clrecon.rendering.views.vtk``.

        Parameters
        ----------
        source : pyvista.Plotter, pyvista.Camera or vtkCamera
            Camera or plotter of a scene in LPS mm.
        size : (int, int), optional
            Size of the picture, for cameras whose view angle is the horizontal one; default: the plotter's window.
        """
        from clrecon.rendering.views.vtk import parameters_from_vtk

        return cls(**parameters_from_vtk(source, size))

    def to_pyvista(self) -> Any:
        """Return a ``pyvista.Camera`` with the same view, for a scene in LPS mm: ``plotter.camera =
        camera.to_pyvista()``.
        """
        from clrecon.rendering.views.vtk import make_pyvista_camera

        return make_pyvista_camera(self.position, self.focal_point, self.up, self.view_angle, self.parallel_scale)

    @property
    def is_parallel(self) -> bool:
        """True for parallel projection."""
        return self.parallel_scale is not None

    @property
    def distance(self) -> float:
        """Distance from position to focal point, mm."""
        return float(np.linalg.norm(np.subtract(self.focal_point, self.position)))

    def basis(self) -> CameraBasis:
        """Unit vectors right, up and forward of the picture, LPS.

        Raises
        ------
        UsageError
            Position and focal point coincide, or ``up`` is along the view.
        """
        return self._basis

    @cached_property
    def _basis(self) -> CameraBasis:
        forward = np.subtract(self.focal_point, self.position)
        length = np.linalg.norm(forward)
        if length < 1e-6:
            raise UsageError("position and focal point of a camera lie in one place: there is no direction to look in")
        forward /= length
        up = np.array(self.up) / max(np.abs(self.up).max(), 1e-12)  # a vector of 1e200 still gets a length
        size = np.linalg.norm(up)
        right = np.cross(forward, up)
        if size < 1e-12 or np.linalg.norm(right) < 1e-6 * size:
            raise UsageError("the up direction of a camera runs along its view: name another one")
        right /= np.linalg.norm(right)
        basis = CameraBasis(right, np.cross(right, forward), forward)
        for vector in basis:
            vector.flags.writeable = False  # all pictures of the camera share them
        return basis

    def half_height(self) -> float:
        """Half the height of the picture: in mm, or for perspective in mm per mm of distance along the view."""
        if self.parallel_scale is not None:
            return self.parallel_scale
        assert self.view_angle is not None
        return float(np.tan(np.radians(0.5 * self.view_angle)))

    @explains_arguments
    def pixel_mm(self, size: Sequence[int]) -> float:
        """Return the side of a pixel in mm: everywhere in a parallel picture, at the focal point in a perspective one.

        Parameters
        ----------
        size : (int, int)
            Width and height of the picture.
        """
        _, height = checked_size(size)
        return 2.0 * self.half_height() * (1.0 if self.is_parallel else self.distance) / height

    @explains_arguments
    def rays(self, size: Sequence[int]) -> tuple[Float64Array, Float64Array]:
        """Return the ray of each pixel, through its centre (x + 0.5, y + 0.5).

        Parameters
        ----------
        size : (int, int)
            Width and height of the picture.

        Returns
        -------
        origins, directions : ndarray, shape (h, w, 3), float64
            LPS mm and unit vectors; row 0 is the top of the picture.
        """
        width, height = checked_size(size)
        right, up, forward = self.basis()
        pixel = 2.0 * self.half_height() / height
        x = (np.arange(width) + 0.5 - 0.5 * width) * pixel
        y = (0.5 * height - np.arange(height) - 0.5) * pixel
        offsets = x[None, :, None] * right + y[:, None, None] * up
        if self.is_parallel:
            return self.position + offsets, np.broadcast_to(forward, offsets.shape).copy()
        directions = forward + offsets
        directions /= np.linalg.norm(directions, axis=2, keepdims=True)
        return np.broadcast_to(self.position, offsets.shape).copy(), directions

    @explains_arguments
    def project(self, points: ArrayLike, size: Sequence[int]) -> tuple[Float64Array, Float64Array]:
        """Return where points appear in the picture; the inverse of `rays`.

        Parameters
        ----------
        points : array_like, shape (n, 3)
            LPS mm.
        size : (int, int)
            Width and height of the picture.

        Returns
        -------
        pixels : ndarray, shape (n, 2), float64
            x to the right and y down from the top left corner of the picture, so that the first pixel's centre is (0.5,
            0.5); NaN for points beside or behind a perspective camera.
        depths : ndarray, shape (n,), float64
            Mm along the ray, negative behind a parallel camera; NaN as above.
        """
        width, height = checked_size(size)
        from_position = checked_points(points) - self.position
        right, up, forward = self.basis()
        along = from_position @ forward
        pixel: Any = 2.0 * self.half_height() / height
        depths = along
        if not self.is_parallel:
            along = np.where(along > 1e-9 * self.distance, along, np.nan)
            pixel = pixel * along
            depths = np.linalg.norm(from_position, axis=1) + 0.0 * along
        x = 0.5 * width + from_position @ right / pixel
        return np.column_stack([x, 0.5 * height - from_position @ up / pixel]), depths

    @explains_arguments
    def orbit(self, azimuth: float, elevation: float = 0.0) -> Camera:
        """Return a camera turned around the focal point; angles are counted as in `fit`.

        Parameters
        ----------
        azimuth : float
            Degrees about the axis of the body, from anterior towards the patient's left.
        elevation : float
            Degrees towards the top of the picture, before the azimuth.

        Returns
        -------
        Camera
            At the same distance from the focal point; ``up`` has turned with it.
        """
        if not np.isfinite([number_or_nan(azimuth), number_or_nan(elevation)]).all():
            raise UsageError(f"a camera orbits by finite angles in degrees, not by {azimuth!r} and {elevation!r}")
        turn = rotation_about((0.0, 0.0, 1.0), azimuth) @ rotation_about(self.basis().right, -elevation)
        offset = turn @ np.subtract(self.position, self.focal_point)
        return replace(self, position=as_point(self.focal_point + offset), up=as_point(turn @ self.up))

    @explains_arguments
    def zoomed(self, zoom: float) -> Camera:
        """Return a camera at the same place that shows everything ``zoom`` times as large.

        Raises
        ------
        UsageError
            ``zoom`` is not positive, or gives an angle out of range.
        """
        factor = number_or_nan(zoom)
        if not (0.0 < factor < np.inf):
            raise UsageError(f"zoom is a positive number, 2 shows everything twice as large, not {zoom!r}")
        if factor == 1.0:
            return self
        if self.parallel_scale is not None:
            return replace(self, parallel_scale=self.parallel_scale / factor)
        return replace(self, view_angle=float(2.0 * np.degrees(np.arctan(self.half_height() / factor))))


def rotation_about(axis: ArrayLike, degrees: float) -> Float64Array:
    """Return the right-handed rotation about a unit axis, shape (3, 3) (Rodrigues 1840)."""
    x, y, z = np.asarray(axis, dtype=np.float64)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    radians = np.radians(degrees)
    return np.eye(3) + np.sin(radians) * cross + (1.0 - np.cos(radians)) * cross @ cross


def describe_camera(camera: Camera) -> dict[str, Any]:
    """Return a camera as entries of JSON, by the arguments of `Camera`."""
    return {
        "position_lps_mm": list(camera.position),
        "focal_point_lps_mm": list(camera.focal_point),
        "up_lps": list(camera.up),
        "view_angle_deg": camera.view_angle,
        "parallel_scale_mm": camera.parallel_scale,
    }
