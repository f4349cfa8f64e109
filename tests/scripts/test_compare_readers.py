"""The table of DICOM readers: the text of its cells, and one row that is really read."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import compare_readers
import numpy as np
import pytest
from refusals import refused
from trap_plan import Marks

ROOT = Path(__file__).resolve().parents[2]

TRUTH = Marks(np.array([1, 2, 3, 4]), np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 2], [1, 0, 2]]), 2)


def answer_of_reader(hu, lps_mm, *, shape=(5, 6, 2), notes=(), warnings=()):
    """What a reader makes of a series with four marked voxels, of 1 to 4 HU: their values and places."""
    volume = {"hu": hu, "lps_mm": lps_mm, "shape": list(shape), "notes": list(notes)}
    return {"volumes": [volume], "warnings": list(warnings)}


PLACES = TRUTH.lps_mm.tolist()
OTHER = [7, 7, 7]
SHIFTED = (TRUTH.lps_mm + [0, 0, 0.004]).tolist()
ACROSS = f"{np.hypot(1, 2):.2f}"  # mm from the first place to the last, which is the largest error of a reversed order


@pytest.mark.parametrize(
    ("answer", "text", "silent_fault"),
    [
        pytest.param(answer_of_reader([1, 2, 3, 4], PLACES), "0 S", False, id="right"),
        pytest.param(answer_of_reader([4, 3, 2, 1], PLACES[::-1]), "0 S", False, id="right in another order"),
        pytest.param(answer_of_reader([4, 3, 2, 1], PLACES), f"{ACROSS} S", True, id="values at other places"),
        pytest.param(
            answer_of_reader([4, 3, 2, 1], PLACES, warnings=["beware"]), f"{ACROSS} W", False, id="wrong with a warning"
        ),
        pytest.param(answer_of_reader([1, 2, 3, 4], SHIFTED), "0.004 S", False, id="4 um off"),
        pytest.param(
            answer_of_reader([1, 2], PLACES[:2], shape=(5, 6, 1)), "0 S, 1 slice, 50% lost", True, id="half is lost"
        ),
        pytest.param(
            answer_of_reader([1, 2, 9, 3, 4], [*PLACES[:2], OTHER, *PLACES[2:]], shape=(5, 6, 3)),
            "0 S, 3 slices, mixed",
            True,
            id="a slice of another series",
        ),
        pytest.param(answer_of_reader([1, 20, 30, 40], PLACES), "- S, HU wrong", True, id="wrong values"),
        pytest.param(answer_of_reader([1, 2, 3, 4], PLACES, notes=["+_Tilt"]), "0 S, +_Tilt", False, id="a note"),
        pytest.param({"refused": "ValueError: no", "verdict": "R"}, "R", False, id="refused"),
    ],
)
def test_cell_of_a_reader_has_its_error_in_mm_and_is_a_fault_if_it_was_silent(answer, text, silent_fault):
    cell = compare_readers.judge(answer, TRUTH)
    assert cell.text() == text
    assert cell.is_silent_fault() is silent_fault


def test_volume_of_an_ambiguous_series_without_a_warning_is_marked_as_a_silent_fault():
    """Of two acquisition times in one series neither is the right one, so no place is wrong."""
    name = "two acquisition times, interleaved"
    cell = compare_readers.judge(answer_of_reader([1, 2, 3, 4], PLACES), TRUTH)
    assert not cell.is_silent_fault()
    _, _, row = compare_readers.make_table({name: {"one": cell}}, ["one"], markdown=True)
    assert row == f"| {name} | **0 S** |"


def test_volume_of_two_frames_of_reference_is_a_silent_fault_without_a_distance_between_them():
    of_first_frame = np.arange(4)[:, None] < 2
    truth = Marks(TRUTH.hu, np.where(of_first_frame, TRUTH.lps_mm, np.nan), 2)
    cell = compare_readers.judge(answer_of_reader([1, 2, 3, 4], PLACES), truth)
    assert cell.text() == "0 S, two frames as one"
    assert cell.is_silent_fault()


@pytest.fixture(scope="module")
def tilt_json(tmp_path_factory):
    """The file that `tilt_lines` writes."""
    return tmp_path_factory.mktemp("readers") / "table.json"


@pytest.fixture(scope="module")
def tilt_lines(tilt_json):
    """The printed lines of a comparison of two readers on a series with a gantry tilt of 1 degree."""
    arguments = ["--small", "--only", "tilt 1 deg", "--readers", "clrecon,highdicom", "--markdown"]
    output = StringIO()
    with redirect_stdout(output):
        assert compare_readers.main([*arguments, "--json", str(tilt_json)]) == 0
    return output.getvalue().splitlines()


@pytest.mark.release
def test_table_of_readers_has_a_row_of_the_case_with_a_cell_of_each_reader(tilt_lines):
    assert tilt_lines[0] == "| case | clrecon | highdicom |"
    assert tilt_lines[2] == "| tilt 1 deg | 0 W | **0.502 S** |"


@pytest.mark.release
def test_last_line_below_a_table_of_readers_has_the_size_of_the_series_and_the_versions(tilt_lines):
    assert tilt_lines[-1].startswith("24 slices of 7 x 6, ")
    assert "highdicom 0." in tilt_lines[-1]


@pytest.mark.release
@pytest.mark.usefixtures("tilt_lines")
def test_tilt_that_highdicom_ignores_is_an_error_of_its_offset_over_all_slices(tilt_json):
    cells = json.loads(tilt_json.read_text())["cases"]["tilt 1 deg"]
    gaps, gap_mm = 24 - 1, 1.25
    assert cells["highdicom"]["error_mm"] == pytest.approx(gaps * gap_mm * np.tan(np.radians(1.0)), rel=1e-3)


@pytest.mark.release
@pytest.mark.usefixtures("tilt_lines")
def test_tilt_that_clrecon_warns_of_is_kept_with_its_warning(tilt_json):
    cells = json.loads(tilt_json.read_text())["cases"]["tilt 1 deg"]
    assert "tilt -1.00 degrees" in cells["clrecon"]["told"]


def test_reader_that_is_not_installed_is_shown_as_such(monkeypatch, capsys):
    monkeypatch.setitem(compare_readers.READERS, "highdicom", ("no-such-distribution", None))
    assert compare_readers.main(["--small", "--only", "axial", "--readers", "highdicom"]) == 0
    output = capsys.readouterr().out
    assert "n/a" in output
    assert "highdicom not installed" in output


def test_unknown_reader_is_refused_by_name(printed):
    with refused(SystemExit, 2):
        compare_readers.main(["--readers", "nobody"])
    printed().assert_error("nobody")


def test_page_on_calibration_has_a_row_of_every_case():
    text = (ROOT / "docs" / "calibration.md").read_text()
    rows = [line.split(" | ")[0].lstrip("| ") for line in text.splitlines() if line.startswith("| ")]
    assert [name for name in compare_readers.CASES if name not in rows] == []
