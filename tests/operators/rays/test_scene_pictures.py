"""Several objects in one picture: closed forms for a volume about meshes, the order of depth, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import tolerances
from sample_meshes import ball
from variants import daily_rows, each_value

import clrecon
from clrecon import (
    Mesh,
    MeshLook,
    PointCloud,
    PointLook,
    SlicesInSpace,
    SurfaceLook,
    TransferFunction,
    Volume,
    VolumeLook,
)
from clrecon.errors import DeviceError, UsageError
from clrecon.operators.rays.ray_slabs import ray_slabs
from clrecon.operators.rays.scene import PIXEL_BYTES, ScenePictures
from clrecon.rendering import UNSHADED
from clrecon.rendering.views.camera import Camera

SIZE = (60, 40)
SIDE = 20
"""Voxels of 1 mm along each side of the block, whose middle is the origin."""

AFFINE = np.eye(4)
AFFINE[:3, 3] = -0.5 * (SIDE - 1)
FOG = TransferFunction([(0, 1, 0, 0, 0.05), (100, 1, 0, 0, 0.05)], unit_distance=1.0)
CAMERAS = {
    "parallel": Camera((3.0, -50.0, 8.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), parallel_scale=14.0),
    "perspective": Camera((9.0, -40.0, 12.0), (0.0, 0.0, 0.0), (0.1, 0.0, 1.0), view_angle=35.0),
    "inside": Camera((1.0, -6.0, 0.5), (0.0, 5.0, 0.0), (0.1, 0.0, 1.0), view_angle=60.0),
}


def block_of_fog(dtype: Any = np.int16) -> Volume:
    """A cube of 50 HU, 20 mm wide around the origin; its fog lets 0.95 of the light through each mm."""
    return Volume(np.full((SIDE, SIDE, SIDE), 50, dtype), AFFINE)


def screen(y: float, half: float = 200.0) -> Mesh:
    """Return a square across y."""
    corners = [(-half, y, -half), (half, y, -half), (half, y, half), (-half, y, half)]
    return Mesh(corners, [(0, 1, 2), (0, 2, 3)])


def ways(camera: Camera, *, y: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mm of each ray within the block before and behind the plane y, and mm to the plane."""
    origins, directions = camera.rays(SIZE)
    with np.errstate(divide="ignore"):
        low, high = (-0.5 * SIDE - origins) / directions, (0.5 * SIDE - origins) / directions
    enter, leave = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
    enter = enter if camera.is_parallel else np.maximum(enter, 0.0)
    leave = np.maximum(leave, enter)
    plane = (y - origins[..., 1]) / directions[..., 1]
    return np.clip(plane, enter, leave) - enter, leave - np.clip(plane, enter, leave), plane


SCREEN_Y = 3.0


class ScreenInFog:
    """A green screen of some opacity at y = 3 mm in red fog: the picture, the slabs it took, and mm of each ray."""

    def __init__(self, device: Any, camera: Camera, patch: pytest.MonkeyPatch, *, opacity: float, in_slabs: bool):
        self.opacity, self.slabs = opacity, 0
        self.before, self.behind, self.plane = ways(camera, y=SCREEN_Y)

        def count_slabs(*arguments: Any) -> Any:
            for slab in ray_slabs(*arguments):
                self.slabs += 1
                yield slab

        patch.setattr("clrecon.operators.rays.ray_slabs.ray_slabs", count_slabs)
        look = MeshLook((0.0, 1.0, 0.0), opacity=opacity, lighting=UNSHADED)
        fog = VolumeLook(FOG, lighting=UNSHADED)
        self.picture = clrecon.render(
            [(block_of_fog(), fog), (screen(SCREEN_Y), look)], camera=camera, size=SIZE, device=device,
            memory=PIXEL_BYTES * SIZE[0] * SIZE[1] + 14_000 if in_slabs else None, background="transparent",
        )  # fmt: skip


@pytest.fixture(
    params=[
        pytest.param(row.values, marks=row.marks)
        for row in daily_rows(3, each_value(CAMERAS, [0.4, 1.0], [False, True]))
    ],
    ids=str,
)
def screen_in_fog(request: pytest.FixtureRequest, device: Any, monkeypatch: pytest.MonkeyPatch) -> ScreenInFog:
    """A screen of either opacity seen by one of the cameras, the fog on the device as a whole or in slabs."""
    name, opacity, in_slabs = request.param
    return ScreenInFog(device, CAMERAS[name], monkeypatch, opacity=opacity, in_slabs=in_slabs)


@pytest.mark.seconds
@pytest.mark.every_device
def test_fog_before_and_behind_a_screen_is_as_red_and_the_screen_as_green_as_the_way_through_it(
    screen_in_fog: ScreenInFog,
) -> None:
    """By analysis: the fog before, what the screen lets through of the fog behind, and the screen behind the first."""
    scene, shown = screen_in_fog, screen_in_fog.picture.image.astype(float)
    through_before, through_behind = 0.95**scene.before, 0.95**scene.behind
    red = 1.0 - through_before + through_before * (1.0 - scene.opacity) * (1.0 - through_behind)
    green = through_before * scene.opacity
    off_edges = (scene.before > 0.2) & (scene.behind > 0.2) & (scene.plane > 0.0)
    assert off_edges.mean() > 0.2  # measured 0.33
    opacity = shown[..., 3] / 255.0
    for found, expected in (
        (opacity, red + green), (shown[..., 0] / 255.0 * opacity, red), (shown[..., 1] / 255.0 * opacity, green)
    ):  # fmt: skip
        assert 255.0 * np.abs(found - expected)[off_edges].max() <= tolerances.LAYER_LEVELS


@pytest.mark.seconds
@pytest.mark.every_device
def test_a_screen_beside_fog_has_its_own_colour_and_opacity(screen_in_fog: ScreenInFog) -> None:
    scene = screen_in_fog
    beside = (scene.before + scene.behind == 0.0) & (scene.plane > 0.0)
    off = np.abs(scene.picture.image[beside] - (0, 255, 0, 255 * scene.opacity))
    assert off.max(initial=0.0) <= 0.5  # of 255: rounding; measured 0


@pytest.mark.seconds
@pytest.mark.every_device
def test_a_scene_takes_a_pass_over_the_volume_for_an_opaque_screen_and_two_for_a_translucent_one(
    screen_in_fog: ScreenInFog, request: pytest.FixtureRequest
) -> None:
    passes = 1 if screen_in_fog.opacity == 1.0 else 2
    _, _, in_slabs = request.node.callspec.params["screen_in_fog"]
    assert screen_in_fog.slabs >= 2 * passes if in_slabs else screen_in_fog.slabs == passes


def test_depth_of_an_opaque_screen_beside_or_hardly_in_fog_is_its_own(
    device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = ScreenInFog(device, CAMERAS["parallel"], monkeypatch, opacity=1.0, in_slabs=False)
    beside = (scene.before + scene.behind == 0.0) & (scene.plane > 0.0)
    hardly_in = (scene.before > 0.0) & (scene.before < 0.02)
    clear = beside | hardly_in
    assert clear.any()
    assert np.allclose(scene.picture.depth[clear], scene.plane[clear], atol=tolerances.SLICE_DEPTH_MM)


def test_report_of_a_scene_names_its_objects_and_its_mode_is_that_of_the_volume(
    device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    picture = ScreenInFog(device, CAMERAS["parallel"], monkeypatch, opacity=1.0, in_slabs=False).picture
    assert picture.report["objects"] == ["dvr", "mesh"]
    assert picture.mode == "dvr"


class SpeckInFog:
    """Fog alone, a speck of 1 mm alone, and both in one picture; pixels where the speck hides the fog."""

    def __init__(self, device: Any) -> None:
        camera = CAMERAS["perspective"]
        vertices, triangles = ball(radius=1.0, rings=12)
        speck = Mesh(np.array(vertices) + (4.5, -20.0, 6.0), triangles)
        fog = block_of_fog(), VolumeLook(FOG)
        settings: dict[str, Any] = {"camera": camera, "size": SIZE, "device": device, "background": "transparent"}
        self.fog = clrecon.render(*fog, **settings)
        self.speck = clrecon.render(speck, **settings)
        self.both = clrecon.render([fog, speck], **settings)
        self.hidden = self.speck.image[..., 3] > 0
        assert 5 < np.count_nonzero(self.hidden) < 500  # measured 32


@pytest.fixture(scope="module")
def speck_in_fog(device: Any) -> SpeckInFog:
    """A speck before a block of fog."""
    return SpeckInFog(device)


def test_a_volume_beside_a_mesh_looks_as_alone(speck_in_fog: SpeckInFog) -> None:
    both, alone, beside = speck_in_fog.both, speck_in_fog.fog, ~speck_in_fog.hidden
    assert np.abs(both.image.astype(int) - alone.image)[beside].max() <= tolerances.RAY_SAME_255
    for name in ("depth", "expected_depth"):
        found, expected = getattr(both, name)[beside], getattr(alone, name)[beside]
        assert np.allclose(found, expected, atol=tolerances.SLICE_DEPTH_MM, equal_nan=True), name


def test_an_opaque_mesh_before_a_volume_looks_as_alone(speck_in_fog: SpeckInFog) -> None:
    both, speck, hidden = speck_in_fog.both, speck_in_fog.speck, speck_in_fog.hidden
    assert np.array_equal(both.image[hidden], speck.image[hidden])
    assert np.array_equal(both.depth[hidden], speck.depth[hidden])


@pytest.mark.every_device
@pytest.mark.parametrize("name", ["parallel", "perspective"])
def test_slices_before_and_behind_a_mesh_are_blended_in_order(device: Any, name: str) -> None:
    """Each of a pixel's slices and both faces of the box come in the order of their depth."""
    camera, chosen = CAMERAS[name], [2, 7, 12, 17]
    mesh, opacity = screen(1.0), 0.3
    look = SlicesInSpace(chosen, opacity=0.5, window=(0, 100))
    shown = [(block_of_fog(), look), (mesh, MeshLook((0, 1, 0), opacity=opacity, lighting=UNSHADED))]
    picture = clrecon.render(shown, camera=camera, size=SIZE, device=device, background="transparent")
    origins, directions = camera.rays(SIZE)
    plane = (1.0 - origins[..., 1]) / directions[..., 1]
    layers = [(plane, np.full(plane.shape, opacity), np.array((0.0, 1.0, 0.0)))]  # depth, opacity and colour
    for k in chosen:
        way = (AFFINE[2, 3] + k - origins[..., 2]) / directions[..., 2]
        place = origins + way[..., None] * directions
        held = (np.abs(place[..., :2]) <= 0.5 * SIDE).all(axis=-1) & (way > 0.0)
        layers.append((way, np.where(held, 0.5, 0.0), np.full(3, 0.5)))
    depths, opacities, colors = (np.stack(part) for part in zip(*layers, strict=True))
    order = np.argsort(depths, axis=0)
    rgba = np.zeros((*plane.shape, 4))
    for nearest_first in order:
        (share,) = np.take_along_axis(opacities, nearest_first[None], axis=0)
        weight = ((1.0 - rgba[..., 3]) * share)[..., None]
        rgba += weight * np.concatenate([colors[nearest_first], np.ones((*plane.shape, 1))], axis=-1)
    alpha = picture.image[..., 3:].astype(float)
    premultiplied = np.concatenate([picture.image[..., :3] * alpha / 255.0, alpha], axis=-1)
    off = np.abs(premultiplied - 255.0 * rgba).max(axis=-1) > tolerances.LAYER_LEVELS
    assert off.mean() < 0.01  # rims of slices
    places_of_mesh = np.argmin(order, axis=0)  # among the slices: the mesh is layer 0
    assert len(np.unique(places_of_mesh)) >= 3


LEFT_POINT, RIGHT_POINT = (-9.0, -20.0, 0.0), (9.0, 20.0, 0.0)


@pytest.fixture(scope="module")
def red_points_glass_bone_and_blue_screen(device: Any) -> clrecon.Rendering:
    """From the front: red points at y = -20, green glass at -10, white bone from -5 to 5, a blue screen at 15, and a
    red point at 20."""
    voxels = np.zeros((SIDE, SIDE, SIDE), np.int16)
    voxels[5:15, 5:15, 5:15] = 1000
    shown = [
        (PointCloud([LEFT_POINT, (0.0, -20.0, 0.0), RIGHT_POINT]),
         PointLook(radius_mm=2.0, color="red", lighting=UNSHADED)),
        (screen(-10.0), MeshLook((0, 1, 0), opacity=0.25, lighting=UNSHADED)),
        (Volume(voxels, AFFINE), SurfaceLook(500, color="white", lighting=UNSHADED)),
        (screen(15.0), MeshLook("blue", lighting=UNSHADED)),
    ]  # fmt: skip
    return clrecon.render(shown, camera=CAMERAS["parallel"], size=(120, 80), device=device)


def color_and_depth(picture: clrecon.Rendering, place: tuple[float, float, float]) -> tuple[tuple[int, ...], float]:
    """Of the pixel where the camera projects a place."""
    ((column, row),), _ = CAMERAS["parallel"].project([place], (120, 80))
    row, column = int(row), int(column)
    return tuple(picture.image[row, column, :3].tolist()), float(picture.depth[row, column])


def depth_of(place: tuple[float, float, float]) -> float:
    _, (depth,) = CAMERAS["parallel"].project([place], SIZE)
    return float(depth)


def test_a_point_before_all_is_seen_at_its_depth(red_points_glass_bone_and_blue_screen: clrecon.Rendering) -> None:
    color, depth = color_and_depth(red_points_glass_bone_and_blue_screen, LEFT_POINT)
    assert color == (255, 0, 0)
    assert depth == pytest.approx(depth_of(LEFT_POINT), abs=tolerances.SLICE_DEPTH_MM)


def test_a_point_behind_a_screen_is_hidden_and_the_screen_seen_through_glass(
    red_points_glass_bone_and_blue_screen: clrecon.Rendering,
) -> None:
    color, _ = color_and_depth(red_points_glass_bone_and_blue_screen, RIGHT_POINT)
    assert color == (0, round(0.25 * 255), round(0.75 * 255))


def test_bone_is_seen_through_glass_whose_depth_comes_first(
    red_points_glass_bone_and_blue_screen: clrecon.Rendering,
) -> None:
    color, depth = color_and_depth(red_points_glass_bone_and_blue_screen, (1.0, -5.0, 2.5))
    assert color == (round(0.75 * 255), 255, round(0.75 * 255))
    assert depth == pytest.approx(depth_of((1.0, -10.0, 2.5)), abs=0.5)  # measured 0.12 off


def test_report_of_a_scene_lists_its_objects_in_their_order(
    red_points_glass_bone_and_blue_screen: clrecon.Rendering,
) -> None:
    assert red_points_glass_bone_and_blue_screen.report["objects"] == ["points", "mesh", "surface", "mesh"]


BALL_RADIUS = 5.0
BALL = Mesh(*ball(BALL_RADIUS, rings=10))


def test_camera_of_a_scene_with_a_mesh_within_its_volume_is_that_of_the_volume(device: Any) -> None:
    fog = block_of_fog(), VolumeLook(FOG)
    alone = clrecon.render(*fog, size=SIZE, device=device)
    assert clrecon.render([fog, BALL], size=SIZE, device=device).camera == alone.camera


def test_camera_of_a_scene_sees_a_mesh_beside_its_volume_and_the_volume(device: Any) -> None:
    beside = Mesh(BALL.vertices + np.float32((80.0, 0.0, 0.0)), BALL.triangles)
    camera = clrecon.render([(block_of_fog(), VolumeLook(FOG)), beside], size=SIZE, device=device).camera
    assert camera is not None
    ends = [(80.0 + BALL_RADIUS, 0.0, 0.0), (-0.5 * SIDE, 0.0, 0.0)]
    pixels, _ = camera.project(ends, SIZE)
    assert ((pixels > 0.0) & (pixels < SIZE)).all()


def test_pictures_of_one_scene_are_the_same_each_time_and_from_the_device(device: Any) -> None:
    with ScenePictures([(block_of_fog(), VolumeLook(FOG)), (BALL, MeshLook())], device=device) as pictures:
        one = pictures.take(CAMERAS["parallel"], SIZE)
        other = pictures.take(CAMERAS["inside"], SIZE)
        again = pictures.take(CAMERAS["parallel"], SIZE)
        assert pictures.device is device
    assert one.image.tobytes() == again.image.tobytes() != other.image.tobytes()
    resident = clrecon.DeviceVolume(block_of_fog(), device=device)
    with ScenePictures([(resident, VolumeLook(FOG)), (BALL, MeshLook())], device=device) as pictures:
        assert pictures.take(CAMERAS["parallel"], SIZE).image.tobytes() == one.image.tobytes()


FOG_VOLUME = block_of_fog()


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        ([], "at least one object"),
        ([(FOG_VOLUME, clrecon.Projection("mip")), BALL], "not mode mip"),
        ([(BALL, VolumeLook())], "a Mesh has the style MeshLook"),
        ([(FOG_VOLUME, VolumeLook()), (FOG_VOLUME, SlicesInSpace())], "2 volumes"),
        ([(BALL, "red")], "in a pair"),
        ([(BALL, MeshLook(), 3)], "in a pair"),
        ([BALL, "left"], "not str"),
        ([PointCloud(np.zeros((0, 3)))], "no points"),
        ([Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))], "no triangles"),
    ],
    ids=["nothing", "mode of values", "style of a volume", "two volumes", "a colour for a style", "three in a pair",
         "text", "no points", "no triangles"],
)  # fmt: skip
def test_objects_that_cannot_be_shown_together_are_refused(device: Any, shown: list[Any], text: str) -> None:
    with pytest.raises(UsageError, match=text):
        clrecon.render(shown, device=device)


@pytest.mark.parametrize(("style", "options"), [((MeshLook(),), {}), ((), {"color": "red"})], ids=["style", "keyword"])
def test_a_style_beside_a_list_of_objects_is_refused(
    device: Any, style: tuple[Any, ...], options: dict[str, Any]
) -> None:
    with pytest.raises(UsageError, match="its own style"):
        clrecon.render([BALL], *style, **options, device=device)


def test_a_scene_without_room_for_its_triangles_is_refused(device: Any) -> None:
    with pytest.raises(DeviceError, match="triangles"):
        clrecon.render([(FOG_VOLUME, VolumeLook(FOG)), BALL], size=SIZE, memory=1000, device=device)
