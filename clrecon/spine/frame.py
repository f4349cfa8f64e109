"""The frame of one vertebra, found in its label: canal, body, endplates.

The canal runs where the hole of the label's projection is widest, the body is where the label is deepest, planes fitted
to its ends give the cranial direction, and the median plane is that by which the label is most like its mirror image.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from clrecon.errors import RefusedInputError
from clrecon.geometry.affine import Float64Array
from clrecon.spine.solid_bone import SolidBone
from clrecon.system.light_dataclass import dataclass

_STRIDE = 2
"""Points of the lattice in one step of the frame's points: 1 mm."""

PIXELS_MM = (2.0, 1.0)
"""Pixels of the projections, in the first round of the search and in those after it."""
_LEAST_MM3 = 3000.0
_WIDEST_LEAN_DEG, _WIDEST_ROLL_DEG = 50.0, 40.0
COARSE_DEG = 8.0

_LEAST_CANAL_RADIUS_MM = 3.0
"""A narrower hole is no canal: real ones are 11 mm wide or more, but a slanted arch narrows what is seen through it."""
_WIDEST_CANAL_RADIUS_MM = 20.0

_CORE_SHARE = 0.6
"""Points with this share of the largest depth and more are the core of the body."""

_PLATE_RADIUS_MM = 11.0
"""Radius of the disc about the body's axis in which the endplates are fitted."""

_MIRROR_STEPS = ((2.0, 0.75), (0.5, 0.25))
"""Steps of the search for the median plane: degrees, mm."""

_BODY_HEIGHT_MM = (8.0, 45.0)
_BODY_DEPTH_MM = (10.0, 55.0)


@dataclass(frozen=True)
class VertebraFrame:
    """Axes and sizes of one vertebra.

    origin: ndarray, shape (3,). LPS mm of the middle of the body, between its endplates.
    axes: ndarray, shape (3, 3). Rows: the vertebra's own left, posterior and cranial directions, unit vectors in LPS.
    canal: x and y of the canal's axis at the height of the origin, mm in the frame.
    canal_lean: By how much x and y of the canal's axis change for each mm of z.
    canal_radius: Radius of the largest circle in the hole, mm.
    body_y: Front and back wall of the body in the median plane at the height of the origin, mm in the frame.
    body_height: Distance of the endplates at the body's axis, mm.
    """

    origin: Float64Array
    axes: Float64Array
    canal: tuple[float, float]
    canal_lean: tuple[float, float]
    canal_radius: float
    body_y: tuple[float, float]
    body_height: float

    def to_frame(self, points: Float64Array) -> Float64Array:
        """Map LPS mm (n, 3) to mm in the frame."""
        return (points - self.origin) @ self.axes.T

    def to_lps(self, points: Float64Array) -> Float64Array:
        return self.origin + points @ self.axes

    def canal_at(self, z: Float64Array) -> Float64Array:
        """Return points (n, 3) of the canal's axis at heights (n,), mm in the frame."""
        return np.stack((self.canal[0] + self.canal_lean[0] * z, self.canal[1] + self.canal_lean[1] * z, z), axis=1)


def _basis(lean_deg: float, roll_deg: float) -> Float64Array:
    """Return rows right-hand, front-to-back and up of a direction that leans about x and rolls about y."""
    lean, roll = np.radians((lean_deg, roll_deg))
    up = np.array((np.tan(roll), np.tan(lean), 1.0))
    up /= np.linalg.norm(up)
    left = np.array((1.0, 0.0, 0.0)) - up[0] * up
    left /= np.linalg.norm(left)
    return np.array((left, np.cross(up, left), up))


def _hole(points: Float64Array, basis: Float64Array, pixel: float) -> tuple[float, Float64Array]:
    """Return the radius of the largest circle in the widest hole of a projection, and the hole's centre, mm."""
    from scipy.ndimage import binary_closing, binary_fill_holes, distance_transform_edt

    flat = points @ basis[:2].T
    low = flat.min(axis=0) - 2.0 * pixel
    pixels = ((flat - low) / pixel).astype(np.intp)
    size = pixels.max(axis=0) + 3
    seen = (np.bincount(pixels[:, 0] * size[1] + pixels[:, 1], minlength=size[0] * size[1]) > 0).reshape(size)
    seen = binary_closing(seen)
    holes = binary_fill_holes(seen) & ~seen
    if not holes.any():
        return 0.0, np.zeros(2)
    wide = distance_transform_edt(holes)
    radius = float(wide.max())
    # the centre of the circles that are nearly as wide: a single pixel would jump
    candidates = np.argwhere(wide >= 0.8 * radius)
    first = np.unravel_index(int(wide.argmax()), wide.shape)
    candidates = candidates[np.linalg.norm(candidates - np.array(first), axis=1) <= radius]
    return (radius - 0.5) * pixel, low + (candidates.mean(axis=0) + 0.5) * pixel


def _look_through(points: Float64Array) -> tuple[float, Float64Array, Float64Array]:
    """Return the radius of the canal, its direction (rows as `_basis`) and its centre in that basis."""
    step = COARSE_DEG
    leans = np.arange(-_WIDEST_LEAN_DEG, _WIDEST_LEAN_DEG + 0.1, step)
    rolls = np.arange(-_WIDEST_ROLL_DEG, _WIDEST_ROLL_DEG + 0.1, step)
    tried = [(float(lean), float(roll)) for lean, roll in product(leans, rolls)]
    middle = np.zeros(2)
    for number in range(4):
        pixel = PIXELS_MM[min(number, 1)]
        radii = np.array([_hole(points, _basis(*pair), pixel)[0] for pair in tried])
        if radii.max() <= 0.0:
            break
        # the middle of the directions that are nearly as good, about the best one
        pairs = np.array(tried)
        good = pairs[radii >= 0.93 * radii.max()]
        middle = good[np.abs(good - pairs[radii.argmax()]).max(axis=1) <= 2.0 * step].mean(axis=0)
        step /= 2.0
        tried = [(middle[0] + a, middle[1] + b) for a, b in product(np.arange(-2, 3) * step, repeat=2)]
    basis = _basis(*middle)
    radius, centre = _hole(points, basis, PIXELS_MM[1])
    return radius, basis, centre


def find_frame(bone: SolidBone, subject: str) -> VertebraFrame:
    from scipy.ndimage import distance_transform_edt

    thin = np.pad(bone.mask[::_STRIDE, ::_STRIDE, ::_STRIDE], 1)
    index = np.argwhere(thin)
    depth = distance_transform_edt(thin)[tuple(index.T)]
    points = bone.lattice.points((index - 1) * _STRIDE)
    step = _STRIDE * bone.lattice.step
    if len(points) * step**3 < _LEAST_MM3:
        raise RefusedInputError(
            f"{subject} has a volume of {len(points) * step**3 / 1000:.2g} ml: no vertebra, those have 5 ml or more"
        )
    radius, basis, centre = _look_through(points)
    if not _LEAST_CANAL_RADIUS_MM <= radius <= _WIDEST_CANAL_RADIUS_MM:
        seen = f"its widest hole has a radius of {radius:.1f} mm" if radius > 0.0 else "it has no hole"
        raise RefusedInputError(
            f"{subject} is not the label of a whole vertebra: no vertebral canal is seen through it ({seen})"
        )
    canal_point = centre @ basis[:2]
    core = points[depth >= _CORE_SHARE * depth.max()]
    middle = core.mean(axis=0)
    up = basis[2]
    axes = _point_front(middle, canal_point, up)
    for _ in range(4):
        up, shift, height = _fit_plates((points - middle) @ axes.T, axes, subject)
        middle = middle + shift * axes[2]
        axes = _point_front(middle, canal_point + ((middle - canal_point) @ basis[2]) * basis[2], up)
    middle, axes = _halve(bone, points, middle, axes)
    return _measure_body(points, middle, axes, (canal_point, basis[2], radius), height, subject)


def _point_front(middle: Float64Array, canal: Float64Array, up: Float64Array) -> Float64Array:
    back = canal - middle
    back -= (back @ up) * up
    back /= np.linalg.norm(back)
    return np.array((np.cross(back, up), back, up))


def _halve(
    bone: SolidBone, points: Float64Array, middle: Float64Array, axes: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Turn the axes about the cranial one, and shift their origin, so that the label is most like its mirror image."""
    local = ((points - middle) @ axes.T)[::3]
    turn, shift = 0.0, 0.0
    for step_deg, step_mm in _MIRROR_STEPS:
        best = (-1, turn, shift)
        for turned in turn + step_deg * np.arange(-4, 5):
            angle = np.radians(turned)
            across = np.array((np.cos(angle), np.sin(angle), 0.0))
            height = local @ across
            for shifted in shift + step_mm * np.arange(-3, 4):
                mirrored = local - 2.0 * (height - shifted)[:, None] * across
                labelled = int(np.count_nonzero(bone.is_labelled(middle + mirrored @ axes)))
                best = max(best, (labelled, float(turned), float(shifted)))
        _, turn, shift = best
    angle = np.radians(turn)
    rotation = np.array(((np.cos(angle), np.sin(angle), 0.0), (-np.sin(angle), np.cos(angle), 0.0), (0.0, 0.0, 1.0)))
    turned_axes = rotation @ axes
    return middle + shift * turned_axes[0], turned_axes


def _fit_plates(local: Float64Array, axes: Float64Array, subject: str) -> tuple[Float64Array, float, float]:
    """Fit planes to both ends of the body's columns; return their mean normal, LPS, middle height and distance, mm."""
    near = local[np.hypot(local[:, 0], local[:, 1]) <= _PLATE_RADIUS_MM]
    column = np.floor(near[:, :2] / 1.5).astype(np.intp) + 20
    key = column[:, 0] * 64 + column[:, 1]
    order = np.lexsort((near[:, 2], key))
    key, near = key[order], near[order]
    starts = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    ends = np.r_[starts[1:], len(key)] - 1
    if len(starts) < 20:
        raise RefusedInputError(f"{subject} is not the label of a whole vertebra: no body lies in front of its canal")
    planes = []
    for rows in (near[ends], near[starts]):
        design = np.column_stack((rows[:, :2], np.ones(len(rows))))
        weights = np.ones(len(rows))
        for _ in range(4):  # ends of columns beside the plate, on rims or in a vein, weigh less
            fit = np.linalg.lstsq(design * weights[:, None], rows[:, 2] * weights, rcond=None)[0]
            weights = 1.0 / np.sqrt(np.maximum(np.abs(rows[:, 2] - design @ fit), 2.0))
        planes.append(fit)
    slope = (planes[0][:2] + planes[1][:2]) / 2.0
    up = axes[2] - slope[0] * axes[0] - slope[1] * axes[1]
    height = float(planes[0][2] - planes[1][2])
    if not _BODY_HEIGHT_MM[0] <= height <= _BODY_HEIGHT_MM[1]:
        raise RefusedInputError(
            f"{subject} is not the label of a whole vertebra: what lies in front of its canal is {height:.0f} mm"
            f" high, a body {_BODY_HEIGHT_MM[0]:g} to {_BODY_HEIGHT_MM[1]:g} mm"
        )
    return up / np.linalg.norm(up), float((planes[0][2] + planes[1][2]) / 2.0), height


def _measure_body(
    points: Float64Array, middle: Float64Array, axes: Float64Array, canal: tuple[Float64Array, Float64Array, float],
    height: float, subject: str,
) -> VertebraFrame:  # fmt: skip
    """Measure the walls of the body and place the canal's axis in the frame."""
    canal_point, along, radius = canal
    start, lean = (canal_point - middle) @ axes.T, along @ axes.T
    slope = lean[:2] / lean[2]
    x, y = start[:2] - slope * start[2]
    local = (points - middle) @ axes.T
    band = local[(np.abs(local[:, 0]) <= 4.0) & (np.abs(local[:, 2]) <= 4.0) & (local[:, 1] < y)]
    walls = []
    for side in (-1.0, 1.0):
        columns = np.floor(band[:, [0, 2]] + 5.0).astype(np.intp)
        farthest: dict[Any, float] = {}
        for key, value in zip(map(tuple, columns), band[:, 1], strict=True):
            farthest[key] = max(farthest.get(key, -np.inf), side * value)
        walls.append(side * float(np.median(list(farthest.values()))) if farthest else 0.0)
    depth = walls[1] - walls[0]
    if not _BODY_DEPTH_MM[0] <= depth <= _BODY_DEPTH_MM[1] or y <= walls[1]:
        raise RefusedInputError(
            f"{subject} is not the label of a whole vertebra: what lies in front of its canal is {depth:.0f} mm deep, a"
            f" body {_BODY_DEPTH_MM[0]:g} to {_BODY_DEPTH_MM[1]:g} mm"
        )
    return VertebraFrame(
        middle, axes, (float(x), float(y)), (float(slope[0]), float(slope[1])), radius, (walls[0], walls[1]), height
    )
