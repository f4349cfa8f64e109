"""Volumes as NIfTI, NRRD and MetaImage: other programs find the same values at the same places."""

from __future__ import annotations

import time

import dicom_series
import numpy as np
import pytest
from refusals import refused
from uneven_volume import uneven

from clrecon import Volume, read_volume, write_volume
from clrecon.errors import OutputError, UsageError
from clrecon.geometry.resample import resample_volume
from clrecon.reading import read_volume as read_dicom

nibabel = pytest.importorskip("nibabel")
sitk = pytest.importorskip("SimpleITK")
nrrd = pytest.importorskip("nrrd")

pytestmark = pytest.mark.unit

NAMES = ["a.nii", "a.nii.gz", "a.nrrd", "a.mha"]
PLANS = {
    "oblique": dicom_series.Plan(shape=(5, 6, 9), angles=(10, -20, 35), gap=1.25),
    "tilted": dicom_series.Plan(shape=(5, 6, 9), tilt_deg=12.0, gap=1.25),
}


def scan(tmp_path, plan):
    dicom_series.write_series(tmp_path / "ct", PLANS[plan])
    return read_dicom(tmp_path / "ct")


@pytest.mark.parametrize("name", NAMES)
def test_itk_finds_the_same_values_at_the_same_places(tmp_path, name):
    volume = scan(tmp_path, "oblique")
    size = write_volume(volume, tmp_path / name)
    assert size == (tmp_path / name).stat().st_size
    image = sitk.ReadImage(str(tmp_path / name))
    assert np.array_equal(sitk.GetArrayFromImage(image), volume.voxels)
    for ijk in ([0, 0, 0], [8, 0, 0], [0, 5, 0], [3, 2, 4]):
        assert np.allclose(image.TransformIndexToPhysicalPoint(ijk), volume.ijk_to_lps([ijk])[0], atol=1e-4)


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_nibabel_finds_the_same_places_in_ras(tmp_path, name):
    volume = scan(tmp_path, "tilted")
    write_volume(volume, tmp_path / name)
    image = nibabel.load(tmp_path / name)
    assert np.array_equal(np.asarray(image.dataobj), volume.voxels.transpose(2, 1, 0))
    ras = nibabel.affines.apply_affine(image.affine, [3, 2, 4])
    assert np.allclose(ras * (-1, -1, 1), volume.ijk_to_lps([(3, 2, 4)])[0], atol=1e-4)
    assert np.allclose(image.header.get_zooms(), volume.spacing, atol=1e-5)


def test_pynrrd_finds_a_shear_in_lps(tmp_path):
    volume = scan(tmp_path, "tilted")
    write_volume(volume, tmp_path / "a.nrrd")
    voxels, header = nrrd.read(str(tmp_path / "a.nrrd"))
    assert header["space"] == "left-posterior-superior"
    assert np.array_equal(voxels, volume.voxels.transpose(2, 1, 0))
    assert np.allclose(header["space directions"].T, volume.affine[:3, :3])
    assert np.allclose(header["space origin"], volume.affine[:3, 3])


@pytest.mark.parametrize("name", NAMES)
def test_written_volume_is_read_back_unchanged(tmp_path, name):
    volume = scan(tmp_path, "oblique")
    write_volume(volume, tmp_path / name)
    back = read_volume(tmp_path / name)
    assert np.array_equal(back.voxels, volume.voxels) and back.voxels.dtype == np.int16
    assert np.allclose(back.affine, volume.affine, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("values", "stored"),
    [([-3024, 3071], np.int16), ([-1024, 32768], np.int32), ([-0.1, 1e-30], np.float32), ([0, 255], np.int16)],
)
def test_no_value_is_lost(tmp_path, name, values, stored):
    kind = np.float32 if stored == np.float32 else np.int32
    voxels = np.full((2, 3, 4), values[0], kind)
    voxels[1, 2, 3] = values[1]
    write_volume(Volume(voxels, np.eye(4)), tmp_path / name)
    found = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / name)))
    assert found.dtype == stored and np.array_equal(found, voxels)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_volume_gives_the_same_bytes_at_another_time(tmp_path, name, monkeypatch):
    volume = scan(tmp_path, "oblique")
    written = []
    for now in (1.6e9, 1.7e9):
        monkeypatch.setattr(time, "time", lambda now=now: now)
        write_volume(volume, tmp_path / name)
        written.append((tmp_path / name).read_bytes())
    assert written[0] == written[1]


def test_the_certificate_is_in_the_file(tmp_path):
    volume = scan(tmp_path, "tilted")
    write_volume(volume, tmp_path / "a.nii")
    text = nibabel.load(tmp_path / "a.nii").header.extensions[0].get_content()
    text = text if isinstance(text, str) else text.decode()
    assert "tilt_deg -12" in text and "gates " in text and "frame_of_reference" not in text
    write_volume(volume, tmp_path / "a.nrrd", keep_ids=True)
    fields = nrrd.read_header(str(tmp_path / "a.nrrd"))
    assert any(str(value).startswith("frame_of_reference ") for value in fields.values())
    straight = resample_volume(volume, 1.0)
    write_volume(straight, tmp_path / "a.mha")
    image = sitk.ReadImage(str(tmp_path / "a.mha"))
    lines = [image.GetMetaData(key) for key in image.GetMetaDataKeys() if key.startswith("clrecon_")]
    assert "tilt_deg 0" in lines and any("resampled" in line for line in lines)


def test_uneven_slices_and_sheared_mha_are_refused(tmp_path):
    for name in NAMES:
        with refused(UsageError, "slices", "volume"):
            write_volume(uneven(), tmp_path / name)
    with refused(UsageError, ".nii.gz", 12.0):
        write_volume(scan(tmp_path, "tilted"), tmp_path / "a.mha")
    assert not [path for path in tmp_path.iterdir() if path.name != "ct"]


@pytest.mark.parametrize("name", ["a.stl", "a", ".nii", "a.gz", "a.mhd"])
def test_a_file_whose_name_is_of_no_volume_is_refused(tmp_path, name):
    with refused(UsageError, ".nii.gz"):
        write_volume(Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), tmp_path / name)


def test_writing_an_array_as_a_volume_is_refused(tmp_path):
    with refused(UsageError, "volume", "ndarray"):
        write_volume(np.zeros((2, 2, 2), np.int16), tmp_path / "a.nii")


def test_writing_a_volume_into_no_folder_is_refused(tmp_path):
    with refused(OutputError, "a.nii"):
        write_volume(Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), tmp_path / "none" / "a.nii")


def test_one_slice_is_written(tmp_path):
    volume = Volume(np.arange(12, dtype=np.int16).reshape(1, 3, 4), np.diag((1.0, 1.0, 3.0, 1.0)))
    for name in NAMES:
        write_volume(volume, tmp_path / name)
        image = sitk.ReadImage(str(tmp_path / name))
        assert image.GetSize() == (4, 3, 1) and image.GetSpacing()[2] == 3.0


def test_uneven_slices_resample_to_their_own_linear_field(tmp_path):
    """Values linear in space stay so, between slices at any distance."""
    volume = uneven()
    nk, nj, ni = volume.voxels.shape
    ijk = np.array([(i, j, k) for k in range(nk) for j in range(nj) for i in range(ni)], float)
    slope = np.array([1.5, -2.0, 0.7])
    values = (volume.ijk_to_lps(ijk) @ slope).reshape(nk, nj, ni).astype(np.float32)
    made = resample_volume(uneven(values), 0.4)
    assert np.allclose(made.spacing, 0.4)
    assert np.allclose(made.affine[:3, :3].T @ made.affine[:3, :3], 0.16 * np.eye(3))
    nk, nj, ni = made.voxels.shape
    ijk = np.array([(i, j, k) for k in range(nk) for j in range(nj) for i in range(ni)], float)
    places = made.ijk_to_lps(ijk)
    within = volume.lps_to_ijk(places)
    held = ((within > 1e-3) & (within < np.array(volume.shape_ijk) - 1.001)).all(axis=1)
    assert held.sum() > 100
    assert np.allclose(made.voxels.reshape(-1)[held], (places @ slope)[held], atol=1e-3)
    assert write_volume(volume, tmp_path / "a.mha", resample=0.4) > made.voxels.size
    assert sitk.ReadImage(str(tmp_path / "a.mha")).GetSize() == made.shape_ijk
    for step in (0.0, -1.0, np.nan, 0.001):
        with refused(UsageError, 0.01):
            resample_volume(volume, step)
