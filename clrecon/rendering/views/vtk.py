"""Cameras of VTK, and PyVista's among them, as the parameters of a `Camera` and back; special ones are refused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.rendering.views.directions import checked_size

Point = Sequence[float]

_NEAR_AND_FAR = (0.01, 100.0)
"""Clipping range of a PyVista camera in distances to its focal point; VTK's default ends in the middle of a patient."""


def parameters_from_vtk(source: Any, size: Sequence[int] | None = None) -> dict[str, Any]:
    """Return the parameters of the `Camera` with the same view as a VTK or PyVista camera, or the camera of a plotter.

    size: Needed where the view angle is the horizontal one; default: that of the plotter's window.
    """
    camera = getattr(source, "camera", source)
    if not hasattr(camera, "GetFocalPoint"):
        raise UsageError(f"{type(source).__name__} is no PyVista plotter, PyVista camera or VTK camera")
    transform = camera.GetUserViewTransform() or camera.GetUserTransform()
    shear, centre = camera.GetViewShear(), camera.GetWindowCenter()
    if transform is not None or tuple(shear) != (0.0, 0.0, 1.0) or tuple(centre) != (0.0, 0.0):
        raise UsageError("this VTK camera has a transform, a shear or a window centre of its own: reset them first")
    if camera.GetUseOffAxisProjection():
        raise UsageError("this VTK camera projects off its axis (for walls of screens): turn that off first")
    placed = {"position": camera.GetPosition(), "focal_point": camera.GetFocalPoint(), "up": camera.GetViewUp()}
    if camera.GetParallelProjection():
        return {**placed, "parallel_scale": camera.GetParallelScale()}
    angle = camera.GetViewAngle()
    if camera.GetUseHorizontalViewAngle():
        window = getattr(source, "window_size", None) if size is None else size
        if window is None:
            raise UsageError("the view angle of this camera is the horizontal one: say the size of the picture too")
        width, height = checked_size(window)
        angle = float(np.degrees(2.0 * np.arctan(np.tan(np.radians(0.5 * angle)) * height / width)))
    return {**placed, "view_angle": angle}


def make_pyvista_camera(
    position: Point, focal_point: Point, up: Point, view_angle: float | None, parallel_scale: float | None
) -> Any:
    import pyvista

    view_camera = pyvista.Camera()
    view_camera.SetUseHorizontalViewAngle(False)
    view_camera.SetPosition(*position)
    view_camera.SetFocalPoint(*focal_point)
    view_camera.SetViewUp(*up)
    view_camera.parallel_projection = parallel_scale is not None  # PyVista has its own flag in addition to VTK's
    if parallel_scale is not None:
        view_camera.SetParallelScale(parallel_scale)
    else:
        view_camera.SetViewAngle(view_angle)
    distance = float(np.linalg.norm(np.subtract(focal_point, position)))
    near, far = _NEAR_AND_FAR
    view_camera.SetClippingRange(near * distance, far * distance)
    return view_camera
