"""DICOM SEG: frames at their own positions, names, overlaps, written by highdicom or by hand."""

from __future__ import annotations

import dicom_series
import numpy as np
import pydicom
import pytest
from label_files import ct_slices, write_seg
from pydicom.uid import DeflatedExplicitVRLittleEndian, RLELossless
from refusals import refused

from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.certificate import amend
from clrecon.labels import read_labels, resample_labels
from clrecon.labels.reader import is_large_map, read_all_labels
from clrecon.reading import read_volume

pytest.importorskip("highdicom")

PLAN = dicom_series.Plan(shape=(7, 6, 9), angles=(10, -20, 35), gap=1.25)


SHARED_VOXELS = 2 * 4
"""Of T12 and L1 body where they overlap: rows 2 and 3, columns 3 to 6 of slice 2."""


def masks_of_two(overlap=False, shape=PLAN.shape):
    """Names and masks of two segments, on slices 1 to 2 and 3 to 5; with overlap, they share slice 2."""
    first, second = np.zeros(shape, bool), np.zeros(shape, bool)
    first[1:3, 1:4, 2:7] = True
    second[2 if overlap else 3 : 6, 2:5, 3:8] = True
    return [("T12", first), ("L1 body", second)]


def assert_segments_on_scan(path, volume, segments):
    """Assert that the file, read and resampled to its scan, has the mask of segment 1, 2, ... as label 1, 2, ..."""
    resampled = resample_labels(read_labels(path), volume)
    assert resampled.exact
    for number, (_, mask) in enumerate(segments, start=1):
        assert np.array_equal(resampled.voxels == number, mask)


def ct_volume(tmp_path, plan=PLAN):
    """Write a CT and read it."""
    dicom_series.write_series(tmp_path / "ct", plan)
    return read_volume(tmp_path / "ct")


@pytest.mark.parametrize(
    ("kind", "syntax"), [("BINARY", None), ("LABELMAP", None), ("LABELMAP", RLELossless)], ids=["bits", "map", "rle"]
)
@pytest.mark.parametrize("leave_out_empty", [True, False], ids=["labelled frames", "all frames"])
def test_segments_lie_on_their_ct(tmp_path, kind, syntax, leave_out_empty):
    segments = masks_of_two()
    path = write_seg(
        tmp_path / "a.dcm", segments, ct_slices(PLAN), kind=kind, leave_out_empty=leave_out_empty, syntax=syntax
    )
    assert_segments_on_scan(path, ct_volume(tmp_path), segments)


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
def test_labels_of_a_segmentation_have_the_names_of_its_segments(tmp_path, kind):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind=kind)
    assert read_labels(path).names == {1: "T12", 2: "L1 body"}


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
def test_progress_of_reading_a_segmentation_counts_its_frames(tmp_path, kind):
    calls: list = []
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind=kind)
    read_labels(path, progress=lambda *call: calls.append(call))
    frames = pydicom.dcmread(path).NumberOfFrames
    assert calls == [("read", frame, frames) for frame in range(1, frames + 1)]


FRAMES_AND_SYNTAX = pytest.mark.parametrize(
    ("kind", "syntax"), [("BINARY", None), ("LABELMAP", RLELossless)], ids=["bits", "rle"]
)
STORED_BYTES = 5 * 9 * 6
"""Of `masks_of_two`, a byte a pixel: 5 frames of 9 x 6."""

SCAN_OF_30_VOXELS, SCAN_OF_35_VOXELS = (Volume(np.zeros((1, 5, ni), np.int16), np.eye(4)) for ni in (6, 7))
"""The segmentation has 270 voxels, 9 times 30 and less than 8 times 35; a large one is read up to 8 times its scan."""


@pytest.fixture
def segmentation_is_large(monkeypatch):
    """Let `masks_of_two` be large by a byte."""
    monkeypatch.setattr("clrecon.labels.reader.LARGE_BYTES", STORED_BYTES - 1)


@FRAMES_AND_SYNTAX
def test_segmentation_is_called_large_by_the_bytes_of_its_frames(tmp_path, kind, syntax):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind=kind, syntax=syntax)
    assert not is_large_map(path)
    assert is_large_map(path, most_bytes=STORED_BYTES - 1)
    assert not is_large_map(path, most_bytes=STORED_BYTES)


@FRAMES_AND_SYNTAX
def test_small_segmentation_is_read_however_many_times_the_voxels_of_its_scan_it_has(tmp_path, kind, syntax):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind=kind, syntax=syntax)
    assert read_labels(path, volume=SCAN_OF_30_VOXELS).numbers == (1, 2)


@FRAMES_AND_SYNTAX
@pytest.mark.usefixtures("segmentation_is_large")
def test_large_segmentation_of_less_than_8_times_the_voxels_of_its_scan_is_read(tmp_path, kind, syntax):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind=kind, syntax=syntax)
    assert read_labels(path, volume=SCAN_OF_35_VOXELS).numbers == (1, 2)


@FRAMES_AND_SYNTAX
@pytest.mark.usefixtures("segmentation_is_large")
def test_large_segmentation_out_of_proportion_is_refused_before_it_is_unpacked(tmp_path, monkeypatch, kind, syntax):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind=kind, syntax=syntax)
    monkeypatch.setattr("clrecon.labels.segmentation._FramePixels", None)  # cannot be called
    with refused(RefusedInputError, "a.dcm", 9, 6, 5):  # voxels along i, j and k
        read_labels(path, volume=SCAN_OF_30_VOXELS)


def test_segmentation_cut_within_its_header_is_not_called_large(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN))
    (tmp_path / "b.dcm").write_bytes(path.read_bytes()[:400])
    assert not is_large_map(tmp_path / "b.dcm", most_bytes=1)  # which any map has more of


def test_frames_of_every_second_slice_leave_those_between_without_labels(tmp_path):
    """No two frames are neighbours: their distance is not that of the slices."""
    mask = np.zeros(PLAN.shape, bool)
    mask[1::2, 2:4, 2:5] = True
    path = write_seg(tmp_path / "a.dcm", [("odd", mask)], ct_slices(PLAN))
    assert pydicom.dcmread(path).NumberOfFrames == 3  # slices 1, 3 and 5 of 7
    assert_segments_on_scan(path, ct_volume(tmp_path), [("odd", mask)])


def test_segments_on_slices_of_a_tilted_gantry_lie_on_their_ct(tmp_path):
    tilted = dicom_series.Plan(shape=(7, 6, 9), tilt_deg=15.0)
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(tilted))
    assert_segments_on_scan(path, ct_volume(tmp_path, tilted), masks_of_two())


def write_overlapping(tmp_path):
    """A segmentation of T12 and L1 body that share SHARED_VOXELS, and the voxels of each."""
    segments = masks_of_two(overlap=True)
    path = write_seg(tmp_path / "a.dcm", segments, ct_slices(PLAN))
    return path, *(int(mask.sum()) for _, mask in segments)


def test_segments_that_overlap_are_refused_with_their_names_and_voxels(tmp_path):
    path, _, _ = write_overlapping(tmp_path)
    with refused(RefusedInputError, "T12", "L1", 1, 2, SHARED_VOXELS):
        read_labels(path)


def test_segment_chosen_by_name_is_read_alone_beside_one_that_overlaps(tmp_path):
    path, t12, _ = write_overlapping(tmp_path)
    assert read_labels(path, ["t12"]).counts == {1: t12}


def test_chosen_segment_keeps_the_voxels_that_it_shares_where_all_are_read(tmp_path):
    path, t12, l1 = write_overlapping(tmp_path)
    assert read_all_labels(path, ["t12"]).counts == {1: t12, 2: l1 - SHARED_VOXELS}
    assert read_all_labels(path, [2]).counts == {1: t12 - SHARED_VOXELS, 2: l1}


def test_segment_that_is_not_there_is_refused_with_those_that_are(tmp_path):
    path, _, _ = write_overlapping(tmp_path)
    with refused(UsageError, "L9", "T12", 1, 2):
        read_labels(path, ["L9"])


def test_segmentation_has_the_frame_of_reference_of_its_ct(tmp_path):
    labels = read_labels(write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN)))
    assert labels.frame_of_reference_hash == ct_volume(tmp_path).report["frame_of_reference_hash"]


def test_segmentation_of_another_frame_of_reference_than_the_ct_is_refused(tmp_path):
    labels = read_labels(write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN)))
    volume = ct_volume(tmp_path)
    volume.report = amend(volume.report, frame_of_reference_hash="0" * 16)
    with refused(RefusedInputError, "frame", "reference"):
        resample_labels(labels, volume)


def change_elements(path, **values):
    """Set elements of a file by their keywords; None takes one out."""
    ds = pydicom.dcmread(path)
    for keyword, value in values.items():
        if value is None:
            delattr(ds, keyword)
        else:
            setattr(ds, keyword, value)
    ds.save_as(path)
    return path


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"SegmentationType": "FRACTIONAL"}, "fractional ones do not say which voxels"),
        ({"Rows": 60_000}, "cannot come from a file of"),
        ({"NumberOfFrames": 2_000_000}, "is corrupt: 2000000 frames"),
        ({"NumberOfFrames": 4}, "4 frames and 5 descriptions"),
        ({"BitsAllocated": 32}, "frames of 32 bits a pixel"),
        ({"PixelData": b"\0\0"}, "is cut: 5 frames of 9 x 6"),
        ({"PixelData": None}, "is no usable DICOM SEG"),
        ({"SegmentSequence": None}, "is no usable DICOM SEG"),
        ({"SOPClassUID": "1.2.840.10008.5.1.4.1.1.2"}, "is DICOM but no segmentation"),
    ],
)
def test_segmentation_with_unsound_elements_is_refused(tmp_path, values, message):
    path = change_elements(write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN)), **values)
    with pytest.raises(RefusedInputError, match=message):
        read_labels(path)


def change_groups(path, change):
    """Change the functional groups of a file: `change(shared, of_frames)`."""
    ds = pydicom.dcmread(path)
    change(ds.SharedFunctionalGroupsSequence[0], ds.PerFrameFunctionalGroupsSequence)
    ds.save_as(path)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s, f: setattr(f[2].PlanePositionSequence[0], "ImagePositionPatient", [0, 0, 0]), "do not lie evenly"),
        (lambda s, f: setattr(f[2].PlanePositionSequence[0], "ImagePositionPatient", []), "no usable DICOM SEG"),
        (lambda s, f: setattr(f[2], "PlanePositionSequence", []), "no usable DICOM SEG: no PlanePositionSequence"),
        (lambda s, f: setattr(s.PlaneOrientationSequence[0], "ImageOrientationPatient", [0] * 6), "cannot be placed"),
        (lambda s, f: setattr(s.PixelMeasuresSequence[0], "PixelSpacing", [0, 1]), "cannot be placed"),
        (lambda s, f: setattr(f[1].SegmentIdentificationSequence[0], "ReferencedSegmentNumber", 9), "segment 9, which"),
    ],
    ids=["uneven places", "place without numbers", "no place", "no direction", "no spacing", "unknown segment"],
)
def test_segmentation_with_a_frame_of_unknown_place_or_segment_is_refused(tmp_path, change, message):
    path = change_groups(write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN)), change)
    with pytest.raises(RefusedInputError, match=message):
        read_labels(path)


def test_deflated_segmentation_is_refused_by_its_transfer_syntax(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN))
    ds = pydicom.dcmread(path)
    ds.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    ds.save_as(path)
    with refused(RefusedInputError, "a.dcm", "1.2.840.10008.1.2.1.99"):
        read_labels(path)


@pytest.mark.fuzz
def test_segmentation_cut_anywhere_is_refused(tmp_path):
    content = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN)).read_bytes()
    for length in range(0, len(content) - 2, 53):
        (tmp_path / "b.dcm").write_bytes(content[:length])
        with refused(RefusedInputError, "b.dcm"):
            read_labels(tmp_path / "b.dcm")


@pytest.mark.fuzz
def test_segmentation_damaged_anywhere_is_read_or_refused(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind="LABELMAP", syntax=RLELossless)
    content = path.read_bytes()
    random = np.random.default_rng(3)
    trials, after_preamble = 150, 132
    refusals = 0
    for _ in range(trials):
        damaged = np.frombuffer(content, np.uint8).copy()
        damaged[random.integers(after_preamble, len(content), 4)] = random.integers(0, 256, 4)
        (tmp_path / "b.dcm").write_bytes(damaged.tobytes())
        try:
            read_labels(tmp_path / "b.dcm")
        except (RefusedInputError, UsageError):
            refusals += 1
    assert 20 < refusals < trials  # some bytes matter, some do not


@pytest.mark.parametrize(("keyword", "value"), [("Rows", b"\7\0"), ("FrameOfReferenceUID", b"1.2\0")])
def test_segmentation_with_two_values_of_one_element_is_refused(tmp_path, keyword, value):
    """pydicom takes the second in silence."""
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN))
    assert read_labels(path).numbers
    data = path.read_bytes()
    tag_and_vr = dicom_series.element_bytes(keyword, b"")[:6]
    length = data.index(tag_and_vr) + len(tag_and_vr)
    end = length + 2 + int.from_bytes(data[length : length + 2], "little")
    path.write_bytes(data[:end] + dicom_series.element_bytes(keyword, value) + data[end:])
    with refused(RefusedInputError, "a.dcm", "DICOM", keyword):
        read_labels(path)


def test_real_segmentation_and_nrrd_of_one_liver_give_the_same_voxels(real_data):
    folder = real_data / "seg_and_labels"
    volume = read_volume(folder / "ct-3slice")
    seg, nrrd = (resample_labels(read_labels(folder / name), volume) for name in ("liver.dcm", "liver_seg.nrrd"))
    assert seg.exact
    assert nrrd.exact
    assert seg.voxels.any()
    assert np.array_equal(seg.voxels, nrrd.voxels)


def test_real_segmentation_whose_segments_overlap_is_refused_unless_one_is_chosen(real_data):
    path = real_data / "seg_and_labels" / "partial_overlaps.dcm"
    with refused(RefusedInputError, "GREEN", "ORANGE", 3017):  # voxels that both hold in this file
        read_labels(path)
    assert read_labels(path, ["green"]).find("GREEN") == 1


def edit_frames(path, change):
    """Change the frames (pixels of 8 bits, group) of a label map."""
    ds = pydicom.dcmread(path)
    frames = list(zip(ds.pixel_array.copy(), ds.PerFrameFunctionalGroupsSequence, strict=True))
    frames = change(frames)
    ds.PixelData = np.stack([pixels for pixels, _ in frames]).tobytes()
    ds.PerFrameFunctionalGroupsSequence = [group for _, group in frames]
    ds.NumberOfFrames = len(frames)
    ds.save_as(path)
    return path


def test_frames_of_a_label_map_at_one_place_are_joined(tmp_path):
    segments = masks_of_two()
    path = write_seg(tmp_path / "a.dcm", segments, ct_slices(PLAN), kind="LABELMAP")
    edit_frames(path, lambda frames: [(px * (px == n), group) for n in (1, 2) for px, group in frames])
    assert_segments_on_scan(path, ct_volume(tmp_path), segments)


def test_frames_of_a_label_map_that_give_voxels_two_segments_are_refused(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind="LABELMAP")

    def repeat_segment_1_as_2(frames):
        return [(2 * (pixels == 1).astype(np.uint8), group) for pixels, group in frames if (pixels == 1).any()]

    edit_frames(path, lambda frames: [*frames, *repeat_segment_1_as_2(frames)])
    # T12 has 3 x 5 voxels in slices 1 and 2 of the five that are not empty; the file begins with the last slice.
    words = "two of its frames lie at one place, slice 2 of 5, and give 15 voxels two segments, 1 and 2$"
    with pytest.raises(RefusedInputError, match=words):
        read_labels(path)


def test_background_that_a_label_map_states_is_no_label(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind="LABELMAP")
    before = read_labels(path)
    edit_frames(path, lambda frames: [(np.where(px == 0, 9, px).astype(np.uint8), group) for px, group in frames])
    change_elements(path, PixelPaddingValue=9)
    assert np.array_equal(read_labels(path).voxels, before.voxels)


def test_zero_in_a_label_map_of_another_background_is_refused(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN), kind="LABELMAP")
    other = {0: 9, 1: 0, 2: 2}
    edit_frames(path, lambda frames: [(np.vectorize(other.get)(px).astype(np.uint8), group) for px, group in frames])
    change_elements(path, PixelPaddingValue=9)
    with refused(RefusedInputError, "segment", "background", 0, 9):
        read_labels(path)


def append_frame_at_the_place_of_the_second(path, pixels_of):
    """Append a frame of `pixels_of(second frame)` to a segmentation of bits."""
    ds = pydicom.dcmread(path)
    groups, frames = ds.PerFrameFunctionalGroupsSequence, ds.pixel_array.astype(np.uint8)
    ds.NumberOfFrames = len(frames) + 1
    ds.PerFrameFunctionalGroupsSequence = [*groups, groups[1]]
    pixels = np.concatenate([frames, pixels_of(frames[1])[None]]).ravel()
    ds.PixelData = np.packbits(pixels, bitorder="little").tobytes() + b"\0"
    ds.save_as(path)


def test_equal_frames_of_a_segment_at_one_place_are_joined(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN))
    before = read_labels(path)
    append_frame_at_the_place_of_the_second(path, lambda pixels: pixels)
    assert np.array_equal(read_labels(path).voxels, before.voxels)


def test_different_frames_of_a_segment_at_one_place_are_refused(tmp_path):
    """They are two states of one segment, as at several points in time."""
    path = write_seg(tmp_path / "a.dcm", masks_of_two(), ct_slices(PLAN))
    append_frame_at_the_place_of_the_second(path, np.zeros_like)
    with refused(RefusedInputError, "slice", "segment", 1, 5):  # segment 1, and 5 slices
        read_labels(path)
