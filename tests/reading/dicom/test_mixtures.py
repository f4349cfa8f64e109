"""Two volumes half a gap apart, in one series: refused by whatever tells them apart, or told by their pixels."""

from __future__ import annotations

import numpy as np
import pytest
import tolerances
from dicom_series import Plan, write_series
from refusals import refused
from variants import daily, daily_rows

from clrecon.errors import RefusedInputError, UsageError
from clrecon.reading import list_series, read_volume
from clrecon.reading.common.likeness import judge_slices, measure_likeness
from clrecon.reading.dicom.stack.mixtures import alternates

GAP = 1.25  # mm between the slices of one volume
EACH = 12  # slices of one volume
STEP_HU = 300  # between the pixels of a volume and those of the next


def write_volumes(folder, *elements, offsets=None, slices=None, pixels=None, per_slice=0):
    """A volume for each mapping of elements (values, or functions of its own slice), a part of a gap apart.

    `pixels` are the stored values by volume and slice; else each volume is `STEP_HU` above the one before.
    """
    plans = []
    count = len(elements)
    for number, own in enumerate(elements):
        along = number * GAP / count if offsets is None else offsets[number]
        shape = (EACH if slices is None else slices[number], *(Plan().shape[1:] if pixels is None else (64, 64)))
        plan = Plan(shape=shape, name=f"{number}-{{:03d}}".format, gap=GAP, origin=(-12.5, 31.25, -400 + along))

        def change(ds, k, number=number, own=own, plan=plan):
            stored = plan.stored(k) + STEP_HU * number if pixels is None else pixels(number, k)
            ds.PixelData = stored.astype("i2").tobytes()
            ds.SOPInstanceUID += f".{number}"
            ds.InstanceNumber = k + 1
            ds.StudyDate, ds.Manufacturer = "20200101", "PHANTOM"
            for keyword, value in own.items():
                value = value(k) if callable(value) else value
                if isinstance(keyword, tuple):
                    block = ds.private_block(keyword[0], "VENDOR", create=True)
                    block.add_new(keyword[1], "LO", value)
                else:
                    setattr(ds, keyword, value)

        write_series(folder, plan, change)
        plans.append(plan)
    return plans


def read_refusal(folder):
    with pytest.raises(RefusedInputError) as caught:
        read_volume(folder)
    return str(caught.value)


TWO_VALUES = pytest.mark.parametrize(
    ("first", "second", "keyword"),
    daily_rows(
        2,
        [
            ({"AcquisitionTime": "101500"}, {"AcquisitionTime": "103000"}, "AcquisitionTime"),
            ({"AcquisitionDate": "20200101"}, {"AcquisitionDate": "20200102"}, "AcquisitionDate"),
            ({"ContentTime": "101500"}, {"ContentTime": "101501"}, "ContentTime"),
            ({}, {"ContrastBolusAgent": "IODINE"}, "ContrastBolusAgent"),
            ({}, {"AcquisitionNumber": 2}, "AcquisitionNumber"),
            ({"AcquisitionNumber": 1}, {"AcquisitionNumber": 2}, "AcquisitionNumber"),
            ({"FilterType": "A"}, {"FilterType": "B"}, "FilterType"),
            ({"ProtocolName": "plain"}, {"ProtocolName": "portal"}, "ProtocolName"),
            ({"ImageComments": "DOE"}, {"ImageComments": "DOE late"}, "ImageComments"),
            ({}, {"ContrastBolusVolume": lambda k: 10 + k}, "ContrastBolusVolume"),
            (
                {"AcquisitionTime": lambda k: f"1015{k:02d}"},
                {"AcquisitionTime": lambda k: f"1015{20 + k:02d}"},
                "order of AcquisitionTime",
            ),
            (
                {"AcquisitionTime": lambda k: f"1015{k // 4:02d}"},
                {"AcquisitionTime": "102500"},
                "order of AcquisitionTime",
            ),
        ],
    ),
)


@TWO_VALUES
def test_two_volumes_that_an_element_tells_apart_are_refused_with_their_list(tmp_path, first, second, keyword):
    write_volumes(tmp_path, first, second)
    refusal = read_refusal(tmp_path)
    assert f"2 phases whose slices lie between each other, choose one with phase: [1: {keyword} " in refusal
    assert f"{EACH} slices], [2:" in refusal
    assert refusal.endswith(f"; slices of phase 1 lie {GAP} mm apart, those of all phases {GAP / 2} mm")


@TWO_VALUES
def test_each_of_two_volumes_between_each_other_is_read_by_its_phase(tmp_path, first, second, keyword):
    plans = write_volumes(tmp_path, first, second)
    for number, plan in enumerate(plans):
        volume = read_volume(tmp_path, phase=number + 1)
        assert np.array_equal(volume.voxels, plan.hu() + STEP_HU * number)
        index = (2, 3, 4)
        assert volume.ijk_to_lps([index])[0] == pytest.approx(plan.truth([index])[0], abs=tolerances.AFFINE_MM)


@TWO_VALUES
def test_report_of_a_phase_says_what_was_left(tmp_path, first, second, keyword):
    write_volumes(tmp_path, first, second)
    report = read_volume(tmp_path, phase=2).report
    assert report["warnings"][0].endswith(
        f"{EACH} slices of others left: slices of phase 2 lie {GAP} mm apart, those of all phases {GAP / 2} mm"
    )


@pytest.mark.parametrize("keyword", ["ImageComments", "ContrastBolusAgent"])
def test_texts_that_tell_volumes_apart_are_in_no_refusal_and_no_report(tmp_path, keyword):
    write_volumes(tmp_path, {keyword: "DOE"}, {keyword: "DOE late"})
    assert keyword in read_refusal(tmp_path)
    assert "DOE" not in read_refusal(tmp_path)
    assert "DOE" not in repr(read_volume(tmp_path, phase=2).report)


def test_volume_without_the_element_that_another_has_is_listed_as_none(tmp_path):
    write_volumes(tmp_path, {}, {"ContrastBolusAgent": "IODINE"})
    assert f"[1: ContrastBolusAgent (none), {EACH} slices]" in read_refusal(tmp_path)


def test_third_phase_of_two_volumes_is_refused(tmp_path):
    write_volumes(tmp_path, {"AcquisitionNumber": 1}, {"AcquisitionNumber": 2})
    with refused(UsageError, "phase", "phases", 3, 2):  # the third, of two
        read_volume(tmp_path, phase=3)


def test_two_volumes_between_each_other_have_no_affine_in_the_listing(tmp_path):
    write_volumes(tmp_path, {"AcquisitionNumber": 1}, {"AcquisitionNumber": 2})
    assert list_series(tmp_path).certificate["affine_ijk_to_lps_mm"] is None


def test_three_volumes_between_each_other_are_refused_as_three_phases(tmp_path):
    write_volumes(tmp_path, *({"ProtocolName": name} for name in "ABC"))
    assert "3 phases whose slices lie between" in read_refusal(tmp_path)


@pytest.mark.parametrize(("slices", "order"), [(16, "AABB"), (120, "AB")], ids=["pairs of slices", "long stack"])
def test_slices_of_two_protocols_by_turns_are_refused_as_two_phases(tmp_path, slices, order):
    """Of a long stack a few places are looked at first."""
    write_series(tmp_path, Plan(shape=(slices, 5, 6)), lambda ds, k: setattr(ds, "ProtocolName", order[k % len(order)]))
    assert "2 phases whose slices lie between" in read_refusal(tmp_path)


def test_short_volume_between_slices_of_a_longer_one_is_refused_as_a_phase(tmp_path):
    write_volumes(tmp_path, {"ProtocolName": "A"}, {"ProtocolName": "B"}, slices=(20, 8), offsets=(0.0, 6.5 * GAP))
    assert "[1: ProtocolName value 1, 20 slices], [2: ProtocolName value 2, 8 slices]" in read_refusal(tmp_path)


@pytest.mark.parametrize(
    ("keyword", "value"),
    [
        pytest.param("AcquisitionTime", lambda k: f"1015{k // 2:02d}", id="two rows of detectors"),
        pytest.param("AcquisitionTime", lambda k: f"1015{(k // 4) % 2:02d}", id="slabs by turns"),
        pytest.param("ProtocolName", lambda k: "AB"[k >= 12], id="halves"),
        pytest.param("ProtocolName", lambda k: "AB"[(7 * k * k + k) % 11 > 4], id="irregular"),
        pytest.param("WindowCenter", lambda k: (40, 300)[k % 2], id="window"),
        pytest.param("XRayTubeCurrent", lambda k: (300, 310)[k % 2], id="tube current"),
        pytest.param("RescaleIntercept", lambda k: (-1024, -1000)[k % 2], id="rescale"),
        pytest.param("InstanceNumber", lambda k: (7 * k) % 23, id="numbers"),
        pytest.param("SliceLocation", lambda k: k % 2, id="location"),
    ],
)
def test_element_that_changes_along_one_volume_does_not_part_it(tmp_path, keyword, value):
    plan = write_series(tmp_path, Plan(shape=(24, 5, 6)), lambda ds, k: setattr(ds, keyword, value(k)))
    assert read_volume(tmp_path).voxels.shape == plan.shape


# --- what may alternate within one volume: the pixels decide ---
def moved_bodies(*, moved):
    """A body that widens from slice to slice, `moved` voxels along its rows in the second volume, and noise."""
    y, x = np.mgrid[:64, :64]

    def stored(number, k):
        noise = np.random.default_rng(100 * number + k).normal(0, 10, (64, 64))
        inside = np.hypot(y - 31.5, x - 31.5 - moved * number) < 20 + 0.3 * k
        return np.where(inside, 1064, 24) + noise

    return stored


DOUBTFUL = [
    {"XRayTubeCurrent": lambda n: (300, 310)[n]},
    {"WindowCenter": lambda n: (40, 300)[n]},
    {(0x0029, 0x10): lambda n: "AB"[n]},
]


def failed_gates(report):
    return [gate["name"] for gate in report["gates"] if gate["ok"] is False]


def values_of_both(elements):
    """The elements of the first volume and those of the second."""
    return [{keyword: value(number) for keyword, value in elements.items()} for number in (0, 1)]


@pytest.mark.parametrize("elements", daily(1, DOUBTFUL), ids=["tube current", "window", "private"])
def test_element_that_may_alternate_parts_volumes_of_unlike_pictures(tmp_path, elements):
    write_volumes(tmp_path, *values_of_both(elements), pixels=moved_bodies(moved=6))
    assert "2 phases whose slices lie between each other" in read_refusal(tmp_path)
    assert read_volume(tmp_path, phase=2).voxels.shape[0] == EACH


@pytest.mark.parametrize("elements", daily(1, DOUBTFUL), ids=["tube current", "window", "private"])
def test_element_that_may_alternate_over_like_pictures_fails_the_gate_of_one_volume_with_a_warning(tmp_path, elements):
    write_volumes(tmp_path, *values_of_both(elements), pixels=moved_bodies(moved=0))
    report = read_volume(tmp_path).report
    assert failed_gates(report) == ["one_volume"]
    assert any("alternates along the stack: maybe several volumes" in warning for warning in report["warnings"])


def test_two_passes_numbered_one_after_the_other_with_unlike_pictures_are_refused_as_phases(tmp_path):
    first, second = {"InstanceNumber": lambda k: k + 1}, {"InstanceNumber": lambda k: EACH + k + 1}
    write_volumes(tmp_path, first, second, pixels=moved_bodies(moved=6))
    assert f"[1: order of InstanceNumber 1, {EACH} slices]" in read_refusal(tmp_path)


TO_AND_FRO = ({"RotationDirection": "CW"}, {"RotationDirection": "CC"})


def test_slices_of_a_gantry_that_turns_to_and_fro_are_one_volume_without_a_warning(tmp_path):
    write_volumes(tmp_path, *TO_AND_FRO, pixels=moved_bodies(moved=0))
    volume = read_volume(tmp_path)
    assert volume.voxels.shape[0] == 2 * EACH
    assert volume.report["spacing_mm"][2] == pytest.approx(GAP / 2)
    assert volume.report["warnings"] == []
    assert [gate["ok"] for gate in volume.report["gates"] if gate["name"] == "one_volume"] == [True]


def test_unlike_pictures_of_a_gantry_that_turns_to_and_fro_are_warned_of(tmp_path):
    write_volumes(tmp_path, *TO_AND_FRO, pixels=moved_bodies(moved=6))
    warnings = read_volume(tmp_path).report["warnings"]
    assert any("maybe two volumes between each other" in warning for warning in warnings)


TWO_TABLE_HEIGHTS = ({"TableHeight": 100}, {"TableHeight": 101})
"""An element that is not in the table of those that part volumes."""


def test_element_that_is_not_in_the_table_parts_volumes_of_unlike_pictures(tmp_path):
    write_volumes(tmp_path, *TWO_TABLE_HEIGHTS, pixels=moved_bodies(moved=6))
    refusal = read_refusal(tmp_path)
    assert "2 phases whose slices lie between each other, choose one with phase: [1: TableHeight" in refusal


def test_element_that_is_not_in_the_table_fails_the_gate_of_one_volume_over_like_pictures(tmp_path):
    write_volumes(tmp_path, *TWO_TABLE_HEIGHTS, pixels=moved_bodies(moved=0))
    report = read_volume(tmp_path).report
    assert failed_gates(report) == ["one_volume"]
    assert any("TableHeight alternates along the stack: maybe several volumes" in text for text in report["warnings"])


def test_unlike_pictures_by_turns_fail_the_gate_of_one_volume_with_a_warning(tmp_path):
    write_volumes(tmp_path, {}, {}, pixels=moved_bodies(moved=6))
    report = read_volume(tmp_path).report
    assert failed_gates(report) == ["one_volume"]
    words = "less alike than each is to the next but one"
    (warning,) = [warning for warning in report["warnings"] if words in warning]
    assert "maybe two volumes between each other, phase takes one" in warning


def test_every_second_slice_of_unlike_pictures_is_read_as_a_phase(tmp_path):
    plan, _ = write_volumes(tmp_path, {}, {}, pixels=moved_bodies(moved=6))
    chosen = read_volume(tmp_path, phase=1)
    assert chosen.report["phase"] == {"number": 1, "of": 2, "keyword": "place", "value": "1 of 2"}
    index = (0, 0, 3)
    assert chosen.ijk_to_lps([index])[0] == pytest.approx(plan.truth([index])[0], abs=tolerances.AFFINE_MM)
    assert [gate["ok"] for gate in chosen.report["gates"] if gate["name"] == "one_volume"] == [True]


def test_second_phase_of_one_volume_is_refused(tmp_path):
    write_volumes(tmp_path, {}, {}, pixels=moved_bodies(moved=0))
    assert read_volume(tmp_path).report["warnings"] == []
    with refused(UsageError, "slice", "phase", 2):
        read_volume(tmp_path, phase=2)


# --- the rule of the orders ---
@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        pytest.param("ABABAB", True, id="by turns"),
        pytest.param("ABABA", False, id="too few"),
        pytest.param("ABCABCABC", True, id="three by turns"),
        pytest.param("AABBAABBAABB", True, id="pairs by turns"),
        pytest.param("AABAABAABAAB", True, id="two to one"),
        pytest.param("ABABABABABBA", False, id="irregular at the end"),
        pytest.param("AAAAAABBBBBB", False, id="halves"),
        pytest.param("ABCDEFGHABCDEFGHABCDEFGH", True, id="eight by turns"),
        pytest.param("AAABBBAAABBBAAABBB", False, id="slabs"),
        pytest.param("AAAABABABAAAA", False, id="by turns in a part with the same gaps"),
    ],
)
def test_values_by_turns_over_even_gaps_alternate_and_runs_do_not(codes, expected):
    assert alternates([ord(code) for code in codes], [1.0] * (len(codes) - 1)) is expected


def test_values_by_turns_in_a_part_alternate_where_its_slices_lie_closer():
    codes = [0] * 6 + [1, 0] * 4 + [0] * 5
    closer_in_that_part = [1.0] * 5 + [0.5] * 9 + [1.0] * 4
    assert alternates(codes, closer_in_that_part)
    assert not alternates(codes, [1.0] * 18)


# --- the likeness of slices ---
def widening_body(slices, seed=1, noise=20.0):
    """HU of a body that widens, with bone and noise."""
    y, x = np.mgrid[:128, :128] - 63.5
    radius = np.hypot(x, y)
    hu = np.stack([np.where(radius < 40 + 0.4 * k, 40.0, -1000.0) for k in range(slices)])
    hu[:, np.hypot(x - 5, y - 20) < 9] = 600
    return hu + np.random.default_rng(seed).normal(0, noise, hu.shape)


def test_likeness_is_the_ratio_of_mean_squares_between_averages_of_four_by_four_pixels():
    voxels = np.random.default_rng(3).integers(-1500, 2500, (9, 130, 134)).astype(np.int16)
    cells = np.clip(voxels, -1000, 2000)[:, :128, :132].reshape(9, 32, 4, 33, 4).mean(axis=(2, 4))
    nearest, further = (np.square(cells[step:] - cells[:-step]).mean(axis=(1, 2)) for step in (1, 2))
    ratios = 0.5 * (nearest[:-1] + nearest[1:]) / further
    # The reference is float64; 16,384 cells summed in float32 differ by less than 1e-5.
    assert measure_likeness(voxels).whole == pytest.approx(ratios.min(), rel=1e-5)


def test_slices_of_one_volume_are_alike():
    likeness = measure_likeness(widening_body(24).astype(np.int16))
    assert not likeness.is_mixed
    assert likeness.whole < 1.0  # neighbours are more alike than the next but one
    assert likeness.part < 1.2  # of the part where they are least alike; measured 0.63, and 2 are two volumes


@pytest.mark.parametrize("noise", [0.0, 5.0, 60.0])
def test_slices_of_water_are_alike_whatever_their_noise(noise):
    water = np.zeros((30, 128, 128)) + np.random.default_rng(2).normal(0, 1, (30, 128, 128)) * noise
    assert not measure_likeness(water.astype(np.int16)).is_mixed


@pytest.mark.parametrize(("order", "period"), [("AB", 2), ("ABC", 3), ("AABB", 4)])
def test_slices_of_several_volumes_by_turns_are_mixed_with_their_period(order, period):
    hu = widening_body(24).astype(np.int16)
    for k in range(24):
        hu[k] = np.roll(hu[k], 6 * "ABC".index(order[k % len(order)]), axis=1)
    likeness = measure_likeness(hu)
    assert likeness.is_mixed
    assert likeness.period == period


def test_contrast_medium_in_a_vessel_of_every_second_slice_is_found_in_its_part():
    hu = widening_body(24).astype(np.int16)
    y, x = np.mgrid[:128, :128]
    hu[1::2, np.hypot(x - 44, y - 50) < 12] += 150
    likeness = measure_likeness(hu)
    assert likeness.whole < 1.0  # the whole slices are alike
    assert likeness.part > 2.0  # in the part of the vessel a slice is far more like the next but one
    assert likeness.is_mixed
    assert not measure_likeness(hu, parts=False).is_mixed


@pytest.mark.parametrize(
    ("slices", "places", "is_mixed"),
    [(16, 1, False), (16, 3, False), (16, 4, True), (30, 1, True)],
    ids=["16 slices, 1 place", "16 slices, 3 places", "16 slices, 4 places", "30 slices, 1 place"],
)
def test_part_that_alternates_is_a_second_volume_over_many_slices_or_in_four_places(slices, places, is_mixed):
    """Artefacts at a saw cut turn from slice to slice: they are few, or in few places.

    One place must alternate over 20 slices, four places over 12.
    """
    hu = widening_body(48)[16:].astype(np.int16)  # its outline moves beside the parts that alternate
    for j, i in [(44, 44), (44, 72), (72, 44), (72, 72)][:places]:  # parts are 32 pixels wide
        hu[1 : slices + 1 : 2, j : j + 12, i : i + 12] += 200
    likeness = measure_likeness(hu)
    assert likeness.whole < 1.0  # the whole slices are alike
    assert likeness.is_mixed is is_mixed


@pytest.mark.parametrize(("windows", "is_mixed"), [(1, False), (2, True)], ids=["one window", "two windows"])
def test_part_that_alternates_is_a_second_volume_in_two_windows_of_a_long_stack(windows, is_mixed):
    """The windows of 32 slices begin at 0, 48 and 96."""
    hu = widening_body(48)[16:].astype(np.int16)  # its outline moves beside the part that alternates
    stack = np.concatenate([hu, hu, hu, hu])
    stack[1 : 32 + 48 * (windows - 1) : 2, 44:56, 44:56] += 200
    likeness = judge_slices(stack, tilt_deg=0.0)
    assert likeness.whole < 1.0  # the whole slices are alike
    assert likeness.is_mixed is is_mixed


@pytest.mark.parametrize(
    ("hu", "is_measured"),
    [(widening_body(5), False), (widening_body(6), True), (widening_body(24)[:, :7, :7], False),
     (widening_body(24)[:, :8, :8], True)],
    ids=["5 slices", "6 slices", "7 pixels", "8 pixels"],
)  # fmt: skip
def test_likeness_is_measured_from_six_slices_and_eight_pixels_a_side_on(hu, is_measured):
    assert (measure_likeness(hu.astype(np.int16)) is not None) is is_measured


@pytest.mark.release
@pytest.mark.parametrize(
    "folder", ["lumbar_4p25mm", "thoracic_0p8mm", "head_tilt_gaps", "thoracolumbar_labels/ct_2mm_jpeg2000"]
)
def test_real_scan_passes_the_gate_of_one_volume(real_data, folder):
    report = read_volume(real_data / folder).report
    assert [gate["ok"] for gate in report["gates"] if gate["name"] == "one_volume"] == [True]
