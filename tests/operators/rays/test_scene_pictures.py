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


def block(dtype: Any = np.int16) -> Volume:
    return Volume(np.full((SIDE, SIDE, SIDE), 50, dtype), AFFINE)


def screen(y: float, half: float = 200.0) -> Mesh:
    """Return a square across y."""
    corners = [(-half, y, -half), (half, y, -half), (half, y, half), (-half, y, half)]
    return Mesh(corners, [(0, 1, 2), (0, 2, 3)])


def ways(camera: Camera, y: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mm of each ray within the block before and behind the plane y, and mm to the plane."""
    origins, directions = camera.rays(SIZE)
    with np.errstate(divide="ignore"):
        low, high = (-0.5 * SIDE - origins) / directions, (0.5 * SIDE - origins) / directions
    enter, leave = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
    enter = enter if camera.is_parallel else np.maximum(enter, 0.0)
    leave = np.maximum(leave, enter)
    plane = (y - origins[..., 1]) / directions[..., 1]
    return np.clip(plane, enter, leave) - enter, leave - np.clip(plane, enter, leave), plane


@pytest.mark.seconds
@pytest.mark.every_device
@pytest.mark.parametrize(("name", "opacity", "in_slabs"), daily_rows(3, each_value(CAMERAS, [0.4, 1.0], [False, True])))
def test_fog_before_and_behind_a_screen_is_a_closed_form(
    device: Any, name: str, opacity: float, in_slabs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera, y = CAMERAS[name], 3.0
    before, behind, plane = ways(camera, y)
    lets = [0.95**length for length in (before, behind)]
    sure = (before > 0.2) & (behind > 0.2) & (plane > 0.0)
    look = MeshLook((0.0, 1.0, 0.0), opacity=opacity, lighting=UNSHADED)
    slabs = []

    def count(*arguments: Any) -> Any:
        for slab in ray_slabs(*arguments):
            slabs.append(slab)
            yield slab

    monkeypatch.setattr("clrecon.operators.rays.ray_slabs.ray_slabs", count)
    memory = PIXEL_BYTES * SIZE[0] * SIZE[1] + 14_000 if in_slabs else None
    picture = clrecon.render(
        [(block(), VolumeLook(FOG, lighting=UNSHADED)), (screen(y), look)], camera=camera, size=SIZE, device=device,
        memory=memory, background="transparent",
    )  # fmt: skip
    passes = 1 if opacity == 1.0 else 2
    assert len(slabs) >= 2 * passes if in_slabs else len(slabs) == passes
    red = 1.0 - lets[0] + lets[0] * (1.0 - opacity) * (1.0 - lets[1])
    green = lets[0] * opacity
    total = red + green
    shown = picture.image.astype(float)
    assert sure.mean() > 0.2
    assert np.abs(shown[..., 3] - 255.0 * total)[sure].max() <= tolerances.LAYER_LEVELS
    for channel, share in ((0, red), (1, green)):
        away = np.abs(shown[..., channel] * shown[..., 3] / 255.0 - 255.0 * share)
        assert away[sure].max() <= tolerances.LAYER_LEVELS
    beside = (before + behind == 0.0) & (plane > 0.0)
    assert np.abs(shown[beside] - (0, 255, 0, 255 * opacity)).max(initial=0.0) <= 0.5
    if opacity == 1.0 and name == "parallel":
        deep = (0.0 < before) & (before < 0.02) | (beside & sure)
        assert np.allclose(picture.depth[deep], plane[deep], atol=1e-3)
    assert picture.report["objects"] == ["dvr", "mesh"] and picture.mode == "dvr"


def test_volume_without_a_mesh_before_it_looks_as_alone(device: Any) -> None:
    volume, camera = block(), CAMERAS["perspective"]
    look = VolumeLook(FOG)
    alone = clrecon.render(volume, look, camera=camera, size=SIZE, device=device, background="transparent")
    speck = Mesh(np.array(ball(1.0, 12)[0]) + (4.5, -20.0, 6.0), ball(1.0, 12)[1])
    both = clrecon.render([(volume, look), speck], camera=camera, size=SIZE, device=device, background="transparent")
    only = clrecon.render(speck, camera=camera, size=SIZE, device=device, background="transparent")
    hidden = only.image[..., 3] > 0
    assert 5 < hidden.sum() < 500
    assert np.abs(both.image.astype(int) - alone.image)[~hidden].max() <= 1
    assert np.allclose(both.depth[~hidden], alone.depth[~hidden], atol=1e-3, equal_nan=True)
    assert np.allclose(both.expected_depth[~hidden], alone.expected_depth[~hidden], atol=1e-3, equal_nan=True)
    assert np.array_equal(both.image[hidden], only.image[hidden])
    assert np.array_equal(both.depth[hidden], only.depth[hidden])


@pytest.mark.every_device
@pytest.mark.parametrize("name", ["parallel", "perspective"])
def test_slices_before_and_behind_a_mesh_are_blended_in_order(device: Any, name: str) -> None:
    """Each of a pixel's slices and both faces of the box come in the order of their depth."""
    camera, chosen = CAMERAS[name], [2, 7, 12, 17]
    mesh, opacity = screen(1.0), 0.3
    look = SlicesInSpace(chosen, opacity=0.5, window=(0, 100))
    shown = [(block(), look), (mesh, MeshLook((0, 1, 0), opacity=opacity, lighting=UNSHADED))]
    picture = clrecon.render(shown, camera=camera, size=SIZE, device=device, background="transparent")
    origins, directions = camera.rays(SIZE)
    plane = (1.0 - origins[..., 1]) / directions[..., 1]
    layers = [(plane, np.full(plane.shape, opacity), np.array((0.0, 1.0, 0.0)))]
    for k in chosen:
        way = (AFFINE[2, 3] + k - origins[..., 2]) / directions[..., 2]
        place = origins + way[..., None] * directions
        held = (np.abs(place[..., :2]) <= 0.5 * SIDE).all(axis=-1) & (way > 0.0)
        layers.append((way, np.where(held, 0.5, 0.0), np.full(3, 0.5)))
    depths = np.stack([layer[0] for layer in layers])
    order = np.argsort(depths, axis=0)
    rgba = np.zeros((*plane.shape, 4))
    for step in order:
        share = np.take_along_axis(np.stack([layer[1] for layer in layers]), step[None], axis=0)[0]
        color = np.stack([layer[2] for layer in layers])[step]
        weight = ((1.0 - rgba[..., 3]) * share)[..., None]
        rgba += weight * np.concatenate([color, np.ones((*plane.shape, 1))], axis=-1)
    alpha = picture.image[..., 3:].astype(float)
    premultiplied = np.concatenate([picture.image[..., :3] * alpha / 255.0, alpha], axis=-1)
    off = np.abs(premultiplied - 255.0 * rgba).max(axis=-1) > tolerances.LAYER_LEVELS
    assert off.mean() < 0.01  # rims of slices
    assert len(np.unique(np.argwhere(order.reshape(5, -1).T == 0)[:, 1])) >= 3  # places of the mesh among the slices


def test_points_and_surfaces_hide_and_are_hidden(device: Any) -> None:
    camera = CAMERAS["parallel"]
    voxels = np.zeros((SIDE, SIDE, SIDE), np.int16)
    voxels[5:15, 5:15, 5:15] = 1000
    solid = Volume(voxels, AFFINE)
    cloud = PointCloud([(-9.0, -20.0, 0.0), (0.0, -20.0, 0.0), (9.0, 20.0, 0.0)])
    dots = PointLook(radius_mm=2.0, color="red", lighting=UNSHADED)
    glass = MeshLook((0, 1, 0), opacity=0.25, lighting=UNSHADED)
    surface = SurfaceLook(500, color="white", lighting=UNSHADED)
    shown = [
        (cloud, dots),
        (screen(-10.0), glass),
        (solid, surface),
        (screen(15.0), MeshLook("blue", lighting=UNSHADED)),
    ]
    picture = clrecon.render(shown, camera=camera, size=(120, 80), device=device)

    def at(point: tuple[float, float, float]) -> tuple[tuple[int, ...], float]:
        (column, row), _ = camera.project([point], (120, 80))[0][0], None
        place = int(row), int(column)
        return tuple(picture.image[place][:3].tolist()), float(picture.depth[place])

    (red, depth), far = at((-9.0, -20.0, 0.0)), camera.project([(-9.0, -20.0, 0.0)], SIZE)[1][0]
    assert red == (255, 0, 0) and depth == pytest.approx(far, abs=1e-3)
    hidden, _ = at((9.0, 20.0, 0.0))
    assert hidden == (0, 64, 191)  # the blue screen hides the point, the glass is before both
    bone, depth = at((1.0, -5.0, 2.5))
    assert bone == (191, 255, 191)
    assert depth == pytest.approx(camera.project([(1.0, -10.0, 2.5)], SIZE)[1][0], abs=0.5)
    assert picture.report["objects"] == ["points", "mesh", "surface", "mesh"]


def test_cameras_fit_all_objects(device: Any) -> None:
    volume, inside = block(), Mesh(*ball(5.0, 10))
    outside = Mesh(np.array(ball(5.0, 10)[0]) + (80.0, 0.0, 0.0), ball(5.0, 10)[1])
    alone = clrecon.render(volume, VolumeLook(FOG), size=SIZE, device=device)
    both = clrecon.render([(volume, VolumeLook(FOG)), inside], size=SIZE, device=device)
    assert both.camera == alone.camera
    wide = clrecon.render([(volume, VolumeLook(FOG)), outside], size=SIZE, device=device)
    assert wide.camera is not None
    pixels, _ = wide.camera.project([(85.0, 0.0, 0.0), (-10.0, 0.0, 0.0)], SIZE)
    assert ((pixels > 0.0) & (pixels < SIZE)).all()


def test_pictures_of_one_scene_are_the_same_each_time_and_from_the_device(device: Any) -> None:
    with ScenePictures([(block(), VolumeLook(FOG)), (Mesh(*ball(5.0, 10)), MeshLook())], device=device) as pictures:
        one = pictures.take(CAMERAS["parallel"], SIZE)
        other = pictures.take(CAMERAS["inside"], SIZE)
        again = pictures.take(CAMERAS["parallel"], SIZE)
        assert pictures.device is device
    assert one.image.tobytes() == again.image.tobytes() != other.image.tobytes()
    resident = clrecon.DeviceVolume(block(), device=device)
    with ScenePictures([(resident, VolumeLook(FOG)), (Mesh(*ball(5.0, 10)), MeshLook())], device=device) as pictures:
        assert pictures.take(CAMERAS["parallel"], SIZE).image.tobytes() == one.image.tobytes()


def test_what_cannot_be_shown_together_is_refused(device: Any) -> None:
    mesh, volume = Mesh(*ball(5.0, 10)), block()
    for shown, text in (
        ([], "at least one object"),
        ([(volume, clrecon.Projection("mip")), mesh], "not mode mip"),
        ([(mesh, VolumeLook())], "a Mesh has the style MeshLook"),
        ([(volume, VolumeLook()), (volume, SlicesInSpace())], "2 volumes"),
        ([(mesh, "red")], "in a pair"),
        ([(mesh, MeshLook(), 3)], "in a pair"),
        ([mesh, "left"], "not str"),
        ([PointCloud(np.zeros((0, 3)))], "no points"),
        ([Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))], "no triangles"),
    ):
        with pytest.raises(UsageError, match=text):
            clrecon.render(shown, device=device)
    with pytest.raises(UsageError, match="its own style"):
        clrecon.render([mesh], MeshLook(), device=device)
    with pytest.raises(UsageError, match="its own style"):
        clrecon.render([mesh], color="red", device=device)
    with pytest.raises(DeviceError, match="triangles"):
        clrecon.render([(volume, VolumeLook(FOG)), mesh], size=SIZE, memory=1000, device=device)
