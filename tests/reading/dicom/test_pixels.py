"""Stored bits to HU: rescale, padding, sign, width, and every transfer syntax."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pydicom
import pytest
from dicom_series import Plan, make_dataset, save_dataset, set_raw, set_values, write_series
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
)
from refusals import refused
from stored_pixels import set_pixels
from tolerances import AFFINE_MM
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
def test_native_syntaxes_give_the_same_hu(tmp_path, syntax):
    plan = Plan(syntax=syntax)
    for k in range(plan.shape[0]):
        ds = make_dataset(plan, k)
        if syntax == ExplicitVRBigEndian:
            ds.PixelData = plan.stored(k).byteswap().tobytes()
        save_dataset(ds, tmp_path / plan.name(k))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.voxels.dtype == np.int16
    assert volume.report["transfer_syntaxes"] == [str(syntax)]
    assert volume.report["hu_range"] == [plan.hu().min(), plan.hu().max()]


def test_headers_of_200_kb_are_read_whole(tmp_path):
    plan = write_series(tmp_path, change=lambda ds, k: ds.add_new(0x00420011, "OB", bytes(200_000)))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


def test_sequences_without_lengths_longer_than_the_first_read_are_read(tmp_path):
    def spoil(ds, k):
        item = pydicom.Dataset()
        item.add_new(0x00420011, "OB", bytes(200_000))
        ds.add_new(0x00081140, "SQ", [item])
        ds[0x00081140].is_undefined_length = item.is_undefined_length_sequence_item = True

    plan = write_series(tmp_path, change=spoil)
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


def test_rescale_goes_slice_by_slice(tmp_path):
    plan = write_series(tmp_path, change=lambda ds, k: set_values(RescaleSlope=k + 1, RescaleIntercept=-10 * k)(ds, k))
    volume = read_volume(tmp_path)
    expected = np.stack([plan.stored(k).astype(int) * (k + 1) - 10 * k for k in range(7)])
    assert np.array_equal(volume.voxels, expected)
    assert volume.voxels.dtype == np.int16
    assert volume.report["rescale"] == {"slope": [1.0, 7.0], "intercept": [-60.0, 0.0], "type": "HU"}


def test_results_too_wide_for_16_bits_become_32(tmp_path):
    plan = write_series(tmp_path, Plan(slope=30, intercept=0))
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.int32
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.voxels.max() > 32767 > volume.voxels.min()


def test_broken_slopes_become_float32(tmp_path):
    plan = write_series(tmp_path, change=set_values(RescaleSlope=0.25))
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.float32
    assert np.array_equal(volume.voxels, (plan.hu() + 1024) * 0.25 - 1024)


def test_unsigned_values_over_the_signed_range_are_widened_where_needed(tmp_path):
    plan = Plan(signed=False, intercept=-32768)
    write_series(tmp_path, plan, set_pixels(lambda array, k: array.view(np.uint16) + 50_000))
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, plan.hu() + 50_000)
    write_series(tmp_path, plan, set_pixels(lambda array, k: array.view(np.uint16) + 50_000, RescaleIntercept=0))
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.int32
    assert volume.voxels[0, 0, 0] == 50_900


def test_signed_values_of_twelve_bits_are_read_under_overlay_bits(tmp_path):
    def spoil(array, k):
        values = array - 1000  # -100 up: both signs
        return (values & 0x0FFF) | 0x5000

    plan = Plan(bits_stored=12)
    write_series(tmp_path, plan, set_pixels(spoil))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu() - 1000)


def test_bits_that_do_not_start_at_zero_are_shifted(tmp_path):
    plan = Plan(bits_stored=12, signed=False)
    write_series(tmp_path, plan, set_pixels(lambda array, k: (array << 4) | 0x9, HighBit=15))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())


@pytest.mark.parametrize("bits", [8, 32])
def test_pixels_of_8_and_32_bits_are_read(tmp_path, bits):
    def narrow(array, k):
        return (array % 200).astype(f"i{bits // 8}") if bits == 32 else (array % 200).astype("u1")

    plan = Plan(shape=(7, 5, 6), signed=bits == 32)
    change = set_pixels(narrow, BitsAllocated=bits, BitsStored=bits, HighBit=bits - 1)
    write_series(tmp_path, plan, change)
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, (plan.hu() + 1024) % 200 - 1024)


@pytest.mark.parametrize(
    ("padding", "limit", "signed"),
    [(-2000, None, True), (63536, None, True), (-2000, -1990, True), (-1990, -2000, True), (63536, None, False)],
    ids=["signed", "as unsigned", "range", "range turned round", "unsigned"],
)
def test_padding_of_any_writing_becomes_air(tmp_path, padding, limit, signed):
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

    plan = Plan(signed=signed)
    write_series(tmp_path, plan, change)
    volume = read_volume(tmp_path)
    expected = plan.hu()
    expected[:, 0, :3] = -1024
    assert volume.voxels.dtype == np.int16
    assert np.array_equal(volume.voxels, expected)
    assert volume.report["padding_share"] == pytest.approx(3 / 30)
    assert volume.report["hu_range"] == [-1024, expected.max()]


def test_slice_of_padding_alone_becomes_air(tmp_path):
    change = set_pixels(lambda array, k: array * 0 - 2000 if k == 2 else array, PixelPaddingValue=-2000)
    plan = write_series(tmp_path, change=change)
    volume = read_volume(tmp_path)
    assert (volume.voxels[2] == -1024).all()
    assert np.array_equal(volume.voxels[3], plan.hu()[3])
    assert volume.report["padding_share"] == pytest.approx(1 / 7)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (set_values(PhotometricInterpretation="MONOCHROME1"), "MONOCHROME1: meant to be shown inverted"),
        (set_values(RescaleType="US"), "RescaleType is 'US': the values are not HU (all slices)"),
        (set_values(LossyImageCompression="01"), "lossy compression: the values are not those that were measured"),
        (set_values(RescaleType="DOE^JOHN"), "RescaleType is 'other': the values are not HU (all slices)"),
        (set_values(2, RescaleType="OD"), "RescaleType is 'OD': the values are not HU (1 of 7 slices, at -397.50 mm)"),
    ],
)
def test_doubtful_values_are_kept_with_a_warning(tmp_path, change, words):
    plan = write_series(tmp_path, change=change)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert words in volume.report["warnings"][0]
    assert list_series(tmp_path).series[0].warnings == volume.report["warnings"]


def test_missing_rescale_is_not_hu(tmp_path):
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
def test_images_that_are_no_ct_slice_are_refused(tmp_path, change, words):
    write_series(tmp_path, change=change)
    with pytest.raises(RefusedInputError) as caught:
        read_volume(tmp_path)
    assert f"slice000.dcm: {words}" in str(caught.value)


def test_short_pixel_data_names_both_sizes(tmp_path):
    write_series(tmp_path)
    file = tmp_path / "slice003.dcm"
    file.write_bytes(file.read_bytes()[:-10])
    with refused(RefusedInputError, "slice003.dcm", 60, 6, 5):
        read_volume(tmp_path)


def test_row_39_memory_is_asked_for_before_it_is_taken(tmp_path, monkeypatch):
    write_series(tmp_path)
    monkeypatch.setattr(memory, "available_memory_bytes", lambda: 100.0)
    with refused(RefusedInputError, 6, 5, 7):
        read_volume(tmp_path)
    monkeypatch.undo()
    assert 1e7 < memory.available_memory_bytes() <= memory.physical_memory_bytes()


def test_row_38_a_deflate_bomb_is_not_inflated(tmp_path, monkeypatch):
    monkeypatch.setattr(stored, "INFLATED_LIMIT", 1_000_000)
    plan = Plan(syntax=DeflatedExplicitVRLittleEndian)
    for k in range(2):
        ds = make_dataset(plan, k)
        ds.Rows = ds.Columns = 1_000
        ds.PixelData = bytes(1_000 * 1_000 * 2)
        save_dataset(ds, tmp_path / plan.name(k))
    assert sum(file.stat().st_size for file in tmp_path.iterdir()) < 10_000
    with refused(RefusedInputError, 1000000):
        read_volume(tmp_path)


@pytest.mark.parametrize(
    ("slope", "intercept"), [(1, -1024), (3, -1000), (3, 0), (1, 40000), (0.25, 0), (0.3125, 1), (-1, 500)]
)
def test_padding_is_air_and_in_no_range_with_any_rescale(tmp_path, slope, intercept):
    """Whatever way the padding takes to air, it counts in no range but as air."""

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


@pytest.mark.parametrize("ending", daily(5, [*LOSSLESS, "4.91", "4.81"]))
def test_transfer_syntaxes_decode_as_the_plain_file(tmp_path, real_data, ending):
    reference = pydicom.dcmread(real_data / SYNTAXES / "CTImage.dcm")
    expected = np.frombuffer(reference.PixelData, "<i2").reshape(512, 512).astype(int) - 1024
    expected[expected == -32768 - 1024] = -1024
    (source,) = (
        (real_data / SYNTAXES).glob(f"*_1.2.840.10008.*{ending}.dcm")
        if ending not in ("1.2",)
        else (real_data / SYNTAXES / "CTImage.dcm_LittleEndianImplicitTransferSyntax_1.2.840.10008.1.2.dcm",)
    )
    copy_as_stack(source, tmp_path)
    volume = read_volume(tmp_path)
    allowed = {"4.91": 5, "4.81": 1}.get(ending, 0)
    assert volume.report["transfer_syntaxes"][0].endswith(ending)
    assert np.abs(volume.voxels[1] - expected).max() <= allowed
    assert np.array_equal(volume.voxels[0], volume.voxels[1])
    assert volume.voxels.dtype == np.int16


@pytest.mark.parametrize("ending", ["50", "51", "53", "55"])
def test_lossy_jpeg_is_refused_with_its_uid(real_data, ending):
    sources = list((real_data / SYNTAXES).glob(f"*4.{ending}.dcm"))
    assert sources
    for source in sources:
        with pytest.raises(RefusedInputError, match=rf"transfer syntax 1\.2\.840\.10008\.1\.2\.4\.{ending} \(JPEG"):
            read_volume(source)


def test_a_compressed_frame_of_another_size_is_refused_before_decoding(tmp_path, real_data):
    for source in sorted((real_data / SYNTAXES).glob("*4.[789]0.dcm")):
        folder = tmp_path / source.name[-6:-4]
        folder.mkdir()
        copy_as_stack(source, folder)
        for file in folder.iterdir():
            ds = pydicom.dcmread(file)
            ds.Rows = 500
            ds.save_as(file)
        with refused(RefusedInputError, "frame", 512, 500):
            read_volume(folder)
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.release
@pytest.mark.seconds
def test_damaged_compressed_frames_are_refused(tmp_path, real_data):
    sources = sorted((real_data / SYNTAXES).glob("*Lossless*.dcm"))
    assert len(sources) == 3
    for source in sources:
        folder = tmp_path / source.name[-8:]
        folder.mkdir()
        copy_as_stack(source, folder)
        whole = (folder / "1").read_bytes()
        (folder / "1").write_bytes(whole[: len(whole) // 3])
        with pytest.raises(
            RefusedInputError, match=r"1: truncated: \d+ bytes of compressed pixels expected, \d+ found"
        ):
            read_volume(folder)
        (folder / "1").write_bytes(whole[:-8])
        with pytest.raises(RefusedInputError, match="1: truncated: the compressed pixels have no end mark"):
            read_volume(folder)
        (folder / "1").write_bytes(whole[: len(whole) // 2] + bytes(len(whole) - len(whole) // 2 - 8) + whole[-8:])
        with pytest.raises(
            RefusedInputError, match="1: (truncated: the compressed frame has no end mark|the compr.* segment)"
        ):
            read_volume(folder)
        (folder / "1").write_bytes(
            whole[: len(whole) // 2] + bytes(len(whole) // 8) + whole[len(whole) // 2 + len(whole) // 8 :]
        )
        try:
            volume = read_volume(folder)
        except RefusedInputError as error:
            assert "1: the compressed pixels (transfer syntax" in str(error)
        else:
            assert volume.voxels.shape == (2, 512, 512)


DATA = [
    ("lumbar_4p25mm", (-250, -250, -846.25), (0.976562, 0.976562, 4.25), -3024, 1288, -1116.8660, 213_337),
    ("thoracic_0p8mm", (-169.399994, -165, -280), (0.644531, 0.644531, 0.8), -3024, 1496, -971.8018, 443_965),
    (
        "thoracolumbar_labels/ct_2mm_jpeg2000",
        (-249.511719, -437.511719, -804.5),
        (0.976562, 0.976562, 2),
        -1024,
        1839,
        None,
        None,
    ),
]


@pytest.mark.parametrize("name, origin, spacing, low, high, mean, bone", DATA, ids=[row[0] for row in DATA])
def test_real_series_have_their_known_affine_and_values(real_data, name, origin, spacing, low, high, mean, bone):
    """Known figures are those without padding masking: padding is put back at its -2000 - 1024 HU for the mean."""
    volume = read_volume(real_data / name)
    expected = np.diag((*spacing, 1.0))
    expected[:3, 3] = origin
    assert np.abs(volume.affine - expected).max() < 1e-6 * 500
    share = volume.report["padding_share"]
    assert volume.voxels.dtype == np.int16
    assert volume.report["hu_range"] == [-1024, high] == [volume.voxels.min(), volume.voxels.max()]
    if mean is not None:
        padding_hu = volume.report["padding_hu"] or 0.0
        assert volume.voxels.mean(dtype=float) + share * (low - padding_hu) == pytest.approx(mean, abs=1e-3)
        assert np.count_nonzero(volume.voxels > 300) == bone
        assert 0.2 < share < 0.25


def has_mark(path):
    return path.is_file() and path.read_bytes()[128:132] == b"DICM"


def test_real_uneven_tilted_series_lies_where_its_slices_say(real_data):
    from pydicom import dcmread

    volume = read_volume(real_data / "head_tilt_gaps")
    files = [
        dcmread(path, stop_before_pixels=True) for path in (real_data / "head_tilt_gaps").rglob("*") if has_mark(path)
    ]
    truth = np.array(sorted((list(map(float, ds.ImagePositionPatient)) for ds in files), key=lambda place: place[2]))
    ours = volume.ijk_to_lps([(0, 0, k) for k in range(28)])
    assert volume.uneven
    assert np.abs(ours - truth).max() <= AFFINE_MM
    row, column = np.array(files[0].ImageOrientationPatient, float).reshape(2, 3) * 0.488281
    far = volume.ijk_to_lps([(511, 511, k) for k in range(28)])
    assert np.abs(far - (truth + 511 * (row + column))).max() <= 0.001
    assert volume.report["tilt_deg"] == pytest.approx(18.5, abs=0.05)
    words = "gaps 1.081 to 6.999 mm (usual 4.002 mm)"
    assert sum(words in text for text in volume.report["warnings"]) == 1


def test_real_segmentation_is_named_as_such(real_data):
    with refused(NoDicomError, "SEG", "CT", 1):
        read_volume(real_data / "seg_and_labels" / "liver.dcm")
