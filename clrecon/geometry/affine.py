"""The affine from voxel indices (i, j, k) to patient millimetres, what follows from it, and patient frames.

It is a 4x4 float64 array that maps (i, j, k, 1) to (x, y, z, 1) in LPS mm (x to the patient's left, y to the posterior,
z to the superior); docs/geometry.md derives it from DICOM.  The slice step is a full vector: with a tilted gantry the
affine is an exact shear.  RAS (NIfTI) exists only at the border, under its own name.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError

Float64Array = NDArray[np.float64]
"""The type of the arrays that the functions here take and return."""

TILT_REPORT_DEG = 0.05
"""Degrees of gantry tilt from which on it is reported."""

_LONG_AXIS = 0.5
"""Share of the slice step that runs from the feet to the head, from which on a tilt has a sign."""


def compose_affine(i_step: ArrayLike, j_step: ArrayLike, k_step: ArrayLike, origin: ArrayLike) -> Float64Array:
    """Build the affine (4, 4) from its steps (i: row cosines times PixelSpacing[1]) and voxel (0, 0, 0), LPS mm."""
    affine = np.eye(4)
    for column, vector in enumerate((i_step, j_step, k_step, origin)):
        affine[:3, column] = vector
    return affine


def checked_affine(affine: ArrayLike) -> Float64Array:
    """Return `affine` as a float64 copy after checking that it is one."""
    try:
        if np.iscomplexobj(affine):
            raise TypeError("complex numbers")
        checked = np.array(affine, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"an affine is a 4x4 array of numbers: {error}") from error
    if checked.shape != (4, 4):
        raise UsageError(f"an affine is a 4x4 array, this one has shape {checked.shape}")
    if not np.isfinite(checked).all():
        raise UsageError("the affine holds NaN or infinite entries")
    if not np.array_equal(checked[3], (0.0, 0.0, 0.0, 1.0)):
        raise UsageError(f"the last row of an affine is (0, 0, 0, 1), this one has {checked[3].tolist()}")
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.linalg.norm(checked[:3, :3], axis=0)
        spans = lengths.min() > 0.0 and abs(np.linalg.det(checked[:3, :3] / lengths)) >= 1e-6
    if not spans:
        raise UsageError("the affine is singular: its three steps do not span space")
    return checked


def apply_affine(affine: Float64Array, points: ArrayLike) -> Float64Array:
    placed: Float64Array = checked_points(points) @ affine[:3, :3].T
    for column, shift in zip(placed.T, affine[:3, 3], strict=True):
        column += shift  # a sum of (n, 3) and (3,) takes 7 times as long
    return placed


def checked_points(points: ArrayLike) -> Float64Array:
    """Return points (n, 3), or one point (3,) as an array of one, as float64."""
    try:
        checked = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"points are an array of numbers of shape (n, 3): {error}") from error
    if checked.shape == (3,):
        return checked[None]
    if checked.ndim != 2 or checked.shape[1] != 3:
        raise UsageError(f"points have shape (n, 3), these have {checked.shape}")
    return checked


def map_points(mapping: Callable[[Float64Array], Float64Array], points: ArrayLike) -> Float64Array:
    """Apply what takes points (n, 3) to points, or to one point (3,), whose result then stands alone."""
    placed = mapping(checked_points(points))
    return placed[0] if np.ndim(points) == 1 else placed  # type: ignore[arg-type, no-any-return]


def column_spacing(affine: Float64Array) -> tuple[float, float, float]:
    """Lengths (di, dj, dk) in mm of the three steps; dk is the length of the full slice step."""
    di, dj, dk = np.linalg.norm(affine[:3, :3], axis=0)
    return float(di), float(dj), float(dk)


def slice_normal(affine: Float64Array) -> Float64Array:
    """Unit normal of the slices, row direction x column direction."""
    normal = np.cross(affine[:3, 0], affine[:3, 1])
    return np.asarray(normal / np.linalg.norm(normal), dtype=np.float64)


def tilt_degrees(affine: Float64Array) -> float:
    """Angle in degrees between the slice step and the line of the slice normal, 0 for a perpendicular stack."""
    step, normal = affine[:3, 2], slice_normal(affine)
    along = float(step @ normal)
    across = float(np.linalg.norm(step - along * normal))
    return float(np.degrees(np.arctan2(across, abs(along))))


def signed_tilt(affine: Float64Array) -> float:
    """Signed `tilt_degrees`: positive where a slice's front edge lies nearer the head, and off the long axis."""
    step, normal = affine[:3, 2] / np.linalg.norm(affine[:3, 2]), slice_normal(affine)
    forward = np.array((0.0, -1.0, 0.0)) + normal[1] * normal  # anterior, within the slice
    leans_back = float(forward @ step) * float(np.sign(step[2])) < 0.0
    return -tilt_degrees(affine) if leans_back and abs(step[2]) >= _LONG_AXIS else tilt_degrees(affine)


def is_left_handed(affine: Float64Array) -> bool:
    """True when the three steps form a left-handed system: index space is then mirrored against the patient."""
    return bool(np.linalg.det(affine[:3, :3]) < 0.0)


def normal_matrix(affine: Float64Array) -> Float64Array:
    """Inverse transpose of the 3x3 part: maps gradients per index step to gradients per mm."""
    return np.asarray(np.linalg.inv(affine[:3, :3]).T, dtype=np.float64)


def facts_of_orientation(affine: Float64Array) -> dict[str, Any]:
    """Describe index space in the patient: ``row``, ``column``, ``normal``, unit vectors in LPS along i, j, and row x
    column.

    ``axes``: for i, j and the normal, the letter of the nearest direction (L left, R right, P posterior, A anterior, S
    superior, I inferior).  ``off_axis_deg``: angle between the normal and the nearest patient axis.
    """
    row, column = (affine[:3, axis] / np.linalg.norm(affine[:3, axis]) for axis in (0, 1))
    normal = slice_normal(affine)
    directions = np.stack((row, column, normal))
    weights = np.abs(directions)
    axes = max(itertools.permutations(range(3)), key=lambda order: weights[range(3), order].sum())
    letters = ["LPS"[axis] if directions[place, axis] > 0 else "RAI"[axis] for place, axis in enumerate(axes)]
    return {
        "row": row.tolist(),
        "column": column.tolist(),
        "normal": normal.tolist(),
        "axes": "".join(letters),
        "off_axis_deg": float(np.degrees(np.arctan2(np.linalg.norm(np.delete(normal, axes[2])), weights[2, axes[2]]))),
        "right_handed": not is_left_handed(affine),
    }


SPACES = ("lps", "ras")


def frame_from_lps(space: str) -> NDArray[np.float64]:
    """Return the 3x3 rotation from LPS mm to `space`, "lps" or "ras" in upper or lower case."""
    name = str(space).lower()
    if name == "lps":
        return np.eye(3)
    if name == "ras":
        return np.diag((-1.0, -1.0, 1.0))
    raise UsageError(f"unknown space {space!r}: use one of {', '.join(SPACES)}")


def lps_affine_from_ras(affine: ArrayLike) -> NDArray[np.float64]:
    """Turn an affine (4, 4) to RAS mm (NIfTI, FreeSurfer) into one to LPS mm; its own inverse."""
    return np.asarray(np.diag((-1.0, -1.0, 1.0, 1.0)) @ np.asarray(affine, dtype=np.float64), dtype=np.float64)


def choose_space(asked: str | None, named: object, title: str) -> str:
    """Return ``LPS`` or ``RAS``, the frame of what another library holds: as `asked`, as `named` there, or LPS."""
    if asked is not None:
        frame_from_lps(asked)
    if named is None:
        return "LPS" if asked is None else asked.upper()
    frame = str(named).upper()
    if frame.lower() not in SPACES:
        raise UsageError(f"{title} names the frame {str(named)[:40]!r}: {' or '.join(SPACES)} are known")
    if asked is not None and asked.upper() != frame:
        raise UsageError(
            f"{title} says that its coordinates are {frame}, {asked.upper()} was asked for: leave space out"
        )
    return frame
