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
from clrecon.viewer.session.commands import COMMANDS
from clrecon.viewer.session.session import ViewSession

SIZE = (96, 80)
PATIENCE = 60.0
AT = {"size": list(SIZE)}


@pytest.fixture
def session(device):
    with open_sessions(device) as make:
        yield make


def pixel(session: ViewSession, number: int) -> dict:
    """Arguments of a command at the middle of a ball."""
    x, y = session.model.camera.project([scenes.middle(number)], SIZE)[0][0]
    return {"x": float(x), "y": float(y), **AT}


def picture(session: ViewSession, moving: bool = False):
    found: list[Any] = []
    session.picture(SIZE, moving, found.append)
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
def test_every_command_is_done_and_undone(session):
    assert set(RIGHT) | {"save"} == set(COMMANDS)
    view = session()
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
    assert view.model.version > 20


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
)
def test_a_wrong_command_is_refused_and_changes_nothing(session, command, words):
    view = session()
    before, version = view.model.state, view.model.version
    with pytest.raises(UsageError, match=words):
        view.do(command)
    assert view.model.state == before and view.model.version == version and view.facts()["error"] is None


@pytest.mark.opencl
def test_pictures_and_slices_come_from_its_threads(session):
    view = session()
    names = []
    view.picture(SIZE, False, lambda made: names.append((threading.current_thread().name, made.size)))
    for plane in ("axial", "coronal", "sagittal"):
        view.slice(plane, (50, 40), lambda made: names.append((threading.current_thread().name, made.size)))
    assert view.wait(PATIENCE)
    assert sorted(size for _, size in names) == [(50, 40)] * 3 + [SIZE]
    assert all(name == "view-pictures" for name, _ in names)
    timing = view.facts()["timing"]
    assert timing["sharp"] and timing["size"] == list(SIZE) and timing["ms"] > 0.0


@pytest.mark.opencl
def test_a_coarse_picture_is_steered_and_the_latest_state_is_drawn(session, monkeypatch):
    view = session(scenes.make_scan())
    paint, took_ms = view.painter.picture, 1.0

    def paint_for(*given, **how):
        painted = paint(*given, **how)
        painted.report["ms"] = took_ms
        return painted

    monkeypatch.setattr(view.painter, "picture", paint_for)
    picture(view, moving=True)
    assert picture(view, moving=True).size == SIZE
    took_ms = 1e9
    picture(view, moving=True)
    assert picture(view, moving=True).size == (77, 64)
    view.do({"do": "look", "view": "left"})
    assert picture(view, moving=True).camera == view.model.camera


@pytest.mark.opencl
def test_a_part_at_a_pixel_is_hidden_once_the_parts_are_found(session):
    view = session()
    facts = view.do({"do": "hide_at", **pixel(view, 2)})
    assert facts["pick"]["part"] == "1"
    assert view.wait(PATIENCE)
    assert view.model.state.part("1/3").visible is False and view.model.state.part("1/1").visible
    view.do({"do": "only_at", **pixel(view, 1)})
    assert [each.key for each in view.model.state.parts if each.visible] == ["1", "1/2"]
    assert view.do({"do": "pick", **pixel(view, 0)})["pick"] is None
    view.do({"do": "undo"})
    view.do({"do": "undo"})
    assert view.model.state.part("1/3").visible


@pytest.mark.opencl
def test_parts_are_found_again_at_another_iso_value_when_nothing_moves(session):
    view = session(scenes.make_scan())
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


@pytest.mark.opencl
def test_points_of_a_tool_are_picks_in_picture_and_slices(session):
    view = session(scenes.make_scan())
    view.do({"do": "set_cross", "point": scenes.middle(0).tolist()})
    view.do({"do": "start_tool", "name": "distance"})
    assert view.do({"do": "add_point", "x": 1, "y": 1, **AT})["measure"] is None
    assert view.facts()["points"] == []
    for number in (0, 1):
        facts = view.do({"do": "add_point", **pixel(view, number)})
    assert facts["measure"]["unit"] == "mm" and facts["measures"][0]["text"].endswith(" mm")
    camera = view.painter.slice_camera(view.model.state, "axial", SIZE)
    x, y = camera.project([scenes.middle(0)], SIZE)[0][0]
    view.do({"do": "start_tool", "name": "seed"})
    facts = view.do({"do": "add_point", "x": x, "y": y, **AT, "plane": "axial"})
    assert facts["measure"]["points"][0] == pytest.approx(scenes.middle(0), abs=1e-3)
    facts = view.do({"do": "cross_at", **pixel(view, 1)})
    assert facts["cross"] == pytest.approx(facts["pick"]["point"], abs=1e-3)


@pytest.mark.opencl
def test_the_table_goes_in_the_background_and_it_is_said_how_much(session, monkeypatch):
    from clrecon.viewer.drawing import stage

    def remove(volume, progress=None):
        made = volume.with_voxels(volume.voxels.copy())
        made.report = {**made.report, "remove_table": {"removed_share": 0.25, "dense_voxels_removed": 1200}}
        return made

    monkeypatch.setattr(stage, "remove_table", remove)
    view = session(scenes.make_scan())
    view.do({"do": "set_table", "shown": False})
    assert view.wait(PATIENCE)
    facts = view.facts()
    assert facts["table"] is False and "25 % of the voxels" in facts["said"] and "1,200" in facts["said"]
    view.do({"do": "undo"})
    assert view.facts()["table"]

    def refuse(volume, progress=None):
        raise RefusedInputError("no body found")

    monkeypatch.setattr(stage, "remove_table", refuse)
    other = session(scenes.make_scan())
    other.do({"do": "set_table", "shown": False})
    assert other.wait(PATIENCE)
    assert other.facts()["error"] == "no body found" and other.facts()["table"]
    assert other.do({"do": "dismiss"})["error"] is None


@pytest.mark.opencl
def test_session_closes_within_a_second_while_it_works(session, monkeypatch):
    view = session()

    monkeypatch.setattr(view.painter, "find_parts", search_for_ever)
    view.do({"do": "find_parts"})
    view.picture((600, 600), False, lambda made: None)
    while "finding parts" not in view.facts()["busy"]:
        time.sleep(0.001)
    view.close()
    assert not view._work._thread.is_alive() and not view._pictures._thread.is_alive()
    view.picture(SIZE, False, lambda made: pytest.fail("a closed view draws nothing"))
    view.close()


@pytest.mark.opencl
def test_work_is_cancelled_by_a_command(session, monkeypatch):
    view = session()

    monkeypatch.setattr(view.painter, "find_parts", search_for_ever)
    view.do({"do": "find_parts"})
    while view.facts()["busy"] != ["finding parts"]:
        time.sleep(0.001)
    view.do({"do": "cancel"})
    assert view.wait(PATIENCE) and view.facts()["error"] is None


@pytest.mark.opencl
def test_several_sessions_share_a_painter_and_do_not_disturb_each_other(device):
    objects = show_objects([scenes.make_scan(), scenes.make_mesh()])
    with Painter(objects, device=device) as painter:
        views = [ViewSession(objects, painter, iso_value=iso) for iso in (300.0, 0.0, 700.0)]
        try:
            for view in views:
                picture(view)  # the view knows the size of its picture now
                view.do({"do": "look", "view": "left"})
            alone = [picture(view).image for view in views]
            for view in views:
                for _ in range(4):
                    view.do({"do": "turn", "dx": 0.05, "dy": 0.02})
                    view.picture(SIZE, True, lambda made: None)
                view.do({"do": "look", "view": "left"})
            for view, before in zip(views, alone, strict=True):
                assert np.array_equal(picture(view).image, before)
            views[0].close()
            assert np.array_equal(picture(views[1]).image, alone[1])
        finally:
            for view in views:
                view.close()


def test_a_mesh_of_many_triangles_is_said_to_be_slow():
    def warnings_of(triangles):
        mesh: Any = SimpleNamespace(triangle_count=triangles)
        shown = ShownMesh(number=1, name="mesh 1", mesh=mesh)
        own: Any = SimpleNamespace(model=SimpleNamespace(objects=[shown]), _timing={})
        return ViewSession._warnings(own)

    assert warnings_of(2_000_000) == []
    (warning,) = warnings_of(2_000_001)
    assert "mesh 1 has 2,000,001 triangles" in warning and "coarse" in warning


@pytest.mark.opencl
def test_a_scan_that_goes_through_in_slabs_is_said_to_be_slow(session):
    view = session(scenes.make_scan(), memory=80_000)
    found: list[Any] = []
    view.picture((24, 20), False, found.append)
    assert view.wait(PATIENCE) and found and view.facts()["error"] is None
    assert any("in slabs, which is slow" in text for text in view.facts()["warnings"])
    view.picture((800, 800), False, found.append)
    assert view.wait(PATIENCE) and len(found) == 1
    assert "80,000 bytes are allowed" in view.facts()["error"]


@pytest.mark.opencl
def test_the_first_view_fits_the_size_of_the_picture(session):
    view = session()
    wide = (200, 80)
    found: list[Any] = []
    before = view.model.camera.parallel_scale
    view.picture(wide, False, found.append)
    assert view.wait(PATIENCE) and found[0].camera.parallel_scale < before and view.model.undo() is None
    view.do({"do": "zoom", "factor": 2})
    zoomed = view.model.camera
    view.picture((80, 80), False, found.append)
    assert view.wait(PATIENCE) and found[1].camera == zoomed


@pytest.mark.opencl
def test_news_of_the_background_are_told(session):
    told = []
    view = session(scenes.make_scan(), on_change=lambda: told.append(1))
    view.prepare()
    view.do({"do": "find_parts"})
    assert view.wait(PATIENCE) and len(told) >= 4 and view.facts()["error"] is None


def place_in_slice(view: ViewSession, x: float, y: float) -> list[float]:
    return view.do({"do": "pick", "x": x, "y": y, "plane": "coronal", **AT})["pick"]["point"]


@pytest.mark.opencl
def test_a_slice_is_zoomed_about_what_is_under_the_pointer(session):
    view = session()
    before, middle = place_in_slice(view, 70.0, 20.0), place_in_slice(view, 48.0, 40.0)
    about = [(70.0 - 48.0) / 80.0, (20.0 - 40.0) / 80.0]
    for factor in (2.0, 1.5):
        view.do({"do": "zoom_slice", "plane": "coronal", "factor": factor, "about": about, **AT})
    assert place_in_slice(view, 70.0, 20.0) == pytest.approx(before, abs=2e-3)
    away = np.subtract(place_in_slice(view, 48.0, 40.0), before)
    assert away == pytest.approx(np.subtract(middle, before) / 3.0, abs=2e-3)
    view.do({"do": "fit_slices"})
    assert place_in_slice(view, 48.0, 40.0) == pytest.approx(middle, abs=2e-3)


@pytest.mark.opencl
@pytest.mark.parametrize("factor", [3.0, 0.6])
def test_a_slice_of_a_thin_stack_is_zoomed_about_the_pointer_beside_it(session, factor):
    view = session(Volume(np.zeros((3, 60, 60), np.int16), np.diag([3.0, 3.0, 5.0, 1.0])))
    before = place_in_slice(view, 64.0, 32.0)
    assert before[2] > 12.5
    view.do({"do": "zoom_slice", "plane": "coronal", "factor": factor, "about": [0.2, -0.1], **AT})
    assert place_in_slice(view, 64.0, 32.0) == pytest.approx(before, abs=2e-3)


@pytest.mark.opencl
def test_a_slice_that_is_shifted_far_stays_at_the_border_of_the_picture(session):
    view = session(Volume(np.zeros((3, 60, 60), np.int16), np.diag([3.0, 3.0, 5.0, 1.0])))
    view.do({"do": "pan_slice", "plane": "coronal", "dx": 0, "dy": 1000, **AT})
    assert place_in_slice(view, 48.0, 80.0)[2] == pytest.approx(12.5)


@pytest.mark.opencl
def test_a_probe_at_either_end_of_paging_and_at_the_borders_is_inside(session):
    affine = [[0.7123457, 0, 0, -3.1415926], [0, 0.4, 0, 2.7182818], [0, 0, 1.2345678, -100.00049], [0, 0, 0, 1]]
    view = session(Volume(np.full((4, 6, 8), 70, np.int16), np.array(affine)))
    ends = [{"do": "scroll", "plane": "axial", "steps": -99}, {"do": "scroll", "plane": "axial", "steps": 99}]
    ends += [{"do": "set_cross", "point": [-1e6, -1e6, -1e6]}, {"do": "set_cross", "point": [1e6, 1e6, 1e6]}]
    for end in ends:
        assert view.do({"do": "probe", "point": view.do(end)["cross"]})["probe"]["hu"] == pytest.approx(70.0), end


@pytest.mark.opencl
def test_a_slice_is_shifted_by_shares_of_its_height(session):
    view = session()
    view.do({"do": "zoom_slice", "plane": "coronal", "factor": 3.0, **AT})
    before = place_in_slice(view, 48.0, 40.0)
    view.do({"do": "pan_slice", "plane": "coronal", "dx": 0.1, "dy": 0.05, **AT})
    assert place_in_slice(view, 56.0, 44.0) == pytest.approx(before, abs=2e-3)


@pytest.mark.opencl
def test_a_zoom_beyond_the_largest_leaves_a_slice_as_it_is(session):
    view = session()
    view.do({"do": "zoom_slice", "plane": "axial", "factor": 40.0, **AT})
    before = view.model.state
    view.do({"do": "zoom_slice", "plane": "axial", "factor": 2.0, "about": [0.2, 0.2], **AT})
    assert view.model.state == before


@pytest.mark.opencl
def test_a_probe_says_hu_and_place_and_changes_nothing(session):
    view = session()
    before = view.model.state
    inside = view.do({"do": "probe", "point": scenes.middle(0).tolist()})["probe"]
    outside = view.do({"do": "probe", "point": [500.0, 0.0, 0.0]})["probe"]
    assert inside["hu"] == pytest.approx(1000.0, abs=1.0) and inside["words"].endswith("mm LPS")
    assert outside == {"hu": None, "words": "500.0, 0.0, 0.0 mm LPS"}
    assert view.model.state == before
