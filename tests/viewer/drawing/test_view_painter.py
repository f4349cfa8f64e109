"""Pictures, picks, parts and meshes of a view's states, on a small scan of three balls."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
import view_scenes as scenes
from open_views import find, open_painters, shown_pixels
from refusals import refused

from clrecon.errors import Cancelled, NoSurfaceError, UsageError
from clrecon.mesh import Mesh
from clrecon.mesh.compare.distances import SurfaceDistance
from clrecon.operators.rays.render import render
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.model.state import Pick

pytestmark = pytest.mark.opencl

SIZE = (96, 80)


@pytest.fixture
def view(device):
    with open_painters(device) as make:
        yield make


@pytest.mark.release
def test_every_mode_makes_a_picture_sharp_and_coarse(view):
    model, painter = view(scenes.make_scan(), scenes.make_mesh(), scenes.make_cloud(), scenes.make_labels())
    for mode in model.modes:
        model.set_mode(mode)
        sharp = painter.picture(model.state, SIZE)
        coarse = painter.picture(model.state, SIZE, sharp=False, share=0.5)
        assert sharp.size == SIZE and shown_pixels(sharp) > 100, mode
        assert sharp.report["sharp"] and sharp.report["ms"] > 0.0
        assert coarse.size == (77, 64) and not coarse.report["sharp"], mode  # the shorter side has 64 pixels at least
        assert shown_pixels(coarse) > 50


def test_a_surface_picture_is_that_of_render(view, device):
    model, painter = view()
    mine = painter.picture(model.state, SIZE)
    other = render(
        model.objects[0].volume, "surface", iso_value=scenes.ISO, camera=model.camera, size=SIZE,
        background="transparent", device=device,
    )  # fmt: skip
    assert np.array_equal(mine.image, other.image)


@pytest.mark.parametrize("mode", ["surface", "bone", "mip", "drr", "slices"])
def test_a_large_picture_in_strips_is_the_same(view, monkeypatch, mode):
    from clrecon.viewer.drawing import painter as module

    model, painter = view()
    model.set_mode(mode)
    model.turn(0.1, 0.05)
    large = 512, 520
    parts = painter.picture(model.state, large)
    monkeypatch.setattr(module, "take_strips", lambda take, camera, size: take(camera, size))
    whole = painter.picture(model.state, large)
    monkeypatch.undo()
    assert parts.report.get("strips", 1) == (1 if mode == "drr" else 2) and parts.camera == whole.camera
    apart = np.abs(parts.image.astype(int) - whole.image.astype(int)).max(axis=2)
    assert (apart > 3).mean() < (0.3 if mode == "bone" else 0.002)  # samples of volume rendering lie at random places
    both = ~np.isnan(parts.depth) & ~np.isnan(whole.depth)
    assert both.any() == (mode != "drr")  # a radiograph has no depth
    if both.any():
        assert np.median(np.abs(parts.depth[both] - whole.depth[both])) < (0.3 if mode == "bone" else 1e-3)
    if mode != "drr":
        asked = []
        with pytest.raises(Cancelled):
            painter.picture(model.state, large, cancelled=lambda: bool(asked.append(1)) or len(asked) > 2)


def test_a_cancelled_picture_raises(view):
    model, painter = view()
    asked = []
    with pytest.raises(Cancelled):
        painter.picture(model.state, SIZE, cancelled=lambda: bool(asked.append(1)) or len(asked) > 1)
    assert len(asked) == 2  # before it begins, and when the device is about to work


def test_nothing_shown_is_an_empty_picture(view):
    model, painter = view()
    model.show("1", False)
    picture = painter.picture(model.state, SIZE)
    assert shown_pixels(picture) == 0 and np.isnan(picture.depth).all()
    with pytest.raises(NoSurfaceError, match="nothing"):
        painter.mesh_of_shown(model.state)


def test_picks_lie_on_the_mesh(view):
    model, painter = view()
    (mesh,) = painter.mesh_of_shown(model.state)
    picture = painter.picture(model.state, SIZE)
    rows, columns = np.nonzero(picture.image[..., 3])
    picks = []
    for place in np.random.default_rng(3).choice(len(rows), 60, replace=False):
        pick = painter.pick(model.state, SIZE, columns[place] + 0.5, rows[place] + 0.5)
        assert pick is not None and pick.object == 1 and pick.part == "1"
        picks.append(pick.point)
        depth = float(picture.depth[rows[place], columns[place]])
        origins, directions = model.camera.rays(SIZE)
        at = origins[rows[place], columns[place]] + depth * directions[rows[place], columns[place]]
        assert pick.point == pytest.approx(at, abs=0.02)
    away = SurfaceDistance(mesh.vertices, mesh.triangles)(np.array(picks))
    assert away.max() <= 0.3 and np.median(away) <= 0.02


MIDDLE_OF_THE_MESH = scenes.middle(0) + (0.0, -25.0, 0.0)
"""It lies in front of the first ball of the scan."""


@pytest.mark.parametrize("perspective", [False, True], ids=["parallel", "perspective"])
@pytest.mark.parametrize(("number", "point"), [(1, scenes.middle(2)), (2, MIDDLE_OF_THE_MESH)], ids=["scan", "mesh"])
def test_a_pick_finds_the_nearest_object_in_each_projection(view, perspective, number, point):
    model, painter = view(scenes.make_scan(), scenes.make_mesh())
    model.set_perspective(perspective)
    x, y = model.camera.project([point], SIZE)[0][0]
    pick = painter.pick(model.state, SIZE, x, y)
    assert (pick.object, pick.part) == (number, str(number))


def test_a_pick_beside_everything_finds_nothing(view):
    model, painter = view(scenes.make_scan(), scenes.make_mesh())
    assert painter.pick(model.state, SIZE, 0.5, 0.5) is None


def test_a_pick_of_a_cloud_is_one_of_its_points_without_hu(view):
    cloud = scenes.make_cloud()
    model, painter = view(cloud)
    nearest = cloud.points[np.argmin(cloud.points[:, 1])]  # the view is from anterior
    pick = painter.pick(model.state, SIZE, *model.camera.project([nearest], SIZE)[0][0])
    assert pick.point == pytest.approx(nearest, abs=0.2)
    assert (pick.object, pick.hu) == (1, None)


def test_slices_map_pixels_to_the_patient_and_show_the_scan(view):
    model, painter = view()
    model.set_cross(tuple(scenes.middle(0)))
    for plane, normal in (("axial", (0, 0, 1)), ("coronal", (0, 1, 0)), ("sagittal", (1, 0, 0))):
        picture = painter.slice(model.state, plane, SIZE)
        (pixel,), (depth,) = picture.camera.project([scenes.middle(0)], SIZE)
        assert picture.values[int(pixel[1]), int(pixel[0])] > 900.0
        assert abs(np.dot(np.subtract(picture.camera.focal_point, scenes.middle(0)), normal)) < 1e-6
        assert depth > 0.0
        pick = painter.pick_slice(model.state, plane, SIZE, *pixel)
        assert pick.point == pytest.approx(scenes.middle(0), abs=1e-6) and pick.hu > 900.0
        edge = painter.slice_camera(model.state, plane, SIZE)
        assert edge.focal_point == pytest.approx(picture.camera.focal_point)
    with refused(UsageError, "axial", "oblique"):
        painter.slice(model.state, "oblique", SIZE)


def test_a_slice_without_a_scan_is_empty_and_one_of_labels_is_not(view):
    model, painter = view(scenes.make_mesh())
    assert shown_pixels(painter.slice(model.state, "axial", SIZE)) == 0
    model, painter = view(scenes.make_labels())
    picture = painter.slice(model.state, "axial", SIZE)
    assert np.ptp(picture.image[..., :3].astype(int), axis=2).max() > 20  # coloured


def test_a_whole_scan_is_translucent_before_its_parts_are_known(view):
    model, painter = view()
    model.set_opacity("1", 0.4)
    image = painter.picture(model.state, SIZE).image
    assert 0 < image[..., 3][image[..., 3] > 0].min() < 200


def test_a_clip_cuts_picture_and_mesh_flat_and_closed(view, device):
    model, painter = view()
    model.add_clip("left")
    (clip,) = model.state.clips
    model.move_clip(0, (scenes.middle(0)[0] - clip.low) / (clip.high - clip.low))
    state = model.state
    (mesh,) = painter.mesh_of_shown(state)
    assert mesh.quality()["closed"] and mesh.bounds[1, 0] == pytest.approx(scenes.middle(0)[0], abs=0.02)
    half = 2 / 3 * np.pi * scenes.BALLS[0][1] ** 3 / 1000.0
    assert mesh.quality()["volume_ml"] == pytest.approx(half, rel=0.05)
    picture = painter.picture(state, SIZE)
    drawn = render([(mesh, MeshLook())], camera=model.camera, size=SIZE, background="transparent", device=device)
    assert ((picture.image[..., 3] > 0) != (drawn.image[..., 3] > 0)).mean() < 0.005


def test_an_oblique_clip_of_a_mesh_cuts_its_triangles_at_the_plane(view):
    model, painter = view(scenes.make_mesh())
    model.add_clip((1.0, 2.0, 0.5))
    (mesh,) = painter.mesh_of_shown(model.state)
    (*normal, offset) = model.state.clip.planes[0]
    heights = mesh.vertices @ normal - offset
    assert heights.min() == pytest.approx(0.0, abs=1e-4) and mesh.triangle_count > 100
    assert mesh.area == pytest.approx(0.5 * scenes.make_mesh().area, rel=0.02)


def test_a_large_mesh_is_coarse_while_it_moves(view):
    model, painter = view(Mesh(*samples.torus(1000, 120)))
    full = painter.picture(model.state, SIZE)
    painter.make_coarse()
    coarse = painter.picture(model.state, SIZE, sharp=False)
    assert 100_000 < coarse.report["triangles"] <= 200_000 < full.report["triangles"]
    assert np.array_equal(painter.picture(model.state, SIZE).image, full.image)
    assert shown_pixels(coarse) == pytest.approx(shown_pixels(full), rel=0.2)


def test_a_translucent_mesh_is_opaque_while_it_moves(view):
    model, painter = view(scenes.make_mesh())
    model.set_opacity("1", 0.3)
    assert painter.picture(model.state, SIZE).image[..., 3].max() < 250
    assert painter.picture(model.state, SIZE, sharp=False).image[..., 3].max() == 255
    asked = []
    with pytest.raises(Cancelled):  # between its layers
        painter.picture(model.state, SIZE, cancelled=lambda: bool(asked.append(1)) or len(asked) > 4)
    assert painter.pick(model.state, SIZE, 48, 40).point[1] < scenes.middle(0)[1] - 28.0


def test_a_curve_straightens_the_scan(view):
    model, painter = view()
    with refused(UsageError, "curve", "points"):
        painter.curve_picture(model.state, SIZE)
    model.start_tool("curve")
    for number in (0, 1):
        model.add_point(Pick(point=tuple(scenes.middle(number))))
    picture = painter.curve_picture(model.state, SIZE)
    assert picture.size == SIZE and np.nanmax(picture.values) > 900.0


def test_without_the_table_another_volume_is_shown(view, monkeypatch):
    from clrecon.viewer.drawing import stage

    model, painter = view()
    bare = scenes.make_scan().voxels.copy()
    bare[:, :, 24:] = -800

    def remove(volume, progress=None):
        made = volume.with_voxels(bare)
        made.report = {**made.report, "remove_table": {"removed_share": 0.5, "dense_voxels_removed": 7}}
        return made

    monkeypatch.setattr(stage, "remove_table", remove)
    before = shown_pixels(painter.picture(model.state, SIZE))
    assert not painter.knows_table
    assert painter.remove_table()[1]["dense_voxels_removed"] == 7 and painter.knows_table
    model.set_table(False)
    assert 0 < shown_pixels(painter.picture(model.state, SIZE)) < before
    model.undo()
    assert shown_pixels(painter.picture(model.state, SIZE)) == before


def test_two_views_share_a_painter_without_disturbing_each_other(view):
    one, painter = view()
    other = ViewModel(one.objects, iso_value=-200.0)
    find(one, painter)
    find(other, painter)
    one.show("1/1", False)
    other.set_color("1/1", (0.0, 0.0, 1.0))
    pictures = [painter.picture(each.state, SIZE).image for each in (one, other)]
    for _ in range(2):
        for each, before in zip((one, other), pictures, strict=True):
            assert np.array_equal(painter.picture(each.state, SIZE).image, before)
    assert not np.array_equal(*pictures)


def test_a_scan_in_slabs_is_shown_too(device):
    objects = show_objects([scenes.make_scan()])
    model = ViewModel(objects, iso_value=scenes.ISO)
    with Painter(objects, device=device) as whole, Painter(objects, device=device, memory=80_000) as slabs:
        pictures = [each.picture(model.state, (24, 20)) for each in (whole, slabs)]
        assert pictures[1].report["slabs"] > 1
        assert np.array_equal(pictures[0].image, pictures[1].image)


@pytest.mark.release
def test_kernels_are_built_for_every_kind_of_voxels(device):
    objects = show_objects([scenes.make_scan(), scenes.make_scan(dtype=np.float32), scenes.make_mesh()])
    told = []
    with Painter(objects, device=device) as painter:
        painter.prepare(lambda stage, done, total: told.append(stage))
    assert told.count("build") >= 14 and "parts" in told


@pytest.mark.unit
def test_a_coarse_mesh_is_near_the_fine_one():
    from clrecon.viewer.drawing.stage import coarsen_mesh

    fine = scenes.make_mesh(radius=20.0)
    coarse, first = coarsen_mesh(fine, 500)
    assert np.linalg.norm(coarse.vertices - fine.vertices[first], axis=1).max() < 8.0
    assert 200 < coarse.triangle_count < 1200
    assert coarse.area == pytest.approx(fine.area, rel=0.1) and coarse.normals is not None
