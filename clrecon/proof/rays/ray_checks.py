"""Checks of pictures by rays: leaps over empty bricks, entries of tiles, volume rendering, projections, surfaces
without a mesh, slices in space.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.opencl import Device, Stopwatch, download, upload
from clrecon.operators.rays import ray_slabs as slabs
from clrecon.operators.rays.openness import Hiding, find_openness
from clrecon.operators.rays.picture_buffers import TILE, PictureBuffers, RayView, Shot
from clrecon.operators.rays.point_pictures import Discs, draw_splats
from clrecon.operators.rays.ray_pictures import MainWay, enter_tiles, look_ahead, take_picture
from clrecon.operators.rays.slices import overlay_slices
from clrecon.operators.rays.surface_pictures import cast_surface
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import volume_box
from clrecon.proof.checking import (
    OBLIQUE,
    Check,
    blobs,
    centre_of,
    look_at,
    require_close,
    require_colors,
    require_equal,
    require_share,
    require_whole,
    stack,
)
from clrecon.proof.rays.objects import find_splats, shade_splats
from clrecon.proof.rays.openness import OpenPlaces
from clrecon.proof.rays.render import cast_rays, smooth_field
from clrecon.proof.rays.surface import cast_surface as surface_twin
from clrecon.proof.rays.surface import overlay_slices as overlay_twin
from clrecon.rendering import UNSHADED, Lighting, Rendering, TransferFunction
from clrecon.rendering.pictures.label_style import LabelStyle
from clrecon.rendering.pictures.styles import Projection, SlicesInSpace, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

_LEAP_SHAPE = (185, 193, 17)
"""Voxels (k, j, i) of 46 x 48 x 4 bricks: four rows of bricks a work-item are more than 500."""

_BEFORE = 5 * slabs.BRICK_CELLS
"""Slices before the first bright one within which a tile may begin: bricks around it, and rays aside of the middle."""

TYPES = ("int16", "uint8", "float32")


def _count_cells(voxels: NDArray[Any], take: np.ufunc) -> NDArray[Any]:
    """Reduce the voxels around the cells of each brick: bricks share the voxels between them."""
    for axis in range(3):
        starts = np.arange(0, voxels.shape[axis] - 1, slabs.BRICK_CELLS)
        ends = np.take(voxels, np.minimum(starts + slabs.BRICK_CELLS, voxels.shape[axis] - 1), axis=axis)
        voxels = take(take.reduceat(voxels, starts, axis=axis), ends)
    return voxels


def _spread_bricks(shown: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the Chebyshev distance of each brick to the nearest that shows, at most `FARTHEST`."""
    distances = np.where(shown, 0, slabs.FARTHEST).astype(np.uint8)
    for axis in range(3):
        lines = np.moveaxis(distances, axis, 0)
        best = lines.copy()
        for step in range(1, slabs.FARTHEST):
            for target, source in ((np.s_[step:], np.s_[:-step]), (np.s_[:-step], np.s_[step:])):
                best[target] = np.minimum(best[target], np.maximum(lines[source], step))
        distances = np.moveaxis(best, 0, axis)
    return distances


def _count_ahead(distances: NDArray[np.uint8], ray: MainWay) -> NDArray[np.uint8]:
    """Return what is free ahead of each brick along the main way, with the bricks beside it that rays drift to."""
    free = distances.T > 0
    clear = free
    for axis in {0, 1, 2} - {ray.axis}:
        numbers = np.arange(free.shape[axis])
        offset = np.float32(0.5) + numbers - ray.eye[axis] if ray.eye[3] else np.full(len(numbers), ray.eye[axis])
        drift = np.where(np.abs(offset) <= ray.aside, 0, np.sign(offset)).astype(int)
        clear = clear & np.take(clear, np.clip(numbers + drift, 0, len(numbers) - 1), axis=axis)
    lines = np.moveaxis(clear, ray.axis, 0)
    counts, count = np.zeros(lines.shape, np.uint8), np.full(lines.shape[1:], slabs.FARTHEST)
    for n in range(len(lines))[:: -ray.ahead]:
        count = np.where(lines[n], np.minimum(count + 1, slabs.FARTHEST), 0)
        counts[n] = count
    return np.moveaxis(counts, 0, ray.axis).T


def _open_slab(device: Device, volume: Volume) -> tuple[DeviceVolume, slabs.RaySlab]:
    resident = DeviceVolume(volume, device=device)
    return resident, next(slabs.ray_slabs(resident, volume.shape_ijk[2], np.inf, Stopwatch()))


def _check_leaps(device: Device) -> str:
    rng, stopwatch = np.random.default_rng(24), Stopwatch()
    for dtype in TYPES:
        voxels = rng.integers(0, 40, _LEAP_SHAPE).astype(dtype)
        for _ in range(60):
            voxels[tuple(rng.integers(0, _LEAP_SHAPE))] = 100
        resident, slab = _open_slab(device, stack(voxels, np.eye(4)))
        counts = slab.bricks[::-1]
        with stopwatch.running(device):
            ranges = np.empty((*counts, 2), dtype)
            download(device, ranges, slabs.measure_cells(resident, slab))
            leaps = slabs.find_leaps(resident, slab, "key", np.arange(100) > 50, 0.0, 1.0)
            distances = download(device, np.empty(counts, np.uint8), leaps.distances_d)
        low, high = _count_cells(voxels, np.minimum), _count_cells(voxels, np.maximum)
        require_equal(ranges, np.stack([low, high], axis=-1), f"ranges of bricks of {dtype} voxels")
        expected = _spread_bricks(high > 50)
        require_equal(distances, expected, f"distances of bricks of {dtype} voxels")
        for eye, aside in (((0.01, -0.5, 0.7, 0.0), 0.02), ((-3.0, 20.0, 10.0, 1.0), 0.5)):
            for axis in range(3):
                main_way = MainWay(axis, 1 if axis else -1, np.array(eye, np.float32), aside)
                with stopwatch.running(device):
                    known = slabs.LeapMap(upload(device, expected), None)
                    ways_d = look_ahead(resident, slab, main_way, known)
                    ways = download(device, np.empty(counts, np.uint8), ways_d)
                require_equal(ways >> 4, _count_ahead(expected, main_way), f"free bricks ahead along axis {axis}")
                require_equal(ways & slabs.FARTHEST, expected, "distances of bricks, copied")
    return f"{np.prod(counts):,} bricks of {len(TYPES)} types of voxels equal"


def _check_tiles(device: Device) -> str:
    """Look at a stair of bright voxels, straight on: each tile begins before it, at most a few bricks."""
    nk, nj = 90, 64
    ni = 80
    stair = 30 + np.arange(ni) // 2
    voxels = np.where(np.arange(nk)[:, None, None] >= stair, 1000, np.zeros((nk, nj, ni))).astype(np.int16)
    size = (ni * TILE, nj * TILE)
    distance = 50.0
    stopwatch = Stopwatch()
    for uneven in (False, True):
        volume = stack(voxels, np.eye(4), uneven=uneven)
        resident, slab = _open_slab(device, volume)
        middle = np.array([(ni - 1) / 2, (nj - 1) / 2, 0.0])
        camera = Camera(tuple(middle - (0.0, 0.0, distance)), tuple(middle), (0.0, -1.0, 0.0), parallel_scale=nj / 2)
        box = volume_box(volume)
        view = RayView.of(volume, camera, size, 0.5, box=box, focus=box)
        output = PictureBuffers(device, size, None, False)
        with stopwatch.running(device):
            leaps = slabs.find_leaps(resident, slab, "key", np.arange(100) > 50, 0.0, 0.1)
            entries_d = enter_tiles(resident, slab, view, leaps, output)
            entries = download(device, np.empty((nj, ni), np.float32), entries_d) + view.table[-1, 0]
        heights = volume.slice_origins()[:, 2]
        first, last = (heights[np.maximum(stair - n, 0)] + distance for n in (_BEFORE, 0))
        allowed = 0.5 * (last - first)
        subject = f"entries of tiles{' of uneven slices' if uneven else ''}"
        require_close((entries - 0.5 * (first + last)) / allowed, np.zeros_like(entries), 1.0, subject)
    return f"{2 * ni * nj:,} tiles begin up to {_BEFORE} slices before the first that shows"


_SMOOTHED_SHAPE = (12, 15, 85)
"""Voxels (k, j, i): rows of ten groups of eight voxels and a part of one; 1,980 work-items of eight voxels."""


def _check_smoothing(device: Device) -> str:
    rng, stopwatch = np.random.default_rng(49), Stopwatch()
    for dtype in TYPES:
        voxels = rng.normal(100.0, 30.0, _SMOOTHED_SHAPE).astype(dtype)
        resident, slab = _open_slab(device, stack(voxels, np.diag([0.7, 0.9, 2.0, 1.0])))
        smoothing = slabs.Smoothing.of(resident.volume, 1.3)
        assert smoothing is not None
        with stopwatch.running(device):
            smoothed = download(device, np.empty_like(voxels), slabs.smooth_voxels(resident, slab, smoothing))
        require_equal(smoothed, smooth_field(resident.volume, 1.3), f"smoothed {dtype} voxels")
    return f"{len(TYPES)} x {voxels.size:,} voxels smoothed along three axes, the same bits"


_OPEN_SHAPE = (23, 24, 25)
"""Voxels (k, j, i) of which each is a cell of the grid of openness: lines along each axis are more than 500."""


def _check_openness(device: Device) -> str:
    """Compare the grid of openness of random voxels with the twin's, cut by a plane and with a translucent label."""
    rng = np.random.default_rng(26)
    opacities = rng.random(4096).astype(np.float32) ** 3
    for dtype in TYPES:
        voxels = rng.integers(0, 120, _OPEN_SHAPE).astype(dtype)
        volume = stack(voxels, OBLIQUE)
        clip = Clip.plane(centre_of(volume), (0.5, 0.4, 1.0))
        look = LabelStyle.of(LabelMap((voxels % 3).astype(np.uint8), OBLIQUE), None, {2: 0.25})
        nodes = np.clip(np.floor(volume.voxels * 30.0 + 0.5), 0, 4095).astype(np.int64)
        for labels in (None, look):
            resident = DeviceVolume(volume, device=device)
            placed = None if labels is None else resident.bring(labels.labels)
            hiding = Hiding(upload(device, opacities), 4096, 0.0, 30.0, clip.planes, placed, labels)
            openness = find_openness(resident, _OPEN_SHAPE[0], hiding, Stopwatch())
            grid = download(device, np.empty(openness.cells.counts[::-1], dtype), openness.grid_d)
            opacity = opacities[nodes]
            if labels is not None:
                opacity = opacity * labels.table[labels.labels.voxels, 3]
            require_equal(grid, OpenPlaces(volume, opacity, clip).grid, f"openness of {dtype} voxels")
    return f"{len(TYPES)} x {grid.size:,} cells as open as computed"


_OPENED = ("fill_cells", "sweep_light", "finish_openness")
LEAP_CHECKS = (
    Check("openness of places", _OPENED, _check_openness, {"rays/openness.cl": ("LABELS",)}),
    Check("smoothed light", ("smooth_along",), _check_smoothing),
    Check(
        "leaps of rays", ("measure_cells", "mark_bricks", "spread_in_rows", "spread_along", "look_ahead"), _check_leaps
    ),
    Check(
        "entries of tiles",
        ("measure_cells", "mark_bricks", "spread_in_rows", "spread_along", "enter_tiles"),
        _check_tiles,
        {"rays/leaps.cl": ("UNEVEN",), "rays/tiles.cl": ("UNEVEN",)},
    ),
)


SIZE = (96, 60)
"""Pixels: 720 work-items that take eight rays each."""

_PICTURE_SHAPE = (16, 26, 22)
"""Voxels (k, j, i)."""

COLOR_255 = 2.0
"""Largest difference of a colour of 8 bits: rounding, and float32 sums."""

DEPTH_MM = 0.01
"""Largest difference of a depth of 150 mm: sums in float32."""

VALUE_HU = 0.5
"""Largest difference of a value along a ray: float32 places between voxels that differ by hundreds of HU."""

EDGE_SHARE = 0.01
"""Pixels that may differ: at edges float32 takes the other side."""

FIXED = Lighting(0.15, 0.7, 0.4, 20.0, direction=(0.4, -1.0, 0.8))
SOFT = TransferFunction([(-300, 0.9, 0.2, 0.1, 0.0), (200, 1, 0.7, 0.4, 0.15), (900, 1, 1, 0.9, 0.6)])
STEEP = TransferFunction([(-200, 0.8, 0.1, 0.1, 0), (100, 1, 0.6, 0.3, 0), (130, 1, 0.9, 0.7, 0.9), (800, 1, 1, 1, 1)])
_BY_GRADIENT = TransferFunction(
    SOFT.points, unit_distance=2.0, gradient_opacity=[(20.0, 0.0), (150.0, 1.0), (600, 0.3)]
)
_DENSE = TransferFunction([(-200, 0.9, 0.2, 0.1, 0.0), (600, 1, 0.7, 0.4, 0.95)])
"""A transfer function by which hollows of the blobs are up to 10 of 255 darker with ambient occlusion."""

_DIM = TransferFunction([(20, 0.9, 0.2, 0.1, 0.0), (90, 1, 0.7, 0.4, 0.2), (130, 1, 1, 0.9, 0.6)])
"""A transfer function for voxels of 8 bits."""


def _compare_picture(picture: Rendering, rgba: NDArray[Any], depth: NDArray[Any], subject: str) -> float:
    """Compare colours over black, 0 to 1, and depths, pixel by pixel."""
    require_whole(picture.report)
    both = np.isfinite(picture.depth) & np.isfinite(depth)
    require_share(np.isfinite(picture.depth), np.isfinite(depth), 0.0, EDGE_SHARE, f"hits of {subject}")
    require_share(picture.depth[both], depth[both], DEPTH_MM, 2.0 * EDGE_SHARE, f"depths of {subject}, in mm")
    colors = 255.0 * np.clip(rgba, 0.0, 1.0)
    return require_colors(picture.image, colors, COLOR_255, f"colours of {subject}", EDGE_SHARE)


def _cut_middle(volume: Volume) -> Clip:
    centre = centre_of(volume)
    return Clip.box(centre - 5.0, centre + (6.0, 7.0, 4.0)) & Clip.plane(centre, (0.5, 0.4, 1.0))


def _check_composite(device: Device, scenes: tuple[tuple[str, TransferFunction, bool, dict[str, Any]], ...]) -> str:
    worst = 0.0
    for dtype, function, uneven, options in scenes:
        volume = blobs(_PICTURE_SHAPE, OBLIQUE, dtype, uneven=uneven)
        lighting, jitter = options.get("lighting", FIXED), options.get("jitter", False)
        clip = _cut_middle(volume) if options.get("cut") else None
        camera = look_at(volume, (0.4, 1.0, -0.3), 7.0, perspective=options.get("perspective", True))
        step = options.get("step", 0.5 * min(volume.spacing))
        style = VolumeLook(
            function, lighting=lighting, jitter=jitter, clip=clip, ray_step=step,
            ambient_occlusion=options.get("ambient_occlusion", 0.0),
        )  # fmt: skip
        picture = take_picture(DeviceVolume(volume, device=device), style, Shot(camera, SIZE), step)
        twin = cast_rays(volume, style, camera, SIZE)
        subject = f"{dtype} voxels{' of uneven slices' * uneven}"
        worst = max(worst, _compare_picture(picture, twin.rgba, twin.depth, subject))
    return f"{len(scenes)} pictures of {SIZE[0]} x {SIZE[1]} pixels within {worst:.1f} of 255"


def _stripes(dtype: str) -> tuple[Volume, LabelMap, Camera]:
    """Return a block of one HU with labels in stripes of eight columns, and a camera with a pixel for each column."""
    width, height = SIZE
    affine, shape = np.diag([0.7, 0.5, 1.1, 1.0]), (height + 4, 10, width)
    numbers = np.broadcast_to(np.arange(width) // 8 % 4, shape).astype(dtype)
    volume = Volume(np.full(shape, 100, np.int16), affine)
    middle = volume.ijk_to_lps([((width - 1) / 2, 4.5, (height + 3) / 2)])[0]
    scale = 0.35 * height
    return (
        volume,
        LabelMap(numbers, affine),
        Camera(tuple(middle - (0, 50, 0)), tuple(middle), (0, 0, 1), parallel_scale=scale),
    )


def _check_composite_labels(device: Device) -> str:
    """Labels, which reach beyond their voxels, scale the opacity of a block of known thickness, and tint it."""
    grey = TransferFunction([(0, 0.5, 0.5, 0.5, 0.1), (200, 0.5, 0.5, 0.5, 0.1)], unit_distance=2.0)
    for dtype in ("uint8", "uint16"):
        volume, labels, camera = _stripes(dtype)
        style = VolumeLook(
            grey, lighting=UNSHADED, labels=labels, label_colors={3: "red"}, label_opacity={1: 0.25, 3: 0.5}
        )
        picture = take_picture(DeviceVolume(volume, device=device), style, Shot(camera, SIZE), 0.3)
        require_whole(picture.report)
        pixels = np.arange(SIZE[0])
        grown = [(pixels >= 32) & (pixels % 32 < slabs.GROWN), (pixels % 32 >= 8 - slabs.GROWN) & (pixels % 32 < 8)]
        column = np.select(grown, [3, 1], pixels // 8 % 4)
        factor = np.choose(column, (1.0, 0.25, 1.0, 0.5))
        opacity = 1.0 - (1.0 - 0.1 * factor) ** (10 * 0.5 / grey.unit_distance)
        tint = np.where((column == 3)[:, None], (0.9, 0.1, 0.1), (0.5, 0.5, 0.5))
        row = 255.0 * np.concatenate([tint * opacity[:, None], opacity[:, None]], axis=1)
        inner = (column == np.roll(column, 1)) & (column == np.roll(column, -1))
        require_colors(picture.image[:, inner], row[inner], COLOR_255, f"colours of labels of type {dtype}")
    return f"2 pictures with labels of {SIZE[0]} x {SIZE[1]} pixels as computed"


def _check_projections(device: Device, kinds: tuple[str, ...], uneven: bool) -> str:
    worst = 0.0
    for kind in kinds:
        for dtype in ("int16", "float32") if uneven else ("int16", "uint8", "float32"):
            volume = blobs(_PICTURE_SHAPE, OBLIQUE, dtype, uneven=uneven)
            clip = _cut_middle(volume) if dtype == "float32" else None
            camera = look_at(volume, (0.4, 1.0, -0.3), 7.0, perspective=dtype != "uint8")
            step = 0.5 * min(volume.spacing)
            style = Projection(kind, clip=clip)  # type: ignore[arg-type]
            picture = take_picture(DeviceVolume(volume, device=device), style, Shot(camera, SIZE), step)
            twin = cast_rays(volume, style, camera, SIZE)
            subject = f"{kind} of {dtype} voxels{' of uneven slices' * uneven}"
            require_whole(picture.report)
            assert picture.values is not None
            worst = max(worst, require_share(picture.values, twin.values, VALUE_HU, EDGE_SHARE, subject))
            if kind in ("mip", "minip") and dtype != "uint8":  # 8 bits have several places of one value
                both = np.isfinite(picture.depth) & np.isfinite(twin.depth)
                require_equal(both.any(), True, f"depths of {subject}")
                require_share(picture.depth[both], twin.depth[both], DEPTH_MM, 2.0 * EDGE_SHARE, f"depths of {subject}")
    return f"values of {', '.join(kinds)} within {worst:.1g}"


def _check_surfaces(device: Device, uneven: bool, ambient_occlusion: float = 0.0) -> str:
    worst = 0.0
    for dtype, iso_value, shadows in (("int16", 100.0, False), ("uint8", 75.0, False), ("float32", 100.0, True)):
        volume = blobs(_PICTURE_SHAPE, OBLIQUE, dtype, uneven=uneven)
        clip = _cut_middle(volume) if dtype == "float32" else None
        camera = look_at(volume, (0.4, 1.0, -0.3), 7.0, perspective=dtype == "float32")
        step = 0.5 * min(volume.spacing)
        style = SurfaceLook(
            iso_value, color="white", shadows=shadows, lighting=FIXED, clip=clip, ambient_occlusion=ambient_occlusion
        )
        picture = cast_surface(DeviceVolume(volume, device=device), style, Shot(camera, SIZE), step)
        twin = surface_twin(volume, style, camera, SIZE)
        subject = f"{dtype} voxels{' of uneven slices' * uneven}"
        worst = max(worst, _compare_picture(picture, twin.rgba, twin.depth, subject))
    return f"3 pictures of {SIZE[0]} x {SIZE[1]} pixels within {worst:.1f} of 255"


def _check_surface_labels(device: Device) -> str:
    """A block whose labels lie in stripes shows their colours, and what lies behind a translucent one."""
    for dtype in ("uint8", "uint16"):
        volume, labels, camera = _stripes(dtype)
        style = SurfaceLook(
            50.0, color="white", lighting=Lighting(1.0, 0.0, 0.0), labels=labels,
            label_colors={1: "red", 2: "blue"}, label_opacity={3: 0.4},
        )  # fmt: skip
        picture = cast_surface(DeviceVolume(volume, device=device), style, Shot(camera, SIZE), 0.2)
        require_whole(picture.report)
        column = np.arange(SIZE[0]) // 8 % 4
        colors = 255.0 * np.array([(1, 1, 1, 1), (1, 0, 0, 1), (0, 0, 1, 1), (0.4, 0.4, 0.4, 0.4)])
        inner = (np.arange(SIZE[0]) % 8 > 1) & (np.arange(SIZE[0]) % 8 < 6)
        rows = slice(3, SIZE[1] - 3)
        shown, expected = picture.image[rows, inner], colors[column[inner]]
        require_colors(shown, expected, COLOR_255, f"colours of labels of type {dtype}")
    return f"2 pictures with labels of {SIZE[0]} x {SIZE[1]} pixels as computed"


def _check_slices(device: Device) -> str:
    worst = 0.0
    for dtype, uneven in (("int16", False), ("uint8", False), ("float32", True)):
        volume = blobs(_PICTURE_SHAPE, OBLIQUE, dtype, uneven=uneven)
        camera = look_at(volume, (0.4, 0.8, -0.7), 7.0, perspective=uneven)
        clip = _cut_middle(volume) if uneven else None
        style = SlicesInSpace([1, 4, 7, 12], opacity=0.4, lowest_hu=-300.0, window=(-500.0, 700.0), clip=clip)
        picture = overlay_slices(DeviceVolume(volume, device=device), style, Shot(camera, SIZE))
        rgba, depth = overlay_twin(volume, camera, SIZE, style)
        worst = max(worst, _compare_picture(picture, rgba, depth, f"slices of {dtype} voxels"))
    return f"3 pictures of {SIZE[0]} x {SIZE[1]} pixels within {worst:.1f} of 255"


def _check_points(device: Device) -> str:
    """Draw a ball of points, with normals and without: each pixel shows the point that the twin finds."""
    rng = np.random.default_rng(25)
    radius, worst = 0.6, 0.0
    normals = rng.normal(size=(3000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points, colors = (6.0 * normals).astype(np.float32), rng.integers(0, 256, (3000, 4)).astype(np.uint8)
    for perspective, point_normals in ((False, None), (True, normals.astype(np.float32))):
        scale = {"view_angle": 9.0} if perspective else {"parallel_scale": 7.0}
        camera = Camera((-30.0, -80.0, 25.0), (0.3, 0.2, 0.1), (0.1, 0.2, 1.0), **scale)
        splats = draw_splats(device, Discs(points, colors, point_normals, radius, FIXED), Shot(camera, SIZE))
        require_equal(splats.parts, 1, "parts of a cloud of 3,000 points")
        depth, numbers = find_splats(points, camera, SIZE, radius)
        apart = round(radius / camera.pixel_mm(SIZE))
        rgba, far = shade_splats(depth, numbers, colors[:, :3] / 255.0, point_normals, camera, FIXED, apart)
        require_equal(splats.image[..., 3] > 0, numbers >= 0, "pixels with a point")
        require_close(splats.depth, far, DEPTH_MM, "depths of points, in mm")
        worst = max(worst, require_colors(splats.image, 255.0 * rgba, COLOR_255, "colours of points"))
    return f"2 pictures of {SIZE[0]} x {SIZE[1]} pixels within {worst:.1f} of 255"


_PREPARED = ("measure_cells", "mark_bricks", "spread_in_rows", "spread_along")
RENDERED = (*_PREPARED, "enter_tiles", "look_ahead", "composite_rays")
_PROJECTED = ("measure_cells", "project_rays")
_TRACED = (*_PREPARED, "trace_surface")


def _check_last(name: str, kernels: tuple[str, ...], run: Any, *macros: str, **options: Any) -> Check:
    """Return a check whose last kernel is built with macros; the kernels before it know only uneven slices."""
    file = {
        "composite_rays": "rays/composite.cl",
        "project_rays": "rays/project.cl",
        "trace_surface": "rays/surface.cl",
    }
    variants = {file[kernels[-1]]: macros} if macros else {}
    if "UNEVEN" in macros:
        variants["rays/leaps.cl"] = ("UNEVEN",)
        if "enter_tiles" in kernels:
            variants["rays/tiles.cl"] = ("UNEVEN",)
    return Check(name, kernels, partial(run, **options), variants)


PICTURE_CHECKS = (
    _check_last(
        "volume rendering",
        RENDERED,
        _check_composite,
        scenes=(
            ("int16", SOFT, False, {}),
            ("uint8", _DIM, False, {}),
            ("float32", SOFT, False, {"cut": True, "jitter": True}),
        ),
    ),
    _check_last(
        "gradient opacity",
        RENDERED,
        _check_composite,
        "GRADIENT_OPACITY",
        scenes=(("int16", _BY_GRADIENT, False, {}), ("float32", _BY_GRADIENT, False, {})),
    ),
    _check_last(
        "steep transfer functions",
        RENDERED,
        _check_composite,
        "TAKES_PARTS",
        scenes=(("int16", STEEP, False, {"step": 0.17}), ("float32", STEEP, False, {"step": 0.17})),
    ),
    _check_last(
        "volume rendering of uneven slices",
        RENDERED,
        _check_composite,
        "UNEVEN",
        scenes=(("int16", SOFT, True, {}), ("float32", SOFT, True, {"cut": True})),
    ),
    _check_last(
        "ambient occlusion in volume rendering",
        (*_OPENED, *RENDERED),
        _check_composite,
        "OPENNESS",
        scenes=(
            ("int16", _DENSE, False, {"ambient_occlusion": 1.0}),
            ("float32", _DENSE, False, {"cut": True, "ambient_occlusion": 0.9}),
        ),
    ),
    _check_last("labels in volume rendering", RENDERED, _check_composite_labels, "LABELS"),
    _check_last("projections", _PROJECTED, _check_projections, kinds=("mip", "minip", "mean"), uneven=False),
    _check_last("radiographs", _PROJECTED, _check_projections, "LEAST_VALUE", kinds=("drr",), uneven=False),
    _check_last(
        "projections of uneven slices",
        _PROJECTED,
        _check_projections,
        "LEAST_VALUE",
        "UNEVEN",
        kinds=("mip", "minip", "mean", "drr"),
        uneven=True,
    ),
    _check_last("surfaces without a mesh", _TRACED, _check_surfaces, uneven=False),
    _check_last("surfaces of uneven slices", _TRACED, _check_surfaces, "UNEVEN", uneven=True),
    _check_last(
        "ambient occlusion on surfaces",
        (*_OPENED, *_TRACED),
        _check_surfaces,
        "OPENNESS",
        uneven=False,
        ambient_occlusion=0.7,
    ),
    _check_last("labels on surfaces", _TRACED, _check_surface_labels, "LABELS"),
    Check("slices in space", ("overlay_slices",), _check_slices),
    Check("points as discs", ("clear_splats", "splat_depths", "splat_numbers", "shade_splats"), _check_points),
)
