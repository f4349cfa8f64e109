"""Enhanced and legacy converted multi-frame CT: every frame at its place with its own rescale, or a reason."""

from __future__ import annotations

import time
import warnings

import numpy as np
import pydicom
import pytest
from dicom_series import ROOT, Plan, save_dataset, write_series
from enhanced_series import (
    assert_right,
    compress,
    frame_groups,
    item,
    make_concatenation,
    real_world,
    refusal,
    without_rescale,
    write_enhanced,
)
from pydicom.dataset import Dataset
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    JPEG2000Lossless,
    JPEGLSLossless,
    RLELossless,
)
from tolerances import AFFINE_MM, THOUSAND_FRAMES_S
from variants import daily

from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.headers.header import read_headers
from clrecon.reading.dicom.headers.multiframe import DIMENSIONS_OF_PLACE

SHUFFLED = (4, 0, 6, 2, 5, 1, 3)
PLANS = {
    "straight": Plan(),
    "oblique": Plan(angles=(20, -35, 50)),
    "sagittal": Plan(angles=(0, 90, 90)),
    "tilt -20, oblique": Plan(tilt_deg=-20, angles=(5, 7, -11)),
    "far away": Plan(origin=(1e5, -1e5, 9.9e4), decimals=6),
}


# --- right ---


def headers_of_ct(path):
    """The headers of a file that is CT."""
    headers = read_headers(path)
    assert isinstance(headers, list)
    return headers


def test_dimensions_that_number_places_are_the_seven_of_the_standard():
    assert {pydicom.datadict.keyword_for_tag(tag) for tag in DIMENSIONS_OF_PLACE} == {
        "ImagePositionPatient", "ImageOrientationPatient", "InStackPositionNumber", "SliceLocation", "InstanceNumber",
        "PlanePositionSequence", "PlaneOrientationSequence",
    }  # fmt: skip


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
@pytest.mark.parametrize("order", [range(7), range(6, -1, -1), SHUFFLED], ids=["sorted", "reversed", "shuffled"])
def test_fault_22_frames_lie_where_they_were_written(tmp_path, plan, order):
    write_enhanced(tmp_path / "mf", plan, order=order)
    volume = read_volume(tmp_path)
    assert_right(volume, plan)
    assert volume.spacing[:2] == pytest.approx(plan.pixel_spacing[::-1])  # di, dj
    assert [warning for warning in volume.report["warnings"] if "tilt" not in warning] == []


def test_frames_of_one_file_are_counted_as_slices(tmp_path):
    plan = write_enhanced(tmp_path / "mf")
    volume = read_volume(tmp_path)
    assert volume.voxels.dtype == np.int16
    assert (volume.report["files"]["used"], volume.report["slices"]) == (1, plan.shape[0])


@pytest.mark.parametrize(
    "shared",
    [
        (),
        ("PlaneOrientationSequence", "PixelMeasuresSequence", "PixelValueTransformationSequence"),
        ("PixelMeasuresSequence",),
    ],
    ids=["all per frame", "all shared", "some shared"],
)
def test_frames_are_placed_by_groups_that_are_shared_or_per_frame(tmp_path, shared):
    plan = write_enhanced(tmp_path / "mf", Plan(angles=(5, 7, -11)), shared=shared, order=SHUFFLED)
    assert_right(read_volume(tmp_path), plan)


def test_fault_22_every_frame_has_its_own_rescale(tmp_path):
    plan = write_enhanced(tmp_path / "mf", Plan(shape=(4, 5, 6)), order=(2, 0, 3, 1), slopes=(1, 2, 3, 4))
    volume = read_volume(tmp_path)
    expected = np.stack([plan.stored(k).astype(int) * (k + 1) + plan.intercept for k in range(4)])
    assert_right(volume, plan, hu=expected)
    lowest_and_highest_slope, intercepts = [1.0, 4.0], [plan.intercept, plan.intercept]
    assert volume.report["rescale"] == {"slope": lowest_and_highest_slope, "intercept": intercepts, "type": "HU"}


@pytest.mark.parametrize(
    "syntax", [ExplicitVRLittleEndian, ImplicitVRLittleEndian, DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian]
)
@pytest.mark.parametrize("undefined", [False, True], ids=["lengths", "delimiters"])
def test_enhanced_images_of_every_uncompressed_encoding_are_read(tmp_path, syntax, undefined):
    def leave_lengths_out(ds):
        for element in ds:
            if element.VR == "SQ":
                element.is_undefined_length = undefined
                for one in element.value:
                    one.is_undefined_length_sequence_item = undefined
                    leave_lengths_out(one)

    plan = write_enhanced(tmp_path / "mf", Plan(syntax=syntax), leave_lengths_out, order=SHUFFLED, slopes=range(1, 8))
    expected = np.stack([plan.stored(k).astype(int) * (k + 1) + plan.intercept for k in range(7)])
    assert_right(read_volume(tmp_path), plan, hu=expected)


@pytest.mark.parametrize("syntax", daily(1, [RLELossless, JPEG2000Lossless, JPEGLSLossless]))
@pytest.mark.parametrize(
    "table, fragments", [("basic", 1), ("none", 1), ("extended", 1), ("basic", 3), ("none", 3)], ids=str
)
def test_compressed_frames_of_enhanced_images_are_read(tmp_path, syntax, table, fragments):
    if syntax == RLELossless and fragments > 1:
        pytest.skip("a frame of RLE is one fragment (PS3.5 A.4.2)")
    plan = Plan(shape=(5, 32, 48), signed=False)
    write_enhanced(
        tmp_path / "mf", plan, lambda ds: compress(ds, syntax, table=table, fragments=fragments), order=(3, 1, 4, 0, 2)
    )
    volume = read_volume(tmp_path)
    assert_right(volume, plan)
    assert volume.report["transfer_syntaxes"] == [str(syntax)]


def test_frames_in_several_files_are_read_as_one_stack(tmp_path):
    plan = Plan(angles=(20, -35, 50))
    for number, order in enumerate([(6, 2), (0, 4, 5), (3, 1)]):
        write_enhanced(tmp_path / f"mf{number}", plan, order=order)
    volume = read_volume(tmp_path)
    assert_right(volume, plan)
    assert (volume.report["files"]["used"], volume.report["slices"]) == (3, plan.shape[0])


def test_frames_and_single_slices_of_one_series_are_read_as_one_stack(tmp_path):
    plan = write_series(tmp_path, Plan(leave_out=(2, 3, 4)))
    write_enhanced(tmp_path / "mf", plan, order=(3, 2, 4))
    assert_right(read_volume(tmp_path), plan)


def test_files_of_a_single_frame_are_read_as_one_stack(tmp_path):
    plan = Plan()
    for k in range(7):
        write_enhanced(tmp_path / f"{k}", plan, order=[k])
    assert_right(read_volume(tmp_path), plan)


def test_single_frame_is_named_by_its_file_alone(tmp_path):
    write_enhanced(tmp_path / "3", Plan(), order=[3])
    assert [header.name for header in headers_of_ct(tmp_path / "3")] == ["3"]


def test_padding_value_of_the_file_is_masked_in_its_frames(tmp_path):
    padding = 905  # the stored value of one voxel
    plan = write_enhanced(tmp_path / "mf", change=lambda ds: setattr(ds, "PixelPaddingValue", padding))
    volume = read_volume(tmp_path)
    (k, j, i), *others = np.argwhere(plan.hu() == padding + plan.intercept)
    assert others == []
    assert volume.voxels[k, j, i] != padding + plan.intercept
    assert volume.report["padding_share"] == pytest.approx(1 / plan.hu().size)


def test_larger_one_of_a_series_of_frames_and_a_series_of_slices_is_read(tmp_path):
    write_series(tmp_path, Plan(series=1, shape=(5, 5, 6)))
    plan = write_enhanced(tmp_path / "mf", Plan(series=2, shape=(7, 5, 6)))
    assert_right(read_volume(tmp_path), plan)
    listing = list_series(tmp_path)
    assert listing.chosen == 2
    assert [series.slices for series in listing.series] == [5, 7]


# --- what frames say ---


def test_frames_are_named_by_their_file_and_number_from_1(tmp_path):
    write_enhanced(tmp_path / "mf", order=SHUFFLED)  # 7 frames
    headers = headers_of_ct(tmp_path / "mf")
    assert [header.frame for header in headers] == list(range(7))
    assert [header.name for header in headers] == [f"mf frame {number}" for number in range(1, 8)]
    assert {header.frames for header in headers} == {7}


def write_with_localizer_frames(path):
    """Frames 1 and 7 of 7 are localizers."""

    def spoil(ds):
        for number in (0, 6):
            frame_type = frame_groups(ds, number).CTImageFrameTypeSequence[0]
            frame_type.FrameType = ["ORIGINAL", "PRIMARY", "LOCALIZER", "NONE"]

    write_enhanced(path, Plan(shape=(7, 5, 6)), change=spoil, shared=("PixelMeasuresSequence",))


def test_localizer_frames_are_listed_as_another_series(tmp_path):
    write_with_localizer_frames(tmp_path / "mf")
    stack, localizers = list_series(tmp_path).series
    assert (stack.slices, localizers.slices) == (5, 2)
    assert localizers.problems == ["localizer images, not a stack"]


def test_frames_beside_localizers_are_read_without_them(tmp_path):
    write_with_localizer_frames(tmp_path / "mf")
    assert np.array_equal(read_volume(tmp_path).voxels, Plan().hu()[1:6])


def test_frames_of_two_orientations_in_one_file_are_listed_as_two_series(tmp_path):
    def turn(ds):
        for number in (0, 1):
            frame_groups(ds, number).PlaneOrientationSequence[0].ImageOrientationPatient = [0, 1, 0, 0, 0, -1]

    plan = write_enhanced(tmp_path / "mf", change=turn, shared=("PixelMeasuresSequence",))
    assert [entry.slices for entry in list_series(tmp_path).series] == [plan.shape[0] - 2, 2]


PHASES = {
    "temporal index": ("FrameContentSequence", "TemporalPositionIndex", (1, 2), "TemporalPositionIndex", ("1", "2")),
    "time offset": (
        "TemporalPositionSequence",
        "TemporalPositionTimeOffset",
        (0.25, 1.5),
        "TemporalPositionTimeOffset",
        ("0.25", "1.5"),
    ),
    "cardiac phase": (
        "CardiacSynchronizationSequence",
        "NominalPercentageOfCardiacPhase",
        (40.0, 75.0),
        "NominalPercentageOfCardiacPhase",
        ("40", "75"),
    ),
    "respiratory phase": (
        "RespiratorySynchronizationSequence",
        "NominalPercentageOfRespiratoryPhase",
        (0.0, 50.0),
        "NominalPercentageOfRespiratoryPhase",
        ("0", "50"),
    ),
    "stack": ("FrameContentSequence", "StackID", ("a", "b"), "StackID", ("a", "b")),
    "acquisition": ("FrameContentSequence", "FrameAcquisitionNumber", (7, 8), "FrameAcquisitionNumber", ("7", "8")),
    "time": (
        "FrameContentSequence",
        "FrameAcquisitionDateTime",
        ("20200101101010", "20200101101020"),
        "AcquisitionTime",
        ("101010", "101020"),
    ),
    "energy": ("CTXRayDetailsSequence", "KVP", (80, 140), "KVP", ("80.0", "140.0")),
    "kernel": ("CTReconstructionSequence", "ConvolutionKernel", ("B30", "B70"), "ConvolutionKernel", ("B30", "B70")),
    "legacy": (
        "UnassignedPerFrameConvertedAttributesSequence",
        "AcquisitionNumber",
        (1, 2),
        "AcquisitionNumber",
        ("1", "2"),
    ),
    "dimension": (
        "FrameContentSequence",
        "DimensionIndexValues",
        ([1, 3], [1, 4]),
        "DimensionIndexValues ContrastBolusAgentNumber",
        ("3", "4"),
    ),
}


def write_two_phases(path, syntax, sequence, keyword, values):
    """Seven frames, and again at the same places with other pixels; an element is one value, then the other."""

    def spoil(ds):
        ds.DimensionIndexSequence.append(item(DimensionIndexPointer=0x00189337, FunctionalGroupPointer=0x00189341))
        for number, groups in enumerate(ds.PerFrameFunctionalGroupsSequence):
            if sequence not in groups:
                setattr(groups, sequence, [Dataset()])
            setattr(getattr(groups, sequence)[0], keyword, values[number // 7])

        pixels = np.frombuffer(ds.PixelData, np.uint8).copy()
        pixels[pixels.size // 2 :] ^= 1  # else they are copies
        ds.PixelData = pixels.tobytes()

    return write_enhanced(path, Plan(syntax=syntax), spoil, order=[*range(7), *range(7)])


PHASE_SYNTAXES = pytest.mark.parametrize(
    "syntax", daily(1, [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian])
)
TWO_PHASES = pytest.mark.parametrize("sequence, keyword, values, name, expected", PHASES.values(), ids=PHASES)


@PHASE_SYNTAXES
@TWO_PHASES
def test_frames_have_the_element_that_tells_phases_apart(tmp_path, syntax, sequence, keyword, values, name, expected):
    write_two_phases(tmp_path / "mf", syntax, sequence, keyword, values)
    headers = headers_of_ct(tmp_path / "mf")
    assert [dict(header.phase).get(name) for header in headers] == [expected[0]] * 7 + [expected[1]] * 7
    assert "DimensionIndexValues ImagePositionPatient" not in dict(headers[0].phase)  # a number of places


@PHASE_SYNTAXES
@TWO_PHASES
def test_two_frames_at_each_place_are_refused_as_phases_and_read_by_number(
    tmp_path, syntax, sequence, keyword, values, name, expected
):
    plan = write_two_phases(tmp_path / "mf", syntax, sequence, keyword, values)
    assert f"2 phases at the same places, choose one with phase: [1: {name} " in refusal(tmp_path)
    assert_right(read_volume(tmp_path, phase=1), plan)
    assert [phase["slices"] for phase in list_series(tmp_path).series[0].phases] == [7, 7]


def test_element_of_a_frame_goes_before_the_shared_one(tmp_path):
    def spoil(ds):
        ds.SharedFunctionalGroupsSequence[0].CTReconstructionSequence = [item(ConvolutionKernel="B30")]
        frame_groups(ds, 2).CTReconstructionSequence = [item(ConvolutionKernel="B70")]

    write_enhanced(tmp_path / "mf", change=spoil)
    kernels = [dict(header.phase)["ConvolutionKernel"] for header in headers_of_ct(tmp_path / "mf")]
    assert kernels == ["B30", "B30", "B70", "B30", "B30", "B30", "B30"]


# --- rescale from elsewhere ---


@pytest.mark.parametrize("kind", [None, "US"])
def test_frames_without_a_rescale_are_in_hu_by_their_real_world_values_with_a_warning(tmp_path, kind):
    to_density = real_world(slope=0.1, intercept=7.0, code="mg/cm3")
    to_hu = real_world(slope=2.0, intercept=-1000.0)
    plan = write_enhanced(tmp_path / "mf", change=without_rescale([to_density, to_hu], kind=kind))
    volume = read_volume(tmp_path)
    stored = plan.hu() - plan.intercept
    assert_right(volume, plan, hu=2 * stored - 1000)
    assert volume.report["rescale"]["type"] == "HU"
    assert volume.report["warnings"] == [
        ("RescaleType is US" if kind else "no RescaleSlope") + ": HU by RealWorldValueMappingSequence (0040,9096) "
        "(all slices)"
    ]


def test_rescale_to_hu_goes_before_real_world_values(tmp_path):
    mappings = [real_world(slope=2.0, intercept=-1000.0)]
    plan = write_enhanced(tmp_path / "mf", change=without_rescale(mappings, kind="HU"))
    assert_right(read_volume(tmp_path), plan)


def test_frames_without_a_rescale_and_values_in_hu_are_kept_with_a_warning(tmp_path):
    to_density = real_world(slope=0.1, intercept=7.0, code="mg/cm3")
    plan = write_enhanced(tmp_path / "mf", change=without_rescale([to_density]))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu() - plan.intercept)  # as stored
    assert "no RescaleSlope" in volume.report["warnings"][0]


def test_intercept_outside_of_the_group_with_the_slope_is_not_used_and_warned_of(tmp_path):
    def spoil(ds):
        ds.RescaleIntercept = 500
        for groups in ds.PerFrameFunctionalGroupsSequence:
            del groups.PixelValueTransformationSequence[0].RescaleIntercept

    plan = write_enhanced(tmp_path / "mf", change=spoil)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu() - plan.intercept)  # as stored
    assert "no RescaleIntercept" in volume.report["warnings"][0]


def test_lossy_compression_of_one_frame_is_warned_of(tmp_path):
    def spoil(ds):
        frame_groups(ds, 2).UnassignedPerFrameConvertedAttributesSequence = [item(LossyImageCompression="01")]

    plan = write_enhanced(tmp_path / "mf", change=spoil)
    _, _, z_mm = plan.position(2)
    assert read_volume(tmp_path).report["warnings"] == [
        f"lossy compression: the values are not those that were measured (1 of 7 slices, at {z_mm:.2f} mm)"
    ]


def test_computed_frames_are_warned_of(tmp_path):
    def spoil(ds):
        frame_type = frame_groups(ds, 1).CTImageFrameTypeSequence[0]
        frame_type.FrameType = ["DERIVED", "PRIMARY", "VOLUME", "SUBTRACTION"]
        frame_type.VolumeBasedCalculationTechnique = "MAX_IP"

    plan = write_enhanced(tmp_path / "mf", change=spoil, shared=())  # each frame has groups of its own
    _, _, z_mm = plan.position(1)
    assert read_volume(tmp_path).report["warnings"] == [
        f"computed frames (MAX_IP, SUBTRACTION): maybe not measured HU (1 of 7 slices, at {z_mm:.2f} mm)"
    ]


# --- concatenations ---


def write_parts(folder, plan, parts, leave_out=(), change=None, **how):
    """Write a concatenation as the files part1, part2, ...: the slices `parts[n]` of the plan in each."""
    for number, ds in enumerate(make_concatenation(plan, parts, **how), start=1):
        if change is not None:
            change(ds, number)
        if number not in leave_out:
            save_dataset(ds, folder / f"part{number}")


@pytest.mark.parametrize("say_total", [True, False], ids=["total", "no total"])
def test_parts_of_a_concatenation_are_read_as_one_stack(tmp_path, say_total):
    plan = Plan(angles=(20, -35, 50))
    write_parts(tmp_path, plan, [(6, 2, 0), (4, 5), (3, 1)], say_total=say_total)
    assert_right(read_volume(tmp_path), plan)


@pytest.mark.parametrize("lost, say_total", [(1, True), (2, True), (3, True), (1, False), (2, False)])
def test_concatenation_that_lacks_a_file_is_refused_with_its_number(tmp_path, lost, say_total):
    write_parts(tmp_path, Plan(), [(0, 1), (2, 3, 4), (5, 6)], leave_out=(lost,), say_total=say_total)
    assert f"file {lost} of the 3 of a concatenation is missing" in refusal(tmp_path)


def test_concatenation_whose_part_starts_too_late_is_refused_with_its_frames(tmp_path):
    def shift(ds, number):
        if number == 3:
            ds.ConcatenationFrameOffsetNumber = 6

    write_parts(tmp_path, Plan(), [(0, 1), (2, 3, 4), (5, 6)], change=shift)
    assert "file 3 of a concatenation starts at frame 6, the one before it ends at frame 5" in refusal(tmp_path)


# --- other opinions ---


def test_corners_of_an_enhanced_image_have_the_places_and_values_that_highdicom_reads(tmp_path):
    highdicom = pytest.importorskip("highdicom")  # not there for Python 3.14

    plan = Plan(tilt_deg=0, angles=(20, -35, 50))
    write_enhanced(tmp_path / "mf", plan, order=SHUFFLED, slopes=range(1, 8))
    volume = read_volume(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = highdicom.imread(tmp_path / "mf").get_volume(apply_real_world_transform=False)
    size = np.array(plan.shape)
    corners = np.array([(i, j, k) for i in (0, size[2] - 1) for j in (0, size[1] - 1) for k in (0, size[0] - 1)])
    lps = volume.ijk_to_lps(corners)
    index = np.rint(theirs.map_reference_to_indices(lps)).astype(int)
    assert np.abs(theirs.map_indices_to_reference(index) - lps).max() < AFFINE_MM
    i, j, k = corners.T
    ours = volume.voxels[k, j, i]
    assert np.array_equal(theirs.array[tuple(index.T)], ours)


@pytest.mark.parametrize("plan", [Plan(), Plan(tilt_deg=12, angles=(5, 7, -11))], ids=["straight", "tilted"])
def test_series_that_highdicom_converts_to_frames_is_read_as_the_same_volume(tmp_path, plan):
    legacy = pytest.importorskip("highdicom.legacy")

    def complete(ds, k):
        ds.StudyInstanceUID = f"{ROOT}.5"
        for keyword in ("StudyDate", "StudyTime", "AccessionNumber", "PatientBirthDate", "PatientSex", "StudyID"):
            setattr(ds, keyword, "")
        ds.AcquisitionNumber = 4
        ds.RescaleSlope = k + 1

    write_series(tmp_path / "classic", plan, complete)
    classic = [pydicom.dcmread(path) for path in sorted((tmp_path / "classic").iterdir())]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        converted = legacy.LegacyConvertedEnhancedCTImage(
            classic, series_instance_uid=f"{ROOT}.6", series_number=2, sop_instance_uid=f"{ROOT}.7", instance_number=1
        )
        converted.save_as(tmp_path / "mf")
    expected, volume = read_volume(tmp_path / "classic"), read_volume(tmp_path / "mf")
    assert np.array_equal(volume.voxels, expected.voxels)
    assert np.array_equal(volume.affine, expected.affine)
    assert volume.report["warnings"] == expected.report["warnings"]
    assert ("FrameAcquisitionNumber", "4") in headers_of_ct(tmp_path / "mf")[0].phase


def test_real_legacy_converted_image_lies_in_its_place(real_data):
    volume = read_volume(real_data / "seg_and_labels" / "enhanced_24x38x3")
    expected = np.diag([0.7, 0.7, 2.5, 1.0])
    expected[:3, 3] = 46.4649, 5.01881, -177.75  # frame 1 is the lowest: stored from the head down
    assert np.abs(volume.affine - expected).max() < AFFINE_MM
    ds = pydicom.dcmread(real_data / "seg_and_labels" / "enhanced_24x38x3" / "mf.dcm")
    assert np.array_equal(volume.voxels, ds.pixel_array)
    assert volume.report["warnings"] == ["RescaleType is 'US': the values are not HU (all slices)"]


@pytest.mark.release
@pytest.mark.untraced
def test_headers_of_a_thousand_frames_are_read_within_a_second_of_the_processor(tmp_path):
    plan = write_enhanced(tmp_path / "mf", Plan(shape=(1000, 2, 2)))
    read_headers(tmp_path / "mf")  # modules are loaded
    start = time.process_time()
    headers = headers_of_ct(tmp_path / "mf")
    assert time.process_time() - start < THOUSAND_FRAMES_S
    assert len(headers) == 1000
    assert headers[999].position_mm == pytest.approx(tuple(plan.position(999)))
