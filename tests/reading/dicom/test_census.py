"""Slices that are missing without a hole: told by numbers and counts, and never by numbering that is only odd."""

from __future__ import annotations

import shutil

import pytest
from dicom_series import ROOT, Plan, set_values, write_series
from enhanced_series import write_enhanced
from variants import daily

from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.series.census import CLOSEST, LOCALIZERS, WIDER

SLICES = 24
STATED = set_values(ImagesInAcquisition=SLICES, NumberOfSeriesRelatedInstances=str(SLICES))


def numbered(number, *changes, thickness=1.0):
    """A change that numbers slice k with `number(k)`."""

    def change(ds, k):
        ds.InstanceNumber, ds.SliceThickness = number(k), thickness
        for one in changes:
            one(ds, k)

    return change


def write(folder, change, missing=(), **plan):
    """24 slices 1 mm apart, some of them missing."""
    return write_series(folder, Plan(shape=(SLICES, 4, 5), **{"gap": 1.0, "leave_out": tuple(missing), **plan}), change)


def judge_completeness(folder, **options):
    """The gate as `info` and a volume have it, and that a failed one is said."""
    report = read_volume(folder, **options).report
    (gate,) = (gate for gate in report["gates"] if gate["name"] == "complete_series")
    certificate = list_series(folder, **options).certificate
    assert gate["text"] in [other.text for other in certificate.gates]
    for warnings in (report["warnings"], certificate.warnings):
        assert (gate["text"] in warnings) == (gate["ok"] is False)
    return gate


def up(k):
    """1 to 24."""
    return k + 1


ODD = range(1, SLICES, 2)
LOST = {  # how slices are numbered, which are missing, how many the gate says, its words, and the plan
    "every second": (numbered(up), ODD, 11, "leaves out 11 of 1 to 23: step 2, and slices of 1 mm lie 2 mm apart"),
    "every second, downwards": (numbered(lambda k: 50 - k), ODD, 11, "leaves out 11 of 28 to 50: step 2"),
    "every second, overlapping": (numbered(up, thickness=1.5), ODD, 11, "slices of 1.5 mm lie 2 mm apart"),
    "two of three": (numbered(up), [k for k in range(SLICES) if k % 3], 14, "leaves out 14 of 1 to 22: step 3"),
    "every second, the thickness unknown": (
        numbered(up, thickness=None), ODD, 11,
        "of 1 to 23: step 2, slices lie 2 mm apart, and no SliceThickness says that none is between them",
    ),
    "three of four, the thickness unknown": (numbered(lambda k: 4 * k, thickness=None), (), 69, "step 4", {"gap": 2.8}),
    "every second of one half": (
        numbered(up, thickness=5), range(13, SLICES, 2), 5, "leaves out 5 of 1 to 23: their positions leave room"
    ),
    "ten at the start": (numbered(up), range(10), 10, "InstanceNumber begins with 11, and no image has the 10"),
    "ten at the end, counted": (
        numbered(up, STATED), range(14, SLICES), 10,
        "ImagesInAcquisition says 24, there are 14; NumberOfSeriesRelatedInstances says 24, there are 14",
    ),
    "ten at the end, images counted": (
        numbered(up, set_values(ImagesInAcquisition=SLICES)), range(14, SLICES), 10, "(ImagesInAcquisition says 24,"
    ),
    "counted, without numbers": (
        numbered(lambda k: "", STATED), [0], 1, "(ImagesInAcquisition says 24, there are 23; NumberOfSeries"
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", LOST.values(), ids=LOST)
def test_slices_missing_by_numbers_or_stated_counts_fail_the_gate_with_their_count(tmp_path, case):
    change, missing, count, words, *plan = case
    write(tmp_path, change, missing, **(plan[0] if plan else {}))
    gate = judge_completeness(tmp_path)
    assert (gate["ok"], gate["measured"], gate["bound"]) == (False, count, 0)
    assert words in gate["text"]


KEPT = {  # how slices are numbered, which are missing, and the plan
    "from 1": (numbered(up, STATED), ()),
    "from 0": (numbered(lambda k: k), ()),
    "downwards": (numbered(lambda k: 90 - k), ()),
    "in steps, touching": (numbered(lambda k: 2 * k + 1), ()),
    "every second of slices that overlap by half": (numbered(up, thickness=2), ODD),
    "in steps, the thickness unknown": (numbered(lambda k: 2 * k, thickness=None), ()),
    "in large steps, the thickness unknown": (numbered(lambda k: 5 * k, thickness=None), (), {"gap": 9.0}),
    "in ones, the thickness unknown": (numbered(up, thickness=None), (), {"gap": 5.0}),
    "a hole in the numbers alone": (numbered(lambda k: k + 1 + 50 * (k > 9)), ()),
    "after localizers elsewhere": (numbered(lambda k: k + 1 + LOCALIZERS), ()),
    "cut out of a longer series": (numbered(lambda k: k + 1 + SLICES), ()),
    "high resolution, far apart": (numbered(up), (), {"gap": 1.9}),
    "counted smaller": (numbered(up, set_values(ImagesInAcquisition=5, NumberOfSeriesRelatedInstances="5")), ()),
    "in tens": (numbered(lambda k: 10 * k), (), {"gap": 1.9}),
    "in steps beyond any count": (numbered(lambda k: 10**10 * (k + 1)), (), {"gap": 1.9}),
}


@pytest.mark.parametrize("case", KEPT.values(), ids=KEPT)
def test_series_with_odd_but_complete_numbers_passes_the_gate(tmp_path, case):
    change, missing, *plan = case
    write(tmp_path, change, missing, **(plan[0] if plan else {}))
    gate = judge_completeness(tmp_path)
    assert (gate["ok"], gate["measured"]) == (True, 0), gate["text"]


def test_completeness_is_not_judged_by_numbers_out_of_order_without_a_stated_count(tmp_path):
    write(tmp_path, numbered(lambda k: 7 * k % 23))
    gate = judge_completeness(tmp_path)
    assert (gate["ok"], gate["measured"]) == (None, None)


@pytest.mark.parametrize("wider", [False, True])
def test_every_second_number_fails_where_slices_lie_wider_apart_than_a_bound(tmp_path, wider):
    write(tmp_path, numbered(up), ODD, gap=0.5 * WIDER * (1.01 if wider else 0.99))
    assert judge_completeness(tmp_path)["ok"] is not wider


@pytest.mark.parametrize("far", [False, True])
def test_numbers_in_steps_fail_where_slices_lie_closer_than_a_bound_for_each_number(tmp_path, far):
    write(tmp_path, numbered(lambda k: 5 * k), gap=5 * CLOSEST * (1.01 if far else 0.99))
    assert judge_completeness(tmp_path)["ok"] is not far


@pytest.mark.parametrize("lost", [LOCALIZERS, LOCALIZERS + 1, SLICES // 2 - 1, SLICES // 2])
def test_numbers_that_begin_late_fail_between_the_most_localizers_and_half_of_the_slices(tmp_path, lost):
    write(tmp_path, numbered(up), range(lost))
    assert judge_completeness(tmp_path)["ok"] is (lost in (LOCALIZERS, SLICES // 2))


def scout(ds, k):
    ds.ImageType, ds.SOPInstanceUID = ["ORIGINAL", "PRIMARY", "LOCALIZER"], f"{ROOT}.8.{k}"
    ds.InstanceNumber = k + 1


def write_with_localizers(folder):
    """6 localizers with the numbers 1 to 6, 24 slices with 7 to 30, and 30 images by their headers."""
    write_series(folder / "scouts", Plan(shape=(6, 4, 5), angles=(0, 90, 90)), scout)
    stated = set_values(ImagesInAcquisition=SLICES + 6, NumberOfSeriesRelatedInstances=str(SLICES + 6))
    write(folder / "ct", numbered(lambda k: k + 7, stated))


def test_localizers_of_a_series_are_counted_as_its_images(tmp_path):
    write_with_localizers(tmp_path)
    assert judge_completeness(tmp_path)["ok"] is True


def test_localizers_that_are_missing_fail_the_gate(tmp_path):
    write_with_localizers(tmp_path)
    shutil.rmtree(tmp_path / "scouts")
    gate = judge_completeness(tmp_path)
    assert (gate["ok"], gate["measured"]) == (False, 6)


@pytest.mark.parametrize("together", daily(1, [True, False]), ids=["numbered by place", "one after the other"])
def test_all_phases_have_their_numbers_and_are_counted(tmp_path, together):
    for phase in (0, 1):
        number = (lambda k, p=phase: 2 * k + p + 1) if together else (lambda k, p=phase: SLICES * p + k + 1)
        values = set_values(AcquisitionNumber=phase + 1, ImagesInAcquisition=2 * SLICES)

        def another(ds, k, phase=phase, values=values):
            values(ds, k)
            ds.SOPInstanceUID = f"{ROOT}.7.{phase}.{k}"
            ds.PixelData = bytes([phase + 1, k]) * (len(ds.PixelData) // 2)

        write(tmp_path / str(phase), numbered(number, another, thickness=0.6))
    for phase in (1, 2):
        assert judge_completeness(tmp_path, phase=phase)["ok"] is True


def test_copies_do_not_make_up_for_what_is_missing(tmp_path):
    write(tmp_path / "ct", numbered(up, STATED))
    shutil.copytree(tmp_path / "ct", tmp_path / "again")
    assert judge_completeness(tmp_path)["ok"] is True
    for k in range(14, SLICES):
        for folder in ("ct", "again"):
            (tmp_path / folder / f"slice{k:03}.dcm").unlink()
    assert judge_completeness(tmp_path)["measured"] == 10


def test_images_of_an_acquisition_reconstructed_as_two_series_are_counted_in_both(tmp_path):
    stated = set_values(ImagesInAcquisition=2 * SLICES, StudyInstanceUID=f"{ROOT}.77")
    for series in (1, 2):
        write(tmp_path / str(series), numbered(up, stated), series=series)
    assert judge_completeness(tmp_path, series=1)["ok"] is True


def test_images_missing_of_the_other_series_of_an_acquisition_fail_the_gate(tmp_path):
    stated = set_values(ImagesInAcquisition=2 * SLICES, StudyInstanceUID=f"{ROOT}.77")
    for series in (1, 2):
        write(tmp_path / str(series), numbered(up, stated), series=series)
    (tmp_path / "2" / "slice000.dcm").unlink()
    assert judge_completeness(tmp_path, series=1)["measured"] == SLICES


def write_numbered_on(folder):
    """Series 1 with the numbers 1 to 10, and series 2 of the study with 11 to 34."""
    study = set_values(StudyInstanceUID=f"{ROOT}.77")
    write(folder / "1", numbered(up, study), range(10, SLICES))
    write(folder / "2", numbered(lambda k: k + 11, study), series=2)


def test_series_numbered_on_from_another_of_its_study_passes_the_gate(tmp_path):
    write_numbered_on(tmp_path)
    assert judge_completeness(tmp_path, series=2)["ok"] is True


def test_series_numbered_on_from_another_that_lacks_a_slice_fails_the_gate(tmp_path):
    write_numbered_on(tmp_path)
    (tmp_path / "1" / "slice009.dcm").unlink()
    assert judge_completeness(tmp_path, series=2)["measured"] == 10


def test_file_with_many_frames_counts_as_one_stated_instance(tmp_path):
    write_enhanced(tmp_path / "a.dcm", change=lambda ds: setattr(ds, "NumberOfSeriesRelatedInstances", "3"))
    text = judge_completeness(tmp_path)["text"]
    assert "(NumberOfSeriesRelatedInstances says 3, there is 1): 2, none allowed" in text


def test_certificate_holds_the_figures_of_the_numbering(tmp_path):
    write(tmp_path, numbered(up, set_values(ImagesInAcquisition=SLICES)), ODD)
    assert read_volume(tmp_path).report["numbering"] == {
        "first": 1, "last": 23, "step": 2, "images": 12, "images_stated": SLICES, "files": 12, "files_stated": None
    }  # fmt: skip
