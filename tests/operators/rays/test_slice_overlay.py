"""Slices in space: where they are, in which order they hide each other, and against their twin."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from raycast_scenes import GRIDS, blobs, centre_of, look, make_volume, premultiplied
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


def overlay_slices(resident, camera, size, **look):
    return operator.overlay_slices(resident, SlicesInSpace(**look), Shot(camera, size))


def assert_overlay_equals_twin(device, volume, camera, *, slices, clip=None, opacity=0.4):
    """The picture of some slices has the colours and depths of the twin's but for edges; return it."""
    style = SlicesInSpace(slices, opacity=opacity, lowest_hu=-300.0, window=WINDOW, clip=clip)
    found = operator.overlay_slices(DeviceVolume(volume, device=device), style, Shot(camera, SIZE))
    rgba, depth = overlay_twin(volume, camera, SIZE, style)
    assert (rgba[..., 3] > 0).mean() > 0.2  # measured 0.41 on
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
    camera = look(volume, (0.4, 0.8, -0.7), half_height=14.0, perspective=perspective)
    assert_overlay_equals_twin(device, volume, camera, slices=[1, 4, 7, 12])


def test_slices_from_below_behind_a_clip_plane_equal_the_twin(device):
    volume = make_volume(blobs, "uneven")
    clip = Clip.plane(centre_of(volume), (0.5, 0.4, 1.0))
    from_below = look(volume, (0.3, -0.6, 0.8), half_height=14.0)
    assert_overlay_equals_twin(device, volume, from_below, slices=[2, 3, 9, 14, 15], clip=clip)


def test_a_camera_between_bright_upper_and_dark_lower_slices_sees_both_as_the_twin(device):
    volume = make_volume(lambda p: 100.0 + 20.0 * p[:, 2], "even", extent=22.0, dtype=np.int16)
    centre = centre_of(volume) + (0.0, 0.0, 0.4)
    camera = Camera(tuple(centre), tuple(centre + (0.0, 1.0, 0.0)), (0, 0, 1), view_angle=120.0)
    found = assert_overlay_equals_twin(device, volume, camera, slices=[3, 9, 15, 21], opacity=1.0)
    upper, lower = found.image[:20, :, 0], found.image[-20:, :, 0]  # of 48 rows
    assert upper.mean() > lower.mean() + 10


@pytest.mark.oclgrind
def test_overlay_of_few_slices_equals_the_twin(device):
    volume = make_volume(blobs, "sheared", extent=6.0, dtype=np.int16)
    camera = look(volume, (0.4, 0.8, -0.7), half_height=5.0)
    found = overlay_slices(DeviceVolume(volume, device=device), camera, (12, 9), slices=[0, 2, 4], window=WINDOW)
    rgba, _ = overlay_twin(volume, camera, (12, 9), SlicesInSpace([0, 2, 4], window=WINDOW))
    away = np.abs(premultiplied(found.image) - 255.0 * rgba).max(axis=-1)
    assert (away <= 2.0).mean() > 0.95  # levels of 255; other pixels are at rims of slices


@pytest.fixture(params=[(grid, perspective) for grid in GRIDS for perspective in (False, True)], ids=str)
def marked_voxels(request, device):
    """A volume of air with a patch of 3 x 3 voxels of 600 HU in slice k, its place, a camera, and k."""
    grid, perspective = request.param
    volume = make_volume(lambda p: np.full(len(p), -900.0), grid, extent=16.0, dtype=np.int16)
    k, j, i = volume.voxels.shape[0] // 3, volume.voxels.shape[1] // 2, 5
    voxels = volume.voxels.copy()
    voxels[k, j - 1 : j + 2, i - 1 : i + 2] = 600
    camera = look(volume, (0.2, 0.5, 0.9), half_height=12.0, perspective=perspective)
    resident = DeviceVolume(volume.with_voxels(voxels), device=device)
    return resident, volume.ijk_to_lps([(i, j, k)]), camera, k


def test_marked_voxels_are_seen_alone_where_the_camera_projects_them(marked_voxels):
    resident, place, camera, k = marked_voxels
    size = (160, 160)
    found = overlay_slices(resident, camera, size, slices=[0, k, k + 1], opacity=0.7)
    (pixel,), (depth,) = camera.project(place, size)
    column, row = pixel.astype(int)
    assert found.image[row, column, 3] == round(0.7 * 255)
    assert found.depth[row, column] == pytest.approx(depth, abs=camera.pixel_mm(size))
    seen = np.argwhere(found.image[..., 3] > 0)[:, ::-1] + 0.5  # columns and rows
    assert np.abs(seen.mean(axis=0) - pixel).max() < 1.0
    to_a_corner_mm = 1.5 * np.hypot(*resident.volume.spacing[:2])  # of the 3 x 3 voxels
    assert np.abs(seen - pixel).max() < to_a_corner_mm / camera.pixel_mm(size) + 1.0  # pixels: nothing else is seen


def test_overlay_of_other_slices_than_that_of_marked_voxels_is_empty(marked_voxels):
    resident, _, camera, k = marked_voxels
    found = overlay_slices(resident, camera, (160, 160), slices=[0, k + 2])
    assert not found.image.any()
    assert np.isnan(found.depth).all()


@pytest.fixture
def stair(device):
    """Slices 2 mm apart with 0, 100 ... 700 HU, and a function that overlays some of them, seen from a side."""
    voxels = np.zeros((8, 12, 12), np.int16) + 100 * np.arange(8, dtype=np.int16)[:, None, None]
    volume = Volume(voxels, np.diag([1.0, 1.0, 2.0, 1.0]))

    def overlay(from_side, *, slices, opacity):
        camera = look(volume, (0.0, 0.01, -1.0 if from_side == "head" else 1.0), half_height=4.0)
        return overlay_slices(
            DeviceVolume(volume, device=device), camera, (8, 8), slices=slices, opacity=opacity,
            window=(0.0, 700.0), lowest_hu=-1000.0,
        )  # fmt: skip

    return overlay


def test_three_slices_let_through_what_each_lets_through(stair):
    found = stair("head", slices=[1, 3, 6], opacity=0.25)
    assert (found.image[..., 3] == round(255 * (1.0 - 0.75**3))).all()


@pytest.mark.parametrize(("from_side", "front"), [("head", 6), ("feet", 0)])
def test_the_front_slice_of_opaque_ones_hides_the_others(stair, from_side, front):
    """Slice 6 has 600 HU, in a window of 0 to 700."""
    found = stair(from_side, slices=[0, 3, 6], opacity=1.0)
    assert (found.image[..., 0] == round(255 * 100 * front / 700)).all()
    assert (found.image[..., 3] == 255).all()


def test_depth_of_opaque_slices_is_that_of_the_front_one(stair):
    """Slice 6 lies 5 mm above the middle, which is 200 mm away."""
    found = stair("head", slices=[0, 3, 6], opacity=1.0)
    assert found.depth == pytest.approx(np.full((8, 8), 200.0 - 5.0), abs=0.1)  # it leans


def test_slices_take_the_colours_of_a_transfer_function(device):
    volume = make_volume(lambda p: np.full(len(p), 150.0), "even", extent=8.0, dtype=np.int16)
    function = TransferFunction([(0, 1, 0, 0, 0), (300, 0, 1, 0, 0)])  # red at 0 HU, green at 300 HU
    camera, style = look(volume, (0.0, 0.1, -1.0), half_height=2.0), {"opacity": 1.0, "transfer_function": function}
    found = overlay_slices(DeviceVolume(volume, device=device), camera, (4, 4), slices=[4], **style)
    assert np.abs(found.image[..., :3].astype(int) - (128, 128, 0)).max() <= 1  # 150 HU are half way: 127.5 of 255


@pytest.fixture
def ten_slices():
    """A volume, a camera and settings of ten slices; bytes of the picture and of a slice."""
    volume = make_volume(blobs, "oblique", extent=26.0, dtype=np.int16)
    camera, size = look(volume, (0.4, 0.8, -0.7), half_height=14.0, perspective=True), (16, 12)
    bytes_a_pixel = 12 + 32  # of the picture, and of the state of its ray
    return volume, camera, size, list(range(0, 20, 2)), bytes_a_pixel * size[0] * size[1], volume.voxels[0].nbytes


def test_slices_that_do_not_fit_together_give_the_same_picture(device, ten_slices):
    volume, camera, size, slices, picture_bytes, slice_bytes = ten_slices
    memory = picture_bytes + 3 * slice_bytes
    assert memory < len(slices) * slice_bytes
    whole = overlay_slices(DeviceVolume(volume, device=device), camera, size, slices=slices)
    parts = overlay_slices(DeviceVolume(volume, device=device, memory=memory), camera, size, slices=slices)
    assert np.array_equal(whole.image, parts.image)
    assert np.array_equal(whole.depth, parts.depth, equal_nan=True)


def test_an_overlay_without_room_for_a_slice_is_refused(device, ten_slices):
    volume, camera, size, slices, picture_bytes, _ = ten_slices
    with refused(DeviceError, "slices"):
        overlay_slices(DeviceVolume(volume, device=device, memory=picture_bytes), camera, size, slices=slices)


@pytest.mark.parametrize(("view", "warned"), [("anterior", True), ((30, 20), False)], ids=["edge-on", "slanted"])
def test_slices_that_are_seen_edge_on_are_warned_of(device, view, warned):
    volume = make_volume(blobs, "even", extent=8.0, dtype=np.int16)
    found = overlay_slices(DeviceVolume(volume, device=device), Camera.fit(volume, view), (8, 8))
    assert ["edge-on" in text for text in found.report["warnings"]] == [True] * warned


@pytest.mark.parametrize("in_scene", [False, True], ids=["alone", "in a scene"])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_slices_without_a_view_are_seen_at_a_slant(device, axis, in_scene):
    """Slices across each axis of the patient, all tissue: edge-on from the front, unless they are coronal."""
    affine = np.diag([2.0, 2.0, 2.0, 1.0])
    affine[:3, :3] = np.roll(affine[:3, :3], axis, axis=1)
    volume = Volume(np.full((16, 16, 16), 100, np.int16), affine)
    if in_scene:
        picture = clrecon.render([(volume, SlicesInSpace())], size=(64, 64), device=device)
    else:
        picture = clrecon.render(volume, "slices", size=(64, 64), device=device)
    assert not [text for text in picture.report["warnings"] if "edge-on" in text]
    assert np.isfinite(picture.depth).mean() > 0.25  # measured 0.62 on
    towards_camera, _ = find_view((30, 30))
    assert np.allclose(picture.camera.basis().forward, -towards_camera)


@pytest.mark.parametrize(
    ("slices", "given", "chosen"),
    [(100, None, list(range(0, 100, 9))), (3, None, [0, 1, 2]), (100, 40, [0, 40, 80]), (100, [7, 3], [3, 7])],
    ids=["twelve by default", "all of few", "every n-th", "listed"],
)
def test_slices_are_chosen_evenly_or_by_number(slices, given, chosen):
    volume = Volume(np.zeros((slices, 2, 2), np.int16), np.eye(4))
    assert choose_slices(volume, given) == chosen


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
def test_wrong_arguments_of_an_overlay_are_refused(device, wrong, says):
    volume = make_volume(blobs, "even", extent=8.0, dtype=np.int16)
    with pytest.raises(UsageError, match=says):
        overlay_slices(DeviceVolume(volume, device=device), Camera.fit(volume), (8, 8), **wrong)


def test_progress_of_an_overlay_counts_its_slices(device):
    volume = make_volume(blobs, "uneven", dtype=np.int16)
    told: list[tuple] = []
    style = SlicesInSpace(slices=[1, 4, 7], opacity=0.4, lowest_hu=-300.0, window=WINDOW)
    camera = look(volume, (0.4, 0.8, -0.7), half_height=14.0, perspective=False)
    resident = DeviceVolume(volume, device=device)
    operator.overlay_slices(resident, style, Shot(camera, SIZE, progress=lambda *said: told.append(said)))
    assert told == [("slabs", 0, 3), ("slabs", 3, 3)]
