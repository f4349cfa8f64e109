"""NIfTI label maps: placed as nibabel places them, named as the file names them, refused when they are not sound."""

from __future__ import annotations

import gzip
import struct
import sys
import tracemalloc

import numpy as np
import pytest
import tolerances
from label_files import OBLIQUE, RAS, TABLE, make_labels, write_nifti
from refusals import refused

from clrecon.errors import RefusedInputError, UsageError
from clrecon.labels import read_labels, resample_labels
from clrecon.reading import read_volume

nibabel = pytest.importorskip("nibabel")
HEADER = {"dim": (40, "h", 8), "datatype": (70, "h", 1), "vox_offset": (108, "f", 1), "slope": (112, "f", 1),
          "pixdim": (76, "f", 8), "sform": (280, "f", 12), "sform_code": (254, "h", 1),
          "units": (123, "B", 1)}  # fmt: skip


def overwrite_field(path, field, *values):
    """Overwrite a field of an uncompressed NIfTI-1 header."""
    offset, code, _ = HEADER[field]
    content = bytearray(path.read_bytes())
    struct.pack_into(f"<{len(values)}{code}", content, offset, *values)
    path.write_bytes(content)
    return path


WHOLE_NUMBERS = [*("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")]
"""The types of NIfTI but complex ones, colours, and numbers of 128 bits."""


@pytest.mark.parametrize("kind", ["Nifti1Image", "Nifti2Image"])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
@pytest.mark.parametrize("dtype", WHOLE_NUMBERS)
def test_nifti_of_whole_numbers_of_every_type_is_read_with_its_voxels_and_place(tmp_path, kind, name, dtype):
    voxels = make_labels()
    labels = read_labels(write_nifti(tmp_path / name, voxels, OBLIQUE, dtype=dtype, kind=kind))
    assert np.array_equal(labels.voxels, voxels)
    assert np.abs(labels.affine - OBLIQUE).max() <= tolerances.NIFTI_AFFINE_MM


def test_labels_of_a_nifti_without_names_are_numbered_named_and_counted(tmp_path):
    voxels = make_labels(numbers=(0, 0, 2, 5))
    labels = read_labels(write_nifti(tmp_path / "a.nii", voxels))
    assert labels.numbers == (2, 5)
    assert labels.names == {2: "label_2", 5: "label_5"}
    assert labels.counts == {number: np.count_nonzero(voxels == number) for number in (2, 5)}


def test_voxel_lies_where_nibabel_puts_it_with_x_and_y_reversed(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels())
    ras = nibabel.affines.apply_affine(nibabel.load(path).affine, (1, 2, 3))
    lps = (read_labels(path).affine @ (1, 2, 3, 1))[:3]
    assert np.allclose(lps, ras * (-1, -1, 1), atol=tolerances.NIFTI_AFFINE_MM)


def test_big_endian_nifti_is_read(tmp_path):
    voxels = make_labels()
    header = nibabel.Nifti1Header(endianness=">")
    header.set_data_dtype(">i2")
    nibabel.save(
        nibabel.Nifti1Image(voxels.transpose(2, 1, 0).astype(">i2"), RAS @ OBLIQUE, header), tmp_path / "a.nii"
    )
    assert (tmp_path / "a.nii").read_bytes()[:4] == (348).to_bytes(4, "big")  # the size of the header
    assert np.array_equal(read_labels(tmp_path / "a.nii").voxels, voxels)


def test_labels_have_the_names_of_the_label_table_in_the_header(tmp_path):
    """TABLE names 2 vertebrae_T12 and 5 vertebrae_T1."""
    labels = read_labels(write_nifti(tmp_path / "a.nii.gz", make_labels(numbers=(0, 2, 5, 7)), extension=TABLE))
    assert labels.names == {2: "vertebrae_T12", 5: "vertebrae_T1", 7: "label_7"}
    assert labels.find("T12") == 2


def test_sform_and_qform_that_agree_have_no_warning(tmp_path):
    affine = np.diag((1.0, 1.0, 2.0, 1.0))
    assert read_labels(write_nifti(tmp_path / "a.nii", make_labels(), affine, qform=True)).warnings == ()


def test_sform_is_used_before_a_qform_that_disagrees_with_a_warning(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels(), np.diag((1.0, 1.0, 2.0, 1.0)), qform=True)
    five_mm_to_the_right = (-1, 0, 0, 5), (0, -1, 0, 0), (0, 0, 2, 0)  # in RAS
    overwrite_field(path, "sform", *np.ravel(five_mm_to_the_right))
    labels = read_labels(path)
    assert labels.affine[0, 3] == -5.0
    (warning,) = labels.warnings
    assert "5 mm apart" in warning


def test_map_without_a_sform_is_placed_by_its_qform(tmp_path):
    affine = np.array([[0, -0.5, 0, 3], [0.7, 0, 0, -4], [0, 0, 2.0, 5], [0, 0, 0, 1]])
    labels = read_labels(write_nifti(tmp_path / "a.nii", make_labels(), affine, sform=False, qform=True))
    assert np.abs(labels.affine - affine).max() <= tolerances.NIFTI_AFFINE_MM


def test_nifti_in_metres_is_converted_to_millimetres(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels(), np.diag((1e-3, 1e-3, 2e-3, 1.0)))
    metres = 1
    overwrite_field(path, "units", metres)
    assert read_labels(path).spacing == pytest.approx((1.0, 1.0, 2.0))


def test_numbers_of_a_nifti_are_scaled_by_its_slope_and_intercept(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels(numbers=(0, 2, 5)))
    overwrite_field(path, "slope", 2.0, 1.0)  # and the intercept
    assert read_labels(path).numbers == (1, 5, 11)


def test_nifti_scaled_to_fractions_is_refused_as_a_label_map(tmp_path):
    path = overwrite_field(write_nifti(tmp_path / "a.nii", make_labels()), "slope", 0.5, 0.0)
    with refused(RefusedInputError, 1, 4, 2.5):  # slice 1 of 4 holds 2.5
        read_labels(path)


@pytest.mark.parametrize(
    ("voxels", "message"),
    [
        (np.full((2, 3, 4), 0.5, np.float32), "is not a label map: slice 1 of 2 holds 0.5"),
        (np.full((2, 3, 4), np.nan, np.float32), "is not a label map: slice 1 of 2 holds nan"),
        (np.full((2, 3, 4), np.inf, np.float32), "slice 1 of 2 holds inf; labels run from 0 to 65,535"),
        (np.full((2, 3, 4), -1, np.int16), "slice 1 of 2 holds -1; labels run from 0"),
        (np.full((2, 3, 4), 70_000, np.int32), "holds 70000; labels run"),
        (np.zeros((2, 3, 4), np.uint8), "is empty: no voxel has a label"),
        (np.ones((3, 2, 3, 4), np.uint8), r"has 4 axes \(4 x 3 x 2 x 3\): a label map has three"),
        (np.ones((3, 4), np.uint8), r"has 2 axes \(4 x 3\)"),
        (np.ones((2, 3, 4), np.complex64), "its voxels are complex64"),
    ],
)
def test_nifti_that_is_no_label_map_is_refused_with_what_it_holds(tmp_path, voxels, message):
    with pytest.raises(RefusedInputError, match=message):
        read_labels(write_nifti(tmp_path / "a.nii.gz", voxels))


def test_nifti_with_a_fourth_axis_of_length_one_is_read(tmp_path):
    voxels = make_labels()
    assert np.array_equal(read_labels(write_nifti(tmp_path / "a.nii", voxels[None])).voxels, voxels)


def test_nifti_without_sform_and_qform_is_refused(tmp_path):
    with refused(RefusedInputError, "a.nii", "sform_code"):
        read_labels(write_nifti(tmp_path / "a.nii", make_labels(), sform=False))


@pytest.mark.parametrize(
    ("value", "facts"), [(0.0, ("affine", "a.nii")), (np.nan, ("NaN", "affine"))], ids=["0", "NaN"]
)
def test_nifti_whose_sform_is_all_zeros_or_nan_is_refused(tmp_path, value, facts):
    path = overwrite_field(write_nifti(tmp_path / "a.nii", make_labels()), "sform", *[value] * 12)
    with refused(RefusedInputError, *facts):
        read_labels(path)


@pytest.mark.parametrize("packed", [False, True], ids=["nii", "nii.gz"])
@pytest.mark.parametrize(
    ("field", "values", "message"),
    [
        ("dim", (3, 32767, 32767, 32767, 1, 1, 1, 1), "at most 68,719,476,736 altogether"),
        ("dim", (3, 1600, 1600, 1600, 1, 1, 1, 1), "cannot come from a file of"),
        ("dim", (3, 30000, 30000, 2, 1, 1, 1, 1), "says that a slice has"),
        ("dim", (3, -7, 6, 4, 1, 1, 1, 1), "says that it has -7 x 6 x 4 voxels"),
        ("dim", (300, 7, 6, 4, 1, 1, 1, 1), "corrupt NIfTI header|has 7 axes|axes"),
        ("datatype", (12345,), "corrupt NIfTI header"),
        ("datatype", (128,), "is not a label map"),
        ("vox_offset", (1e9,), "its voxels start at byte 1e[+]09"),
        ("vox_offset", (float("nan"),), "its voxels start at byte nan"),
        ("vox_offset", (0,), "its voxels start at byte 0"),
        ("vox_offset", (4000,), "is cut: it ends in its header"),
    ],
)
def test_nifti_with_an_impossible_header_is_refused_without_taking_memory(tmp_path, field, values, message, packed):
    path = overwrite_field(write_nifti(tmp_path / "a.nii", make_labels()), field, *values)
    if packed:
        (tmp_path / "a.nii.gz").write_bytes(gzip.compress(path.read_bytes()))
        path = tmp_path / "a.nii.gz"

    tracemalloc.start()
    with pytest.raises(RefusedInputError, match=message):
        read_labels(path)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert peak_bytes < tolerances.HEADER_PEAK_BYTES


@pytest.mark.parametrize(
    ("shape", "facts"),
    [
        pytest.param((9, 1000, 1000), (1000, 9, "GiB"), id="9 MB in small slices"),
        pytest.param((1, 20_000, 14_000), (14000, 20000), id="280 MB in one slice"),
    ],
)
def test_small_file_of_zeros_that_would_fill_a_memory_of_a_mib_is_refused(tmp_path, monkeypatch, shape, facts):
    monkeypatch.setattr("clrecon.labels.segments.physical_memory_bytes", lambda: 2**20)
    path = write_nifti(tmp_path / "a.nii.gz", np.zeros(shape, np.uint8))
    with refused(RefusedInputError, *facts):
        read_labels(path)


@pytest.mark.fuzz
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_nifti_map_cut_anywhere_is_refused(tmp_path, name):
    content = write_nifti(tmp_path / name, make_labels((9, 20, 20)), extension=TABLE).read_bytes()
    cut = tmp_path / f"cut-{name}"
    for length in {*range(0, len(content), 41), len(content) - 1, len(content) - 8}:
        cut.write_bytes(content[:length])
        with refused(RefusedInputError, cut.name):
            read_labels(cut)


@pytest.mark.fuzz
def test_nifti_map_damaged_anywhere_in_its_header_is_read_or_refused(tmp_path):
    content = write_nifti(tmp_path / "a.nii", make_labels()).read_bytes()
    random = np.random.default_rng(3)
    trials, header_bytes = 300, 360
    refusals = 0
    for _ in range(trials):
        damaged = np.frombuffer(content, np.uint8).copy()
        damaged[random.integers(0, header_bytes, 3)] = random.integers(0, 256, 3)
        (tmp_path / "b.nii").write_bytes(damaged.tobytes())
        try:
            read_labels(tmp_path / "b.nii")
        except (RefusedInputError, UsageError):
            refusals += 1
    assert 20 < refusals < trials  # some bytes matter, some do not


def test_nifti_with_header_and_voxels_in_two_files_is_read(tmp_path):
    voxels = make_labels()
    nibabel.save(nibabel.Nifti1Pair(voxels.transpose(2, 1, 0), RAS @ OBLIQUE), tmp_path / "a.hdr")
    labels = read_labels(tmp_path / "a.hdr")
    assert np.array_equal(labels.voxels, voxels)
    assert np.abs(labels.affine - OBLIQUE).max() <= tolerances.NIFTI_AFFINE_MM


def test_nifti_header_whose_file_of_voxels_is_missing_is_refused_by_its_name(tmp_path):
    nibabel.save(nibabel.Nifti1Pair(make_labels().transpose(2, 1, 0), RAS @ OBLIQUE), tmp_path / "a.hdr")
    (tmp_path / "a.img").unlink()
    with refused(RefusedInputError, "a.img", "voxels"):
        read_labels(tmp_path / "a.hdr")


def test_nifti_is_refused_with_the_missing_package_where_there_is_no_nibabel(tmp_path, monkeypatch):
    path = write_nifti(tmp_path / "a.nii", make_labels())
    monkeypatch.setitem(sys.modules, "nibabel", None)
    with refused(UsageError, "package", "nibabel"):
        read_labels(path)


@pytest.mark.release
def test_real_labels_with_reversed_rows_lie_on_their_ct(real_data):
    folder = real_data / "thoracolumbar_labels"
    labels = read_labels(folder / "ct_2mm_labels.nii.gz")
    resampled = resample_labels(labels, read_volume(folder / "ct_2mm_jpeg2000"))
    assert resampled.exact
    assert np.array_equal(resampled.voxels, labels.voxels[:, ::-1])


@pytest.mark.release
def test_real_vertebra_t12_has_the_volume_and_mean_hu_that_nibabel_and_numpy_give(real_data):
    folder = real_data / "thoracolumbar_labels"
    labels = read_labels(folder / "ct_2mm_labels.nii.gz")
    volume = read_volume(folder / "ct_2mm_jpeg2000")
    t12 = labels.find("T12")
    voxel_ml = abs(np.linalg.det(labels.affine[:3, :3])) / 1000
    assert labels.counts[t12] * voxel_ml == pytest.approx(44.97, abs=0.005)
    on_scan = resample_labels(labels, volume).voxels
    assert volume.voxels[on_scan == t12].mean() == pytest.approx(267, abs=0.5)


@pytest.mark.parametrize(
    ("file", "first_number", "expected_ml"),
    [
        ("thoracolumbar_labels/spine_report/totalseg.nii.gz", 27, [65.64, 64.96, 63.04, 60.53, 57.86, 47.87]),
        ("vertebra_masks/sub-verse004_seg-vert_msk.nii.gz", 16,
         [28.22, 31.46, 36.27, 41.32, 38.27, 53.73, 58.01, 59.96, 58.23]),
    ],
    ids=["TotalSegmentator", "VerSe"],
)  # fmt: skip
def test_vertebrae_of_real_label_maps_have_their_known_volumes(real_data, file, first_number, expected_ml):
    labels = read_labels(real_data / file)
    voxel_ml = abs(np.linalg.det(labels.affine[:3, :3])) / 1000
    numbers = range(first_number, first_number + len(expected_ml))
    assert [labels.counts[n] * voxel_ml for n in numbers] == pytest.approx(expected_ml, abs=0.02)


def test_entities_of_xml_in_a_label_table_are_decoded_outside_of_cdata_alone(tmp_path):
    table = (
        b'<Label Key="2" Red="0"> a &amp; b</Label><Label Key="5"><![CDATA[c &amp; d]]></Label><Label Key="6"></Label>'
    )
    labels = read_labels(write_nifti(tmp_path / "a.nii", make_labels(), extension=table))
    assert labels.names == {2: "a & b", 5: "c &amp; d"}


def test_names_are_read_from_a_label_table_with_single_quotes(tmp_path):
    table = b"<Label Key='2' Red='0'>two</Label><Label Red='0' Key=\"5\"><![CDATA[it's five]]></Label>"
    labels = read_labels(write_nifti(tmp_path / "a.nii", make_labels(), extension=table))
    assert labels.names == {2: "two", 5: "it's five"}


RIGID = np.array([[0.7, 0.0, 0.0, -10.0], [0.0, 0.5, 0.0, 20.0], [0.0, 0.0, -2.5, -30.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize("sform", [True, False], ids=["sform and qform", "qform"])
def test_nifti_whose_first_pixdim_is_0_lies_where_it_lies_with_1(tmp_path, sform):
    affine = RIGID @ np.diag((1.0, 1.0, -1.0, 1.0))
    path = write_nifti(tmp_path / "a.nii", make_labels(), affine, sform=sform, qform=True)
    before = read_labels(path)
    labels = read_labels(overwrite_field(path, "pixdim", 0.0))
    assert np.array_equal(labels.affine, before.affine)
    assert labels.warnings == ()


def test_corrupt_qform_beside_a_sform_is_warned_of(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels(), RIGID, qform=True)
    before = read_labels(path)
    labels = read_labels(overwrite_field(path, "pixdim", 3.0))
    assert np.array_equal(labels.affine, before.affine)
    assert labels.warnings == ("its qform cannot be read (qfac (pixdim[0]) should be 1 or -1): the sform is used",)


def test_corrupt_qform_without_a_sform_is_refused(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels(), RIGID, qform=True)
    overwrite_field(path, "pixdim", 3.0)
    overwrite_field(path, "sform_code", 0)
    with refused(RefusedInputError, "NIfTI", 0, 1, -1):  # pixdim[0] is 1 or -1
        read_labels(path)
