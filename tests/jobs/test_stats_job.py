"""``clrecon stats``: table, JSON and CSV, wide and narrow, and wrong usage."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from command_lines import check_refused
from label_files import write_nifti
from printed_text import Printer
from scipy.special import ndtr

from clrecon.cli.main import main
from clrecon.cli.stats import _lay_out

pytest.importorskip("nibabel")

AFFINE = np.array([[2.0, 0, 0, -10.0], [0, 2.0, 0, -12.0], [0, 0, 2.5, -84.0], [0, 0, 0, 1.0]])


@pytest.fixture
def files(tmp_path: Path) -> dict[str, str]:
    """A scan of 8 x 8 x 6 voxels of 0.01 ml, and its labels: 2, with a long name, and 5, without one."""
    voxels = np.zeros((6, 8, 8), np.int16)
    voxels[2:4] = 100
    voxels[3:5, 2:4] += 7
    labels = np.zeros(voxels.shape, np.uint8)
    labels[2:4, 1:5, 1:5] = 2  # 24 voxels of 100 HU and 8 of 107
    labels[4:5] = 5  # a slice: 16 voxels of 7 HU and 48 of 0
    scan = write_nifti(tmp_path / "ct.nii", voxels, AFFINE)
    own = (
        b'<?xml version="1.0"?> <CaretExtension><VolumeInformation Index="0"><LabelTable>'
        b'<Label Key="2"><![CDATA[a very long name of a structure in the belly]]></Label>'
        b"</LabelTable></VolumeInformation>"
    )
    return {"ct": str(scan), "labels": str(write_nifti(tmp_path / "l.nii", labels, AFFINE, extension=own))}


@pytest.fixture
def stats_command(files: dict[str, str]) -> list[str]:
    """The command for the statistics of both labels."""
    return ["stats", files["ct"], "--labels", files["labels"]]


def test_report_of_stats_has_volume_mean_and_percentiles_of_each_label(
    stats_command: list[str], printed: Printer
) -> None:
    assert main([*stats_command, "--percentiles", "50,2.5", "--json"]) == 0

    report = printed().report()
    named, unnamed = report["labels"]
    assert (named["number"], named["voxels"], unnamed["name"]) == (2, 32, "label_5")
    assert named["ml"] == pytest.approx(32 * 0.01)
    assert named["mean_hu"] == pytest.approx((24 * 100 + 8 * 107) / 32)
    assert unnamed["ml"] == pytest.approx(64 * 0.01)
    assert unnamed["mean_hu"] == pytest.approx((16 * 7 + 48 * 0) / 64)
    assert report["percentiles"] == [2.5, 50.0]
    assert named["percentiles_hu"] == {"2.5": 100.0, "50": 100.0}
    assert unnamed["percentiles_hu"] == {"2.5": 0.0, "50": 0.0}


def test_report_of_stats_has_the_peak_of_memory_and_whether_labels_were_resampled(
    stats_command: list[str], printed: Printer
) -> None:
    assert main([*stats_command, "--json"]) == 0

    report = printed().report()
    assert report["resampled"] is False  # the labels have the grid of the scan
    assert report["peak_memory_bytes"] > 0


def test_report_of_stats_has_no_hash_of_a_series_for_a_nifti_file(stats_command: list[str], printed: Printer) -> None:
    assert main([*stats_command, "--json"]) == 0

    assert printed().report()["volume"]["series"]["uid_hash"] is None


def test_csv_of_stats_has_the_figures_of_the_report(stats_command: list[str], tmp_path: Path, printed: Printer) -> None:
    table = tmp_path / "out.csv"

    assert main([*stats_command, "--percentiles", "50,2.5", "--json", "--csv", str(table)]) == 0

    named, unnamed = printed().report()["labels"]
    with table.open(newline="") as stream:
        first, second = csv.DictReader(stream)
    assert (first["name"], second["name"]) == (named["name"], unnamed["name"])
    assert float(first["mean_hu"]) == pytest.approx(named["mean_hu"])
    assert float(second["p50_hu"]) == unnamed["percentiles_hu"]["50"]


def test_printed_table_of_stats_has_volume_mean_deviation_and_percentiles_of_a_label(
    stats_command: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*stats_command, "--percentiles", "50,2.5"]) == 0

    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("a very long"))
    ml, mean, deviation, smallest, low, median, largest = line.split()[-7:]
    values = np.repeat([100, 107], [24, 8])
    assert (ml, mean, deviation) == ("0.32", f"{values.mean():.1f}", f"{values.std():.1f}")
    assert (smallest, low, median, largest) == ("100", "100", "100", "107")


def test_stats_of_a_chosen_label_are_of_it_alone(stats_command: list[str], printed: Printer) -> None:
    assert main([*stats_command, "--label", "5", "--json"]) == 0
    assert [label["number"] for label in printed().report()["labels"]] == [5]


@pytest.fixture
def stats_report(stats_command: list[str], printed: Printer) -> Any:
    """The report of the command for both labels."""
    assert main([*stats_command, "--json"]) == 0
    return printed().report()


@pytest.mark.parametrize("columns", [None, 200], ids=["no terminal", "a wide terminal"])
def test_table_of_stats_is_one_with_a_line_for_each_label(columns: int | None, stats_report: Any) -> None:
    heading, named, unnamed = _lay_out(stats_report, width=columns)

    assert heading.split()[0] == "label"
    assert named.startswith("a very long name of a structure in the belly")
    assert unnamed.startswith("label_5")


def test_table_of_stats_is_split_into_two_in_a_narrow_terminal(stats_report: Any) -> None:
    lines = _lay_out(stats_report, width=60)

    assert max(map(len, lines)) <= 60
    _, named, _, empty, _, named_again, _ = lines  # headings, and the label without a name in both tables
    assert empty == ""
    assert named.startswith("a very long name")
    assert "..." in named_again
    assert named_again.split()[-1] == "107"  # the last column: the largest HU


@pytest.mark.parametrize(
    ("extra", "code", "fact"),
    [
        pytest.param([], 3, "--labels", id="no label map"),
        pytest.param(["--labels", "LABELS", "--label", "spleen"], 3, "spleen", id="label not in the map"),
        pytest.param(["--labels", "no.nii"], 3, "no.nii", id="missing label map"),
        pytest.param(["--labels", "LABELS", "--percentiles", "5;50"], 3, "5,50,95", id="semicolon"),
        pytest.param(["--labels", "LABELS", "--hu", "300"], 3, "--surface", id="iso value without surface"),
        pytest.param(["--labels", "LABELS", "--surface", "mask"], 3, "cortex", id="surface of the mask"),
        pytest.param(["--labels", "LABELS", "--percentiles", "500"], 3, 100, id="percentile above 100"),
        pytest.param(["--labels", "LABELS", "--csv", "a.json", "--report", "a.json"], 3, "a.json", id="one file twice"),
        pytest.param(["--labels", "LABELS", "--csv", "no/a.csv"], 6, "no", id="missing folder"),
        pytest.param(["--labels", "LABELS", "--report", "LABELS"], 3, "report", id="report over the label map"),
    ],
)
def test_wrong_usage_of_stats_is_refused_in_one_line_and_writes_nothing(
    extra: list[str], code: int, fact: str | int, files: dict[str, str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, printed: Printer,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    given = [files["labels"] if word == "LABELS" else word for word in extra]
    check_refused(["stats", files["ct"], *given], code, fact, tmp_path, printed)


def test_existing_table_of_stats_stays_with_no_clobber(
    stats_command: list[str], tmp_path: Path, printed: Printer
) -> None:
    table = tmp_path / "a.csv"
    table.write_text("mine")

    assert main([*stats_command, "--csv", str(table), "--no-clobber"]) == 6

    printed().assert_error("a.csv")
    assert table.read_text() == "mine"


def test_existing_table_of_stats_is_replaced_without_no_clobber(stats_command: list[str], tmp_path: Path) -> None:
    table = tmp_path / "a.csv"
    table.write_text("mine")

    assert main([*stats_command, "--csv", str(table)]) == 0

    assert table.read_text().startswith("number,name,voxels,ml")


SHELLS_MM = ((13.0, 2.0), (9.0, 3.0))
"""Radius and thickness of the wall."""


@pytest.fixture(scope="module")
def shells(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A scan of two spherical shells of bone with marrow, blurred by 0.7 mm, and labels: 1 and 2 of the shells, and 3,
    a cube of 3 x 3 x 3 voxels of soft tissue."""
    k, j, i = np.indices((36, 36, 60))
    values, labels = np.full(k.shape, 50.0), np.zeros(k.shape, np.uint8)
    for number, x, (radius, thickness) in zip((1, 2), (18.3, 45.2), SHELLS_MM, strict=True):
        far = np.sqrt((i - x) ** 2 + (j - 17.6) ** 2 + (k - 18.1) ** 2)
        outer, inner = ndtr((far - radius) / 0.7), ndtr((radius - thickness - far) / 0.7)
        values += 950.0 * (1.0 - outer - inner) + 150.0 * inner
        labels[far < radius] = number
    labels[2:5, 2:5, 2:5] = 3
    folder, grid = tmp_path_factory.mktemp("shells"), np.diag([1.0, 1.0, 1.0, 1.0])
    scan = write_nifti(folder / "ct.nii", np.rint(values).astype(np.int16), grid)
    return {"ct": str(scan), "labels": str(write_nifti(folder / "l.nii", labels, grid))}


@pytest.fixture(scope="module")
def shell_rows(shells: dict[str, str], device: Any, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, str]]:
    """Rows of the CSV of the labels of `shells`, with the surfaces fitted to their cortex."""
    table = tmp_path_factory.mktemp("walls") / "walls.csv"
    command = ["stats", shells["ct"], "--labels", shells["labels"], "--device", str(device.index)]
    assert main([*command, "--surface", "cortex", "--csv", str(table), "-q"]) == 0
    with table.open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("shell", [0, 1], ids=["large", "small"])
def test_surface_fitted_to_the_cortex_of_a_label_has_the_volume_area_and_wall_of_its_shell(
    shell: int, shell_rows: list[dict[str, str]]
) -> None:
    row, (radius, thickness) = shell_rows[shell], SHELLS_MM[shell]

    volume_ml, area_mm2 = 4 / 3 * np.pi * radius**3 / 1000, 4 * np.pi * radius**2
    assert float(row["surface_ml"]) == pytest.approx(volume_ml, rel=tolerances.CORTEX_SHELL_VOLUME)
    assert float(row["surface_area_mm2"]) == pytest.approx(area_mm2, rel=tolerances.CORTEX_SHELL_AREA)
    assert float(row["surface_thickness_p50_mm"]) == pytest.approx(thickness, abs=tolerances.CORTEX_SHELL_WALL_MM)


@pytest.mark.parametrize("shell", [0, 1], ids=["large", "small"])
def test_surface_fitted_to_the_cortex_of_a_label_states_where_it_was_fitted_and_its_error(
    shell: int, shell_rows: list[dict[str, str]]
) -> None:
    row = shell_rows[shell]

    assert float(row["surface_fitted"]) > 0.9  # all of a shell is cortex; 1 would be every vertex
    assert 0.0 < float(row["surface_error_p50_mm"]) < 0.2  # a fifth of a voxel


def test_surface_of_a_label_at_the_iso_value_encloses_more_than_its_shell(
    shells: dict[str, str], printed: Printer, device: Any
) -> None:
    command = ["stats", shells["ct"], "--labels", shells["labels"], "--device", str(device.index)]

    assert main([*command, "--surface", "hu", "--json"]) == 0

    *of_shells, _ = printed().report()["labels"]
    for label, (radius, _) in zip(of_shells, SHELLS_MM, strict=True):
        # 200 HU lies in the blurred edge from 50 to 1000 HU outside of its middle: measured 1.19 and 1.27
        assert label["surface"]["ml"] > 1.09 * 4 / 3 * np.pi * radius**3 / 1000
        assert label["surface"]["cortex"] is None


def test_label_below_the_iso_value_has_no_surface_and_is_named_with_it(
    shells: dict[str, str], tmp_path: Path, printed: Printer, device: Any
) -> None:
    command = ["stats", shells["ct"], "--labels", shells["labels"], "--device", str(device.index)]

    assert main([*command, "--surface", "hu", "--label", "3", "--report", str(tmp_path / "r.json")]) == 0

    (label,) = json.loads((tmp_path / "r.json").read_text())["labels"]
    assert label["surface"]["ml"] is None
    printed().assert_output(200, "label_3")
