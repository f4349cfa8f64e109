"""Pictures of clouds: what is chosen for them before anything is drawn."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from clrecon.operators.rays.point_pictures import LARGEST_DISC, PointPictures
from clrecon.points.cloud import PointCloud
from clrecon.points.spacing import mean_spacing
from clrecon.rendering.pictures.object_looks import PointLook
from clrecon.rendering.views.camera import Camera

ABOVE = Camera((3.5, 3.5, 50.0), (3.5, 3.5, 0.0), (0.0, 1.0, 0.0), parallel_scale=5.0)
PLANE = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0), 0.0), axis=-1).reshape(-1, 3)
"""A point in each mm of a square."""


@pytest.mark.parametrize(
    ("points", "given", "radius"),
    [(PLANE, None, mean_spacing(PLANE)), (PLANE[:1], None, 1.0), (PLANE, 0.25, 0.25), (PLANE[:1], 0.25, 0.25)],
    ids=["of a square", "of one point", "given for a square", "given for one point"],
)
def test_discs_are_as_large_as_points_lie_apart(
    device: Any, points: np.ndarray, given: float | None, radius: float
) -> None:
    """And as large as is asked for; again in a second picture."""
    with PointPictures(PointCloud(points), device=device) as pictures:
        found = [pictures.take(PointLook(radius_mm=given), ABOVE, (9, 9)).report["radius_mm"] for _ in range(2)]
    assert found == [radius, radius]


@pytest.mark.parametrize(("share", "warned"), [(0.5, False), (1.0, False), (1.25, True)])
def test_discs_of_more_pixels_than_are_drawn_are_warned_of(device: Any, share: float, warned: bool) -> None:
    """A picture of 8 x 8 pixels is 16 mm high: 2 mm a pixel."""
    camera = dataclasses.replace(ABOVE, parallel_scale=8.0)
    look = PointLook(radius_mm=2.0 * share * LARGEST_DISC)
    with PointPictures(PointCloud(PLANE), device=device) as pictures:
        warnings = pictures.take(look, camera, (8, 8)).report["warnings"]
    words = f"discs of {2.5 * LARGEST_DISC:.3g} mm are {1.25 * LARGEST_DISC:.0f} pixels in radius: they are drawn with"
    expected = f"{words} {LARGEST_DISC:g}, which is {2.0 * LARGEST_DISC:.3g} mm"
    assert [text for text in warnings if "discs" in text] == [expected] * warned
