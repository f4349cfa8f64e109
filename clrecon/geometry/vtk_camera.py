"""`Camera` from and to VTK's, which PyVista's is one of: the same words, with conditions that ours does not have."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.camera import Camera
from clrecon.geometry.views import checked_size

__all__ = ["camera_from_vtk", "camera_to_pyvista"]

NEAR_AND_FAR = (0.01, 100.0)
"""Clipping range of a PyVista camera in distances to its focal point, until the scene sets its own: VTK's default
ends at 1000 mm, which is in the midst of a patient."""


def camera_from_vtk(source: Any, size: Sequence[int] | None = None) -> Camera:
    """What a VTK or PyVista camera, or the camera of a plotter, sees.

    Parameters
    ----------
    source : vtkCamera, pyvista.Camera or pyvista.Plotter
        In LPS mm.
    size : (int, int), optional
        Width and height of the picture, needed where the view angle is the horizontal one; default: those of the
        plotter's window.

    Raises
    ------
    UsageError
        No camera, or one with a transform, shear, window centre or off-axis projection, which a `Camera` has not.
    """
    camera = getattr(source, "camera", source)
    if not hasattr(camera, "GetFocalPoint"):
        raise UsageError(f"{type(source).__name__} is no PyVista plotter, PyVista camera or VTK camera")
    _refuse_distortion(camera)
    placed = camera.GetPosition(), camera.GetFocalPoint(), camera.GetViewUp()
    if camera.GetParallelProjection():
        return Camera(*placed, parallel_scale=camera.GetParallelScale())
    angle = camera.GetViewAngle()
    if camera.GetUseHorizontalViewAngle():
        window = getattr(source, "window_size", None) if size is None else size
        if window is None:
            raise UsageError("the view angle of this camera is the horizontal one: say the size of the picture too")
        width, height = checked_size(window)
        angle = float(np.degrees(2.0 * np.arctan(np.tan(np.radians(0.5 * angle)) * height / width)))
    return Camera(*placed, view_angle=angle)


def camera_to_pyvista(camera: Camera) -> Any:
    """A `pyvista.Camera` that sees what `camera` does; its view angle is the vertical one."""
    import pyvista

    made = pyvista.Camera()
    made.SetUseHorizontalViewAngle(False)
    made.SetPosition(*camera.position)
    made.SetFocalPoint(*camera.focal_point)
    made.SetViewUp(*camera.up)
    made.parallel_projection = camera.is_parallel  # its own flag beside VTK's
    if camera.parallel_scale is not None:
        made.SetParallelScale(camera.parallel_scale)
    else:
        made.SetViewAngle(camera.view_angle)
    near, far = NEAR_AND_FAR
    made.SetClippingRange(near * camera.distance, far * camera.distance)
    return made


def _refuse_distortion(camera: Any) -> None:
    transform = camera.GetUserViewTransform() or camera.GetUserTransform()
    shear, centre = camera.GetViewShear(), camera.GetWindowCenter()
    if transform is not None or tuple(shear) != (0.0, 0.0, 1.0) or tuple(centre) != (0.0, 0.0):
        raise UsageError("this VTK camera has a transform, a shear or a window centre of its own: reset them first")
    if camera.GetUseOffAxisProjection():
        raise UsageError("this VTK camera projects off its axis (for walls of screens): turn that off first")
