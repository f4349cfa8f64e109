"""Checks of triangles and of the layers of a picture."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.mesh import Mesh
from clrecon.opencl import Device, Stopwatch, download
from clrecon.operators.rays.mesh_pictures import make_part
from clrecon.operators.rays.picture_buffers import Between, DrawnVolume, Shot
from clrecon.operators.rays.scene import LayeredPicture, ScenePictures, Still, draw_layers
from clrecon.proof.checking import (
    OBLIQUE,
    Check,
    blobs,
    centre_of,
    look_at,
    require_close,
    require_colors,
    require_equal,
    require_whole,
)
from clrecon.proof.rays.objects import ColoredMesh, Meetings, find_meetings, nth_layer, shade_layer
from clrecon.proof.rays.ray_checks import COLOR_255, EDGE_SHARE, FIXED, RENDERED, SOFT
from clrecon.proof.rays.render import cast_rays
from clrecon.proof.rays.surface import overlay_slices as overlay_twin
from clrecon.rendering import UNSHADED
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.rendering.pictures.styles import SlicesInSpace, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

SIZE = (160, 104)
"""Pixels, of which 32 are a work-item of the kernel that counts them."""

_WITH_VOLUME = (96, 60)
"""Pixels: 720 work-items that take eight rays each."""

TRIANGLES, SPLIT = 660, 90
"""All triangles, every seventh of which fills a quarter of the picture; from `SPLIT` on they are opaque."""

OPACITY = 0.35
DEPTH_MM = 1e-3
_BETWEEN_255 = 3.5
"""As COLOR_255, and the hundredth behind what is nearly opaque, which rays leave out."""


def _soup() -> tuple[Mesh, NDArray[np.uint8]]:
    """Return triangles anywhere within 7 mm, and a colour for each vertex."""
    rng, count = np.random.default_rng(31), TRIANGLES
    size = np.where(np.arange(count) % 7 < 6, 0.4, 3.0)[:, None, None]
    corners = rng.uniform(-6.0, 6.0, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3))
    normals = rng.normal(size=(3 * count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    mesh = Mesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3), normals)
    return mesh, rng.integers(0, 256, (3 * count, 3)).astype(np.uint8)


def _still(camera: Camera) -> Still:
    """Return a sheet in the middle of the triangles, opaque in a third of the picture, translucent in another."""
    width, height = SIZE
    depth = (camera.distance / (camera.rays(SIZE)[1] @ camera.basis().forward)).astype(np.float32)
    image = np.full((height, width, 4), (40, 90, 200, 255), np.uint8)
    image[:, : width // 3, 3] = 100
    depth[:, 2 * width // 3 :] = np.nan
    image[np.isnan(depth)] = 0
    return Still(image, depth)


def _blend_layers(
    mesh: Mesh, colors: NDArray[np.uint8], camera: Camera, still: Still
) -> tuple[list[Float64Array], Float64Array, Float64Array, Float64Array]:
    """Return the depths of all layers, premultiplied colours, first and expected depths; see `SPLIT`."""
    count, (width, height) = mesh.triangle_count, SIZE
    met = find_meetings(mesh.vertices, mesh.triangles, camera, SIZE)
    along = np.ones((height, width)) if camera.is_parallel else camera.rays(SIZE)[1] @ camera.basis().forward
    sheet = np.flatnonzero(~np.isnan(still.depth))
    depths = np.concatenate([met.depths, (still.depth * along).ravel()[sheet].astype(np.float32)])
    pixels = np.concatenate([met.pixels, sheet])
    numbers = np.concatenate([met.triangles, np.full(len(sheet), count)])
    shares = np.concatenate([met.shares, np.full((len(sheet), 3), 1 / 3)])
    order = np.lexsort((numbers, depths, pixels))
    every = Meetings(pixels[order], numbers[order], depths[order], shares[order])
    triangles = np.concatenate([mesh.triangles, [[0, 1, 2]]])
    with_sheet = ColoredMesh(mesh.vertices, triangles, colors / 255.0, mesh.normals)
    color, opacity = np.zeros((height, width, 3)), np.zeros((height, width))
    first, depth_sum = np.full((height, width), np.nan), np.zeros((height, width))
    layers = []
    for layer in range(int(np.bincount(pixels).max())):
        places = np.where(opacity < 1.0, nth_layer(every, layer, SIZE), -1)
        rgb, depth = shade_layer(every, places, with_sheet, camera, FIXED)
        triangle_numbers = np.where(places >= 0, every.triangles[places], 0)
        is_sheet = triangle_numbers == count
        rgb[is_sheet] = still.image[is_sheet][:, :3] / 255.0
        share = np.where(is_sheet, still.image[..., 3] / 255.0, np.where(triangle_numbers >= SPLIT, 1.0, OPACITY))
        weight = np.where(places >= 0, (1.0 - opacity) * share, 0.0)
        color, opacity = color + weight[..., None] * rgb, opacity + weight
        depth_sum += weight * np.nan_to_num(depth)
        first = np.where(np.isnan(first), depth, first)
        layers.append(np.where(np.isnan(depth), np.inf, depth))
    with np.errstate(invalid="ignore"):
        return layers, np.concatenate([color, opacity[..., None]], axis=-1), first, depth_sum / opacity


def _check_layers(device: Device) -> str:
    """Draw translucent and opaque triangles with a sheet between them, in parallel and in perspective."""
    mesh, colors = _soup()
    worst = 0.0
    halves = [(slice(0, SPLIT), OPACITY), (slice(SPLIT, None), 1.0)]
    parts = [
        make_part(
            Mesh(mesh.vertices, mesh.triangles[own], mesh.normals),
            MeshLook(vertex_colors=colors, opacity=opacity, lighting=FIXED),
        )
        for own, opacity in halves
    ]
    for scale in ({"parallel_scale": 6.0}, {"view_angle": 14.0}):
        camera = Camera((-20.0, -40.0, 15.0), (0.3, 0.2, 0.1), (0.1, 0.2, 1.0), **scale)
        still = _still(camera)
        ways: list[Any] = []

        def note_ends(between: Between, ways: list[Any] = ways) -> None:
            depths = (between.nearest_d, between.farthest_d)
            ways.append([download(device, np.empty(SIZE[::-1], np.float32), each) for each in depths])

        drawn = DrawnVolume(device, note_ends, 0.0, Stopwatch(), [])
        layered = draw_layers(drawn, parts, Shot(camera, SIZE), still=still)
        layers, rgba, depth, mean = _blend_layers(mesh, colors, camera, still)
        _compare_ways(ways, layers, layered)
        first = draw_layers(drawn._replace(sample=None), parts, Shot(camera, SIZE), still=still, most=1)
        more = np.isfinite(layers[0]) & (first.image[..., 3] < 255)
        require_equal(first.open_pixels, np.count_nonzero(more), "pixels that may have a second layer")
        require_close(layered.depth, depth, DEPTH_MM, "depths of triangles, in mm")
        require_close(layered.expected_depth, mean, DEPTH_MM, "expected depths of triangles, in mm")
        worst = max(worst, require_colors(layered.image, 255.0 * rgba, COLOR_255, "colours of triangles"))
    return f"2 pictures of {SIZE[0]} x {SIZE[1]} pixels within {worst:.1f} of 255"


def _compare_ways(ways: list[Any], layers: list[Float64Array], image: LayeredPicture) -> None:
    """Compare where rays begin and end between layers; beyond the last one with something there may be an empty one."""
    require_equal(image.open_pixels, 0, "pixels with further layers")
    ends = [*layers, np.full(SIZE[::-1], np.inf), np.full(SIZE[::-1], np.inf)]
    nearest = np.full(SIZE[::-1], -np.inf)
    for number, ((begin, end), farthest) in enumerate(zip(ways, ends, strict=False)):
        for part, drawn, expected in (("begin", begin, nearest), ("end", end, farthest)):
            # Before or behind all.
            side, wanted_side = (np.sign(depths) * np.isinf(depths) for depths in (drawn, expected))
            require_equal(side, wanted_side, f"pixels without a {part} of the way before layer {number}")
            finite, wanted = (np.where(np.isinf(depths), 0.0, depths) for depths in (drawn, expected))
            require_close(finite, wanted, DEPTH_MM, f"{part}s of the way before layer {number}, in mm")
        nearest = farthest


def _screen(volume: Volume, camera: Camera) -> tuple[Mesh, Clip, Clip]:
    """Return two triangles across a volume, aslant, and the half-spaces before and behind them."""
    centre, toward = centre_of(volume), -camera.basis().forward + (0.2, 0.3, -0.25)
    normal = toward / np.linalg.norm(toward)
    across = np.cross(normal, (0.0, 0.0, 1.0))
    across, down = 200.0 * across, 200.0 * np.cross(normal, across)
    corners = [centre - across - down, centre + across - down, centre + across + down, centre - across + down]
    return Mesh(corners, [(0, 1, 2), (0, 2, 3)]), Clip.plane(centre, normal), Clip.plane(centre, -normal)


def _check_between(device: Device, slices: bool) -> str:
    """Show a volume with a translucent screen across it: the twin's part before it, the screen, and the part behind."""
    worst, opacity = 0.0, 0.4
    color = np.array([0.2, 0.9, 0.4])
    screen = MeshLook(tuple(color.tolist()), opacity=opacity, lighting=UNSHADED)
    for perspective in (False, True):
        volume = blobs((16, 26, 22), OBLIQUE, "int16")
        camera = look_at(volume, (0.4, 0.9, -0.5), 7.0, perspective=perspective)
        mesh, before, behind = _screen(volume, camera)
        look: VolumeLook | SlicesInSpace = VolumeLook(SOFT, lighting=FIXED)
        if slices:
            look = SlicesInSpace([1, 4, 7, 9, 12], opacity=0.4, lowest_hu=-300.0, window=(-500.0, 700.0))
        with ScenePictures([(volume, look), (mesh, screen)], device=device) as pictures:
            picture = pictures.take(camera, _WITH_VOLUME)
        require_whole(picture.report)
        sides = []
        for clip in (before, behind):
            if isinstance(look, SlicesInSpace):
                rgba, _ = overlay_twin(volume, camera, _WITH_VOLUME, replace(look, clip=clip))
            else:
                rgba = cast_rays(volume, replace(look, clip=clip), camera, _WITH_VOLUME).rgba
            sides.append(np.clip(rgba, 0.0, 1.0))
        rest = opacity * np.append(color, 1.0) + (1.0 - opacity) * sides[1]
        expected = sides[0] + (1.0 - sides[0][..., 3:]) * rest
        subject = "colours about a screen"
        worst = max(worst, require_colors(picture.image, 255.0 * expected, _BETWEEN_255, subject, EDGE_SHARE))
    return f"2 pictures of {_WITH_VOLUME[0]} x {_WITH_VOLUME[1]} pixels within {worst:.1f} of 255"


CHECKS = (
    Check(
        "a volume before and behind triangles",
        RENDERED,
        partial(_check_between, slices=False),
        {"rays/composite.cl": ("BETWEEN",)},
    ),
    Check(
        "slices before and behind triangles",
        ("overlay_slices",),
        partial(_check_between, slices=True),
        {"rays/slices.cl": ("BETWEEN",)},
    ),
    Check(
        "triangles and layers",
        (
            "place_vertices", "count_pieces", "draw_triangles", "draw_pieces", "shade_triangles", "clear_rays",
            "fill_depths", "begin_layer", "show_still", "blend_layer", "count_open", "finish_rays",
        ),
        _check_layers,
    ),
)  # fmt: skip
