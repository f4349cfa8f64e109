"""Pictures of clouds: what is chosen for them before anything is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from clrecon.operators.rays.point_pictures import PointPictures
from clrecon.points import PointCloud
from clrecon.points.spacing import mean_spacing
from clrecon.rendering.pictures.styles import PointLook
from clrecon.rendering.views.camera import Camera

ABOVE = Camera((3.5, 3.5, 50.0), (3.5, 3.5, 0.0), (0.0, 1.0, 0.0), parallel_scale=5.0)
PLANE = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0), 0.0), axis=-1).reshape(-1, 3)
"""A point in each mm of a square."""


@pytest.mark.parametrize(
    ("points", "given", "radius"),
    [(PLANE, None, mean_spacing(PLANE)), (PLANE[:1], None, 1.0), (PLANE, 0.25, 0.25), (PLANE[:1], 0.25, 0.25)],
)
def test_discs_are_as_large_as_points_lie_apart(
    device: Any, points: np.ndarray, given: float | None, radius: float
) -> None:
    with PointPictures(PointCloud(points), device=device) as pictures:
        found = [pictures.take(PointLook(radius_mm=given), ABOVE, (9, 9)).report["radius_mm"] for _ in range(2)]
    assert found == [radius, radius] and 0.2 < radius < 1.5
