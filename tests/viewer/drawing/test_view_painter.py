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
from clrecon.viewer.drawing.stage import COARSE_TRIANGLES
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.model.state import Pick

pytestmark = pytest.mark.opencl

SIZE = (96, 80)


@pytest.fixture
def open_model_and_painter(device):
    """A function that makes the model and the painter of objects, by default of a scan of three balls."""
    with open_painters(device) as make:
        yield make


@pytest.mark.release
def test_each_mode_is_drawn_sharp_and_coarse(open_model_and_painter):
    model, painter = open_model_and_painter(
        scenes.make_scan(), scenes.make_mesh(), scenes.make_cloud(), scenes.make_labels()
    )
    for mode in model.modes:
        model.set_mode(mode)
        sharp = painter.picture(model.state, SIZE)
        coarse = painter.picture(model.state, SIZE, sharp=False, share=0.5)
        assert sharp.size == SIZE and shown_pixels(sharp) > 600, mode  # of 7,680; the fewest, of slices, were 1,147
        assert sharp.report["sharp"] and sharp.report["ms"] > 0.0
        assert coarse.size == (77, 64) and not coarse.report["sharp"], mode  # the shorter side has 64 pixels at least
        assert shown_pixels(coarse) > 350  # of 4,928; the fewest were 732


def test_picture_of_a_surface_in_a_view_is_that_of_render(open_model_and_painter, device):
    model, painter = open_model_and_painter()
    mine = painter.picture(model.state, SIZE)
    other = render(
        model.objects[0].volume, "surface", iso_value=scenes.ISO, camera=model.camera, size=SIZE,
        background="transparent", device=device,
    )  # fmt: skip
    assert np.array_equal(mine.image, other.image)


@pytest.mark.parametrize("mode", ["surface", "bone"])
def test_dark_hollows_are_those_of_ambient_occlusion_in_sharp_pictures_alone(mode, open_model_and_painter):
    model, painter = open_model_and_painter()
    model.set_mode(mode)
    plain, coarse = (painter.picture(model.state, SIZE, sharp=sharp).image for sharp in (True, False))

    model.toggle_occlusion()
    darker = painter.picture(model.state, SIZE).image

    assert (darker[..., :3] <= plain[..., :3]).all() and (darker < plain).any()
    assert np.array_equal(darker[..., 3], plain[..., 3])
    assert np.array_equal(painter.picture(model.state, SIZE, sharp=False).image, coarse)


LARGE = (512, 520)
"""A size that is drawn in two strips."""


@pytest.fixture
def in_strips_and_whole(request, open_model_and_painter, monkeypatch):
    """The same picture in a mode, drawn in strips and in one piece."""
    from clrecon.viewer.drawing import painter as module

    model, painter = open_model_and_painter()
    model.set_mode(request.param)
    model.turn(dx=0.1, dy=0.05)
    in_strips = painter.picture(model.state, LARGE)
    monkeypatch.setattr(module, "take_strips", lambda take, camera, size: take(camera, size))
    return in_strips, painter.picture(model.state, LARGE)


@pytest.mark.parametrize("in_strips_and_whole", ["surface", "mip", "slices", "bone"], indirect=True)
def test_large_picture_in_two_strips_is_that_in_one_piece(in_strips_and_whole):
    in_strips, whole = in_strips_and_whole

    assert in_strips.report["strips"] == 2
    assert in_strips.camera == whole.camera
    apart = np.abs(in_strips.image.astype(int) - whole.image.astype(int)).max(axis=2)
    assert (apart > 3).mean() < 0.002  # of pixels, at edges: other rays in float32; none was measured
    both = ~np.isnan(in_strips.depth) & ~np.isnan(whole.depth)
    assert both.any()
    assert np.median(np.abs(in_strips.depth[both] - whole.depth[both])) < 1e-3  # mm; 0 was measured


@pytest.mark.parametrize("in_strips_and_whole", ["drr"], indirect=True)
def test_large_radiograph_is_drawn_in_one_piece_without_depths(in_strips_and_whole):
    picture, whole = in_strips_and_whole

    assert picture.report.get("strips", 1) == 1
    assert np.array_equal(picture.image, whole.image)
    assert np.isnan(picture.depth).all()


@pytest.mark.parametrize("mode", ["surface", "bone", "mip", "slices"])
def test_large_picture_is_cancelled_between_its_strips(open_model_and_painter, mode):
    model, painter = open_model_and_painter()
    model.set_mode(mode)
    asked = []
    with pytest.raises(Cancelled):
        painter.picture(model.state, LARGE, cancelled=lambda: bool(asked.append(1)) or len(asked) > 2)
    assert len(asked) == 3  # before it begins, before the first strip, and before the second


def test_picture_of_a_view_asks_twice_whether_it_is_cancelled_and_ends_where_it_is(open_model_and_painter):
    model, painter = open_model_and_painter()
    asked = []
    with pytest.raises(Cancelled):
        painter.picture(model.state, SIZE, cancelled=lambda: bool(asked.append(1)) or len(asked) > 1)
    assert len(asked) == 2  # before it begins, and when the device is about to work


def test_picture_of_a_view_that_shows_nothing_is_empty(open_model_and_painter):
    model, painter = open_model_and_painter()
    model.show("1", visible=False)

    picture = painter.picture(model.state, SIZE)

    assert shown_pixels(picture) == 0
    assert np.isnan(picture.depth).all()


def test_mesh_of_a_view_that_shows_nothing_is_refused(open_model_and_painter):
    model, painter = open_model_and_painter()
    model.show("1", visible=False)
    with refused(NoSurfaceError, "nothing"):
        painter.mesh_of_shown(model.state)


def test_picked_points_lie_on_the_surface_at_the_depth_of_their_pixels(open_model_and_painter):
    model, painter = open_model_and_painter()
    (mesh,) = painter.mesh_of_shown(model.state)
    picture = painter.picture(model.state, SIZE)
    rows, columns = np.nonzero(picture.image[..., 3])
    origins, directions = model.camera.rays(SIZE)

    picked = []
    for place in np.random.default_rng(3).choice(len(rows), 60, replace=False):
        row, column = rows[place], columns[place]
        pick = painter.pick(model.state, SIZE, x=column + 0.5, y=row + 0.5)
        assert (pick.object, pick.part) == (1, "1")
        at_its_depth = origins[row, column] + float(picture.depth[row, column]) * directions[row, column]
        assert pick.point == pytest.approx(at_its_depth, abs=0.02)  # mm: the way along a ray in float32
        picked.append(pick.point)

    away_mm = SurfaceDistance(mesh.vertices, mesh.triangles)(np.array(picked))
    assert np.median(away_mm) <= 0.02  # 0.005 was measured
    assert away_mm.max() <= 0.3  # between triangles the field is bent


MIDDLE_OF_THE_MESH = scenes.middle(0) + (0.0, -25.0, 0.0)
"""It lies in front of the first ball of the scan."""


@pytest.mark.parametrize("perspective", [False, True], ids=["parallel", "perspective"])
@pytest.mark.parametrize(
    ("number", "point"),
    [(1, scenes.middle(2)), (2, MIDDLE_OF_THE_MESH)],
    ids=["scan", "mesh before a ball of the scan"],
)
def test_pick_finds_the_nearest_object_in_each_projection(open_model_and_painter, perspective, number, point):
    model, painter = open_model_and_painter(scenes.make_scan(), scenes.make_mesh())
    model.set_perspective(on=perspective)
    ((x, y),), _ = model.camera.project([point], SIZE)
    pick = painter.pick(model.state, SIZE, x=x, y=y)
    assert (pick.object, pick.part) == (number, str(number))


def test_pick_beside_all_objects_finds_nothing(open_model_and_painter):
    model, painter = open_model_and_painter(scenes.make_scan(), scenes.make_mesh())
    assert painter.pick(model.state, SIZE, x=0.5, y=0.5) is None


def test_pick_of_a_cloud_is_one_of_its_points_without_hu(open_model_and_painter):
    cloud = scenes.make_cloud()
    model, painter = open_model_and_painter(cloud)
    nearest = cloud.points[np.argmin(cloud.points[:, 1])]  # the view is from anterior
    ((x, y),), _ = model.camera.project([nearest], SIZE)
    pick = painter.pick(model.state, SIZE, x=x, y=y)
    assert pick.point == pytest.approx(nearest, abs=1e-4)  # mm, in float32; measured 1e-6
    assert (pick.object, pick.hu) == (1, None)


PLANES = pytest.mark.parametrize(
    ("plane", "normal"), [("axial", (0, 0, 1)), ("coronal", (0, 1, 0)), ("sagittal", (1, 0, 0))]
)
BALL_HU = 900.0
"""The first ball of the scan has more."""


@PLANES
def test_slice_lies_at_the_cross_and_shows_the_scan_there(open_model_and_painter, plane, normal):
    model, painter = open_model_and_painter()
    cross = scenes.middle(0)
    model.set_cross(tuple(cross))

    picture = painter.slice(model.state, plane, SIZE)

    (pixel,), (depth,) = picture.camera.project([cross], SIZE)
    assert picture.values[int(pixel[1]), int(pixel[0])] > BALL_HU
    assert abs(np.dot(np.subtract(picture.camera.focal_point, cross), normal)) < 1e-6  # float64
    assert depth > 0.0
    assert painter.slice_camera(model.state, plane, SIZE).focal_point == pytest.approx(picture.camera.focal_point)


@PLANES
def test_pick_in_a_slice_is_the_place_of_its_pixel_with_its_hu(open_model_and_painter, plane, normal):
    model, painter = open_model_and_painter()
    cross = scenes.middle(0)
    model.set_cross(tuple(cross))
    (pixel,), _ = painter.slice_camera(model.state, plane, SIZE).project([cross], SIZE)

    pick = painter.pick_slice(model.state, plane, SIZE, *pixel)

    assert pick.point == pytest.approx(cross, abs=1e-6)  # float64
    assert pick.hu > BALL_HU


def test_pick_in_a_turned_slice_lies_in_its_plane(open_model_and_painter):
    model, painter = open_model_and_painter()
    model.turn_cross("sagittal", degrees=30.0)
    forward = painter.slice_camera(model.state, "axial", SIZE).basis().forward

    pick = painter.pick_slice(model.state, "axial", SIZE, x=10.0, y=15.0)

    assert abs(forward @ np.subtract(pick.point, model.state.cross)) < 1e-9  # mm, of places of some 200 mm


def test_thick_slice_of_the_most_shows_a_ball_that_lies_beside_its_plane(open_model_and_painter):
    model, painter = open_model_and_painter()
    model.set_cross(scenes.middle(1) + (0.0, 0.0, 8.0))  # the ball has a radius of 5 mm
    thin = painter.slice(model.state, "axial", SIZE)

    model.set_slab(20.0, "max")

    thick = painter.slice(model.state, "axial", SIZE)
    (pixel,), _ = thick.camera.project([scenes.middle(1)], SIZE)
    column, row = np.floor(pixel).astype(int)
    assert thin.image[row, column, 0] == 0  # air
    assert thick.image[row, column, 0] > 200  # 1000 HU in a window from -450 to 1050 HU


def test_slice_in_an_unknown_plane_is_refused(open_model_and_painter):
    model, painter = open_model_and_painter()
    with refused(UsageError, "axial", "oblique"):
        painter.slice(model.state, "oblique", SIZE)


def test_slice_of_a_mesh_alone_is_empty(open_model_and_painter):
    model, painter = open_model_and_painter(scenes.make_mesh())
    assert shown_pixels(painter.slice(model.state, "axial", SIZE)) == 0


def test_slice_of_labels_alone_is_coloured(open_model_and_painter):
    model, painter = open_model_and_painter(scenes.make_labels())
    picture = painter.slice(model.state, "axial", SIZE)
    assert np.ptp(picture.image[..., :3].astype(int), axis=2).max() > 75  # of 255, between the channels; measured 153


def test_whole_scan_is_translucent_before_its_parts_are_known(open_model_and_painter):
    model, painter = open_model_and_painter()
    model.set_opacity("1", 0.4)
    image = painter.picture(model.state, SIZE).image
    assert 0 < image[..., 3][image[..., 3] > 0].min() < 200  # a surface alone has 0.4 * 255 = 102


def test_clip_through_a_ball_leaves_a_closed_half_of_it_in_mesh_and_picture(open_model_and_painter, device):
    model, painter = open_model_and_painter()
    model.add_clip("left")
    (clip,) = model.state.clips
    middle_x = scenes.middle(0)[0]
    model.move_clip(0, share=(middle_x - clip.low) / (clip.high - clip.low))

    (mesh,) = painter.mesh_of_shown(model.state)
    picture = painter.picture(model.state, SIZE)

    quality = mesh.quality()
    assert quality["closed"]
    assert mesh.bounds[1, 0] == pytest.approx(middle_x, abs=0.02)  # vertices in float32, held off samples
    half_ball_ml = 2 / 3 * np.pi * scenes.BALLS[0].radius_mm ** 3 / 1000.0
    assert quality["volume_ml"] == pytest.approx(half_ball_ml, rel=0.035)  # voxels of about 1 mm; measured 0.983 of it
    drawn = render([(mesh, MeshLook())], camera=model.camera, size=SIZE, background="transparent", device=device)
    assert ((picture.image[..., 3] > 0) != (drawn.image[..., 3] > 0)).mean() < 0.005  # of pixels, at outlines


def test_oblique_clip_of_a_mesh_cuts_its_triangles_at_the_plane(open_model_and_painter):
    model, painter = open_model_and_painter(scenes.make_mesh())
    model.add_clip((1.0, 2.0, 0.5))
    (mesh,) = painter.mesh_of_shown(model.state)
    (*normal, offset) = model.state.clip.planes[0]
    heights = mesh.vertices @ normal - offset
    assert mesh.triangle_count > 100  # 1,264 of 2,208
    assert heights.min() == pytest.approx(0.0, abs=1e-4)  # mm; -3e-6 was measured, as vertices are rounded to float32
    half_of_the_ball = scenes.make_mesh().area / 2  # a new plane goes through the middle
    assert mesh.area == pytest.approx(half_of_the_ball, rel=1e-4)  # 2e-7 was measured


def test_large_mesh_is_drawn_with_fewer_triangles_while_it_moves(open_model_and_painter):
    model, painter = open_model_and_painter(Mesh(*samples.torus(rings=1000, sides=120)))
    full = painter.picture(model.state, SIZE)
    painter.make_coarse()
    coarse = painter.picture(model.state, SIZE, sharp=False)
    assert COARSE_TRIANGLES / 2 < coarse.report["triangles"] <= COARSE_TRIANGLES < full.report["triangles"]
    assert np.array_equal(painter.picture(model.state, SIZE).image, full.image)
    assert shown_pixels(coarse) == pytest.approx(shown_pixels(full), rel=0.01)  # measured equal


@pytest.fixture
def translucent_mesh(open_model_and_painter):
    """The model and painter of a mesh with an opacity of 0.3."""
    model, painter = open_model_and_painter(scenes.make_mesh())
    model.set_opacity("1", 0.3)
    return model, painter


@pytest.mark.parametrize(("is_sharp", "is_opaque"), [(True, False), (False, True)], ids=["at rest", "moving"])
def test_translucent_mesh_is_drawn_opaque_while_it_moves(is_sharp, is_opaque, translucent_mesh):
    model, painter = translucent_mesh
    opacity = painter.picture(model.state, SIZE, sharp=is_sharp).image[..., 3].max()
    assert (opacity == 255) == is_opaque


def test_picture_of_a_translucent_mesh_is_cancelled_between_its_layers(translucent_mesh):
    model, painter = translucent_mesh
    asked = []
    with pytest.raises(Cancelled):
        painter.picture(model.state, SIZE, cancelled=lambda: bool(asked.append(1)) or len(asked) > 4)
    assert len(asked) == 5  # it goes on four times, and ends at the fifth


def test_pick_of_a_translucent_mesh_is_on_its_front(translucent_mesh):
    model, painter = translucent_mesh
    middle_of_picture = SIZE[0] / 2, SIZE[1] / 2
    in_front_of_its_middle = MIDDLE_OF_THE_MESH[1] - 3.0  # of a radius of 4 mm; y grows to the back
    assert painter.pick(model.state, SIZE, *middle_of_picture).point[1] < in_front_of_its_middle


def test_picture_along_a_curve_of_two_points_shows_the_bone_between_them(open_model_and_painter):
    model, painter = open_model_and_painter()
    model.start_tool("curve")
    for number in (0, 1):
        model.add_point(Pick(point=tuple(scenes.middle(number))))

    picture = painter.curve_picture(model.state, SIZE)

    assert picture.size == SIZE
    assert np.nanmax(picture.values) > BALL_HU


def test_picture_along_a_curve_without_points_is_refused(open_model_and_painter):
    model, painter = open_model_and_painter()
    with refused(UsageError, "curve", "points"):
        painter.curve_picture(model.state, SIZE)


def test_view_without_the_table_draws_the_scan_without_its_voxels(open_model_and_painter, monkeypatch):
    from clrecon.viewer.drawing import stage

    model, painter = open_model_and_painter()
    bare = scenes.make_scan().voxels.copy()
    bare[:, :, 24:] = -800

    def remove(volume, progress=None):
        made = volume.with_voxels(bare)
        made.report = {**made.report, "remove_table": {"removed_share": 0.5, "dense_voxels_removed": 7}}
        return made

    monkeypatch.setattr(stage, "remove_table", remove)
    before = shown_pixels(painter.picture(model.state, SIZE))
    assert not painter.knows_table
    [facts] = painter.remove_table().values()
    assert facts["dense_voxels_removed"] == 7 and painter.knows_table
    model.set_table(shown=False)
    assert 0 < shown_pixels(painter.picture(model.state, SIZE)) < before
    model.undo()
    assert shown_pixels(painter.picture(model.state, SIZE)) == before


def test_two_views_of_one_painter_draw_their_own_pictures_in_turn(open_model_and_painter):
    one, painter = open_model_and_painter()
    other = ViewModel(one.objects, iso_value=-200.0)
    find(one, painter)
    find(other, painter)
    one.show("1/1", visible=False)
    other.set_color("1/1", (0.0, 0.0, 1.0))
    pictures = [painter.picture(each.state, SIZE).image for each in (one, other)]
    for _ in range(2):
        for each, before in zip((one, other), pictures, strict=True):
            assert np.array_equal(painter.picture(each.state, SIZE).image, before)
    assert not np.array_equal(*pictures)


def test_picture_of_a_scan_in_slabs_is_that_of_the_whole(device):
    objects = show_objects([scenes.make_scan()])
    model = ViewModel(objects, iso_value=scenes.ISO)
    memory = 80_000  # bytes, of which the voxels alone would take 77,440
    with Painter(objects, device=device) as whole, Painter(objects, device=device, memory=memory) as slabs:
        of_whole, of_slabs = (each.picture(model.state, (24, 20)) for each in (whole, slabs))
        assert of_slabs.report["slabs"] > 1
        assert np.array_equal(of_whole.image, of_slabs.image)


@pytest.mark.release
def test_preparation_of_a_painter_builds_kernels_and_finds_parts(device):
    objects = show_objects([scenes.make_scan(), scenes.make_scan(dtype=np.float32), scenes.make_mesh()])
    told = []
    with Painter(objects, device=device) as painter:
        painter.prepare(lambda stage, done, total: told.append(stage))
    assert told.count("build") == 2 * 8  # pictures and surfaces of int16 and float32
    assert "parts" in told


@pytest.mark.unit
def test_coarse_mesh_has_few_triangles_near_the_fine_ones_and_their_area():
    from clrecon.viewer.drawing.stage import coarsen_mesh

    fine, wanted = scenes.make_mesh(radius=20.0), 500
    coarse, first = coarsen_mesh(fine, triangles=wanted)
    assert np.linalg.norm(coarse.vertices - fine.vertices[first], axis=1).max() < 4.5  # mm: a cell; measured 3.2
    assert 250 < coarse.triangle_count < 1000  # half and twice of what is asked for; 564 were measured
    assert coarse.area == pytest.approx(fine.area, rel=0.03)  # measured 0.986 of it
    assert coarse.normals is not None
