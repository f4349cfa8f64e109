"""Multi-frame images that are wrong, old or hostile: refused with file, frame and tag, and nothing worse."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest
from dicom_series import Plan, make_dataset, save_dataset, set_raw, set_values, write_series
from enhanced_series import (
    assert_right,
    frame_groups,
    item,
    make_enhanced,
    real_world,
    refusal,
    without_rescale,
    write_enhanced,
)
from pydicom.dataset import Dataset
from refusals import refused
from tolerances import THOUSAND_FRAMES_S

from clrecon.errors import NoDicomError, RefusedInputError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.headers import multiframe
from clrecon.reading.dicom.parse.values import ValueProblem


def per_frame(change, only=None):
    """A change of the groups of each frame, or of `only` one, from 0."""

    def spoil(ds):
        for number, groups in enumerate(ds.PerFrameFunctionalGroupsSequence):
            if only is None or number == only:
                change(groups)

    return spoil


def drop(keyword, inner=None, only=2):
    """Take a group, or an element of it, from a frame: from the third, which messages call frame 3."""

    def change(groups):
        if inner is None:
            delattr(groups, keyword)
        else:
            delattr(getattr(groups, keyword)[0], inner)

    return per_frame(change, only)


def put(keyword, only=2, **values):
    """Give a frame, the third, a group of such values."""

    def change(groups):
        setattr(groups, keyword, [item(**values)])

    return per_frame(change, only)


def set_frames(text):
    return lambda ds: set_raw("NumberOfFrames", text)(ds, 0)


PVT = "PixelValueTransformationSequence"
FAULTS = {
    "no position": (drop("PlanePositionSequence"), "mf frame 3: ImagePositionPatient (0020,0032) is missing or empty"),
    "empty position": (
        per_frame(lambda groups: setattr(groups, "PlanePositionSequence", []), 2),
        "mf frame 3: ImagePositionPatient (0020,0032) is missing or empty",
    ),
    "position without a value": (
        drop("PlanePositionSequence", "ImagePositionPatient"),
        "mf frame 3: ImagePositionPatient (0020,0032) is missing or empty",
    ),
    "position of two numbers": (
        put("PlanePositionSequence", ImagePositionPatient=[1, 2]),
        "mf frame 3: ImagePositionPatient (0020,0032) is '1.0\\2.0', expected 3 finite numbers",
    ),
    "two positions": (
        per_frame(lambda groups: groups.PlanePositionSequence.append(item(ImagePositionPatient=[1, 2, 3])), 2),
        "mf frame 3: PlanePositionSequence (0020,9113) holds 2 items, expected 1",
    ),
    "no orientation": (
        drop("PlaneOrientationSequence"),
        "mf frame 3: ImageOrientationPatient (0020,0037) is missing or empty",
    ),
    "no spacing": (drop("PixelMeasuresSequence"), "mf frame 3: PixelSpacing (0028,0030) is missing or empty"),
    "spacing 0": (
        put("PixelMeasuresSequence", PixelSpacing=[0, 0]),
        "mf frame 3: PixelSpacing (0028,0030) is '0.0\\0.0'",
    ),
    "other spacing": (put("PixelMeasuresSequence", PixelSpacing=[0.7, 0.6]), "PixelSpacing differs within the series"),
    "slope 0": (put(PVT, RescaleSlope=0, RescaleIntercept=0), "mf frame 3: RescaleSlope (0028,1053) is '0.0'"),
    "geometry at the top level": (
        lambda ds: (drop("PlaneOrientationSequence")(ds), setattr(ds, "ImageOrientationPatient", [1, 0, 0, 0, 1, 0])),
        "mf frame 3: ImageOrientationPatient (0020,0037) is missing or empty",
    ),
    "no groups": (
        lambda ds: delattr(ds, "PerFrameFunctionalGroupsSequence"),
        "mf: PerFrameFunctionalGroupsSequence (5200,9230) is missing or empty",
    ),
    "no shared group": (
        lambda ds: (delattr(ds, "SharedFunctionalGroupsSequence"), drop("PixelMeasuresSequence", only=None)(ds)),
        "mf frame 1: PixelSpacing (0028,0030) is missing or empty",
    ),
    "two shared groups": (
        lambda ds: ds.SharedFunctionalGroupsSequence.append(Dataset()),
        "mf: SharedFunctionalGroupsSequence (5200,9229) holds 2 items, expected 1",
    ),
    "empty groups": (
        lambda ds: setattr(ds, "PerFrameFunctionalGroupsSequence", [Dataset() for _ in range(7)]),
        "mf frame 1: PixelSpacing (0028,0030) is missing or empty",
    ),
    "shared and own differ": (
        lambda ds: setattr(ds.SharedFunctionalGroupsSequence[0], PVT, [item(RescaleSlope=2, RescaleIntercept=0)]),
        f"mf frame 1: {PVT} (0028,9145) is in the shared and in the frame's groups, and they differ",
    ),
    "fewer frames than groups": (
        set_frames("6"),
        "mf: NumberOfFrames (0028,0008) is 6, PerFrameFunctionalGroupsSequence (5200,9230) holds 7 items",
    ),
    "more frames than groups": (
        set_frames("8"),
        "mf: NumberOfFrames (0028,0008) is 8, PerFrameFunctionalGroupsSequence (5200,9230) holds 7 items",
    ),
    "no frames": (set_frames("0"), "mf: NumberOfFrames (0028,0008) is '0', expected a whole number from 1 to 65536"),
    "negative frames": (set_frames("-7"), "mf: NumberOfFrames (0028,0008) is '-7', expected a whole number"),
    "frames in words": (set_frames("seven"), "mf: NumberOfFrames (0028,0008) is 'seven', expected a whole number"),
    "no number of frames": (
        lambda ds: delattr(ds, "NumberOfFrames"),
        "mf: NumberOfFrames (0028,0008) is missing or empty, expected a whole number",
    ),
    "fault 39: 2^31 - 1 frames": (set_frames("2147483647"), "mf: NumberOfFrames (0028,0008) is '2147483647'"),
    "fault 39: 65535 x 65535": (
        lambda ds: (setattr(ds, "Rows", 65535), setattr(ds, "Columns", 65535)),
        "truncated: 60127707150 bytes of pixels expected (7 x 65535 x 65535 x 16 bit), 420 found",
    ),
    "short pixels": (
        lambda ds: setattr(ds, "PixelData", ds.PixelData[:-60]),
        "truncated: 420 bytes of pixels expected (7 x 6 x 5 x 16 bit), 360 found",
    ),
    "colour": (
        put("CTImageFrameTypeSequence", FrameType=["DERIVED", "PRIMARY", "VOLUME", "NONE"], PixelPresentation="COLOR"),
        "mf frame 3: PixelPresentation (0008,9205) is 'COLOR', expected MONOCHROME",
    ),
    "bent": (
        put("CTImageFrameTypeSequence", FrameType=["DERIVED"], VolumetricProperties="DISTORTED"),
        "mf frame 3: VolumetricProperties (0008,9206) is 'DISTORTED': the frame is no plane of the patient",
    ),
    "rendered": (
        put("CTImageFrameTypeSequence", FrameType=["DERIVED"], VolumeBasedCalculationTechnique="SURFACE_RENDER"),
        "mf frame 3: VolumeBasedCalculationTechnique (0008,9207) is 'SURFACE_RENDER'",
    ),
    "mixed types": (
        lambda ds: (drop("CTImageFrameTypeSequence")(ds), setattr(ds, "ImageType", ["MIXED", "PRIMARY"])),
        "mf frame 3: FrameType (0008,9007) is missing, and ImageType (0008,0008) is MIXED",
    ),
    "real world NaN": (
        lambda ds: without_rescale([real_world(float("nan"), 0.0)])(ds),
        "mf frame 1: RealWorldValueSlope (0040,9225) is nan, expected a finite number",
    ),
    "part 0": (
        lambda ds: (setattr(ds, "ConcatenationUID", "1.2.3"), setattr(ds, "InConcatenationNumber", 0)),
        "mf: InConcatenationNumber (0020,9162) is missing or 0",
    ),
    "one place twice": (
        lambda ds: setattr(frame_groups(ds, 3), "PlanePositionSequence", frame_groups(ds, 2).PlanePositionSequence),
        "no element of their headers parts them into phases: mf frame 3, mf frame 4",
    ),
}


@pytest.mark.filterwarnings("ignore:Invalid value for VR IS")
@pytest.mark.parametrize("change, words", FAULTS.values(), ids=FAULTS)
def test_faults_of_multi_frame_images_are_refused_by_name(tmp_path, change, words):
    write_enhanced(tmp_path / "mf", change=change, shared=())
    start = time.process_time()
    assert words in refusal(tmp_path)
    assert time.process_time() - start < THOUSAND_FRAMES_S
    assert list_series(tmp_path).series[0].problems


def test_larger_series_of_frames_that_is_faulty_is_refused_and_not_passed_over(tmp_path):
    write_series(tmp_path, Plan(series=1, shape=(5, 5, 6)))
    write_enhanced(tmp_path / "mf", Plan(series=2), drop("PlanePositionSequence"), shared=())
    assert "series 2: mf frame 3: ImagePositionPatient" in refusal(tmp_path)
    assert [entry.slices for entry in list_series(tmp_path).series] == [5, 7]


@pytest.mark.parametrize("frames", [3, 300])
def test_classic_image_of_many_frames_is_refused_as_their_places_are_not_known(tmp_path, frames):
    ds = make_dataset(Plan(), 0)
    ds.NumberOfFrames = frames
    ds.add_new(0x00201041, "DS", "1")
    ds.PixelData *= frames
    save_dataset(ds, tmp_path / "old")
    assert f"old: multi-frame image of {frames} frames, SOP class 1.2.840.10008.5.1.4.1.1.2: the places" in refusal(
        tmp_path
    )


def test_slices_that_each_state_one_frame_are_read(tmp_path):
    plan = write_series(tmp_path, change=set_values(NumberOfFrames=1))
    assert_right(read_volume(tmp_path), plan)


def test_frames_of_mr_are_refused(tmp_path):
    write_enhanced(tmp_path / "mf", change=lambda ds: setattr(ds, "Modality", "MR"))
    with refused(NoDicomError, "MR", "CT", 1):  # series of MR
        read_volume(tmp_path)


def test_frames_of_a_secondary_capture_are_refused(tmp_path):
    def to_capture(ds):
        ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = "1.2.840.10008.5.1.4.1.1.7.3"

    write_enhanced(tmp_path / "mf", change=to_capture)
    assert "mf: secondary capture (SOP class 1.2.840.10008.5.1.4.1.1.7.3)" in refusal(tmp_path)


# --- hostile bytes ---


def nested_sequences(levels):
    """A private sequence of undefined length, `levels` deep, to stand in place of an element of the same length."""
    head = b"\x11\x00\x10\x10SQ\0\0\xff\xff\xff\xff"
    opened, closed = b"\xfe\xff\x00\xe0\xff\xff\xff\xff", b"\xfe\xff\x0d\xe0\0\0\0\0"
    end = b"\xfe\xff\xdd\xe0\0\0\0\0"
    within = levels - 1
    return head + (opened + head) * within + end + (closed + end) * within


def write_nested(path, *, levels):
    payload = nested_sequences(levels)
    marker = bytes([0xA5]) * (len(payload) - 12)
    plan = write_enhanced(path, change=lambda ds: frame_groups(ds, 1).add_new(0x00111010, "OB", marker))
    data = path.read_bytes()
    place = data.index(marker) - 12
    path.write_bytes(data[:place] + payload + data[place + len(payload) :])
    return plan


def test_fault_37_sequences_nested_64_deep_in_the_groups_are_read(tmp_path):
    plan = write_nested(tmp_path / "mf", levels=64)
    assert_right(read_volume(tmp_path), plan)


@pytest.mark.parametrize("levels", [65, 5000])
def test_fault_37_sequences_nested_deeper_in_the_groups_are_refused(tmp_path, levels):
    write_nested(tmp_path / "mf", levels=levels)
    assert "sequences are nested too deep" in refusal(tmp_path)


SHARED_GROUPS = b"\x00\x52\x29\x92"  # SharedFunctionalGroupsSequence, with which the groups begin


def test_frames_whose_file_is_cut_at_every_seventh_byte_from_their_groups_on_are_refused(tmp_path):
    write_enhanced(tmp_path / "mf", Plan(shape=(2, 2, 2)))
    data = (tmp_path / "mf").read_bytes()
    for end in range(data.index(SHARED_GROUPS), len(data), 7):
        (tmp_path / "mf").write_bytes(data[:end])
        assert "mf: " in refusal(tmp_path) or "truncated" in refusal(tmp_path)


@pytest.mark.untraced
def test_frames_with_every_third_byte_from_their_groups_on_wrong_are_read_or_refused(tmp_path):
    plan = write_enhanced(tmp_path / "mf", Plan(shape=(2, 2, 2)))
    data = bytearray((tmp_path / "mf").read_bytes())
    refusals = 0
    for place in range(data.index(SHARED_GROUPS), len(data), 3):
        old, data[place] = data[place], data[place] ^ 0xFF
        (tmp_path / "mf").write_bytes(data)
        try:
            assert read_volume(tmp_path).voxels.shape == plan.shape
        except (RefusedInputError, NoDicomError):
            refusals += 1
        data[place] = old
    assert refusals > 100  # measured 134 of 198


def test_frames_with_thousands_of_empty_items_are_refused(tmp_path):
    """Empty items cost 8 bytes each: as many as a file holds must not become objects."""
    ds = make_enhanced(Plan(shape=(7, 5, 6)))
    frame_groups(ds, 0).PlanePositionSequence = [Dataset() for _ in range(2000)]
    save_dataset(ds, tmp_path / "mf")
    most = multiframe.ITEMS_PER_FRAME * (7 + 1)  # those of the shared groups count as a frame's
    assert f"the sequences hold more than {most} items" in refusal(tmp_path)


def test_header_of_frames_beyond_256_mib_is_refused_without_reading_it(tmp_path):
    long: Any = SimpleNamespace(pixel_offset=2**28 + 1)
    with refused(ValueProblem, 2**28 + 1, 2**28):  # bytes, and the most
        multiframe._read_header_bytes(tmp_path / "no file", long)
