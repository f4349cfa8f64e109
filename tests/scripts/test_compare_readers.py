"""The table of readers: cells by analysis, and one true row of it."""

from __future__ import annotations

import json
from pathlib import Path

import compare_readers
import numpy as np
import pytest
from trap_cases import Marks

ROOT = Path(__file__).resolve().parents[2]

TRUTH = Marks(np.array([1, 2, 3, 4]), np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 2], [1, 0, 2]]), 2)


def found(hu, lps_mm, *, shape=(5, 6, 2), notes=(), warnings=()):
    volume = {"hu": hu, "lps_mm": lps_mm, "shape": list(shape), "notes": list(notes)}
    return {"volumes": [volume], "warnings": list(warnings)}


PLACES = TRUTH.lps_mm.tolist()


@pytest.mark.parametrize(
    ("answer", "text", "silent_fault"),
    [
        (found([1, 2, 3, 4], PLACES), "0 S", False),
        (found([4, 3, 2, 1], PLACES[::-1]), "0 S", False),
        (found([4, 3, 2, 1], PLACES), "2.24 S", True),
        (found([4, 3, 2, 1], PLACES, warnings=["beware"]), "2.24 W", False),
        (found([1, 2, 3, 4], (TRUTH.lps_mm + [0, 0, 0.004]).tolist()), "0.004 S", False),
        (found([1, 2], PLACES[:2], shape=(5, 6, 1)), "0 S, 1 slice, 50% lost", True),
        (found([1, 2, 9, 3, 4], [*PLACES[:2], [7, 7, 7], *PLACES[2:]], shape=(5, 6, 3)), "0 S, 3 slices, mixed", True),
        (found([1, 20, 30, 40], PLACES), "- S, HU wrong", True),
        (found([1, 2, 3, 4], PLACES, notes=["+_Tilt"]), "0 S, +_Tilt", False),
        ({"refused": "ValueError: no", "verdict": "R"}, "R", False),
    ],
)
def test_cells_say_the_error_and_whether_it_is_silent(answer, text, silent_fault):
    cell = compare_readers.judge(answer, TRUTH)
    assert cell.text() == text and cell.is_silent_fault() is silent_fault


def test_any_volume_of_a_doubtful_series_without_a_word_is_a_silent_fault():
    name = "two acquisition times, interleaved"
    rows = {name: {"one": compare_readers.judge(found([1, 2, 3, 4], PLACES), TRUTH)}}
    assert compare_readers.make_table(rows, ["one"], markdown=True)[2] == f"| {name} | **0 S** |"
    assert not rows[name]["one"].is_silent_fault()


def test_two_frames_have_no_distance():
    truth = Marks(TRUTH.hu, np.where(np.arange(4)[:, None] < 2, TRUTH.lps_mm, np.nan), 2)
    cell = compare_readers.judge(found([1, 2, 3, 4], PLACES), truth)
    assert cell.text() == "0 S, two frames as one" and cell.is_silent_fault()


@pytest.mark.release
def test_readers_are_compared_in_a_row_of_the_table(tmp_path, capsys):
    """highdicom takes a tilt of 1 degree for none: 23 gaps of 1.25 mm, 0.50 mm off at both ends together."""
    arguments = ["--small", "--only", "tilt 1 deg", "--readers", "clrecon,highdicom", "--markdown"]
    assert compare_readers.main([*arguments, "--json", str(tmp_path / "table.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "| case | clrecon | highdicom |"
    assert lines[2] == "| tilt 1 deg | 0 W | **0.502 S** |"
    assert lines[-1].startswith("24 slices of 7 x 6, ") and "highdicom 0." in lines[-1]
    cells = json.loads((tmp_path / "table.json").read_text())["cases"]["tilt 1 deg"]
    assert cells["highdicom"]["error_mm"] == pytest.approx(23 * 1.25 * np.tan(np.radians(1.0)), rel=1e-3)
    assert "tilt -1.00 degrees" in cells["clrecon"]["told"]


def test_missing_readers_are_shown_as_such_and_unknown_ones_refused(monkeypatch, capsys):
    monkeypatch.setitem(compare_readers.READERS, "highdicom", ("no-such-distribution", None))
    assert compare_readers.main(["--small", "--only", "axial", "--readers", "highdicom"]) == 0
    shown = capsys.readouterr().out
    assert "n/a" in shown and "highdicom not installed" in shown
    with pytest.raises(SystemExit) as caught:
        compare_readers.main(["--readers", "nobody"])
    assert caught.value.code == 2 and "unknown readers nobody" in capsys.readouterr().err


def test_the_document_has_every_case():
    text = (ROOT / "docs" / "calibration.md").read_text()
    rows = [line.split(" | ")[0].lstrip("| ") for line in text.splitlines() if line.startswith("| ")]
    assert [name for name in compare_readers.CASES if name not in rows] == []
