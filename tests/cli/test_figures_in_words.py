"""What commands print of a report's figures: each function on a few numbers, without a scan or a device."""

from __future__ import annotations

import argparse
import os
from types import SimpleNamespace
from typing import Any

import pytest
from printed_text import Printer
from refusals import refused

from clrecon.cli import (
    bench,
    common,
    compare,
    completion,
    console,
    corridor,
    devices,
    distance,
    info,
    inside,
    main,
    render,
    stats,
)
from clrecon.cli import mesh as mesh_command
from clrecon.cli.console import Console
from clrecon.errors import ClreconError, UsageError


def runs(count: int) -> list[dict[str, Any]]:
    return [{"count": 3, "gap_mm": float(n + 1)} for n in range(count)]


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (runs(2), "3 of 1, then 3 of 2 mm; SpacingBetweenSlices says 2"),
        (runs(info._RUNS_SHOWN), ", then ".join(f"3 of {n + 1}" for n in range(info._RUNS_SHOWN)) + " mm; Spac"),
        (runs(info._RUNS_SHOWN + 1), "1 to 9 mm, usually 2; SpacingBetweenSlices says 2"),
        ([], "1 to 9 mm, usually 2; SpacingBetweenSlices says 2"),
    ],
)
def test_gaps_are_told_by_their_runs_where_those_are_few(found: list[dict[str, Any]], words: str) -> None:
    of = {"gap_mm": {"min": 1.0, "max": 9.0, "median": 2.0}, "stated_gap_mm": 2.0, "gap_runs": found}
    assert info._describe_gaps(of).startswith(words)


def test_patients_are_parted_in_a_table_of_series() -> None:
    entries = [{"number": n, "patient": who} for n, who in enumerate(("a", "a", "b"), start=1)]
    columns = [info._Column("series", [str(n) for n in (1, 2, 3)])]
    table = info._make_table(columns, entries, 1)
    assert [row.end_section for row in table.rows] == [False, True, False]


def test_colours_of_distances_say_what_lies_beyond() -> None:
    mesh = {
        "triangles": 4,
        "volume_ml": None,
        "iso_value_hu": None,
        "cortex": None,
        "name": "a.stl",
        "components": 1,
        "area_mm2": 1.0,
        "vertices": 4,
        "space": "LPS",
        "space_from": "file",
    }
    side = {"mean": 1.0, "rms": 1.0, "p95": 1.0, "max": 1.0}
    report = {
        "a": mesh, "b": mesh, "a_to_b_mm": side, "b_to_a_mm": side, "assd_mm": 1.0, "hd95_mm": 1.0, "hausdorff_mm": 1.0,
        "a_to_b_signed_mm": None, "b_to_a_signed_mm": None, "seconds": {"total": 1.0}, "outputs": [],
        "colors": {"range_mm": 2.0, "signed": True, "beyond_share": 0.25},
    }  # fmt: skip
    assert "colours  -2 to +2 mm, beyond them 25.0 % of A's vertices" in distance._describe_distance(report)


def test_the_ranges_of_a_corridor_are_both_ends() -> None:
    point = [1.0, 2.0, 3.0]
    side = {
        "side": "left", "refused": None, "level_bias_mm": None, "sagittal_angle_range_deg": [-9.0, 8.0],
        "margins_mm": {"medial": 1.0}, "medial_angle_range_deg": [5.0, 15.0], "radius_mm": 3.0, "length_mm": 40.0,
        "screw_diameter_mm": 4.0, "medial_angle_deg": 10.0, "medial_angle_lps_deg": 11.0, "sagittal_angle_deg": 1.0,
        "sagittal_angle_lps_deg": 2.0, "entry_mm": point, "tip_mm": point, "canal_mm": 2.0,
    }  # fmt: skip
    lines = corridor._describe_side("L3", side, {"space": "lps", "margin_mm": 1.0, "surface": "hu"})
    assert lines[1].strip() == (
        "medial 10 degrees (5 to 15 within 0.1 mm; LPS 11), sagittal not determined: -9 to 8 within 0.1 mm, line at 1"
        " (LPS 2)"
    )


def test_lines_that_are_one_text_are_put_together() -> None:
    full = "  " + "x" * (console.FULL - 2)
    labelled = ["  --one N   words", "            more", "  --two N   others"]
    assert console._find_paragraphs(labelled) == [labelled[:2], labelled[2:]]
    assert console._find_paragraphs([full, "  more", "", "  other"]) == [[full, "  more"], [""], ["  other"]]
    assert console._find_paragraphs(["a", "b"]) == [["a"], ["b"]]


@pytest.mark.parametrize(
    ("as_json", "quiet", "with_json", "is_said"),
    [
        (False, False, False, True), (False, False, True, True), (True, False, False, False), (True, False, True, True),
        (False, True, True, False),
    ],
)  # fmt: skip
def test_warnings_are_said_once(
    as_json: bool, quiet: bool, with_json: bool, is_said: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    made = Console(as_json=as_json)
    made.set_loudness(quiet, False)
    made.warn("cold", with_json=with_json)
    assert capsys.readouterr().err == ("clrecon: warning: cold\n" if is_said else "")


def test_a_new_console_draws_at_once() -> None:
    assert Console()._last_draw == 0.0


def test_two_files_cannot_share_standard_output() -> None:
    def use(**given: Any) -> None:
        options = argparse.Namespace(**{"output": "a.stl", "report": None, "json": False, "one_file": False, **given})
        with console.filled_streams("cloud", options, Console()):
            pass

    with refused(UsageError, "--report", "output"):
        use(output="-", report="-")
    with refused(UsageError, "--json", "output"):
        use(output="-", json=True)
    use(json=True)


@pytest.mark.parametrize(
    ("levels", "words"), [((200.0, 300.0), "several iso values"), ((200.0,), ""), (None, ""), ([200.0, 300.0], "")]
)
def test_several_levels_make_several_files(levels: Any, words: str) -> None:
    options = argparse.Namespace(
        one_file=False, split=False, below=None, iso_value={"iso_value": levels}, path=None, grow_from=None, label=None
    )
    assert console._find_several("mesh", options) == words


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (UsageError("a"), UsageError.exit_code, "clrecon: error: a\n"),
        (MemoryError(), ClreconError.exit_code, "clrecon: error: out of memory: free some, or use a smaller series\n"),
        (ZeroDivisionError("b"), ClreconError.exit_code, "clrecon: error: unexpected error (ZeroDivisionError: b)"),
    ],
)
def test_errors_are_printed_in_a_line_with_their_exit_code(
    error: Exception, code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert common._report_error(error, Console(), debug=False) == code
    assert capsys.readouterr().err.startswith(words)


def test_files_have_their_units() -> None:
    assert common.describe_space("a.GLB", "ras") == "metres, Y up"
    assert common.describe_space("a.glb.stl", "ras") == "RAS mm"


@pytest.mark.parametrize("levels", [(200.0, 300.0), ((200.0, 300.0),)])
def test_comparison_at_two_levels_or_a_range_is_refused(levels: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "pick", lambda *given: {"iso_value": {"iso_value": levels}})
    with refused(UsageError, "value"):
        compare.run(argparse.Namespace(), Console())


def test_a_method_is_missed_if_it_failed_or_was_asked_for() -> None:
    cases = [("failed", ()), ("left out", ()), ("left out", ("a",)), ("done", ("a",)), ("done", ())]
    missed = [compare._is_missed({"state": state, "name": "a"}, asked) for state, asked in cases]
    assert missed == [True, False, True, False, False]


def test_filled_volume_is_printed_in_a_line() -> None:
    assert mesh_command._describe_solid(None) == []
    solid = {"open": {"air": {"ml": 2.0}, "end": {"ml": 3.0}}, "filled_share": 0.25, "filled_ml": 12.0}
    assert mesh_command._describe_solid(solid) == [
        "solid    12.0 ml filled, 25 % of the solid, 5 ml enclosed stay open"
    ]


@pytest.mark.parametrize(("closed", "words"), [(True, "closed"), (False, "not closed")])
def test_the_quality_of_a_mesh_is_a_line(closed: bool, words: str) -> None:
    report = {"components": 2, "closed": closed, "manifold": True, "area_mm2": 1234.0, "volume_ml": None}
    assert mesh_command._describe_quality(report) == [f"         2 components, {words}, manifold, 1,234 mm2"]


@pytest.mark.parametrize(
    ("moved", "mean", "words"),
    [
        (True, 0.06, " 0.06 mm inside of the level"),
        (True, -0.06, " 0.06 mm outside of the level"),
        (False, 0.06, " 0.06 mm outside of the bone"),
        (False, -0.06, " 0.06 mm inside of the bone"),
    ],
)
def test_the_side_of_the_bone_is_a_word_and_no_sign(moved: bool, mean: float, words: str) -> None:
    spread = {"p5": -0.2, "p50": 0.0, "p95": 0.3}
    cortex = {
        "moved": moved, "constants": {"blur_mm": 0.6}, "vertices": 200, "fitted": 100, "bias_mm": 0.05,
        "outside_mm": {"mean": mean, **spread}, "error_mm": spread, "thickness_mm": spread,
    }  # fmt: skip
    (line,) = mesh_command.describe_cortex([{"cortex": cortex}])
    assert words in line


def test_volume_of_a_label_mesh_is_printed_beside_that_of_the_label() -> None:
    one = {"label_number": 1, "iso_value_hu": 200.0, "label_mesh_ml": 11.0, "label_compared_ml": 10.0}
    assert mesh_command._describe_volumes([one, one]) == ["         11.00 ml of mesh for 10.00 ml of labels (+10.0 %)"]


@pytest.mark.parametrize(
    ("scan", "of_mesh", "strict", "code"),
    [
        (False, False, True, 8),
        (False, True, True, 7),
        (True, False, True, 8),
        (True, True, True, 0),
        (False, False, False, 0),
    ],
)
def test_a_gate_of_the_mesh_decides_the_code(scan: bool, of_mesh: bool, strict: bool, code: int) -> None:
    def gate(name: str, ok: bool, **more: str) -> dict[str, Any]:
        return {"name": name, "ok": ok, "text": "t", "measured": 1, "bound": 0, "unit": None, **more}

    report = {
        "volume": {"gates": [gate("lossless", scan), gate("grid_residual", False)]},
        "gates": [gate("closed", of_mesh, mesh="m")],
        "warnings": [],
    }
    assert mesh_command.finish_with_gates(report, Console(), strict) == code


@pytest.mark.parametrize(
    ("name", "own_units", "code"), [("hu_scale", True, 0), ("hu_scale", False, 7), ("lossless", True, 7)]
)
def test_a_level_in_the_values_own_units_leaves_gates_of_hu_warnings(name: str, own_units: bool, code: int) -> None:
    gate = {"name": name, "ok": False, "text": "t", "measured": 1, "bound": 0, "unit": None}
    report = {"volume": {"gates": [gate]}, "gates": [], "warnings": []}
    assert mesh_command.finish_with_gates(report, Console(), True, own_units=own_units) == code


def test_a_simulator_is_named_as_one() -> None:
    device = {
        "chosen": True, "simulator": True, "type": "cpu", "has_own_memory": False, "memory_bytes": 10**6,
        "max_allocation_bytes": 10**6, "index": 0, "name": "N", "compute_units": 2, "platform": "P", "version": "V",
        "driver": "D", "shortcoming": "", "fault": "",
    }  # fmt: skip
    survey = {
        "devices": [device, {**device, "simulator": False, "chosen": False}],
        "platforms": [],
        "reason": "no other one",
    }
    lines = devices._describe_survey(survey)
    assert [line[:14].strip() for line in lines if line[4:14].strip()[:3] in ("sim", "cpu")] == [
        "* 0  simulator",
        "0  cpu",
    ]


def test_word_help_becomes_the_option_of_the_command_behind_it() -> None:
    assert main._as_help_option(["help", "mesh"]) == ["mesh", "--help-all"]
    assert main._as_help_option(["help"]) == ["--help"]
    assert main._as_help_option(["mesh", "help"]) == ["mesh", "help"]


@pytest.mark.parametrize(("ml", "words"), [(None, "0 ml"), (2.0, "2.00 ml")])
def test_a_trabecular_volume_that_is_not_there_is_0_ml(ml: float | None, words: str) -> None:
    vertebra = {
        "volumes_ml": {"canal": None, "solid": 9.0, "dense": 3.0, "trabecular": ml}, "dense_hu": (300.0, None),
        "iso_value_hu": 200.0, "canal_height_mm": None, "cortex": None, "name": "L3",
        "dense_thickness": {"median_mm": None, "limit_mm": 2.0},
    }  # fmt: skip
    lines = inside._describe_vertebra(vertebra)
    assert lines[2].endswith(f"(300 HU and above), trabecular {words}")


def test_options_without_help_have_none_in_fish() -> None:
    def option(**given: Any) -> Any:
        return SimpleNamespace(**{"names": ["--a"], "words": [], "takes_value": False, "help": "", **given})

    command: Any = SimpleNamespace(help="makes", first=[], options=[option(), option(help="it's")])
    lines = completion._write_fish({"mesh": command}).splitlines()
    assert lines[2:] == [
        "complete -c clrecon -n '__fish_seen_subcommand_from mesh' -l a",
        "complete -c clrecon -n '__fish_seen_subcommand_from mesh' -l a -d 'it\\'s'",
    ]


@pytest.mark.parametrize("count", [0, 1, render._LABELS_LISTED, render._LABELS_LISTED + 1])
def test_labels_over_slices_are_listed_up_to_a_number(count: int) -> None:
    labels = [{"color": "#fff", "label": f"l{n}", "label_number": n} for n in range(count)]
    lines = render._describe_labels([{"labels": labels}, {"labels": None}])
    assert len(lines) == min(count, render._LABELS_LISTED + 1)
    assert (lines[-1:] == ["and 1 more labels, see the report"]) is (count > render._LABELS_LISTED)


@pytest.mark.parametrize(
    ("value", "words"), [(None, "none"), (1.26, "1.3"), (-0.04, "0"), (2.0, "2"), (99999.94, "99999.9"), (1e5, "1e+05")]
)
def test_hu_have_a_decimal_where_there_is_one(value: float | None, words: str) -> None:
    assert stats._format_hu(value) == words


@pytest.mark.parametrize("resident", [None, {"median": 0.5, "q1": 0.4, "q3": 0.6, "min": 0.3, "max": 0.7}])
def test_a_volume_on_the_device_has_its_row(resident: dict[str, float] | None) -> None:
    times = {"median": 1.0, "q1": 0.9, "q3": 1.1, "min": 0.8, "max": 1.2}
    entry = {
        "device": {"index": 0, "name": "N", "platform": "P", "driver": "D"}, "vertices": 5, "triangles": 6,
        "mvoxels_per_s": 1.0, "mtriangles_per_s": 2.0, "error": None, "first_seconds": {"total": 1.0},
        "warm_seconds": times, "peer": None, "part_seconds": {}, "kernel_seconds": {}, "resident_seconds": resident,
        "ratio": None,
    }  # fmt: skip
    lines = bench._describe_device(entry)
    assert any("new iso value" in line for line in lines) is (resident is not None)


def test_meshes_are_made_of_a_part_of_a_scan(capsys: pytest.CaptureFixture[str]) -> None:
    assert main.main(["help", "mesh"]) == 0
    told = capsys.readouterr().out
    assert all(option in told for option in ("--clip-box", "--between", "--around", "--fov", "--remove-table"))


def test_the_picture_of_distances_is_among_the_first_options(printed: Printer) -> None:
    assert main.main(["distance", "--help"]) == 0
    printed().assert_output("--picture", "FILE")


@pytest.mark.parametrize("given", [{}, {"report": "a.json"}, {"json": True}, {"verbose": True}])
def test_a_mesh_is_measured_for_whoever_sees_the_figures(
    given: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[bool] = []

    def make_mesh(*names: object, measure: bool, **how: object) -> None:
        told.append(measure)
        raise UsageError("enough")

    monkeypatch.setattr("clrecon.jobs.mesh.job.make_mesh", make_mesh)
    monkeypatch.setattr(mesh_command, "mesh_fields", lambda options: {})
    options = {"input": "a", "output": "b.stl", "report": None, "json": False, "verbose": False, "no_clobber": False}
    with refused(UsageError, "enough"):
        mesh_command.run(argparse.Namespace(**options | given), Console())
    assert told == [bool(given)]


def test_a_moving_line_has_20_characters_at_least(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((5, 24)))
    Console()._draw("x" * 50, 0, 0)
    assert capsys.readouterr().err == "\rclrecon: " + "x" * 11


def test_a_turntable_needs_no_picture(printed: Printer) -> None:
    assert main.main(["help", "render"]) == 0
    printed().assert_output("OUT")
