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


@pytest.fixture(scope="module")
def two_blocks() -> tuple[Volume, LabelMap]:
    """Blocks of 600 HU in opposite corners, labels 1 and 2: 6 and 8 voxels wide in 40 x 40 x 40."""
    voxels, labels = np.full((40, 40, 40), -1000, np.int16), np.zeros((40, 40, 40), np.uint8)
    for number, part in ((1, slice(2, 8)), (2, slice(30, 38))):
        voxels[part, part, part] = 600
        labels[part, part, part] = number
    return Volume(voxels, AFFINE), LabelMap(labels, AFFINE)


def filled(picture: clrecon.Rendering) -> float:
    """Return the larger share of width and height over which something is seen."""
    seen = np.argwhere(np.isfinite(picture.depth))
    return float(((np.ptp(seen, axis=0) + 1) / picture.depth.shape).max())


def test_the_whole_volume_fits_where_nothing_is_taken_away(two_blocks, device):
    volume, _ = two_blocks
    picture = clrecon.render(volume, "surface", size=(60, 60), device=device)
    assert picture.camera == Camera.fit(volume, size=(60, 60))


@pytest.mark.parametrize(
    ("kind", "mode"),
    daily_rows(
        3, [*each_value(["clip", "mask"], ["dvr", "slices", "surface", "mip"]), ("label", "surface"), ("label", "dvr")]
    ),
)
def test_rest_of_a_masked_volume_fills_the_picture(two_blocks, device, kind, mode):
    volume, labels = two_blocks
    look: dict[str, object] = {"iso_value": 200.0} if mode == "surface" else {}
    if kind == "label":
        look |= {"labels": labels, "label_opacity": {2: 0.0}}
    elif kind == "clip":
        look["clip"] = Clip.box((0, 0, 0), (30, 30, 30))
    else:
        volume = clrecon.Mask.from_box(volume, (0, 20, 0, 20, 0, 20), device=device).apply(volume)
    picture = clrecon.render(volume, mode, view="superior", size=(80, 80), device=device, **look)
    assert np.abs(np.subtract(picture.camera.focal_point, 4.5 * MM)).max() < 1.6 * MM
    if mode != "mip":
        assert filled(picture) >= 0.6  # the block and a voxel around it: 6 of 8, less the blur of its edge


def test_a_slice_goes_through_the_middle_of_what_is_left(two_blocks, device):
    volume, _ = two_blocks
    left = clrecon.Mask.from_box(volume, (0, 20, 0, 20, 0, 20), device=device).apply(volume)
    picture = clrecon.render(left, "slice", view="axial", size=(64, 64), device=device)
    assert np.allclose(picture.camera.focal_point, 4.5 * MM) and picture.values[32, 32] == 600.0
    assert (picture.values > 0.0).mean() > 0.5
    moved = clrecon.render(volume, "slice", view="axial", size=(64, 64), center=(51, 50, 49), device=device)
    assert moved.camera.focal_point == (51.0, 50.0, 49.0) and moved.values[32, 32] == 600.0
    assert moved.camera.parallel_scale == pytest.approx(0.5 * 40 * MM)


def test_a_centre_is_in_the_middle_and_zoom_goes_with_it(two_blocks, device):
    volume, _ = two_blocks
    at = (33.5 * MM, 33.5 * MM, 33.5 * MM)
    picture = clrecon.render(volume, "surface", center=at, zoom=4.0, size=(64, 64), device=device)
    plain = Camera.fit(volume, size=(64, 64))
    assert picture.camera.focal_point == at and picture.camera.parallel_scale == plain.parallel_scale / 4.0
    hit = np.argwhere(np.isfinite(picture.depth))
    assert np.allclose(hit.mean(axis=0), 31.5, atol=1.0) and len(hit) > 900
    with refused(UsageError, 900, "outside"):
        clrecon.render(volume, "surface", center=(0, 0, 900), device=device)
    with refused(UsageError, "center"):
        clrecon.render(volume, "surface", center=at, camera=plain, device=device)
    with refused(UsageError, "center", "cpr"):
        clrecon.render(volume, "cpr", center=at, device=device)


def test_a_scene_fits_what_is_left_and_its_meshes(two_blocks):
    volume, _ = two_blocks
    look = clrecon.VolumeLook(clip=Clip.box((0, 0, 0), (30, 30, 30)))
    mesh = clrecon.Mesh([(20.0, 0, 0), (30, 0, 0), (30, 9, 9)], [(0, 1, 2)])
    box = _box_of([(volume, look), (mesh, clrecon.MeshLook())])
    assert np.allclose(box.affine[:3, 3] + 0.5 * np.diag(box.affine)[:3], (30.0, 8 * MM, 8 * MM))


def test_transfer_functions_show_bands(two_blocks):
    volume, _ = two_blocks
    cut = Clip.box((-99, -99, -99), (99, 99, 99))
    rows = [(-200.0, 1, 1, 1, 0.0), (-100.0, 1, 1, 1, 0.5), (100.0, 1, 1, 1, 0.0)]
    between = clrecon.VolumeLook(clrecon.TransferFunction(rows), clip=cut)  # -200 to 100 HU: only edges of the blocks
    nothing = clrecon.VolumeLook(clrecon.TransferFunction([(0.0, 1, 1, 1, 0.0), (9.0, 1, 1, 1, 0.0)]), clip=cut)
    assert np.diag(shown_box(volume, between).affine)[0] == pytest.approx(37 * MM)  # from voxel 1 to voxel 38
    assert np.diag(shown_box(volume, nothing).affine)[0] == pytest.approx(40 * MM)


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
def test_the_box_of_equal_styles_is_found_once(two_blocks, device, monkeypatch, style, look):
    """Keywords make a new style for each picture."""
    volume, labels = two_blocks
    found = []
    monkeypatch.setattr(volume_renderer, "shown_box", lambda *given: found.append(given) or shown_box(*given))
    look = look | ({"labels": labels} if "label_opacity" in look else {})
    with clrecon.VolumeRenderer(volume, device=device) as renderer:
        pictures = [renderer.render(style, size=(20, 20), **look) for _ in range(3)]
    assert len(found) == 1
    assert pictures[0].camera == pictures[1].camera == pictures[2].camera


def test_another_part_of_the_volume_gets_another_box(two_blocks, device):
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
            assert (renderer.frame(style).affine == shown_box(volume, style).affine).all()
