"""Volumes as NIfTI, NRRD and MetaImage: other programs find the same values at the same places."""

from __future__ import annotations

import os
import time
import zlib

import dicom_series
import numpy as np
import pytest
import tolerances
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


def read_scan(tmp_path, plan):
    """One of the `PLANS` of 5 slices of 6 x 9 pixels, as a volume."""
    dicom_series.write_series(tmp_path / "ct", PLANS[plan])
    return read_dicom(tmp_path / "ct")


@pytest.mark.parametrize("name", NAMES)
def test_simpleitk_reads_a_written_volume_with_the_same_values_at_the_same_places(tmp_path, name):
    volume = read_scan(tmp_path, "oblique")
    write_volume(volume, tmp_path / name)
    image = sitk.ReadImage(str(tmp_path / name))
    assert np.array_equal(sitk.GetArrayFromImage(image), volume.voxels)
    for ijk in ([0, 0, 0], [8, 0, 0], [0, 5, 0], [3, 2, 4]):  # corners and one within
        place = image.TransformIndexToPhysicalPoint(ijk)
        assert np.allclose(place, volume.ijk_to_lps([ijk])[0], atol=tolerances.GRID_PLACE_MM)


@pytest.mark.parametrize("name", NAMES)
def test_writing_a_volume_returns_the_bytes_of_its_file(tmp_path, name):
    assert write_volume(read_scan(tmp_path, "oblique"), tmp_path / name) == (tmp_path / name).stat().st_size


@pytest.fixture
def noisy_volume():
    """4 MB of noise: more than two pieces that are packed at once."""
    return Volume(np.random.default_rng(0).integers(0, 2000, (8, 512, 512), np.int16), np.eye(4))


def test_packed_volume_is_one_member_of_gzip_that_holds_the_bytes_of_the_unpacked_file(tmp_path, noisy_volume):
    for name in ("a.nii.gz", "a.nii"):
        write_volume(noisy_volume, tmp_path / name)
    inflater = zlib.decompressobj(16 + zlib.MAX_WBITS)
    assert inflater.decompress((tmp_path / "a.nii.gz").read_bytes()) == (tmp_path / "a.nii").read_bytes()
    assert inflater.eof
    assert inflater.unused_data == b""


def test_volume_packed_by_one_core_has_the_bytes_of_that_packed_by_several(tmp_path, noisy_volume, monkeypatch):
    for cores in (1, 3):
        monkeypatch.setattr(os, "sched_getaffinity", lambda process, cores=cores: set(range(cores)), raising=False)
        write_volume(noisy_volume, tmp_path / f"{cores}.nii.gz")
    assert (tmp_path / "1.nii.gz").read_bytes() == (tmp_path / "3.nii.gz").read_bytes()


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_nibabel_reads_a_written_volume_with_the_same_values_at_the_same_places_in_ras(tmp_path, name):
    volume = read_scan(tmp_path, "tilted")
    write_volume(volume, tmp_path / name)
    image = nibabel.load(tmp_path / name)
    assert np.array_equal(np.asarray(image.dataobj), volume.voxels.transpose(2, 1, 0))
    ijk = (3, 2, 4)
    ras = nibabel.affines.apply_affine(image.affine, ijk)
    assert np.allclose(ras * (-1, -1, 1), volume.ijk_to_lps([ijk])[0], atol=tolerances.GRID_PLACE_MM)
    assert np.allclose(image.header.get_zooms(), volume.spacing, atol=tolerances.GRID_SPACING_MM)


def test_pynrrd_reads_a_written_sheared_volume_with_the_same_values_and_affine_in_lps(tmp_path):
    volume = read_scan(tmp_path, "tilted")
    write_volume(volume, tmp_path / "a.nrrd")
    voxels, header = nrrd.read(str(tmp_path / "a.nrrd"))
    assert np.array_equal(voxels, volume.voxels.transpose(2, 1, 0))
    assert header["space"] == "left-posterior-superior"
    assert np.allclose(header["space directions"].T, volume.affine[:3, :3])
    assert np.allclose(header["space origin"], volume.affine[:3, 3])


@pytest.mark.parametrize("name", NAMES)
def test_written_volume_is_read_back_unchanged(tmp_path, name):
    volume = read_scan(tmp_path, "oblique")
    write_volume(volume, tmp_path / name)
    back = read_volume(tmp_path / name)
    assert back.voxels.dtype == np.int16
    assert np.array_equal(back.voxels, volume.voxels)
    assert np.allclose(back.affine, volume.affine, atol=tolerances.GRID_PLACE_MM)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("values", "stored"),
    [([-3024, 3071], np.int16), ([-1024, 32768], np.int32), ([-0.1, 1e-30], np.float32), ([0, 255], np.int16)],
    ids=["HU", "beyond 16 bits", "fractions", "bytes"],
)
def test_values_are_written_in_the_smallest_type_that_holds_them_all(tmp_path, name, values, stored):
    kind = np.float32 if stored == np.float32 else np.int32
    voxels = np.full((2, 3, 4), values[0], kind)
    voxels[1, 2, 3] = values[1]
    write_volume(Volume(voxels, np.eye(4)), tmp_path / name)
    read = sitk.GetArrayFromImage(sitk.ReadImage(str(tmp_path / name)))
    assert read.dtype == stored
    assert np.array_equal(read, voxels)


@pytest.mark.parametrize("name", NAMES)
def test_volume_written_at_another_time_has_the_same_bytes(tmp_path, name, monkeypatch):
    volume = read_scan(tmp_path, "oblique")
    contents = []
    for now in (1.6e9, 1.7e9):
        monkeypatch.setattr(time, "time", lambda now=now: now)
        write_volume(volume, tmp_path / name)
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]


def test_nifti_holds_the_certificate_without_the_frame_of_reference(tmp_path):
    write_volume(read_scan(tmp_path, "tilted"), tmp_path / "a.nii")
    text = nibabel.load(tmp_path / "a.nii").header.extensions[0].get_content()
    text = text if isinstance(text, str) else text.decode()
    assert "tilt_deg -12" in text
    assert "gates " in text
    assert "frame_of_reference" not in text


def test_nrrd_holds_the_frame_of_reference_on_request(tmp_path):
    write_volume(read_scan(tmp_path, "tilted"), tmp_path / "a.nrrd", keep_ids=True)
    fields = nrrd.read_header(str(tmp_path / "a.nrrd"))
    assert any(str(value).startswith("frame_of_reference ") for value in fields.values())


def test_metaimage_of_a_resampled_volume_holds_its_certificate(tmp_path):
    straight = resample_volume(read_scan(tmp_path, "tilted"), to=1.0)
    write_volume(straight, tmp_path / "a.mha")
    image = sitk.ReadImage(str(tmp_path / "a.mha"))
    lines = [image.GetMetaData(key) for key in image.GetMetaDataKeys() if key.startswith("clrecon_")]
    assert "tilt_deg 0" in lines
    assert any("resampled" in line for line in lines)


@pytest.mark.parametrize("name", NAMES)
def test_volume_of_uneven_slices_is_refused_and_nothing_is_written(tmp_path, name):
    with refused(UsageError, "slices", "volume"):
        write_volume(uneven(), tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_sheared_volume_is_refused_as_a_metaimage_and_nothing_is_written(tmp_path):
    volume = read_scan(tmp_path, "tilted")  # by 12 degrees
    with refused(UsageError, ".nii.gz", 12.0):
        write_volume(volume, tmp_path / "a.mha")
    assert not (tmp_path / "a.mha").exists()


@pytest.mark.parametrize("name", ["a.stl", "a", ".nii", "a.gz", "a.mhd"])
def test_volume_under_a_name_of_no_grid_format_is_refused(tmp_path, name):
    with refused(UsageError, ".nii.gz"):
        write_volume(Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), tmp_path / name)


def test_writing_an_array_as_a_volume_is_refused(tmp_path):
    with refused(UsageError, "volume", "ndarray"):
        write_volume(np.zeros((2, 2, 2), np.int16), tmp_path / "a.nii")


def test_writing_a_volume_into_no_folder_is_refused(tmp_path):
    with refused(OutputError, "a.nii", "folder"):
        write_volume(Volume(np.zeros((2, 2, 2), np.int16), np.eye(4)), tmp_path / "none" / "a.nii")


@pytest.mark.parametrize("name", NAMES)
def test_volume_of_one_slice_is_written_with_its_thickness(tmp_path, name):
    volume = Volume(np.arange(12, dtype=np.int16).reshape(1, 3, 4), np.diag((1.0, 1.0, 3.0, 1.0)))
    write_volume(volume, tmp_path / name)
    image = sitk.ReadImage(str(tmp_path / name))
    assert image.GetSize() == (4, 3, 1)
    assert image.GetSpacing()[2] == 3.0


def centres_of_voxels(volume):
    """Indices (n, 3) of all voxels, i, j and k."""
    nk, nj, ni = volume.voxels.shape
    return np.array([(i, j, k) for k in range(nk) for j in range(nj) for i in range(ni)], float)


def test_resampled_volume_of_uneven_slices_has_cubic_voxels_at_right_angles():
    resampled = resample_volume(uneven(), to=0.4)
    assert np.allclose(resampled.spacing, 0.4)
    assert np.allclose(resampled.affine[:3, :3].T @ resampled.affine[:3, :3], 0.4**2 * np.eye(3))


def test_uneven_slices_of_a_linear_field_are_resampled_to_the_same_field():
    gradient = np.array([1.5, -2.0, 0.7])  # HU a mm along x, y and z
    stack = uneven()
    values = stack.ijk_to_lps(centres_of_voxels(stack)) @ gradient
    volume = uneven(values.reshape(stack.voxels.shape).astype(np.float32))

    resampled = resample_volume(volume, to=0.4)

    places = resampled.ijk_to_lps(centres_of_voxels(resampled))
    ijk_in_stack = volume.lps_to_ijk(places)
    inside = ((ijk_in_stack > 1e-3) & (ijk_in_stack < np.array(volume.shape_ijk) - 1.001)).all(axis=1)
    assert inside.sum() > 100  # 462 of 1,560 voxels were measured
    assert np.allclose(resampled.voxels.reshape(-1)[inside], (places @ gradient)[inside], atol=tolerances.RESAMPLED_HU)


def test_uneven_slices_are_written_resampled_on_request(tmp_path):
    write_volume(uneven(), tmp_path / "a.mha", resample=0.4)
    assert sitk.ReadImage(str(tmp_path / "a.mha")).GetSize() == resample_volume(uneven(), to=0.4).shape_ijk


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan, 0.001])
def test_spacing_that_is_no_hundredth_of_a_mm_or_more_is_refused_for_resampling(spacing):
    with refused(UsageError, 0.01):
        resample_volume(uneven(), spacing)
