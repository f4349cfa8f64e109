"""Analytic bodies in LPS mm: exact signed distance, area and volume; and the body of a phantom.

Signed distances are in mm, **positive inside** and zero on the surface, so that a distance field behaves like bone
in a CT volume: inside is ``>= 0``.  Source: exact Euclidean distances after J. C. Hart, "Sphere tracing", The
Visual Computer 12 (1996), with the sign turned round.

The body of a phantom is sized for its field of view, with its centre a part of a voxel off the middle."""

from __future__ import annotations

import abc
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry import apply_affine
from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom.settings import PhantomSettings


def _vector(name: str, value: ArrayLike) -> Float64Array:
    vector = np.array(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise UsageError(f"{name} must be three finite numbers, got {np.asarray(value).tolist()}")
    return vector


def _unit(name: str, value: ArrayLike) -> Float64Array:
    vector = _vector(name, value)
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise UsageError(f"{name} must not be the zero vector")
    return vector / length


def _positive(name: str, value: float) -> float:
    number = float(value)
    if not (math.isfinite(number) and number > 0.0):
        raise UsageError(f"{name} must be a positive number of mm, got {value}")
    return number


def checked_points(points_mm: ArrayLike) -> Float64Array:
    points = np.asarray(points_mm, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise UsageError(f"points have shape (n, 3), these have {points.shape}")
    return points


def _box_distance(excess: Float64Array) -> Float64Array:
    """Return the signed distance, positive inside, from (n, m) signed excesses over m orthogonal limits."""
    outside = np.linalg.norm(np.maximum(excess, 0.0), axis=1)
    return -(outside + np.minimum(excess.max(axis=1), 0.0))


def _split(offsets: Float64Array, axis: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the signed lengths of offsets (n, 3) along a unit vector, and their lengths across it."""
    along = offsets @ axis
    return along, np.linalg.norm(offsets - along[:, None] * axis, axis=1)


class Body(abc.ABC):
    """A solid with an exact signed distance, area and volume."""

    kind: str
    center: Float64Array
    area_mm2: float
    volume_ml: float
    reach_mm: Float64Array | float
    """Half of the axis-parallel box around the body."""

    def signed_distance(self, points_mm: ArrayLike) -> Float64Array:
        """Distance in mm to the surface, positive inside, (n,) float64 for points (n, 3) in LPS mm."""
        return self._distance(checked_points(points_mm) - self.center)

    @abc.abstractmethod
    def _distance(self, offsets: Float64Array) -> Float64Array:
        """Return `signed_distance` of points given from the centre."""

    @property
    def bounds_mm(self) -> Float64Array:
        """Axis-parallel box, shape (2, 3): lowest and highest corner in LPS mm."""
        return np.array((self.center - self.reach_mm, self.center + self.reach_mm))

    @abc.abstractmethod
    def _parameters(self) -> dict[str, Any]: ...

    def describe(self) -> dict[str, Any]:
        """Kind, parameters, area and volume as plain JSON types."""
        return {
            "kind": self.kind,
            "center_lps_mm": self.center.tolist(),
            **self._parameters(),
            "area_mm2": self.area_mm2,
            "volume_ml": self.volume_ml,
        }


class Sphere(Body):
    """Ball around a centre in LPS mm."""

    kind = "sphere"

    def __init__(self, center: ArrayLike, radius: float):
        self.center = _vector("center", center)
        self.radius = self.reach_mm = _positive("radius", radius)
        self.area_mm2 = 4.0 * math.pi * self.radius**2
        self.volume_ml = 4.0 / 3.0 * math.pi * self.radius**3 / 1000.0

    def _distance(self, offsets: Float64Array) -> Float64Array:
        return self.radius - np.sqrt(np.einsum("ij,ij->i", offsets, offsets))

    def _parameters(self) -> dict[str, Any]:
        return {"radius_mm": self.radius}


class Torus(Body):
    """Ring torus around an axis of any length; radius of the centre line, `major`, and of the tube, `minor`, in mm."""

    kind = "torus"

    def __init__(self, center: ArrayLike, axis: ArrayLike, major: float, minor: float):
        self.center = _vector("center", center)
        self.axis = _unit("axis", axis)
        self.major = _positive("major", major)
        self.minor = _positive("minor", minor)
        if self.minor >= self.major:
            raise UsageError(f"a torus needs minor < major, got minor {self.minor:g} and major {self.major:g} mm")
        # Pappus
        self.area_mm2 = 4.0 * math.pi**2 * self.major * self.minor
        self.volume_ml = 2.0 * math.pi**2 * self.major * self.minor**2 / 1000.0
        self.reach_mm = self.major * np.sqrt(np.maximum(1.0 - self.axis**2, 0.0)) + self.minor

    def _distance(self, offsets: Float64Array) -> Float64Array:
        along, radial = _split(offsets, self.axis)
        return self.minor - np.hypot(radial - self.major, along)

    def _parameters(self) -> dict[str, Any]:
        return {"axis_lps": self.axis.tolist(), "major_radius_mm": self.major, "minor_radius_mm": self.minor}


class Cylinder(Body):
    """Circular cylinder with flat caps; its centre is the middle of its axis, which may have any length."""

    kind = "cylinder"

    def __init__(self, center: ArrayLike, axis: ArrayLike, radius: float, length: float):
        self.center = _vector("center", center)
        self.axis = _unit("axis", axis)
        self.radius = _positive("radius", radius)
        self.length = _positive("length", length)
        self.area_mm2 = 2.0 * math.pi * self.radius * (self.length + self.radius)  # caps included
        self.volume_ml = math.pi * self.radius**2 * self.length / 1000.0
        across = np.sqrt(np.maximum(1.0 - self.axis**2, 0.0))
        self.reach_mm = np.abs(self.axis) * self.length / 2.0 + self.radius * across

    def _distance(self, offsets: Float64Array) -> Float64Array:
        along, radial = _split(offsets, self.axis)
        return _box_distance(np.stack((radial - self.radius, np.abs(along) - self.length / 2.0), axis=1))

    def _parameters(self) -> dict[str, Any]:
        return {"axis_lps": self.axis.tolist(), "radius_mm": self.radius, "length_mm": self.length}


class Box(Body):
    """Oblique box: a slab, `thickness` mm thick, with two large faces square to `normal`, of any length.

    The width is along `edge`, less its part along `normal`; default: some direction square to `normal`.
    """

    kind = "plane"

    def __init__(
        self, center: ArrayLike, normal: ArrayLike, thickness: float, width: float, height: float,
        edge: ArrayLike | None = None,
    ):  # fmt: skip
        self.center = _vector("center", center)
        self.normal = _unit("normal", normal)
        if edge is None:
            edge = np.eye(3)[int(np.argmin(np.abs(self.normal)))]
        across = _unit("edge", edge)
        across = across - (across @ self.normal) * self.normal
        if np.linalg.norm(across) < 1e-6:
            raise UsageError("edge must not be parallel to normal")
        self.edge = _unit("edge", across)
        self.size = np.array(
            (_positive("width", width), _positive("height", height), _positive("thickness", thickness))
        )
        # rows: width, height and thickness directions
        self._axes = np.array((self.edge, np.cross(self.normal, self.edge), self.normal))
        wide, high, thick = self.size.tolist()
        self.area_mm2 = 2.0 * (wide * high + high * thick + thick * wide)
        self.volume_ml = float(np.prod(self.size)) / 1000.0
        self.reach_mm = (self.size / 2.0) @ np.abs(self._axes)

    def _distance(self, offsets: Float64Array) -> Float64Array:
        return _box_distance(np.abs(offsets @ self._axes.T) - self.size / 2.0)

    def _parameters(self) -> dict[str, Any]:
        width, height, thickness = self.size.tolist()
        return {
            "normal_lps": self.normal.tolist(),
            "edge_lps": self.edge.tolist(),
            "thickness_mm": thickness,
            "width_mm": width,
            "height_mm": height,
        }


_AXIS_LPS = (0.36, -0.48, 0.8)
"""Axis of torus, cylinder and slab: unit length, parallel to no axis of the patient or of usual slices."""

_RADIUS_SHARES = {"sphere": 0.7, "torus": 0.6, "cylinder": 0.4, "plane": 0.2}
"""Radius, without one in the settings, as a share of the room about the centre; half of the plane's thickness."""

_MARGIN_STEPS = 1.5
"""Steps of background kept between the body and the faces of the volume."""


def choose_body(affine: NDArray[np.float64], settings: PhantomSettings) -> Body:
    """Make the body of `settings` wholly inside a volume with this affine, a voxel of background on every side."""
    offset = np.random.default_rng((settings.seed, 7)).uniform(-0.5, 0.5, 3)
    middle = (np.array(settings.shape_kji[::-1], dtype=np.float64) - 1.0) / 2.0
    centre = apply_affine(affine, (middle + offset)[None])[0]
    # distances between opposite faces of the volume, halved: rows of the inverse are the faces' normals per step
    per_step = 1.0 / np.linalg.norm(np.linalg.inv(affine)[:3, :3], axis=1)
    reach = float(((np.array(settings.shape_kji[::-1]) / 2.0 - _MARGIN_STEPS) * per_step).min())
    if reach <= 0.0:
        raise UsageError(
            f"a {settings.kind} needs at least 4 voxels along every axis, this volume has {settings.shape_kji[::-1]}"
        )
    if settings.kind not in _RADIUS_SHARES:
        raise UsageError(f"a {settings.kind} phantom has no analytic body")
    radius = _RADIUS_SHARES[settings.kind] * reach if settings.radius_mm is None else settings.radius_mm
    body: Body
    if settings.kind == "sphere":
        body = Sphere(centre, radius)
        extent, thinnest = radius, 2.0 * radius
    elif settings.kind == "torus":
        body = Torus(centre, _AXIS_LPS, radius, 0.4 * radius)
        extent, thinnest = 1.4 * radius, 0.8 * radius
    elif settings.kind == "cylinder":
        body = Cylinder(centre, _AXIS_LPS, radius, 3.0 * radius)
        extent, thinnest = float(np.hypot(1.0, 1.5)) * radius, 2.0 * radius
    else:
        body = Box(centre, _AXIS_LPS, 2.0 * radius, 0.9 * reach, 0.7 * reach)
        extent, thinnest = float(np.linalg.norm(body.size)) / 2.0, 2.0 * radius
    largest_step = float(np.linalg.norm(affine[:3, :3], axis=0).max())
    if thinnest < 2.0 * largest_step:
        raise UsageError(
            f"a {settings.kind} with radius {radius:.4g} mm is {thinnest:.4g} mm thick: too thin for voxels of "
            f"{largest_step:.4g} mm (two voxels are needed); use more or finer voxels, or a larger radius"
        )
    if extent > reach:
        raise UsageError(
            f"a {settings.kind} with radius {radius:.4g} mm reaches {extent:.4g} mm from the centre: the volume "
            f"leaves {reach:.4g} mm; use a smaller radius or a larger volume"
        )
    return body
