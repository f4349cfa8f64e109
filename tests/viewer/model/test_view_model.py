"""The model of a view, without a device: every change, its undo, and wrong values."""

from __future__ import annotations

import json
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
import view_scenes as scenes
from refusals import refused
from view_models import make_model

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.labels.resample import ResampledLabels
from clrecon.points.cloud import PointCloud
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.drawing.saving import shown_cloud
from clrecon.viewer.model import parts
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import ShownLabels, ShownMesh, ShownScan, show_objects
from clrecon.viewer.model.parts import FoundParts
from clrecon.viewer.model.state import ClipPlane, Pick, ShownPart

pytestmark = pytest.mark.unit


def make_parts(*, iso: float = 300.0) -> FoundParts:
    """Parts 1/1, 1/2 and the rest 1/0 of the scan, as if they were found."""
    volume, labels = scenes.make_scan(), scenes.make_labels()
    parts = tuple(
        ShownPart(
            key=f"1/{n}", name=f"part {n}", kind="cluster" if n else "rest", object=1, number=n, count=5,
            inside=tuple(volume.ijk_to_lps([(10 if n == 1 else 30, 20, 10)])[0]) if n else None,
        )
        for n in (1, 2, 0)
    )  # fmt: skip
    placed = ResampledLabels(labels.voxels, exact=True, inside={}, warnings=())
    return FoundParts(
        scan=1, iso_value=iso, shown=(True, 0.0), volume=volume, labels=labels, placed=placed, parts=parts
    )  # fmt: skip


CHANGES = {
    "turn": lambda m: m.turn(dx=0.1, dy=0.2),
    "pan": lambda m: m.pan(dx=0.1, dy=0.2),
    "zoom": lambda m: m.zoom(2.0, at=(0.1, 0.1)),
    "roll": lambda m: m.roll(30.0),
    "look": lambda m: m.look("left"),
    "perspective": lambda m: m.set_perspective(on=True),
    "iso": lambda m: m.set_iso(310.0),
    "mode": lambda m: m.set_mode("muscle"),
    "window": lambda m: m.set_window(low=-100.0, high=300.0),
    "table": lambda m: m.set_table(shown=False),
    "scroll": lambda m: m.scroll("axial", 3),
    "cross": lambda m: m.set_cross((-40.0, -20.0, 210.0)),
    "frame": lambda m: m.frame_slice("coronal", zoom=2.0, center=(-40.0, -20.0, 210.0)),
    "turn of the cross": lambda m: m.turn_cross("axial", degrees=10.0),
    "slab": lambda m: m.set_slab(5.0, "max"),
    "layout": lambda m: m.set_layout("4"),
    "hide": lambda m: m.show("1/1", visible=False),
    "only": lambda m: m.only("1/2"),
    "color": lambda m: m.set_color("2", (1.0, 0.5, 0.0)),
    "colors": lambda m: m.color_parts(),
    "opacity": lambda m: m.set_opacity("1/2", 0.4),
    "tool": lambda m: m.start_tool("angle"),
    "measure": lambda m: m.add_seed(Pick(point=(1.0, 2.0, 3.0))),
    "clip": lambda m: m.add_clip("left"),
    "clip by the view": lambda m: m.add_clip("view"),
    "box": lambda m: m.set_clip_box(low=(-50.0, -40.0, 200.0), high=(-20.0, -20.0, 220.0)),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_each_change_raises_the_version_and_is_undone_in_one_step(change):
    model = make_model()
    model.take_parts([make_parts()])
    before, version = model.state, model.version
    change(model)
    assert model.state != before and model.version == version + 1
    assert isinstance(model.undo(), str)
    assert model.state == before and model.version == version + 2
    assert model.undo() is None


WRONG = {
    "turn by a text": (lambda m: m.turn(dx="a", dy=0.0), "a turn is a finite number"),
    "zoom by 0": (lambda m: m.zoom(0.0), "above 0"),
    "unknown side": (lambda m: m.look("lft"), "left"),
    "iso value beyond the scan": (lambda m: m.set_iso(9e9), "runs from -800 to 1000 HU"),
    "iso value of NaN": (lambda m: m.set_iso(float("nan")), "finite"),
    "unknown mode": (lambda m: m.set_mode("bones"), "bone"),
    "window without width": (lambda m: m.set_window(low=5.0, high=5.0), "lower HU first"),
    "window of a surface": (lambda m: m.set_window(low=5.0, high=9.0, of="picture"), "has no window"),
    "window of no picture": (lambda m: m.set_window(low=5.0, high=9.0, of="page"), "slices"),
    "scroll in no plane": (lambda m: m.scroll("axal", 1), "axial"),
    "cross of two numbers": (lambda m: m.set_cross((1.0, 2.0)), "three finite numbers"),
    "turn in no plane": (lambda m: m.turn_cross("axal", degrees=1.0), "axial"),
    "endless turn": (lambda m: m.turn_cross("axial", degrees=float("inf")), "finite"),
    "slab below 0": (lambda m: m.set_slab(-1.0), "0 to 100 mm"),
    "slab of an unknown kind": (lambda m: m.set_slab(5.0, "median"), "mean"),
    "unknown layout": (lambda m: m.set_layout("2"), "layout"),
    "endless zoom of a slice": (lambda m: m.frame_slice("axial", zoom=float("inf"), center=(0.0, 0.0, 0.0)), "finite"),
    "middle of two numbers": (lambda m: m.frame_slice("axial", zoom=2.0, center=(0.0, 0.0)), "three finite numbers"),
    "unknown part": (lambda m: m.show("7", visible=True), "unknown part"),
    "colour above 1": (lambda m: m.set_color("2", (2.0, 0.0, 0.0)), "from 0 to 1"),
    "opacity above 1": (lambda m: m.set_opacity("2", 1.5), "from 0 to 1"),
    "colours before parts are found": (lambda m: m.color_parts(), "not found yet"),
    "unknown tool": (lambda m: m.start_tool("ruler"), "distance"),
    "point without a tool": (lambda m: m.add_point(Pick(point=(0.0, 0.0, 0.0))), "no tool"),
    "clip from no side": (lambda m: m.add_clip("up"), "side of the patient"),
    "clip without a length": (lambda m: m.add_clip((0.0, 0.0, 0.0)), "length"),
    "clip that is not there": (lambda m: m.move_clip(0, share=0.5), "there are 0"),
    "box without room": (lambda m: m.set_clip_box(low=(1.0, 0.0, 0.0), high=(0.0, 1.0, 1.0)), "holds nothing"),
    "box of one corner": (lambda m: m.set_clip_box(low=(1.0, 0.0, 0.0), high=None), "two corners"),
}


@pytest.mark.parametrize(("change", "words"), WRONG.values(), ids=WRONG)
def test_wrong_value_is_refused_and_leaves_state_version_and_undo(change, words):
    model = make_model()
    before, version = model.state, model.version
    with pytest.raises(UsageError, match=words):
        change(model)
    assert model.state == before and model.version == version and model.undo() is None


def test_moves_of_one_gesture_are_one_step_of_undo():
    clock = iter([0.0, 0.1, 0.2, 5.0, 5.1])  # seconds of three turns at once, and later one, and a shift
    model = ViewModel(show_objects([scenes.make_scan()]), clock=lambda: next(clock))
    first = model.state
    for _ in range(3):
        model.turn(dx=0.1, dy=0.0)
    later = model.state
    model.turn(dx=0.1, dy=0.0)
    model.pan(dx=0.1, dy=0.0)
    assert [model.undo() for _ in range(2)] == ["the shift", "the turn"] and model.state == later
    model.undo()
    assert model.state == first


def test_a_slow_drag_is_one_step_of_undo_and_the_next_another():
    clock = iter(range(0, 100, 10))  # ten seconds between two moves
    model = ViewModel(show_objects([scenes.make_scan()]), clock=lambda: next(clock))
    states = [model.state]
    for _ in range(2):
        model.hold(on=True)
        model.pan(dx=0.1, dy=0.0)
        model.zoom(1.1)
        model.pan(dx=0.1, dy=0.1)
        model.hold(on=False)
        states.append(model.state)
    model.pan(dx=0.1, dy=0.0)
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
    [label] = [part for part in facts_of_all_kinds()["parts"] if part["name"] == "one"]
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
    low, high = scenes.make_scan().hu_range
    assert facts["iso"] == {"hu": 200.0, "low": low, "high": high}  # a view begins at 200 HU
    assert {"surface", "bone", "mip", "minip", "drr", "slices", "labels"} <= {each["name"] for each in facts["modes"]}


def test_facts_name_a_mesh_that_the_mode_does_not_show():
    model = make_model(scenes.make_scan(), scenes.make_mesh())
    model.set_mode("mip")
    assert "mesh 2" in model.facts()["notes"][0]


@pytest.mark.parametrize(
    ("shape", "forward"),
    [((40, 40, 40), (0, 1, 0)), ((3, 40, 40), (0, 0, 1)), ((40, 40, 3), (-1, 0, 0)), ((40, 3, 40), (0, 1, 0))],
    ids=["cube", "axial slices", "sagittal slices", "coronal slices"],
)
def test_view_begins_at_the_front_and_of_a_few_slices_at_their_face(shape, forward):
    model = ViewModel(show_objects([Volume(np.zeros(shape, np.int16), np.eye(4))]))

    assert model.camera.basis().forward == pytest.approx(forward)


def test_view_of_a_mesh_alone_has_one_mode_and_no_iso_value():
    model = make_model(scenes.make_mesh())
    assert list(model.modes) == ["surface"]
    assert model.facts()["iso"] is None


def test_view_of_labels_alone_is_in_its_one_mode():
    model = make_model(scenes.make_labels())
    assert list(model.modes) == ["labels"]
    assert model.state.mode == "labels"


@pytest.mark.parametrize(
    "change", [lambda m: m.set_iso(200.0), lambda m: m.set_table(shown=False)], ids=["iso value", "table"]
)
def test_change_of_a_scan_in_a_view_without_one_is_refused(change):
    with refused(UsageError, "scan"):
        change(make_model(scenes.make_mesh()))


def test_view_without_objects_is_refused():
    with refused(UsageError, "nothing", "show"):
        ViewModel([])


def test_objects_are_named_as_given_or_by_kind_and_number():
    scan, labels = show_objects([scenes.make_scan(), scenes.make_labels()], ["left knee"], [["a remark"]])
    assert isinstance(scan, ShownScan) and (scan.name, scan.said) == ("left knee", ("a remark",))
    assert isinstance(labels, ShownLabels) and (labels.name, labels.within) == ("labels 2", 1)


def test_a_shown_mesh_gets_normals():
    (mesh,) = show_objects([scenes.make_mesh()])
    assert isinstance(mesh, ShownMesh) and mesh.mesh.normals is not None


@pytest.mark.parametrize(("objects", "fact"), [([], "nothing"), ([3], "int")], ids=["none", "a number"])
def test_view_of_nothing_or_of_a_number_is_refused(objects, fact):
    with refused(UsageError, fact):
        show_objects(objects)


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
    model.move_clip(0, share=1.0)
    assert model.state.clip.contains(right_and_left).all()


def test_a_removed_clip_plane_is_gone(clipped):
    model, _ = clipped
    model.remove_clip(0)
    assert model.state.clip is None and model.state.clips == ()


def test_parts_that_are_found_raise_the_version_and_are_no_step_of_undo():
    model = make_model()
    version = model.version

    model.take_parts([make_parts()])

    assert model.version == version + 1
    assert model.undo() is None


def test_view_from_a_side_fits_the_parts_that_are_shown():
    model = make_model()
    model.take_parts([make_parts()])
    of_all = model.camera.parallel_scale
    box = ((-50.0, -30.0, 205.0), (-45.0, -25.0, 210.0))
    parts = tuple(
        ShownPart(**{**vars(part), "box": box}) if part.kind == "cluster" else part for part in model.state.parts
    )
    model._change("test", "a test", parts=parts)

    model.only("1/1")
    model.look("anterior")

    assert model.camera.parallel_scale < 0.2 * of_all  # half of 5 mm and a margin, 2.55, of 21.8
    assert model.camera.focal_point == pytest.approx((-47.5, -27.5, 207.5))  # the middle of the box


@pytest.fixture
def three_parts():
    """A model of a scan, its parts 1/1, 1/2 and the rest 1/0, and a mesh 2."""
    model = make_model(scenes.make_scan(), scenes.make_mesh())
    model.take_parts([make_parts()])
    return model


@pytest.mark.parametrize(
    ("key", "visible"), [("1/2", {"1", "1/2"}), ("1", {"1", "1/1", "1/2", "1/0"})], ids=["a part", "a scan"]
)
def test_part_alone_is_shown_with_its_scan_and_a_scan_with_its_parts(three_parts, key, visible):
    three_parts.only(key)
    assert {part.key for part in three_parts.state.parts if part.visible} == visible


def test_all_parts_are_shown_again_together(three_parts):
    three_parts.only("1/2")
    three_parts.show_all()
    assert all(part.visible for part in three_parts.state.parts)


def test_looks_of_parts_go_over_to_another_iso_value_by_their_place():
    model = make_model(scenes.make_scan())
    model.take_parts([make_parts(iso=300.0)])
    model.show("1/2", visible=False)
    model.set_color("1/1", (1.0, 0.0, 0.0))
    model.set_iso(310.0)
    assert not model.parts_known
    fresh = make_parts(iso=310.0)
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


@pytest.mark.parametrize(
    ("plane", "facts", "row"),
    [
        pytest.param(
            ClipPlane(direction=(1.0, 0.0, 0.0), name="left", low=-10.0, high=30.0, share=0.25),
            {"words": "left side", "direction": [1.0, 0.0, 0.0], "at_mm": 0.0, "flipped": False},
            (-1.0, 0.0, 0.0, 0.0),
            id="from a side by its name",
        ),
        pytest.param(
            ClipPlane(direction=(0.0, 0.0, 1.0), name="0,0,1", low=-10.0, high=30.0, share=0.5, flipped=True),
            {"words": "S side", "direction": [0.0, 0.0, 1.0], "at_mm": 10.0, "flipped": True},
            (0.0, 0.0, 1.0, 10.0),
            id="flipped",
        ),
    ],
)
def test_clip_plane_has_its_side_in_words_its_place_in_mm_and_the_row_of_its_plane(plane, facts, row):
    assert facts.items() <= plane.describe().items()
    assert plane.row == row


def test_perspective_camera_shows_the_focal_plane_as_large_as_the_parallel_one():
    model = make_model()
    parallel = model.state.camera

    model.set_perspective(on=True)

    perspective = model.state.camera
    assert perspective.view_angle == 30.0  # degrees, of each view
    assert perspective.focal_point == parallel.focal_point
    assert perspective.half_height() * perspective.distance == pytest.approx(parallel.parallel_scale)


def test_camera_that_is_parallel_again_has_its_scale():
    model = make_model()
    before = model.state.camera.parallel_scale
    model.set_perspective(on=True)
    model.set_perspective(on=False)
    assert model.state.camera.parallel_scale == pytest.approx(before)


def pick_in_middle(sliced, number):
    """Pick the middle of a slice in which `number` lies there, by a painter that has part 2 of object 7 alone."""
    camera = make_model().state.camera
    painter = SimpleNamespace(
        lock=nullcontext(), hu_at=lambda point: 55.0, slice_camera=lambda *given: camera,
        _sliced=lambda state: sliced, _number_at=lambda scan, labelled, point: number,
    )  # fmt: skip
    state = SimpleNamespace(compare=None, part=lambda key: SimpleNamespace(object=7))
    return Painter.pick_slice(painter, state, "axial", (40, 30), x=20.0, y=15.0), camera


@pytest.mark.parametrize(("number", "key", "number_of_object"), [(2, "1/2", 7), (3, None, None)], ids=["part", "none"])
def test_pick_in_a_slice_is_of_the_part_that_lies_there(number, key, number_of_object):
    parts = SimpleNamespace(parts=[SimpleNamespace(number=2, key="1/2")])

    pick, camera = pick_in_middle(("scan", parts), number)

    assert (pick.part, pick.object, pick.hu) == (key, number_of_object, 55.0)
    assert pick.point == pytest.approx(camera.focal_point)


@pytest.mark.parametrize("sliced", [None, ("scan", None)], ids=["no scan", "no parts"])
def test_pick_in_a_slice_without_parts_is_of_none(sliced):
    pick, _ = pick_in_middle(sliced, 2)
    assert pick.part is None


CLOUD_OF_2 = PointCloud(np.zeros((2, 3)), hu=np.array([1.0, 2.0]), labels=np.array([1, 2]))
CLOUD_OF_3 = PointCloud(np.ones((3, 3)), hu=np.array([3.0, 4.0, 5.0]))


def cloud_of_shown(*clouds, hidden=None):
    """The points that a view of clouds saves, one of which may be hidden by its key."""
    model = make_model(*clouds)
    if hidden:
        model.show(hidden, visible=False)
    return shown_cloud(SimpleNamespace(objects=show_objects(clouds)), model.state)


def test_clouds_that_are_shown_are_one_with_the_values_that_all_of_them_have():
    together = cloud_of_shown(CLOUD_OF_2, CLOUD_OF_3)

    assert together.points[:, 0].tolist() == [0, 0, 1, 1, 1]
    assert together.hu.tolist() == [1, 2, 3, 4, 5]
    assert together.labels is None  # one of them has none


def test_hidden_cloud_is_not_among_the_points_that_are_shown():
    assert cloud_of_shown(CLOUD_OF_2, CLOUD_OF_3, hidden="1").hu.tolist() == [3, 4, 5]


def test_single_cloud_that_is_shown_keeps_its_labels():
    assert cloud_of_shown(CLOUD_OF_2).labels.tolist() == [1, 2]


def test_progress_of_the_search_for_parts_names_each_step(monkeypatch):
    def find_nothing(resident, band):
        raise NoSurfaceError("no voxel is so dense")

    monkeypatch.setattr(parts.Mask, "from_band", find_nothing)
    told = []
    resident = SimpleNamespace(volume=scenes.make_scan())
    parts.find_clusters(resident, scan=1, iso_value=300.0, shown=(True, 0.0), progress=lambda *step: told.append(step))
    assert told == [("parts", done, parts.STEPS) for done in range(parts.STEPS + 1)]
