"""Pictures of points: against their twin, against known discs, in parts, and what cannot be shown."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused
from variants import each_value

import clrecon
from clrecon.errors import DeviceError, UsageError
from clrecon.operators.rays.picture_buffers import Shot
from clrecon.operators.rays.point_pictures import (
    LARGEST_DISC,
    MOST_NAMED,
    MOST_PIXELS,
    Discs,
    PointPictures,
    cloud_box,
    draw_splats,
)
from clrecon.points.cloud import PointCloud
from clrecon.proof.rays.objects import find_splats, shade_splats
from clrecon.rendering import UNSHADED, Lighting
from clrecon.rendering.pictures.object_looks import PointLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

SIZE = (61, 47)
FRONT = Camera((0.0, -50.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=11.75)
"""Half a mm a pixel, y into the picture."""


def ball(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points on a ball of 8 mm with some noise, and unit normals."""
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return (normals * (8.0 + rng.normal(0.0, 0.1, (count, 1)))).astype(np.float32), normals.astype(np.float32)


CAMERAS = {
    "parallel": Camera((30.0, -60.0, 25.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=9.0),
    "perspective": Camera((9.0, -16.0, 6.0), (0.0, 1.0, 0.0), (0.1, 0.0, 1.0), view_angle=50.0),
    "inside": Camera((1.0, -3.0, 0.5), (0.0, 5.0, 0.0), (0.1, 0.0, 1.0), view_angle=70.0),
    "inside, parallel": Camera((1.0, -3.0, 0.5), (0.0, 5.0, 0.0), (0.1, 0.0, 1.0), parallel_scale=9.0),
}


@pytest.mark.parametrize(("name", "radius"), each_value(CAMERAS, [0.01, 0.4, 2.0]))
def test_every_pixel_shows_the_point_and_depth_of_the_twin(device: Any, name: str, radius: float) -> None:
    points, _ = ball(300)
    camera = CAMERAS[name]
    depth, numbers = find_splats(points, camera, SIZE, radius)
    colors = np.zeros((len(points), 4), np.uint8)
    colors[:, :2] = np.arange(len(points), dtype="<u2").view(np.uint8).reshape(-1, 2)  # the number as a colour
    colors[:, 2:] = 255
    found = draw_splats(device, Discs(points, colors, None, radius, UNSHADED), Shot(camera, SIZE))
    assert (numbers >= 0).any() and (numbers < 0).any() or "inside" in name
    shown = np.where(
        found.image[..., 3] > 0, found.image[..., 0].astype(int) + 256 * found.image[..., 1].astype(int), -1
    )
    assert np.array_equal(shown, numbers)
    assert np.array_equal(np.isnan(found.depth), numbers < 0)
    _, expected = shade_splats(depth, numbers, colors[:, :3] / 255.0, None, camera, UNSHADED, 1)
    assert np.allclose(found.depth, expected, rtol=0.0, atol=tolerances.SPLAT_DEPTH_MM, equal_nan=True)


@pytest.mark.every_device
@pytest.mark.parametrize(
    "lighting",
    [
        pytest.param(Lighting(), marks=pytest.mark.oclgrind),
        Lighting(ambient=0.1, diffuse=0.7, specular=0.5, specular_power=20.5, direction=(0.4, -1.0, 0.8)),
        UNSHADED,
    ],
)
@pytest.mark.parametrize("has_normals", [True, False])
def test_light_of_points_is_that_of_the_twin(device: Any, has_normals: bool, lighting: Lighting) -> None:
    points, normals = ball(700)
    rng = np.random.default_rng(3)
    colors = rng.integers(0, 256, (len(points), 4)).astype(np.uint8)
    normals[::50] = 0.0  # no direction: full diffuse light
    own, radius_mm = normals if has_normals else None, 0.6
    for camera in (CAMERAS["parallel"], CAMERAS["perspective"]):
        found = draw_splats(device, Discs(points, colors, own, radius_mm, lighting), Shot(camera, SIZE, "navy"))
        depth, numbers = find_splats(points, camera, SIZE, radius_mm)
        # Neighbours of eye-dome lighting lie beyond a point's own disc, 1 to 8 pixels away.
        apart = int(np.clip(round(radius_mm / camera.pixel_mm(SIZE)), 1, 8))
        rgba, _ = shade_splats(depth, numbers, colors[:, :3] / 255.0, own, camera, lighting, apart)
        image = np.where(rgba[..., 3:] > 0.0, 255.0 * rgba[..., :3], (0.0, 0.0, 128.0))  # navy
        assert np.abs(found.image[..., :3] - image).max() <= tolerances.SPLAT_COLOR_LEVELS
        assert (found.image[..., 3] == 255).all()
        assert found.shading == ("none" if not lighting.shades else "normals" if has_normals else "depths")


@pytest.fixture(scope="module")
def two_discs(device: Any) -> Any:
    """Discs of 3 mm at depth 45, two in one place, and 60, to the right; mm of each pixel from the middle."""
    points = np.array([(0, 0, 0), (0, -5, 0), (0, -5, 0), (3.1, 10, 0)], np.float32)
    cloud = PointCloud(points, labels=[7, 3, 5, 1])
    look = PointLook(radius_mm=3.0, lighting=UNSHADED)
    picture = clrecon.render(cloud, look, camera=FRONT, size=(95, 47), device=device)
    x, z = np.meshgrid(0.5 * (np.arange(95) - 47.0), 0.5 * (23.0 - np.arange(47)))
    return picture, x, z


def test_disc_of_a_point_covers_its_radius_and_hides_farther_ones(two_discs: Any) -> None:
    picture, x, z = two_discs
    near, far = x * x + z * z <= 3.0**2, (x - 3.1) ** 2 + z * z <= 3.0**2
    assert np.array_equal(picture.depth == 50.0 - 5.0, near)
    assert np.array_equal(picture.depth == 50.0 + 10.0, far & ~near)
    assert np.isnan(picture.depth[~near & ~far]).all()


def test_first_of_points_in_one_place_is_seen_in_the_colour_of_the_legend(two_discs: Any) -> None:
    picture, _, _ = two_discs
    color_of = {entry["label"]: entry["color"] for entry in picture.report["legend"]}
    middle, right = picture.image[23, 47, :3], picture.image[23, 55, :3]  # of 47 x 95 pixels; 4 mm to the right
    assert "#" + middle.tobytes().hex() == color_of[3]
    assert "#" + right.tobytes().hex() == color_of[1]


def test_legend_counts_the_points_of_each_label(two_discs: Any) -> None:
    picture, _, _ = two_discs
    assert [entry["points"] for entry in picture.report["legend"]] == [1, 1, 1, 1]


def test_picture_of_points_has_one_depth_and_no_values(two_discs: Any) -> None:
    picture, _, _ = two_discs
    assert picture.expected_depth is picture.depth
    assert picture.values is None


def test_points_smaller_than_a_pixel_are_seen(device: Any) -> None:
    places = np.random.default_rng(4).uniform(-10.0, 10.0, (500, 3)).astype(np.float32)
    picture = clrecon.render(PointCloud(places), radius_mm=1e-6, camera=FRONT, size=(47, 47), device=device)
    pixels, _ = FRONT.project(places, (47, 47))
    column, row = np.floor(pixels).astype(int).T
    assert np.isfinite(picture.depth[row, column]).all()
    assert np.isfinite(picture.depth).mean() < 0.5  # measured 0.29


MANY = 250_000


@pytest.fixture(params=["parallel", "perspective"])
def many_discs(request: pytest.FixtureRequest) -> Any:
    """Discs of 250,000 points, and a shot of them."""
    points, normals = ball(MANY)
    colors = np.full((MANY, 4), 255, np.uint8)
    colors[:, 0] = np.arange(MANY) % 256
    discs = Discs(points, colors, normals, radius_mm=0.5, lighting=Lighting())
    return discs, Shot(CAMERAS[request.param], SIZE)


PICTURE_BYTES = 16 * SIZE[0] * SIZE[1]
POINT_BYTES = 3 * 4 + 4 + 3 * 4  # place, colour and normal


def test_points_in_parts_give_the_same_picture_and_progress_after_each(device: Any, many_discs: Any) -> None:
    discs, shot = many_discs
    whole = draw_splats(device, discs, shot)
    calls: list[tuple[str, int, int]] = []
    part = 80_000
    memory = PICTURE_BYTES + POINT_BYTES * part
    parts = draw_splats(device, discs, shot._replace(progress=lambda *call: calls.append(call)), memory=memory)
    assert (whole.parts, parts.parts) == (1, 4)
    assert parts.image.tobytes() == whole.image.tobytes()
    assert parts.depth.tobytes() == whole.depth.tobytes()
    passes, ends = 3, [part, 2 * part, 3 * part, MANY]
    done = [0, *(MANY * number + end for number in range(passes) for end in ends)]
    assert calls == [("points", count, passes * MANY) for count in done]


def test_permuted_points_give_the_same_picture(device: Any, many_discs: Any) -> None:
    discs, shot = many_discs
    order = np.random.default_rng(5).permutation(MANY)
    shuffled = discs._replace(points=discs.points[order], colors=discs.colors[order], normals=discs.normals[order])
    assert draw_splats(device, shuffled, shot).image.tobytes() == draw_splats(device, discs, shot).image.tobytes()


def test_points_without_room_beside_their_picture_are_refused(device: Any, many_discs: Any) -> None:
    discs, shot = many_discs
    with refused(DeviceError, "points"):
        draw_splats(device, discs, shot, memory=PICTURE_BYTES + 1000)


def test_a_cloud_far_from_the_origin_looks_as_the_same_points_near_it(device: Any) -> None:
    points, normals = ball(3000)
    near = clrecon.render(PointCloud(points, normals), size=SIZE, view=(20, 30), radius_mm=0.5, device=device)
    away = PointCloud(points.astype(np.float64) + 1e5, normals)
    assert away.points.dtype == np.float64
    far = clrecon.render(away, size=SIZE, view=(20, 30), radius_mm=0.5, device=device)
    assert (np.abs(far.image.astype(int) - near.image).max(axis=-1) > 2).mean() < tolerances.FAR_SPLAT_SHARE


FOUR = np.array([(x, 0, 0) for x in (-6, -2, 2, 6)], np.float32)


def colors_of_four(device: Any, **look: Any) -> tuple[list[tuple[int, ...]], dict[str, Any]]:
    """Return the colours of four points from 0 to 300 HU, labelled noise, 0, "sheet" and 0, and the report."""
    cloud = PointCloud(FOUR, hu=[0, 100, 200, 300], labels=[-1, 0, 2, 0], report={"label_names": {2: "sheet"}})
    own = PointLook(radius_mm=1.0, lighting=UNSHADED, **look)
    picture = clrecon.render(cloud, own, camera=FRONT, size=(47, 47), device=device)
    middle_row, columns = 23, 23 + 2 * FOUR[:, 0].astype(int)  # of 47 x 47 pixels of half a mm
    return [tuple(picture.image[middle_row, at, :3].tolist()) for at in columns], picture.report


def test_points_are_grey_by_their_hu_within_the_window(device: Any) -> None:
    """0, 100, 200 and 300 HU in a window of 0 to 200."""
    colors, report = colors_of_four(device, color_by="hu", window=(0, 200))
    assert colors == [(0,) * 3, (128,) * 3, (255,) * 3, (255,) * 3]
    assert report["window_hu"] == (0.0, 200.0)


NOISE_GREY, KEPT_GREY = (112,) * 3, (160,) * 3


def test_points_have_the_colours_of_their_labels_and_noise_is_grey(device: Any) -> None:
    (noise, first, sheet, second), report = colors_of_four(device)
    assert report["color_by"] == "label"
    assert noise == NOISE_GREY
    assert first == second != sheet


def test_legend_of_labels_has_their_numbers_names_and_points(device: Any) -> None:
    _, report = colors_of_four(device)
    legend = [(entry["label"], entry["name"], entry["points"]) for entry in report["legend"]]
    assert legend == [(-1, "noise", 1), (0, None, 2), (2, "sheet", 1)]


def test_kept_points_are_grey_beside_coloured_removed_ones(device: Any) -> None:
    """Label 0 stands for points that are kept, others for the reasons of removal."""
    (_, first_kept, removed, second_kept), report = colors_of_four(device, color_by="removed")
    assert first_kept == second_kept == KEPT_GREY
    assert removed not in (KEPT_GREY, NOISE_GREY)
    assert [entry["name"] for entry in report["legend"]] == [None, "kept", "sheet"]


def test_points_have_the_one_colour_that_is_given(device: Any) -> None:
    colors, _ = colors_of_four(device, color="red")
    assert colors == [(255, 0, 0)] * 4


@pytest.mark.parametrize(("hu", "color_by"), [(None, "none"), ([0, 100, 200, 300], "hu")])
def test_points_without_labels_are_coloured_by_hu_if_they_have_some(device: Any, hu: Any, color_by: str) -> None:
    assert clrecon.render(PointCloud(FOUR, hu=hu), size=SIZE, device=device).report["color_by"] == color_by


def test_legend_names_the_largest_labels_and_counts_the_rest(device: Any) -> None:
    many = PointCloud(np.repeat(FOUR, 10, axis=0), labels=np.arange(40))
    report = clrecon.render(many, size=SIZE, device=device).report
    assert len(report["legend"]) == MOST_NAMED
    assert report["legend_left_out"] == 40 - MOST_NAMED


def test_labels_as_far_apart_as_32_bits_are_told_apart(device: Any) -> None:
    wide = clrecon.render(PointCloud(FOUR, labels=[5, -(2**31), 2**31 - 1, 5]), size=SIZE, device=device)
    assert [entry["points"] for entry in wide.report["legend"]] == [1, 2, 1]


@pytest.fixture(scope="module")
def ball_cloud() -> PointCloud:
    """Points on a ball of 8 mm, whose HU are their x."""
    points, normals = ball(3000)
    return PointCloud(points, normals, hu=points[:, 0])


def test_picture_of_a_clipped_cloud_is_that_of_the_points_that_are_kept(device: Any, ball_cloud: PointCloud) -> None:
    upper_half = Clip.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    found = clrecon.render(ball_cloud, camera=FRONT, size=SIZE, radius_mm=0.5, clip=upper_half, device=device)
    kept = ball_cloud.select(ball_cloud.points[:, 2] >= 0.0)
    window = found.report["window_hu"]
    alone = clrecon.render(kept, camera=FRONT, size=SIZE, radius_mm=0.5, window=window, device=device)
    assert found.image.tobytes() == alone.image.tobytes()


def test_picture_of_a_cloud_that_is_clipped_away_is_its_background(device: Any, ball_cloud: PointCloud) -> None:
    beyond = Clip.plane((0.0, 0.0, 99.0), (0.0, 0.0, 1.0))
    empty = clrecon.render(ball_cloud, camera=FRONT, size=SIZE, clip=beyond, background="red", device=device)
    assert np.isnan(empty.depth).all()
    assert (empty.image == (255, 0, 0, 255)).all()


@pytest.mark.parametrize(
    "place", [{"view": "left"}, {"view": (20, 30), "view_angle": 40.0}, {"view": "superior", "zoom": 0.5}]
)
def test_the_camera_sees_the_whole_cloud(device: Any, place: dict[str, Any]) -> None:
    points, _ = ball(3000)
    camera = clrecon.render(PointCloud(points), size=SIZE, device=device, **place).camera
    pixels, _ = camera.project(points, SIZE)
    assert ((0 < pixels) & (pixels < SIZE)).all()


def test_box_of_a_single_point_has_a_size(device: Any) -> None:
    box = cloud_box(PointCloud([(1.0, 2.0, 3.0)]))
    assert np.allclose(box.affine[:3, 3], (1.0, 2.0, 3.0))
    assert min(box.spacing) > 0.0


def test_a_single_point_is_seen(device: Any) -> None:
    assert np.isfinite(clrecon.render(PointCloud([(1.0, 2.0, 3.0)]), size=SIZE, device=device).depth).any()


SMALL_CLOUD = PointCloud(*ball(50))


@pytest.mark.parametrize(
    ("shown", "style", "options", "facts"),
    [
        (PointCloud(np.empty((0, 3))), None, {}, ("nothing",)),
        (SMALL_CLOUD, None, {"color_by": "removed"}, ("color_by", "labels")),
        (SMALL_CLOUD, None, {"color_by": "hu"}, ("color_by",)),
        (SMALL_CLOUD, "mip", {}, ("point", "cloud")),
        (clrecon.Volume(np.zeros((4, 4, 4), np.int16), np.eye(4)), PointLook(), {}, ("volume", "cloud")),
    ],
    ids=["no points", "no labels", "no HU", "mode of volumes", "volume as points"],
)
def test_pictures_of_points_that_cannot_be_made_are_refused(
    device: Any, shown: Any, style: Any, options: dict[str, Any], facts: tuple[str, ...]
) -> None:
    with refused(UsageError, *facts):
        clrecon.render(shown, style, **options, device=device)


def test_pictures_of_points_with_no_memory_are_refused(device: Any) -> None:
    with refused(UsageError, "number"):
        PointPictures(SMALL_CLOUD, device=device, memory=0)


def test_discs_of_few_points_larger_than_are_drawn_are_warned_of(device: Any) -> None:
    near = clrecon.render(SMALL_CLOUD, camera=FRONT, size=(64, 64), radius_mm=80.0, device=device)
    assert f"are drawn with {LARGEST_DISC:g}" in near.report["warnings"][-1]  # pixels


def test_large_discs_of_a_few_points_more_than_are_drawn_are_refused(device: Any) -> None:
    too_many = int(MOST_PIXELS / (np.pi * LARGEST_DISC**2)) + 1  # their discs have more pixels than the most
    many = PointCloud(*ball(too_many))
    with refused(UsageError, "radius", "zoom", too_many):
        clrecon.render(many, camera=FRONT, size=(64, 64), radius_mm=80.0, device=device)
