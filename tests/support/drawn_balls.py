"""A ball as a raycaster draws it, from analysis; and whether there is an OpenGL that draws off a screen."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from clrecon.rendering import Rendering
from clrecon.rendering.views.camera import Camera

CENTRE = np.array([12.0, -30.0, 850.0])
RADIUS = 20.0
EYE = (10.0, -400.0, 870.0)
CAMERAS = [
    Camera(position=EYE, focal_point=tuple(CENTRE), up=(0.2, 0, 1), parallel_scale=40.0),
    Camera(position=EYE, focal_point=tuple(CENTRE), up=(0.2, 0, 1), view_angle=12.0),
]


def need_off_screen() -> None:
    """Skip without OpenGL.  A driver that cannot draw off screen may end the process: it is tried in another one."""
    code = "import pyvista; p = pyvista.Plotter(off_screen=True); p.add_mesh(pyvista.Cube()); p.screenshot()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if done.returncode != 0:
        pytest.skip(f"no off-screen OpenGL here: {done.stderr.strip()[-200:]}")


def ball(
    camera: Camera,
    size: tuple[int, int],
    *,
    center: np.ndarray = CENTRE,
    radius: float = RADIUS,
    color: tuple[int, int, int] = (250, 40, 10),
) -> Rendering:
    """What a raycaster makes of an opaque ball: its colour, and depths from analysis."""
    origins, directions = camera.rays(size)
    to_center = np.asarray(center) - origins
    along = (to_center * directions).sum(axis=2)
    inside = radius**2 - (to_center**2).sum(axis=2) + along**2
    depth = np.where(inside > 0.0, along - np.sqrt(np.maximum(inside, 0.0)), np.nan).astype(np.float32)
    image = np.zeros((size[1], size[0], 4), np.uint8)
    image[np.isfinite(depth)] = (*color, 255)
    return Rendering(image, depth, depth, camera)
