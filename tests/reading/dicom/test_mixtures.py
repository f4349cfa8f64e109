"""Two volumes half a gap apart, in one series: refused by whatever tells them apart, or told by their pixels."""

from __future__ import annotations

import re

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

GAP = 1.25
EACH = 12


def write_volumes(folder, *elements, offsets=None, slices=None, pixels=None, per_slice=0):
    """A volume for each mapping of elements (values, or functions of its own slice), a part of a gap apart."""
    plans = []
    count = len(elements)
    for number, own in enumerate(elements):
        along = number * GAP / count if offsets is None else offsets[number]
        shape = (EACH if slices is None else slices[number], *(Plan().shape[1:] if pixels is None else (64, 64)))
        plan = Plan(shape=shape, name=f"{number}-{{:03d}}".format, gap=GAP, origin=(-12.5, 31.25, -400 + along))

        def change(ds, k, number=number, own=own, plan=plan):
            stored = plan.stored(k) + 300 * number if pixels is None else pixels(number, k)
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


def refusal(folder):
    with pytest.raises(RefusedInputError) as caught:
        read_volume(folder)
    return str(caught.value)


@pytest.mark.parametrize(
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
def test_alternating_elements_part_two_volumes(tmp_path, first, second, keyword):
    plans = write_volumes(tmp_path, first, second)
    said = refusal(tmp_path)
    assert f"2 phases whose slices lie between each other, choose one with phase: [1: {keyword} " in said
    assert "12 slices], [2:" in said and "DOE" not in said
    assert said.endswith("; slices of phase 1 lie 1.25 mm apart, those of all phases 0.625 mm")
    assert keyword != "ContrastBolusAgent" or "[1: ContrastBolusAgent (none), 12 slices]" in said
    with refused(UsageError, "phase", "phases", 3, 2):
        read_volume(tmp_path, phase=3)
    assert list_series(tmp_path).certificate["affine_ijk_to_lps_mm"] is None
    for number, plan in enumerate(plans):
        volume = read_volume(tmp_path, phase=number + 1)
        assert np.array_equal(volume.voxels, plan.hu() + 300 * number)
        assert volume.ijk_to_lps([(2, 3, 4)])[0] == pytest.approx(plan.truth([(2, 3, 4)])[0], abs=tolerances.AFFINE_MM)
        assert not re.search("IODINE|DOE", repr(volume.report))
        chosen = volume.report["warnings"][0]
        assert chosen.endswith(
            f"12 slices of others left: slices of phase {number + 1} lie 1.25 mm apart, those of all phases 0.625 mm"
        )


def test_three_volumes_and_volumes_in_pairs_are_told_as_phases(tmp_path):
    write_volumes(tmp_path / "three", *({"ProtocolName": name} for name in "ABC"))
    assert "3 phases whose slices lie between" in refusal(tmp_path / "three")
    write_series(tmp_path / "pairs", Plan(shape=(16, 5, 6)), lambda ds, k: setattr(ds, "ProtocolName", "AABB"[k % 4]))
    assert "2 phases whose slices lie between" in refusal(tmp_path / "pairs")


def test_volume_within_a_part_of_another_is_told_apart(tmp_path):
    write_volumes(tmp_path, {"ProtocolName": "A"}, {"ProtocolName": "B"}, slices=(20, 8), offsets=(0.0, 6.5 * GAP))
    assert "[1: ProtocolName value 1, 20 slices], [2: ProtocolName value 2, 8 slices]" in refusal(tmp_path)


def test_a_long_stack_is_looked_at_in_places_first(tmp_path):
    write_series(tmp_path, Plan(shape=(120, 5, 6)), lambda ds, k: setattr(ds, "ProtocolName", "AB"[k % 2]))
    assert "2 phases" in refusal(tmp_path)


@pytest.mark.parametrize(
    "elements",
    [
        {"AcquisitionTime": lambda k: f"1015{k // 2:02d}"},  # two rows of detectors
        {"AcquisitionTime": lambda k: f"1015{(k // 4) % 2:02d}"},  # comes back, slab by slab
        {"ProtocolName": lambda k: "AB"[k >= 12]},
        {"ProtocolName": lambda k: "AB"[(7 * k * k + k) % 11 > 4]},
        {"WindowCenter": lambda k: (40, 300)[k % 2]},
        {"XRayTubeCurrent": lambda k: (300, 310)[k % 2]},
        {"RescaleIntercept": lambda k: (-1024, -1000)[k % 2]},
        {"InstanceNumber": lambda k: (7 * k) % 23},
        {"SliceLocation": lambda k: k % 2},
    ],
    ids=["rows", "slabs", "halves", "irregular", "window", "tube current", "rescale", "numbers", "location"],
)
def test_elements_that_change_within_one_volume_make_no_second_one(tmp_path, elements):
    plan = write_series(tmp_path, Plan(shape=(24, 5, 6)), lambda ds, k: [
        setattr(ds, keyword, value(k)) for keyword, value in elements.items()
    ] and None)  # fmt: skip
    volume = read_volume(tmp_path)
    assert volume.voxels.shape == plan.shape


# --- what may alternate within one volume: the pixels decide ---
def picture(moved):
    """A body that is the same in all slices, moved along its rows in one of the volumes, and noise."""
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


@pytest.mark.parametrize("elements", daily(1, DOUBTFUL), ids=["tube current", "window", "private"])
def test_doubtful_elements_and_other_pixels_are_two_volumes(tmp_path, elements):
    own = [{keyword: value(number) for keyword, value in elements.items()} for number in (0, 1)]
    write_volumes(tmp_path / "moved", *own, pixels=picture(6))
    assert "2 phases whose slices lie between each other" in refusal(tmp_path / "moved")
    assert read_volume(tmp_path / "moved", phase=2).voxels.shape[0] == EACH
    write_volumes(tmp_path / "alike", *own, pixels=picture(0))
    report = read_volume(tmp_path / "alike").report
    assert any("alternates along the stack: maybe several volumes" in text for text in report["warnings"])
    assert [gate["name"] for gate in report["gates"] if gate["ok"] is False] == ["one_volume"]


def test_two_passes_by_number_with_other_pixels_are_told_apart(tmp_path):
    own = [{"InstanceNumber": lambda k: k + 1}, {"InstanceNumber": lambda k: k + 13}]
    write_volumes(tmp_path, *own, pixels=picture(6))
    assert "[1: order of InstanceNumber 1, 12 slices]" in refusal(tmp_path)


TO_AND_FRO = ({"RotationDirection": "CW"}, {"RotationDirection": "CC"})


def test_a_gantry_that_turns_to_and_fro_makes_one_volume(tmp_path):
    write_volumes(tmp_path, *TO_AND_FRO, pixels=picture(0))
    volume = read_volume(tmp_path)
    assert volume.voxels.shape[0] == 2 * EACH and volume.report["warnings"] == []
    assert volume.report["spacing_mm"][2] == pytest.approx(GAP / 2)
    assert [gate["ok"] for gate in volume.report["gates"] if gate["name"] == "one_volume"] == [True]


def test_a_gantry_that_turns_to_and_fro_over_unlike_pictures_is_doubted(tmp_path):
    write_volumes(tmp_path, *TO_AND_FRO, pixels=picture(6))  # every second slice lies 6 voxels aside
    warnings = read_volume(tmp_path).report["warnings"]
    assert any("maybe two volumes between each other" in text for text in warnings)


TWO_TABLE_HEIGHTS = ({"TableHeight": 100}, {"TableHeight": 101})
"""An element that is not in the table of those that part volumes."""


def test_an_element_of_no_row_parts_volumes_of_unlike_pictures(tmp_path):
    write_volumes(tmp_path, *TWO_TABLE_HEIGHTS, pixels=picture(6))  # every second slice lies 6 voxels aside
    said = refusal(tmp_path)
    assert "2 phases whose slices lie between each other, choose one with phase: [1: TableHeight" in said


def test_an_element_of_no_row_that_alternates_over_like_pictures_is_doubted(tmp_path):
    write_volumes(tmp_path, *TWO_TABLE_HEIGHTS, pixels=picture(0))
    report = read_volume(tmp_path).report
    assert any("TableHeight alternates along the stack: maybe several volumes" in text for text in report["warnings"])
    assert [gate["name"] for gate in report["gates"] if gate["ok"] is False] == ["one_volume"]


def test_pixels_alone_are_told_and_chosen_from(tmp_path):
    (plan, _) = write_volumes(tmp_path, {}, {}, pixels=picture(6))
    volume = read_volume(tmp_path)
    said = [text for text in volume.report["warnings"] if "less alike than each is to the next but one" in text]
    assert len(said) == 1 and "maybe two volumes between each other, phase takes one" in said[0]
    assert [gate["name"] for gate in volume.report["gates"] if gate["ok"] is False] == ["one_volume"]
    chosen = read_volume(tmp_path, phase=1)
    assert chosen.report["phase"] == {"number": 1, "of": 2, "keyword": "place", "value": "1 of 2"}
    assert chosen.ijk_to_lps([(0, 0, 3)])[0] == pytest.approx(plan.truth([(0, 0, 3)])[0], abs=tolerances.AFFINE_MM)
    assert [gate["ok"] for gate in chosen.report["gates"] if gate["name"] == "one_volume"] == [True]


def test_one_volume_has_no_second_phase(tmp_path):
    write_volumes(tmp_path, {}, {}, pixels=picture(0))
    assert read_volume(tmp_path).report["warnings"] == []
    with refused(UsageError, "slice", "phase", 2):
        read_volume(tmp_path, phase=2)


# --- the rule of the orders ---
@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ("ABABAB", True),
        ("ABABA", False),  # too few
        ("ABCABCABC", True),
        ("AABBAABBAABB", True),
        ("AABAABAABAAB", True),
        ("ABABABABABBA", False),
        ("AAAAAABBBBBB", False),
        ("ABCDEFGHABCDEFGHABCDEFGH", True),
        ("AAABBBAAABBBAAABBB", False),  # slabs
        ("AAAABABABAAAA", False),  # the same gaps everywhere: no second volume
    ],
)
def test_alternating_values_are_told_from_runs(codes, expected):
    assert alternates([ord(code) for code in codes], [1.0] * (len(codes) - 1)) is expected


def test_part_where_slices_lie_closer_and_codes_alternate_is_told():
    codes, gaps = [0] * 6 + [1, 0] * 4 + [0] * 5, [1.0] * 5 + [0.5] * 9 + [1.0] * 4
    assert alternates(codes, gaps) and not alternates(codes, [1.0] * 18)


# --- the likeness of slices ---
def body(slices, seed=1, noise=20.0):
    """HU of a body that widens, with bone and noise."""
    y, x = np.mgrid[:128, :128] - 63.5
    radius = np.hypot(x, y)
    hu = np.stack([np.where(radius < 40 + 0.4 * k, 40.0, -1000.0) for k in range(slices)])
    hu[:, np.hypot(x - 5, y - 20) < 9] = 600
    return hu + np.random.default_rng(seed).normal(0, noise, hu.shape)


def test_slices_of_one_volume_are_alike():
    found = measure_likeness(body(24).astype(np.int16))
    assert not found.is_mixed and found.whole < 1.0 and found.part < 1.2


@pytest.mark.parametrize("noise", [0.0, 5.0, 60.0])
def test_slices_that_are_all_the_same_but_for_noise_are_alike(noise):
    water = np.zeros((30, 128, 128)) + np.random.default_rng(2).normal(0, 1, (30, 128, 128)) * noise
    assert not measure_likeness(water.astype(np.int16)).is_mixed


@pytest.mark.parametrize(("order", "period"), [("AB", 2), ("ABC", 3), ("AABB", 4)])
def test_volumes_between_each_other_are_not(order, period):
    hu = body(24).astype(np.int16)
    for k in range(24):
        hu[k] = np.roll(hu[k], 6 * "ABC".index(order[k % len(order)]), axis=1)
    found = measure_likeness(hu)
    assert found.is_mixed and found.period == period


def test_contrast_medium_in_a_vessel_shows_in_its_part():
    hu = body(24).astype(np.int16)
    y, x = np.mgrid[:128, :128]
    hu[1::2, np.hypot(x - 44, y - 50) < 12] += 150
    found = measure_likeness(hu)
    assert found.whole < 1.0 and found.part > 2.0 and found.is_mixed
    assert not measure_likeness(hu, parts=False).is_mixed


@pytest.mark.parametrize(("along", "places", "mixed"), [(16, 1, False), (16, 3, False), (16, 4, True), (30, 1, True)])
def test_one_place_alternates_within_one_volume_two_volumes_in_many(along, places, mixed):
    """Artefacts at a saw cut turn from slice to slice: many slices, or many places, show two volumes."""
    hu = body(48)[16:].astype(np.int16)  # its outline moves beside the parts that alternate
    for j, i in [(44, 44), (44, 72), (72, 44), (72, 72)][:places]:  # parts are 32 pixels wide
        hu[1 : along + 1 : 2, j : j + 12, i : i + 12] += 200
    found = measure_likeness(hu)
    assert found.whole < 1.0 and found.is_mixed is mixed


@pytest.mark.parametrize(("windows", "mixed"), [(1, False), (2, True)])
def test_a_part_must_alternate_in_two_windows_of_a_long_stack(windows, mixed):
    """The windows begin at 0, 48 and 96."""
    hu = body(48)[16:].astype(np.int16)  # its outline moves beside the part that alternates
    stack = np.concatenate([hu, hu, hu, hu])
    stack[1 : 32 + 48 * (windows - 1) : 2, 44:56, 44:56] += 200
    found = judge_slices(stack, 0.0)
    assert found.is_mixed is mixed and found.whole < 1.0


def test_too_few_slices_or_pixels_say_nothing():
    assert measure_likeness(body(5).astype(np.int16)) is None
    assert measure_likeness(body(24)[:, :7, :7].astype(np.int16)) is None


@pytest.mark.release
@pytest.mark.parametrize(
    "folder", ["lumbar_4p25mm", "thoracic_0p8mm", "head_tilt_gaps", "thoracolumbar_labels/ct_2mm_jpeg2000"]
)
def test_real_scans_are_one_volume(real_data, folder):
    report = read_volume(real_data / folder).report
    assert [gate["ok"] for gate in report["gates"] if gate["name"] == "one_volume"] == [True]
