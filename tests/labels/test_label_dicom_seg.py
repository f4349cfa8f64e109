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


def masks(overlap=False, shape=PLAN.shape):
    first, second = np.zeros(shape, bool), np.zeros(shape, bool)
    first[1:3, 1:4, 2:7] = True
    second[2 if overlap else 3 : 6, 2:5, 3:8] = True
    return [("T12", first), ("L1 body", second)]


def ct_volume(tmp_path, plan=PLAN):
    dicom_series.write_series(tmp_path / "ct", plan)
    return read_volume(tmp_path / "ct")


@pytest.mark.parametrize(
    ("kind", "syntax"), [("BINARY", None), ("LABELMAP", None), ("LABELMAP", RLELossless)], ids=["bits", "map", "rle"]
)
@pytest.mark.parametrize("leave_out_empty", [True, False])
def test_segments_lie_on_their_ct(tmp_path, kind, syntax, leave_out_empty):
    segments = masks()
    path = write_seg(
        tmp_path / "a.dcm", segments, ct_slices(PLAN), kind=kind, leave_out_empty=leave_out_empty, syntax=syntax
    )
    labels = read_labels(path)
    assert labels.names == {1: "T12", 2: "L1 body"}
    taken = resample_labels(labels, ct_volume(tmp_path))
    assert taken.exact
    for number, (_, mask) in enumerate(segments, start=1):
        assert np.array_equal(taken.voxels == number, mask)


@pytest.mark.parametrize("kind", ["BINARY", "LABELMAP"])
def test_progress_counts_frames_from_the_first_to_the_last(tmp_path, kind):
    told: list = []
    path = write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN), kind=kind)
    read_labels(path, progress=lambda *step: told.append(step))
    frames = pydicom.dcmread(path).NumberOfFrames
    assert told == [("read", frame, frames) for frame in range(1, frames + 1)]


@pytest.mark.parametrize(("kind", "syntax"), [("BINARY", None), ("LABELMAP", RLELossless)], ids=["bits", "rle"])
def test_a_large_segmentation_is_held_against_its_scan_before_it_is_unpacked(tmp_path, monkeypatch, kind, syntax):
    path = write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN), kind=kind, syntax=syntax)  # 5 slices of 9 x 6
    small, fits = (Volume(np.zeros(shape, np.int16), np.eye(4)) for shape in ((1, 5, 6), (1, 5, 7)))
    assert not is_large_map(path) and read_labels(path, volume=small).numbers == (1, 2)
    frames = pydicom.dcmread(path).NumberOfFrames
    for most, large in ((frames * 54 - 1, True), (frames * 54, False)):
        assert is_large_map(path, most_bytes=most) == large
    assert read_labels(path, volume=small).numbers == (1, 2)
    monkeypatch.setattr("clrecon.labels.reader.LARGE_BYTES", frames * 54 - 1)
    assert read_labels(path, volume=fits).numbers == (1, 2)  # 270 voxels for 35
    monkeypatch.setattr("clrecon.labels.segmentation._FramePixels", None)
    with refused(RefusedInputError, "a.dcm", 9, 6, 5):
        read_labels(path, volume=small)
    (tmp_path / "b.dcm").write_bytes(path.read_bytes()[:400])
    assert not is_large_map(tmp_path / "b.dcm")


def test_holes_between_frames_are_slices_without_labels(tmp_path):
    """No two frames are neighbours: their distance is not that of the slices."""
    mask = np.zeros(PLAN.shape, bool)
    mask[1::2, 2:4, 2:5] = True
    path = write_seg(tmp_path / "a.dcm", [("odd", mask)], ct_slices(PLAN))
    taken = resample_labels(read_labels(path), ct_volume(tmp_path))
    assert pydicom.dcmread(path).NumberOfFrames == 3
    assert np.array_equal(taken.voxels == 1, mask)


def test_the_frames_of_a_tilted_gantry_form_a_sheared_stack(tmp_path):
    plan = dicom_series.Plan(shape=(7, 6, 9), tilt_deg=15.0)
    path = write_seg(tmp_path / "a.dcm", masks(), ct_slices(plan))
    taken = resample_labels(read_labels(path), ct_volume(tmp_path, plan))
    assert taken.exact and np.array_equal(taken.voxels == 2, masks()[1][1])


def test_overlapping_segments_are_refused_unless_one_is_chosen(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks(overlap=True), ct_slices(PLAN))
    with refused(RefusedInputError, "T12", "L1", 1, 2, 8):
        read_labels(path)
    first, second = (int(mask.sum()) for _, mask in masks(overlap=True))
    assert read_labels(path, ["t12"]).counts == {1: first}
    assert read_all_labels(path, ["t12"]).counts == {1: first, 2: second - 8}
    assert read_all_labels(path, [2]).counts == {1: first - 8, 2: second}
    with refused(UsageError, "L9", "T12", 1, 2):
        read_labels(path, ["L9"])


def test_labels_of_another_frame_of_reference_are_refused(tmp_path):
    labels = read_labels(write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN)))
    volume = ct_volume(tmp_path)
    assert labels.frame_of_reference_hash == volume.report["frame_of_reference_hash"]
    volume.report = amend(volume.report, frame_of_reference_hash="0" * 16)
    with refused(RefusedInputError, "frame", "reference"):
        resample_labels(labels, volume)


def spoil(path, **values):
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
def test_what_is_no_sound_segmentation_is_refused(tmp_path, values, message):
    path = spoil(write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN)), **values)
    with pytest.raises(RefusedInputError, match=message):
        read_labels(path)


def move(path, change):
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
)
def test_frames_without_a_sound_place_are_refused(tmp_path, change, message):
    path = move(write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN)), change)
    with pytest.raises(RefusedInputError, match=message):
        read_labels(path)


def test_deflated_files_are_refused_before_they_are_inflated(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN))
    ds = pydicom.dcmread(path)
    ds.file_meta.TransferSyntaxUID = DeflatedExplicitVRLittleEndian
    ds.save_as(path)
    with refused(RefusedInputError, "a.dcm", "1.2.840.10008.1.2.1.99"):
        read_labels(path)


@pytest.mark.fuzz
def test_segmentation_cut_anywhere_is_refused(tmp_path):
    content = write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN)).read_bytes()
    for length in range(0, len(content) - 2, 53):
        (tmp_path / "b.dcm").write_bytes(content[:length])
        with refused(RefusedInputError, "b.dcm"):
            read_labels(tmp_path / "b.dcm")


@pytest.mark.fuzz
def test_segmentation_damaged_anywhere_is_read_or_refused(tmp_path):
    content = write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN), kind="LABELMAP", syntax=RLELossless).read_bytes()
    random = np.random.default_rng(3)
    refused = 0
    for _ in range(150):
        damaged = np.frombuffer(content, np.uint8).copy()
        damaged[random.integers(132, len(content), 4)] = random.integers(0, 256, 4)
        (tmp_path / "b.dcm").write_bytes(damaged.tobytes())
        try:
            read_labels(tmp_path / "b.dcm")
        except (RefusedInputError, UsageError):
            refused += 1
    assert 20 < refused < 150


@pytest.mark.parametrize(("keyword", "value"), [("Rows", b"\7\0"), ("FrameOfReferenceUID", b"1.2\0")])
def test_an_element_twice_with_two_values_is_refused(tmp_path, keyword, value):
    """pydicom takes the second in silence."""
    write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN))
    assert read_labels(tmp_path / "a.dcm").numbers
    data = (tmp_path / "a.dcm").read_bytes()
    head = dicom_series.element_bytes(keyword, b"")[:6]
    end = data.index(head) + 8 + int.from_bytes(data[data.index(head) + 6 : data.index(head) + 8], "little")
    (tmp_path / "a.dcm").write_bytes(data[:end] + dicom_series.element_bytes(keyword, value) + data[end:])
    with refused(RefusedInputError, "a.dcm", "DICOM", keyword):
        read_labels(tmp_path / "a.dcm")


def test_real_segmentation_and_nrrd_agree(real_data):
    folder = real_data / "seg_and_labels"
    volume = read_volume(folder / "ct-3slice")
    seg, nrrd = (resample_labels(read_labels(folder / name), volume) for name in ("liver.dcm", "liver_seg.nrrd"))
    assert seg.exact and nrrd.exact and seg.voxels.any()
    assert np.array_equal(seg.voxels, nrrd.voxels)
    with refused(RefusedInputError, "GREEN", "ORANGE", 3017):
        read_labels(folder / "partial_overlaps.dcm")
    assert read_labels(folder / "partial_overlaps.dcm", ["green"]).find("GREEN") == 1


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
    segments = masks()
    path = write_seg(tmp_path / "a.dcm", segments, ct_slices(PLAN), kind="LABELMAP")
    edit_frames(path, lambda frames: [(px * (px == n), group) for n in (1, 2) for px, group in frames])
    taken = resample_labels(read_labels(path), ct_volume(tmp_path))
    for number, (_, mask) in enumerate(segments, start=1):
        assert np.array_equal(taken.voxels == number, mask)


def test_frames_of_a_label_map_that_contradict_each_other_are_refused(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN), kind="LABELMAP")
    edit_frames(
        path,
        lambda frames: [*frames, *((2 * (px == 1).astype(np.uint8), group) for px, group in frames if (px == 1).any())],
    )
    words = "two of its frames lie at one place, slice . of 5, and give 15 voxels two segments, 1 and 2$"
    with pytest.raises(RefusedInputError, match=words):
        read_labels(path)


def test_a_background_of_its_own_is_no_label(tmp_path):
    path = write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN), kind="LABELMAP")
    before = read_labels(path)
    edit_frames(path, lambda frames: [(np.where(px == 0, 9, px).astype(np.uint8), group) for px, group in frames])
    spoil(path, PixelPaddingValue=9)
    assert np.array_equal(read_labels(path).voxels, before.voxels)
    edit_frames(path, lambda frames: [(np.where(px == 1, 0, px).astype(np.uint8), group) for px, group in frames])
    with refused(RefusedInputError, "segment", "background", 0, 9):
        read_labels(path)


def test_equal_frames_of_a_segment_are_joined_and_different_ones_refused(tmp_path):
    """Equal frames are one; with other pixels they are two states of one segment, as in several points in time."""
    path = write_seg(tmp_path / "a.dcm", masks(), ct_slices(PLAN))
    before = read_labels(path)
    ds = pydicom.dcmread(path)
    groups, bits = list(ds.PerFrameFunctionalGroupsSequence), ds.pixel_array.astype(np.uint8)
    for extra, equal in ((bits[1], True), (bits[1] * 0, False)):
        ds.NumberOfFrames = len(groups) + 1
        ds.PerFrameFunctionalGroupsSequence = [*groups, groups[1]]
        ds.PixelData = np.packbits(np.concatenate([bits, extra[None]]).ravel(), bitorder="little").tobytes() + b"\0"
        ds.save_as(path)
        if equal:
            assert np.array_equal(read_labels(path).voxels, before.voxels)
            continue
        with refused(RefusedInputError, "slice", "segment", 1, 5):
            read_labels(path)
