"""Parts of a scan in a view: found, hidden, coloured, carried to pictures, slices and meshes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import view_scenes as scenes
from open_views import find, open_painters, shown_pixels
from variants import daily

from clrecon.geometry import Volume
from clrecon.operators.rays.render import render
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.viewer.model.parts import _box_of, grow_labels

pytestmark = pytest.mark.opencl

SIZE = (96, 80)


@pytest.fixture
def open_model_and_painter(device):
    """A function that makes the model and the painter of objects, by default of a scan of three balls."""
    with open_painters(device) as make:
        yield make


@pytest.mark.parametrize("plane", ["coronal", "sagittal"])
def test_parts_lie_over_their_bone_in_slices_of_an_uneven_scan(open_model_and_painter, plane):
    scan = scenes.make_scan()
    steps = 0.4 + 1.2 * np.arange(22) / 21  # of a step of the even scan, 0.4 to 1.6
    heights = scan.affine[:3, 3] + np.cumsum(steps)[:, None] * scan.affine[:3, 2]
    model, painter = open_model_and_painter(Volume(scan.voxels, scan.affine, slice_positions=heights))
    find(model, painter)
    model.set_color("1/1", (1.0, 0.0, 0.0))
    [middle] = painter.objects[0].volume.ijk_to_lps([scenes.BALLS[0].middle_ijk])
    model.set_cross(tuple(middle))
    picture = painter.slice(model.state, plane, (200, 200))
    tinted = picture.image[..., 0].astype(int) - picture.image[..., 1] > 30  # of 255: more red than green
    bone = np.nan_to_num(picture.values, nan=-1000.0) >= scenes.ISO
    assert tinted[bone].mean() > 0.97  # measured 1
    assert bone[tinted].mean() > 0.6  # parts are grown by a voxel: measured 0.74


def test_parts_of_a_scan_are_the_scan_its_three_balls_from_the_largest_on_and_the_rest(open_model_and_painter):
    model, painter = open_model_and_painter()

    find(model, painter)

    scan, *balls, rest = model.state.parts  # their keys: the number of the object, and that of the part in it
    assert (scan.key, scan.kind) == ("1", "scan")
    assert [part.key for part in balls] == ["1/1", "1/2", "1/3"]
    assert balls[0].ml > balls[1].ml > balls[2].ml  # their radii are 9, 5 and 3 mm
    assert (rest.key, rest.kind) == ("1/0", "rest")


def test_model_and_painter_know_that_parts_are_found(open_model_and_painter):
    model, painter = open_model_and_painter()
    assert not model.parts_known
    assert not painter.has_parts(model.state)

    find(model, painter)

    assert model.parts_known
    assert painter.has_parts(model.state)


@pytest.mark.parametrize("number", [0, 1, 2], ids=["first ball", "second ball", "third ball"])
def test_part_of_a_ball_has_its_volume_its_box_and_a_point_in_it(open_model_and_painter, number):
    model, painter = open_model_and_painter()
    find(model, painter)
    middle, radius = scenes.middle(number), scenes.BALLS[number].radius_mm

    (part,) = (part for part in model.state.parts if part.key == f"1/{number + 1}")

    ball_ml = 4 / 3 * np.pi * radius**3 / 1000.0
    assert part.ml == pytest.approx(ball_ml, rel=0.04)  # counted in voxels of about 1 mm; measured 0.019
    low, high = np.array(part.box)
    voxel_mm = 1.5  # the longest side, 1.4 mm, and rounding
    assert (low <= middle - radius + voxel_mm).all()
    assert (high >= middle + radius - voxel_mm).all()
    assert np.linalg.norm(np.subtract(part.inside, middle)) < radius


def test_parts_of_a_scan_are_found_once(open_model_and_painter):
    model, painter = open_model_and_painter()
    assert painter.find_parts(model.state)[0] is painter.find_parts(model.state)[0]


def test_parts_beyond_the_twenty_largest_are_one_of_them_together(open_model_and_painter):
    voxels = np.full((9, 30, 40), -500, np.int16)
    voxels[1::3, 1::3, 1::3] = 700  # 3 x 10 x 13 lone voxels
    voxels[1, 1, 1:3] = 700  # the first of them becomes two
    model, painter = open_model_and_painter(Volume(voxels, np.eye(4)))
    find(model, painter)
    clusters = [each for each in model.state.parts if each.kind == "cluster"]
    count = 3 * 10 * 13
    assert len(clusters) == 21 and clusters[0].count == 2
    assert clusters[-1].name == f"{count - 20} smaller parts" and clusters[-1].count == count - 20
    model.only("1/1")
    (mesh,) = painter.mesh_of_shown(model.state)
    beside = (700 - scenes.ISO) / (700 + 500)  # of the 1 mm to the next voxel
    assert mesh.bounds[1] - mesh.bounds[0] == pytest.approx([1 + 2 * beside, 2 * beside, 2 * beside], abs=0.002)


def test_parts_and_looks_of_the_six_last_iso_values_are_kept(open_model_and_painter):
    model, painter = open_model_and_painter()
    for hu in range(200, 1000, 100):
        model.set_iso(float(hu))
        find(model, painter)
        model.set_color("1/1", (1.0, 0.1 * hu / 100.0, 0.0))
        painter.picture(model.state, SIZE)
    assert [key[1] for key in painter._found] == [400.0, 500.0, 600.0, 700.0, 800.0, 900.0]
    kept = [style for style in painter._looks._kept.values() if getattr(style, "labels", None) is not None]
    assert [style.iso_value for style in kept] == [400.0, 500.0, 600.0, 700.0, 800.0, 900.0]


def test_parts_of_the_two_last_iso_values_are_kept_whatever_their_size(open_model_and_painter):
    model, painter = open_model_and_painter()
    for hu in (200.0, 300.0, 400.0):
        model.set_iso(hu)
        find(model, painter)
        key, found = painter._found.popitem()
        half_a_gibibyte = SimpleNamespace(voxels=np.broadcast_to(np.uint8(0), 2**29))  # what all may take together
        painter._found[key] = replace(found, labels=half_a_gibibyte)
    assert [key[1] for key in painter._found] == [300.0, 400.0]


def test_scan_without_a_voxel_at_the_iso_value_has_no_parts_of_bone(open_model_and_painter):
    model, painter = open_model_and_painter(Volume(np.full((4, 5, 6), -900, np.int16), np.eye(4)))
    find(model, painter)
    assert [each.kind for each in model.state.parts] == ["scan", "rest"]


@pytest.mark.parametrize("uneven", [False, True], ids=["even", "uneven"])
@pytest.mark.parametrize("hidden", daily(1, [1, 2, 3]))
def test_hidden_part_is_neither_in_the_picture_nor_in_the_mesh(open_model_and_painter, device, hidden, uneven):
    scan = scenes.make_scan()
    if uneven:  # every second slice lies 0.3 of a step late
        heights = (
            scan.affine[:3, 3] + (np.arange(22)[:, None] + 0.3 * (np.arange(22) % 2)[:, None]) * scan.affine[:3, 2]
        )
        scan = Volume(scan.voxels, scan.affine, slice_positions=heights)
    model, painter = open_model_and_painter(scan)
    find(model, painter)
    model.show(f"1/{hidden}", visible=False)
    state = model.state
    (kept,) = painter.mesh_of_shown(state)
    whole = extract_isosurface(scan, scenes.ISO, device=device)
    pieces = sorted(whole.components(), key=lambda each: -each.area)
    of_the_others = sum(each.triangle_count for number, each in enumerate(pieces, 1) if number != hidden)
    assert kept.triangle_count == of_the_others
    assert kept.quality()["closed"]
    for view_name in ("anterior", "left", "superior"):
        model.look(view_name)
        picture = painter.picture(model.state, SIZE)
        mesh = render([(kept, MeshLook())], camera=model.camera, size=SIZE, background="transparent", device=device)
        differs = (picture.image[..., 3] > 0) != (mesh.image[..., 3] > 0)
        assert differs.mean() < 0.004  # of pixels, at the edges of the silhouette; measured 0.0016 at most
        seen = (picture.image[..., 3] > 0) & (mesh.image[..., 3] > 0)
        assert np.abs(picture.depth[seen] - mesh.depth[seen]).mean() < 0.05  # mm; measured 0.009 to 0.023


def test_volume_rendering_leaves_hidden_parts_out_with_their_edges(open_model_and_painter):
    model, painter = open_model_and_painter()
    find(model, painter)
    model.set_mode("bone")
    before = shown_pixels(painter.picture(model.state, SIZE))
    model.only("1/3")
    picture = painter.picture(model.state, SIZE)
    rows, columns = np.nonzero(picture.image[..., 3] > 8)
    (spot,), _ = model.camera.project([scenes.middle(2)], SIZE)
    assert 0 < len(rows) < 0.3 * before  # the smallest of three balls; measured 128 of 1394 pixels
    away_mm = np.hypot(columns + 0.5 - spot[0], rows + 0.5 - spot[1]) * model.camera.pixel_mm(SIZE)
    assert away_mm.max() < 6.5  # measured 6.4; with the ball beside it, 5.8 mm away and 5 mm in radius, 10.8


@pytest.fixture
def first_part(open_model_and_painter):
    """The model, the painter, the plain picture, and the pixel (row, column) of the middle of part 1."""
    model, painter = open_model_and_painter()
    find(model, painter)
    (pixel,), _ = model.camera.project([scenes.middle(0)], SIZE)
    column, row = pixel.astype(int)
    return model, painter, painter.picture(model.state, SIZE), (row, column)


def test_part_of_a_scan_is_drawn_in_its_colour_and_opacity(first_part):
    model, painter, plain, pixel = first_part

    model.set_color("1/1", (1.0, 0.0, 0.0))
    red = painter.picture(model.state, SIZE)
    model.set_opacity("1/1", 0.5)
    translucent = painter.picture(model.state, SIZE)

    red_level, green_level, *_ = red.image[pixel]
    _, green_before, *_ = plain.image[pixel]
    assert red_level > 200 and green_level < 100  # of 255: red in the light; measured 255 and 51
    assert green_before > 200  # measured 255
    assert translucent.image[(*pixel, 3)] == pytest.approx(0.5 * 255, abs=1)


def test_mesh_of_a_coloured_part_is_apart_from_the_rest_with_its_colour(first_part):
    model, painter, _, _ = first_part
    model.set_color("1/1", (1.0, 0.0, 0.0))

    part, rest = painter.mesh_of_shown(model.state)

    assert (part.report["part_name"], rest.report["part_name"]) == ("part 1", "scan 1")
    assert part.report["color"] == [1.0, 0.0, 0.0]


def test_undo_takes_colour_and_opacity_of_a_part_back(first_part):
    model, painter, plain, _ = first_part
    model.set_color("1/1", (1.0, 0.0, 0.0))
    model.set_opacity("1/1", 0.5)

    model.undo()
    model.undo()

    assert np.array_equal(painter.picture(model.state, SIZE).image, plain.image)


@pytest.fixture
def labelled(open_model_and_painter):
    """The model and painter of a scan with a label map, and the pixels of the middles of labels 1 and 2."""
    model, painter = open_model_and_painter(scenes.make_scan(), scenes.make_labels())
    assert painter.find_parts(model.state) == []
    assert model.parts_known
    (one, two), _ = model.camera.project([scenes.middle(0), scenes.middle(1)], SIZE)
    return model, painter, one, two


def test_labels_of_a_map_are_the_parts_of_the_scan_that_it_lies_in(labelled):
    model, painter, one, two = labelled
    assert painter.pick(model.state, SIZE, *one).part == "2/1"
    assert painter.pick(model.state, SIZE, *two).part == "2/2"


@pytest.mark.parametrize("mode", ["surface", "labels"])
def test_hidden_label_is_neither_picked_nor_meshed(labelled, mode):
    model, painter, _, two = labelled
    model.show("2/2", visible=False)
    model.set_mode(mode)

    assert painter.pick(model.state, SIZE, *two) is None
    assert [mesh.report["part_name"] for mesh in painter.mesh_of_shown(model.state)] == ["one"]


@pytest.mark.unit
def test_labels_grow_by_one_voxel_to_all_sides_within_the_map():
    voxels = np.zeros((5, 6, 7), np.uint8)
    voxels[2, 2, 2], voxels[4, 5, 6] = 3, 9  # one in the middle, one in the last corner
    grow_labels(voxels)
    assert (voxels[1:4, 1:4, 1:4] == 3).all() and (voxels == 3).sum() == 27
    assert (voxels[3:, 4:, 5:] == 9).all() and (voxels == 9).sum() == 8


def test_box_of_a_part_ends_with_its_voxels_in_mm() -> None:
    volume = Volume(np.zeros((9, 9, 9), np.int16), np.diag((0.5, -1.0, 2.0, 1.0)))
    assert _box_of(volume, low=(1, 2, 3), high=(4, 6, 5)) == ((0.25, -6.5, 5.0), (2.25, -1.5, 11.0))  # i, j, k
