"""Directions of a grid in the patient, for certificates."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from clrecon.geometry.affine import Float64Array, is_left_handed, slice_normal


def describe_orientation(affine: Float64Array) -> dict[str, Any]:
    """Describe the directions of index space in the patient.

    Returns: ``row``, ``column``, ``normal``: unit vectors in LPS along i, along j, and row x column.  ``axes``: for i,
        j and the normal, the letter of the patient direction nearest to it (L left, R right, P posterior, A anterior, S
        superior, I inferior).  ``off_axis_deg``: angle between the normal and the nearest patient axis.
        ``right_handed``: the determinant of the affine is above zero.
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
