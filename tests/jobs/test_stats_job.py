"""``clrecon stats``: table, JSON and CSV, wide and narrow, and wrong usage."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
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
    voxels = np.zeros((6, 8, 8), np.int16)
    voxels[2:4] = 100
    voxels[3:5, 2:4] += 7
    labels = np.zeros(voxels.shape, np.uint8)
    labels[2:4, 1:5, 1:5] = 2
    labels[4:5] = 5
    scan = write_nifti(tmp_path / "ct.nii", voxels, AFFINE)
    own = (
        b'<?xml version="1.0"?> <CaretExtension><VolumeInformation Index="0"><LabelTable>'
        b'<Label Key="2"><![CDATA[a very long name of a structure in the belly]]></Label>'
        b"</LabelTable></VolumeInformation>"
    )
    return {"ct": str(scan), "labels": str(write_nifti(tmp_path / "l.nii", labels, AFFINE, extension=own))}


def test_table_json_and_csv_say_the_same(files: dict[str, str], tmp_path: Path, capsys: Any) -> None:
    out, table = tmp_path / "out.json", tmp_path / "out.csv"
    given = ["stats", files["ct"], "--labels", files["labels"], "--percentiles", "50,2.5"]
    assert main([*given, "--report", str(out), "--csv", str(table)]) == 0
    shown = capsys.readouterr().out
    report = json.loads(out.read_text())
    one, other = report["labels"]
    assert report["percentiles"] == [2.5, 50.0] and report["resampled"] is False
    assert (one["number"], one["voxels"], other["name"]) == (2, 32, "label_5")
    assert one["ml"] == pytest.approx(32 * 0.01) and one["mean_hu"] == pytest.approx((24 * 100 + 8 * 107) / 32)
    assert one["percentiles_hu"] == {"2.5": 100.0, "50": 100.0}
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["name"] for row in rows] == [one["name"], "label_5"]
    assert float(rows[0]["mean_hu"]) == pytest.approx(one["mean_hu"])
    assert float(rows[1]["p50_hu"]) == other["percentiles_hu"]["50"]
    (line,) = (line for line in shown.splitlines() if line.startswith("a very long"))
    assert line.split()[-7:] == ["0.32", "101.8", "3.0", "100", "100", "100", "107"]
    assert "peak_memory_bytes" in report and report["volume"]["series"]["uid_hash"] is None


def test_stats_of_one_label_are_printed_as_json(files: dict[str, str], printed: Printer) -> None:
    assert main(["stats", files["ct"], "--labels", files["labels"], "--label", "5", "--json"]) == 0
    (one,) = printed().report()["labels"]
    assert one["number"] == 5


def test_a_narrow_window_gets_two_tables(files: dict[str, str], printed: Printer) -> None:
    assert main(["stats", files["ct"], "--labels", files["labels"], "--json"]) == 0
    report = printed().report()
    wide, narrow = _lay_out(report, None), _lay_out(report, 60)
    assert len(wide) == 3 and max(map(len, wide)) > 60
    assert len(narrow) == 7 and max(map(len, narrow)) <= 60
    assert narrow[1].startswith("a very long name") and "..." in narrow[5] and narrow[5].split()[-1] == "107"
    assert _lay_out(report, 200) == wide


@pytest.mark.parametrize(
    ("extra", "code", "fact"),
    [
        ([], 3, "--labels"),
        (["--labels", "LABELS", "--label", "spleen"], 3, "spleen"),
        (["--labels", "no.nii"], 3, "no.nii"),
        (["--labels", "LABELS", "--percentiles", "5;50"], 3, "5,50,95"),
        (["--labels", "LABELS", "--hu", "300"], 3, "--surface"),
        (["--labels", "LABELS", "--surface", "mask"], 3, "cortex"),
        (["--labels", "LABELS", "--percentiles", "500"], 3, 100),
        (["--labels", "LABELS", "--csv", "a.json", "--report", "a.json"], 3, "a.json"),
        (["--labels", "LABELS", "--csv", "no/a.csv"], 6, "no"),
        (["--labels", "LABELS", "--report", "LABELS"], 3, "report"),
    ],
)
def test_wrong_usage_is_one_line_and_writes_nothing(
    extra: list[str], code: int, fact: str | int, files: dict[str, str], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, printed: Printer,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    given = [files["labels"] if word == "LABELS" else word for word in extra]
    check_refused(["stats", files["ct"], *given], code, fact, tmp_path, printed)


def test_existing_table_of_stats_stays_with_no_clobber(files: dict[str, str], tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "a.csv").write_text("mine")
    given = ["stats", files["ct"], "--labels", files["labels"], "--csv", str(tmp_path / "a.csv")]
    assert main([*given, "--no-clobber"]) == 6
    printed().assert_error("a.csv")
    assert (tmp_path / "a.csv").read_text() == "mine"
    assert main(given) == 0
    assert (tmp_path / "a.csv").read_text().startswith("number,name,voxels,ml")


@pytest.fixture(scope="module")
def shells(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Two shells of bone, radius 13 and 9 mm, 2 and 3 mm thick, blurred by 0.7 mm, with marrow; and a dim label."""
    k, j, i = np.indices((36, 36, 60))
    values, labels = np.full(k.shape, 50.0), np.zeros(k.shape, np.uint8)
    for number, (x, radius, thickness) in enumerate(((18.3, 13.0, 2.0), (45.2, 9.0, 3.0)), start=1):
        far = np.sqrt((i - x) ** 2 + (j - 17.6) ** 2 + (k - 18.1) ** 2)
        outer, inner = ndtr((far - radius) / 0.7), ndtr((radius - thickness - far) / 0.7)
        values += 950.0 * (1.0 - outer - inner) + 150.0 * inner
        labels[far < radius] = number
    labels[2:5, 2:5, 2:5] = 3
    folder, grid = tmp_path_factory.mktemp("shells"), np.diag([1.0, 1.0, 1.0, 1.0])
    scan = write_nifti(folder / "ct.nii", np.rint(values).astype(np.int16), grid)
    return {"ct": str(scan), "labels": str(write_nifti(folder / "l.nii", labels, grid))}


def test_the_surface_of_each_label_has_the_area_volume_and_walls_of_the_bone(
    shells: dict[str, str], tmp_path: Path, printed: Printer, device: Any
) -> None:
    table = tmp_path / "walls.csv"
    given = ["stats", shells["ct"], "--labels", shells["labels"], "--device", str(device.index)]
    assert main([*given, "--surface", "hu", "--json"]) == 0
    at_level = printed().report()["labels"]
    assert main([*given, "--surface", "cortex", "--csv", str(table)]) == 0
    shown = printed()
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row, level, radius, thickness in zip(rows, at_level, (13.0, 9.0), (2.0, 3.0), strict=False):
        ml, area = 4.0 / 3.0 * np.pi * radius**3 / 1000.0, 4.0 * np.pi * radius**2
        assert level["surface"]["ml"] > 1.09 * ml and level["surface"]["cortex"] is None  # what a level costs
        assert float(row["surface_ml"]) == pytest.approx(ml, rel=0.025)
        assert float(row["surface_area_mm2"]) == pytest.approx(area, rel=0.03)
        assert float(row["surface_thickness_p50_mm"]) == pytest.approx(thickness, abs=0.3)
        assert float(row["surface_fitted"]) > 0.9 and 0.0 < float(row["surface_error_p50_mm"]) < 0.2
    assert rows[2]["surface_ml"] == "" and at_level[2]["surface"]["ml"] is None
    shown.assert_output(200, "label_3")
