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


def make_gap_runs(count: int) -> list[dict[str, Any]]:
    return [{"count": 3, "gap_mm": float(n + 1)} for n in range(count)]


@pytest.mark.parametrize(
    ("gap_runs", "words"),
    [
        (make_gap_runs(2), "3 of 1, then 3 of 2 mm; SpacingBetweenSlices says 2"),
        (
            make_gap_runs(info._RUNS_SHOWN),
            ", then ".join(f"3 of {n + 1}" for n in range(info._RUNS_SHOWN)) + " mm; Spac",
        ),
        (make_gap_runs(info._RUNS_SHOWN + 1), "1 to 9 mm, usually 2; SpacingBetweenSlices says 2"),
        ([], "1 to 9 mm, usually 2; SpacingBetweenSlices says 2"),
    ],
)
def test_gaps_between_slices_are_listed_by_their_runs_up_to_a_number(
    gap_runs: list[dict[str, Any]], words: str
) -> None:
    of = {"gap_mm": {"min": 1.0, "max": 9.0, "median": 2.0}, "stated_gap_mm": 2.0, "gap_runs": gap_runs}
    assert info._describe_gaps(of).startswith(words)


def test_patients_are_separated_by_a_line_in_the_table_of_series() -> None:
    missing = ("uid_hash", "phases", "shape_ijk", "spacing_mm", "extent_mm", "slice_thickness_mm", "tilt_deg")
    known = {"study": 1, "kind": "stack", "modality": "CT", "slices": 9, "description": "", **dict.fromkeys(missing)}
    entries = [{**known, "number": n, "patient": who} for n, who in enumerate((7, 7, 8), start=1)]
    lines, _ = info._render_table(entries, 1, 200, styled=False)
    assert [line.split()[-9:-8] for line in lines[2:]] == [["7"], ["7"], [], ["8"]]


def test_words_of_distance_have_the_range_of_its_colours_and_the_share_beyond() -> None:
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


def test_words_of_a_corridor_have_both_ends_of_the_ranges_of_its_angles() -> None:
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


FULL_LINE = "  " + "x" * (console.FULL - 2)


@pytest.mark.parametrize(
    ("lines", "paragraphs"),
    [
        pytest.param(
            ["  --one N   words", "            more", "  --two N   others"],
            [["  --one N   words", "            more"], ["  --two N   others"]],
            id="help of two options",
        ),
        pytest.param(
            [FULL_LINE, "  more", "", "  other"],
            [[FULL_LINE, "  more"], [""], ["  other"]],
            id="a full line goes on, an empty one ends it",
        ),
        pytest.param(["a", "b"], [["a"], ["b"]], id="short lines"),
    ],
)
def test_lines_of_one_text_are_one_paragraph_to_be_wrapped(lines: list[str], paragraphs: list[list[str]]) -> None:
    assert console._find_paragraphs(lines) == paragraphs


@pytest.mark.parametrize(
    ("as_json", "quiet", "with_json", "is_printed"),
    [
        pytest.param(False, False, False, True, id="words"),
        pytest.param(False, False, True, True, id="words, of what JSON has not"),
        pytest.param(True, False, False, False, id="JSON that has it"),
        pytest.param(True, False, True, True, id="JSON that has it not"),
        pytest.param(False, True, True, False, id="quiet"),
    ],
)
def test_warning_is_printed_unless_it_is_in_the_json_or_quiet(
    as_json: bool, quiet: bool, with_json: bool, is_printed: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    made = Console(as_json=as_json)
    made.set_loudness(quiet, verbose=False)

    made.warn("cold", with_json=with_json)

    assert capsys.readouterr().err == ("clrecon: warning: cold\n" if is_printed else "")


def use_standard_output(**given: Any) -> None:
    """Do what ``clrecon cloud`` does with its options before its work."""
    options = argparse.Namespace(**{"output": "a.stl", "report": None, "json": False, "one_file": False, **given})
    with console.filled_streams("cloud", options, Console()):
        pass


def test_output_and_report_to_standard_output_are_refused() -> None:
    with refused(UsageError, "--report", "output"):
        use_standard_output(output="-", report="-")


def test_output_to_standard_output_with_json_is_refused() -> None:
    with refused(UsageError, "--json", "output"):
        use_standard_output(output="-", json=True)


@pytest.mark.parametrize(
    ("levels", "words"),
    [((200.0, 300.0), "several iso values"), ((200.0,), ""), (None, ""), ([200.0, 300.0], "")],
    ids=["two values", "one value", "none", "a range"],
)
def test_tuple_of_iso_values_is_said_to_make_several_meshes(levels: Any, words: str) -> None:
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
        (
            ModuleNotFoundError(name="scipy.sparse"),
            UsageError.exit_code,
            "clrecon: error: this needs the package scipy",
        ),
        (ModuleNotFoundError(name="clrecon.x"), ClreconError.exit_code, "clrecon: error: unexpected error (ModuleNot"),
    ],
)
def test_errors_are_printed_in_a_line_with_their_exit_code(
    error: Exception, code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert common._report_error(error, Console(), debug=False) == code
    assert capsys.readouterr().err.startswith(words)


def test_space_of_a_file_is_metres_for_glb_and_mm_of_its_frame_for_others() -> None:
    assert common.describe_space("a.GLB", "ras") == "metres, Y up"
    assert common.describe_space("a.glb.stl", "ras") == "RAS mm"


@pytest.mark.parametrize("levels", [(200.0, 300.0), ((200.0, 300.0),)], ids=["two levels", "a range"])
def test_comparison_at_two_levels_or_a_range_is_refused(levels: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(common, "pick", lambda *given: {"iso_value": {"iso_value": levels}})
    with refused(UsageError, "--hu", "one"):
        compare.run(argparse.Namespace(), Console())


@pytest.mark.parametrize(
    ("state", "asked_for", "is_missed"),
    [
        ("failed", (), True),
        ("left out", (), False),
        ("left out", ("a",), True),
        ("done", ("a",), False),
        ("done", (), False),
    ],
)
def test_method_of_a_comparison_is_missed_where_it_failed_or_was_asked_for_and_left_out(
    state: str, asked_for: tuple[str, ...], is_missed: bool
) -> None:
    assert compare._is_missed({"state": state, "name": "a"}, asked_for) == is_missed


def test_filled_volume_is_printed_in_a_line() -> None:
    assert mesh_command._describe_solid(None) == []
    solid = {"open": {"air": {"ml": 2.0}, "end": {"ml": 3.0}}, "filled_share": 0.25, "filled_ml": 12.0}
    assert mesh_command._describe_solid(solid) == [
        "solid    12.0 ml filled, 25 % of the solid, 5 ml enclosed stay open"
    ]


@pytest.mark.parametrize(("closed", "words"), [(True, "closed"), (False, "not closed")])
def test_quality_of_a_mesh_is_printed_in_a_line(closed: bool, words: str) -> None:
    report = {"components": 2, "closed": closed, "manifold": True, "area_mm2": 1234.0, "volume_ml": None}
    assert mesh_command._describe_quality(report) == [f"         2 components, {words}, manifold, 1,234 mm2"]


@pytest.mark.parametrize(
    ("moved", "mean", "words"),
    [
        (True, 0.06, " 0.06 mm inside of the level (5 % to 95 %: -0.30 to +0.20, outward is positive)"),
        (True, -0.06, " 0.06 mm outside of the level (5 % to 95 %: -0.30 to +0.20, outward is positive)"),
        (False, 0.06, " 0.06 mm outside of the bone (5 % to 95 %: -0.20 to +0.30, outward is positive)"),
        (False, -0.06, " 0.06 mm inside of the bone (5 % to 95 %: -0.20 to +0.30, outward is positive)"),
    ],
)
def test_side_of_a_fitted_surface_is_a_word_and_its_range_is_signed_outward(
    moved: bool, mean: float, words: str
) -> None:
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
    ("scan_passes", "mesh_passes", "strict", "code"),
    [
        pytest.param(False, False, True, 8, id="both fail"),
        pytest.param(False, True, True, 7, id="that of the scan fails"),
        pytest.param(True, False, True, 8, id="that of the mesh fails"),
        pytest.param(True, True, True, 0, id="both pass"),
        pytest.param(False, False, False, 0, id="both fail, not strict"),
    ],
)
def test_strict_exit_code_is_that_of_a_failed_gate_of_the_mesh_before_one_of_the_scan(
    scan_passes: bool, mesh_passes: bool, strict: bool, code: int
) -> None:
    def gate(name: str, ok: bool, **more: str) -> dict[str, Any]:
        return {"name": name, "ok": ok, "text": "t", "measured": 1, "bound": 0, "unit": None, **more}

    report = {
        "volume": {"gates": [gate("lossless", scan_passes), gate("grid_residual", ok=False)]},
        "gates": [gate("closed", mesh_passes, mesh="m")],
        "warnings": [],
    }
    assert mesh_command.finish_with_gates(report, Console(), strict) == code


@pytest.mark.parametrize(
    ("name", "own_units", "code"), [("hu_scale", True, 0), ("hu_scale", False, 7), ("lossless", True, 7)]
)
def test_failed_gate_of_hu_is_a_warning_where_the_level_is_in_the_values_own_units(
    name: str, own_units: bool, code: int
) -> None:
    gate = {"name": name, "ok": False, "text": "t", "measured": 1, "bound": 0, "unit": None}
    report = {"volume": {"gates": [gate]}, "gates": [], "warnings": []}
    assert mesh_command.finish_with_gates(report, Console(), strict=True, own_units=own_units) == code


def test_simulated_device_is_listed_as_a_simulator() -> None:
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


@pytest.mark.parametrize(
    ("words", "read_as"),
    [(["help", "mesh"], ["mesh", "--help-all"]), (["help"], ["--help"]), (["mesh", "help"], ["mesh", "help"])],
    ids=["before a command", "alone", "after a command"],
)
def test_word_help_before_a_command_becomes_its_option(words: list[str], read_as: list[str]) -> None:
    assert main._as_help_option(words) == read_as


@pytest.mark.parametrize(("ml", "words"), [(None, "0 ml"), (2.0, "2.00 ml")])
def test_missing_trabecular_volume_is_printed_as_0_ml(ml: float | None, words: str) -> None:
    vertebra = {
        "volumes_ml": {"canal": None, "solid": 9.0, "dense": 3.0, "trabecular": ml}, "dense_hu": (300.0, None),
        "iso_value_hu": 200.0, "canal_height_mm": None, "cortex": None, "name": "L3",
        "dense_thickness": {"median_mm": None, "limit_mm": 2.0},
    }  # fmt: skip
    lines = inside._describe_vertebra(vertebra)
    assert lines[2].endswith(f"(300 HU and above), trabecular {words}")


def test_option_without_help_has_no_description_in_the_completion_of_fish() -> None:
    def option(**given: Any) -> Any:
        return SimpleNamespace(**{"names": ["--a"], "words": [], "takes_value": False, "help": "", **given})

    command: Any = SimpleNamespace(help="makes", first=[], options=[option(), option(help="it's")])
    lines = completion._write_fish({"mesh": command}).splitlines()
    assert lines[2:] == [
        "complete -c clrecon -n '__fish_seen_subcommand_from mesh' -l a",
        "complete -c clrecon -n '__fish_seen_subcommand_from mesh' -l a -d 'it\\'s'",
    ]


@pytest.mark.parametrize("count", [0, 1, render._LABELS_LISTED, render._LABELS_LISTED + 1])
def test_labels_over_slices_are_listed_up_to_a_number_and_the_rest_counted(count: int) -> None:
    labels = [{"color": "#fff", "label": f"l{n}", "label_number": n} for n in range(count)]
    lines = render._describe_labels([{"labels": labels}, {"labels": None}])
    assert len(lines) == min(count, render._LABELS_LISTED + 1)
    assert (lines[-1:] == ["and 1 more labels, see the report"]) is (count > render._LABELS_LISTED)


@pytest.mark.parametrize(
    ("value", "words"), [(None, "none"), (1.26, "1.3"), (-0.04, "0"), (2.0, "2"), (99999.94, "99999.9"), (1e5, "1e+05")]
)
def test_hu_are_printed_with_a_decimal_where_there_is_one(value: float | None, words: str) -> None:
    assert stats._format_hu(value) == words


@pytest.mark.parametrize("resident", [None, {"median": 0.5, "q1": 0.4, "q3": 0.6, "min": 0.3, "max": 0.7}])
def test_time_of_a_new_iso_value_is_printed_where_it_was_measured(resident: dict[str, float] | None) -> None:
    times = {"median": 1.0, "q1": 0.9, "q3": 1.1, "min": 0.8, "max": 1.2}
    entry = {
        "device": {"index": 0, "name": "N", "platform": "P", "driver": "D"}, "vertices": 5, "triangles": 6,
        "mvoxels_per_s": 1.0, "mtriangles_per_s": 2.0, "error": None, "first_seconds": {"total": 1.0},
        "warm_seconds": times, "peer": None, "part_seconds": {}, "kernel_seconds": {}, "resident_seconds": resident,
        "ratio": None,
    }  # fmt: skip
    lines = bench._describe_device(entry)
    assert any("new iso value" in line for line in lines) is (resident is not None)


def test_help_of_mesh_names_the_options_that_cut_a_scan(printed: Printer) -> None:
    assert main.main(["help", "mesh"]) == 0
    printed().assert_output("--clip-box", "--between", "--around", "--fov", "--remove-table")


def test_short_help_of_distance_names_the_picture(printed: Printer) -> None:
    assert main.main(["distance", "--help"]) == 0
    printed().assert_output("--picture", "FILE")


@pytest.mark.parametrize(
    ("given", "is_measured"),
    [({}, False), ({"report": "a.json"}, True), ({"json": True}, True), ({"verbose": True}, True)],
    ids=["words", "report", "JSON", "verbose"],
)
def test_mesh_is_measured_where_its_figures_are_reported_or_printed(
    given: dict[str, Any], is_measured: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured: list[bool] = []

    def make_mesh(*names: object, measure: bool, **how: object) -> None:
        measured.append(measure)
        raise UsageError("enough")

    monkeypatch.setattr("clrecon.jobs.mesh.job.make_mesh", make_mesh)
    paths = {"input": "a", "output": "b.stl", "report": None, "store": None}
    options = {**paths, "json": False, "verbose": False, "no_clobber": False}
    with refused(UsageError, "enough"):
        mesh_command.run(argparse.Namespace(**options | given), Console())

    assert measured == [is_measured]


def test_progress_on_a_very_narrow_terminal_has_20_characters(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((5, 24)))
    Console()._draw("x" * 50, done=0, total=0)
    assert capsys.readouterr().err == "\rclrecon: " + "x" * (20 - len("clrecon: "))


def test_help_of_render_names_its_output(printed: Printer) -> None:
    assert main.main(["help", "render"]) == 0
    printed().assert_output("OUT")
