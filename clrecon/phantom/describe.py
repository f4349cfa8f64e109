"""What the truth of a spine phantom says: levels, angles, and the slices of a series that is not even."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.phantom.extent import bone_points
from clrecon.phantom.levels import level_number
from clrecon.phantom.parts import Anatomy
from clrecon.phantom.placement import Placement
from clrecon.phantom.settings import CENTRE_LPS_MM, PhantomSettings

Float64Array = NDArray[np.float64]


def describe_spine(anatomy: Anatomy, affine: Float64Array, settings: PhantomSettings) -> dict[str, Any]:
    """Describe where the parts are, LPS mm, and which of them lie in the volume."""
    inverse = np.linalg.inv(affine)
    extents = np.array(settings.shape_kji[::-1])

    def inside(points: Float64Array) -> bool:
        ijk = points @ inverse[:3, :3].T + inverse[:3, 3]
        return bool(np.all((ijk > -0.5) & (ijk < extents - 0.5)))

    centre = np.array(CENTRE_LPS_MM)
    described: dict[str, Any] = {
        "vertebrae": [
            {
                "name": vertebra.name,
                "center_lps_mm": [float(value) for value in vertebra.center + centre],
                "inside": inside(vertebra.center + centre),
            }
            for vertebra in anatomy.vertebrae
        ],
        "left_marker_lps_mm": [float(value) for value in anatomy.marker + centre],
        "left_marker_radius_mm": anatomy.marker_radius,
        "left_marker_inside": inside(anatomy.marker + centre),
        "absent": anatomy.absent,
    }
    choice = settings.spine_choice
    if choice is not None:
        for vertebra, said in zip(anatomy.vertebrae, described["vertebrae"], strict=True):
            said["label"] = level_number(vertebra.name)
            said["whole"] = inside(bone_points(vertebra) + centre)
        first, last = anatomy.vertebrae[0].axes[2], anatomy.vertebrae[-1].axes[2]
        # the angles between the first and the last level, as they are measured on a lateral and an anterior picture
        described["sagittal_angle_deg"] = _angle(last[1], last[2]) - _angle(first[1], first[2])
        described["coronal_angle_deg"] = _angle(last[0], last[2]) - _angle(first[0], first[2])
        described["facet_gap_mm"] = choice.facet_gap_mm
    return described


def _angle(across: float, up: float) -> float:
    return math.degrees(math.atan2(across, up))


def describe_series(settings: PhantomSettings, placement: Placement) -> dict[str, Any] | None:
    """Describe slices that are uneven, missing or of several phases; None for an even stack.

    Returns: ``uneven_mm``, ``missing`` (numbers from 1), ``phases``, and ``slice_positions_lps_mm`` of the first pixel
        of each slice that is written.
    """
    if not (settings.uneven_mm or settings.missing or settings.phases > 1):
        return None
    written = [k for k in range(settings.slices) if k + 1 not in settings.missing]
    return {
        "uneven_mm": settings.uneven_mm,
        "missing": list(settings.missing),
        "phases": settings.phases,
        "slice_positions_lps_mm": [[float(text) for text in placement.positions[k]] for k in written],
    }
