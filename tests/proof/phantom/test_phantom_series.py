"""The written DICOM series against its truth, re-derived from the files alone."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pydicom
import pytest
import tolerances
from refusals import refused
from variants import daily

from clrecon.errors import OutputError, UsageError
from clrecon.proof.phantom import PhantomSettings, build, make_phantom, write_phantom

AWKWARD = {"size": (38, 30), "slices": 14, "spacing": (0.7, 0.5, 2.5)}


def read_back(folder: Path) -> tuple[np.ndarray, np.ndarray, list[pydicom.Dataset]]:
    """HU, affine and headers of the files, by the DICOM formulas alone."""
    headers = [pydicom.dcmread(path) for path in sorted(folder.glob("*.dcm"))]
    first = headers[0]
    row, column = np.array(first.ImageOrientationPatient, float).reshape(2, 3)
    positions = np.array([header.ImagePositionPatient for header in headers], float)
    affine = np.eye(4)
    affine[:3, 0] = row * float(first.PixelSpacing[1])
    affine[:3, 1] = column * float(first.PixelSpacing[0])
    affine[:3, 2] = np.polyfit(np.arange(len(positions)), positions, 1)[0]
    affine[:3, 3] = positions[0]
    hu = np.stack([h.pixel_array * float(h.RescaleSlope) + float(h.RescaleIntercept) for h in headers])
    return hu, affine, headers


@pytest.fixture(
    scope="module",
    params=[{}, {"tilt": 18.5}, {"tilt": -12.0, "oblique": (10.0, -5.0, 33.0), "transfer_syntax": "implicit"}],
    ids=["straight", "tilted", "tilted-oblique-implicit"],
)
def extra(request: pytest.FixtureRequest) -> dict:
    """What a phantom has beside `AWKWARD`."""
    return request.param


@pytest.fixture(scope="module", params=daily(1, ["sphere", "spine"]))
def written(request: pytest.FixtureRequest, extra: dict, tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """A phantom as asked for, as told by its truth, and as its files hold it."""
    folder = tmp_path_factory.mktemp("phantom") / "ct"
    settings = PhantomSettings(kind=request.param, **AWKWARD, **extra)
    truth = write_phantom(folder, settings)
    hu, affine, headers = read_back(folder)
    return SimpleNamespace(folder=folder, settings=settings, truth=truth, hu=hu, affine=affine, headers=headers)


def test_files_hold_the_affine_and_voxels_of_the_truth(written: SimpleNamespace) -> None:
    voxels, affine, truth = make_phantom(written.settings)
    assert written.truth == truth == json.loads((written.folder / "truth.json").read_text())
    assert np.array_equal(written.hu, voxels)
    assert np.array_equal(affine, truth["affine_ijk_to_lps_mm"])
    assert written.affine == pytest.approx(affine, abs=tolerances.PHANTOM_POSITION_MM)


def test_files_hold_the_size_spacing_and_tilt_that_were_asked_for(written: SimpleNamespace, extra: dict) -> None:
    row, column, step = written.affine[:3, :3].T
    normal = np.cross(row, column)
    assert list(written.hu.shape[::-1]) == written.truth["shape_ijk"] == [38, 30, 14]
    assert [np.linalg.norm(row), np.linalg.norm(column)] == pytest.approx([0.5, 0.7])
    assert step @ normal / np.linalg.norm(normal) == pytest.approx(2.5, abs=1e-9)
    assert written.truth["tilt_deg"] == pytest.approx(extra.get("tilt", 0.0), abs=1e-6)


def test_headers_of_a_phantom_are_those_of_a_ct(written: SimpleNamespace, extra: dict) -> None:
    first = written.headers[0]
    assert first.file_meta.TransferSyntaxUID.is_implicit_VR == (extra.get("transfer_syntax") == "implicit")
    assert first.SOPClassUID == pydicom.uid.CTImageStorage and first.PatientPosition == "HFS"
    assert (first.BitsStored, first.PixelRepresentation, first.RescaleIntercept) == (16, 1, -1024)
    assert ("GantryDetectorTilt" in first) == ("tilt" in extra)


def test_slices_of_a_phantom_are_of_one_series_and_have_names_of_their_own(written: SimpleNamespace) -> None:
    assert len({header.SOPInstanceUID for header in written.headers}) == 14
    assert len({header.SeriesInstanceUID for header in written.headers}) == 1


def test_decimal_strings_fit_into_sixteen_characters(tmp_path: Path) -> None:
    settings = PhantomSettings(
        kind="sphere", size=(20, 21), slices=19, spacing=(0.7 / 3.0, 0.123456789, 0.2), oblique=(1.0, 2.0, 3.0)
    )
    write_phantom(tmp_path / "ct", settings)
    for path in (tmp_path / "ct").glob("*.dcm"):
        header = pydicom.dcmread(path)
        for name in ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing"):
            texts = header.get_item(name).value.decode().split("\\")
            assert all(0 < len(text.strip()) <= 16 for text in texts), texts


def test_tilt_shears_and_obliquity_does_not() -> None:
    affines = [
        make_phantom(PhantomSettings(kind="sphere", **AWKWARD, **extra))[1]
        for extra in ({}, {"tilt": 20.0}, {"oblique": (30.0, -20.0, 10.0)})
    ]
    steps = [affine[:3, :3] / np.linalg.norm(affine[:3, :3], axis=0) for affine in affines]
    assert steps[0].T @ steps[0] == pytest.approx(np.eye(3), abs=1e-12)
    assert steps[2].T @ steps[2] == pytest.approx(np.eye(3), abs=1e-9)
    # the table still moves along z, the rows lean: only columns and slice step leave the right angle
    assert steps[1][:, 2] == pytest.approx((0.0, 0.0, 1.0), abs=1e-9)
    assert steps[1][:, 1] @ steps[1][:, 2] == pytest.approx(-np.sin(np.radians(20.0)), abs=1e-9)
    assert steps[1][:, 0] @ steps[1][:, 2] == pytest.approx(0.0, abs=1e-12)
    # same voxel volume whatever the tilt: the gap is along the normal
    assert np.linalg.det(affines[1][:3, :3]) == pytest.approx(np.linalg.det(affines[0][:3, :3]), rel=1e-9)
    # oblique turns about x first, then y, then z
    assert steps[2][:, 0] == pytest.approx(
        (np.cos(np.radians(20)) * np.cos(np.radians(10)), np.cos(np.radians(20)) * np.sin(np.radians(10)),
         np.sin(np.radians(20))), abs=1e-9
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["sphere", "torus", "cylinder", "plane"])
def test_analytic_voxels_hold_the_stated_volume_and_level(kind: str) -> None:
    settings = PhantomSettings(
        kind=kind, size=(61, 44), slices=29, spacing=(0.8, 0.6, 1.3), tilt=15.0, oblique=(5.0, 8.0, -20.0),
        inside_hu=700.0, outside_hu=-900.0,
    )  # fmt: skip
    voxels, affine, truth = make_phantom(settings)
    assert voxels.dtype == np.int16 and voxels.shape == (29, 44, 61)
    assert (voxels.min(), voxels.max()) == (-900, 700)
    assert truth["half_maximum_hu"] == truth["iso_value_hu"] == -100.0
    share = (voxels.astype(np.float64) + 900.0) / 1600.0
    volume = share.sum() * abs(np.linalg.det(affine[:3, :3])) / 1000.0
    assert volume == pytest.approx(truth["surface"]["volume_ml"], rel=tolerances.PHANTOM_VOLUME_RATIO)
    k, j, i = np.indices(voxels.shape).reshape(3, -1) * share.ravel() / share.sum()
    centroid = affine[:3, :3] @ (i.sum(), j.sum(), k.sum()) + affine[:3, 3]
    assert centroid == pytest.approx(truth["surface"]["center_lps_mm"], abs=0.02)
    assert max(voxels.take(end, axis).max() for axis in range(3) for end in (0, -1)) == -900


@pytest.mark.release
def test_phantom_has_the_same_bytes_with_the_same_seed_alone(tmp_path: Path) -> None:
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        write_phantom(tmp_path / name, PhantomSettings(kind="spine", **AWKWARD, seed=seed))
    content = {name: {path.name: path.read_bytes() for path in (tmp_path / name).iterdir()} for name in ("a", "b", "c")}
    assert content["a"] == content["b"]
    assert sorted(content["a"]) == [*(f"IM{n:04d}.dcm" for n in range(1, 15)), "truth.json"]
    assert all(content["a"][name] != content["c"][name] for name in content["a"])
    sphere = [make_phantom(PhantomSettings(kind="sphere", **AWKWARD, seed=seed))[0] for seed in (3, 4)]
    assert not np.array_equal(*sphere)


def test_an_earlier_phantom_is_replaced_and_anything_else_refused(tmp_path: Path) -> None:
    settings = PhantomSettings(kind="sphere", **AWKWARD)
    out = tmp_path / "ct"
    out.mkdir()
    write_phantom(out, settings)
    write_phantom(out, PhantomSettings(kind="sphere", **{**AWKWARD, "slices": 12}))
    assert len(list(out.glob("*.dcm"))) == 12
    (out / "notes.txt").write_text("mine")
    with pytest.raises(UsageError, match="notes.txt"):
        write_phantom(out, settings)
    assert (out / "notes.txt").read_text() == "mine" and len(list(out.glob("*.dcm"))) == 12
    other = tmp_path / "other"
    other.mkdir()
    (other / "truth.json").write_text('{"generator": "someone"}')
    with pytest.raises(UsageError, match="not of a phantom"):
        write_phantom(other, settings)
    (other / "truth.json").unlink()
    (other / "IM0001.dcm").write_bytes(b"a scan of somebody")
    with refused(UsageError, 1, "file", "IM0001.dcm"):
        write_phantom(other, settings)
    (other / "IM0002.dcm").write_bytes(b"another")
    with refused(UsageError, 2, "files", "IM0001.dcm"):
        write_phantom(other, settings)
    with pytest.raises(OutputError, match="does not exist"):
        write_phantom(tmp_path / "missing" / "ct", settings)
    with pytest.raises(OutputError, match="a file of that name"):
        write_phantom(out / "notes.txt", settings)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ct", "other"]


def test_nothing_is_left_when_writing_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "ct"
    settings = PhantomSettings(kind="sphere", **AWKWARD)
    write_phantom(out, settings)
    before = {path.name: path.read_bytes() for path in out.iterdir()}

    def fail(folder: Path, *rest: object) -> None:
        (folder / "IM0001.dcm").write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(build, "write_series", fail)
    with pytest.raises(OutputError, match="No space left"):
        write_phantom(out, PhantomSettings(kind="sphere", **AWKWARD, seed=5))
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    with pytest.raises(OutputError):
        write_phantom(tmp_path / "new", settings)
    assert [path.name for path in tmp_path.iterdir()] == ["ct"]


def test_a_file_that_reads_back_differently_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save = pydicom.FileDataset.save_as

    def spoil(self: pydicom.FileDataset, path: Path, **options: object) -> None:
        save(self, path, **options)
        data = bytearray(path.read_bytes())
        data[-1] ^= 1
        path.write_bytes(bytes(data))

    monkeypatch.setattr(pydicom.FileDataset, "save_as", spoil)
    with refused(OutputError, "IM0001.dcm"):
        write_phantom(tmp_path / "ct", PhantomSettings(kind="sphere", **AWKWARD))
    assert list(tmp_path.iterdir()) == []
