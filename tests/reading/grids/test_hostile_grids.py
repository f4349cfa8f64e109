"""Grid files by strangers: cut, damaged, lying about sizes, without a position, pointing elsewhere."""

from __future__ import annotations

import os
import subprocess
import sys
import tracemalloc

import numpy as np
import pytest
import tolerances
from label_files import OBLIQUE, write_nifti, write_nrrd
from refusals import assert_one_line, refused
from variants import daily
from volume_files import WRITERS, make_ct, write_metaimage

import clrecon
from clrecon.errors import ClreconError, RefusedInputError
from clrecon.reading.grids.metaimage import UNUSED_NUMBERS

nibabel = pytest.importorskip("nibabel")
nrrd = pytest.importorskip("nrrd")
pytest.importorskip("SimpleITK")


def replace_in_header(path, old, new):
    """Replace text in a header that is text."""
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))
    return path


XYZT_UNITS, THIRD_PIXDIM, SROW_X_OFFSET = 123, 88, 292
"""Bytes of fields in a header of NIfTI-1."""


def overwrite(path, start, field):
    """Overwrite the bytes of a field of a file, from its start."""
    content = bytearray(path.read_bytes())
    content[start : start + len(field)] = field
    path.write_bytes(content)


@pytest.mark.fuzz
@pytest.mark.parametrize("name", daily(4, WRITERS))
def test_grid_file_cut_anywhere_is_refused(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct((6, 12, 12)), OBLIQUE)
    beside = [other for other in tmp_path.iterdir() if other != path]
    for part in (path, *beside):
        content = part.read_bytes()
        # without its last line breaks the header of an .mhd or .nhdr still says everything
        for length in {*range(0, len(content), 29), len(content) - (4 if part.suffix in (".mhd", ".nhdr") else 1)}:
            part.write_bytes(content[:length])
            with pytest.raises(ClreconError) as caught:
                clrecon.read_volume(path)
            # An empty file is no file of this kind; others begin at 29 bytes.
            assert type(caught.value) is RefusedInputError or length == 0, (part.name, length)
        part.write_bytes(content)
    assert clrecon.read_volume(path).voxels.shape == (6, 12, 12)


@pytest.mark.fuzz
@pytest.mark.parametrize("name", daily(2, ["a.nii.gz", "gzip.nrrd", "packed.mha", "packed.mhd"]))
def test_grid_file_with_a_damaged_byte_of_compressed_voxels_is_refused(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct((6, 12, 12)), OBLIQUE)
    part = path.with_suffix(".zraw") if path.suffix == ".mhd" else path
    content = part.read_bytes()
    for at in range(len(content) - 1200, len(content) - 10, 13):  # the compressed voxels are longer than that
        damaged = bytearray(content)
        damaged[at] ^= 0x5A
        part.write_bytes(damaged)
        with refused(RefusedInputError, "corrupt"):
            clrecon.read_volume(path)


@pytest.mark.fuzz
@pytest.mark.parametrize("name", ["a.nii", "raw.nrrd"])
def test_grid_file_with_a_damaged_header_is_read_or_refused(tmp_path, name):
    content = WRITERS[name](tmp_path / name, make_ct(), OBLIQUE).read_bytes()
    random = np.random.default_rng(5)
    trials, header_bytes = 200, 350
    refusals = 0
    for _ in range(trials):
        damaged = bytearray(content)
        for position in random.integers(0, header_bytes, size=2):
            damaged[position] = random.integers(0, 256)
        (tmp_path / "b").write_bytes(damaged)
        try:
            clrecon.read_volume(tmp_path / "b")
        except ClreconError:
            refusals += 1
    assert 20 < refusals < trials  # some bytes matter, some do not


MUTATE = """
import sys
import numpy as np
import clrecon
from clrecon.errors import ClreconError
content = open(sys.argv[1], "rb").read()
head = content.index(b"LOCAL")
random = np.random.default_rng(7)
words = [b"100000", b"-1", b"nan", b"=", b"\\n", b"1e999", b"0", b" 1", b"x" * 300, b"LIST", b"NDims", b"MET_INT"]
read = 0
for _ in range(400):
    damaged = bytearray(content)
    for _ in range(random.integers(1, 3)):
        at = int(random.integers(0, head + 6))
        damaged[at : at + int(random.integers(0, 4))] = words[random.integers(len(words))]
    open(sys.argv[2], "wb").write(damaged)
    try:
        clrecon.read_volume(sys.argv[2])
        read += 1
    except ClreconError:
        pass
print("read", read)
"""


@pytest.mark.fuzz
def test_metaimage_with_a_damaged_header_never_ends_the_process(tmp_path):
    path = write_metaimage(tmp_path / "a.mha", make_ct())
    process = subprocess.run(
        [sys.executable, "-c", MUTATE, str(path), str(tmp_path / "b.mha")], capture_output=True, text=True, timeout=120
    )
    assert process.returncode == 0, process.stderr[-2000:]
    files_read = int(process.stdout.split()[-1])
    assert 10 < files_read < 300  # of 400: some changes do no harm, as in comments, or one digit for another


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("NDims", "100000", "NDims is '100000', expected a volume has three axes"),
        ("NDims", "2", "NDims is '2'"),
        ("NDims", None, "is no NIfTI|NDims is missing"),
        ("DimSize", "7 6", "DimSize is '7 6', expected 3 finite numbers"),
        ("DimSize", "7 6 4000", "cannot come from a file of"),
        ("DimSize", "70000 60000 40000", "at most 68,719,476,736"),
        ("DimSize", "7 6 -4", "DimSize is '7 6 -4'"),
        ("DimSize", "7 6 1.5", "whole numbers from 1"),
        ("ElementType", "MET_SHORT_ARRAY", "one real number a voxel"),
        ("ElementType", "MET_STRING", "one real number a voxel"),
        ("ElementNumberOfChannels", "3", "ElementNumberOfChannels is '3', expected 1"),
        ("ElementSpacing", None, "ElementSpacing is missing, expected 3 finite numbers: it does not say where it lies"),
        ("ElementSpacing", "0.7 -0.5 2", "steps above 0 mm"),
        ("ElementSpacing", "0.7 nan 2", "expected 3 finite numbers"),
        ("ElementSpacing", "0.7 1e999 2", "expected 3 finite numbers"),
        ("Offset", None, "Offset is missing, expected 3 finite numbers: it does not say where it lies"),
        ("TransformMatrix", None, "TransformMatrix is missing, expected 9 finite numbers: it does not say where"),
        ("TransformMatrix", "1 0 0 1 0 0 0 0 1", "cannot read its header|cannot be placed"),
        ("Origin", "0 0 0", "says Offset and Origin"),
        ("offset", "0 0 0", "says offset twice"),
        ("HeaderSize", "-1", "HeaderSize is '-1', expected 0"),
        ("BinaryData", "False", "voxels written as text are not read"),
        ("CompressedData", "Maybe", "expected True or False"),
        ("CompressedData", "True", "cut or corrupt in slice 1 of 4"),
        ("DistanceUnits", "inch", "DistanceUnits is 'inch', expected mm, cm or um"),
        ("ElementToIntensityFunctionSlope", "2", "expected 1"),
        ("CenterOfRotation", "1e9990 0", "CenterOfRotation is '1e9990 0', expected 3 finite numbers"),
        ("ElementSize", "1 1", "expected 3 finite numbers"),
        ("Color", "1 0 0", "Color is '1 0 0', expected 4 finite numbers"),
        ("CompressedDataSize", "z", "CompressedDataSize is 'z', expected a finite number"),
        ("ObjectType", "Scene", "ObjectType is 'Scene', expected Image"),
        ("Comment", "x" * 5000, "does not end|no line 'ElementDataFile"),
        ("ElementDataFile", "../a.raw", "voxels are in '../a.raw': only files beside it are read"),
        ("ElementDataFile", "/etc/passwd", "'/etc/passwd': only files beside it"),
        ("ElementDataFile", "C:\\a.raw", "only files beside it"),
        ("ElementDataFile", "sub\\..\\..\\a.raw", "only files beside it"),
        ("ElementDataFile", "LIST", "expected LOCAL or one file, not several"),
        ("ElementDataFile", "a%03d.raw 1 4 1", "expected LOCAL or one file, not several"),
        ("ElementDataFile", "none.raw", "'none.raw', which is not there"),
        ("ElementDataFile", "folder", "'folder', which is no regular file"),
        ("ElementDataFile", "pipe", "'pipe', which is no regular file"),
        ("ElementDataFile", "link", "'link', a link to another folder"),
        ("ElementDataFile", "", "expected LOCAL or one file"),
    ],
)  # fmt: skip
def test_metaimage_with_an_impossible_field_is_refused(tmp_path, capfd, key, value, message):
    folder = tmp_path / "here"
    folder.mkdir()
    (folder / "folder").mkdir()
    os.mkfifo(folder / "pipe")
    (tmp_path / "secret").write_bytes(bytes(1000))
    (folder / "link").symlink_to(tmp_path / "secret")
    path = write_metaimage(folder / "a.mha", make_ct((4, 6, 7)), **{key: value})  # None leaves a field out
    with pytest.raises(RefusedInputError, match=message):
        clrecon.read_volume(path)
    if key in UNUSED_NUMBERS:  # the library was not asked
        assert capfd.readouterr().err == ""


def test_metaimage_in_micrometres_is_read_in_mm(tmp_path):
    in_um = np.diag((1e3, 1e3, 1e3, 1.0)) @ OBLIQUE
    volume = clrecon.read_volume(write_metaimage(tmp_path / "a.mha", make_ct(), in_um, DistanceUnits="um"))
    assert np.allclose(volume.affine, OBLIQUE, atol=tolerances.DECIMAL_PLACE_MM)


def test_nrrd_in_micrometres_is_read_in_mm(tmp_path):
    in_um = np.diag((1e3, 1e3, 1e3, 1.0)) @ OBLIQUE
    volume = clrecon.read_volume(write_nrrd(tmp_path / "a.nrrd", make_ct(), in_um, **{"space units": ["um"] * 3}))
    assert np.allclose(volume.affine, OBLIQUE, atol=tolerances.DECIMAL_PLACE_MM)


def test_nrrd_in_an_unknown_unit_is_refused(tmp_path):
    path = write_nrrd(tmp_path / "b.nrrd", make_ct(), **{"space units": ["mm", "mm", "parsec"]})
    with refused(RefusedInputError, "b.nrrd", "unknown"):
        clrecon.read_volume(path)


@pytest.mark.parametrize(
    ("code", "mm", "is_plausible"),
    [(1, 1000.0, False), (3, 1e-3, False), (0, 1.0, True)],
    ids=["metres", "micrometres", "unknown: mm"],
)
def test_nifti_is_read_in_mm_with_a_warning_of_spacings_that_no_scanner_has(tmp_path, code, mm, is_plausible):
    path = write_nifti(tmp_path / "a.nii", make_ct(), np.diag((2.0, 3.0, 4.0, 1.0)))
    overwrite(path, XYZT_UNITS, bytes([code]))
    volume = clrecon.read_volume(path)
    assert volume.spacing == pytest.approx((2 * mm, 3 * mm, 4 * mm))
    is_warned_of = any("spacings that no scanner has" in text for text in volume.report["warnings"])
    assert is_warned_of is not is_plausible


def test_metaimage_that_does_not_say_its_byte_order_is_read_with_a_warning(tmp_path):
    voxels = make_ct()
    volume = clrecon.read_volume(write_metaimage(tmp_path / "a.mha", voxels, BinaryDataByteOrderMSB=None))
    assert np.array_equal(volume.voxels, voxels)
    _not_dicom, warning = volume.report["warnings"]
    assert "byte order is not said" in warning


@pytest.mark.parametrize("field", ["ElementMin =", "ImagePosition = 1"])
def test_metaimage_with_a_field_of_too_few_numbers_before_its_spacing_is_refused(tmp_path, field):
    """SimpleITK takes the name of the next field for a number, and 1 mm for the spacing that it then does not see."""
    path = write_metaimage(tmp_path / "a.mha", make_ct())
    replace_in_header(path, b"ElementSpacing", f"{field}\nElementSpacing".encode())
    with refused(RefusedInputError, "a.mha", "two", "ways"):
        clrecon.read_volume(path)


def write_points_in_time(folder, extension, points):
    """A file of four axes: `points` volumes of 7 x 6 x 4 voxels; and the voxels."""
    voxels = np.stack([make_ct(seed=n) for n in range(points)])
    path = folder / f"a{extension}"
    if extension == ".nii.gz":
        return write_nifti(path, voxels, np.eye(4)), voxels
    if extension == ".nrrd":
        axes = np.vstack([np.eye(3), np.full((1, 3), np.nan)])
        header = {"space": "left-posterior-superior", "space origin": np.zeros(3), "space directions": axes,
                  "kinds": ["domain"] * 3 + ["time"]}  # fmt: skip
        nrrd.write(str(path), voxels.transpose(3, 2, 1, 0), header)
        return path, voxels
    fields = {
        "NDims": "4", "DimSize": f"7 6 4 {points}", "ElementSpacing": "1 1 1 1", "Offset": "0 0 0 0",
        "TransformMatrix": "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "CenterOfRotation": "0 0 0 0",
    }  # fmt: skip
    return write_metaimage(path, voxels.reshape(4 * points, 6, 7), np.eye(4), **fields), voxels


@pytest.mark.parametrize("extension", [".nii.gz", ".nrrd", ".mha"])
def test_grid_file_of_one_point_in_time_is_read_as_its_volume(tmp_path, extension):
    path, voxels = write_points_in_time(tmp_path, extension, points=1)
    assert np.array_equal(clrecon.read_volume(path).voxels, voxels[0])


@pytest.mark.parametrize("extension", [".nii.gz", ".nrrd", ".mha"])
def test_grid_file_of_five_points_in_time_is_refused(tmp_path, extension):
    path, _ = write_points_in_time(tmp_path, extension, points=5)
    with refused(RefusedInputError, 7, 6, 4, 5):  # voxels along each axis, and points in time
        clrecon.read_volume(path)


def test_nifti_of_colours_is_refused(tmp_path):
    colours = np.zeros((7, 6, 4), dtype=[("R", "u1"), ("G", "u1"), ("B", "u1")])
    nibabel.save(nibabel.Nifti1Image(colours, np.eye(4)), tmp_path / "a.nii")
    with refused(RefusedInputError, "volume", "voxels", "a.nii"):
        clrecon.read_volume(tmp_path / "a.nii")


@pytest.mark.parametrize(
    ("channels", "header"),
    [(3, {"kinds": ["RGB-color"] + ["domain"] * 3}), (2, {})],
    ids=["colours", "two values a voxel"],
)
def test_nrrd_of_several_values_a_voxel_is_refused(tmp_path, channels, header):
    path = write_nrrd(tmp_path / "a.nrrd", np.zeros((4, 6, 7, channels), np.uint8), **header)
    with refused(RefusedInputError, 4, "axes"):  # the values of a voxel are the fourth
        clrecon.read_volume(path)


@pytest.mark.parametrize("name", WRITERS)
def test_grid_file_of_a_single_slice_is_refused(tmp_path, name):
    path = WRITERS[name](tmp_path / name, make_ct((1, 6, 7)), OBLIQUE)
    with refused(RefusedInputError, 7, 6, 1):  # voxels
        clrecon.read_volume(path)


def test_nrrd_with_a_field_without_its_value_is_refused(tmp_path):
    path = replace_in_header(write_nrrd(tmp_path / "a.nrrd", make_ct()), b"space origin: ", b"space origin: \n#")
    with refused(RefusedInputError, "NRRD", "header"):
        clrecon.read_volume(path)


def test_nifti_without_a_position_is_refused(tmp_path):
    with refused(RefusedInputError, "a.nii", "sform_code"):
        clrecon.read_volume(write_nifti(tmp_path / "a.nii", make_ct(), sform=False))


def test_nrrd_without_a_frame_is_refused(tmp_path):
    path = replace_in_header(write_nrrd(tmp_path / "a.nrrd", make_ct()), b"space: left-posterior-superior\n", b"")
    with refused(RefusedInputError, "a.nrrd", "lies"):
        clrecon.read_volume(path)


def test_analyze_file_is_refused(tmp_path):
    nibabel.save(nibabel.AnalyzeImage(make_ct().transpose(2, 1, 0), np.eye(4)), tmp_path / "a.hdr")
    with refused(RefusedInputError, "Analyze"):
        clrecon.read_volume(tmp_path / "a.hdr")


def test_file_of_voxels_of_a_nifti_pair_is_refused_without_its_header(tmp_path):
    WRITERS["a.hdr"](tmp_path / "a.hdr", make_ct(), OBLIQUE)
    with refused(RefusedInputError, "NIfTI"):
        clrecon.read_volume(tmp_path / "a.img")


def test_nifti_pair_whose_voxels_are_a_link_to_another_folder_is_refused(tmp_path):
    (tmp_path / "in").mkdir()
    path = WRITERS["a.hdr"](tmp_path / "in" / "a.hdr", make_ct(), OBLIQUE)
    (tmp_path / "in" / "a.img").rename(tmp_path / "a.img")
    (tmp_path / "in" / "a.img").symlink_to(tmp_path / "a.img")
    with refused(RefusedInputError, "a.img", "a.hdr"):
        clrecon.read_volume(path)


def test_pixdim_other_than_the_spacing_of_the_sform_is_not_used_and_warned_of(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_ct(), OBLIQUE)
    overwrite(path, THIRD_PIXDIM, np.float32(5).tobytes())
    volume = clrecon.read_volume(path)
    assert volume.spacing == pytest.approx(np.linalg.norm(OBLIQUE[:3, :3], axis=0))
    _not_dicom, warning = volume.report["warnings"]
    di, dj, _ = volume.spacing
    assert f"pixdim says a spacing of {di:.4f} x {dj:.4f} x 5 mm, the affine" in warning


@pytest.mark.parametrize(
    ("name", "key"),
    [("raw.nrrd", b"sizes: "), ("a.mha", b""), ("packed.mha", b"")],
    ids=["NRRD", "MetaImage", "packed"],
)
def test_grid_file_of_6_slices_whose_header_says_3_is_refused(tmp_path, name, key):
    path = WRITERS[name](tmp_path / name, make_ct((6, 40, 40)), OBLIQUE)
    replace_in_header(path, key + b"40 40 6", key + b"40 40 3")
    with refused(RefusedInputError, "header", "numbers"):
        clrecon.read_volume(path)


def test_sform_of_a_volume_is_used_before_a_qform_that_differs_with_a_warning(tmp_path):
    path = write_nifti(tmp_path / "a.nii", make_ct(), np.diag((1.0, 1.0, 2.0, 1.0)), qform=True)
    overwrite(path, SROW_X_OFFSET, np.float32(5).tobytes())
    volume = clrecon.read_volume(path)
    assert volume.affine[0, 3] == -5.0  # x of LPS
    assert "sform and qform lie 5 mm apart: the sform is used" in volume.report["warnings"]


def test_small_file_that_would_fill_the_memory_is_refused_without_taking_it(tmp_path, monkeypatch):
    path = write_nifti(tmp_path / "a.nii.gz", np.zeros((60, 400, 400), np.int16))  # 19 MB
    assert path.stat().st_size < 100_000  # measured 83,937
    monkeypatch.setattr("clrecon.system.memory.available_memory_bytes", lambda: 2**20)

    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    tracemalloc.reset_peak()
    with refused(RefusedInputError, "a.nii.gz", 400, 60, "GiB"):
        clrecon.read_volume(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert peak - before < tolerances.GRID_REFUSAL_BYTES


def test_name_and_comment_of_a_file_are_not_in_the_report(tmp_path):
    path = write_metaimage(tmp_path / "Jane\x1b[31mDoe.mha", make_ct(), Comment="Doe^Jane\x1b]0;x")
    assert "Doe" not in repr(clrecon.read_volume(path).report)
    assert "Doe" not in repr(clrecon.list_series(path))


def test_refusal_of_a_file_whose_name_and_field_have_control_characters_is_one_printable_line(tmp_path):
    path = write_metaimage(tmp_path / "Jane\x1b[31mDoe.mha", make_ct(), ElementSpacing="\x1b[31m")
    with pytest.raises(RefusedInputError) as refusal:
        clrecon.read_volume(path)
    assert_one_line(refusal.value)
