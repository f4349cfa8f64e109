"""Pictures of the parts of a vertebra: one of them opaque, others faded."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.rendering import Rendering

DEFAULT_VIEW = "130,20"
"""From the left, behind and above: body, arch and canal are seen."""

COLORS = {
    "solid": (0.93, 0.88, 0.76),
    "dense": (0.93, 0.88, 0.76),
    "trabecular": (0.80, 0.42, 0.32),
    "canal": (0.25, 0.55, 0.90),
}

FADED = {"solid": ("canal",), "dense": ("canal",), "trabecular": ("solid", "canal"), "canal": ("solid",)}
"""Parts that are seen faded beside each opaque one: those that it does not hide."""

FADED_OPACITY = 0.15


def check_pictures(picture: str | Path, view: str) -> None:
    """Refuse pictures that cannot be made, before any work is done."""
    from clrecon.rendering.pictures.image_files import check_image_path
    from clrecon.rendering.pictures.pillow import load_pillow
    from clrecon.rendering.views.directions import find_view

    load_pillow()
    check_image_path(picture)
    find_view(view)


def draw_parts(
    meshes: Mapping[str, Mesh], view: str, device: Device, memory: int | None = None
) -> dict[str, Rendering]:
    """Draw each part opaque, with others faded, all from one camera.

    meshes: By the names of `clrecon.operators.vertebrae.inside.PARTS`.
    view: See `clrecon.Camera.fit`.
    memory: Most bytes on the device.
    """
    from clrecon.operators.rays.mesh_pictures import box_around, mesh_corners
    from clrecon.operators.rays.scene import ScenePictures
    from clrecon.rendering.pictures.mesh_look import MeshLook
    from clrecon.rendering.views.camera import Camera
    from clrecon.rendering.views.directions import DEFAULT_SIZE

    camera = Camera.fit(box_around([mesh_corners(mesh) for mesh in meshes.values()]), view)
    pictures = {}
    for part, mesh in meshes.items():
        shown = [(mesh, MeshLook(COLORS[part]))]
        shown += [
            (meshes[other], MeshLook(COLORS[other], opacity=FADED_OPACITY)) for other in FADED[part] if other in meshes
        ]
        with ScenePictures(shown, device=device, memory=memory) as scene:
            pictures[part] = scene.take(camera, DEFAULT_SIZE, "white")
    return pictures


def describe_picture(part: str, picture: Rendering, path: str | Path, size: int) -> dict[str, Any]:
    """Return one object of ``pictures``."""
    kind = os.path.splitext(os.fspath(path))[1].lower().lstrip(".")
    return {"part": part, "faded": list(FADED[part]), "size": list(picture.size), "format": kind, "bytes": size}
