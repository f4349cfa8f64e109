"""NIfTI label maps: placed as nibabel places them, named as the file names them, refused when they are not sound."""

from __future__ import annotations

import gzip
import struct
import tracemalloc

import numpy as np
import pytest
import tolerances
from label_files import OBLIQUE, RAS, TABLE, make_labels, write_nifti
from refusals import refused

from clrecon.errors import RefusedInputError, UsageError
from clrecon.labels import read_labels

nibabel = pytest.importorskip("nibabel")
HEADER = {"dim": (40, "h", 8), "datatype": (70, "h", 1), "vox_offset": (108, "f", 1), "slope": (112, "f", 1),
          "pixdim": (76, "f", 8), "sform": (280, "f", 12), "sform_code": (254, "h", 1)}  # fmt: skip


def forge(path, field, *values):
    """Overwrite a field of an uncompressed NIfTI-1 header."""
    offset, code, _ = HEADER[field]
    content = bytearray(path.read_bytes())
    struct.pack_into(f"<{len(values)}{code}", content, offset, *values)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("kind", ["Nifti1Image", "Nifti2Image"])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int32", "int64", "float32", "float64"])
def test_whole_numbers_of_every_type_are_read(tmp_path, kind, name, dtype):
    voxels = make_labels()
    labels = read_labels(write_nifti(tmp_path / name, voxels, dtype=dtype, kind=kind))
    assert np.array_equal(labels.voxels, voxels)
    assert np.abs(labels.affine - OBLIQUE).max() <= tolerances.NIFTI_AFFINE_MM
    assert labels.numbers == (2, 5) and labels.names == {2: "label_2", 5: "label_5"}
    assert labels.counts == {n: int((voxels == n).sum()) for n in (2, 5)}


def test_a_voxel_lies_where_nibabel_puts_it_with_x_and_y_turned(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels())
    ras = nibabel.affines.apply_affine(nibabel.load(path).affine, (1, 2, 3))
    lps = (read_labels(path).affine @ (1, 2, 3, 1))[:3]
    assert np.allclose(lps, ras * (-1, -1, 1), atol=tolerances.NIFTI_AFFINE_MM)


def test_big_endian_files_are_read(tmp_path):
    voxels = make_labels()
    header = nibabel.Nifti1Header(endianness=">")
    header.set_data_dtype(">i2")
    image = nibabel.Nifti1Image(voxels.transpose(2, 1, 0).astype(">i2"), RAS @ OBLIQUE, header)
    nibabel.save(image, tmp_path / "a.nii")
    assert (tmp_path / "a.nii").read_bytes()[:4] == b"\0\0\x01\x5c"
    assert np.array_equal(read_labels(tmp_path / "a.nii").voxels, voxels)


def test_names_come_from_the_label_table_of_the_header(tmp_path):
    labels = read_labels(write_nifti(tmp_path / "a.nii.gz", make_labels(numbers=(0, 2, 5, 7)), extension=TABLE))
    assert labels.names == {2: "vertebrae_T12", 5: "vertebrae_T1", 7: "label_7"}
    assert labels.find("T12") == 2 and labels.find("t1") == 5 and labels.find("VERTEBRAE_T1") == 5


def test_the_sform_is_preferred_and_a_disagreement_said(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels(), np.diag((1.0, 1.0, 2.0, 1.0)), qform=True)
    assert read_labels(path).warnings == ()
    forge(path, "sform", -1, 0, 0, 5, 0, -1, 0, 0, 0, 0, 2, 0)
    labels = read_labels(path)
    assert labels.affine[0, 3] == -5.0
    assert "5 mm apart" in labels.warnings[0]


def test_the_qform_places_what_has_no_sform(tmp_path):
    affine = np.array([[0, -0.5, 0, 3], [0.7, 0, 0, -4], [0, 0, 2.0, 5], [0, 0, 0, 1]])
    labels = read_labels(write_nifti(tmp_path / "a.nii", make_labels(), affine, sform=False, qform=True))
    assert np.abs(labels.affine - affine).max() <= tolerances.NIFTI_AFFINE_MM


def test_nifti_in_metres_is_converted_to_millimetres(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels(), np.diag((1e-3, 1e-3, 2e-3, 1.0)))
    content = bytearray(path.read_bytes())
    content[123] = 1
    path.write_bytes(content)
    assert read_labels(path).spacing == pytest.approx((1.0, 1.0, 2.0))


def test_scaled_numbers_are_unscaled(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels())
    assert read_labels(forge(path, "slope", 2.0, 1.0)).numbers == (1, 5, 11)
    with refused(RefusedInputError, 1, 4, 2.5):
        read_labels(forge(path, "slope", 0.5, 0.0))


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
def test_what_is_no_label_map_is_refused(tmp_path, voxels, message):
    with pytest.raises(RefusedInputError, match=message):
        read_labels(write_nifti(tmp_path / "a.nii.gz", voxels))


def test_a_fourth_axis_of_one_is_no_axis(tmp_path):
    voxels = make_labels()
    assert np.array_equal(read_labels(write_nifti(tmp_path / "a.nii", voxels[None])).voxels, voxels)


def test_nifti_map_without_a_position_is_refused(tmp_path):
    with refused(RefusedInputError, "a.nii", "sform_code"):
        read_labels(write_nifti(tmp_path / "a.nii", make_labels(), sform=False))
    with refused(RefusedInputError, "affine", "b.nii"):
        read_labels(forge(write_nifti(tmp_path / "b.nii", make_labels()), "sform", *[0] * 12))
    with refused(RefusedInputError, "NaN", "affine"):
        read_labels(forge(write_nifti(tmp_path / "c.nii", make_labels()), "sform", *[np.nan] * 12))


@pytest.mark.parametrize(
    ("field", "values", "message"),
    [
        ("dim", (3, 32767, 32767, 32767, 1, 1, 1, 1), "at most 4,294,967,296 altogether"),
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
def test_hostile_headers_are_refused_without_taking_memory(tmp_path, field, values, message):
    path = forge(write_nifti(tmp_path / "a.nii", make_labels()), field, *values)
    zipped = tmp_path / "b.nii.gz"
    zipped.write_bytes(gzip.compress(path.read_bytes()))
    for file in (path, zipped):
        tracemalloc.start()
        with pytest.raises(RefusedInputError, match=message):
            read_labels(file)
        assert tracemalloc.get_traced_memory()[1] < 8e6
        tracemalloc.stop()


def test_a_small_file_that_would_fill_the_memory_is_refused(tmp_path, monkeypatch):
    from clrecon.labels import segments

    monkeypatch.setattr(segments, "physical_memory_bytes", lambda: 2**20)
    with refused(RefusedInputError, 1000, 9, "GiB"):
        read_labels(write_nifti(tmp_path / "a.nii.gz", np.zeros((9, 1000, 1000), np.uint8)))
    path = write_nifti(tmp_path / "b.nii.gz", np.zeros((1, 20_000, 14_000), np.uint8))  # 280 MB of zeros
    with refused(RefusedInputError, 14000, 20000):
        read_labels(path)


@pytest.mark.fuzz
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_nifti_map_cut_anywhere_is_refused(tmp_path, name):
    content = write_nifti(tmp_path / name, make_labels((9, 20, 20)), extension=TABLE).read_bytes()
    cut = tmp_path / f"cut-{name}"
    for length in {*range(0, len(content), 41), len(content) - 1, len(content) - 8}:
        cut.write_bytes(content[:length])
        with pytest.raises(RefusedInputError, match="."):
            read_labels(cut)


@pytest.mark.fuzz
def test_nifti_map_damaged_anywhere_is_read_or_refused(tmp_path):
    content = write_nifti(tmp_path / "a.nii", make_labels()).read_bytes()
    random = np.random.default_rng(3)
    refused = 0
    for _ in range(300):
        damaged = np.frombuffer(content, np.uint8).copy()
        damaged[random.integers(0, 360, 3)] = random.integers(0, 256, 3)
        (tmp_path / "b.nii").write_bytes(damaged.tobytes())
        try:
            read_labels(tmp_path / "b.nii")
        except (RefusedInputError, UsageError):
            refused += 1
    assert 20 < refused < 300


def test_header_and_voxels_in_two_files_are_read(tmp_path):
    voxels = make_labels()
    nibabel.save(nibabel.Nifti1Pair(voxels.transpose(2, 1, 0), RAS @ OBLIQUE), tmp_path / "a.hdr")
    labels = read_labels(tmp_path / "a.hdr")
    assert np.array_equal(labels.voxels, voxels)
    assert np.abs(labels.affine - OBLIQUE).max() <= tolerances.NIFTI_AFFINE_MM
    (tmp_path / "a.img").unlink()
    with refused(RefusedInputError, "a.img", "voxels"):
        read_labels(tmp_path / "a.hdr")


def test_missing_nibabel_is_named_with_its_command(tmp_path, monkeypatch):
    path = write_nifti(tmp_path / "a.nii", make_labels())
    monkeypatch.setitem(__import__("sys").modules, "nibabel", None)
    with refused(UsageError, "package"):
        read_labels(path)


@pytest.mark.release
def test_real_labels_lie_on_their_ct(real_data):
    from clrecon.labels import resample_labels
    from clrecon.reading import read_volume

    folder = real_data / "thoracolumbar_labels"
    labels = read_labels(folder / "ct_2mm_labels.nii.gz")
    volume = read_volume(folder / "ct_2mm_jpeg2000")
    taken = resample_labels(labels, volume)
    assert taken.exact and np.array_equal(taken.voxels, labels.voxels[:, ::-1])  # rows run the other way
    t12 = labels.find("T12")
    assert labels.name(t12) == "vertebrae_T12"
    voxel_ml = abs(np.linalg.det(labels.affine[:3, :3])) / 1000
    assert labels.counts[t12] * voxel_ml == pytest.approx(44.97, abs=0.005)
    assert volume.voxels[taken.voxels == t12].mean() == pytest.approx(267, abs=0.5)


@pytest.mark.parametrize(
    ("file", "volumes"),
    [
        ("thoracolumbar_labels/spine_report/totalseg.nii.gz", [65.64, 64.96, 63.04, 60.53, 57.86, 47.87]),
        ("vertebra_masks/sub-verse004_seg-vert_msk.nii.gz",
         [28.22, 31.46, 36.27, 41.32, 38.27, 53.73, 58.01, 59.96, 58.23]),
    ],
)  # fmt: skip
def test_real_labels_have_their_volumes(real_data, file, volumes):
    labels = read_labels(real_data / file)
    voxel_ml = abs(np.linalg.det(labels.affine[:3, :3])) / 1000
    numbers = range(27, 33) if len(volumes) == 6 else range(16, 25)
    assert [labels.counts[n] * voxel_ml for n in numbers] == pytest.approx(volumes, abs=0.02)


def test_marks_of_xml_are_read_outside_of_cdata_alone(tmp_path):
    table = (
        b'<Label Key="2" Red="0"> a &amp; b</Label><Label Key="5"><![CDATA[c &amp; d]]></Label><Label Key="6"></Label>'
    )
    labels = read_labels(write_nifti(tmp_path / "a.nii", make_labels(), extension=table))
    assert labels.names == {2: "a & b", 5: "c &amp; d"}


def test_label_tables_may_have_single_quotes(tmp_path):
    table = b"<Label Key='2' Red='0'>two</Label><Label Red='0' Key=\"5\"><![CDATA[it's five]]></Label>"
    labels = read_labels(write_nifti(tmp_path / "a.nii", make_labels(), extension=table))
    assert labels.names == {2: "two", 5: "it's five"}


RIGID = np.array([[0.7, 0.0, 0.0, -10.0], [0.0, 0.5, 0.0, 20.0], [0.0, 0.0, -2.5, -30.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.mark.parametrize("sform", [True, False])
def test_first_pixdim_of_0_counts_as_1(tmp_path, sform):
    affine = RIGID @ np.diag((1.0, 1.0, -1.0, 1.0))
    path = write_nifti(tmp_path / "a.nii", make_labels(), affine, sform=sform, qform=True)
    before = read_labels(path)
    labels = read_labels(forge(path, "pixdim", 0.0))
    assert np.array_equal(labels.affine, before.affine) and labels.warnings == ()


def test_a_qform_that_is_corrupt_is_said_beside_a_sform(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_labels(), RIGID, qform=True)
    before = read_labels(path)
    labels = read_labels(forge(path, "pixdim", 3.0))
    assert np.array_equal(labels.affine, before.affine)
    (said,) = labels.warnings
    assert said == "its qform cannot be read (qfac (pixdim[0]) should be 1 or -1): the sform is used"
    with refused(RefusedInputError, "NIfTI", 0, 1, -1):
        read_labels(forge(path, "sform_code", 0))
