"""What a view's cameras fit, and how far apart the voxels lie across its slices."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from clrecon.geometry.affine import Float64Array
from clrecon.operators.rays.mesh_pictures import box_around
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.directions import DIRECTIONS
from clrecon.rendering.views.reformation import PLANES
from clrecon.viewer.model.objects import ShownScan

FIT_PIXELS = 1000
"""Height of the picture that a camera is fitted for; only its ratio to the width counts."""


def fit_camera(
    points: Float64Array, view: str | Sequence[float], aspect: float, view_angle: float | None = None
) -> Camera:
    """Return a camera that looks from a side of the patient, so that the box around points fits.

    points: ndarray, shape (n, 3). LPS mm.
    aspect: Width of the picture by its height.
    """
    size = (max(1, round(aspect * FIT_PIXELS)), FIT_PIXELS)
    return Camera.fit(box_around([points]), view, view_angle=view_angle, size=size)


def plane_step(scans: Sequence[ShownScan], plane: str) -> Float64Array:
    """Return the step from one slice of a plane to the next, away from the eye: (3,) in mm.

    It is the distance of the first scan's voxels along its axis that is nearest to the normal of the plane; 1 mm
    without a scan.
    """
    normal = -np.array(DIRECTIONS[PLANES[plane]])
    if not scans:
        return normal
    columns = scans[0].volume.affine[:3, :3]
    along = np.abs(normal @ columns)
    return normal * float(along[int(np.argmax(along / np.linalg.norm(columns, axis=0)))])
