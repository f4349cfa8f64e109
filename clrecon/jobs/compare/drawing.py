"""Pictures of what methods made: meshes and clouds from one camera in one light, before black, without OpenGL."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.points import PointCloud
from clrecon.rendering.views.camera import Camera

Image = NDArray[np.uint8]

BACKGROUND = "black"


def draw_mesh(mesh: Mesh, camera: Camera, size: tuple[int, int], *, device: Device | None = None) -> Image:
    """Draw a mesh, shaded by the normals of its triangles alone, so that pictures differ only where surfaces do.

    Returns: ndarray, shape (height, width, 3), uint8
    """
    from clrecon.operators.rays.render import render
    from clrecon.rendering.pictures.mesh_look import MeshLook

    bare = Mesh(mesh.vertices, mesh.triangles)
    picture = render(bare, MeshLook("bone"), camera=camera, size=size, background=BACKGROUND, device=device)
    return flatten(picture.image)


def draw_points(cloud: PointCloud, camera: Camera, size: tuple[int, int], *, device: Device | None = None) -> Image:
    """Draw a cloud as discs.

    Returns: ndarray, shape (height, width, 3), uint8
    """
    from clrecon.operators.rays.point_pictures import PointPictures
    from clrecon.rendering.pictures.point_look import PointLook

    with PointPictures(cloud, device=device) as pictures:
        return flatten(pictures.take(PointLook(color="bone"), camera, size, BACKGROUND).image)


def flatten(image: NDArray[Any]) -> Image:
    """Put a picture with opacity before black: (h, w, 4) uint8, not premultiplied, becomes (h, w, 3) uint8."""
    colour, opacity = image[..., :3].astype(np.uint16), image[..., 3:].astype(np.uint16)
    return ((colour * opacity + 127) // 255).astype(np.uint8)
