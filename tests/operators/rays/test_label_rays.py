"""Labels in pictures: colours, what is translucent and what is seen through it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from raycast_scenes import STEPS, centre_of, look, make_volume, positions, premultiplied

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
UNLIT = Lighting(ambient=1.0, diffuse=0.0, specular=0.0)
BYTES_A_PIXEL = 44  # of buffers of a picture
NAMES = {1: "vertebrae_L1", 2: "vertebrae_L2", 3: "rib_left_1"}
RED, BLUE = np.array([255.0, 0.0, 0.0]), np.array([0.0, 0.0, 255.0])


def cast_labels(
    device, volume: Volume, camera: Camera, labels: dict[str, Any] | None, *, memory=None, size=SIZE, **settings
) -> Rendering:
    """The surface at 300 HU with `label_options`, without light and white unless `settings` say otherwise."""
    style = SurfaceLook(300.0, **{"lighting": UNLIT, "color": "white", **(labels or {}), **settings})
    resident = DeviceVolume(volume, device=device, memory=memory)
    return cast_surface(resident, style, Shot(camera, size), 0.5 * min(volume.spacing))


def label_options(labels: LabelMap, colors: dict | None = None, opacity: dict | None = None) -> dict[str, Any]:
    return {"labels": labels, "label_colors": colors, "label_opacity": opacity}


def two_balls(grid: str, gap: float = 2.0) -> tuple[Volume, LabelMap]:
    """Label 1, a ball of 4 mm in front (smaller y), and behind it 2, one of 6 mm; `gap` mm apart."""
    fields = [lambda p: 4.0 - np.linalg.norm(p + (0, 4.0 + gap / 2, 0), axis=-1)]
    fields += [lambda p: 6.0 - np.linalg.norm(p - (0, 6.0 + gap / 2, 0), axis=-1)]
    values = lambda p: 300.0 + 60.0 * np.maximum(*(field(p) for field in fields))  # noqa: E731
    volume = make_volume(values, grid, extent=32.0, dtype=np.int16)
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
    """Where each pixel's ray enters a ball, by analysis, in mm; NaN where it passes off the inner 0.8 of the radius."""
    origins, directions = camera.rays(SIZE)
    along = ((centre - origins) * directions).sum(axis=-1)
    passing = np.linalg.norm(centre - origins - along[..., None] * directions, axis=-1)
    with np.errstate(invalid="ignore"):
        return np.where(passing < 0.8 * radius, along - np.sqrt(radius**2 - passing**2), np.nan)


@pytest.fixture(params=STEPS)
def balls_behind_each_other(request):
    """Two balls on a grid, a camera before them, the depths of both by analysis, and the pixels that both cover."""
    volume, labels = two_balls(request.param)
    camera = look(volume, (0.0, 1.0, 0.1), half_height=8.0)
    front, back = (depth_of_ball(camera, centre_of(volume) + (0, y, 0), r) for y, r in ((-5.0, 4.0), (7.0, 6.0)))
    both = np.isfinite(front) & np.isfinite(back)
    assert both.sum() > 60  # enough pixels to judge: measured 162
    return volume, labels, camera, front, back, both


OPACITIES = pytest.mark.parametrize("opacity", [1.0, 0.25, 0.0], ids=["opaque", "translucent", "hidden"])


@OPACITIES
def test_colour_of_a_label_is_mixed_with_that_behind_by_its_opacity(device, balls_behind_each_other, opacity):
    volume, labels, camera, _, _, both = balls_behind_each_other
    options = label_options(labels, colors={"L1": "red", "L2": "blue"}, opacity={"L1": opacity})
    image = cast_labels(device, volume, camera, options).image[both]
    assert np.abs(image[:, :3] - (opacity * RED + (1.0 - opacity) * BLUE)).max() <= tolerances.RAY_SAME_255
    assert (image[:, 3] == 255).all()


@OPACITIES
def test_depth_of_a_label_is_that_of_the_first_that_is_seen(device, balls_behind_each_other, opacity):
    volume, labels, camera, front, back, both = balls_behind_each_other
    found = cast_labels(device, volume, camera, label_options(labels, opacity={"L1": opacity}))
    first_seen = back if opacity == 0.0 else front
    limit = tolerances.SURFACE_RAY_VOXEL * max(volume.spacing)
    assert np.abs(found.depth - first_seen)[both].max() <= limit
    assert np.abs(found.expected_depth - (opacity * front + (1.0 - opacity) * back))[both].max() <= limit


@pytest.fixture(scope="module")
def balls_side_by_side(device):
    """A ball of label 1 with an opacity of 0.4 beside an opaque one, and both as one surface without labels."""
    volume, labels = two_balls("even")
    camera = look(volume, (1.0, 0.0, 0.0), half_height=12.0)
    found = cast_labels(device, volume, camera, label_options(labels, colors={}, opacity={"L1": 0.4}))
    return found, cast_labels(device, volume, camera, None)


def test_translucent_label_is_translucent_where_nothing_is_behind(balls_side_by_side):
    found, whole = balls_side_by_side
    assert np.array_equal(np.isfinite(found.depth), np.isfinite(whole.depth))
    opacity, counts = np.unique(found.image[..., 3], return_counts=True)
    assert opacity[counts > 20].tolist() == [0, 0.4 * 255, 255]  # other pixels are where a ray grazes


def test_labels_without_colours_keep_the_colour_of_the_picture(balls_side_by_side):
    found, _ = balls_side_by_side
    seen = found.image[found.image[..., 3] > 0]
    assert len(seen) > 100  # pixels of the balls
    assert (seen[:, :3] == 255).all()


def test_border_of_a_label_whose_neighbour_is_hidden_is_seen_head_on_half_way_between_their_voxels(device):
    """Rays run along +y: label 2 begins half way between rows 9 and 10; the camera is 200 mm before row 11.5."""
    volume, labels = two_blocks()
    options = label_options(labels, colors={"L1": "red", "L2": "blue"}, opacity={"L1": 0.0})
    camera = look(volume, (0.0, 1.0, 0.0), half_height=8.0)
    found = cast_labels(device, volume, camera, options, lighting=Lighting(ambient=0.2, diffuse=0.8, specular=0.0))
    border = np.abs(found.depth - (200.0 + 9.5 - 11.5)) <= 0.5
    assert border.sum() > 400  # measured 432
    inner = border.copy()  # two pixels from its edge
    for axis in (0, 1):
        inner &= np.roll(border, 2, axis) & np.roll(border, -2, axis)
    assert (found.image[inner] == (0, 0, 255, 255)).all()  # full light: its normal is that of the border


@pytest.fixture(scope="module")
def blocks_of_bone(device):
    """Two blocks in the colour of bone: a function of label options, and the picture without labels."""
    volume, labels = two_blocks()
    camera = look(volume, (0.1, 1.0, -0.2), half_height=10.0)

    def take(colors):
        return cast_labels(device, volume, camera, label_options(labels, colors), color="bone").image

    return take, cast_labels(device, volume, camera, None, color="bone").image


def test_surface_of_labels_without_colours_looks_as_without_labels(blocks_of_bone):
    take, plain = blocks_of_bone
    assert np.array_equal(take(colors={}), plain)


def test_colour_of_a_label_changes_its_pixels_alone(blocks_of_bone):
    take, plain = blocks_of_bone
    red = take(colors={1: "red"})
    changed = (red != plain).any(axis=-1)
    assert 100 < changed.sum() < (plain[..., 3] > 0).sum() - 100  # some of the surface, and not all
    assert (red[changed][:, :3] == (255, 0, 0)).all()


def test_labels_of_a_grid_half_as_fine_colour_most_pixels_of_the_same_surface_alike(device):
    volume, labels = two_blocks()
    coarse = LabelMap(labels.voxels[::2, ::2, ::2], np.diag([2.0, 2.0, 2.0, 1.0]), NAMES)
    camera, colors = look(volume, (0.1, 1.0, -0.2), half_height=10.0), {"L1": "red", "L2": "blue"}
    by_fine, by_coarse = (cast_labels(device, volume, camera, label_options(each, colors)) for each in (labels, coarse))
    assert np.array_equal(by_fine.depth, by_coarse.depth, equal_nan=True)
    assert (by_fine.image == by_coarse.image).all(axis=-1).mean() > 0.8  # but the borders of labels


def test_shadow_of_a_label_with_an_opacity_of_a_half_is_half_as_dark(device):
    volume, labels = two_balls("even", gap=3.0)
    camera = look(volume, (1.0, 1.0, 0.0), half_height=12.0)
    ambient = 0.2
    light = Lighting(ambient, diffuse=0.8, specular=0.0, direction=(0.0, -1.0, 0.0))

    def take_red(*, opacity, shadows):
        options = label_options(labels, colors={}, opacity={"L1": opacity})
        found = cast_labels(device, volume, camera, options, lighting=light, shadows=shadows)
        return found.image[..., 0].astype(float)

    in_shadow, lit = (take_red(opacity=1.0, shadows=shadows) for shadows in (True, False))
    half = take_red(opacity=0.5, shadows=True)
    dark = (in_shadow == ambient * 255) & (lit > 150)  # of the ball behind
    assert dark.sum() > 20  # measured 75
    assert np.median(np.abs(half - 0.5 * (in_shadow + lit))[dark]) <= tolerances.RAY_SAME_255


@pytest.mark.parametrize("towards", [(0.2, 0.3, 1.0), (0.1, 1.0, 0.2)], ids=["across slices", "along slices"])
def test_slabs_give_the_picture_of_translucent_labels_of_the_whole(device, towards):
    volume, labels = two_balls("oblique")
    camera = look(volume, towards, half_height=10.0, perspective=True)
    options = label_options(labels, opacity={"L1": 0.3, "L2": 0.6})
    memory = BYTES_A_PIXEL * SIZE[0] * SIZE[1] + volume.voxels.nbytes * 3 // 5
    whole = cast_labels(device, volume, camera, options)
    parts = cast_labels(device, volume, camera, options, memory=memory)
    assert parts.report["slabs"] > 2
    away = np.abs(premultiplied(whole.image) - premultiplied(parts.image)).max(axis=-1)
    assert (away <= tolerances.RAY_SAME_255).mean() >= 1.0 - tolerances.SURFACE_TWIN_SHARE
    assert np.allclose(whole.depth, parts.depth, atol=tolerances.SLICE_DEPTH_MM, equal_nan=True)


@pytest.mark.oclgrind
def test_small_surface_of_labels_clipped_and_in_shadow_is_seen(device):
    volume, labels = two_blocks()
    style = label_options(labels, opacity={"L1": 0.3, "L2": 0.6})
    clip = Clip.plane(centre_of(volume), (0.0, 0.5, 1.0))
    found = cast_labels(
        device, volume, look(volume, (0.1, 1.0, -0.3), half_height=8.0), style, size=(12, 9), clip=clip, shadows=True,
        lighting=Lighting(direction=(0.5, -0.5, 1.0)),
    )  # fmt: skip
    assert 20 < (found.image[..., 3] > 0).sum()  # measured 31 of 108


@pytest.fixture(scope="module")
def unlabelled_block(device):
    """Pictures by the opacity of what has no label; pixels of the block without a label, and of the red one."""
    volume, labels = two_blocks()
    camera = Camera.fit(volume, "anterior")

    def take(opacity):
        options = label_options(labels, colors={1: "red", 2: "blue"}, opacity=opacity)
        return cast_labels(device, volume, camera, options).image

    whole = take(None)
    white = (whole[..., :3].min(axis=-1) > 200) & (whole[..., 3] > 0)
    red = (whole[..., 0] > 200) & (whole[..., 2] < 50)
    assert white.mean() > 0.02  # measured 0.058
    assert red.mean() > 0.05  # measured 0.117
    return take, whole, white, red


def test_surface_without_a_label_is_hidden_by_an_opacity_of_0_and_labels_stay(unlabelled_block):
    take, whole, white, red = unlabelled_block
    hidden = take({0: 0.0})
    assert (hidden[white, 3] == 0).mean() > 0.95  # but for the edge where the nearest voxel has a label
    assert np.array_equal(hidden[red], whole[red])


def test_surface_without_a_label_is_translucent_by_an_opacity_of_a_half(unlabelled_block):
    take, _, white, _ = unlabelled_block
    opacity = np.median(take({0: 0.5})[white, 3])
    assert 0.5 * 255 <= opacity + 1 <= 0.75 * 255 + 2  # its front alone, or its back too


@pytest.fixture(params=["even", "oblique"])
def holey_mask(request, device):
    """Where rays hit two balls whose mask lacks voxels, as those of other programs do: image, labels, if clear.

    A hit has the label, grown as for meshes, of the nearest voxel inside; it is clear where the second is farther.
    """
    volume, labels = two_balls(request.param)
    numbers = np.where(np.random.default_rng(5).random(labels.voxels.shape) < 0.4, 0, labels.voxels).astype(np.uint8)
    camera = look(volume, (0.3, 1.0, 0.2), half_height=12.0)
    options = label_options(LabelMap(numbers, volume.affine, NAMES), {"L1": "red", "L2": "blue"})
    found = cast_labels(device, volume, camera, options)

    hit = np.isfinite(found.depth)
    origins, directions = camera.rays(SIZE)
    places = volume.lps_to_ijk(origins[hit] + found.depth[hit][:, None] * directions[hit])
    corners = np.floor(places)[:, None, :] + np.array(list(np.ndindex(2, 2, 2)))
    index = corners.astype(int)
    away = np.linalg.norm(corners - places[:, None, :], axis=2)
    away[volume.voxels[index[..., 2], index[..., 1], index[..., 0]] < 300] = np.inf
    nearest, second = np.sort(away, axis=1)[:, :2].T
    i, j, k = index[np.arange(len(index)), away.argmin(axis=1)].T
    return found.image[hit], find_solid(volume, numbers, 300.0)[k, j, i], second - nearest > 1e-2


def test_colour_of_a_hit_is_that_of_the_label_that_meshes_have_there(holey_mask):
    image, hit_labels, clear = holey_mask
    assert clear.sum() > 200  # measured 274
    colors = np.array([(255, 255, 255), tuple(RED), tuple(BLUE)])[hit_labels]
    np.testing.assert_allclose(image[clear, :3], colors[clear], atol=1)  # of 255: rounding; measured 0


def test_nearly_every_hit_has_a_label_although_the_mask_lacks_voxels(holey_mask):
    _, hit_labels, _ = holey_mask
    assert (hit_labels > 0).mean() > 0.98  # 2 % of the voxels have no labelled one around them


@pytest.fixture(params=["even", "oblique"])
def red_ball(request, device):
    """A ball of 8 mm by volume rendering, whole and in slabs, whose red label ends at 7 mm, before the bone."""
    values = lambda p: 300.0 + 60.0 * (8.0 - np.linalg.norm(p, axis=-1))  # noqa: E731
    volume = make_volume(values, request.param, extent=26.0, dtype=np.int16)
    mask = (np.linalg.norm(positions(volume), axis=-1) < 7.0).astype(np.uint8)
    bone = TransferFunction([(299.0, 1, 1, 1, 0.0), (301.0, 1, 1, 1, 0.6), (2000.0, 1, 1, 1, 0.6)])
    labels = LabelMap(mask, volume.affine)
    style = VolumeLook(bone, lighting=UNLIT, labels=labels, label_colors={1: "red"})
    shot = Shot(look(volume, (0.3, 1.0, 0.2), half_height=10.0), SIZE)
    memory = BYTES_A_PIXEL * SIZE[0] * SIZE[1] + volume.voxels.nbytes  # labels do not fit beside it
    residents = (DeviceVolume(volume, device=device, memory=limit) for limit in (None, memory))
    return [take_picture(resident, style, shot, ray_step=0.3) for resident in residents]


def test_volume_rendering_leaves_no_fringe_around_a_label_that_ends_before_the_bone(red_ball):
    whole, _ = red_ball
    color, opacity = premultiplied(whole.image)[..., :3], whole.image[..., 3:] / 255.0
    seen = opacity[..., 0] > 0.3
    assert seen.sum() > 200  # measured 648
    mixed = 0.8 * RED + 0.2 * 255.0  # with the picture's white
    expected = np.broadcast_to(mixed, (seen.sum(), 3))
    np.testing.assert_allclose(color[seen] / opacity[seen], expected, atol=tolerances.LABEL_COLOR_255)


def test_volume_rendering_of_a_label_in_slabs_is_that_of_the_whole(red_ball):
    whole, parts = red_ball
    assert parts.report["slabs"] > 2
    assert np.abs(premultiplied(parts.image) - premultiplied(whole.image)).max() <= tolerances.RAY_SAME_255
