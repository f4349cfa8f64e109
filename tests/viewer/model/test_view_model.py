"""The model of a view, without a device: every change, its undo, and wrong values."""

from __future__ import annotations

import json
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import view_scenes as scenes
from refusals import refused

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.labels.resample import ResampledLabels
from clrecon.points import PointCloud
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.drawing.saving import shown_cloud
from clrecon.viewer.model import parts
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import ShownLabels, ShownMesh, ShownScan, show_objects
from clrecon.viewer.model.parts import FoundParts
from clrecon.viewer.model.state import ClipPlane, Pick, ShownPart

pytestmark = pytest.mark.unit


class Clock:
    now = 0.0

    def __call__(self) -> float:
        self.now += 10.0
        return self.now


def make_model(*subjects, **given) -> ViewModel:
    return ViewModel(show_objects(subjects or [scenes.make_scan(), scenes.make_mesh()]), clock=Clock(), **given)


def found(iso: float = 300.0) -> FoundParts:
    volume, labels = scenes.make_scan(), scenes.make_labels()
    parts = tuple(
        ShownPart(
            key=f"1/{n}", name=f"part {n}", kind="cluster" if n else "rest", object=1, number=n, count=5,
            inside=tuple(volume.ijk_to_lps([(10 if n == 1 else 30, 20, 10)])[0]) if n else None,
        )
        for n in (1, 2, 0)
    )  # fmt: skip
    placed = ResampledLabels(labels.voxels, True, {}, ())
    return FoundParts(
        scan=1, iso_value=iso, table=True, volume=volume, labels=labels, placed=placed, parts=parts
    )  # fmt: skip


CHANGES = {
    "turn": lambda m: m.turn(0.1, 0.2),
    "pan": lambda m: m.pan(0.1, 0.2),
    "zoom": lambda m: m.zoom(2.0, (0.1, 0.1)),
    "roll": lambda m: m.roll(30.0),
    "look": lambda m: m.look("left"),
    "perspective": lambda m: m.set_perspective(True),
    "iso": lambda m: m.set_iso(310.0),
    "mode": lambda m: m.set_mode("muscle"),
    "window": lambda m: m.set_window(-100.0, 300.0),
    "table": lambda m: m.set_table(False),
    "scroll": lambda m: m.scroll("axial", 3),
    "cross": lambda m: m.set_cross((-40.0, -20.0, 210.0)),
    "frame": lambda m: m.frame_slice("coronal", 2.0, (-40.0, -20.0, 210.0)),
    "hide": lambda m: m.show("1/1", False),
    "only": lambda m: m.only("1/2"),
    "color": lambda m: m.set_color("2", (1.0, 0.5, 0.0)),
    "colors": lambda m: m.color_parts(),
    "opacity": lambda m: m.set_opacity("1/2", 0.4),
    "tool": lambda m: m.start_tool("angle"),
    "measure": lambda m: m.add_seed(Pick(point=(1.0, 2.0, 3.0))),
    "clip": lambda m: m.add_clip("left"),
    "clip by the view": lambda m: m.add_clip("view"),
    "box": lambda m: m.set_clip_box((-50.0, -40.0, 200.0), (-20.0, -20.0, 220.0)),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_every_change_grows_the_version_and_can_be_undone(change):
    model = make_model()
    model.take_parts([found()])
    before, version = model.state, model.version
    change(model)
    assert model.state != before and model.version == version + 1
    assert isinstance(model.undo(), str)
    assert model.state == before and model.version == version + 2
    assert model.undo() is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m.turn("a", 0.0), "a turn is a finite number"),
        (lambda m: m.zoom(0.0), "above 0"),
        (lambda m: m.look("lft"), "left"),
        (lambda m: m.set_iso(9e9), "runs from -800 to 1000 HU"),
        (lambda m: m.set_iso(float("nan")), "finite"),
        (lambda m: m.set_mode("bones"), "bone"),
        (lambda m: m.set_window(5.0, 5.0), "lower HU first"),
        (lambda m: m.set_window(5.0, 9.0, "picture"), "has no window"),
        (lambda m: m.set_window(5.0, 9.0, "page"), "slices"),
        (lambda m: m.scroll("axal", 1), "axial"),
        (lambda m: m.set_cross((1.0, 2.0)), "three finite numbers"),
        (lambda m: m.frame_slice("axial", float("inf"), (0.0, 0.0, 0.0)), "finite"),
        (lambda m: m.frame_slice("axial", 2.0, (0.0, 0.0)), "three finite numbers"),
        (lambda m: m.show("7", True), "unknown part"),
        (lambda m: m.set_color("2", (2.0, 0.0, 0.0)), "from 0 to 1"),
        (lambda m: m.set_opacity("2", 1.5), "from 0 to 1"),
        (lambda m: m.color_parts(), "not found yet"),
        (lambda m: m.start_tool("ruler"), "distance"),
        (lambda m: m.add_point(Pick(point=(0.0, 0.0, 0.0))), "no tool"),
        (lambda m: m.add_clip("up"), "side of the patient"),
        (lambda m: m.add_clip((0.0, 0.0, 0.0)), "length"),
        (lambda m: m.move_clip(0, 0.5), "there are 0"),
        (lambda m: m.set_clip_box((1.0, 0.0, 0.0), (0.0, 1.0, 1.0)), "holds nothing"),
        (lambda m: m.set_clip_box((1.0, 0.0, 0.0), None), "two corners"),
    ],
)
def test_a_wrong_value_is_refused_and_changes_nothing(change, words):
    model = make_model()
    before, version = model.state, model.version
    with pytest.raises(UsageError, match=words):
        change(model)
    assert model.state == before and model.version == version and model.undo() is None


def test_moves_of_one_gesture_are_one_step_of_undo():
    clock = iter([0.0, 0.1, 0.2, 5.0, 5.1])
    model = ViewModel(show_objects([scenes.make_scan()]), clock=lambda: next(clock))
    first = model.state
    for _ in range(3):
        model.turn(0.1, 0.0)
    later = model.state
    model.turn(0.1, 0.0)
    model.pan(0.1, 0.0)
    assert [model.undo() for _ in range(2)] == ["the shift", "the turn"] and model.state == later
    model.undo()
    assert model.state == first


def test_a_slow_drag_is_one_step_of_undo_and_the_next_another():
    clock = iter(range(0, 100, 10))
    model = ViewModel(show_objects([scenes.make_scan()]), clock=lambda: next(clock))
    states = [model.state]
    for _ in range(2):
        model.hold(True)
        model.pan(0.1, 0.0)
        model.zoom(1.1)
        model.pan(0.1, 0.1)
        model.hold(False)
        states.append(model.state)
    model.pan(0.1, 0.0)
    assert model.undo() == "the shift" and model.state == states[2]
    assert model.undo() == "the shift" and model.state == states[1]
    assert model.undo() == "the shift" and model.state == states[0]


def facts_of_all_kinds():
    """The facts, by way of JSON, of a view in RAS of a scan, mesh, cloud and labels, cut from above."""
    model = make_model(scenes.make_scan(), scenes.make_mesh(), scenes.make_cloud(), scenes.make_labels(), space="ras")
    model.add_clip("superior")
    return json.loads(json.dumps(model.facts()))


def test_facts_list_objects_and_parts_by_key():
    facts = facts_of_all_kinds()
    assert [each["kind"] for each in facts["objects"]] == ["scan", "mesh", "cloud", "labels"]
    assert [each["key"] for each in facts["parts"]] == ["1", "2", "3", "4", "4/1", "4/2", "4/0"]


def test_facts_of_a_label_have_its_name_and_volume():
    label = facts_of_all_kinds()["parts"][4]
    assert label["name"] == "one"
    voxel_ml = abs(np.linalg.det(scenes.AFFINE)) / 1000.0
    assert label["ml"] == pytest.approx(voxel_ml * np.count_nonzero(scenes.make_labels().voxels == 1), abs=0.001)


def test_facts_name_the_sides_and_the_cross_in_the_frame_of_the_output():
    facts = facts_of_all_kinds()
    assert facts["space"] == "RAS" and facts["cross_text"].endswith("mm RAS")
    assert facts["letters"]["left"].startswith("R") and facts["letters"]["top"] == "S"
    x_ras = float(facts["cross_text"].split(",")[0])
    assert facts["cross"][0] == pytest.approx(-x_ras, abs=0.06)  # in LPS; the text has one digit


def test_facts_hold_the_modes_and_the_range_of_the_level():
    facts = facts_of_all_kinds()
    assert facts["iso"] == {"hu": 200.0, "low": -800.0, "high": 1000.0}
    assert {"surface", "bone", "mip", "minip", "drr", "slices", "labels"} <= {each["name"] for each in facts["modes"]}


def test_facts_note_a_mesh_that_the_mode_does_not_show():
    model = make_model(scenes.make_scan(), scenes.make_mesh())
    model.set_mode("mip")
    assert "mesh 2" in model.facts()["notes"][0]


def test_view_without_a_scan_has_only_what_means_something():
    meshes, labels = make_model(scenes.make_mesh()), make_model(scenes.make_labels())
    assert list(meshes.modes) == ["surface"] and meshes.facts()["iso"] is None
    assert list(labels.modes) == ["labels"] and labels.state.mode == "labels"
    for change in (lambda m: m.set_iso(200.0), lambda m: m.set_table(False)):
        with pytest.raises(UsageError, match="no scan"):
            change(meshes)
    with pytest.raises(UsageError, match="nothing to show"):
        ViewModel([])


def test_objects_are_named_as_given_or_by_kind_and_number():
    scan, labels = show_objects([scenes.make_scan(), scenes.make_labels()], ["left knee"], [["a remark"]])
    assert isinstance(scan, ShownScan) and (scan.name, scan.said) == ("left knee", ("a remark",))
    assert isinstance(labels, ShownLabels) and (labels.name, labels.within) == ("labels 2", 1)


def test_a_shown_mesh_gets_normals():
    (mesh,) = show_objects([scenes.make_mesh()])
    assert isinstance(mesh, ShownMesh) and mesh.mesh.normals is not None


@pytest.mark.parametrize(("objects", "fact"), [([], "nothing"), ([3], "int")], ids=["none", "a number"])
def test_what_cannot_be_shown_as_an_object_is_refused(objects, fact):
    with refused(UsageError, fact):
        show_objects(objects)


def measure(model, tool, *points):
    """Return what the last of the points, or the end of a curve, makes."""
    model.start_tool(tool)
    made = [model.add_point(Pick(point=point)) for point in points]
    return model.end_tool() if tool == "curve" else made[-1]


def test_a_distance_is_made_of_two_points_in_mm():
    model = make_model()
    model.start_tool("distance")
    assert model.add_point(Pick(point=(0.0, 0.0, 0.0))) is None
    distance = model.add_point(Pick(point=(3.0, 4.0, 12.0)))
    assert distance.value == pytest.approx(13.0)  # 9 + 16 + 144 = 13 * 13
    assert distance.text == "13.0 mm"


def test_an_angle_is_made_at_the_second_of_three_points_in_degrees():
    angle = measure(make_model(), "angle", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 2.0, 0.0))
    assert angle.value == pytest.approx(90.0)
    assert angle.unit == "degrees"


def test_a_curve_is_made_of_its_points_when_its_tool_ends():
    model = make_model()
    points = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    model.start_tool("curve")
    assert [model.add_point(Pick(point=point)) for point in points] == [None] * 4
    assert model.end_tool().value == pytest.approx(3.0)
    assert model.state.curve == points
    assert model.state.tool is None


def test_a_seed_is_made_of_one_point_and_has_its_place_as_text():
    model = make_model()
    assert measure(model, "seed", (1.0, 2.0, 3.0)).value is None
    assert model.facts()["measures"][0]["text"] == "1.0, 2.0, 3.0 mm LPS"


def test_measures_are_undone_one_by_one_and_cleared_together():
    model = make_model()
    measure(model, "seed", (1.0, 2.0, 3.0))
    measure(model, "distance", (0.0, 0.0, 0.0), (3.0, 4.0, 12.0))
    measure(model, "seed", (4.0, 5.0, 6.0))
    model.undo()
    assert [each.kind for each in model.state.measures] == ["seed", "distance"]
    model.clear_measures()
    assert list(model.state.measures) == []
    assert model.undo() == "the measures"
    assert [each.kind for each in model.state.measures] == ["seed", "distance"]


def test_measures_are_named_by_their_kind_with_the_first_free_number():
    model = make_model()
    for x in (1.0, 2.0, 3.0):
        measure(model, "seed", (x, 0.0, 0.0))
    measure(model, "distance", (0.0, 0.0, 0.0), (3.0, 4.0, 12.0))
    model.remove_measure(1)
    measure(model, "seed", (4.0, 0.0, 0.0))
    assert [each.name for each in model.state.measures] == ["place 1", "place 3", "distance 1", "place 2"]


def test_a_measure_is_renamed_without_spaces_around_and_undone():
    model = make_model()
    measure(model, "distance", (0.0, 0.0, 0.0), (3.0, 4.0, 12.0))
    model.rename_measure(0, "  L3 height ")
    assert model.facts()["measures"][0]["name"] == "L3 height"
    assert model.undo() == "the name L3 height"
    assert model.facts()["measures"][0]["name"] == "distance 1"


def test_a_removed_measure_comes_back_by_undo_in_its_order():
    model = make_model()
    for x in (1.0, 2.0, 3.0):
        measure(model, "seed", (x, 0.0, 0.0))
    before = model.state
    model.remove_measure(1)
    assert [each.name for each in model.state.measures] == ["place 1", "place 3"]
    model.undo()
    assert model.state == before


@pytest.mark.parametrize("name", ["", "   ", "a" * 81, "two\nlines", "turned\u202eround", 3], ids=repr)
def test_a_name_that_cannot_be_read_is_refused(name):
    model = make_model()
    measure(model, "seed", (1.0, 2.0, 3.0))
    with refused(UsageError, "name", 80):
        model.rename_measure(0, name)
    assert model.state.measures[0].name == "place 1"


@pytest.mark.parametrize("n", [-1, 1, True, 0.0])
def test_a_number_without_a_measure_is_refused(n):
    model = make_model()
    measure(model, "seed", (1.0, 2.0, 3.0))
    with refused(UsageError, "measure", repr(n)):
        model.remove_measure(n)
    assert len(model.state.measures) == 1


def test_the_curve_of_a_view_is_the_one_that_was_made_last():
    model = make_model()
    for length in (3.0, 5.0):
        model.start_tool("curve")
        for x in (0.0, length):
            model.add_point(Pick(point=(x, 0.0, 0.0)))
        model.end_tool()
    assert model.state.curve == ((0.0, 0.0, 0.0), (5.0, 0.0, 0.0))


def test_an_angle_of_points_in_one_place_is_refused():
    model = make_model()
    model.start_tool("angle")
    model.add_point(Pick(point=(0.0, 0.0, 0.0)))
    model.add_point(Pick(point=(0.0, 0.0, 0.0)))
    with refused(UsageError, "angle", "points"):
        model.add_point(Pick(point=(1.0, 0.0, 0.0)))


def test_slices_are_numbered_away_from_the_eye():
    affine = np.diag([-1.0, 1.0, 2.0, 1.0])  # i runs to the right, j to the back, k up
    model = make_model(Volume(np.zeros((5, 4, 3), np.int16), affine))
    model.set_cross((-2.0, 1.0, 0.0))
    slices = model.facts()["slices"]
    assert slices == {
        "axial": {"place": "I 0.0 mm", "number": 1, "count": 5},
        "coronal": {"place": "P 1.0 mm", "number": 2, "count": 4},
        "sagittal": {"place": "R 2.0 mm", "number": 3, "count": 3},
    }
    model.scroll("axial", 3)
    assert model.facts()["slices"]["axial"] == {"place": "S 6.0 mm", "number": 4, "count": 5}


def test_slices_without_a_scan_have_a_place_and_no_number():
    model = make_model(scenes.make_mesh())
    assert set(model.facts()["slices"]["sagittal"]) == {"place"}


@pytest.fixture
def clipped():
    """A model cut from the left, and a point at the right that stays with one at the left that goes."""
    model = make_model(scenes.make_scan())
    model.add_clip("left")
    x = model.objects[0].corners[:, 0]
    return model, [(x.min() + 1.0, 0.0, 0.0), (x.max() - 1.0, 0.0, 0.0)]


def test_a_clip_plane_from_the_left_keeps_the_right(clipped):
    model, right_and_left = clipped
    assert model.state.clip.contains(right_and_left).tolist() == [True, False]


def test_a_flipped_clip_plane_keeps_the_other_side(clipped):
    model, right_and_left = clipped
    model.flip_clip(0)
    assert model.state.clip.contains(right_and_left).tolist() == [False, True]


def test_a_clip_plane_moved_to_the_end_keeps_everything(clipped):
    model, right_and_left = clipped
    model.move_clip(0, 1.0)
    assert model.state.clip.contains(right_and_left).all()


def test_a_removed_clip_plane_is_gone(clipped):
    model, _ = clipped
    model.remove_clip(0)
    assert model.state.clip is None and model.state.clips == ()


def test_a_view_fits_what_is_shown():
    model = make_model()
    version = model.version
    model.take_parts([found()])
    assert model.version == version + 1 and model.state.window == (-450.0, 1050.0)
    whole = model.camera.parallel_scale
    box = ((-50.0, -30.0, 205.0), (-45.0, -25.0, 210.0))
    parts = tuple(
        ShownPart(**{**vars(each), "box": box}) if each.kind == "cluster" else each for each in model.state.parts
    )
    model._change("test", "a test", parts=parts)
    model.only("1/1")
    model.look("anterior")
    assert model.camera.parallel_scale < 0.5 * whole
    assert model.camera.focal_point == pytest.approx((-47.5, -27.5, 207.5))


def test_only_and_show_all_switch_every_part():
    model = make_model(scenes.make_scan(), scenes.make_mesh())
    model.take_parts([found()])
    model.only("1/2")
    assert {each.key for each in model.state.parts if each.visible} == {"1", "1/2"}
    model.only("1")
    assert {each.key for each in model.state.parts if each.visible} == {"1", "1/1", "1/2", "1/0"}
    model.show_all()
    assert all(each.visible for each in model.state.parts)


def test_looks_of_parts_go_over_to_another_iso_value_by_their_place():
    model = make_model(scenes.make_scan())
    model.take_parts([found(300.0)])
    model.show("1/2", False)
    model.set_color("1/1", (1.0, 0.0, 0.0))
    model.set_iso(310.0)
    assert not model.parts_known
    fresh = found(310.0)
    swapped = {1: 2, 2: 1, 0: 0}
    voxels = np.array([0, 2, 1], np.uint8)[fresh.labels.voxels]
    labels = type(fresh.labels)(voxels, fresh.labels.affine.copy())
    parts = tuple(
        ShownPart(**{**vars(each), "number": swapped[each.number], "key": f"1/{swapped[each.number]}"})
        for each in fresh.parts
    )
    model.take_parts([FoundParts(**{**vars(fresh), "labels": labels, "parts": parts})])
    assert model.parts_known
    assert model.state.part("1/1").visible is False and model.state.part("1/2").color == (1.0, 0.0, 0.0)
    assert model.state.part("1/2").visible and model.state.part("1/1").color is None


def test_slices_begin_in_the_middle_of_the_scan_whatever_lies_beside_it():
    far = scenes.make_mesh(np.array([500.0, 0.0, 0.0]))
    cross = make_model(far, scenes.make_scan()).state.cross
    assert scenes.make_scan().lps_to_ijk(cross) == pytest.approx([22.0, 20.0, 11.0])  # of 44 x 40 x 22 voxels


def paged(affine, plane: str, positions=None) -> list[tuple[int, float]]:
    """Number and index along k of every position that paging reaches, the way back included, of 3 x 4 x 5 voxels."""
    volume = Volume(np.zeros((5, 4, 3), np.int16), np.array(affine), slice_positions=positions)
    model = make_model(volume)
    model.set_cross(volume.ijk_to_lps([1.0, 2.0, 2.3]))
    model.scroll(plane, -1e308)
    places = []
    for step in (1, -1):
        version = -1
        while version != model.version:
            version = model.version
            number = model.facts()["slices"][plane]["number"]
            places.append((number, round(float(volume.lps_to_ijk(model.state.cross)[2]), 6)))
            model.scroll(plane, step)
    assert places[: len(places) // 2] == places[len(places) // 2 :][::-1]
    return places[: len(places) // 2]


TURNED = [[0.0, 0.0, 2.5, 0.0], [0.7, 0.0, 0.0, 0.0], [0.0, 0.7, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]  # k runs to the left
TILTED = [[0.7, 0.0, 0.0, 0.0], [0.0, 0.7, 0.7, 0.0], [0.0, 0.0, 2.5, 0.0], [0.0, 0.0, 0.0, 1.0]]  # gantry tilt
UNEVEN = np.outer([0.0, 2.5, 3.0, 9.0, 10.0], [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    ("affine", "plane", "positions", "last_first"),
    [
        (np.diag([0.7, 0.7, 2.5, 1.0]), "axial", None, False),
        (np.diag([0.7, 0.7, -2.5, 1.0]), "axial", None, True),
        (np.diag([0.7, 0.7, 2.5, 1.0]), "axial", UNEVEN, False),
        (TURNED, "sagittal", None, True),
        (TILTED, "axial", None, False),
    ],
    ids=["upwards", "downwards", "uneven", "turned", "tilted"],
)
def test_paging_shows_each_layer_once_at_its_middle(affine, plane, positions, last_first):
    layers = [4.0, 3.0, 2.0, 1.0, 0.0] if last_first else [0.0, 1.0, 2.0, 3.0, 4.0]
    assert paged(affine, plane, positions) == list(zip([1, 2, 3, 4, 5], layers, strict=True))


def test_paging_an_oblique_scan_goes_to_the_middle_of_the_next_layer_at_the_cross():
    scan = scenes.make_scan()
    model = make_model(scan)
    model.set_cross(scan.ijk_to_lps([22.0, 20.0, 11.3]))
    for plane, axis, layers in (("axial", 2, [10.0, 11.0]), ("sagittal", 0, [21.0, 20.0])):
        model.scroll(plane, -1 if plane == "axial" else 1)
        first = scan.lps_to_ijk(model.state.cross)[axis]
        model.scroll(plane, 1)
        assert [first, scan.lps_to_ijk(model.state.cross)[axis]] == pytest.approx(layers), plane


def test_slices_without_a_scan_scroll_by_mm_and_stay_within():
    model = make_model(scenes.make_mesh())
    before = model.state.cross[2]
    model.scroll("axial", 1)
    assert model.state.cross[2] == pytest.approx(before + 1.0)
    model.scroll("axial", 10_000)
    assert model.state.cross[2] == pytest.approx(model.objects[0].corners[:, 2].max())


def test_a_clip_plane_says_its_side():
    def say(name, direction, share=0.25, flipped=False):
        plane = ClipPlane(direction=direction, name=name, low=-10.0, high=30.0, share=share, flipped=flipped)
        return plane.describe() | {"row": plane.row}

    assert say("left", (1.0, 0.0, 0.0)) == {
        "name": "left", "words": "left side", "direction": [1.0, 0.0, 0.0], "share": 0.25, "at_mm": 0.0,
        "flipped": False, "row": (-1.0, 0.0, 0.0, 0.0),
    }  # fmt: skip
    oblique = say("0,0,1", (0.0, 0.0, 1.0), 0.5, True)
    assert (oblique["words"], oblique["row"]) == ("S side", (0.0, 0.0, 1.0, 10.0))


def test_a_perspective_camera_sees_the_focal_plane_as_the_parallel_one_did():
    model = make_model()
    before = model.state.camera
    model.set_perspective(True)
    after = model.state.camera
    assert after.view_angle == 30.0 and after.focal_point == before.focal_point
    assert after.half_height() * after.distance == pytest.approx(before.parallel_scale)
    model.set_perspective(False)
    assert model.state.camera.parallel_scale == pytest.approx(before.parallel_scale)


@pytest.mark.parametrize(("number", "key", "of"), [(2, "1/2", 7), (3, None, None)])
def test_a_place_in_a_slice_is_of_the_part_that_lies_there(number, key, of):
    look = SimpleNamespace(parts=[SimpleNamespace(number=2, key="1/2")])
    camera = make_model().state.camera
    painter = SimpleNamespace(
        lock=nullcontext(), hu_at=lambda point: 55.0, slice_camera=lambda *given: camera,
        _sliced=lambda state: ("scan", look), _number_at=lambda scan, labelled, point: number,
    )  # fmt: skip
    state = SimpleNamespace(part=lambda key: SimpleNamespace(object=7))
    middle = Painter.pick_slice(painter, state, "axial", (40, 30), 20.0, 15.0)
    assert (middle.part, middle.object, middle.hu) == (key, of, 55.0)
    assert middle.point == pytest.approx(camera.focal_point)
    for found in (None, ("scan", None)):  # no scan, or no parts
        painter._sliced = lambda state, found=found: found
        assert Painter.pick_slice(painter, state, "axial", (40, 30), 20.0, 15.0).part is None


def test_clouds_that_are_shown_are_one_with_what_all_of_them_have():
    one = PointCloud(np.zeros((2, 3)), hu=np.array([1.0, 2.0]), labels=np.array([1, 2]))
    other = PointCloud(np.ones((3, 3)), hu=np.array([3.0, 4.0, 5.0]))
    model = make_model(one, other)
    painter = SimpleNamespace(objects=show_objects([one, other]))
    both = shown_cloud(painter, model.state)
    assert both.points[:, 0].tolist() == [0, 0, 1, 1, 1] and both.hu.tolist() == [1, 2, 3, 4, 5] and both.labels is None
    model.show("1", False)
    assert shown_cloud(painter, model.state).hu.tolist() == [3, 4, 5]
    painter.objects = show_objects([one])
    assert shown_cloud(painter, make_model(one).state).labels.tolist() == [1, 2]


def test_the_search_for_parts_tells_every_step(monkeypatch):
    def find_nothing(resident, band):
        raise NoSurfaceError("no voxel is so dense")

    monkeypatch.setattr(parts.Mask, "from_band", find_nothing)
    told = []
    parts.find_clusters(SimpleNamespace(volume=scenes.make_scan()), 1, 300.0, True, lambda *step: told.append(step))
    assert told == [("parts", done, parts.STEPS) for done in range(parts.STEPS + 1)]


def test_slices_that_are_edge_on_turn_the_camera_and_are_told():
    model = make_model(scenes.make_scan())
    start = model.camera
    model.set_mode("slices")
    normal = np.cross(*model.scans[0].volume.affine[:3, :2].T)
    along = model.camera.basis().forward @ normal / np.linalg.norm(normal)
    assert abs(along) >= 0.25, along
    assert model.facts()["notes"] == []
    model.look("anterior")
    assert "turn the picture" in model.facts()["notes"][0]
    model.undo()
    model.undo()
    assert (model.camera, model.state.mode) == (start, "surface"), "one change has mode and camera"


def test_slices_that_are_seen_leave_the_camera():
    model = make_model(scenes.make_scan())
    model.look("superior")
    start = model.camera
    model.set_mode("slices")
    assert model.camera == start
