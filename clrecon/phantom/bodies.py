"""The analytic body of a phantom, sized for its field of view, with its centre a part of a voxel off the middle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import apply_affine
from clrecon.phantom.settings import PhantomSettings
from clrecon.phantom.shapes import Body, Box, Cylinder, Sphere, Torus

AXIS_LPS = (0.36, -0.48, 0.8)
"""Axis of torus, cylinder and slab: unit length, parallel to no axis of the patient or of usual slices."""

_MARGIN_STEPS = 1.5
"""Steps of background kept between the body and the faces of the volume."""


def _sub_voxel_centre(affine: NDArray[np.float64], settings: PhantomSettings) -> NDArray[np.float64]:
    offset = np.random.default_rng((settings.seed, 7)).uniform(-0.5, 0.5, 3)
    middle = (np.array(settings.shape_kji[::-1], dtype=np.float64) - 1.0) / 2.0
    return apply_affine(affine, (middle + offset)[None])[0]


def choose_body(affine: NDArray[np.float64], settings: PhantomSettings) -> Body:
    """Make the analytic body of `settings` for a volume with this affine.

    affine: ndarray, shape (4, 4). Index (i, j, k) to LPS mm.
    settings: Of an analytic kind.

    Returns: Wholly inside the volume, with at least one voxel of background on every side.
    """
    centre = _sub_voxel_centre(affine, settings)
    # distances between opposite faces of the volume, halved: rows of the inverse are the faces' normals per step
    per_step = 1.0 / np.linalg.norm(np.linalg.inv(affine)[:3, :3], axis=1)
    reach = float(((np.array(settings.shape_kji[::-1]) / 2.0 - _MARGIN_STEPS) * per_step).min())
    if reach <= 0.0:
        raise UsageError(
            f"a {settings.kind} needs at least 4 voxels along every axis, this volume has {settings.shape_kji[::-1]}"
        )
    given = settings.radius_mm
    body: Body
    if settings.kind == "sphere":
        radius = given if given is not None else 0.7 * reach
        body, extent, thinnest = Sphere(centre, radius), radius, 2.0 * radius
    elif settings.kind == "torus":
        radius = given if given is not None else 0.6 * reach
        body, extent, thinnest = Torus(centre, AXIS_LPS, radius, 0.4 * radius), 1.4 * radius, 0.8 * radius
    elif settings.kind == "cylinder":
        radius = given if given is not None else 0.4 * reach
        body = Cylinder(centre, AXIS_LPS, radius, 3.0 * radius)
        extent, thinnest = float(np.hypot(1.0, 1.5)) * radius, 2.0 * radius
    elif settings.kind == "plane":
        radius = given if given is not None else 0.2 * reach
        body = Box(centre, AXIS_LPS, 2.0 * radius, 0.9 * reach, 0.7 * reach)
        extent, thinnest = float(np.linalg.norm(body.size)) / 2.0, 2.0 * radius
    else:
        raise UsageError(f"a {settings.kind} phantom has no analytic body")
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
