"""Volumes from NIfTI, NRRD and MetaImage: every value and every place as the file has it, whatever it is stored as."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import tolerances
from dicom_series import Plan, write_series
from label_files import OBLIQUE, RAS, write_nifti, write_nrrd
from refusals import refused
from scipy.spatial import cKDTree
from variants import daily
from volume_files import LEFT_HANDED, ROTATED, WRITERS, make_ct, write_metaimage

import clrecon
from clrecon.errors import RefusedInputError
from clrecon.geometry import AIR_HU
from clrecon.labels import resample_labels
from clrecon.proof.phantom import PhantomSettings, write_phantom

nibabel = pytest.importorskip("nibabel")
pytest.importorskip("nrrd")
sitk = pytest.importorskip("SimpleITK")
AFFINES = {"oblique and sheared": OBLIQUE, "oblique": ROTATED, "left-handed": LEFT_HANDED}
TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"]


def affine_bound(name: str) -> float:
    """NIfTI-1 keeps 24 bits of each entry."""
    return tolerances.NIFTI_AFFINE_MM if name in ("a.nii", "a.nii.gz", "a.hdr") else tolerances.AFFINE_MM


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("place", AFFINES)
def test_grid_file_is_read_with_its_values_and_its_place(tmp_path, name, place):
    voxels = make_ct()
    volume = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels, AFFINES[place]))
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, voxels)
    assert np.abs(volume.affine - AFFINES[place]).max() <= affine_bound(name)


@pytest.mark.parametrize("name", WRITERS)
def test_report_of_a_grid_file_has_its_range_and_warns_that_it_is_not_dicom(tmp_path, name):
    voxels = make_ct()
    report = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels, OBLIQUE)).report
    assert report["hu_range"] == [voxels.min(), voxels.max()]
    (warning,) = report["warnings"]
    assert warning.startswith("not DICOM")


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("order", daily(1, "<>"))
@pytest.mark.parametrize("stored", TYPES)
def test_whole_numbers_are_read_as_int16_whatever_they_are_stored_as(tmp_path, name, order, stored):
    low, high = {"u1": (0, 256), "i1": (-128, 128)}.get(stored, (0 if stored[0] == "u" else -1024, 3000))
    voxels = make_ct(low=low, high=high)
    volume = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels.astype(order + stored), OBLIQUE))
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, voxels)


@pytest.mark.parametrize("kind", ["Nifti1", "Nifti2"])
@pytest.mark.parametrize("stored", [">i2", ">f4"])
def test_big_endian_nifti_is_read(tmp_path, kind, stored):
    header = getattr(nibabel, f"{kind}Header")(endianness=">")
    header.set_data_dtype(stored)
    image = getattr(nibabel, f"{kind}Image")(make_ct().transpose(2, 1, 0).astype(stored), RAS @ OBLIQUE, header)
    nibabel.save(image, tmp_path / "a.nii")
    assert (tmp_path / "a.nii").read_bytes()[:2] == b"\0\0"  # of the size of the header, 348 or 540, big end first
    assert np.array_equal(clrecon.read_volume(tmp_path / "a.nii").voxels, make_ct())


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("stored", ["f4", "f8"])
def test_fractions_are_read_as_float32(tmp_path, name, stored):
    voxels = make_ct((4, 6, 7)).astype(stored) + np.random.default_rng(1).random((4, 6, 7)).astype(stored)
    volume = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels, OBLIQUE))
    assert volume.voxels.dtype == np.float32
    assert np.array_equal(volume.voxels, voxels.astype(np.float32))


@pytest.mark.parametrize("k", [0, 2, 3])
@pytest.mark.parametrize(("value", "dtype"), [(40_000.0, "i4"), (-3.0e6, "i4"), (12.25, "f4"), (1e12, "f4")])
def test_value_that_int16_cannot_hold_in_one_slice_widens_the_type_of_the_whole_volume(tmp_path, k, value, dtype):
    voxels = make_ct().astype(np.float64)
    voxels[k, 3, 2] = value
    volume = clrecon.read_volume(write_nifti(tmp_path / "a.nii.gz", voxels))
    assert volume.voxels.dtype == dtype
    assert np.array_equal(volume.voxels, voxels.astype(dtype))


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "two.nii"])  # it does not read NIfTI-2
def test_grid_file_is_read_as_simpleitk_reads_it(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct((4, 6, 7)), ROTATED)
    volume, image = clrecon.read_volume(path), sitk.ReadImage(str(path))
    assert np.array_equal(volume.voxels, sitk.GetArrayFromImage(image))
    ijk = np.array([[0, 0, 0], [6, 0, 0], [0, 5, 0], [0, 0, 3], [3, 2, 1]])  # corners and one within
    expected = [image.TransformIndexToPhysicalPoint(tuple(map(int, index))) for index in ijk]
    assert np.abs(volume.ijk_to_lps(ijk) - expected).max() <= affine_bound(name)


@pytest.mark.parametrize("name", [name for name in WRITERS if ".nii" in name or ".hdr" in name])
def test_nifti_is_read_as_nibabel_reads_it(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct(), ROTATED)
    volume, image = clrecon.read_volume(path), nibabel.load(path)
    assert np.array_equal(volume.voxels, np.asarray(image.dataobj).transpose(2, 1, 0))
    assert np.allclose(volume.affine, RAS @ image.affine, rtol=0, atol=affine_bound(name))


@pytest.mark.parametrize("name", ["a.mha", "packed.mha", "a.mhd", "packed.mhd"])
def test_left_handed_metaimage_is_read_as_simpleitk_reads_it(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct((4, 6, 7)), LEFT_HANDED)
    volume, image = clrecon.read_volume(path), sitk.ReadImage(str(path))
    assert np.array_equal(volume.voxels, sitk.GetArrayFromImage(image))
    for ijk in ((0, 0, 0), (6, 5, 3)):  # first and last voxel
        expected = image.TransformIndexToPhysicalPoint(ijk)
        assert np.abs(volume.ijk_to_lps([ijk])[0] - expected).max() <= tolerances.AFFINE_MM


def test_packed_metaimage_without_the_size_of_its_data_is_read(tmp_path):
    path = write_metaimage(tmp_path / "a.mha", make_ct(), packed=True, CompressedDataSize=None)
    assert np.array_equal(clrecon.read_volume(path).voxels, make_ct())  # SimpleITK returns what was in memory


@pytest.mark.parametrize("name", ["s.nii.gz", "s.nrrd", "s.nhdr", "s.mha", "s.mhd"])
def test_dicom_series_converted_by_simpleitk_is_read_as_the_same_volume(tmp_path, name):
    write_series(tmp_path / "ct", Plan(shape=(7, 5, 6), angles=(20.0, -10.0, 5.0), gap=2.5))
    series = clrecon.read_volume(tmp_path / "ct")
    image = sitk.ReadImage(sorted(map(str, (tmp_path / "ct").iterdir())))
    sitk.WriteImage(image, str(tmp_path / name), useCompression=True)

    converted = clrecon.read_volume(tmp_path / name)

    assert converted.voxels.dtype == series.voxels.dtype
    assert np.array_equal(converted.voxels, series.voxels)
    bound = tolerances.NIFTI_LARGE_AFFINE_MM if name == "s.nii.gz" else tolerances.AFFINE_MM
    assert np.abs(converted.affine - series.affine).max() <= bound


@pytest.mark.parametrize(("slope", "intercept"), [(1.0, -1024.0), (2.0, 0.0), (-1.0, 5.0), (0.1, -3.7), (1.0, 0.5)])
@pytest.mark.parametrize("stored", ["i2", "u2", "f4"])
def test_nifti_with_slope_and_intercept_has_the_values_of_nibabel(tmp_path, slope, intercept, stored):
    path = write_nifti(tmp_path / "a.nii", make_ct(low=0).astype(stored))
    content = bytearray(path.read_bytes())
    scl_slope = slice(112, 120)  # bytes of the header: slope and intercept
    content[scl_slope] = np.array([slope, intercept], "<f4").tobytes()
    path.write_bytes(content)

    volume = clrecon.read_volume(path)

    expected = nibabel.load(path).get_fdata(dtype=np.float64).transpose(2, 1, 0)
    is_whole = bool((expected == np.rint(expected)).all())
    assert volume.voxels.dtype == (np.int16 if is_whole else np.float32)
    assert np.array_equal(volume.voxels, expected.astype(volume.voxels.dtype))
    lowest_and_highest_slope, lowest_and_highest_intercept = (
        [float(np.float32(value))] * 2 for value in (slope, intercept)
    )
    assert volume.report["rescale"] == {
        "slope": lowest_and_highest_slope, "intercept": lowest_and_highest_intercept, "type": None
    }  # fmt: skip


def test_nan_is_read_as_air_with_a_warning_and_its_share(tmp_path):
    voxels = make_ct((4, 6, 7), low=-500).astype(np.float32)
    voxels[0] = np.nan
    voxels[2, 0, 0] = np.nan
    volume = clrecon.read_volume(write_nifti(tmp_path / "a.nii.gz", voxels))
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, np.where(np.isnan(voxels), AIR_HU, voxels))
    assert volume.report["hu_range"][0] == AIR_HU
    assert volume.report["padding_share"] == (6 * 7 + 1) / (4 * 6 * 7)
    assert "43 voxels (25.60 %) are NaN: -1024 HU, air, is taken for them" in volume.report["warnings"]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.inf, "slice 3 of 4 holds infinity"),
        (-np.inf, "slice 3 of 4 holds infinity"),
        (1e300, "slice 3 of 4 goes from .* beyond float32"),
    ],
)
@pytest.mark.parametrize("with_nan", [False, True])
def test_value_beyond_float32_is_refused_with_its_slice(tmp_path, value, message, with_nan):
    voxels = make_ct((4, 6, 7)).astype(np.float64) + 0.5
    voxels[2, 1, 3] = value
    if with_nan:
        voxels[2, 0] = np.nan
    with pytest.raises(RefusedInputError, match=message):
        clrecon.read_volume(write_nrrd(tmp_path / "a.nrrd", voxels))


def test_whole_number_beyond_float32_is_refused_with_its_slice(tmp_path):
    voxels = make_ct((4, 6, 7)).astype(np.float64)
    voxels[2, 1, 3] = 1e300
    with refused(RefusedInputError, "float32", 3, 4):  # slice 3 of 4
        clrecon.read_volume(write_nrrd(tmp_path / "a.nrrd", voxels))


def test_volume_of_nan_alone_is_refused(tmp_path):
    with refused(RefusedInputError, "NaN", "voxels"):
        clrecon.read_volume(write_nrrd(tmp_path / "a.nrrd", np.full((2, 3, 4), np.nan)))


def test_integer_beyond_32_bits_is_refused_with_its_slice(tmp_path):
    voxels = make_ct((4, 6, 7)).astype(np.int64)
    voxels[1, 0, 0] = 2**40
    with refused(RefusedInputError, 2, 4, 32):  # slice 2 of 4, and the bits
        clrecon.read_volume(write_metaimage(tmp_path / "a.mha", voxels))


NOISE = np.random.default_rng(2).random((4, 6, 7))


def warnings_beside_not_dicom(path):
    not_dicom, *warnings = clrecon.read_volume(path).report["warnings"]
    assert not_dicom.startswith("not DICOM")
    return warnings


@pytest.mark.parametrize("low_and_high", [(-1024, 3000), (-200, -20)], ids=["scan", "fat alone"])
def test_values_that_may_be_hu_are_not_warned_of(tmp_path, low_and_high):
    low, high = low_and_high
    assert warnings_beside_not_dicom(write_nifti(tmp_path / "a.nii.gz", make_ct(low=low, high=high))) == []


@pytest.mark.parametrize(
    ("voxels", "words"),
    [
        pytest.param(
            make_ct(low=0, high=4000) + 0.5, "none is below 0: not HU, or HU with an offset", id="none below 0, few"
        ),
        pytest.param(
            make_ct((8, 20, 20), low=0, high=4000), "none is below 0: not HU, or HU with an offset", id="none below 0"
        ),
        pytest.param(NOISE, "normalised, not HU", id="0 to 1"),
        pytest.param(2 * NOISE - 1, "normalised, not HU", id="-1 to 1"),
        pytest.param(make_ct(low=0, high=118), "looks like a label map", id="118 labels"),
        pytest.param(
            (make_ct() > 0).astype(np.uint8),
            "run from 0 to 1 in 2 different whole numbers: this looks like a label map",
            id="mask",
        ),
        pytest.param(
            np.minimum(make_ct((5, 40, 40), high=9000), 3071), "3071 HU, the ceiling of 12 bits", id="saturated"
        ),
    ],
)
def test_values_that_are_hardly_hu_are_warned_of(tmp_path, voxels, words):
    (warning,) = warnings_beside_not_dicom(write_nifti(tmp_path / "a.nii.gz", voxels))
    assert words in warning


@pytest.mark.parametrize("name", WRITERS)
def test_labels_in_the_same_kind_of_file_lie_on_their_volume_exactly(tmp_path, name):
    voxels = make_ct()
    (tmp_path / "labels").mkdir()
    volume = clrecon.read_volume(WRITERS[name](tmp_path / name, voxels, OBLIQUE))
    labels = clrecon.read_labels(WRITERS[name](tmp_path / "labels" / name, (voxels > 200).astype(np.uint8), OBLIQUE))
    on_scan = resample_labels(labels, volume)
    assert np.array_equal(labels.affine, volume.affine)
    assert on_scan.exact
    assert np.array_equal(on_scan.voxels, voxels > 200)


@pytest.mark.parametrize("name", daily(2, ["a.nii.gz", "gzip.nrrd", "packed.mha", "a.mha"]))
@pytest.mark.parametrize("kind", daily(1, ["whole", "fractions", "a fraction at the end"]))
def test_grid_file_is_read_in_the_memory_of_two_volumes(tmp_path, name, kind):
    voxels = np.repeat(make_ct((50, 150, 100)), 3, axis=2).astype(np.float32)
    if kind == "fractions":
        voxels += 0.25
    if kind == "a fraction at the end":
        voxels[-1, -1, -1] += 0.25
    path = WRITERS[name](tmp_path / name, voxels, OBLIQUE)
    clrecon.read_volume(path)  # libraries are loaded
    tracemalloc.start()
    volume = clrecon.read_volume(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak <= 2 * volume.voxels.nbytes


@pytest.fixture(scope="module")
def tilted_torus(tmp_path_factory):
    """A DICOM series of a torus from a tilted gantry, 48 columns wide, as a volume; 250 HU are on its surface."""
    folder = tmp_path_factory.mktemp("torus") / "ct"
    write_phantom(folder, PhantomSettings(kind="torus", size=(48, 44), slices=20, spacing=(0.7, 0.5, 2.5), tilt=12.0))
    return clrecon.read_volume(folder)


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("stored", [np.int16, np.float64])
def test_isosurface_of_a_volume_is_the_same_from_every_kind_of_file(tilted_torus, tmp_path, device, name, stored):
    expected = clrecon.extract_isosurface(tilted_torus, 250, device=device)
    path = WRITERS[name](tmp_path / name, tilted_torus.voxels.astype(stored), tilted_torus.affine)
    mesh = clrecon.extract_isosurface(clrecon.read_volume(path), 250, device=device)
    assert expected.vertex_count > 500  # measured 1542
    assert np.array_equal(mesh.triangles, expected.triangles)
    assert np.abs(mesh.vertices - expected.vertices).max() <= tolerances.FRAME_MM


def test_isosurface_is_the_same_from_a_file_with_its_axes_in_another_order(tilted_torus, tmp_path, device):
    expected = clrecon.extract_isosurface(tilted_torus, 250, device=device)
    reordered = tilted_torus.voxels.transpose(1, 2, 0)[:, ::-1]  # what was i runs down the rows, from the other end
    last_column = tilted_torus.voxels.shape[2] - 1
    reorder = np.array([[0, -1.0, 0, last_column], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    path = write_nrrd(tmp_path / "t.nrrd", reordered, tilted_torus.affine @ reorder)
    mesh = clrecon.extract_isosurface(clrecon.read_volume(path), 250, device=device)
    assert mesh.vertex_count == expected.vertex_count
    assert cKDTree(expected.vertices).query(mesh.vertices)[0].max() <= tolerances.FRAME_MM


@pytest.mark.parametrize("name", ["example_ct.nii.gz", "ct_thorax_1p5mm_cropped.nii.gz"])
def test_real_nifti_is_read_as_nibabel_and_simpleitk_read_it_without_a_warning(real_data, name):
    path = real_data / "thoracolumbar_labels" / name
    volume, of_nibabel = clrecon.read_volume(path), nibabel.load(path)
    assert np.array_equal(volume.voxels, sitk.GetArrayFromImage(sitk.ReadImage(str(path))))
    assert np.array_equal(volume.voxels, np.asarray(of_nibabel.dataobj).transpose(2, 1, 0))
    assert np.allclose(volume.affine, RAS @ of_nibabel.affine, rtol=0, atol=tolerances.NIFTI_AFFINE_MM)
    assert volume.report["warnings"][1:] == []  # the first says that it is not DICOM


def test_real_label_map_read_as_a_volume_is_warned_of(real_data):
    labels = clrecon.read_volume(real_data / "thoracolumbar_labels" / "ct_2mm_labels.nii.gz")
    assert "looks like a label map" in labels.report["warnings"][-1]


def test_real_labels_lie_on_their_nifti_ct_exactly(real_data):
    folder = real_data / "thoracolumbar_labels"
    labels = clrecon.read_labels(folder / "spine_report" / "totalseg.nii.gz")
    volume = clrecon.read_volume(folder / "example_ct.nii.gz")
    assert resample_labels(labels, volume).exact


@pytest.mark.release
@pytest.mark.parametrize("name", ["a.nii.gz", "gzip.nrrd", "packed.mha", "a.mhd"])
def test_real_series_written_in_each_format_is_read_back_as_the_same_volume(real_data, tmp_path, name):
    series = clrecon.read_volume(real_data / "thoracolumbar_labels" / "ct_2mm_jpeg2000")
    back = clrecon.read_volume(WRITERS[name](tmp_path / name, series.voxels, series.affine))
    assert back.voxels.dtype == series.voxels.dtype
    assert np.array_equal(back.voxels, series.voxels)
    assert np.abs(back.affine - series.affine).max() <= tolerances.NIFTI_LARGE_AFFINE_MM
