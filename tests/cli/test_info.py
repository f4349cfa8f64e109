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
from ct_files import SPACING, find_words, sphere_voxels, write_series
from dicom_series import Plan, set_values
from dicom_series import write_series as write_plan
from house import ROOT
from printed_text import Printer

from clrecon import list_series, read_volume
from clrecon.cli.info import describe_certificate, render_listing
from clrecon.cli.main import main

ANSI = re.compile(r"\x1b\[")


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


@pytest.fixture
def ct(tmp_path: Path) -> Path:
    """A sphere of 700 HU in air of -1000 HU, in 17 slices of 31 x 25 voxels."""
    return write_series(tmp_path / "ct", sphere_voxels((17, 25, 31)))


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


def make_entry(number: int, **changes: Any) -> dict[str, Any]:
    return {
        "number": number, "uid_hash": f"{number:016x}", "description": "", "modality": "CT", "kind": "stack",
        "shape_ijk": [512, 512, 99], "spacing_mm": [0.9766, 0.9766, 4.25], "extent_mm": [500.0, 500.0, 421.0],
        "slice_thickness_mm": 5.0, "tilt_deg": 0.0, "warnings": [], "problems": [], "slices": 99,
        "patient": 1, "study": 1, "phases": [], **changes,
    }  # fmt: skip


def make_listing(*entries: dict[str, Any], chosen: int | None = 1) -> dict[str, Any]:
    return {"series": list(entries), "chosen": chosen, "certificate": None}


def test_json_of_info_states_the_stack_of_its_folder(ct: Path, printed: Printer) -> None:
    assert main(["info", str(ct), "--json"]) == 0
    facts = printed().report()
    stack = {"number": 1, "slices": 17, "shape_ijk": [31, 25, 17], "modality": "CT", "kind": "stack"}
    assert stack.items() <= facts["series"][0].items()
    assert facts["series"][0]["spacing_mm"] == pytest.approx(SPACING)
    assert facts["chosen"] == 1
    assert facts["certificate"]["padding_share"] is None  # measured by --pixels only


def test_json_of_info_neither_warns_nor_names_the_patient_beyond_the_description(ct: Path, printed: Printer) -> None:
    assert main(["info", str(ct), "--json"]) == 0
    said = printed()
    assert said.error_lines == 0
    assert set(find_words(said.everything)) == {"Jolanthe", "scan of Jolanthe"}  # as the series is described


def test_info_with_pixels_has_their_padding_and_range_in_json(ct: Path, printed: Printer) -> None:
    assert main(["info", str(ct), "--json", "--pixels"]) == 0
    certificate = printed().report()["certificate"]
    assert (certificate["padding_share"], certificate["hu_range"]) == (0.0, [-1000, 700])
    assert main(["info", str(ct), "--pixels"]) == 0
    printed().assert_output(-1000, 700)


CEILING_WARNING = "900 voxels are at 3071 HU, the ceiling of 12 bits"
"""On one slice of 30 x 30 voxels that all hold 4095, with the intercept -1024."""


@pytest.fixture
def bright_slice(tmp_path: Path) -> str:
    """A folder with 4 slices of 30 x 30 voxels, one of which is at the ceiling."""
    bright = set_values(PixelData=np.full((30, 30), 4095, np.uint16).tobytes(), BitsStored=12, HighBit=11)
    write_plan(tmp_path, Plan(shape=(4, 30, 30), signed=False), lambda ds, k: bright(ds, k) if k == 2 else None)
    return str(tmp_path)


def test_info_without_pixels_has_no_warning_of_their_values(bright_slice: str, printed: Printer) -> None:
    assert main(["info", bright_slice]) == 0
    assert CEILING_WARNING not in printed().everything


def test_info_with_pixels_prints_a_warning_of_their_values_once(bright_slice: str, printed: Printer) -> None:
    assert main(["info", bright_slice, "--pixels"]) == 0
    said = printed()
    assert said.error_lines == 0
    assert said.everything.count(CEILING_WARNING) == 1


def test_warning_of_the_values_of_pixels_is_in_the_series_and_in_the_certificate(
    bright_slice: str, printed: Printer
) -> None:
    assert main(["info", bright_slice, "--pixels", "--json"]) == 0
    facts = printed().report()
    assert facts["series"][0]["warnings"] == facts["certificate"]["warnings"]
    assert CEILING_WARNING in facts["certificate"]["warnings"][-1]


@pytest.fixture
def table_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The lines on a folder of the CT of 31 x 25 voxels, a smaller one, and three series of MR."""
    folder = write_series(tmp_path / "ct", sphere_voxels((17, 25, 31)), number=1)
    write_series(folder, np.full((6, 9, 9), -1000, np.int16), number=2)
    for number in (3, 4, 6):
        write_series(folder, np.full((3, 9, 9), 5, np.int16), number=number, modality="MR")
    assert main(["info", str(folder)]) == 0
    return capsys.readouterr().out.splitlines()


def test_table_of_series_marks_the_largest_ct_and_has_its_shape_and_spacing(table_rows: list[str]) -> None:
    assert table_rows[0].split()[:4] == ["series", "hash", "kind", "slices"]
    assert table_rows[2].split()[:2] == ["*", "1"] and table_rows[3].split()[0] == "2"
    assert "31 x 25" in table_rows[2] and "0.8 x 1.1 x 1.5" in table_rows[2]


def test_info_lists_series_that_are_not_read_and_describes_the_chosen_one(table_rows: list[str]) -> None:
    assert "series 3-5: not read: modality MR is not CT" in table_rows  # places in the list
    assert "series 1, as clrecon mesh would read it" in table_rows
    assert any(re.fullmatch(r"  slices +17 used, none dropped", row) for row in table_rows)


@pytest.fixture
def equal_series(tmp_path: Path) -> str:
    """A folder with the series 1 and 2 of one size."""
    folder = write_series(tmp_path / "ct", number=1)
    return str(write_series(folder, number=2))


def test_of_two_equal_series_none_is_chosen_and_the_option_that_chooses_is_named(
    equal_series: str, printed: Printer
) -> None:
    assert main(["info", equal_series, "--json"]) == 0
    said = printed()
    facts = said.report()
    assert (facts["chosen"], facts["certificate"]) == (None, None)
    said.assert_error("--series")


def test_one_of_two_equal_series_is_chosen_by_its_number(equal_series: str, printed: Printer) -> None:
    assert main(["info", equal_series, "--series", "2", "--json"]) == 0
    facts = printed().report()
    assert facts["chosen"] == facts["certificate"]["series"]["number"] == 2


def test_one_of_two_equal_series_is_chosen_by_its_hash(equal_series: str, printed: Printer) -> None:
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


def test_strict_info_of_a_series_that_passes_its_gates_ends_with_0_and_counts_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_plan(tmp_path)
    assert main(["info", str(tmp_path), "--strict"]) == 0
    unmeasured = (
        "stated_gap, stated_places, one_volume, hu_scale, stored_sign, shown_places, padding_share, stored_bits"
    )
    assert re.search(rf"gates +\d+ kept, 0 failed, not measured: {unmeasured}", capsys.readouterr().out)


@pytest.fixture
def lossy(tmp_path: Path) -> str:
    """Seven slices of lossy compression whose values are of no known unit: two gates fail."""
    write_plan(tmp_path, Plan(shape=(7, 5, 6)), set_values(LossyImageCompression="01", RescaleType="US"))
    return str(tmp_path)


def test_info_of_a_series_that_fails_gates_ends_with_0_without_strict(lossy: str) -> None:
    assert main(["info", lossy]) == 0


def test_strict_info_ends_with_4_and_the_gates_that_failed(lossy: str, capsys: pytest.CaptureFixture[str]) -> None:
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


def test_info_of_a_refused_series_prints_its_certificate_and_ends_with_4(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_plan(tmp_path / "hole", Plan(shape=(9, 5, 6), leave_out=(4,)))
    assert main(["info", str(tmp_path / "hole")]) == 4
    captured = capsys.readouterr()
    assert "series 1, refused" in captured.out
    assert "each slice has its own place" not in captured.out and "--pixels reads it" not in captured.out
    assert "FAILED     missing_slices: slices missing in between: 1, none allowed" in captured.out
    assert "series 1 cannot be used: 1 slice missing" in captured.err


def test_quiet_info_prints_nothing(ct: Path, printed: Printer) -> None:
    assert main(["info", str(ct), "-q"]) == 0
    assert printed().is_silent


def test_listing_for_a_file_is_plain_text_in_lines_of_any_length(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("FORCE_COLOR", "1")
    long, word = "long " * 60, "word " * 60

    lines = render_listing(make_listing(make_entry(1, description=long, warnings=[word])), [])

    assert not ANSI.search("".join(lines))
    assert any(long.strip() in line for line in lines)
    assert any(word.strip() in line for line in lines)


def test_info_into_a_file_has_no_colours_and_leaves_no_column_out(
    ct: Path, printed: Printer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("FORCE_COLOR", "1")

    assert main(["info", str(ct)]) == 0

    text = printed().everything
    assert not ANSI.search(text)
    assert "left out" not in text


WORDS_OF_A_LISTING = ("LUMBAR", "SPINE", "0.9766 x 0.9766 x 4.25", "512 x 512", "gantry")


@pytest.fixture
def long_listing() -> dict[str, Any]:
    """Two series with the words of `WORDS_OF_A_LISTING`."""
    return make_listing(
        make_entry(1, description="LUMBAR SPINE 0.8 BONE"), make_entry(12, warnings=["gantry tilt " * 9], tilt_deg=12.5)
    )


@pytest.mark.parametrize("columns", [200, 120, 80, 60, 30])
def test_lines_of_a_listing_fit_a_terminal_and_keep_its_words(
    columns: int, terminal: Any, long_listing: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal(columns)
    monkeypatch.setenv("NO_COLOR", "1")

    lines = render_listing(long_listing, describe_certificate(None))

    assert not ANSI.search("".join(lines))
    assert max(map(len, lines)) <= columns
    text = " ".join(" ".join(lines).split())
    assert [word for word in WORDS_OF_A_LISTING if word not in text] == []


@pytest.mark.parametrize(
    ("columns", "has_tilt", "says_left_out"),
    [(200, True, False), (120, True, True), (80, False, True), (60, False, False), (30, False, False)],
)
def test_listing_for_a_terminal_leaves_columns_out_and_says_so_where_it_is_a_table(
    columns: int, has_tilt: bool, says_left_out: bool, terminal: Any, long_listing: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    """Below 80 columns it is no table, and nothing is left out."""
    terminal(columns)
    monkeypatch.setenv("NO_COLOR", "1")

    lines = render_listing(long_listing, describe_certificate(None))

    assert ("tilt" in lines[0]) == has_tilt
    assert ("left out: a wider window" in " ".join(" ".join(lines).split())) == says_left_out


def test_listing_shows_a_tilt_from_a_hundredth_of_a_degree_on(terminal: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    terminal(200)
    monkeypatch.setenv("NO_COLOR", "1")
    entries = [make_entry(number, tilt_deg=tilt) for number, tilt in enumerate((0.04, 0.004), 1)]

    lines = render_listing(make_listing(*entries), describe_certificate(None))

    assert [word for line in lines[1:] for word in line.split() if word in ("+0.04", "+0.00")] == ["+0.04"]


@pytest.mark.parametrize(("columns", "is_coloured"), [(200, True), (80, True), (60, False), (30, False)])
def test_listing_for_a_terminal_is_coloured_where_it_is_a_table(
    columns: int, is_coloured: bool, terminal: Any, long_listing: dict[str, Any]
) -> None:
    terminal(columns)
    lines = render_listing(long_listing, describe_certificate(None))
    assert any(ANSI.search(line) for line in lines) == is_coloured


def test_markup_and_control_characters_of_a_description_are_shown_as_text(terminal: Any) -> None:
    hostile = "[bold red]x[/] :smile: \x1b[31mred\x07\u202e"
    (_, _, row, *_) = render_listing(make_listing(make_entry(1, description=hostile, modality="[i]")), [])
    assert "[bold red]x[/] :smile: \\x1b[31mred\\x07\\u202e" in row and "[i]" in row
    terminal(200)
    shown = "".join(render_listing(make_listing(make_entry(1, description=hostile, problems=[hostile])), []))
    assert "\x1b[31mred" not in shown and "\x07" not in shown and "\u202e" not in shown


def test_listing_for_ascii_has_ascii_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert "\n".join(render_listing(make_listing(make_entry(1)), [])).isascii()


def test_listing_of_several_patients_has_their_numbers_and_those_of_studies() -> None:
    entries = [
        make_entry(1),
        make_entry(2, study=3, phases=[{"number": 1}, {"number": 2}]),
        make_entry(3, patient=28, study=2),
        make_entry(4, patient=28, study=2, modality="SEG", kind="other"),
        make_entry(5, patient=None, study=None),
    ]
    lines = render_listing(make_listing(*entries), [])
    assert lines[0].split()[:3] == ["series", "patient", "study"] and "phases" in lines[0]
    rows = [line.removeprefix("*").split()[:3] for line in lines if re.match(r"[* ] +\d", line)]
    assert rows == [["1", "1", "1"], ["2", "1", "3"], ["3", "28", "2"], ["4", "28", "2"], ["5", "-", "-"]]
    assert [number for number, line in enumerate(lines) if not line] == [4, 7]  # a patient ends there


def test_description_of_wide_characters_is_folded_to_their_width(terminal: Any) -> None:
    terminal(100)
    lines = render_listing(make_listing(make_entry(1, description="\u810a\u67f1" * 30), chosen=None), [])
    folded = [line.rpartition(" ")[2] for line in lines if "\u810a" in line]
    assert "".join(folded) == "\u810a\u67f1" * 30
    columns = [len(line) + line.count("\u810a") + line.count("\u67f1") for line in lines if "\u810a" in line]
    assert len(folded) > 1 and max(columns) in (99, 100)  # each takes two


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.untraced
def test_two_thousand_series_take_a_line_each_and_one_for_their_common_problem() -> None:
    entries = [make_entry(number, modality="MR", problems=["modality MR is not CT"]) for number in range(1, 2001)]
    lines = render_listing(make_listing(*entries, chosen=None), [])
    assert len(lines) == 2 + 2000 + 1
    assert lines[-1] == "series 1-2000: problem: modality MR is not CT"


def test_certificate_is_described_in_words(tmp_path: Path) -> None:
    plan = Plan(shape=(7, 5, 6), pixel_spacing=(0.7, 0.5), gap=1.25, tilt_deg=12, angles=(3, 4, -5))
    write_plan(tmp_path, plan, set_values(PatientPosition="FFP", SliceThickness=5))
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
        "values": "-124 to 145 HU; slope 1, intercept -1024",  # stored are 900 to 900 + 6 * 40 + 29
        "stored": "Explicit VR Little Endian",
        "gates": "17 kept, 0 failed, not measured: stated_gap, stated_places, one_volume, hu_scale, shown_places",
    }.items() <= words.items()


def test_certificate_of_uneven_slices_describes_each_gap(tmp_path: Path) -> None:
    plan = Plan(shape=(7, 5, 6), gap=1.25, offsets={3: 0.4})  # one of 7 slices is 0.4 mm too high
    write_plan(tmp_path, plan, set_values(SliceThickness=1))
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
    assert len(comments) > 1 and [line for line in comments if line not in written] == []


@pytest.mark.release
def test_strict_mesh_of_a_scan_that_passes_its_gates_is_written_with_their_number(tmp_path: Path, device: Any) -> None:
    folder = write_series(tmp_path / "ct")
    arguments = ["mesh", str(folder), "-o", str(tmp_path / "a.ply"), "--hu", "100", "--device", str(device.index)]
    assert main([*arguments, "--strict"]) == 0
    passed = sum(gate["ok"] is True for gate in read_volume(folder).report["gates"])
    assert f"comment CERTIFICATE gates {passed} passed 0 failed".encode() in (tmp_path / "a.ply").read_bytes()


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


def test_strict_mesh_of_a_scan_that_fails_a_gate_ends_with_7_and_the_gate(
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


def test_strict_mesh_of_unevenly_spaced_slices_is_written_which_strict_info_refuses(
    tmp_path: Path, device: Any, printed: Printer
) -> None:
    import pydicom

    folder = write_series(tmp_path / "ct")
    for path in folder.iterdir():
        ds = pydicom.dcmread(path)
        if ds.InstanceNumber > 9:
            ds.ImagePositionPatient[2] += 0.3  # mm: the gap after slice 9 is wider
            ds.save_as(path)
    arguments = ["mesh", str(folder), "-o", str(tmp_path / "a.ply"), "--hu", "100", "--device", str(device.index)]
    assert main([*arguments, "--strict", "--json"]) == 0
    report = printed().report()
    said = report["volume"]
    assert said["uneven"] and [gate["name"] for gate in said["gates"] if gate["ok"] is False] == ["grid_residual"]
    assert any("unevenly spaced" in text for text in report["warnings"])
    assert main(["info", str(folder), "--strict"]) == 4
