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
from clrecon.operators.rays.point_pictures import MOST_NAMED, Discs, PointPictures, cloud_box, draw_splats
from clrecon.points import PointCloud
from clrecon.proof.rays.objects import find_splats, shade_splats
from clrecon.rendering import UNSHADED, Lighting
from clrecon.rendering.pictures.object_looks import PointLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

SIZE = (61, 47)
FRONT = Camera((0.0, -50.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=11.75)
"""Half a mm a pixel, y into the picture."""


def ball(count: int = 3000, radius: float = 8.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return points on a ball with some noise, and unit normals."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return (normals * (radius + rng.normal(0.0, 0.1, (count, 1)))).astype(np.float32), normals.astype(np.float32)


CAMERAS = {
    "parallel": Camera((30.0, -60.0, 25.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=9.0),
    "perspective": Camera((9.0, -16.0, 6.0), (0.0, 1.0, 0.0), (0.1, 0.0, 1.0), view_angle=50.0),
    "inside": Camera((1.0, -3.0, 0.5), (0.0, 5.0, 0.0), (0.1, 0.0, 1.0), view_angle=70.0),
    "inside, parallel": Camera((1.0, -3.0, 0.5), (0.0, 5.0, 0.0), (0.1, 0.0, 1.0), parallel_scale=9.0),
}


@pytest.mark.parametrize(("name", "radius"), each_value(CAMERAS, [0.01, 0.4, 2.0]))
def test_every_pixel_shows_the_point_of_the_twin(device: Any, name: str, radius: float) -> None:
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
    expected = shade_splats(depth, numbers, colors[:, :3] / 255.0, None, camera, UNSHADED, 1)[1]
    assert np.allclose(found.depth, expected, rtol=0.0, atol=tolerances.SPLAT_DEPTH_MM, equal_nan=True)


@pytest.mark.every_device
@pytest.mark.parametrize(
    "lighting",
    [
        pytest.param(Lighting(), marks=pytest.mark.oclgrind),
        Lighting(0.1, 0.7, 0.5, 20.5, direction=(0.4, -1.0, 0.8)),
        UNSHADED,
    ],
)
@pytest.mark.parametrize("has_normals", [True, False])
def test_the_light_is_that_of_the_twin(device: Any, has_normals: bool, lighting: Lighting) -> None:
    points, normals = ball(700)
    rng = np.random.default_rng(3)
    colors = rng.integers(0, 256, (len(points), 4)).astype(np.uint8)
    normals[::50] = 0.0  # no direction: full diffuse light
    own = normals if has_normals else None
    for camera in (CAMERAS["parallel"], CAMERAS["perspective"]):
        found = draw_splats(device, Discs(points, colors, own, 0.6, lighting), Shot(camera, SIZE, "navy"))
        depth, numbers = find_splats(points, camera, SIZE, 0.6)
        apart = int(np.clip(round(0.6 / camera.pixel_mm(SIZE)), 1, 8))
        rgba, _ = shade_splats(depth, numbers, colors[:, :3] / 255.0, own, camera, lighting, apart)
        image = np.where(rgba[..., 3:] > 0.0, 255.0 * rgba[..., :3], (0.0, 0.0, 128.0))
        assert np.abs(found.image[..., :3] - image).max() <= tolerances.SPLAT_COLOR_LEVELS
        assert (found.image[..., 3] == 255).all()
        assert found.shading == ("none" if not lighting.shades else "normals" if has_normals else "depths")


def test_disc_of_a_point_covers_its_radius_and_hides_farther_ones(device: Any) -> None:
    """A disc of 3 mm before a larger one; the nearer hides the other, and of equals the first is seen."""
    points = np.array([(0, 0, 0), (0, -5, 0), (0, -5, 0), (3.1, 10, 0)], np.float32)
    cloud = PointCloud(points, labels=[7, 3, 5, 1])
    look = PointLook(radius_mm=3.0, lighting=UNSHADED)
    picture = clrecon.render(cloud, look, camera=FRONT, size=(95, 47), device=device)
    x, y = np.meshgrid(0.5 * (np.arange(95) - 47.0), 0.5 * (23.0 - np.arange(47)))
    near, far = x * x + y * y <= 9.0, (x - 3.1) ** 2 + y * y <= 9.0
    assert np.array_equal(picture.depth == 45.0, near)
    assert np.array_equal(picture.depth == 60.0, far & ~near)
    assert np.isnan(picture.depth[~near & ~far]).all()
    legend = {entry["label"]: entry for entry in picture.report["legend"]}
    assert picture.image[23, 47, :3].tobytes().hex() == legend[3]["color"][1:]
    assert picture.image[23, 55, :3].tobytes().hex() == legend[1]["color"][1:]
    assert {entry["points"] for entry in legend.values()} == {1}
    assert picture.expected_depth is picture.depth and picture.values is None


def test_points_smaller_than_a_pixel_are_seen(device: Any) -> None:
    places = np.random.default_rng(4).uniform(-10.0, 10.0, (500, 3)).astype(np.float32)
    picture = clrecon.render(PointCloud(places), radius_mm=1e-6, camera=FRONT, size=(47, 47), device=device)
    pixels, _ = FRONT.project(places, (47, 47))
    column, row = np.floor(pixels).astype(int).T
    assert np.isfinite(picture.depth[row, column]).all()
    assert np.isfinite(picture.depth).mean() < 0.5


@pytest.mark.parametrize("name", ["parallel", "perspective"])
def test_parts_and_permutations_give_the_same_picture(device: Any, name: str) -> None:
    points, normals = ball(250_000)
    colors = np.full((250_000, 4), 255, np.uint8)
    colors[:, 0] = np.arange(250_000) % 256
    camera, calls = CAMERAS[name], []
    discs, shot = Discs(points, colors, normals, 0.5, Lighting()), Shot(camera, SIZE)
    whole = draw_splats(device, discs, shot)
    memory = 16 * SIZE[0] * SIZE[1] + 28 * 80_000
    parts = draw_splats(device, discs, shot._replace(progress=lambda *call: calls.append(call)), memory=memory)
    assert (whole.parts, parts.parts) == (1, 4)
    assert parts.image.tobytes() == whole.image.tobytes() and parts.depth.tobytes() == whole.depth.tobytes()
    assert calls[0] == ("points", 0, 750_000) and calls[-1] == ("points", 750_000, 750_000)
    order = np.random.default_rng(5).permutation(250_000)
    other = draw_splats(device, Discs(points[order], colors[order], normals[order], 0.5, Lighting()), shot)
    assert other.image.tobytes() == whole.image.tobytes()
    with refused(DeviceError, "points"):
        draw_splats(device, discs, shot, memory=16 * SIZE[0] * SIZE[1] + 1000)


def test_a_cloud_far_away_looks_the_same(device: Any) -> None:
    points, normals = ball()
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
    return [tuple(picture.image[23, at, :3].tolist()) for at in (11, 19, 27, 35)], picture.report


def test_points_are_grey_by_hu(device: Any) -> None:
    colors, report = colors_of_four(device, color_by="hu", window=(0, 200))
    assert colors == [(0,) * 3, (128,) * 3, (255,) * 3, (255,) * 3] and report["window_hu"] == (0.0, 200.0)


def test_points_have_the_colours_of_their_labels_and_noise_is_grey(device: Any) -> None:
    colors, report = colors_of_four(device)
    assert report["color_by"] == "label" and colors[1] == colors[3] != colors[2] and colors[0] == (112,) * 3
    assert [(e["label"], e["name"], e["points"]) for e in report["legend"]] == [
        (-1, "noise", 1),
        (0, None, 2),
        (2, "sheet", 1),
    ]


def test_kept_points_are_grey_beside_removed_ones(device: Any) -> None:
    colors, report = colors_of_four(device, color_by="removed")
    assert colors[1] == colors[3] == (160,) * 3 and colors[2] not in ((160,) * 3, (112,) * 3)
    assert [e["name"] for e in report["legend"]] == [None, "kept", "sheet"]


def test_points_have_the_one_colour_that_is_given(device: Any) -> None:
    assert colors_of_four(device, color="red")[0] == [(255, 0, 0)] * 4


@pytest.mark.parametrize(("hu", "color_by"), [(None, "none"), ([0, 100, 200, 300], "hu")])
def test_points_without_labels_are_coloured_by_hu_if_they_have_some(device: Any, hu: Any, color_by: str) -> None:
    assert clrecon.render(PointCloud(FOUR, hu=hu), size=SIZE, device=device).report["color_by"] == color_by


def test_legend_names_the_largest_labels_and_counts_the_rest(device: Any) -> None:
    many = PointCloud(np.repeat(FOUR, 10, axis=0), labels=np.arange(40))
    report = clrecon.render(many, size=SIZE, device=device).report
    assert len(report["legend"]) == MOST_NAMED and report["legend_left_out"] == 40 - MOST_NAMED


def test_labels_as_far_apart_as_32_bits_are_told_apart(device: Any) -> None:
    wide = clrecon.render(PointCloud(FOUR, labels=[5, -(2**31), 2**31 - 1, 5]), size=SIZE, device=device)
    assert [entry["points"] for entry in wide.report["legend"]] == [1, 2, 1]


def test_clipped_points_do_not_show(device: Any) -> None:
    points, normals = ball()
    cloud = PointCloud(points, normals, hu=points[:, 0])
    cut = Clip.plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    found = clrecon.render(cloud, camera=FRONT, size=SIZE, radius_mm=0.5, clip=cut, device=device)
    own = cloud.select(points[:, 2] >= 0.0)
    window = found.report["window_hu"]
    alone = clrecon.render(own, camera=FRONT, size=SIZE, radius_mm=0.5, window=window, device=device)
    assert found.image.tobytes() == alone.image.tobytes()
    nothing = Clip.plane((0.0, 0.0, 99.0), (0.0, 0.0, 1.0))
    empty = clrecon.render(cloud, camera=FRONT, size=SIZE, clip=nothing, background="red", device=device)
    assert np.isnan(empty.depth).all() and (empty.image == (255, 0, 0, 255)).all()


def test_the_camera_sees_the_whole_cloud(device: Any) -> None:
    points, _ = ball()
    for place in ({"view": "left"}, {"view": (20, 30), "view_angle": 40.0}, {"view": "superior", "zoom": 0.5}):
        camera = clrecon.render(PointCloud(points), size=SIZE, device=device, **place).camera
        pixels, _ = camera.project(points, SIZE)
        assert (pixels > 0).all() and (pixels < SIZE).all()
    flat = cloud_box(PointCloud([(1.0, 2.0, 3.0)]))
    assert np.allclose(flat.affine[:3, 3], (1.0, 2.0, 3.0)) and min(flat.spacing) > 0.0
    lone = clrecon.render(PointCloud([(1.0, 2.0, 3.0)]), size=SIZE, device=device)
    assert np.isfinite(lone.depth).any()


def test_what_cannot_be_shown_is_refused(device: Any) -> None:
    cloud = PointCloud(ball(50)[0])
    with refused(UsageError, "nothing"):
        clrecon.render(PointCloud(np.empty((0, 3))), device=device)
    with refused(UsageError, "color_by", "labels"):
        clrecon.render(cloud, color_by="removed", device=device)
    with refused(UsageError, "color_by"):
        clrecon.render(cloud, color_by="hu", device=device)
    with refused(UsageError, "point", "cloud"):
        clrecon.render(cloud, "mip", device=device)
    volume = clrecon.Volume(np.zeros((4, 4, 4), np.int16), np.eye(4))
    with refused(UsageError, "volume", "cloud"):
        clrecon.render(volume, PointLook(), device=device)
    with refused(UsageError, "number"):
        PointPictures(cloud, device=device, memory=0)
    near = clrecon.render(cloud, camera=FRONT, size=(64, 64), radius_mm=80.0, device=device)
    assert "are drawn with 128" in near.report["warnings"][-1]
    large = PointCloud(ball(1_400_000)[0])
    with refused(UsageError, "radius", "zoom", 1_400_000):
        clrecon.render(large, camera=FRONT, size=(64, 64), radius_mm=80.0, device=device)
