"""Pictures fit what is left of a volume: masked, clipped, labels hidden."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from variants import daily_rows, each_value

import clrecon
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.operators.rays import volume_renderer
from clrecon.operators.rays.scene import _box_of
from clrecon.operators.rays.volume_renderer import shown_box
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

MM = 1.5
AFFINE = np.diag((MM, MM, MM, 1.0))


BLOCK_CENTRE = 4.5  # of the first block, voxels from 2 to 7


@pytest.fixture(scope="module")
def two_blocks() -> tuple[Volume, LabelMap]:
    """Blocks of 600 HU in opposite corners, labels 1 and 2: 6 and 8 voxels wide in 40 x 40 x 40."""
    voxels, labels = np.full((40, 40, 40), -1000, np.int16), np.zeros((40, 40, 40), np.uint8)
    for number, part in ((1, slice(2, 8)), (2, slice(30, 38))):
        voxels[part, part, part] = 600
        labels[part, part, part] = number
    return Volume(voxels, AFFINE), LabelMap(labels, AFFINE)


def first_block(volume: Volume, device: object) -> Volume:
    """The volume with air in place of all but the first block."""
    return clrecon.Mask.from_box(volume, (0, 20, 0, 20, 0, 20), device=device).apply(volume)


def seen_share(picture: clrecon.Rendering) -> float:
    """Return the larger share of width and height over which something is seen."""
    seen = np.argwhere(np.isfinite(picture.depth))
    return float(((np.ptp(seen, axis=0) + 1) / picture.depth.shape).max())


def test_camera_of_a_whole_volume_fits_its_box(two_blocks, device):
    volume, _ = two_blocks
    picture = clrecon.render(volume, "surface", size=(60, 60), device=device)
    assert picture.camera == Camera.fit(volume, size=(60, 60))


@pytest.mark.parametrize(
    ("kind", "mode"),
    daily_rows(
        3, [*each_value(["clip", "mask"], ["dvr", "slices", "surface", "mip"]), ("label", "surface"), ("label", "dvr")]
    ),
)
def test_first_of_two_blocks_is_in_the_middle_and_fills_the_picture_where_the_other_is_hidden(
    two_blocks, device, kind, mode
):
    volume, labels = two_blocks
    options: dict[str, object] = {"iso_value": 200.0} if mode == "surface" else {}
    if kind == "label":
        options |= {"labels": labels, "label_opacity": {2: 0.0}}
    elif kind == "clip":
        options["clip"] = Clip.box((0, 0, 0), (30, 30, 30))
    else:
        volume = first_block(volume, device)

    picture = clrecon.render(volume, mode, view="superior", size=(80, 80), device=device, **options)

    off_mm = np.abs(np.subtract(picture.camera.focal_point, BLOCK_CENTRE * MM)).max()
    assert off_mm < 1.6 * MM  # the box is one of bricks of four voxels
    if mode != "mip":
        assert seen_share(picture) >= 0.6  # the block and a voxel around it: 6 of 8, less the blur of its edge


def test_slice_of_a_masked_volume_goes_through_the_middle_of_what_is_left(two_blocks, device):
    volume, _ = two_blocks
    picture = clrecon.render(first_block(volume, device), "slice", view="axial", size=(64, 64), device=device)
    assert np.allclose(picture.camera.focal_point, BLOCK_CENTRE * MM)
    assert picture.values[32, 32] == 600.0  # of 64 x 64 pixels
    assert (picture.values > 0.0).mean() > 0.5  # the block fills most of the picture


def test_slice_through_a_given_centre_shows_the_whole_volume_around_it(two_blocks, device):
    volume, _ = two_blocks
    in_second_block = (51.0, 50.0, 49.0)
    picture = clrecon.render(volume, "slice", view="axial", size=(64, 64), center=in_second_block, device=device)
    assert picture.camera.focal_point == in_second_block
    assert picture.values[32, 32] == 600.0  # of 64 x 64 pixels
    assert picture.camera.parallel_scale == pytest.approx(0.5 * 40 * MM)  # half the height of all 40 rows


SECOND_BLOCK_MM = (33.5 * MM,) * 3


def test_picture_around_a_given_centre_is_zoomed_about_it(two_blocks, device):
    volume, _ = two_blocks
    size = (64, 64)
    picture = clrecon.render(volume, "surface", center=SECOND_BLOCK_MM, zoom=4.0, size=size, device=device)
    assert picture.camera.focal_point == SECOND_BLOCK_MM
    assert picture.camera.parallel_scale == Camera.fit(volume, size=size).parallel_scale / 4.0
    hit = np.argwhere(np.isfinite(picture.depth))
    assert len(hit) > 2000  # of 4096 pixels; measured 2292
    assert np.allclose(hit.mean(axis=0), (64 - 1) / 2, atol=1.0)  # in the middle


def test_a_centre_outside_of_the_volume_is_refused(two_blocks, device):
    volume, _ = two_blocks
    with refused(UsageError, 900, "outside"):
        clrecon.render(volume, "surface", center=(0, 0, 900), device=device)


def test_a_centre_beside_a_camera_is_refused(two_blocks, device):
    volume, _ = two_blocks
    with refused(UsageError, "center"):
        clrecon.render(volume, "surface", center=SECOND_BLOCK_MM, camera=Camera.fit(volume), device=device)


def test_a_centre_of_a_curved_reformation_is_refused(two_blocks, device):
    volume, _ = two_blocks
    with refused(UsageError, "center", "cpr"):
        clrecon.render(volume, "cpr", center=SECOND_BLOCK_MM, device=device)


def test_box_of_a_scene_holds_the_rest_of_a_clipped_volume_and_its_meshes(two_blocks):
    """The first block ends before 8 voxels, the mesh at 30 mm along x and 9 mm along y and z."""
    volume, _ = two_blocks
    look = clrecon.VolumeLook(clip=Clip.box((0, 0, 0), (30, 30, 30)))
    mesh = clrecon.Mesh([(20.0, 0, 0), (30, 0, 0), (30, 9, 9)], [(0, 1, 2)])
    box = _box_of([(volume, look), (mesh, clrecon.MeshLook())])
    first_centre, voxel = box.affine[:3, 3], np.diag(box.affine)[:3]  # of a box of a single voxel
    ends = first_centre + 0.5 * voxel
    assert np.allclose(ends, (30.0, 8 * MM, 8 * MM))


def width_of_shown_box(volume: Volume, rows: list) -> float:
    """Of a volume in a clip box that holds all of it, mm along x; rows of a transfer function: HU, colour, opacity."""
    look = clrecon.VolumeLook(clrecon.TransferFunction(rows), clip=Clip.box((-99, -99, -99), (99, 99, 99)))
    return float(np.diag(shown_box(volume, look).affine)[0])


def test_box_of_a_transfer_function_holds_the_edges_of_blocks_where_it_shows_the_hu_between(two_blocks):
    """From -200 to 100 HU only edges are seen: from voxel 1 to voxel 38."""
    volume, _ = two_blocks
    rows = [(-200.0, 1, 1, 1, 0.0), (-100.0, 1, 1, 1, 0.5), (100.0, 1, 1, 1, 0.0)]
    assert width_of_shown_box(volume, rows) == pytest.approx((38 - 1) * MM)


def test_box_of_a_transparent_transfer_function_is_that_of_the_volume(two_blocks):
    volume, _ = two_blocks
    rows = [(0.0, 1, 1, 1, 0.0), (9.0, 1, 1, 1, 0.0)]
    assert width_of_shown_box(volume, rows) == pytest.approx(40 * MM)


@pytest.mark.parametrize(
    ("style", "look"),
    [
        ("dvr", {"preset": "bone"}),
        ("surface", {"iso_value": 300, "color": (1.0, 0.5, 0.0)}),
        ("surface", {"iso_value": 300, "clip": Clip.box((0, 0, 0), (30, 30, 30))}),
        ("slices", {"slices": [3, 9]}),
        ("surface", {"label_opacity": {1: 0.0}}),
    ],
)
def test_the_box_of_equal_styles_is_found_once_for_three_pictures(two_blocks, device, monkeypatch, style, look):
    """Keywords make a new style for each picture."""
    volume, labels = two_blocks
    searches = []
    monkeypatch.setattr(volume_renderer, "shown_box", lambda *given: searches.append(given) or shown_box(*given))
    look = look | ({"labels": labels} if "label_opacity" in look else {})
    with clrecon.VolumeRenderer(volume, device=device) as renderer:
        first, second, third = (renderer.render(style, size=(20, 20), **look) for _ in range(3))
    assert len(searches) == 1
    assert first.camera == second.camera == third.camera


def test_a_renderer_finds_the_box_of_each_style_after_another(two_blocks, device):
    volume, labels = two_blocks
    looks = [
        {"clip": Clip.box((0, 0, 0), (30, 30, 30))},
        {"clip": Clip.box((0, 0, 0), (60, 60, 60))},
        {"labels": labels, "label_opacity": {1: 0.0}},
        {"labels": labels, "label_opacity": {2: 0.0}},
        {"labels": labels, "label_opacity": {0: 0.0}},
        {},
    ]
    with clrecon.VolumeRenderer(volume, device=device) as renderer:
        for look in looks:
            style = clrecon.SurfaceLook(300, **look)
            assert (renderer.frame(style).affine == shown_box(volume, style).affine).all(), look
