"""The export command: masks, crop and steps, and what other programs find in the file."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import dicom_series
import numpy as np
import pytest
from printed_text import Printer

from clrecon import read_volume
from clrecon.cli.main import main
from clrecon.jobs.export import export_volume
from clrecon.jobs.settings import ExportSettings

sitk = pytest.importorskip("SimpleITK")
nibabel = pytest.importorskip("nibabel")
pytest.importorskip("nrrd")

pytestmark = pytest.mark.first_device

NAME = "Geheimnis^Jolanthe"


def series(folder: Path, **plan: object) -> Path:
    plan = {"shape": (12, 20, 24), "gap": 1.25, **plan}
    dicom_series.write_series(folder / "ct", dicom_series.Plan(**plan), lambda ds, k: setattr(ds, "PatientName", NAME))
    return folder / "ct"


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_exported_crop_lies_in_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = series(tmp_path, angles=(10, -20, 35))
    volume = read_volume(scan)
    x, y, z = volume.ijk_to_lps([(12, 10, 6)])[0]
    words = ["export", scan, "-o", tmp_path / "a.nii.gz", "--around", f"{x},{y},{z},3", "--report", tmp_path / "a.json"]
    assert run(*words) == 0
    out, err = capsys.readouterr()
    assert "cropped to x" in err and "voxels stay" in err
    assert all(line[:9].strip() in ("volume", "place", "time", "wrote", "report") for line in out.splitlines())
    report = json.loads((tmp_path / "a.json").read_text())
    image = sitk.ReadImage(str(tmp_path / "a.nii.gz"))
    assert list(image.GetSize()) == report["output"]["shape_ijk"] == report["volume"]["shape_ijk"]
    found = sitk.GetArrayFromImage(image)
    first = np.array(report["volume"]["crop"]["first_ijk"])
    i, j, k = first
    nk, nj, ni = found.shape
    assert found.size < volume.voxels.size / 2
    assert np.array_equal(found, volume.voxels[k : k + nk, j : j + nj, i : i + ni])
    place = image.TransformIndexToPhysicalPoint([1, 2, 3])
    assert np.allclose(place, volume.ijk_to_lps([first + (1, 2, 3)])[0], atol=1e-4)
    assert report["output"]["space"] == "ras" and report["output"]["type"] == "int16" and report["device"] is None


def test_exported_files_hold_no_patient_data(tmp_path: Path) -> None:
    scan = series(tmp_path)
    assert run("export", scan, "-o", tmp_path / "a.nii.gz", "--report", tmp_path / "a.json") == 0
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["volume"]["gates"] and report["volume"]["series"]["uid_hash"] is None
    for content in (gzip.decompress((tmp_path / "a.nii.gz").read_bytes()), (tmp_path / "a.json").read_bytes()):
        assert b"Geheimnis" not in content


def test_outside_of_a_region_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = series(tmp_path)
    volume = read_volume(scan)
    middle = float(np.median(volume.voxels))
    assert run("export", scan, "-o", tmp_path / "a.nrrd", "--region", f"hu:{middle},") == 0
    out, err = capsys.readouterr()
    assert "region   what lies outside has -1024 HU" in out and "outside of the region" in err
    found = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "a.nrrd")))
    assert np.array_equal(found, np.where(volume.voxels >= middle, volume.voxels, -1024))


@pytest.fixture
def tilted(tmp_path: Path) -> Path:
    """A scan with a gantry tilt of 12 degrees."""
    return series(tmp_path, tilt_deg=12.0)


def test_tilted_scan_is_refused_by_a_format_without_shear(
    tilted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("export", tilted, "-o", tmp_path / "a.mha") == 3
    assert "sheared by 12.00 degrees (.nii.gz and .nrrd hold that)" in (said := capsys.readouterr().err)
    assert "--resample MM" in said and not (tmp_path / "a.mha").exists()


def test_tilt_is_kept_in_nifti_with_a_warning(tilted: Path, tmp_path: Path, printed: Printer) -> None:
    assert run("export", tilted, "-o", tmp_path / "a.nii") == 0
    printed().assert_error("sheared", "NIfTI")
    assert np.allclose(nibabel.load(tmp_path / "a.nii").affine[:2] * -1, read_volume(tilted).affine[:2], atol=1e-4)


def test_tilt_is_resampled_when_asked(tilted: Path, tmp_path: Path) -> None:
    assert run("export", tilted, "-o", tmp_path / "a.mha", "--resample", "0.7") == 0
    image = sitk.ReadImage(str(tmp_path / "a.mha"))
    assert np.allclose(image.GetSpacing(), 0.7)
    assert np.allclose(image.GetDirection(), np.round(image.GetDirection()))


def test_wrong_calls_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = series(tmp_path)
    cases = {
        ("-o", "a.stl"): "one of .nii.gz, .nii, .nrrd, .mha",
        ("-o", "a.nii", "--resample", "0"): "at least 0.01 mm, not 0",
        ("-o", "a.nii", "--resample", "1mm"): "'1mm' is no number: write the length in mm",
        ("-o", "a.nii", "--resample", "nan"): "at least 0.01 mm, not nan",
        ("-o", "a.nii", "--space", "mni"): "unknown space 'mni'",
        ("-o", "a.nii", "--report", "a.nii"): "same file",
    }
    for words, line in cases.items():
        named = [tmp_path / word if word.startswith("a.") else word for word in words]
        assert run("export", scan, *named) == 3, words
        said = capsys.readouterr().err
        assert line in said and len(said.strip().splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["ct"]


def test_export_replaces_no_file_with_no_clobber(tmp_path: Path) -> None:
    scan = series(tmp_path)
    (tmp_path / "a.nii").write_bytes(b"older")
    assert run("export", scan, "-o", tmp_path / "a.nii", "--no-clobber") == 6
    assert (tmp_path / "a.nii").read_bytes() == b"older"
    assert run("export", scan, "-o", tmp_path / "a.nii") == 0


def test_export_from_python_resamples_and_reports_progress(tmp_path: Path) -> None:
    scan = series(tmp_path)
    seen = []
    settings = ExportSettings(between=(-1e9, 1e9), resample=2.0)
    report = export_volume(scan, tmp_path / "a.mha", settings, progress=lambda *told: seen.append(told[0]))
    assert report.volume["resampled"]["step_mm"] == 2.0 and {"read", "resample", "write"} <= set(seen)
    back = read_volume(tmp_path / "a.mha")
    assert np.allclose(back.affine, report.output["affine_ijk_to_lps_mm"], atol=1e-6)
