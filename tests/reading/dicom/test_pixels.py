"""Stored bits to HU: rescale, padding, sign, width, and every transfer syntax."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
import tolerances
from dicom_series import Plan, make_dataset, save_dataset, set_raw, set_values, write_series
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
)
from refusals import refused
from stored_pixels import set_pixels
from variants import daily

from clrecon.errors import NoDicomError, RefusedInputError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.pixels import stored
from clrecon.system import memory

SYNTAXES = "transfer_syntaxes"
LOSSLESS = ["1.2.2", "1.2.1.99", "4.90", "4.80", "4.70", "4.57", "1.2.1", "1.2", "1.2.5"]


@pytest.mark.parametrize(
    "syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian]
)
def test_native_transfer_syntaxes_give_the_same_hu(tmp_path, syntax):
    plan = Plan(syntax=syntax)
    for k in range(plan.shape[0]):
        ds = make_dataset(plan, k)
        if syntax == ExplicitVRBigEndian:
            ds.PixelData = plan.stored(k).byteswap().tobytes()
        save_dataset(ds, tmp_path / plan.name(k))
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["transfer_syntaxes"] == [str(syntax)]
    assert volume.report["hu_range"] == [plan.hu().min(), plan.hu().max()]


def test_slices_with_a_header_of_200_kb_are_read(tmp_path):
    """More than the 16 KiB that are read first."""
    plan = write_series(tmp_path, change=lambda ds, k: ds.add_new(0x00420011, "OB", bytes(200_000)))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


def test_slices_with_a_sequence_of_undefined_length_and_200_kb_are_read(tmp_path):
    def spoil(ds, k):
        item = pydicom.Dataset()
        item.add_new(0x00420011, "OB", bytes(200_000))
        ds.add_new(0x00081140, "SQ", [item])
        ds[0x00081140].is_undefined_length = item.is_undefined_length_sequence_item = True

    plan = write_series(tmp_path, change=spoil)
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


def test_each_slice_is_rescaled_by_its_own_slope_and_intercept(tmp_path):
    plan = write_series(tmp_path, change=lambda ds, k: set_values(RescaleSlope=k + 1, RescaleIntercept=-10 * k)(ds, k))
    volume = read_volume(tmp_path)
    expected = np.stack([plan.stored(k).astype(int) * (k + 1) - 10 * k for k in range(7)])
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, expected)
    lowest_and_highest_slope, lowest_and_highest_intercept = [1.0, 7.0], [-60.0, 0.0]
    assert volume.report["rescale"] == {
        "slope": lowest_and_highest_slope, "intercept": lowest_and_highest_intercept, "type": "HU"
    }  # fmt: skip


def test_hu_too_wide_for_16_bits_are_read_as_32(tmp_path):
    plan = write_series(tmp_path, Plan(slope=30, intercept=0))
    volume = read_volume(tmp_path)
    assert plan.hu().max() > np.iinfo(np.int16).max
    assert volume.voxels.dtype == np.int32
    assert np.array_equal(volume.voxels, plan.hu())


def test_hu_by_a_slope_with_a_fraction_are_read_as_float32(tmp_path):
    plan = write_series(tmp_path, change=set_values(RescaleSlope=0.25))
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.float32
    assert np.array_equal(volume.voxels, (plan.hu() + 1024) * 0.25 - 1024)


@pytest.mark.parametrize(
    ("intercept", "dtype"), [(-32768, np.int16), (0, np.int32)], ids=["HU within 16 bits", "HU beyond"]
)
def test_unsigned_values_beyond_32767_are_read_in_the_type_that_holds_their_hu(tmp_path, intercept, dtype):
    plan = Plan(signed=False, intercept=intercept)
    write_series(tmp_path, plan, set_pixels(lambda array, k: array.view(np.uint16) + 50_000))
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == dtype
    assert np.array_equal(volume.voxels, plan.hu() + 50_000)


def test_signed_values_of_twelve_bits_are_read_under_overlay_bits(tmp_path):
    def put_overlay_into_upper_bits(array, k):
        values = array - 1000  # from -100 on: both signs
        return (values & 0x0FFF) | 0x5000

    plan = Plan(bits_stored=12)
    write_series(tmp_path, plan, set_pixels(put_overlay_into_upper_bits))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu() - 1000)


def test_values_of_twelve_bits_that_do_not_start_at_bit_zero_are_shifted(tmp_path):
    plan = Plan(bits_stored=12, signed=False)
    write_series(tmp_path, plan, set_pixels(lambda array, k: (array << 4) | 0x9, HighBit=15))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.parametrize(("bits", "dtype"), [(8, "u1"), (32, "i4")], ids=["8", "32"])
def test_pixels_of_8_and_32_bits_are_read(tmp_path, bits, dtype):
    plan = Plan(shape=(7, 5, 6), signed=bits == 32)
    make = set_pixels(
        lambda array, k: (array % 200).astype(dtype), BitsAllocated=bits, BitsStored=bits, HighBit=bits - 1
    )
    write_series(tmp_path, plan, make)
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, (plan.hu() + 1024) % 200 - 1024)


@pytest.mark.parametrize(
    ("padding", "limit", "signed"),
    [(-2000, None, True), (63536, None, True), (-2000, -1990, True), (-1990, -2000, True), (63536, None, False)],
    ids=["signed", "as unsigned", "range", "range turned round", "unsigned"],
)
def test_declared_padding_is_read_as_air_however_it_is_written(tmp_path, padding, limit, signed):
    def pad(array, k):
        array[0, :3] = -2000
        if limit is not None:
            array[0, 1] = -1995
        return array

    def change(ds, k):
        set_pixels(pad)(ds, k)
        ds.add_new("PixelPaddingValue", "SS" if padding < 0 else "US", padding)
        if limit is not None:
            ds.add_new("PixelPaddingRangeLimit", "SS", limit)

    plan = Plan(shape=(7, 5, 6), signed=signed)
    write_series(tmp_path, plan, change)
    volume = read_volume(tmp_path)
    expected = plan.hu()
    expected[:, 0, :3] = -1024
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, expected)
    assert volume.report["padding_share"] == pytest.approx(3 / (5 * 6))
    assert volume.report["hu_range"] == [-1024, expected.max()]


def test_slice_of_padding_alone_is_read_as_air(tmp_path):
    change = set_pixels(lambda array, k: array * 0 - 2000 if k == 2 else array, PixelPaddingValue=-2000)
    plan = write_series(tmp_path, change=change)
    volume = read_volume(tmp_path)
    expected = plan.hu()
    expected[2] = -1024
    assert np.array_equal(volume.voxels, expected)
    assert volume.report["padding_share"] == pytest.approx(1 / 7)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_values(PhotometricInterpretation="MONOCHROME1"), "MONOCHROME1: meant to be shown inverted"),
        (set_values(RescaleType="US"), "RescaleType is 'US': the values are not HU (all slices)"),
        (set_values(LossyImageCompression="01"), "lossy compression: the values are not those that were measured"),
        (set_values(RescaleType="DOE^JOHN"), "RescaleType is 'other': the values are not HU (all slices)"),
        (set_values(only=2, RescaleType="OD"), "RescaleType is 'OD': the values are not HU (1 of 7 slices, at -397.5"),
    ],
    ids=["MONOCHROME1", "RescaleType", "lossy", "free text", "one slice"],
)
def test_doubtful_values_are_kept_with_a_warning(tmp_path, change, words):
    plan = write_series(tmp_path, change=change)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert words in volume.report["warnings"][0]
    assert list_series(tmp_path).series[0].warnings == volume.report["warnings"]


def test_values_without_a_rescale_are_kept_with_a_warning(tmp_path):
    plan = write_series(tmp_path, change=set_values(RescaleSlope=None, RescaleIntercept=None))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu() + 1024)
    assert "maybe not HU" in volume.report["warnings"][0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            set_values(PhotometricInterpretation="RGB", SamplesPerPixel=3),
            "PhotometricInterpretation (0028,0004) is RGB",
        ),
        (
            set_values(PhotometricInterpretation="PALETTE COLOR"),
            "PhotometricInterpretation (0028,0004) is PALETTE COLOR with 1 samples",
        ),
        (set_values(BitsAllocated=12), "BitsAllocated (0028,0100) is 12, expected 8, 16 or 32"),
        (set_values(BitsStored=17), "BitsStored (0028,0101) is 17, expected 1 to 16"),
        (set_values(HighBit=3), "HighBit (0028,0102) is 3, expected 15 to 15"),
        (set_values(PixelRepresentation=2), "PixelRepresentation (0028,0103) is 2, expected 0 or 1"),
        (set_values(PixelRepresentation=None), "PixelRepresentation (0028,0103) is missing or empty"),
        (set_values(Rows=0), "Rows (0028,0010) x Columns (0028,0011) is 0 x 6"),
        (
            set_values(Rows=65535, Columns=65535),
            "truncated: 8589672450 bytes of pixels expected (65535 x 65535 x 16 bit)",
        ),
        (set_raw("NumberOfFrames", "2147483647"), "multi-frame image of 2147483647 frames, SOP class 1.2.840."),
    ],
)
def test_image_that_is_no_ct_slice_is_refused_with_its_element(tmp_path, change, words):
    write_series(tmp_path, change=change)
    with pytest.raises(RefusedInputError) as caught:
        read_volume(tmp_path)
    assert f"slice000.dcm: {words}" in str(caught.value)


def test_slice_whose_pixels_are_cut_is_refused_with_its_name_and_size(tmp_path):
    write_series(tmp_path)
    file = tmp_path / "slice003.dcm"
    file.write_bytes(file.read_bytes()[:-10])
    rows, columns, expected_bytes = 5, 6, 5 * 6 * 2
    with refused(RefusedInputError, "slice003.dcm", expected_bytes, columns, rows):
        read_volume(tmp_path)


@pytest.mark.fault_row(39)
def test_series_that_does_not_fit_into_memory_is_refused_with_its_size(tmp_path, monkeypatch):
    plan = write_series(tmp_path)
    monkeypatch.setattr(memory, "available_memory_bytes", lambda: 100.0)
    slices, rows, columns = plan.shape
    with refused(RefusedInputError, columns, rows, slices):
        read_volume(tmp_path)


def test_available_memory_is_more_than_10_mb_and_no_more_than_there_is():
    assert 1e7 < memory.available_memory_bytes() <= memory.physical_memory_bytes()


@pytest.mark.fault_row(38)
def test_deflated_slices_far_larger_than_their_files_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(stored, "INFLATED_LIMIT", 1_000_000)
    plan = Plan(syntax=DeflatedExplicitVRLittleEndian)
    for k in range(2):
        ds = make_dataset(plan, k)
        ds.Rows = ds.Columns = 1_000
        ds.PixelData = bytes(1_000 * 1_000 * 2)
        save_dataset(ds, tmp_path / plan.name(k))
    # measured 5,226 bytes: zeros deflate to a thousandth of their 4 MB
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 10_000
    with refused(RefusedInputError, 1_000_000):
        read_volume(tmp_path)


@pytest.mark.parametrize(
    ("slope", "intercept"), [(1, -1024), (3, -1000), (3, 0), (1, 40000), (0.25, 0), (0.3125, 1), (-1, 500)]
)
def test_padding_is_read_as_air_and_counts_as_that_in_the_range_with_any_rescale(tmp_path, slope, intercept):
    def pad(array, k):
        array[1, 1:4] = -30000
        return array

    change = set_pixels(pad, PixelPaddingValue=-30000, RescaleSlope=slope, RescaleIntercept=intercept)
    plan = write_series(tmp_path, change=change)
    volume = read_volume(tmp_path)
    expected = (plan.hu() + 1024) * slope + intercept
    expected[:, 1, 1:4] = -1024
    assert np.array_equal(volume.voxels, expected)
    assert volume.report["hu_range"] == [expected.min(), expected.max()]


# --- real files ---


def copy_as_stack(source: Path, folder: Path) -> None:
    """Two slices out of one file, 2 mm apart, its pixel data element untouched."""
    ds = pydicom.dcmread(source)
    for k in range(2):
        ds.ImagePositionPatient = [-161.4, -148.8, 4.7 + 2 * k]
        ds.save_as(folder / f"{k}", enforce_file_format=True)


LOSSY_HU = {"4.91": 5, "4.81": 1}
"""Largest difference of the lossy ones, JPEG 2000 and JPEG-LS: measured."""


@pytest.mark.parametrize("ending", daily(5, [*LOSSLESS, *LOSSY_HU]))
def test_real_slice_in_each_transfer_syntax_decodes_as_the_uncompressed_one(tmp_path, real_data, ending):
    reference = pydicom.dcmread(real_data / SYNTAXES / "CTImage.dcm")
    expected = np.frombuffer(reference.PixelData, "<i2").reshape(512, 512).astype(int) - 1024
    expected[expected == -32768 - 1024] = -1024  # padding
    (source,) = (
        (real_data / SYNTAXES).glob(f"*_1.2.840.10008.*{ending}.dcm")
        if ending not in ("1.2",)
        else (real_data / SYNTAXES / "CTImage.dcm_LittleEndianImplicitTransferSyntax_1.2.840.10008.1.2.dcm",)
    )
    copy_as_stack(source, tmp_path)

    volume = read_volume(tmp_path)

    assert volume.report["transfer_syntaxes"][0].endswith(ending)
    assert volume.voxels.dtype == np.int16
    for slice_hu in volume.voxels:
        assert np.abs(slice_hu - expected).max() <= LOSSY_HU.get(ending, 0)


@pytest.mark.parametrize("ending", ["50", "51", "53", "55"])
def test_real_slice_in_lossy_jpeg_is_refused_with_its_transfer_syntax(real_data, ending):
    sources = list((real_data / SYNTAXES).glob(f"*4.{ending}.dcm"))
    assert sources
    for source in sources:
        with refused(RefusedInputError, f"1.2.840.10008.1.2.4.{ending}", "JPEG"):
            read_volume(source)


@pytest.mark.parametrize("ending", ["70", "80", "90"], ids=["JPEG lossless", "JPEG-LS", "JPEG 2000"])
def test_compressed_frame_of_another_size_than_the_header_says_is_refused(tmp_path, real_data, ending):
    (source,) = (real_data / SYNTAXES).glob(f"*4.{ending}.dcm")
    copy_as_stack(source, tmp_path)
    for file in tmp_path.iterdir():
        ds = pydicom.dcmread(file)
        ds.Rows = 500
        ds.save_as(file)
    with refused(RefusedInputError, "frame", 512, 500):
        read_volume(tmp_path)


def without_end(whole):
    return whole[: len(whole) // 3]


def without_end_mark(whole):
    return whole[:-8]


def second_half_zeroed(whole):
    half = len(whole) // 2
    return whole[:half] + bytes(len(whole) - half - 8) + whole[-8:]


def eighth_zeroed(whole):
    half, eighth = len(whole) // 2, len(whole) // 8
    return whole[:half] + bytes(eighth) + whole[half + eighth :]


@pytest.fixture(params=["RLE", "JPEGLS", "JPEG2000"])
def compressed_stack(request, real_data, tmp_path):
    """A folder of two slices, 0 and 1, in one of the lossless codings."""
    (source,) = (real_data / SYNTAXES).glob(f"*_{request.param}Lossless*.dcm")
    copy_as_stack(source, tmp_path)
    return tmp_path


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (without_end, r"1: truncated: \d+ bytes of compressed pixels expected, \d+ found"),
        (without_end_mark, "1: truncated: the compressed pixels have no end mark"),
        (second_half_zeroed, "1: (truncated: the compressed frame has no end mark|the compr.* segment)"),
    ],
    ids=["cut", "no end mark", "half zeroed"],
)
def test_real_compressed_slice_that_is_cut_or_zeroed_is_refused(compressed_stack, damage, words):
    file = compressed_stack / "1"
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(RefusedInputError, match=words):
        read_volume(compressed_stack)


@pytest.mark.release
@pytest.mark.seconds
def test_real_compressed_slice_with_zeros_within_is_refused_or_keeps_its_size(compressed_stack):
    file = compressed_stack / "1"
    file.write_bytes(eighth_zeroed(file.read_bytes()))
    try:
        volume = read_volume(compressed_stack)
    except RefusedInputError as error:
        assert "1: the compressed pixels (transfer syntax" in str(error)
    else:
        assert volume.voxels.shape == (2, 512, 512)


LUMBAR, THORACIC, THORACOLUMBAR = "lumbar_4p25mm", "thoracic_0p8mm", "thoracolumbar_labels/ct_2mm_jpeg2000"


@pytest.mark.parametrize(
    ("name", "origin", "spacing"),
    [
        (LUMBAR, (-250, -250, -846.25), (0.976562, 0.976562, 4.25)),
        (THORACIC, (-169.399994, -165, -280), (0.644531, 0.644531, 0.8)),
        (THORACOLUMBAR, (-249.511719, -437.511719, -804.5), (0.976562, 0.976562, 2)),
    ],
)
def test_real_series_has_its_known_affine(real_data, name, origin, spacing):
    expected = np.diag((*spacing, 1.0))
    expected[:3, 3] = origin
    assert np.abs(read_volume(real_data / name).affine - expected).max() < tolerances.REAL_AFFINE_MM


@pytest.mark.parametrize(("name", "high"), [(LUMBAR, 1288), (THORACIC, 1496), (THORACOLUMBAR, 1839)])
def test_real_series_has_its_known_range_of_hu(real_data, name, high):
    volume = read_volume(real_data / name)
    assert volume.voxels.dtype == np.int16
    assert volume.report["hu_range"] == [-1024, high] == [volume.voxels.min(), volume.voxels.max()]


@pytest.mark.parametrize(
    ("name", "mean", "voxels_above_300_hu"), [(LUMBAR, -1116.8660, 213_337), (THORACIC, -971.8018, 443_965)]
)
def test_real_series_has_its_known_mean_and_voxels_of_bone(real_data, name, mean, voxels_above_300_hu):
    """The known mean is that without masking: padding is put back at its stored -2000, with the intercept -1024."""
    volume = read_volume(real_data / name)
    share, padding_hu = volume.report["padding_share"], volume.report["padding_hu"] or 0.0
    unmasked_mean = volume.voxels.mean(dtype=float) + share * (-2000 - 1024 - padding_hu)
    assert unmasked_mean == pytest.approx(mean, abs=tolerances.REAL_MEAN_HU)
    assert np.count_nonzero(volume.voxels > 300) == voxels_above_300_hu
    assert 0.2 < share < 0.25  # the corners around a circle in a square: 1 - pi / 4 is 0.215


def has_mark(path):
    return path.is_file() and path.read_bytes()[128:132] == b"DICM"


@pytest.fixture(scope="module")
def real_tilted(real_data):
    """A real series of 28 slices with uneven gaps from a tilted gantry, and positions and directions by pydicom."""
    folder = real_data / "head_tilt_gaps"
    headers = [pydicom.dcmread(path, stop_before_pixels=True) for path in folder.rglob("*") if has_mark(path)]
    positions = sorted((list(map(float, ds.ImagePositionPatient)) for ds in headers), key=lambda place: place[2])
    directions = np.array(headers[0].ImageOrientationPatient, float).reshape(2, 3)
    return read_volume(folder), np.array(positions), directions


def test_slices_of_a_real_uneven_series_lie_at_their_own_positions(real_tilted):
    volume, positions, _ = real_tilted
    assert volume.uneven
    assert np.abs(volume.ijk_to_lps([(0, 0, k) for k in range(28)]) - positions).max() <= tolerances.AFFINE_MM


def test_far_corners_of_a_real_tilted_series_lie_along_its_directions(real_tilted):
    volume, positions, (row, column) = real_tilted
    spacing_mm = 0.488281
    far_corners = volume.ijk_to_lps([(511, 511, k) for k in range(28)])
    expected = positions + 511 * spacing_mm * (row + column)
    assert np.abs(far_corners - expected).max() <= tolerances.REAL_FAR_CORNER_MM


def test_real_uneven_tilted_series_is_reported_with_its_tilt_and_gaps(real_tilted):
    volume, _, _ = real_tilted
    assert volume.report["tilt_deg"] == pytest.approx(18.5, abs=tolerances.REAL_TILT_DEG)
    words = "gaps 1.081 to 6.999 mm (usual 4.002 mm)"
    assert sum(words in warning for warning in volume.report["warnings"]) == 1


def test_real_segmentation_is_refused_as_a_volume_by_its_modality(real_data):
    with refused(NoDicomError, "SEG", "CT", 1):  # series of SEG
        read_volume(real_data / "seg_and_labels" / "liver.dcm")
