"""A session of a view: every command with right and wrong arguments, pictures from its threads, closing at any time."""

from __future__ import annotations

import json
import threading
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import view_scenes as scenes
from open_views import open_sessions, search_for_ever

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.objects import ShownMesh, show_objects
from clrecon.viewer.model.state import MOST_ZOOM
from clrecon.viewer.session.commands import COMMANDS
from clrecon.viewer.session.session import ViewSession

SIZE = (96, 80)
PATIENCE = 60.0
AT = {"size": list(SIZE)}


@pytest.fixture
def open_session(device):
    """A function that opens the session of objects, by default of a scan of three balls and a mesh."""
    with open_sessions(device) as make:
        yield make


def pixel(session: ViewSession, number: int) -> dict:
    """Arguments of a command at the middle of a ball."""
    ((x, y),), _ = session.model.camera.project([scenes.middle(number)], SIZE)
    return {"x": float(x), "y": float(y), **AT}


def wait_for_picture(session: ViewSession, *, moving: bool = False):
    """Return the next picture of the scene."""
    found: list[Any] = []
    session.picture(SIZE, moving=moving, then=found.append)
    assert session.wait(PATIENCE)
    assert session.facts()["error"] is None
    return found[-1]


def settle(session: ViewSession) -> None:
    """Let the parts be found again where that is needed."""
    session.rest()
    assert session.wait(PATIENCE)


RIGHT: dict[str, dict[str, Any]] = {
    "set_fitted": {"shown": True},
    "set_color_by": {"name": "error"},
    "step_color_by": {},
    "toggle_fitted": {},
    "turn": {"dx": 0.1, "dy": 0},
    "pan": {"dx": 0.1, "dy": 0.1},
    "zoom": {"factor": 2, "at": [0.1, 0.1]},
    "roll": {"degrees": 20},
    "look": {"view": "left"},
    "set_perspective": {"on": True},
    "toggle_perspective": {},
    "set_iso": {"hu": 310},
    "set_mode": {"name": "muscle"},
    "step_mode": {"steps": -1},
    "set_window": {"low": -100, "high": 400, "of": "slices"},
    "scroll": {"plane": "axial", "steps": 2},
    "step_iso": {"by": -5},
    "set_cross": {"point": [-40, -20, 210]},
    "zoom_slice": {"plane": "axial", "factor": 2, "about": [0.1, 0.1], **AT},
    "fit_slices": {},
    "pan_slice": {"plane": "axial", "dx": 0.1, "dy": 0.1, **AT},
    "probe": {"point": [-40, -20, 210]},
    "turn_cross": {"plane": "axial", "degrees": 12.5},
    "straighten": {},
    "set_slab": {"thickness": 6, "combine": "max"},
    "step_slab": {},
    "set_layout": {"name": "4"},
    "step_layout": {},
    "show": {"key": "2", "visible": False},
    "only": {"key": "2"},
    "show_all": {},
    "set_color": {"key": "2", "rgb": [1, 0, 0]},
    "color_parts": {"distinct": True},
    "toggle_colors": {},
    "set_opacity": {"key": "2", "value": 0.5},
    "start_tool": {"name": "seed"},
    "add_clip": {"direction": [0, 1, 1]},
    "move_clip": {"n": 0, "share": 0.7},
    "flip_clip": {"n": 0},
    "remove_clip": {"n": 0},
    "set_clip_box": {"low": [-60, -40, 200], "high": [-20, -10, 220]},
    "toggle_clip_box": {},
    "hold": {"on": True},
    "clear_measures": {},
    "end_tool": {},
    "undo": {},
    "cancel": {},
    "dismiss": {},
    "find_parts": {},
    "set_table": {"shown": True},
    "toggle_table": {},
    "pick": {"x": 3, "y": 3, **AT},
    "hide_at": {"x": 3, "y": 3, **AT},
    "only_at": {"x": 3, "y": 3, **AT},
    "cross_at": {"x": 3, "y": 3, **AT},
    "add_point": {"x": 3, "y": 3, **AT},
    "mark_at": {"x": 48, "y": 40, **AT},
    "rename_measure": {"n": 0, "name": "entry"},
    "remove_measure": {"n": 0},
}


@pytest.mark.opencl
def test_each_command_is_done_and_what_it_changes_is_undone(open_session):
    toggles = {f"{verb}_{name}" for verb in ("set", "toggle") for name in ("compare", "occlusion", "smooth")}
    assert {*RIGHT, *toggles, "save", "find_spine", "toggle_small_parts"} == set(COMMANDS)
    view = open_session()
    view.do({"do": "find_parts"})
    assert view.wait(PATIENCE)
    for name, arguments in RIGHT.items():
        before = view.model.state
        json.dumps(view.do({"do": name, **arguments}))
        settle(view)
        after = view.model.state
        if after != before and name != "undo":
            view.do({"do": "undo"})
            assert view.model.state == before, name
            view.do({"do": name, **arguments})
            settle(view)
        assert view.facts()["error"] is None
    assert view.model.version > 20  # it grows with each change; measured 146


@pytest.mark.opencl
@pytest.mark.parametrize(
    ("command", "words"),
    [
        (None, "mapping"),
        ({}, "unknown command"),
        ({"do": "set_isso"}, "set_iso"),
        ({"do": ["set_iso"]}, "unknown command"),
        ({"do": "set_iso"}, "needs hu"),
        ({"do": "set_iso", "hu": "300"}, "hu of the command set_iso is a number"),
        ({"do": "set_iso", "hu": True}, "is a number"),
        ({"do": "set_iso", "hu": float("nan")}, "finite"),
        ({"do": "set_iso", "hu": 300, "hv": 1}, "no argument 'hv'"),
        ({"do": "undo", "times": 2}, "takes none"),
        ({"do": "turn", "dx": 1, "dy": None}, "is a number"),
        ({"do": "zoom", "factor": 2, "at": [1]}, "2 numbers"),
        ({"do": "zoom", "factor": 2, "at": "ab"}, "2 numbers"),
        ({"do": "zoom_slice", "plane": "axial", "factor": -2, **AT}, "above 0"),
        ({"do": "zoom_slice", "plane": "axal", "factor": 2, **AT}, "axial"),
        ({"do": "zoom_slice", "plane": "axial", "factor": 2}, "needs size"),
        ({"do": "pan_slice", "plane": "axial", "dx": 1, "dy": float("nan"), **AT}, "a shift is a finite number"),
        ({"do": "pan_slice", "plane": "axial", "dx": 1e308, "dy": 0, **AT}, "a shift"),
        ({"do": "pan", "dx": 0, "dy": -1e300}, "at most"),
        ({"do": "zoom_slice", "plane": "axial", "factor": 2, "about": [1e308, 0], **AT}, "a shift"),
        ({"do": "probe", "point": [1, 2]}, "3 numbers"),
        ({"do": "rename_measure", "n": 0, "name": 3}, "is a name"),
        ({"do": "remove_measure", "n": 0.5}, "a whole number"),
        ({"do": "look", "view": [0, 95]}, "-90"),
        ({"do": "show", "key": 2, "visible": True}, "is a name"),
        ({"do": "show", "key": "x" * 300, "visible": True}, "is a name"),
        ({"do": "show", "key": "2", "visible": 1}, "true or false"),
        ({"do": "move_clip", "n": 0.5, "share": 0.5}, "whole number"),
        ({"do": "move_clip", "n": 3, "share": 0.5}, "no clip plane 3"),
        ({"do": "set_color", "key": "2", "rgb": [1, 2]}, "3 numbers"),
        ({"do": "pick", "x": 1, "y": 1, "size": [0, 10]}, "from 1 to"),
        ({"do": "pick", "x": 1, "y": 1, "size": [10]}, "width and height"),
        ({"do": "pick", "x": 99, "y": 1, "size": [10, 10]}, "outside of a picture"),
        ({"do": "pick", "x": 1, "y": 1, "size": [10, 10], "plane": "oblique"}, "axial"),
        ({"do": "add_clip", "direction": "up"}, "side"),
        ({"do": "save", "path": "page.doc"}, "extension"),
        ({"do": "save", "path": ""}, "extension"),
    ],
    ids=lambda value: repr(value)[:60],
)
def test_wrong_command_is_refused_and_leaves_state_and_version(open_session, command, words):
    view = open_session()
    before, version = view.model.state, view.model.version
    with pytest.raises(UsageError, match=words):
        view.do(command)
    assert view.model.state == before and view.model.version == version and view.facts()["error"] is None


@pytest.mark.opencl
def test_pictures_and_slices_of_a_session_are_drawn_by_its_thread_with_their_timing(open_session):
    view = open_session()
    names = []
    view.picture(SIZE, moving=False, then=lambda made: names.append((threading.current_thread().name, made.size)))
    for plane in ("axial", "coronal", "sagittal"):
        view.slice(plane, (50, 40), lambda made: names.append((threading.current_thread().name, made.size)))
    assert view.wait(PATIENCE)
    assert sorted(size for _, size in names) == [(50, 40)] * 3 + [SIZE]
    assert all(name == "view-pictures" for name, _ in names)
    timing = view.facts()["timing"]
    assert timing["sharp"] and timing["size"] == list(SIZE) and timing["ms"] > 0.0


@pytest.mark.opencl
@pytest.mark.parametrize(
    ("took_ms", "size"),
    [
        pytest.param(1.0, SIZE, id="fast"),
        pytest.param(1e9, (77, 64), id="slow: the shorter side has 64 pixels at least"),
    ],
)
def test_coarse_picture_is_smaller_after_one_that_took_long(open_session, monkeypatch, took_ms, size):
    view = open_session(scenes.make_scan())
    paint = view.painter.picture

    def paint_in(*given, **how):
        painted = paint(*given, **how)
        painted.report["ms"] = took_ms
        return painted

    monkeypatch.setattr(view.painter, "picture", paint_in)
    wait_for_picture(view, moving=True)

    assert wait_for_picture(view, moving=True).size == size


@pytest.mark.opencl
def test_coarse_picture_shows_the_latest_state(open_session):
    view = open_session(scenes.make_scan())
    wait_for_picture(view, moving=True)

    view.do({"do": "look", "view": "left"})

    assert wait_for_picture(view, moving=True).camera == view.model.camera


@pytest.mark.opencl
def test_part_at_a_pixel_is_hidden_when_the_parts_are_found(open_session):
    view = open_session()

    facts = view.do({"do": "hide_at", **pixel(view, 2)})
    assert facts["pick"]["part"] == "1"  # the scan: its parts are not known yet
    assert view.wait(PATIENCE)

    assert not view.model.state.part("1/3").visible
    assert view.model.state.part("1/1").visible


@pytest.mark.opencl
def test_part_at_a_pixel_is_shown_alone_and_others_are_not_picked(open_session):
    view = open_session()
    view.do({"do": "find_parts"})
    assert view.wait(PATIENCE)

    view.do({"do": "only_at", **pixel(view, 1)})

    assert [part.key for part in view.model.state.parts if part.visible] == ["1", "1/2"]
    assert view.do({"do": "pick", **pixel(view, 0)})["pick"] is None


@pytest.mark.opencl
def test_parts_are_found_again_at_another_iso_value_when_the_view_rests(open_session):
    view = open_session(scenes.make_scan())
    view.do({"do": "find_parts"})
    assert view.wait(PATIENCE)
    view.do({"do": "show", "key": "1/1", "visible": False})
    view.do({"do": "set_iso", "hu": 600})
    assert not view.facts()["parts_known"]
    view.rest()
    assert view.wait(PATIENCE)
    assert view.facts()["parts_known"] and view.model.state.part("1/1").visible is False
    view.do({"do": "undo"})
    assert view.wait(PATIENCE) and view.facts()["parts_known"] and view.model.state.iso_value == scenes.ISO


@pytest.fixture
def scan_view(open_session):
    """A session of a scan, its cross in the middle of the first ball."""
    view = open_session(scenes.make_scan())
    view.do({"do": "set_cross", "point": scenes.middle(0).tolist()})
    return view


@pytest.mark.opencl
def test_two_points_picked_in_the_picture_make_a_distance(scan_view):
    scan_view.do({"do": "start_tool", "name": "distance"})
    scan_view.do({"do": "add_point", **pixel(scan_view, 0)})
    facts = scan_view.do({"do": "add_point", **pixel(scan_view, 1)})

    first, second = np.array(facts["measure"]["points"])
    assert facts["measures"][0]["text"] == f"{np.linalg.norm(second - first):.1f} mm"


@pytest.mark.opencl
def test_point_of_a_tool_beside_all_objects_is_none(scan_view):
    scan_view.do({"do": "start_tool", "name": "distance"})

    assert scan_view.do({"do": "add_point", "x": 1, "y": 1, **AT})["measure"] is None

    assert scan_view.facts()["points"] == []


@pytest.mark.opencl
def test_point_of_a_tool_in_a_slice_is_the_place_of_its_pixel(scan_view):
    camera = scan_view.painter.slice_camera(scan_view.model.state, "axial", SIZE)
    ((x, y),), _ = camera.project([scenes.middle(0)], SIZE)
    scan_view.do({"do": "start_tool", "name": "seed"})

    facts = scan_view.do({"do": "add_point", "x": x, "y": y, **AT, "plane": "axial"})

    (place,) = facts["measure"]["points"]
    assert place == pytest.approx(scenes.middle(0), abs=1e-3)  # facts have 3 decimals


@pytest.mark.opencl
def test_cross_is_moved_to_the_place_that_is_picked(scan_view):
    facts = scan_view.do({"do": "cross_at", **pixel(scan_view, 1)})
    assert facts["cross"] == pytest.approx(facts["pick"]["point"], abs=1e-3)  # facts have 3 decimals


@pytest.mark.opencl
def test_table_is_removed_in_the_background_and_its_volume_is_said(open_session, monkeypatch):
    from clrecon.viewer.drawing import stage

    def remove(volume, progress=None):
        made = volume.with_voxels(volume.voxels.copy())
        made.report = {**made.report, "remove_table": {"removed_share": 0.25, "dense_voxels_removed": 1200}}
        return made

    monkeypatch.setattr(stage, "remove_table", remove)
    scan = scenes.make_scan()
    view = open_session(scan)

    view.do({"do": "set_table", "shown": False})
    assert view.wait(PATIENCE)

    facts = view.facts()
    assert facts["table"] is False
    assert f"{1.2 * np.prod(scan.spacing):,.0f} ml" in facts["said"]  # of 1,200 voxels
    assert view.do({"do": "undo"})["table"]


@pytest.mark.opencl
def test_table_that_cannot_be_removed_stays_with_an_error_that_can_be_dismissed(open_session, monkeypatch):
    from clrecon.viewer.drawing import stage

    def refuse(volume, progress=None):
        raise RefusedInputError("no body found")

    monkeypatch.setattr(stage, "remove_table", refuse)
    view = open_session(scenes.make_scan())

    view.do({"do": "set_table", "shown": False})
    assert view.wait(PATIENCE)

    assert view.facts()["error"] == "no body found"
    assert view.facts()["table"]
    assert view.do({"do": "dismiss"})["error"] is None


@pytest.mark.opencl
def test_session_that_is_closed_while_it_works_ends_its_threads(open_session, monkeypatch):
    view = open_session()

    monkeypatch.setattr(view.painter, "find_parts", search_for_ever)
    view.do({"do": "find_parts"})
    view.picture((600, 600), moving=False, then=lambda made: None)
    while "finding parts" not in view.facts()["busy"]:
        time.sleep(0.001)
    view.close()
    assert not view._work._thread.is_alive() and not view._pictures._thread.is_alive()
    view.picture(SIZE, moving=False, then=lambda made: pytest.fail("a closed view draws nothing"))
    view.close()


@pytest.mark.opencl
def test_command_cancel_ends_the_search_for_parts(open_session, monkeypatch):
    view = open_session()

    monkeypatch.setattr(view.painter, "find_parts", search_for_ever)
    view.do({"do": "find_parts"})
    while view.facts()["busy"] != ["finding parts"]:
        time.sleep(0.001)
    view.do({"do": "cancel"})
    assert view.wait(PATIENCE) and view.facts()["error"] is None


@pytest.mark.opencl
def test_sessions_of_one_painter_draw_their_own_pictures_in_turn(device):
    objects = show_objects([scenes.make_scan(), scenes.make_mesh()])
    with Painter(objects, device=device) as painter:
        views = [ViewSession(objects, painter, iso_value=iso) for iso in (300.0, 0.0, 700.0)]
        try:
            for view in views:
                wait_for_picture(view)  # the view knows the size of its picture now
                view.do({"do": "look", "view": "left"})
            alone = [wait_for_picture(view).image for view in views]
            for view in views:
                for _ in range(4):
                    view.do({"do": "turn", "dx": 0.05, "dy": 0.02})
                    view.picture(SIZE, moving=True, then=lambda made: None)
                view.do({"do": "look", "view": "left"})
            for view, before in zip(views, alone, strict=True):
                assert np.array_equal(wait_for_picture(view).image, before)
            views[0].close()
            assert np.array_equal(wait_for_picture(views[1]).image, alone[1])
        finally:
            for view in views:
                view.close()


def test_mesh_of_more_than_two_million_triangles_is_warned_of_as_slow():
    def warnings_of(triangles):
        mesh: Any = SimpleNamespace(triangle_count=triangles)
        shown = ShownMesh(number=1, name="mesh 1", mesh=mesh)
        own: Any = SimpleNamespace(model=SimpleNamespace(objects=[shown]), _timing={})
        return ViewSession._warnings(own)

    assert warnings_of(2_000_000) == []
    (warning,) = warnings_of(2_000_001)
    assert "mesh 1 has 2,000,001 triangles" in warning and "coarse" in warning


@pytest.mark.opencl
def test_picture_too_large_for_the_allowed_memory_is_an_error(open_session):
    memory = 80_000
    view = open_session(scenes.make_scan(), memory=memory)
    pictures: list[Any] = []

    view.picture((800, 800), moving=False, then=pictures.append)

    assert view.wait(PATIENCE)
    assert pictures == []
    assert f"{memory:,} bytes are allowed" in view.facts()["error"]


@pytest.mark.opencl
def test_first_picture_of_a_view_is_fitted_to_its_size_without_a_step_of_undo(open_session):
    view = open_session()
    before = view.model.camera.parallel_scale
    pictures: list[Any] = []

    view.picture((200, 80), moving=False, then=pictures.append)  # wide

    assert view.wait(PATIENCE)
    assert pictures[0].camera.parallel_scale < before
    assert view.model.undo() is None


@pytest.mark.opencl
def test_camera_that_was_changed_is_not_fitted_to_another_size(open_session):
    view = open_session()
    pictures: list[Any] = []
    view.picture((200, 80), moving=False, then=pictures.append)
    assert view.wait(PATIENCE)
    view.do({"do": "zoom", "factor": 2})
    zoomed = view.model.camera

    view.picture((80, 80), moving=False, then=pictures.append)

    assert view.wait(PATIENCE)
    assert pictures[1].camera == zoomed


@pytest.mark.opencl
def test_work_in_the_background_tells_of_its_changes(open_session):
    told = []
    view = open_session(scenes.make_scan(), on_change=lambda: told.append(1))
    view.prepare()
    view.do({"do": "find_parts"})
    assert view.wait(PATIENCE) and view.facts()["error"] is None
    assert len(told) >= 4  # begin and end of three works, and the parts: measured 7


def place_in_slice(view: ViewSession, pixel: tuple[float, float]) -> list[float]:
    """What lies at a pixel (x, y) of the coronal slice, LPS mm."""
    x, y = pixel
    return view.do({"do": "pick", "x": x, "y": y, "plane": "coronal", **AT})["pick"]["point"]


POINTER, MIDDLE = (70.0, 20.0), (48.0, 40.0)
"""Pixels (x, y) of a slice of 96 x 80."""
HEIGHT = float(SIZE[1])
FACTS_MM = 2e-3
"""Of places in facts, which have three decimals."""


@pytest.mark.opencl
def test_slice_is_zoomed_about_what_is_under_the_pointer(open_session):
    view = open_session()
    at_pointer, in_middle = place_in_slice(view, POINTER), place_in_slice(view, MIDDLE)
    about = [(POINTER[0] - MIDDLE[0]) / HEIGHT, (POINTER[1] - MIDDLE[1]) / HEIGHT]  # from the middle

    for factor in (2.0, 1.5):
        view.do({"do": "zoom_slice", "plane": "coronal", "factor": factor, "about": about, **AT})

    assert place_in_slice(view, POINTER) == pytest.approx(at_pointer, abs=FACTS_MM)
    away = np.subtract(place_in_slice(view, MIDDLE), at_pointer)
    assert away == pytest.approx(np.subtract(in_middle, at_pointer) / (2.0 * 1.5), abs=FACTS_MM)


@pytest.mark.opencl
def test_slice_that_was_zoomed_is_fitted_again_by_a_command(open_session):
    view = open_session()
    in_middle = place_in_slice(view, MIDDLE)
    view.do({"do": "zoom_slice", "plane": "coronal", "factor": 2.0, "about": [0.3, -0.2], **AT})

    view.do({"do": "fit_slices"})

    assert place_in_slice(view, MIDDLE) == pytest.approx(in_middle, abs=FACTS_MM)


@pytest.mark.opencl
@pytest.mark.parametrize("factor", [3.0, 0.6])
def test_slice_of_a_thin_stack_is_zoomed_about_the_pointer_beside_it(open_session, factor):
    view = open_session(Volume(np.zeros((3, 60, 60), np.int16), np.diag([3.0, 3.0, 5.0, 1.0])))
    pointer = (MIDDLE[0] + 0.2 * HEIGHT, MIDDLE[1] - 0.1 * HEIGHT)
    before = place_in_slice(view, pointer)
    assert before[2] > 2.5 * 5.0  # beside the stack, whose third slice of 5 mm ends there
    view.do({"do": "zoom_slice", "plane": "coronal", "factor": factor, "about": [0.2, -0.1], **AT})
    assert place_in_slice(view, pointer) == pytest.approx(before, abs=FACTS_MM)


@pytest.mark.opencl
def test_slice_that_is_shifted_far_stays_at_the_border_of_the_picture(open_session):
    view = open_session(Volume(np.zeros((3, 60, 60), np.int16), np.diag([3.0, 3.0, 5.0, 1.0])))
    view.do({"do": "pan_slice", "plane": "coronal", "dx": 0, "dy": 1000, **AT})
    lowest_in_the_middle = (MIDDLE[0], HEIGHT)
    assert place_in_slice(view, lowest_in_the_middle)[2] == pytest.approx(2.5 * 5.0)  # where its third slice ends


@pytest.mark.opencl
@pytest.mark.parametrize(
    "end",
    [
        {"do": "scroll", "plane": "axial", "steps": -99},
        {"do": "scroll", "plane": "axial", "steps": 99},
        {"do": "set_cross", "point": [-1e6, -1e6, -1e6]},
        {"do": "set_cross", "point": [1e6, 1e6, 1e6]},
    ],
    ids=["lowest slice", "highest slice", "first corner", "last corner"],
)
def test_probe_at_the_end_of_a_scan_is_inside_of_it(open_session, end):
    affine = [[0.7123457, 0, 0, -3.1415926], [0, 0.4, 0, 2.7182818], [0, 0, 1.2345678, -100.00049], [0, 0, 0, 1]]
    view = open_session(Volume(np.full((4, 6, 8), 70, np.int16), np.array(affine)))

    cross = view.do(end)["cross"]

    assert view.do({"do": "probe", "point": cross})["probe"]["hu"] == pytest.approx(70.0)


@pytest.mark.opencl
def test_slice_is_shifted_by_shares_of_its_height(open_session):
    view = open_session()
    view.do({"do": "zoom_slice", "plane": "coronal", "factor": 3.0, **AT})
    before = place_in_slice(view, MIDDLE)
    view.do({"do": "pan_slice", "plane": "coronal", "dx": 0.1, "dy": 0.05, **AT})
    shifted = (MIDDLE[0] + 0.1 * HEIGHT, MIDDLE[1] + 0.05 * HEIGHT)
    assert place_in_slice(view, shifted) == pytest.approx(before, abs=FACTS_MM)


@pytest.mark.opencl
def test_zoom_of_a_slice_beyond_the_largest_leaves_it(open_session):
    view = open_session()
    view.do({"do": "zoom_slice", "plane": "axial", "factor": 0.8 * MOST_ZOOM, **AT})
    before = view.model.state
    view.do({"do": "zoom_slice", "plane": "axial", "factor": 2.0, "about": [0.2, 0.2], **AT})
    assert view.model.state == before


@pytest.mark.opencl
def test_probe_of_a_place_has_its_hu_and_its_words_and_leaves_the_state(open_session):
    view = open_session()
    before = view.model.state

    inside = view.do({"do": "probe", "point": scenes.middle(0).tolist()})["probe"]

    assert inside["hu"] == pytest.approx(1000.0, abs=1.0)  # whole HU, interpolated
    assert inside["words"].endswith("mm LPS")
    assert view.model.state == before


@pytest.mark.opencl
def test_probe_outside_of_the_scan_has_no_hu(open_session):
    outside = open_session().do({"do": "probe", "point": [500.0, 0.0, 0.0]})["probe"]
    assert outside == {"hu": None, "words": "500.0, 0.0, 0.0 mm LPS"}


@pytest.mark.opencl
def test_spine_that_is_not_found_is_said_and_no_curve_is_made(open_session) -> None:
    view = open_session()  # balls

    view.do({"do": "find_spine"})

    assert view.wait(PATIENCE)
    assert "no spine" in view.facts()["error"]
    assert view.model.state.measures == ()
