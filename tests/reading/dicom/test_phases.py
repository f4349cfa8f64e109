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


def write_phase(folder, number, *, shift=0, plan=None, **elements):
    """The 7 slices of 5 x 6 pixels of a `Plan`, or those of another, their HU `shift` higher.

    `elements` of each slice may be functions of its number.
    """

    def change(ds, k):
        ds.PixelData = (np.frombuffer(ds.PixelData, "i2") + shift).tobytes()
        ds.SOPInstanceUID = f"{ds.SOPInstanceUID}.{number}"
        for keyword, value in elements.items():
            setattr(ds, keyword, value(k) if callable(value) else value)

    return write_series(folder, plan or Plan(name=f"phase{number}-{{}}".format), change)


def test_copies_of_all_slices_are_dropped_with_a_warning(tmp_path):
    plan = write_series(tmp_path, Plan(shape=(7, 5, 6)))
    write_series(tmp_path, Plan(name="again{}".format), set_values(ContentTime="101010"))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == ["7 duplicate slices dropped: same place, same pixels as another"]
    assert volume.report["files"]["used"] == 7


def test_series_with_copies_of_all_slices_is_listed_without_a_problem_or_phases(tmp_path):
    write_series(tmp_path, Plan(shape=(7, 5, 6)))
    write_series(tmp_path, Plan(shape=(7, 5, 6), name="again{}".format), set_values(ContentTime="101010"))
    series = list_series(tmp_path).series[0]
    assert (series.slices, series.shape_ijk) == (7 + 7, [6, 5, 7])
    assert (series.problems, series.phases) == ([], [])


def test_copy_of_one_slice_is_dropped_with_a_warning(tmp_path):
    plan = write_series(tmp_path, Plan())
    (tmp_path / "copy").write_bytes((tmp_path / "slice003.dcm").read_bytes())
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == ["1 duplicate slice dropped: same place, same pixels as another"]


TWO_PHASES = pytest.mark.parametrize(
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


@TWO_PHASES
def test_two_slices_at_each_place_are_listed_as_phases_with_the_element_that_differs(
    tmp_path, first, second, keyword, values
):
    write_phase(tmp_path, 1, **first)
    write_phase(tmp_path, 2, shift=500, **second)
    series = list_series(tmp_path).series[0]
    assert series.phases == [
        {"number": n, "keyword": keyword, "value": value, "slices": 7} for n, value in enumerate(values, start=1)
    ]
    assert series.affine_ijk_to_lps_mm is None
    assert series.slices == 7 + 7


@TWO_PHASES
def test_series_of_two_phases_is_refused_with_their_list(tmp_path, first, second, keyword, values):
    write_phase(tmp_path, 1, **first)
    write_phase(tmp_path, 2, shift=500, **second)
    with refused(RefusedInputError, "phases", "phase", keyword, 2, 7):  # two phases of seven slices
        read_volume(tmp_path)


@TWO_PHASES
def test_each_of_two_phases_is_read_by_its_number(tmp_path, first, second, keyword, values):
    plan = write_phase(tmp_path, 1, **first)
    write_phase(tmp_path, 2, shift=500, **second)
    shifts = [500, 0] if values[-1] == "(none)" else [0, 500]  # slices without the element are the last phase
    for number, shift in enumerate(shifts, start=1):
        volume = read_volume(tmp_path, phase=number)
        assert np.array_equal(volume.voxels, plan.hu() + shift)
        assert volume.ijk_to_lps([(2, 3, 4)])[0] == pytest.approx(plan.truth([(2, 3, 4)])[0])


@pytest.fixture
def report_of_phase_2(tmp_path, first, second):
    """The report of the second of two phases of 7 slices each, which are told apart by an element."""
    write_phase(tmp_path, 1, **first)
    write_phase(tmp_path, 2, shift=500, **second)  # HU, so that its slices are no copies of the first phase's
    return read_volume(tmp_path, phase=2).report


@TWO_PHASES
def test_report_of_a_phase_says_which_one_it_is(report_of_phase_2, keyword, values):
    assert report_of_phase_2["phase"] == {"number": 2, "of": 2, "keyword": keyword, "value": values[1]}


@TWO_PHASES
def test_warning_of_a_phase_tells_how_many_slices_of_others_are_left_out(report_of_phase_2, keyword, values):
    expected = f"phase 2 of 2 ({keyword} {values[1]}) read, 7 slices of others left"
    assert expected in report_of_phase_2["warnings"]


@pytest.mark.parametrize(
    ("first", "second"), [({"AcquisitionDate": "20200101"}, {"AcquisitionDate": "20210704"})], ids=["of 2020 and 2021"]
)
def test_warnings_of_phases_that_their_dates_tell_apart_hold_no_date(report_of_phase_2):
    warnings = "; ".join(report_of_phase_2["warnings"])
    assert "AcquisitionDate date 2" in warnings
    assert "2020" not in warnings and "2021" not in warnings


def test_phases_of_different_lengths_are_listed_and_read(tmp_path):
    write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, shift=9, plan=Plan(shape=(4, 5, 6), name="b{}".format), AcquisitionNumber=2)
    assert [phase["slices"] for phase in list_series(tmp_path).series[0].phases] == [7, 4]
    assert read_volume(tmp_path, phase=2).shape_ijk == (6, 5, 4)


def test_four_phases_that_two_elements_tell_apart_together_are_listed_and_read(tmp_path):
    for number, (kernel, phase) in enumerate([("A", 1), ("A", 2), ("B", 1), ("B", 2)]):
        write_phase(tmp_path, number, shift=100 * number, ConvolutionKernel=kernel, AcquisitionNumber=phase)
    phases = list_series(tmp_path).series[0].phases
    assert [phase["value"] for phase in phases] == ["1, A", "1, B", "2, A", "2, B"]
    assert {phase["keyword"] for phase in phases} == {"AcquisitionNumber and ConvolutionKernel"}
    shift_of_b_1 = 200
    assert read_volume(tmp_path, phase=2).voxels[0, 0, 0] == Plan().hu()[0, 0, 0] + shift_of_b_1


def test_slices_with_a_time_each_are_phases_by_the_order_of_their_times(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionTime=lambda k: f"1010{10 + k}")
    write_phase(tmp_path, 2, shift=300, AcquisitionTime=lambda k: f"1010{30 - k}")
    phases = list_series(tmp_path).series[0].phases
    assert [(phase["keyword"], phase["value"]) for phase in phases] == [
        ("order of AcquisitionTime", "1"),
        ("order of AcquisitionTime", "2"),
    ]
    assert np.array_equal(read_volume(tmp_path, phase=2).voxels, plan.hu() + 300)


def test_two_different_slices_at_one_place_that_no_element_tells_apart_are_refused(tmp_path):
    write_series(tmp_path, Plan(offsets={3: -1.25}))  # slice 3 lies where slice 2 does
    with refused(RefusedInputError, "duplicate", "slice002.dcm", "slice003.dcm", 1) as refusal:  # at one place
        read_volume(tmp_path)
    assert_one_line(refusal.value)


def test_copy_of_a_slice_of_a_phase_is_dropped_with_a_warning(tmp_path):
    write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, shift=500, AcquisitionNumber=2)
    (tmp_path / "copy").write_bytes((tmp_path / "phase2-3").read_bytes())
    volume = read_volume(tmp_path, phase=2)
    assert volume.shape_ijk == (6, 5, 7)
    assert "1 duplicate slice dropped: same place, same pixels as another" in volume.report["warnings"]


@pytest.mark.parametrize(
    ("phase", "fact"), [(3, 3), (0, 1), ("2", "number"), (True, "number")], ids=["3 of 2", "0", "text", "True"]
)
def test_phase_that_is_not_there_or_no_number_is_refused(tmp_path, phase, fact):
    write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, shift=500, AcquisitionNumber=2)
    with refused(UsageError, "phase", fact):
        read_volume(tmp_path, phase=phase)


def test_series_of_one_volume_is_read_as_its_first_phase_and_refused_as_its_second(tmp_path):
    plan = write_series(tmp_path, Plan())
    assert np.array_equal(read_volume(tmp_path, phase=1).voxels, plan.hu())
    with refused(UsageError, "slice", "phase", 2):
        read_volume(tmp_path, phase=2)


def test_two_slices_at_one_place_whose_pixels_cannot_be_compared_are_refused(tmp_path, monkeypatch):
    write_series(tmp_path, Plan())
    write_series(tmp_path, Plan(name="again{}".format))

    def fail(slices, progress=None, source=None):
        raise RefusedInputError("again0: does not decode")

    monkeypatch.setattr("clrecon.reading.dicom.series.phases.read_voxels", fail)
    with refused(RefusedInputError, "again0"):
        read_volume(tmp_path)
    assert list_series(tmp_path).series[0].phases == []


def test_slices_of_the_same_stored_values_with_another_rescale_are_no_copies(tmp_path):
    write_series(tmp_path / "a", Plan(intercept=-1024))
    write_series(tmp_path / "b", Plan(intercept=-1000))
    one, other = (scan_path(tmp_path / name).slices[0] for name in "ab")
    assert have_same_pixels(one, one)
    assert not have_same_pixels(one, other)


@pytest.fixture
def series_of_two_patients(tmp_path):
    """7 slices of the patient with the ID ONE, and 4 of TWO."""
    write_series(tmp_path / "a", Plan(series=1, shape=(7, 5, 6)), set_values(PatientID="ONE"))
    write_series(tmp_path / "b", Plan(series=2, shape=(4, 5, 6)), set_values(PatientID="TWO"))
    return tmp_path


def test_series_of_two_patients_are_refused_with_their_list_and_without_their_ids(series_of_two_patients):
    with pytest.raises(RefusedInputError) as refusal:
        read_volume(series_of_two_patients)
    text = str(refusal.value)
    assert "CT series of 2 patients, choose one with series" in text
    assert "patient 1, series 1" in text
    assert "ONE" not in text


def test_series_of_one_of_two_patients_is_read_by_its_number(series_of_two_patients):
    assert read_volume(series_of_two_patients, series=2).shape_ijk == (6, 5, 4)


def test_series_of_two_patients_are_listed_with_none_chosen(series_of_two_patients):
    listing = list_series(series_of_two_patients)
    assert listing.chosen is None
    assert [(series.patient, series.kind) for series in listing.series] == [(1, "stack"), (2, "stack")]


def test_series_of_two_studies_are_listed_with_the_number_of_each(tmp_path):
    write_series(tmp_path / "a", Plan(series=1), set_values(StudyInstanceUID="1.2.1"))
    write_series(tmp_path / "b", Plan(series=2, shape=(4, 5, 6)), set_values(StudyInstanceUID="1.2.2"))
    assert [series.study for series in list_series(tmp_path).series] == [1, 2]


def test_slice_of_another_study_within_a_series_is_refused(tmp_path):
    write_series(tmp_path, Plan(series=1), set_values(StudyInstanceUID="1.2.1"))
    write_series(tmp_path, Plan(series=1), set_values(only=3, StudyInstanceUID="1.2.9"))
    with refused(RefusedInputError, "StudyInstanceUID", "slice003.dcm"):
        read_volume(tmp_path, series=1)


def test_three_localizers_at_one_place_are_listed_without_phases(tmp_path):
    for number in range(3):
        write_series(
            tmp_path / f"scout{number}",
            Plan(series=1, shape=(1, 5, 6), name=f"scout{number}-{{}}".format),
            set_values(ImageType=["ORIGINAL", "PRIMARY", "LOCALIZER"]),
        )
    (scout,) = list_series(tmp_path).series
    assert (scout.kind, scout.slices, scout.phases) == ("localizer", 3, [])


def test_series_whose_directions_are_not_at_right_angles_is_listed_with_that_problem_and_without_phases(tmp_path):
    def skew(ds, k):
        x, y, z, *column = map(float, ds.ImageOrientationPatient)
        ds.ImageOrientationPatient = [x, y, z + 0.002, *column]

    write_series(tmp_path, Plan(angles=(0, 90, 90)), skew)
    (stack,) = list_series(tmp_path).series
    assert any("off unit length or right angle" in problem for problem in stack.problems)
    assert not any("duplicate" in problem for problem in stack.problems)
    assert stack.phases == []


def test_slices_that_are_the_same_in_two_phases_belong_to_both(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, shift=500, AcquisitionNumber=2)
    for k in (0, 6):  # first and last slice of phase 2: the pixels of phase 1
        ds = make_dataset(plan, k)
        ds.AcquisitionNumber = 2
        save_dataset(ds, tmp_path / f"phase2-{k}")
    expected = plan.hu()
    expected[1:6] += 500
    volume = read_volume(tmp_path, phase=2)
    assert np.array_equal(volume.voxels, expected)
    assert volume.ijk_to_lps([(0, 0, 0)])[0] == pytest.approx(plan.position(0))


def test_copy_beside_slices_that_are_the_same_in_two_phases_is_dropped_with_a_warning(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, shift=500, AcquisitionNumber=2)
    ds = make_dataset(plan, 0)
    ds.AcquisitionNumber = 2
    save_dataset(ds, tmp_path / "phase2-0")
    (tmp_path / "copy").write_bytes((tmp_path / "phase2-3").read_bytes())
    volume = read_volume(tmp_path, phase=2)
    assert volume.shape_ijk == (6, 5, 7)
    assert "1 duplicate slice dropped: same place, same pixels as another" in volume.report["warnings"]


def test_phases_by_the_order_of_times_may_have_a_slice_in_common(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionTime=lambda k: f"1010{10 + k}")
    write_phase(tmp_path, 2, shift=300, AcquisitionTime=lambda k: f"1010{30 + k}")
    ds = make_dataset(plan, 0)  # the first slice of the second phase: the pixels of the first
    ds.AcquisitionTime = "101030"
    save_dataset(ds, tmp_path / "phase2-0")
    expected = plan.hu()
    expected[1:] += 300
    assert np.array_equal(read_volume(tmp_path, phase=2).voxels, expected)


@pytest.mark.parametrize(
    ("elements", "plan", "fact"),
    [
        ({"PixelSpacing": [0.9, 0.9]}, {}, "geometry"),
        ({"FrameOfReferenceUID": "1.2.3"}, {}, "geometry"),
        ({}, {"origin": (50.0, 31.25, -400.0)}, "geometry"),
        ({}, {"angles": (0.0, 0.0, 0.4)}, "ImageOrientationPatient"),
    ],
    ids=["spacing", "frame", "moved sideways", "turned"],
)
def test_slices_of_equal_pixels_and_another_geometry_are_not_dropped_but_refused(tmp_path, elements, plan, fact):
    write_series(tmp_path, Plan())
    write_phase(tmp_path, 2, plan=Plan(name="b{}".format, **plan), **elements)
    with refused(RefusedInputError, fact):
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
def test_slices_whose_times_tell_no_passes_apart_are_refused(tmp_path, first, second):
    write_phase(tmp_path, 1, **first)
    write_phase(tmp_path, 2, shift=500, **second)
    with refused(RefusedInputError, "duplicate", "element", "headers", 7):  # at seven places
        read_volume(tmp_path)


def test_slices_of_a_table_that_stops_for_both_phases_are_read_by_the_order_of_their_times(tmp_path):
    plan = write_phase(tmp_path, 1, AcquisitionTime=lambda k: f"10{10 + k // 3}10")  # three slices at each stop
    write_phase(tmp_path, 2, shift=500, AcquisitionTime=lambda k: f"10{10 + k // 3}20")
    assert np.array_equal(read_volume(tmp_path, phase=2).voxels, plan.hu() + 500)


BETWEEN = pytest.mark.parametrize(
    ("keyword", "values", "along"),
    [("ConvolutionKernel", ("A", "B"), 0.625), ("KVP", (80, 120), 0.4), ("AcquisitionNumber", (1, 2), 5 * 1.25 + 0.5)],
    ids=["half a gap apart", "uneven", "overlapping acquisitions"],
)


def write_two_volumes(folder, keyword, values, along):
    """Two volumes, the second with pixels 500 higher and `along` mm towards the head."""
    plans = [Plan(name=f"{n}-{{}}".format, origin=(-12.5, 31.25, -400 + n * along)) for n in (0, 1)]
    for number, value in enumerate(values):
        write_phase(folder, number, shift=500 * number, plan=plans[number], **{keyword: value})
    return plans


@BETWEEN
def test_two_volumes_whose_slices_lie_between_each_other_are_refused_as_phases(tmp_path, keyword, values, along):
    write_two_volumes(tmp_path, keyword, values, along)
    with refused(RefusedInputError, "phases", "phase", keyword, 2) as refusal:
        read_volume(tmp_path)
    assert_one_line(refusal.value)


@BETWEEN
def test_each_of_two_volumes_whose_slices_lie_between_each_other_is_read_evenly(tmp_path, keyword, values, along):
    for number, plan in enumerate(write_two_volumes(tmp_path, keyword, values, along)):
        volume = read_volume(tmp_path, phase=number + 1)
        assert not volume.uneven
        assert np.array_equal(volume.voxels, plan.hu() + 500 * number)
        assert volume.ijk_to_lps([(2, 3, 4)])[0] == pytest.approx(plan.truth([(2, 3, 4)])[0])


@pytest.mark.parametrize(
    ("elements", "words"),
    [
        pytest.param(
            {"AcquisitionNumber": lambda k: (1, 2, 1, 1, 2, 2, 1)[k]},
            "AcquisitionNumber alternates along the stack: maybe several",
            id="by turns",
        ),
        pytest.param({"KVP": lambda k: (80, 120)[k > 3]}, "KVP differs along the stack: maybe parts", id="two parts"),
        pytest.param(
            {"SliceThickness": lambda k: 2.0 + (k == 3)},
            "SliceThickness differs along the stack (1 of 7",
            id="one slice",
        ),
    ],
)
def test_element_that_differs_along_a_stack_is_warned_of(tmp_path, elements, words):
    write_phase(tmp_path, 1, **elements)
    (warning,) = read_volume(tmp_path).report["warnings"]
    assert words in warning


@pytest.mark.parametrize("number", [lambda k: 1 + k // 2, lambda k: k], ids=["two slices each", "a slice each"])
def test_acquisition_number_that_counts_along_a_stack_is_not_warned_of(tmp_path, number):
    write_phase(tmp_path, 1, AcquisitionNumber=number)
    assert read_volume(tmp_path).report["warnings"] == []


def test_phase_that_is_shorter_than_another_is_warned_of(tmp_path):
    write_phase(tmp_path, 1, AcquisitionNumber=1)
    write_phase(tmp_path, 2, shift=500, plan=Plan(name="b{}".format, leave_out=(6,)), AcquisitionNumber=2)
    assert "phase 2 has 6 slices, another one 7" in read_volume(tmp_path, phase=2).report["warnings"]
    assert not any("another one" in warning for warning in read_volume(tmp_path, phase=1).report["warnings"])


ONE_PLACE = {
    "phases": (
        {"AcquisitionNumber": lambda k: k + 1}, "7 phases of one slice each, which differ in AcquisitionNumber"
    ),
    "different pixels": (
        {}, "7 of them with different pixels, and no element of their headers parts them into phases"
    ),
    "copies": ({"PixelData": lambda k: Plan().stored(0).tobytes()}, "copies of each other"),
}  # fmt: skip


@pytest.fixture(params=ONE_PLACE)
def images_at_one_place(request, tmp_path):
    """A folder of 7 images that all lie at one place, and what is said of them."""
    elements, words = ONE_PLACE[request.param]

    def change(ds, k):
        ds.ImagePositionPatient = list(Plan().origin)
        for keyword, value in elements.items():
            setattr(ds, keyword, value(k))

    write_series(tmp_path, Plan(), change)
    return tmp_path, words


@pytest.mark.parametrize("phase", [None, 1])
def test_images_at_one_place_are_refused_with_what_they_are_and_what_to_do(images_at_one_place, phase):
    folder, words = images_at_one_place
    with pytest.raises(RefusedInputError) as refusal:
        read_volume(folder, phase=phase)
    text = str(refusal.value)
    assert f"all 7 images lie in one plane, at ImagePositionPatient (-12.5, 31.25, -400) mm ({words})" in text
    assert "a single slice cannot make a volume" in text
    assert "export the series again" in text
    assert "choose one with" not in text
    assert ("choosing a phase does not help" in text) == ("7 phases" in words)


def test_images_at_one_place_are_listed_with_one_problem(images_at_one_place):
    assert len(list_series(images_at_one_place[0]).series[0].problems) == 1


def test_phase_beyond_the_images_at_one_place_is_refused(images_at_one_place):
    with refused(UsageError, "phase", 8, 7):  # the eighth, of seven images
        read_volume(images_at_one_place[0], phase=8)
