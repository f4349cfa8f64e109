"""Meshes and pictures in one PyVista scene, on a screen or off it.

>>> plotter = pyvista.Plotter(off_screen=True, window_size=picture.size)
>>> plotter.add_mesh(mesh.to_pyvista(), color="white")
>>> merge_scene(plotter, picture).save("both.png")
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.picture import merge_layers
from clrecon.rendering.pictures.vtk import rendering_to_pyvista
from clrecon.rendering.views.camera import Camera


def add_rendering(
    plotter: Any, rendering: Rendering, form: str = "points", *, move_camera: bool = True, **options: Any
) -> Any:
    """Add a picture to the scene of a PyVista plotter, in its own colours.

    plotter: Plotter of a scene in LPS mm.
    form: {"points", "plane"}. See `Rendering.to_pyvista`.  Points are as large as the pixels of a picture that is as
        high as the window.
    move_camera: Give the plotter the camera of the picture.
    options: Options of `Rendering.to_pyvista`: ``expected``, ``distance``.
    """
    data = rendering_to_pyvista(rendering, form, **options)
    style = {}
    if form == "points":
        size = max(1.0, plotter.window_size[1] / rendering.size[1])
        style = {"style": "points", "point_size": size, "render_points_as_spheres": False}
    actor = plotter.add_mesh(data, scalars="RGBA", rgba=True, lighting=False, reset_camera=False, **style)
    if move_camera:
        assert rendering.camera is not None
        _place_camera(plotter, rendering.camera)
    return actor


def merge_scene(plotter: Any, rendering: Rendering) -> Rendering:
    """Draw the scene of a plotter with the picture's camera, and combine both by their depths.

    Each pixel of the picture is one layer at its expected depth, each pixel of the scene one at its nearest surface.
    The order is right wherever the nearer layer is opaque.  The plotter keeps the picture's camera.

    plotter: Plotter of a scene in LPS mm, with a window as large as the picture; off screen, or already shown.
    rendering: With a transparent background.

    Returns: With a transparent background and the depths of both.
    """
    if rendering.camera is None:
        raise UsageError("this picture is no projection (its camera is None): no scene is seen as it is")
    if tuple(plotter.shape) != (1, 1):
        raise UsageError("a plotter with several views has several cameras: merge a picture with one that has one")
    if tuple(plotter.window_size) != rendering.size:
        raise UsageError(
            f"the plotter's window has {plotter.window_size[0]} x {plotter.window_size[1]} pixels, the picture"
            f" {rendering.size[0]} x {rendering.size[1]}: make them equal (plotter.window_size = rendering.size)"
        )
    _place_camera(plotter, rendering.camera)
    colors, depth = _draw_scene(plotter, rendering.camera)
    return merge_layers(rendering, colors, depth)


def _place_camera(plotter: Any, camera: Camera) -> None:
    plotter.camera = camera.to_pyvista()
    plotter.renderer.ResetCameraClippingRange()


def _draw_scene(plotter: Any, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return colours with opacity, and depths along the rays in mm, NaN where there is nothing."""
    renderer, window = plotter.renderer, plotter.render_window
    background, gradient = renderer.GetBackground(), renderer.GetGradientBackground()
    samples = window.GetMultiSamples()
    actors = [actor for actor in renderer.actors.values() if hasattr(actor, "GetForceOpaque")]
    translucent = [actor for actor in actors if not actor.GetForceOpaque()]
    # VTK blends with the background's colour even if it is transparent; with black, colours are multiplied by opacity.
    renderer.SetBackground(0.0, 0.0, 0.0)
    renderer.SetGradientBackground(False)
    try:
        plotter.render()
        colors = np.array(plotter.screenshot(transparent_background=True, return_img=True))
        window.SetMultiSamples(0)  # else depths are those of a corner of the pixel
        for actor in translucent:  # these have no depth otherwise
            actor.ForceOpaqueOn()
        plotter.render()
        across = -np.array(plotter.get_image_depth(reset_camera_clipping_range=False), dtype=np.float64)
    finally:
        for actor in translucent:
            actor.ForceOpaqueOff()
        window.SetMultiSamples(samples)
        renderer.SetBackground(background)
        renderer.SetGradientBackground(gradient)
    opacity = np.maximum(colors[..., 3:], 1) / 255.0
    colors[..., :3] = np.rint(np.minimum(colors[..., :3] / opacity, 255.0))
    _, directions = camera.rays(plotter.window_size)
    return colors, across / (directions @ camera.basis().forward)
