"""Planes of the three slices: which way each looks, turned with the cross, and its layers of voxels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.views.camera import Camera, rotation_about
from clrecon.rendering.views.directions import DIRECTIONS, as_point, checked_vector
from clrecon.rendering.views.reformation import PLANES
from clrecon.system.text import unknown_name
from clrecon.viewer.model.objects import ShownScan
from clrecon.viewer.model.state import Turn

_LEAST_TURN = 0.05
"""Degrees by which a slice is said to be turned."""

_LEAST_ROTATION = 1e-9
"""Changes of a unit direction up to this size are rounding: the slice is not turned."""

_LEAST_UPRIGHT = 0.3
"""Part of the upward direction that lies in a turned slice, below which it turns with the slice."""


def check_plane(name: str) -> str:
    if name not in PLANES:
        raise UsageError(unknown_name("plane", name, PLANES))
    return name


def find_forward(plane: str, turn: Turn | None = None) -> Float64Array:
    """Return the direction (3,) away from the eye of a slice."""
    forward = -np.array(DIRECTIONS[PLANES[plane]])
    return forward if turn is None else np.array(turn) @ forward


def turn_plane(camera: Camera, turn: Turn) -> Camera:
    """Return the camera of a slice, turned about its focal point, and as upright as before."""
    _, up, forward = camera.basis()
    rotation = np.array(turn)
    turned = rotation @ forward
    upright = up - (up @ turned) * turned
    if np.linalg.norm(upright) < _LEAST_UPRIGHT:
        upright = rotation @ up
    position = np.array(camera.focal_point) - camera.distance * turned
    return replace(camera, position=as_point(position), up=as_point(upright))


def turn_cross(turn: Turn | None, plane: str, degrees: float) -> Turn | None:
    """Turn the other two planes about the direction of a slice: on it the cross goes clockwise; None: all straight."""
    rotation = rotation_about(find_forward(plane, turn), degrees) @ (np.eye(3) if turn is None else np.array(turn))
    left, _, right = np.linalg.svd(rotation)
    rows = left @ right  # the nearest rotation
    if np.abs(rows - np.eye(3)).max() < _LEAST_ROTATION:
        return None
    return (as_point(rows[0]), as_point(rows[1]), as_point(rows[2]))


def checked_turn(rows: Any) -> Turn | None:
    """Return the turn of the slices as a file says it: three rows of a rotation, or None."""
    if rows is None:
        return None
    matrix = np.array([checked_vector("a row of the turn of the slices", row) for row in rows])
    if matrix.shape != (3, 3) or np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-6 or np.linalg.det(matrix) < 0.0:
        raise UsageError("the turn of the slices is a rotation: three rows of length 1 across each other")
    return (as_point(matrix[0]), as_point(matrix[1]), as_point(matrix[2]))


def near_layers(volume: Volume, point: Sequence[float] | Float64Array) -> Float64Array:
    """Return the index (i, j, k) of the layers of voxels at a place; beside the volume they go on."""
    return np.floor(np.round(volume.lps_to_ijk(point), 6) + 0.5)


def layers_across(volume: Volume, normal: Float64Array) -> tuple[int, Float64Array]:
    """Return the axis whose layers of voxels lie most across a normal, and by what its index grows along x, y and z."""
    growths = np.linalg.inv(volume.affine[:3, :3])
    axis = int(np.argmax(np.abs(growths @ normal) / np.linalg.norm(growths, axis=1)))
    return axis, growths[axis]


def move_to_layer(
    scans: Sequence[ShownScan], plane: str, cross: Sequence[float], steps: float, turn: Turn | None = None
) -> Float64Array:
    """Return a cross (3,) moved away from the eye by layers of the first scan, to the middle of one; else by mm."""
    normal, point = find_forward(plane, turn), np.array(cross)
    if not scans:
        return point + steps * normal
    heights = np.concatenate([_outer_layers(scan, normal) @ normal for scan in scans])
    volume, index = scans[0].volume, scans[0].volume.lps_to_ijk(point)
    axis, growth = layers_across(volume, normal)
    index[axis] = near_layers(volume, point)[axis] + np.sign(growth @ normal) * np.clip(steps, -1e6, 1e6)
    distance = growth @ (volume.ijk_to_lps(index) - point) / (growth @ normal)
    return point + np.clip(distance, heights.min() - point @ normal, heights.max() - point @ normal) * normal


def _outer_layers(scan: ShownScan, normal: Float64Array) -> Float64Array:
    """Return corners (n, 3) of a scan from the middle of its first layer across a normal to that of the last."""
    ends, (axis, _) = scan.volume.lps_to_ijk(scan.corners), layers_across(scan.volume, normal)
    ends[:, axis] = np.clip(ends[:, axis], 0, scan.volume.shape_ijk[axis] - 1)
    return scan.volume.ijk_to_lps(ends)


def describe_slice(
    scans: Sequence[ShownScan], plane: str, cross: Sequence[float], turn: Turn | None = None
) -> dict[str, Any]:
    """Return the side and mm of a slice through a cross, and which of the first scan's layers it cuts there, from 1.

    Layers are counted away from the eye, as `move_to_layer` goes.  A slice that is turned has an angle instead.
    """
    forward, straight = find_forward(plane, turn), find_forward(plane)
    degrees = float(np.degrees(np.arccos(min(1.0, float(forward @ straight)))))
    if degrees > _LEAST_TURN:
        return {"place": f"turned {degrees:.1f}°"}
    axis = int(np.argmax(np.abs(straight)))
    side = ("RL", "AP", "IS")[axis][cross[axis] > 0.0]
    described: dict[str, Any] = {"place": f"{side} {abs(cross[axis]):.1f} mm"}
    if scans:
        volume = scans[0].volume
        ordinal, growth = layers_across(volume, straight)
        count = volume.shape_ijk[ordinal]
        layer = min(max(int(near_layers(volume, cross)[ordinal]), 0), count - 1)
        described |= {"number": layer + 1 if growth @ straight > 0.0 else count - layer, "count": count}
    return described
