"""Labels in pictures: colours, what is translucent and what is seen through it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from ray_scenes import STEPS, centre_of, look, make_volume, positions, premultiplied

from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.operators.rays.picture_buffers import Shot
from clrecon.operators.rays.ray_pictures import take_picture
from clrecon.operators.rays.surface_pictures import cast_surface
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.surface.labels import find_solid
from clrecon.rendering import Lighting, Rendering, TransferFunction
from clrecon.rendering.pictures.styles import SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

SIZE = (40, 36)
UNLIT = Lighting(1.0, 0.0, 0.0)
NAMES = {1: "vertebrae_L1", 2: "vertebrae_L2", 3: "rib_left_1"}
RED, BLUE = np.array([255.0, 0.0, 0.0]), np.array([0.0, 0.0, 255.0])


def cast(
    device, volume: Volume, camera: Camera, labels: dict[str, Any] | None, memory=None, size=SIZE, **settings
) -> Rendering:
    style = SurfaceLook(300.0, **{"lighting": UNLIT, "color": "white", **(labels or {}), **settings})
    resident = DeviceVolume(volume, device=device, memory=memory)
    return cast_surface(resident, style, Shot(camera, size), 0.5 * min(volume.spacing))


def labelled(labels: LabelMap, colors: dict | None = None, opacity: dict | None = None) -> dict[str, Any]:
    return {"labels": labels, "label_colors": colors, "label_opacity": opacity}


def two_balls(grid: str, gap: float = 2.0) -> tuple[Volume, LabelMap]:
    """Label 1, a ball of 4 mm in front (smaller y), and behind it 2, one of 6 mm; `gap` mm apart."""
    fields = [lambda p: 4.0 - np.linalg.norm(p + (0, 4.0 + gap / 2, 0), axis=-1)]
    fields += [lambda p: 6.0 - np.linalg.norm(p - (0, 6.0 + gap / 2, 0), axis=-1)]
    volume = make_volume(lambda p: 300.0 + 60.0 * np.maximum(*(field(p) for field in fields)), grid, 32.0, np.int16)
    front, back = (field(positions(volume)) > -0.8 for field in fields)
    return volume, LabelMap(np.where(front, 1, np.where(back, 2, 0)).astype(np.uint8), volume.affine, NAMES)


def two_blocks() -> tuple[Volume, LabelMap]:
    """Blocks of 1000 HU that touch: label 1 where j < 10, label 2 from there on; a third of no label beside them."""
    voxels, numbers = np.full((16, 24, 30), -1000, np.int16), np.zeros((16, 24, 30), np.uint16)
    voxels[3:13, 4:16, 3:15] = voxels[3:13, 4:16, 20:26] = 1000
    numbers[3:13, 4:10, 3:15], numbers[3:13, 10:16, 3:15] = 1, 2
    volume = Volume(voxels, np.eye(4))
    return volume, LabelMap(numbers, volume.affine, NAMES)


def depth_of_ball(camera: Camera, centre: np.ndarray, radius: float) -> np.ndarray:
    origins, directions = camera.rays(SIZE)
    along = ((centre - origins) * directions).sum(axis=-1)
    passing = np.linalg.norm(centre - origins - along[..., None] * directions, axis=-1)
    with np.errstate(invalid="ignore"):
        return np.where(passing < 0.8 * radius, along - np.sqrt(radius**2 - passing**2), np.nan)


@pytest.mark.parametrize("grid", STEPS)
def test_translucent_label_shows_what_is_behind(device, grid):
    volume, labels = two_balls(grid)
    camera = look(volume, (0.0, 1.0, 0.1), 8.0)
    front, back = (depth_of_ball(camera, centre_of(volume) + (0, y, 0), r) for y, r in ((-5.0, 4.0), (7.0, 6.0)))
    both = np.isfinite(front) & np.isfinite(back)
    assert both.sum() > 60
    colors = {"L1": "red", "L2": "blue"}
    for opacity, color in ((1.0, RED), (0.25, 0.25 * RED + 0.75 * BLUE), (0.0, BLUE)):
        found = cast(device, volume, camera, labelled(labels, colors, {"L1": opacity}))
        assert np.abs(found.image[both][:, :3] - color).max() <= 1.0 and (found.image[both][:, 3] == 255).all()
        near = back if opacity == 0.0 else front
        assert np.abs(found.depth - near)[both].max() <= tolerances.SURFACE_RAY_VOXEL * max(volume.spacing)
        mean = opacity * front + (1.0 - opacity) * back
        assert np.abs(found.expected_depth - mean)[both].max() <= tolerances.SURFACE_RAY_VOXEL * max(volume.spacing)


def test_translucent_label_is_translucent_where_nothing_is_behind(device):
    volume, labels = two_balls("even")
    camera = look(volume, (1.0, 0.0, 0.0), 12.0)
    found = cast(device, volume, camera, labelled(labels, {}, {"L1": 0.4}))
    whole = cast(device, volume, camera, None)
    assert np.array_equal(np.isfinite(found.depth), np.isfinite(whole.depth))
    opacity, counts = np.unique(found.image[..., 3], return_counts=True)
    seen = set(opacity[counts > 20].tolist())
    assert seen == {0, 102, 255}
    assert (found.image[found.image[..., 3] > 0][:, :3] == 255).all()  # without colours all keep the picture's


def test_labels_that_touch_have_their_border(device):
    volume, labels = two_blocks()
    camera = look(volume, (0.0, 1.0, 0.0), 8.0)
    style = labelled(labels, {"L1": "red", "L2": "blue"}, {"L1": 0.0})
    found = cast(device, volume, camera, style, lighting=Lighting(0.2, 0.8, 0.0))
    # Rays run along +y: label 2 begins half way between rows 9 and 10; the camera is 150 mm before row 11.5.
    border = np.abs(found.depth - (150.0 + 9.5 - 11.5)) <= 0.5
    assert border.sum() > 400
    inner = found.image[
        border & np.roll(border, 2, 0) & np.roll(border, -2, 0) & np.roll(border, 2, 1) & np.roll(border, -2, 1)
    ]
    assert (inner == (0, 0, 255, 255)).all()  # seen head-on: its normal is that of the border


def test_surface_without_a_named_label_looks_as_without_labels(device):
    volume, labels = two_blocks()
    camera = look(volume, (0.1, 1.0, -0.2), 10.0)
    plain = cast(device, volume, camera, None, color="bone")
    assert np.array_equal(plain.image, cast(device, volume, camera, labelled(labels, {}), color="bone").image)
    red = cast(device, volume, camera, labelled(labels, {1: "red"}), color="bone")
    turned = (red.image != plain.image).any(axis=-1)
    assert 100 < turned.sum() < (plain.image[..., 3] > 0).sum() - 100
    assert (red.image[turned][:, :3] == (255, 0, 0)).all()


def test_labels_of_another_grid_are_brought_to_the_volume(device):
    volume, labels = two_blocks()
    coarse = LabelMap(labels.voxels[::2, ::2, ::2], np.diag([2.0, 2.0, 2.0, 1.0]), NAMES)
    camera, colors = look(volume, (0.1, 1.0, -0.2), 10.0), {"L1": "red", "L2": "blue"}
    fine, rough = (cast(device, volume, camera, labelled(which, colors)) for which in (labels, coarse))
    assert np.array_equal(fine.depth, rough.depth, equal_nan=True)
    assert (fine.image == rough.image).all(axis=-1).mean() > 0.8


def test_shadow_of_a_translucent_label_is_half_as_dark(device):
    volume, labels = two_balls("even", gap=3.0)
    camera = look(volume, (1.0, 1.0, 0.0), 12.0)
    light = Lighting(0.2, 0.8, 0.0, direction=(0.0, -1.0, 0.0))
    opaque, lit, half = (
        cast(device, volume, camera, labelled(labels, {}, {"L1": opacity}), lighting=light, shadows=shadows)
        for opacity, shadows in ((1.0, True), (1.0, False), (0.5, True))
    )
    dark = (opaque.image[..., 0] == 51) & (lit.image[..., 0] > 150)  # ambient alone, where the ball behind is in shadow
    assert dark.sum() > 20
    middle = 0.5 * (opaque.image[dark][:, 0].astype(float) + lit.image[dark][:, 0])
    assert np.median(np.abs(half.image[dark][:, 0] - middle)) <= 1.0


@pytest.mark.parametrize("towards", [(0.2, 0.3, 1.0), (0.1, 1.0, 0.2)])
def test_slabs_give_the_picture_of_the_whole(device, towards):
    volume, labels = two_balls("oblique")
    camera, style = look(volume, towards, 10.0, True), labelled(labels, None, {"L1": 0.3, "L2": 0.6})
    memory = 44 * SIZE[0] * SIZE[1] + volume.voxels.nbytes * 3 // 5
    whole = cast(device, volume, camera, style)
    parts = cast(device, volume, camera, style, memory)
    assert parts.report["slabs"] > 2
    away = np.abs(premultiplied(whole.image) - premultiplied(parts.image)).max(axis=-1)
    assert (away <= 1.0).mean() >= 1.0 - tolerances.SURFACE_TWIN_SHARE
    assert np.allclose(whole.depth, parts.depth, atol=1e-3, equal_nan=True)


@pytest.mark.oclgrind
def test_small_surface_of_labels_is_seen_under_the_simulator(device):
    volume, labels = two_blocks()
    style = labelled(labels, None, {"L1": 0.3, "L2": 0.6})
    clip = Clip.plane(centre_of(volume), (0.0, 0.5, 1.0))
    found = cast(
        device, volume, look(volume, (0.1, 1.0, -0.3), 8.0), style, size=(12, 9), clip=clip, shadows=True,
        lighting=Lighting(direction=(0.5, -0.5, 1.0)),
    )  # fmt: skip
    assert 20 < (found.image[..., 3] > 0).sum()


def test_surface_without_a_label_can_be_hidden(device):
    volume, labels = two_blocks()
    camera = Camera.fit(volume, "anterior")
    whole, left, faint = (
        cast(device, volume, camera, labelled(labels, {1: "red", 2: "blue"}, opacity))
        for opacity in (None, {0: 0.0}, {0: 0.5})
    )
    alone = (whole.image[..., :3].min(axis=-1) > 200) & (whole.image[..., 3] > 0)  # the block of no label is white
    assert alone.mean() > 0.02
    assert (left.image[alone, 3] == 0).mean() > 0.95  # but for the edge where the nearest voxel has a label
    red = (whole.image[..., 0] > 200) & (whole.image[..., 2] < 50)
    assert red.mean() > 0.05 and np.array_equal(left.image[red], whole.image[red])
    assert np.median(faint.image[alone, 3]) in range(120, 200)  # its front and its back


@pytest.mark.parametrize("grid", ["even", "oblique"])
def test_the_label_of_a_hit_is_that_of_meshes(device, grid):
    """A mask that is a voxel too small in places, as those of other programs are: no stripe is left without a label."""
    volume, labels = two_balls(grid)
    rng = np.random.default_rng(5)
    numbers = np.where(rng.random(labels.voxels.shape) < 0.4, 0, labels.voxels).astype(np.uint8)
    inside = find_solid(volume, numbers, 300.0)
    camera = look(volume, (0.3, 1.0, 0.2), 12.0)
    style = labelled(LabelMap(numbers, volume.affine, NAMES), {"L1": "red", "L2": "blue"})
    found = cast(device, volume, camera, style)
    hit = np.isfinite(found.depth)
    origins, directions = camera.rays(SIZE)
    places = volume.lps_to_ijk(origins[hit] + found.depth[hit][:, None] * directions[hit])
    corners = np.floor(places)[:, None, :] + np.array(list(np.ndindex(2, 2, 2)))
    index = corners.astype(int)
    away = np.linalg.norm(corners - places[:, None, :], axis=2)
    away[volume.voxels[index[..., 2], index[..., 1], index[..., 0]] < 300] = np.inf
    order = np.sort(away, axis=1)
    clear = order[:, 1] - order[:, 0] > 1e-2
    i, j, k = index[np.arange(len(index)), away.argmin(axis=1)].T
    expected = np.array([(255, 255, 255), tuple(RED), tuple(BLUE)])[inside[k, j, i]]
    assert clear.sum() > 200
    np.testing.assert_allclose(found.image[hit][clear, :3], expected[clear], atol=1)
    assert (inside[k, j, i] > 0).mean() > 0.98  # 2 % of the voxels have no labelled one around them


@pytest.mark.parametrize("grid", ["even", "oblique"])
def test_volume_rendering_leaves_no_fringe_around_a_label(device, grid):
    """A mask that ends a voxel before the bone, in the whole volume and in slabs."""
    volume = make_volume(lambda p: 300.0 + 60.0 * (8.0 - np.linalg.norm(p, axis=-1)), grid, 26.0, np.int16)
    ball = (np.linalg.norm(positions(volume), axis=-1) < 7.0).astype(np.uint8)
    bone = TransferFunction([(299.0, 1, 1, 1, 0.0), (301.0, 1, 1, 1, 0.6), (2000.0, 1, 1, 1, 0.6)])
    labels = LabelMap(ball, volume.affine)
    style = VolumeLook(bone, lighting=UNLIT, labels=labels, label_colors={1: "red"})
    shot = Shot(look(volume, (0.3, 1.0, 0.2), 10.0), SIZE)
    memory = 44 * SIZE[0] * SIZE[1] + volume.voxels.nbytes
    whole, parts = (
        take_picture(DeviceVolume(volume, device=device, memory=limit), style, shot, 0.3) for limit in (None, memory)
    )
    color, opacity = premultiplied(whole.image)[..., :3], whole.image[..., 3:] / 255.0
    seen = opacity[..., 0] > 0.3
    assert seen.sum() > 200 and parts.report["slabs"] > 2
    expected = np.broadcast_to((255.0, 51.0, 51.0), (seen.sum(), 3))  # 0.8 of red, 0.2 of the picture's white
    np.testing.assert_allclose(color[seen] / opacity[seen], expected, atol=4)
    assert np.abs(premultiplied(parts.image) - premultiplied(whole.image)).max() <= tolerances.RAY_SAME_255
