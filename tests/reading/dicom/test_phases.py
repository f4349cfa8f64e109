"""Several slices at one place: copies are dropped, phases are listed and chosen, the rest is refused."""

from __future__ import annotations

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, set_values, write_series
from refusals import assert_one_line, refused
from variants import daily_rows

from clrecon.errors import RefusedInputError, UsageError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.series.phases import have_same_pixels
from clrecon.reading.dicom.series.scan import scan_path


def write_phase(folder, number, shift=0, plan=None, **elements):
    """A copy of the plan's series with other pixels, and elements that may be functions of the slice."""

    def change(ds, k):
        ds.PixelData = (np.frombuffer(ds.PixelData, "i2") + shift).tobytes()
        ds.SOPInstanceUID = f"{ds.SOPInstanceUID}.{number}"
        for keyword, value in elements.items():
            setattr(ds, keyword, value(k) if callable(value) else value)

    return write_series(folder, plan or Plan(name=f"phase{number}-{{}}".format), change)


def test_identical_slices_are_dropped_with_a_warning(tmp_path):
    plan = write_series(tmp_path, Plan())
    write_series(tmp_path, Plan(name="again{}".format), set_values(ContentTime="101010"))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == ["7 duplicate slices dropped: same place, same pixels as another"]
    assert volume.report["files"]["used"] == 7
    entry = list_series(tmp_path).series[0]
    assert entry.slices == 14 and entry.shape_ijk == [6, 5, 7] and entry.problems == [] and entry.phases == []


def test_one_identical_slice_is_dropped(tmp_path):
    plan = write_series(tmp_path, Plan())
    (tmp_path / "copy").write_bytes((tmp_path / "slice003.dcm").read_bytes())
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == ["1 duplicate slice dropped: same place, same pixels as another"]


@pytest.mark.parametrize(
    ("first", "second", "keyword", "values"),
    daily_rows(
        2,
        [
            ({"AcquisitionNumber": 3}, {"AcquisitionNumber": 12}, "AcquisitionNumber", ["3", "12"]),
            (
                {"TemporalPositionIdentifier": 1},
                {"TemporalPositionIdentifier": 2},
                "TemporalPositionIdentifier",
                ["1", "2"],
            ),
            ({"TriggerTime": "9.5"}, {"TriggerTime": "78.5"}, "TriggerTime", ["9.5", "78.5"]),
            ({"AcquisitionTime": "101500.5"}, {"AcquisitionTime": "101601"}, "AcquisitionTime", ["+0 s", "+60.5 s"]),
            ({"AcquisitionDate": "20200101"}, {"AcquisitionDate": "20210704"}, "AcquisitionDate", ["date 1", "date 2"]),
            ({"ConvolutionKernel": "B31f"}, {"ConvolutionKernel": "B70f"}, "ConvolutionKernel", ["B31f", "B70f"]),
            ({}, {"AcquisitionNumber": 1}, "AcquisitionNumber", ["1", "(none)"]),
        ],
    ),
)
def test_phases_are_listed_and_chosen(tmp_path, first, second, keyword, values):
    plan = write_phase(tmp_path, 1, **first)
    write_phase(tmp_path, 2, 500, **second)
    shifts = [500, 0] if values[-1] == "(none)" else [0, 500]
    entry = list_series(tmp_path).series[0]
    assert entry.phases == [
        {"number": n, "keyword": keyword, "value": value, "slices": 7} for n, value in enumerate(values, start=1)
    ]
    assert entry.affine_ijk_to_lps_mm is None and entry.slices == 14
    with refused(RefusedInputError, "phases", "phase", keyword, 2, 7):
        read_volume(tmp_path)
    for number, shift in enumerate(shifts, start=1):
        volume = read_volume(tmp_path, phase=number)
        assert np.array_equal(volume.voxels, plan.hu() + shift)
        assert volume.ijk_to_lps([(2, 3, 4)])[0] == pytest.approx(plan.truth([(2, 3, 4)])[0])
        told = f"phase {number} of 2 ({keyword} {values[number - 1]}) read, 7 slices of others left"
        assert told in volume.report["warnings"]
        assert volume.report["phase"] == {"number": number, "of": 2, "keyword": keyword, "value": values[number - 1]}
        assert not any("2020" in text or "2021" in text for text in volume.report["warnings"])


def test_phases_of_different_extent_are_read_each(tmp_path):
    write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, 9, Plan(shape=(4, 5, 6), name="b{}".format), AcquisitionNumber=2)
    assert [phase["slices"] for phase in list_series(tmp_path).series[0].phases] == [7, 4]
    assert read_volume(tmp_path, phase=2).shape_ijk == (6, 5, 4)


def test_two_elements_together_tell_four_phases_apart(tmp_path):
    for number, (kernel, phase) in enumerate([("A", 1), ("A", 2), ("B", 1), ("B", 2)]):
        write_phase(tmp_path, number, 100 * number, ConvolutionKernel=kernel, AcquisitionNumber=phase)
    phases = list_series(tmp_path).series[0].phases
    assert [phase["value"] for phase in phases] == ["1, A", "1, B", "2, A", "2, B"]
    assert {phase["keyword"] for phase in phases} == {"AcquisitionNumber and ConvolutionKernel"}
    assert read_volume(tmp_path, phase=2).voxels[0, 0, 0] == 900 - 1024 + 200


def test_a_time_of_its_own_for_every_slice_ranks_the_visits(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionTime=lambda k: f"1010{10 + k}")
    write_phase(tmp_path, 2, 300, AcquisitionTime=lambda k: f"1010{30 - k}")
    phases = list_series(tmp_path).series[0].phases
    assert [(phase["keyword"], phase["value"]) for phase in phases] == [
        ("order of AcquisitionTime", "1"),
        ("order of AcquisitionTime", "2"),
    ]
    assert np.array_equal(read_volume(tmp_path, phase=2).voxels, plan.hu() + 300)


def test_different_slices_that_nothing_tells_apart_are_refused(tmp_path):
    write_series(tmp_path, Plan(offsets={3: -1.25}))
    with pytest.raises(RefusedInputError) as caught:
        read_volume(tmp_path)
    assert_one_line(caught.value, "duplicate", "slice002.dcm", "slice003.dcm", 1)


def test_copies_within_phases_are_dropped_first(tmp_path):
    write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, 500, AcquisitionNumber=2)
    (tmp_path / "copy").write_bytes((tmp_path / "phase2-3").read_bytes())
    volume = read_volume(tmp_path, phase=2)
    assert volume.shape_ijk == (6, 5, 7)
    assert "1 duplicate slice dropped: same place, same pixels as another" in volume.report["warnings"]


@pytest.mark.parametrize(
    ("phase", "says"), [(3, "no phase 3"), (0, "number from 1"), ("2", "number"), (True, "number")]
)
def test_phases_that_are_not_there_are_refused(tmp_path, phase, says):
    write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, 500, AcquisitionNumber=2)
    with pytest.raises(UsageError, match=says):
        read_volume(tmp_path, phase=phase)


def test_a_series_of_one_volume_has_a_first_phase_only(tmp_path):
    plan = write_series(tmp_path, Plan())
    assert np.array_equal(read_volume(tmp_path, phase=1).voxels, plan.hu())
    with refused(UsageError, "slice", "phase", 2):
        read_volume(tmp_path, phase=2)


def test_copies_whose_pixels_cannot_be_read_are_refused(tmp_path, monkeypatch):
    write_series(tmp_path, Plan())
    write_series(tmp_path, Plan(name="again{}".format))

    def fail(slices, progress=None, source=None):
        raise RefusedInputError("again0: does not decode")

    monkeypatch.setattr("clrecon.reading.dicom.series.phases.read_voxels", fail)
    with refused(RefusedInputError, "again0"):
        read_volume(tmp_path)
    assert list_series(tmp_path).series[0].phases == []


def test_the_same_stored_values_with_another_rescale_are_no_copies(tmp_path):
    write_series(tmp_path / "a", Plan())
    write_series(tmp_path / "b", Plan(intercept=-1000))
    one, other = (scan_path(tmp_path / name).slices[0] for name in "ab")
    assert have_same_pixels(one, one)
    assert not have_same_pixels(one, other)


def test_of_several_patients_none_is_taken_unasked(tmp_path):
    write_series(tmp_path / "a", Plan(series=1), set_values(PatientID="ONE"))
    write_series(tmp_path / "b", Plan(series=2, shape=(4, 5, 6)), set_values(PatientID="TWO"))
    with pytest.raises(RefusedInputError) as caught:
        read_volume(tmp_path)
    assert "CT series of 2 patients, choose one with series" in str(caught.value)
    assert "patient 1, series 1" in str(caught.value) and "ONE" not in str(caught.value)
    assert read_volume(tmp_path, 2).shape_ijk == (6, 5, 4)
    listing = list_series(tmp_path)
    assert listing.chosen is None
    assert [(entry.patient, entry.kind) for entry in listing.series] == [(1, "stack"), (2, "stack")]


def test_studies_are_numbered_and_never_mixed(tmp_path):
    write_series(tmp_path / "a", Plan(series=1), set_values(StudyInstanceUID="1.2.1"))
    write_series(tmp_path / "b", Plan(series=2, shape=(4, 5, 6)), set_values(StudyInstanceUID="1.2.2"))
    assert [entry.study for entry in list_series(tmp_path).series] == [1, 2]
    write_series(tmp_path / "a", Plan(series=1), set_values(3, StudyInstanceUID="1.2.9"))
    with refused(RefusedInputError, "StudyInstanceUID", "series"):
        read_volume(tmp_path, 1)


def test_localizers_at_one_place_and_broken_directions_are_no_phases(tmp_path):
    for number in range(3):
        write_series(
            tmp_path / f"scout{number}",
            Plan(series=1, shape=(1, 5, 6), name=f"scout{number}-{{}}".format),
            set_values(ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"]),
        )

    def skew(ds, k):
        ds.ImageOrientationPatient = [
            float(v) + 0.002 * (axis == 2) for axis, v in enumerate(ds.ImageOrientationPatient)
        ]

    write_series(tmp_path / "ct", Plan(series=2, angles=(0, 90, 90)), skew)
    scout, stack = list_series(tmp_path).series
    assert (scout.kind, scout.slices, scout.phases) == ("localizer", 3, [])
    assert any("off unit length or right angle" in text for text in stack.problems)
    assert not any("duplicate" in text for text in stack.problems) and stack.phases == []


def test_a_slice_that_two_phases_have_alike_belongs_to_both(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, 500, AcquisitionNumber=2)
    for k in (0, 6):
        ds = make_dataset(plan, k)
        ds.AcquisitionNumber = 2
        save_dataset(ds, tmp_path / f"phase2-{k}")
    (tmp_path / "copy").write_bytes((tmp_path / "phase2-3").read_bytes())
    expected = plan.hu()
    expected[1:6] += 500
    volume = read_volume(tmp_path, phase=2)
    assert np.array_equal(volume.voxels, expected)
    assert volume.ijk_to_lps([(0, 0, 0)])[0] == pytest.approx(plan.position(0))
    assert "1 duplicate slice dropped: same place, same pixels as another" in volume.report["warnings"]


def test_visits_are_ranked_where_two_of_them_are_alike(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionTime=lambda k: f"1010{10 + k}")
    write_phase(tmp_path, 2, 300, AcquisitionTime=lambda k: f"1010{30 + k}")
    ds = make_dataset(plan, 0)
    ds.AcquisitionTime = "101030"
    save_dataset(ds, tmp_path / "phase2-0")
    expected = plan.hu()
    expected[1:] += 300
    assert np.array_equal(read_volume(tmp_path, phase=2).voxels, expected)


@pytest.mark.parametrize(
    ("elements", "plan"),
    [
        ({"PixelSpacing": [0.9, 0.9]}, {}),
        ({"FrameOfReferenceUID": "1.2.3"}, {}),
        ({}, {"origin": (50.0, 31.25, -400.0)}),
        ({}, {"angles": (0.0, 0.0, 0.4)}),
    ],
    ids=["spacing", "frame", "moved sideways", "turned"],
)
def test_slices_with_equal_pixels_and_another_geometry_are_no_copies(tmp_path, elements, plan):
    write_series(tmp_path, Plan())
    write_phase(tmp_path, 2, plan=Plan(name="b{}".format, **plan), **elements)
    with refused(RefusedInputError, "series"):
        read_volume(tmp_path)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (
            {"AcquisitionTime": lambda k: f"{235955 + k if k < 5 else k - 5:06d}"},
            {"AcquisitionTime": lambda k: f"0000{30 + k}"},
        ),
        (
            {"ContentTime": lambda k: f"1010{10 + 2 * k + k % 2}"},
            {"ContentTime": lambda k: f"1010{10 + 2 * k + 1 - k % 2}"},
        ),
        ({"AcquisitionTime": lambda k: f"1010{10 + 3 * k}"}, {"AcquisitionTime": lambda k: f"1010{14 + 3 * k}"}),
    ],
    ids=["midnight", "order of reconstruction", "neither passes nor stops"],
)
def test_times_that_tell_no_passes_apart_are_not_ranked(tmp_path, first, second):
    write_phase(tmp_path, 1, **first)
    write_phase(tmp_path, 2, 500, **second)
    with refused(RefusedInputError, "element", "headers", 2):
        read_volume(tmp_path)


def test_stops_with_all_visits_each_are_ranked(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionTime=lambda k: f"10{10 + k // 3}10")
    write_phase(tmp_path, 2, 500, AcquisitionTime=lambda k: f"10{10 + k // 3}20")
    assert np.array_equal(read_volume(tmp_path, phase=2).voxels, plan.hu() + 500)


@pytest.mark.parametrize(
    ("keyword", "values", "along"),
    [("ConvolutionKernel", ("A", "B"), 0.625), ("KVP", (80, 120), 0.4), ("AcquisitionNumber", (1, 2), 5 * 1.25 + 0.5)],
    ids=["half a gap apart", "uneven", "overlapping acquisitions"],
)
def test_volumes_whose_slices_lie_between_each_other_are_phases(tmp_path, keyword, values, along):
    plans = [Plan(name=f"{n}-{{}}".format, origin=(-12.5, 31.25, -400 + n * along)) for n in (0, 1)]
    for number, value in enumerate(values):
        write_phase(tmp_path, number, 500 * number, plans[number], **{keyword: value})
    with pytest.raises(RefusedInputError) as caught:
        read_volume(tmp_path)
    assert_one_line(caught.value, "phases", "phase", keyword, 2, 1)
    for number, plan in enumerate(plans):
        volume = read_volume(tmp_path, phase=number + 1)
        assert np.array_equal(volume.voxels, plan.hu() + 500 * number) and not volume.uneven
        assert volume.ijk_to_lps([(2, 3, 4)])[0] == pytest.approx(plan.truth([(2, 3, 4)])[0])


@pytest.mark.parametrize(
    ("elements", "told"),
    [
        (
            {"AcquisitionNumber": lambda k: (1, 2, 1, 1, 2, 2, 1)[k]},
            "AcquisitionNumber alternates along the stack: maybe several",
        ),
        ({"KVP": lambda k: (80, 120)[k > 3]}, "KVP differs along the stack: maybe parts"),
        ({"SliceThickness": lambda k: 2.0 + (k == 3)}, "SliceThickness differs along the stack (1 of 7"),
        ({"AcquisitionNumber": lambda k: 1 + k // 2}, None),
        ({"AcquisitionNumber": lambda k: k}, None),
    ],
)
def test_elements_that_differ_along_a_stack_are_told(tmp_path, elements, told):
    write_phase(tmp_path, 1, **elements)
    warnings = read_volume(tmp_path).report["warnings"]
    assert len(warnings) == (told is not None)
    assert told is None or told in warnings[0]


def test_a_phase_that_is_shorter_than_another_is_said(tmp_path):
    write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, 500, Plan(name="b{}".format, leave_out=(6,)), AcquisitionNumber=2)
    assert "phase 2 has 6 slices, another one 7" in read_volume(tmp_path, phase=2).report["warnings"]
    assert not any("another one" in text for text in read_volume(tmp_path, phase=1).report["warnings"])


@pytest.mark.parametrize(
    ("elements", "told"),
    [
        ({"AcquisitionNumber": lambda k: k + 1}, "7 phases of one slice each, which differ in AcquisitionNumber"),
        ({}, "7 of them with different pixels, and no element of their headers parts them into phases"),
        ({"PixelData": lambda k: Plan().stored(0).tobytes()}, "copies of each other"),
    ],
)
def test_images_that_all_lie_at_one_place_are_no_volume(tmp_path, elements, told):
    def change(ds, k):
        ds.ImagePositionPatient = list(Plan().origin)
        for keyword, value in elements.items():
            setattr(ds, keyword, value(k))

    write_series(tmp_path, Plan(), change)
    entry = list_series(tmp_path).series[0]
    assert len(entry.problems) == 1
    for phase in (None, 1):
        with pytest.raises(RefusedInputError) as caught:
            read_volume(tmp_path, phase=phase)
        text = str(caught.value)
        assert f"all 7 images lie in one plane, at ImagePositionPatient (-12.5, 31.25, -400) mm ({told})" in text
        assert "a single slice cannot make a volume" in text and "export the series again" in text
        assert "choose one with" not in text
        assert ("choosing a phase does not help" in text) == bool(entry.phases)
    with refused(UsageError, "phase", 8, 7):
        read_volume(tmp_path, phase=8)
