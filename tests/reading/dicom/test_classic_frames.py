"""One classic CT image with many frames, as cone beams write it: read where its geometry is whole, else refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import tolerances
from dicom_series import Plan, make_dataset, save_dataset, set_raw
from pydicom.tag import Tag
from pydicom.uid import RLELossless

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.headers.multiframe import PLACE_POINTERS

PLAN = Plan(shape=(7, 5, 6), gap=1.25)
OBLIQUE = replace(PLAN, angles=(10.0, -5.0, 30.0))


def make_frames(plan=PLAN, *, order=None, **elements):
    """All slices of a plan as frames in this order of places; the position is that of the first frame."""
    order = range(plan.shape[0]) if order is None else order
    ds = make_dataset(plan, order[0])
    ds.NumberOfFrames = len(order)
    ds.SpacingBetweenSlices = plan.gap
    ds.PixelData = b"".join(plan.stored(k).tobytes() for k in order)
    for keyword, value in elements.items():
        if value is None:
            delattr(ds, keyword)
        else:
            setattr(ds, keyword, value)
    return ds


def assert_voxels_and_places(volume, plan):
    assert np.array_equal(volume.voxels, plan.hu())
    corners = [(0, 0, 0), (5, 4, 6), (2, 3, 4)]
    assert volume.ijk_to_lps(corners) == pytest.approx(plan.truth(corners), abs=tolerances.AFFINE_MM)


def read_refusal(path):
    with pytest.raises(RefusedInputError) as caught:
        read_volume(path)
    return str(caught.value)


@pytest.mark.parametrize("plan", [PLAN, OBLIQUE], ids=["axial", "oblique"])
def test_frames_in_steps_of_the_stated_spacing_are_placed_with_a_warning(tmp_path, plan):
    save_dataset(make_frames(plan), tmp_path / "scan.dcm")
    volume = read_volume(tmp_path / "scan.dcm")
    assert_voxels_and_places(volume, plan)
    assert volume.report["warnings"] == [
        "7 frames in one classic CT image: they run from feet to head, along the normal of rows and columns in steps "
        "of SpacingBetweenSlices, 1.25 mm; no element says that they do not run the other way, and then the volume is "
        "mirrored: compare left and right with the scanner's pictures (all slices)"
    ]


def test_frames_of_one_file_are_counted_as_slices_and_pass_all_gates(tmp_path):
    save_dataset(make_frames(), tmp_path / "scan.dcm")
    report = read_volume(tmp_path / "scan.dcm").report
    assert (report["slices"], report["files"]["used"]) == (7, 1)
    assert [gate["name"] for gate in report["gates"] if gate["ok"] is False] == []


def test_frames_of_a_spacing_below_zero_run_against_the_normal(tmp_path):
    save_dataset(make_frames(order=range(6, -1, -1), SpacingBetweenSlices=-1.25), tmp_path / "scan")
    volume = read_volume(tmp_path)
    assert_voxels_and_places(volume, PLAN)
    assert "they run from head to feet, along the normal" in volume.report["warnings"][0]
    assert [gate["name"] for gate in volume.report["gates"] if gate["ok"] is False] == []


@pytest.mark.parametrize("plan", [PLAN, OBLIQUE], ids=["axial", "oblique"])
@pytest.mark.parametrize("down", [False, True])
def test_frames_run_the_way_that_their_offsets_say(tmp_path, plan, down):
    order = range(6, -1, -1) if down else range(7)
    offsets = [(k - order[0]) * plan.gap for k in order]
    save_dataset(
        make_frames(plan, order=order, GridFrameOffsetVector=offsets, SpacingBetweenSlices=None), tmp_path / "scan"
    )
    volume = read_volume(tmp_path)
    assert_voxels_and_places(volume, plan)
    way = "head to feet" if down else "feet to head"
    assert volume.report["warnings"] == [
        f"7 frames in one classic CT image: they run from {way}, as GridFrameOffsetVector says (all slices)"
    ]


@pytest.mark.parametrize("orientation", [(0, 0, 0), (180, 0, 0)], ids=["normal to the head", "normal to the feet"])
def test_frames_lie_at_the_z_that_their_offsets_are(tmp_path, orientation):
    plan = replace(PLAN, angles=orientation)
    z = [plan.position(k)[2] for k in range(7)]
    save_dataset(make_frames(plan, GridFrameOffsetVector=z), tmp_path / "scan")
    assert_voxels_and_places(read_volume(tmp_path), plan)


def test_frames_of_uneven_offsets_lie_at_their_own_places(tmp_path):
    plan = replace(PLAN, offsets={3: 0.2})
    offsets = [plan.position(k)[2] - plan.position(0)[2] for k in range(7)]
    save_dataset(make_frames(plan, GridFrameOffsetVector=offsets), tmp_path / "scan")
    volume = read_volume(tmp_path)
    assert volume.report["uneven"]
    assert_voxels_and_places(volume, plan)


def test_frames_in_no_order_lie_at_their_offsets_with_a_warning(tmp_path):
    order = [3, 0, 6, 1, 5, 2, 4]
    offsets = [(k - 3) * PLAN.gap for k in order]
    save_dataset(make_frames(PLAN, order=order, GridFrameOffsetVector=offsets), tmp_path / "scan")
    volume = read_volume(tmp_path)
    assert_voxels_and_places(volume, PLAN)
    assert "they are in no order, as GridFrameOffsetVector says" in volume.report["warnings"][0]


def test_compressed_frames_of_a_classic_image_are_read(tmp_path):
    ds = make_frames()
    ds.file_meta.TransferSyntaxUID = PLAN.syntax
    ds.compress(RLELossless, generate_instance_uid=False)
    save_dataset(ds, tmp_path / "scan")
    assert_voxels_and_places(read_volume(tmp_path), PLAN)


@pytest.mark.parametrize("pointer", sorted(PLACE_POINTERS))
def test_frames_that_are_slices_by_their_pointer_are_read(tmp_path, pointer):
    save_dataset(make_frames(FrameIncrementPointer=Tag(pointer)), tmp_path / "scan")
    assert_voxels_and_places(read_volume(tmp_path), PLAN)


@pytest.mark.parametrize(
    ("elements", "words"),
    [
        ({"SpacingBetweenSlices": None}, "not known, without SpacingBetweenSlices or GridFrameOffsetVector: export"),
        (
            {"ImagePositionPatient": None, "PixelSpacing": None},
            "multi-frame image of 7 frames, SOP class 1.2.840.10008.5.1.4.1.1.2: the places of its frames are not "
            "known, without ImagePositionPatient, PixelSpacing: export the series as single slices or as Enhanced CT",
        ),
        ({"ImageOrientationPatient": None}, "without ImageOrientationPatient: export"),
        ({"SpacingBetweenSlices": 0}, "SpacingBetweenSlices (0018,0088) is '0.0', expected the distance of 7 frames"),
        ({"GridFrameOffsetVector": [0, 1, 2]}, "(3004,000C) is '0.0\\1.0\\2.0', expected 7 finite numbers"),
        (
            {"GridFrameOffsetVector": [5, 6, 7, 8, 9, 10, 11]},
            "GridFrameOffsetVector (3004,000C) begins with 5, expected 0, or in axial frames the z of",
        ),
        (
            {"FrameIncrementPointer": Tag(0x00181063)},
            "FrameIncrementPointer (0028,0009) does not say that its frames are slices, but names FrameTime: export",
        ),
        ({"NumberOfFrames": 8}, "truncated: 480 bytes of pixels expected (8 x 6 x 5 x 16 bit), 420 found"),
        ({"GridFrameOffsetVector": [0, 1, 2, 2, 3, 4, 5]}, "duplicate slices with different pixels at 1 place"),
        ({"GridFrameOffsetVector": [0, 1, 2, 4, 5, 6, 7]}, "1 slice missing between"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else None,
)
def test_frames_whose_places_are_not_known_are_refused_with_what_is_missing(tmp_path, elements, words):
    save_dataset(make_frames(**elements), tmp_path / "scan")
    said = read_refusal(tmp_path / "scan")
    assert words in said
    assert "name the folder" not in said


def test_one_slice_of_a_series_is_refused_with_the_advice_to_name_the_folder(tmp_path):
    save_dataset(make_dataset(PLAN, 0), tmp_path / "scan")
    assert "name the folder that holds them all" in read_refusal(tmp_path / "scan")


@pytest.mark.parametrize("text", ["65537", "2147483647"])
def test_numbers_of_frames_beyond_65536_are_refused(tmp_path, text):
    ds = make_frames()
    set_raw("NumberOfFrames", text)(ds, 0)
    save_dataset(ds, tmp_path / "scan")
    assert f"multi-frame image of {text} frames, SOP class" in read_refusal(tmp_path)
    assert list_series(tmp_path).series[0].slices == 1
