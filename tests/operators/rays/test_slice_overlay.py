"""Slices in space: where they are, in which order they hide each other, and against their twin."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from ray_scenes import GRIDS, blobs, centre_of, look, make_volume, premultiplied
from refusals import refused

import clrecon
from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.operators.rays import slices as operator
from clrecon.operators.rays.picture_buffers import Shot
from clrecon.operators.rays.slices import choose_slices
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.proof.rays.surface import overlay_slices as overlay_twin
from clrecon.rendering import TransferFunction
from clrecon.rendering.pictures.styles import SlicesInSpace
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip
from clrecon.rendering.views.directions import find_view

SIZE = (56, 48)
WINDOW = (-500.0, 700.0)


def overlay_slices(resident, camera, size, *, background=None, **look):
    return operator.overlay_slices(resident, SlicesInSpace(**look), Shot(camera, size, background))


def assert_twin(device, volume, camera, slices, clip=None, opacity=0.4, lowest=-300.0, **settings):
    style = SlicesInSpace(slices, opacity=opacity, lowest_hu=lowest, window=WINDOW, clip=clip, **settings)
    found = operator.overlay_slices(DeviceVolume(volume, device=device), style, Shot(camera, SIZE))
    rgba, depth = overlay_twin(volume, camera, SIZE, style)
    assert (rgba[..., 3] > 0).mean() > 0.2
    away = np.abs(premultiplied(found.image) - 255.0 * rgba).max(axis=-1)
    assert (away <= 2.0).mean() >= 1.0 - tolerances.SLICE_EDGE_SHARE
    both = np.isfinite(depth) & np.isfinite(found.depth)
    assert (np.isfinite(depth) != np.isfinite(found.depth)).mean() <= tolerances.SLICE_EDGE_SHARE
    far = np.abs(found.depth - depth)[both] > tolerances.SLICE_DEPTH_MM
    assert far.mean() <= tolerances.SLICE_EDGE_SHARE
    return found


@pytest.mark.every_device
@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("grid", GRIDS)
def test_slice_overlay_equals_its_twin(device, grid, perspective):
    volume = make_volume(blobs, grid, dtype=np.int16)
    assert_twin(device, volume, look(volume, (0.4, 0.8, -0.7), 14.0, perspective), [1, 4, 7, 12])


def test_slices_from_below_behind_a_clip_plane_equal_the_twin(device):
    volume = make_volume(blobs, "uneven")
    clip = Clip.plane(centre_of(volume), (0.5, 0.4, 1.0))
    assert_twin(device, volume, look(volume, (0.3, -0.6, 0.8), 14.0), [2, 3, 9, 14, 15], clip)


def test_a_camera_between_the_slices_sees_them_on_both_sides(device):
    volume = make_volume(lambda p: 100.0 + 20.0 * p[:, 2], "even", 22.0, np.int16)
    centre = centre_of(volume) + (0.0, 0.0, 0.4)
    camera = Camera(tuple(centre), tuple(centre + (0.0, 1.0, 0.0)), (0, 0, 1), view_angle=120.0)
    found = assert_twin(device, volume, camera, [3, 9, 15, 21], opacity=1.0)
    assert found.image[:20, :, 0].mean() > found.image[-20:, :, 0].mean() + 10  # bright above, dark below


@pytest.mark.oclgrind
def test_few_slices_under_the_simulator_equal_the_twin(device):
    volume = make_volume(blobs, "sheared", 6.0, np.int16)
    camera = look(volume, (0.4, 0.8, -0.7), 5.0)
    found = overlay_slices(DeviceVolume(volume, device=device), camera, (12, 9), slices=[0, 2, 4], window=WINDOW)
    rgba, _ = overlay_twin(volume, camera, (12, 9), SlicesInSpace([0, 2, 4], window=WINDOW))
    assert (np.abs(premultiplied(found.image) - 255.0 * rgba).max(axis=-1) <= 2.0).mean() > 0.95


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("perspective", [False, True])
def test_a_marked_voxel_is_where_the_camera_projects_it(device, grid, perspective):
    volume = make_volume(lambda p: np.full(len(p), -900.0), grid, 16.0, np.int16)
    k, j, i = volume.voxels.shape[0] // 3, volume.voxels.shape[1] // 2, 5
    voxels = volume.voxels.copy()
    voxels[k, j - 1 : j + 2, i - 1 : i + 2] = 600
    volume = volume.with_voxels(voxels)
    camera, size = look(volume, (0.2, 0.5, 0.9), 12.0, perspective), (160, 160)
    pixels, depths = camera.project(volume.ijk_to_lps([(i, j, k)]), size)
    found = overlay_slices(DeviceVolume(volume, device=device), camera, size, slices=[0, k, k + 1], opacity=0.7)
    x, y = pixels[0]
    assert found.image[int(y), int(x), 3] == round(0.7 * 255)
    assert abs(found.depth[int(y), int(x)] - depths[0]) < camera.pixel_mm(size)
    shown = np.argwhere(found.image[..., 3] > 0)
    assert np.abs(shown.mean(axis=0)[::-1] + 0.5 - pixels[0]).max() < 1.0  # a patch around it, and nothing else
    others = overlay_slices(DeviceVolume(volume, device=device), camera, size, slices=[0, k + 2])
    assert not others.image.any() and np.isnan(others.depth).all()


def test_opacity_adds_up_and_front_hides_back(device):
    voxels = np.zeros((8, 12, 12), np.int16) + 100 * np.arange(8, dtype=np.int16)[:, None, None]
    volume = Volume(voxels, np.diag([1.0, 1.0, 2.0, 1.0]))
    above, below = (look(volume, (0.0, 0.01, z), 4.0) for z in (-1.0, 1.0))
    settings = {"window": (0.0, 700.0), "lowest_hu": -1000.0}
    found = overlay_slices(
        DeviceVolume(volume, device=device), above, (8, 8), slices=[1, 3, 6], opacity=0.25, **settings
    )
    assert (found.image[..., 3] == round(255 * (1.0 - 0.75**3))).all()
    hidden = [
        overlay_slices(DeviceVolume(volume, device=device), camera, (8, 8), slices=3, opacity=1.0, **settings)
        for camera in (above, below)
    ]
    assert (hidden[0].image[..., 0] == round(255 * 600 / 700)).all()  # slices 0, 3 and 6, from the head: 6
    assert (hidden[1].image[..., 0] == 0).all() and (hidden[1].image[..., 3] == 255).all()
    assert np.abs(hidden[0].depth - (150.0 - 5.0)).max() < 0.1  # slice 6 lies 5 mm above the middle


def test_slices_take_the_colours_of_a_transfer_function(device):
    volume = make_volume(lambda p: np.full(len(p), 150.0), "even", 8.0, np.int16)
    function = TransferFunction([(0, 1, 0, 0, 0), (300, 0, 1, 0, 0)])
    found = overlay_slices(
        DeviceVolume(volume, device=device),
        look(volume, (0.0, 0.1, -1.0), 2.0),
        (4, 4),
        slices=[4],
        opacity=1.0,
        transfer_function=function,
    )
    assert np.abs(found.image[..., :3].astype(int) - (128, 128, 0)).max() <= 1


def test_parts_that_fit_the_memory_give_the_same_picture(device):
    volume = make_volume(blobs, "oblique", 26.0, np.int16)
    camera, slices, size = look(volume, (0.4, 0.8, -0.7), 14.0, True), list(range(0, 20, 2)), (16, 12)
    whole = overlay_slices(DeviceVolume(volume, device=device), camera, size, slices=slices)
    picture, one = 44 * size[0] * size[1], volume.voxels[0].nbytes
    assert picture + 3 * one < 10 * one
    parts = overlay_slices(DeviceVolume(volume, device=device, memory=picture + 3 * one), camera, size, slices=slices)
    assert np.array_equal(whole.image, parts.image)
    assert np.array_equal(whole.depth, parts.depth, equal_nan=True)
    with refused(DeviceError, "slices"):
        overlay_slices(DeviceVolume(volume, device=device, memory=picture), camera, size, slices=slices)


def test_slices_that_are_seen_edge_on_are_warned_of(device):
    volume = make_volume(blobs, "even", 8.0, np.int16)
    camera = Camera.fit(volume, "anterior")
    assert "edge-on" in overlay_slices(DeviceVolume(volume, device=device), camera, (8, 8)).report["warnings"][0]
    assert not overlay_slices(DeviceVolume(volume, device=device), Camera.fit(volume, (30, 20)), (8, 8)).report[
        "warnings"
    ]


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_slices_show_without_a_view_and_in_a_scene_too(device, axis):
    """Slices across each axis of the patient, all tissue: edge-on from the front, unless they are coronal."""
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, :3] = np.roll(affine[:3, :3], axis, axis=1)
    volume = Volume(np.full((16, 16, 16), 100, np.int16), affine)
    for shown in (volume, [(volume, SlicesInSpace())]):
        style = {} if shown is not volume else {"mode": "slices"}
        picture = clrecon.render(shown, size=(64, 64), device=device, **style)
        assert not [text for text in picture.report["warnings"] if "edge-on" in text]
        assert np.isfinite(picture.depth).mean() > 0.25
        assert np.allclose(picture.camera.basis().forward, -find_view((30, 30))[0])


def test_slices_are_chosen_evenly_or_by_number():
    volume = Volume(np.zeros((100, 2, 2), np.int16), np.eye(4))
    assert choose_slices(volume) == [0, 9, 18, 27, 36, 45, 54, 63, 72, 81, 90, 99]
    assert choose_slices(volume, 40) == [0, 40, 80]
    assert choose_slices(volume, [7, 3]) == [3, 7]
    assert choose_slices(Volume(np.zeros((3, 2, 2), np.int16), np.eye(4))) == [0, 1, 2]


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"slices": 0}, "every 0th slice"),
        ({"slices": [1, 99]}, "slice 99 is not there: the volume has slices 0 to 8"),
        ({"slices": [1, 1]}, "twice"),
        ({"slices": []}, "whole numbers"),
        ({"slices": [0.5]}, "whole numbers"),
        ({"slices": "all"}, "whole numbers"),
        ({"opacity": 0.0}, "opacity of a slice"),
        ({"opacity": 1.5}, "opacity of a slice"),
        ({"lowest_hu": "air"}, "lowest HU"),
        ({"window": (5, 5)}, "window"),
        ({"window": (0, 9), "transfer_function": TransferFunction([(0, 0, 0, 0, 0), (1, 1, 1, 1, 1)])}, "not by both"),
    ],
)
def test_bad_input_is_refused(device, wrong, says):
    volume = make_volume(blobs, "even", 8.0, np.int16)
    with pytest.raises(UsageError, match=says):
        overlay_slices(DeviceVolume(volume, device=device), Camera.fit(volume), (8, 8), **wrong)


def test_progress_of_an_overlay_counts_its_slices(device):
    volume = make_volume(blobs, "uneven", dtype=np.int16)
    told: list[tuple] = []
    style = SlicesInSpace(slices=[1, 4, 7], opacity=0.4, lowest_hu=-300.0, window=WINDOW)
    camera = look(volume, (0.4, 0.8, -0.7), 14.0, False)
    resident = DeviceVolume(volume, device=device)
    operator.overlay_slices(resident, style, Shot(camera, SIZE, progress=lambda *said: told.append(said)))
    assert told == [("slabs", 0, 3), ("slabs", 3, 3)]
