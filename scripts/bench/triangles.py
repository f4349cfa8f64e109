"""Case of pictures of a mesh, beside VTK's OpenGL renderer on whatever OpenGL is there."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from measure import alternate, summarise
from raycast import keep_pictures, likeness
from registry import Job, case

SIZES = (512, 1024)


@case("triangles", "a further picture of a mesh, parallel, against VTK on the OpenGL that is there (Mesa's llvmpipe)")
def measure_triangles(job: Job) -> dict[str, Any]:
    """Time a picture of the whole surface, one of its nearest facets as large triangles, and a translucent one.

    VTK keeps the mesh between pictures; clrecon uploads it for each.  Both sides read the picture back.  Seconds are
    those of the processor: both sides use all cores.
    """
    import clrecon
    from clrecon.operators.rays.scene import ScenePictures
    from clrecon.rendering.views.camera import Camera

    mesh = clrecon.extract_isosurface(job.input.volume(), job.hu, device=job.device)
    found: dict[str, Any] = {}
    for size in SIZES:
        for name, zoom, opacity in (("small", 1.0, 1.0), ("large", 40.0, 1.0), ("translucent", 1.0, 0.5)):
            look = clrecon.MeshLook("bone", opacity=opacity)
            with ScenePictures([(mesh, look)], device=job.device) as pictures:
                camera = Camera.fit(pictures.box, (30, 15), zoom, size=(size, size))
                peer = _Peer(mesh, camera, size, opacity, tuple(look.rgb.tolist()))
                ours = pictures.take(camera, (size, size), "black").image
                theirs = peer.draw()
                draw = partial(pictures.take, camera, (size, size), "black")
                sides = alternate(partial(_time, draw), partial(_time, peer.draw), job.pairs, limit_s=job.limit_s)
            keep_pictures(job.pictures, f"{name}-{size}", clrecon=ours[..., :3], vtk=theirs)
            found[f"{name}-{size}"] = {**summarise(*sides), "likeness": likeness(ours[..., :3], theirs)}
    return {"ratios": {name: own["ratio"] for name, own in found.items()}, "triangles": mesh.triangle_count, **found}


def _time(draw: Callable[[], object]) -> float:
    start = time.process_time()
    draw()
    return time.process_time() - start


class _Peer:
    """The same mesh, camera and light in a window of VTK off the screen."""

    def __init__(self, mesh: Any, camera: Any, size: int, opacity: float, color: tuple[float, ...]):
        import pyvista

        self.plotter = pyvista.Plotter(off_screen=True, window_size=(size, size), lighting="none")
        self.plotter.set_background("black")
        self.plotter.add_light(pyvista.Light(light_type="headlight"))
        self.plotter.add_mesh(
            mesh.to_pyvista(), color=color, opacity=opacity, smooth_shading=True, ambient=0.2, diffuse=0.8,
            specular=0.2, specular_power=15.0,
        )  # fmt: skip
        if opacity < 1.0:
            self.plotter.enable_depth_peeling(number_of_peels=16)
        self.plotter.camera = camera.to_pyvista()
        self.plotter.render_window.SetMultiSamples(0)
        self.plotter.show(auto_close=False)

    def draw(self) -> Any:
        """Return the picture (h, w, 3) uint8."""
        self.plotter.render()
        return self.plotter.screenshot(return_img=True)
