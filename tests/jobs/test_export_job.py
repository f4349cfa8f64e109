"""The export command: masks, crop and steps, and what other programs find in the file."""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dicom_series
import numpy as np
import pytest
import tolerances
from printed_text import Printer

from clrecon import Volume, read_volume
from clrecon.cli.main import main
from clrecon.jobs.export import export_volume
from clrecon.jobs.settings import ExportSettings

sitk = pytest.importorskip("SimpleITK")
nibabel = pytest.importorskip("nibabel")
pytest.importorskip("nrrd")

pytestmark = pytest.mark.first_device

NAME = "Geheimnis^Jolanthe"


SHAPE_KJI = (12, 20, 24)


def write_ct(folder: Path, **plan: object) -> Path:
    """Write a CT of SHAPE_KJI with the name of a patient into `folder`; return where it is."""
    plan = {"shape": SHAPE_KJI, "gap": 1.25, **plan}
    dicom_series.write_series(folder / "ct", dicom_series.Plan(**plan), lambda ds, k: setattr(ds, "PatientName", NAME))
    return folder / "ct"


def run(*words: object) -> int:
    return main([str(word) for word in words])


@dataclass
class ExportedCrop:
    """A crop of a scan with turned axes as SimpleITK reads it, the scan, the report, and what was printed."""

    image: Any
    scan: Volume
    report: dict[str, Any]
    printed: tuple[str, str]


@pytest.fixture
def exported_crop(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> ExportedCrop:
    folder = write_ct(tmp_path, angles=(10, -20, 35))
    scan = read_volume(folder)
    x, y, z = scan.ijk_to_lps([(12, 10, 6)])[0]
    words = ["export", folder, "-o", tmp_path / "a.nii.gz", "--around", f"{x},{y},{z},3"]
    assert run(*words, "--report", tmp_path / "a.json") == 0
    report = json.loads((tmp_path / "a.json").read_text())
    return ExportedCrop(sitk.ReadImage(str(tmp_path / "a.nii.gz")), scan, report, capsys.readouterr())


def test_exported_crop_has_the_voxels_of_the_scan_from_its_first_one_on(exported_crop: ExportedCrop) -> None:
    voxels = sitk.GetArrayFromImage(exported_crop.image)

    i, j, k = exported_crop.report["volume"]["crop"]["first_ijk"]
    nk, nj, ni = voxels.shape
    assert np.array_equal(voxels, exported_crop.scan.voxels[k : k + nk, j : j + nj, i : i + ni])
    assert voxels.size < exported_crop.scan.voxels.size / 2


def test_exported_crop_lies_in_the_place_of_its_voxels_in_the_scan(exported_crop: ExportedCrop) -> None:
    some_voxel = (1, 2, 3)
    in_scan = np.add(exported_crop.report["volume"]["crop"]["first_ijk"], some_voxel)

    place = exported_crop.image.TransformIndexToPhysicalPoint(some_voxel)

    expected = exported_crop.scan.ijk_to_lps([in_scan])[0]
    assert np.allclose(place, expected, atol=tolerances.NIFTI_LARGE_AFFINE_MM)


def test_report_of_an_exported_crop_has_its_shape_frame_and_type(exported_crop: ExportedCrop) -> None:
    output = exported_crop.report["output"]

    assert list(exported_crop.image.GetSize()) == output["shape_ijk"] == exported_crop.report["volume"]["shape_ijk"]
    assert (output["space"], output["type"]) == ("ras", "int16")
    assert exported_crop.report["device"] is None  # none was needed


def test_words_of_an_exported_crop_warn_of_it_and_begin_with_their_subjects(exported_crop: ExportedCrop) -> None:
    output, error = exported_crop.printed

    assert "cropped to x" in error and "voxels stay" in error
    assert [line[:9].strip() for line in output.splitlines()] == ["volume", "place", "time", "wrote", "report"]


def test_exported_volume_and_report_do_not_hold_the_name_of_the_patient(tmp_path: Path) -> None:
    scan = write_ct(tmp_path)

    assert run("export", scan, "-o", tmp_path / "a.nii.gz", "--report", tmp_path / "a.json") == 0

    assert b"Geheimnis" in next(scan.iterdir()).read_bytes()
    assert b"Geheimnis" not in gzip.decompress((tmp_path / "a.nii.gz").read_bytes())
    assert b"Geheimnis" not in (tmp_path / "a.json").read_bytes()


def test_report_of_an_export_has_the_gates_of_the_series_and_no_hash_of_it(tmp_path: Path) -> None:
    assert run("export", write_ct(tmp_path), "-o", tmp_path / "a.nii.gz", "--report", tmp_path / "a.json") == 0

    volume = json.loads((tmp_path / "a.json").read_text())["volume"]
    assert volume["gates"]
    assert volume["series"]["uid_hash"] is None


def test_exported_region_has_air_outside_of_it_and_words_that_say_so(tmp_path: Path, printed: Printer) -> None:
    scan = write_ct(tmp_path)
    voxels = read_volume(scan).voxels
    middle_hu = float(np.median(voxels))

    assert run("export", scan, "-o", tmp_path / "a.nrrd", "--region", f"hu:{middle_hu},") == 0

    exported = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / "a.nrrd")))
    outside_hu = -1024  # what scanners write for air
    assert np.array_equal(exported, np.where(voxels >= middle_hu, voxels, outside_hu))
    said = printed()
    said.assert_output("region", outside_hu, "HU")
    said.assert_error("outside", "region")


@pytest.fixture
def tilted(tmp_path: Path) -> Path:
    """A scan with a gantry tilt of 12 degrees."""
    return write_ct(tmp_path, tilt_deg=12.0)


def test_tilted_scan_is_refused_by_a_format_without_shear_with_those_that_have_it(
    tilted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("export", tilted, "-o", tmp_path / "a.mha") == 3

    error = capsys.readouterr().err
    assert "sheared by 12.00 degrees (.nii.gz and .nrrd hold that)" in error
    assert "--resample MM" in error
    assert not (tmp_path / "a.mha").exists()


def test_tilt_is_kept_in_nifti_with_a_warning(tilted: Path, tmp_path: Path, printed: Printer) -> None:
    assert run("export", tilted, "-o", tmp_path / "a.nii") == 0

    printed().assert_error("sheared", "NIfTI")
    affine_lps = nibabel.load(tmp_path / "a.nii").affine * [[-1], [-1], [1], [1]]  # NIfTI is in RAS
    assert np.allclose(affine_lps, read_volume(tilted).affine, atol=tolerances.NIFTI_LARGE_AFFINE_MM)


def test_resampled_tilted_scan_has_even_voxels_along_the_axes_of_the_patient(tilted: Path, tmp_path: Path) -> None:
    assert run("export", tilted, "-o", tmp_path / "a.mha", "--resample", "0.7") == 0

    image = sitk.ReadImage(str(tmp_path / "a.mha"))
    assert np.allclose(image.GetSpacing(), 0.7)
    directions = np.array(image.GetDirection())
    assert np.allclose(directions, np.round(directions))


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("-o", "a.stl"), "one of .nii.gz, .nii, .nrrd, .mha"),
        (("-o", "a.nii", "--resample", "0"), "at least 0.01 mm, not 0"),
        (("-o", "a.nii", "--resample", "1mm"), "'1mm' is no number: write the length in mm"),
        (("-o", "a.nii", "--resample", "nan"), "at least 0.01 mm, not nan"),
        (("-o", "a.nii", "--space", "mni"), "unknown space 'mni'"),
        (("-o", "a.nii", "--report", "a.nii"), "same file"),
    ],
)
def test_wrong_usage_of_export_is_refused_in_one_line_and_writes_nothing(
    words: tuple[str, ...], line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    write_ct(tmp_path)
    monkeypatch.chdir(tmp_path)

    assert run("export", "ct", *words) == 3

    (said,) = capsys.readouterr().err.splitlines()
    assert line in said
    assert [path.name for path in tmp_path.iterdir()] == ["ct"]


def test_existing_file_of_an_export_stays_with_no_clobber(tmp_path: Path) -> None:
    (tmp_path / "a.nii").write_bytes(b"older")

    assert run("export", write_ct(tmp_path), "-o", tmp_path / "a.nii", "--no-clobber") == 6

    assert (tmp_path / "a.nii").read_bytes() == b"older"


def test_existing_file_of_an_export_is_replaced_without_no_clobber(tmp_path: Path) -> None:
    (tmp_path / "a.nii").write_bytes(b"older")

    assert run("export", write_ct(tmp_path), "-o", tmp_path / "a.nii") == 0

    assert read_volume(tmp_path / "a.nii").voxels.shape == SHAPE_KJI


def test_export_from_python_resamples_and_reports_its_stages_and_affine(tmp_path: Path) -> None:
    stages = []
    settings = ExportSettings(between=(-1e9, 1e9), resample=2.0)

    report = export_volume(
        write_ct(tmp_path), tmp_path / "a.mha", settings, progress=lambda stage, *_: stages.append(stage)
    )

    assert report.volume["resampled"]["step_mm"] == 2.0
    assert {"read", "resample", "write"} <= set(stages)
    written = read_volume(tmp_path / "a.mha")
    assert np.allclose(written.affine, report.output["affine_ijk_to_lps_mm"], atol=tolerances.AFFINE_MM)
