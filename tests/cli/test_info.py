"""``clrecon info``: what is listed, for people and for programs, and what --strict makes of it."""

from __future__ import annotations

import io
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ct_files import PATIENT, SPACING, write_series
from dicom_series import Plan, set_values
from dicom_series import write_series as write_plan
from house import ROOT
from printed_text import Printer

from clrecon import list_series
from clrecon.cli.info import describe_certificate, render_listing
from clrecon.cli.main import main

ANSI = re.compile(r"\x1b\[")


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


@pytest.fixture
def ct(tmp_path: Path) -> Path:
    return write_series(tmp_path / "ct")


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Make stdout a terminal so many columns wide; gives it back."""

    def make(columns: int) -> Terminal:
        stream = Terminal()
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setenv("COLUMNS", str(columns))
        monkeypatch.setenv("TERM", "xterm")
        monkeypatch.delenv("NO_COLOR", raising=False)
        return stream

    return make


def entry(number: int, **changes: Any) -> dict[str, Any]:
    return {
        "number": number, "uid_hash": f"{number:016x}", "description": "", "modality": "CT", "kind": "stack",
        "shape_ijk": [512, 512, 99], "spacing_mm": [0.9766, 0.9766, 4.25], "extent_mm": [500.0, 500.0, 421.0],
        "slice_thickness_mm": 5.0, "tilt_deg": 0.0, "warnings": [], "problems": [], "slices": 99,
        "patient": 1, "study": 1, "phases": [], **changes,
    }  # fmt: skip


def listing(*entries: dict[str, Any], chosen: int | None = 1) -> dict[str, Any]:
    return {"series": list(entries), "chosen": chosen, "certificate": None}


def test_json_of_info_states_the_stack_of_its_folder(ct: Path, printed: Printer) -> None:
    assert main(["info", str(ct), "--json"]) == 0
    facts = printed().report()
    stack = {"number": 1, "slices": 17, "shape_ijk": [31, 25, 17], "modality": "CT", "kind": "stack"}
    assert stack.items() <= facts["series"][0].items()
    assert facts["series"][0]["spacing_mm"] == pytest.approx(SPACING)
    assert facts["chosen"] == 1
    assert facts["certificate"]["padding_share"] is None  # measured by --pixels only


def test_json_of_info_neither_warns_nor_names_the_patient(ct: Path, printed: Printer) -> None:
    assert main(["info", str(ct), "--json"]) == 0
    said = printed()
    assert said.error_lines == 0
    assert PATIENT.split("^")[0] not in said.everything


def test_pixels_are_read_on_request(ct: Path, printed: Printer) -> None:
    assert main(["info", str(ct), "--json", "--pixels"]) == 0
    certificate = printed().report()["certificate"]
    assert (certificate["padding_share"], certificate["hu_range"]) == (0.0, [-1000, 700])
    assert main(["info", str(ct), "--pixels"]) == 0
    printed().assert_output(-1000, 700)


CEILING_WARNING = "900 voxels are at 3071 HU, the ceiling of 12 bits"
"""On one slice of 30 x 30 voxels that all hold 4095, with the intercept -1024."""


@pytest.fixture
def bright_slice(tmp_path: Path) -> str:
    bright = set_values(PixelData=np.full((30, 30), 4095, np.uint16).tobytes(), BitsStored=12, HighBit=11)
    write_plan(tmp_path, Plan(shape=(4, 30, 30), signed=False), lambda ds, k: bright(ds, k) if k == 2 else None)
    return str(tmp_path)


def test_warnings_of_pixels_are_not_made_without_pixels(bright_slice: str, printed: Printer) -> None:
    assert main(["info", bright_slice]) == 0
    assert CEILING_WARNING not in printed().everything


def test_warnings_of_pixels_are_printed_once(bright_slice: str, printed: Printer) -> None:
    assert main(["info", bright_slice, "--pixels"]) == 0
    said = printed()
    assert said.error_lines == 0
    assert said.everything.count(CEILING_WARNING) == 1


def test_warnings_of_pixels_are_those_of_series_and_certificate(bright_slice: str, printed: Printer) -> None:
    assert main(["info", bright_slice, "--pixels", "--json"]) == 0
    facts = printed().report()
    assert facts["series"][0]["warnings"] == facts["certificate"]["warnings"]
    assert CEILING_WARNING in facts["certificate"]["warnings"][-1]


@pytest.fixture
def table_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The lines on a folder of the CT of 31 x 25 voxels, a smaller one, and three series of MR."""
    folder = write_series(tmp_path / "ct", number=1)
    write_series(folder, np.full((6, 9, 9), -1000, np.int16), number=2)
    for number in (3, 4, 6):
        write_series(folder, np.full((3, 9, 9), 5, np.int16), number=number, modality="MR")
    assert main(["info", str(folder)]) == 0
    return capsys.readouterr().out.splitlines()


def test_the_table_marks_the_largest_ct(table_rows: list[str]) -> None:
    assert table_rows[0].split()[:4] == ["series", "hash", "kind", "slices"]
    assert table_rows[2].split()[:2] == ["*", "1"] and table_rows[3].split()[0] == "2"
    assert "31 x 25" in table_rows[2] and "0.8 x 1.1 x 1.5" in table_rows[2]


def test_below_the_table_stand_what_is_not_read_and_the_choice(table_rows: list[str]) -> None:
    assert "series 3-5: not read: modality MR is not CT" in table_rows
    assert "series 1, as clrecon mesh would read it" in table_rows
    assert any(re.fullmatch(r"  slices +17 used, none dropped", row) for row in table_rows)


@pytest.fixture
def equal_series(tmp_path: Path) -> str:
    folder = write_series(tmp_path / "ct", number=1)
    return str(write_series(folder, number=2))


def test_of_equal_series_none_is_chosen_and_the_option_named(equal_series: str, printed: Printer) -> None:
    assert main(["info", equal_series, "--json"]) == 0
    said = printed()
    facts = said.report()
    assert (facts["chosen"], facts["certificate"]) == (None, None)
    said.assert_error("--series")


def test_equal_series_are_chosen_by_number(equal_series: str, printed: Printer) -> None:
    assert main(["info", equal_series, "--series", "2", "--json"]) == 0
    facts = printed().report()
    assert facts["chosen"] == facts["certificate"]["series"]["number"] == 2


def test_equal_series_are_chosen_by_hash(equal_series: str, printed: Printer) -> None:
    assert main(["info", equal_series, "--json"]) == 0
    uid_hash = printed().report()["series"][1]["uid_hash"]
    assert main(["info", equal_series, "--series", uid_hash, "--json"]) == 0
    assert printed().report()["chosen"] == 2


@pytest.mark.parametrize(
    ("options", "code", "facts"),
    [(["--series", "7"], 3, ("--series", "CT", 7, 1)), (["--strict"], 4, ("--series",))],
    ids=["no such number", "strict without a choice"],
)
def test_equal_series_are_refused_without_a_choice(
    equal_series: str, printed: Printer, options: list[str], code: int, facts: tuple[Any, ...]
) -> None:
    assert main(["info", equal_series, *options]) == code
    printed().assert_error(*facts)


def test_strict_passes_a_series_that_keeps_its_gates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_plan(tmp_path)
    assert main(["info", str(tmp_path), "--strict"]) == 0
    unmeasured = (
        "stated_gap, stated_places, one_volume, hu_scale, stored_sign, shown_places, padding_share, stored_bits"
    )
    assert re.search(rf"gates +\d+ kept, 0 failed, not measured: {unmeasured}", capsys.readouterr().out)


@pytest.fixture
def lossy(tmp_path: Path) -> str:
    """Seven slices of lossy compression whose values are of no known unit: two gates fail."""
    write_plan(tmp_path, change=set_values(LossyImageCompression="01", RescaleType="US"))
    return str(tmp_path)


def test_without_strict_a_series_that_fails_gates_is_no_error(lossy: str) -> None:
    assert main(["info", lossy]) == 0


def test_strict_fails_with_the_gates_that_failed(lossy: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", lossy, "--strict"]) == 4
    captured = capsys.readouterr()
    assert "FAILED     lossless: slices with lossy compression: 7, none allowed" in captured.out
    assert captured.err == (
        "clrecon: error: series 1 fails 2 gates: hu_known: slices whose values are not known to be HU: 7, "
        "none allowed; lossless: slices with lossy compression: 7, none allowed\n"
    )


def test_strict_with_json_prints_the_report_beside_its_error(lossy: str, printed: Printer) -> None:
    assert main(["info", lossy, "--strict", "--json", "-q"]) == 4
    said = printed()
    assert said.report()["chosen"] == 1
    said.assert_error("series", 1, "gates", 2)


def test_a_refused_series_has_its_certificate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_plan(tmp_path / "hole", Plan(shape=(9, 5, 6), leave_out=(4,)))
    assert main(["info", str(tmp_path / "hole")]) == 4
    captured = capsys.readouterr()
    assert "series 1, refused" in captured.out
    assert "each slice has its own place" not in captured.out and "--pixels reads it" not in captured.out
    assert "FAILED     missing_slices: slices missing in between: 1, none allowed" in captured.out
    assert "series 1 cannot be used: 1 slice missing" in captured.err


def test_info_prints_nothing_when_quiet(ct: Path, printed: Printer) -> None:
    assert main(["info", str(ct), "-q"]) == 0
    assert printed().is_silent


def test_a_file_gets_plain_text_of_any_width(ct: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("FORCE_COLOR", "1")
    lines = render_listing(listing(entry(1, description="long " * 60, warnings=["word " * 60])), [])
    assert not ANSI.search("".join(lines))
    assert any("long " * 59 in line for line in lines) and any("word " * 59 in line for line in lines)
    assert main(["info", str(ct)]) == 0
    captured = capsys.readouterr()
    assert not ANSI.search(captured.out) and "left out" not in captured.out


@pytest.mark.parametrize("columns", [200, 120, 80, 60, 30])
def test_a_terminal_gets_lines_that_fit(terminal: Any, columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal(columns)
    entries = [entry(1, description="LUMBAR SPINE 0.8 BONE"), entry(12, warnings=["gantry tilt " * 9], tilt_deg=12.5)]
    words = describe_certificate(None)
    assert any(ANSI.search(line) for line in render_listing(listing(*entries), words)) == (columns >= 80)
    monkeypatch.setenv("NO_COLOR", "1")
    lines = render_listing(listing(*entries), words)
    assert not ANSI.search("".join(lines))
    assert max(map(len, lines)) <= columns
    text = " ".join(" ".join(lines).split())
    assert all(word in text for word in ("LUMBAR", "SPINE", "0.9766 x 0.9766 x 4.25", "512 x 512", "gantry"))
    assert ("tilt" in lines[0]) == (columns >= 120)
    assert ("left out: a wider window" in text) == (columns in (120, 80))


def test_a_hostile_description_is_shown_as_it_is(terminal: Any) -> None:
    hostile = "[bold red]x[/] :smile: \x1b[31mred\x07\u202e"
    (_, _, row, *_) = render_listing(listing(entry(1, description=hostile, modality="[i]")), [])
    assert "[bold red]x[/] :smile: \\x1b[31mred\\x07\\u202e" in row and "[i]" in row
    terminal(200)
    shown = "".join(render_listing(listing(entry(1, description=hostile, problems=[hostile])), []))
    assert "\x1b[31mred" not in shown and "\x07" not in shown and "\u202e" not in shown


def test_a_plain_encoding_draws_no_lines_that_it_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert "\n".join(render_listing(listing(entry(1)), [])).isascii()


def test_patients_and_studies_stand_apart() -> None:
    entries = [
        entry(1),
        entry(2, study=3, phases=[{"number": 1}, {"number": 2}]),
        entry(3, patient=28, study=2),
        entry(4, patient=28, study=2, modality="SEG", kind="other"),
        entry(5, patient=None, study=None),
    ]
    lines = render_listing(listing(*entries), [])
    assert lines[0].split()[:3] == ["series", "patient", "study"] and "phases" in lines[0]
    rows = [line.removeprefix("*").split()[:3] for line in lines if re.match(r"[* ] +\d", line)]
    assert rows == [["1", "1", "1"], ["2", "1", "3"], ["3", "28", "2"], ["4", "28", "2"], ["5", "-", "-"]]


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.untraced
def test_thousands_of_series_take_one_line_each() -> None:
    entries = [entry(number, modality="MR", problems=["modality MR is not CT"]) for number in range(1, 2001)]
    lines = render_listing(listing(*entries, chosen=None), [])
    assert len(lines) == 2 + 2000 + 1
    assert lines[-1] == "series 1-2000: problem: modality MR is not CT"


def test_certificate_is_described_in_words(tmp_path: Path) -> None:
    write_plan(tmp_path, Plan(tilt_deg=12, angles=(3, 4, -5)), set_values(PatientPosition="FFP"))
    words = dict(describe_certificate(list_series(tmp_path, pixels=True).certificate))
    assert {
        "voxels": "6 x 5 x 7 of 0.5 x 0.7 x 1.278 mm; the box is 3.0 x 3.5 x 8.8 mm",  # 1.25 / cos 12 deg
        "directions": (
            "rows run to the left, columns to the back, slices to the head, their normal 5.0 degrees off that axis; "
            "feet first, prone (FFP)"
        ),
        "positions": "within 0.001 mm of even steps (allowed 0.0125)",
        "gaps": "1.25 mm",
        "thickness": "5 mm: 3.75 mm overlap between neighbouring slices (300 % of the gap)",
        "tilt": "-12.00 degrees (back edge towards the head), kept exactly as a shear",
        "padding": "0.0 % of the voxels hold no measurement",
        "values": "-124 to 145 HU; slope 1, intercept -1024",
        "stored": "Explicit VR Little Endian",
        "gates": "17 kept, 0 failed, not measured: stated_gap, stated_places, one_volume, hu_scale, shown_places",
    }.items() <= words.items()


def test_certificate_of_uneven_slices_describes_each_gap(tmp_path: Path) -> None:
    write_plan(tmp_path, Plan(offsets={3: 0.4}), set_values(SliceThickness=1))  # one of 7 slices is 0.4 mm too high
    words = dict(describe_certificate(list_series(tmp_path).certificate))
    assert words["gaps"] == "2 of 1.25, then 1 of 1.65, then 1 of 0.85, then 2 of 1.25 mm"
    assert words["thickness"] == (
        "1 mm: neighbouring slices overlap by up to 0.15 mm, or up to 0.65 mm between them are not measured"
    )
    assert words["positions"].startswith("uneven, up to 0.34")


def test_commands_of_the_certificate_page_print_what_it_shows(
    tmp_path: Path, device: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (ROOT / "docs" / "certificate.md").read_text(encoding="utf-8").split("## An example")[1]
    blocks = [block.splitlines() for block in re.findall(r"(?:^    .*\n)+", page, re.MULTILINE)]
    commands, words, comments = ([line[4:] for line in block] for block in blocks)
    monkeypatch.chdir(tmp_path)
    for command in commands:
        assert main(shlex.split(command)[1:]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[printed.index(words[0]) :] == words
    assert main(["mesh", "example", "-o", "torus.ply", "--device", str(device.index)]) == 0
    written = Path("torus.ply").read_bytes().split(b"end_header")[0].decode("ascii").splitlines()
    assert len(comments) == 7 and [line for line in comments if line not in written] == []


@pytest.mark.release
def test_mesh_strict_passes_a_scan_whose_gates_pass(tmp_path: Path, device: Any) -> None:
    folder = write_series(tmp_path / "ct")
    arguments = ["mesh", str(folder), "-o", str(tmp_path / "a.ply"), "--hu", "100", "--device", str(device.index)]
    assert main([*arguments, "--strict"]) == 0
    assert b"comment CERTIFICATE gates 19 passed 0 failed" in (tmp_path / "a.ply").read_bytes()


@pytest.fixture
def lossy_mesh(tmp_path: Path, device: Any) -> list[str]:
    """The words that make tmp_path/a.ply of a scan that says that it was compressed with loss."""
    import pydicom

    folder = write_series(tmp_path / "ct")
    for path in folder.iterdir():
        ds = pydicom.dcmread(path)
        ds.LossyImageCompression = "01"
        ds.save_as(path)
    return ["mesh", str(folder), "-o", str(tmp_path / "a.ply"), "--hu", "100", "--device", str(device.index)]


def test_mesh_strict_exits_with_7_where_a_gate_of_the_scan_fails(
    lossy_mesh: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*lossy_mesh, "--strict", "-q"]) == 7
    assert capsys.readouterr().err.startswith("clrecon: error: volume: gate lossless failed: slices with lossy")


def test_report_and_file_of_a_mesh_tell_the_failed_gate_of_the_scan(
    lossy_mesh: list[str], tmp_path: Path, printed: Printer
) -> None:
    assert main([*lossy_mesh, "--json"]) == 0
    report = printed().report()
    assert [gate["name"] for gate in report["volume"]["gates"] if gate["ok"] is False] == ["lossless"]
    assert any("lossy compression" in text for text in report["warnings"])
    assert b"comment CERTIFICATE gate_failed lossless: slices with lossy" in (tmp_path / "a.ply").read_bytes()


def test_mesh_strict_takes_slices_that_are_placed_one_by_one(tmp_path: Path, device: Any, printed: Printer) -> None:
    import pydicom

    folder = write_series(tmp_path / "ct")
    for path in folder.iterdir():
        ds = pydicom.dcmread(path)
        if ds.InstanceNumber > 9:
            ds.ImagePositionPatient[2] += 0.3  # one gap is wider
            ds.save_as(path)
    arguments = ["mesh", str(folder), "-o", str(tmp_path / "a.ply"), "--hu", "100", "--device", str(device.index)]
    assert main([*arguments, "--strict", "--json"]) == 0
    report = printed().report()
    said = report["volume"]
    assert said["uneven"] and [gate["name"] for gate in said["gates"] if gate["ok"] is False] == ["grid_residual"]
    assert any("unevenly spaced" in text for text in report["warnings"])
    assert main(["info", str(folder), "--strict"]) == 4
