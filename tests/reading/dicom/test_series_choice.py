"""What is found in a folder, how it is grouped, listed and chosen, and what is said of the rest."""

from __future__ import annotations

import json
import os
import shutil
import time

import numpy as np
import pydicom
import pytest
import tolerances
from dicom_series import (
    ROOT,
    Plan,
    hash_of,
    make_dataset,
    save_dataset,
    set_raw,
    set_values,
    write_series,
    write_two_series,
)
from pydicom.data import get_testdata_file
from pydicom.uid import MRImageStorage, SecondaryCaptureImageStorage
from refusals import refused

from clrecon.errors import NoDicomError, RefusedInputError, UsageError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.series.series import SPLIT_ANGLE_RAD, Planes

CONTRACT = (
    "number uid_hash description modality slices shape_ijk spacing_mm affine_ijk_to_lps_mm tilt_deg "
    "grid_residual_max_mm gap_mm uneven warnings problems"
).split()


@pytest.fixture
def series_of_7_and_4(tmp_path):
    """The UIDs end with 2 and 5; the listing numbers them 1, of 7 slices, and 2, of 4."""
    return write_two_series(tmp_path)


def test_listing_has_the_names_of_the_contract(series_of_7_and_4):
    entries = [entry.as_dict() for entry in list_series(series_of_7_and_4).series]
    assert [list(entry)[: len(CONTRACT)] for entry in entries] == [CONTRACT, CONTRACT]
    assert json.loads(json.dumps(entries)) == entries


def test_listing_begins_with_the_largest_series_and_chooses_it(series_of_7_and_4):
    listing = list_series(series_of_7_and_4)
    assert listing.chosen == 1
    assert [(entry.number, entry.slices) for entry in listing.series] == [(1, 7), (2, 4)]


def test_listing_describes_a_series_by_its_stack(series_of_7_and_4):
    entry = list_series(series_of_7_and_4).series[0].as_dict()
    (dj, di), gap = Plan().pixel_spacing, Plan().gap
    expected = {
        "uid_hash": hash_of(2), "description": "series 2", "modality": "CT",
        "shape_ijk": [6, 5, 7], "spacing_mm": pytest.approx([di, dj, gap]),
        "gap_mm": pytest.approx({"min": gap, "max": gap, "median": gap}),
        "tilt_deg": pytest.approx(0, abs=tolerances.TILT_DEG), "uneven": False, "warnings": [], "problems": [],
    }  # fmt: skip
    assert {name: entry[name] for name in expected} == expected
    assert np.array(entry["affine_ijk_to_lps_mm"])[:3, 3] == pytest.approx(Plan().origin)
    assert entry["grid_residual_max_mm"] < tolerances.GRID_RESIDUAL_MM


def test_series_with_the_most_slices_is_read_and_the_other_warned_of(series_of_7_and_4):
    report = read_volume(series_of_7_and_4).report
    assert report["series"] == {"number": 1, "uid_hash": hash_of(2), "modality": "CT"}
    assert report["warnings"] == [
        "1 other CT series not used: [2: CT, 4 slices]; series 1 is read, with the most slices"
    ]
    assert report["files"] == {"found": 7 + 4, "used": 7, "skipped": {}}
    assert list_series(series_of_7_and_4).warnings == report["warnings"]


@pytest.mark.parametrize("wanted", [2, "2", "series 5", "SERIES 5", "es 5", f"{ROOT}.5", hash_of(5)])
def test_series_is_chosen_by_number_description_uid_or_hash(series_of_7_and_4, wanted):
    assert read_volume(series_of_7_and_4, wanted).report["series"]["number"] == 2


@pytest.mark.parametrize("wanted", [3, "neck", "", "9", "1.2.4"])
def test_series_that_is_not_there_is_refused_with_those_that_are(series_of_7_and_4, wanted):
    numbers_and_slices = (1, 7, 2, 4)
    with refused(UsageError, repr(wanted), "CT", *numbers_and_slices):
        read_volume(series_of_7_and_4, wanted)


def test_text_that_several_descriptions_hold_is_refused_with_their_list(series_of_7_and_4):
    write_series(
        series_of_7_and_4, Plan(series=8, shape=(3, 5, 6), name="neck{}".format), set_values(SeriesDescription="neck")
    )
    with pytest.raises(UsageError) as caught:
        read_volume(series_of_7_and_4, "erie")
    assert str(caught.value) == (
        "2 series match series 'erie': [1: CT, 7 slices], [2: CT, 4 slices] (\"clrecon info\" describes them)"
    )


@pytest.mark.parametrize("wanted", [hash_of(5)[:4], hash_of(5)[:10].upper()], ids=["4 letters", "10 letters"])
def test_series_is_chosen_by_the_start_of_its_hash(series_of_7_and_4, wanted):
    assert read_volume(series_of_7_and_4, wanted).report["series"]["number"] == 2


def test_three_letters_of_a_hash_choose_no_series(series_of_7_and_4):
    letters = hash_of(5)[:3]
    with refused(UsageError, "no", "series", repr(letters)):
        read_volume(series_of_7_and_4, letters)


def test_start_of_two_uids_is_refused(series_of_7_and_4):
    with refused(UsageError, 2, "match"):  # series
        read_volume(series_of_7_and_4, ROOT)


def test_two_series_of_equal_size_are_refused_with_their_list(tmp_path):
    write_series(tmp_path, Plan(series=1, shape=(7, 5, 6)))
    write_series(tmp_path, Plan(series=2, shape=(7, 5, 6), name="x{}".format))
    with refused(RefusedInputError, "CT", 1, 2, 7):  # both numbers, and the slices of each
        read_volume(tmp_path)
    assert read_volume(tmp_path, series=2).report["series"]["uid_hash"] == hash_of(2)


def test_of_two_series_of_equal_size_none_is_chosen_in_the_listing(tmp_path):
    write_series(tmp_path, Plan(series=1))
    write_series(tmp_path, Plan(series=2, name="x{}".format))
    listing = list_series(tmp_path)
    assert listing.chosen is None
    assert "choose one with series" in listing.warnings[0]


def test_faulty_largest_series_is_refused_and_not_passed_over(series_of_7_and_4):
    spoil_largest(series_of_7_and_4)
    with refused(RefusedInputError, "b3", "PixelSpacing", 1):
        read_volume(series_of_7_and_4)


def test_smaller_series_beside_a_faulty_one_is_read_by_its_number_without_a_warning(series_of_7_and_4):
    spoil_largest(series_of_7_and_4)
    smaller = read_volume(series_of_7_and_4, series=2)
    assert smaller.voxels.shape == (4, 5, 6)
    assert smaller.report["warnings"] == []


def spoil_largest(folder):
    """Give one slice of the largest of `series_of_7_and_4` pixels of 0 mm."""
    file = folder / "sub" / "b3"
    ds = pydicom.dcmread(file)
    set_raw("PixelSpacing", "0\\0")(ds, 3)
    ds.save_as(file)


def test_usable_one_of_two_series_of_equal_size_is_read_and_the_other_warned_of(tmp_path):
    write_series(tmp_path, Plan(series=1, shape=(7, 5, 6)), set_raw("PixelSpacing", "0\\0", only=3))
    write_series(tmp_path, Plan(series=2, shape=(7, 5, 6), name="x{}".format))
    report = read_volume(tmp_path).report
    assert report["series"]["uid_hash"] == hash_of(2)
    assert report["warnings"] == [
        "1 other CT series not used: [1: CT, 7 slices, cannot be used];"
        " series 2 is read, the only one of its size that can be used"
    ]


def test_two_usable_series_beside_a_faulty_one_of_equal_size_are_refused_without_that(tmp_path):
    write_series(tmp_path, Plan(series=1, shape=(7, 5, 6)), set_raw("PixelSpacing", "0\\0", only=3))
    for number in (2, 3):
        write_series(tmp_path, Plan(series=number, shape=(7, 5, 6), name=f"{number}-{{}}".format))
    with refused(RefusedInputError, "CT", 2, 3, 7) as refusal:  # both numbers, and the slices of each
        read_volume(tmp_path)
    assert "[1: " not in repr(refusal.value)


def test_two_faulty_series_of_equal_size_are_refused_though_a_smaller_one_is_usable(tmp_path):
    for number in (1, 2):
        spoil = set_raw("PixelSpacing", "0\\0", only=3)
        write_series(tmp_path, Plan(series=number, shape=(7, 5, 6), name=f"{number}-{{}}".format), spoil)
    write_series(tmp_path, Plan(series=3, shape=(4, 5, 6), name="3-{}".format))
    with refused(RefusedInputError, "PixelSpacing", 7, "1-3", "2-3"):  # slices of each, and the faulty files
        read_volume(tmp_path)


@pytest.mark.parametrize("frames", [7, 300], ids=["as many", "more"])
def test_multi_frame_image_without_places_of_its_frames_counts_as_one_slice(tmp_path, frames):
    """It is one image of unknown content, whatever number of frames it claims."""
    plan = write_series(tmp_path, Plan(series=1, shape=(7, 5, 6)))
    ds = make_dataset(Plan(series=2), 0)
    ds.NumberOfFrames = frames
    save_dataset(ds, tmp_path / "many")
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == [
        "1 other CT series not used: [2: CT, 1 slice]; series 1 is read, with the most slices"
    ]
    with refused(RefusedInputError, frames, "SOP"):
        read_volume(tmp_path, series=2)


def test_localizer_in_the_series_is_left_out_with_a_warning(tmp_path):
    plan = write_series(tmp_path)
    scout = make_dataset(Plan(shape=(1, 9, 9)), 0)
    scout.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
    save_dataset(scout, tmp_path / "scout")
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == [
        "not used, though they may be harmed slices of series 1: [2: CT, 1 slice, localizer]"
    ]


def test_slice_in_another_plane_in_the_series_is_listed_and_left_as_another_series(tmp_path):
    plan = write_series(tmp_path)
    save_dataset(make_dataset(Plan(angles=(90, 0, 0), shape=(1, 9, 9)), 0), tmp_path / "scout")
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == [
        "1 other CT series not used: [2: CT, 1 slice]; series 1 is read, with the most slices",
        "1 slice of the series that is read left: in another plane, 90.0 degrees off",
    ]
    assert len(list_series(tmp_path).series) == 2


def test_series_with_a_slice_in_another_plane_is_chosen_by_its_uid(tmp_path):
    plan = write_series(tmp_path, Plan(series=1))
    save_dataset(make_dataset(Plan(series=1, angles=(90, 0, 0), shape=(1, 9, 9)), 0), tmp_path / "scout")
    assert read_volume(tmp_path, f"{ROOT}.1").report["slices"] == plan.shape[0]


def test_secondary_capture_in_the_series_is_listed_apart_with_its_problem(tmp_path):
    plan = write_series(tmp_path)
    ds = make_dataset(plan, 0)
    ds.SOPClassUID = ds.file_meta.MediaStorageSOPClassUID = SecondaryCaptureImageStorage
    del ds.ImagePositionPatient
    save_dataset(ds, tmp_path / "dose")
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())
    entry = list_series(tmp_path).series[1]
    assert entry.problems == [
        f"dose: secondary capture (SOP class {SecondaryCaptureImageStorage}): "
        "without ImagePositionPatient (0020,0032): no geometry"
    ]


def write_mr(folder):
    """A series of MR of 7 slices."""
    write_series(folder, Plan(shape=(7, 5, 6)), change=set_values(Modality="MR", SOPClassUID=MRImageStorage))


def test_folder_of_mr_alone_is_refused(tmp_path):
    write_mr(tmp_path)
    with refused(NoDicomError, "MR", "CT", 1):  # series of MR
        read_volume(tmp_path)


def test_series_of_mr_is_listed_with_that_problem_and_not_chosen(tmp_path):
    write_mr(tmp_path)
    listing = list_series(tmp_path)
    (series,) = listing.series
    assert listing.chosen is None
    assert (series.modality, series.slices) == ("MR", 7)
    assert series.problems == ["modality MR is not CT"]


def test_ct_beside_a_larger_series_of_mr_is_read_and_the_mr_refused(tmp_path):
    write_mr(tmp_path)
    write_series(tmp_path, Plan(series=2, shape=(3, 5, 6), name="ct{}".format))
    assert read_volume(tmp_path).report["series"]["modality"] == "CT"
    with refused(NoDicomError, "MR", "CT", 1):
        read_volume(tmp_path, series=1)


def test_two_series_of_one_slice_are_refused(tmp_path):
    for number in (1, 2):
        write_series(tmp_path, Plan(series=number, shape=(1, 5, 6), name=f"{number}-{{}}".format))
    with refused(RefusedInputError, 2, "single", "volume"):  # two series
        read_volume(tmp_path)


def test_single_slice_is_refused_as_it_makes_no_volume(tmp_path):
    write_series(tmp_path, Plan(shape=(1, 5, 6)))
    with refused(RefusedInputError, "single", "volume"):
        read_volume(tmp_path / "slice000.dcm")


def test_slices_without_a_series_uid_are_one_series_by_their_folder_with_a_warning(tmp_path):
    plan = write_series(tmp_path, change=set_values(SeriesInstanceUID=None))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["series"]["uid_hash"] is None
    assert "no SeriesInstanceUID" in volume.report["warnings"][0]


def test_hostile_descriptions_come_out_in_one_printable_line(tmp_path):
    write_series(tmp_path, change=set_raw("SeriesDescription", "a\n\x1b[31m../\x00b" + "x" * 100))
    text = list_series(tmp_path).series[0].description
    assert text.isprintable()
    assert text.startswith("a\\n\\x1b[31m../\\x00bxx")
    assert len(text) == 64


def test_descriptions_keep_their_character_set(tmp_path):
    write_series(tmp_path, change=set_values(SpecificCharacterSet="ISO_IR 192", SeriesDescription="Rücken 背骨"))
    assert list_series(tmp_path).series[0].description == "Rücken 背骨"


@pytest.fixture
def doe_folder(tmp_path):
    """Two series, of 7 slices and of 3, a corrupt file and a text, with "Doe" in names and descriptions.

    Of the first series the slices 2, 3 and 6 are not in HU.
    """
    folder = tmp_path / "Doe^John"

    def spoil(ds, k):
        ds.SeriesDescription = "Doe, spine"
        if k in (2, 3, 6):
            ds.RescaleType = "US"

    write_series(folder, Plan(shape=(7, 5, 6), tilt_deg=3, name="Doe{}.dcm".format), spoil)
    write_series(folder / "Doe2", Plan(series=2, shape=(3, 5, 6), name="Doe{}.dcm".format), spoil)
    (folder / "Doe2" / "Doe9").write_bytes(bytes(128) + b"DICM" + b"\xff" * 50)
    (folder / "Doe2" / "Doe8.dcm").write_text("none")
    return folder


def test_report_and_warnings_hold_no_patient_data_and_no_folder(doe_folder):
    volume, listing = read_volume(doe_folder), list_series(doe_folder)
    text = json.dumps([volume.report, listing.warnings, [series.warnings for series in listing.series]])
    for private in ("SECRET", "Doe", str(doe_folder.parent)):  # SECRET is in the patient's elements
        assert private not in text


def test_warnings_count_slices_files_and_series_without_naming_them(doe_folder):
    _, _, z_mm = Plan().position(2)  # of the first slice that is not in HU
    assert read_volume(doe_folder).report["warnings"] == [
        "gantry tilt -3.00 degrees: kept exactly, as a shear",
        f"RescaleType is 'US': the values are not HU (3 of 7 slices, the first at {z_mm:.2f} mm)",
        "1 corrupt file skipped",
        "1 skipped: named like DICOM but is none",
        "1 other CT series not used: [2: CT, 3 slices]; series 1 is read, with the most slices",
    ]


def test_refusal_names_files_and_not_the_description_of_the_series(tmp_path):
    write_series(tmp_path, Plan(leave_out=(2,)), set_values(SeriesDescription="Doe, spine"))
    with refused(RefusedInputError, "slice001.dcm", "slice003.dcm", "missing") as refusal:
        read_volume(tmp_path)
    assert "Doe" not in repr(refusal.value)


# --- what else lies in a folder ---


def test_folder_that_does_not_exist_is_refused(tmp_path):
    with refused(NoDicomError, "nowhere", "exist"):
        read_volume(tmp_path / "nowhere")


def test_empty_folder_is_refused_with_0_files(tmp_path):
    with refused(NoDicomError, "DICOM", 0):
        read_volume(tmp_path)


def test_folder_of_other_files_is_refused_with_their_kinds(tmp_path):
    (tmp_path / "empty").touch()
    (tmp_path / "text.dcm").write_text("DICM " * 100)
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(300))
    with pytest.raises(NoDicomError, match=r"3 files looked at \(PNG image: 1, not DICOM: 2\)"):
        list_series(tmp_path)


def test_text_named_as_dicom_is_refused(tmp_path):
    (tmp_path / "text.dcm").write_text("DICM " * 100)
    with refused(NoDicomError, "DICOM", "text"):
        read_volume(tmp_path / "text.dcm")


@pytest.mark.parametrize("read", [read_volume, list_series])
@pytest.mark.parametrize("path", ["", " "], ids=["empty", "space"])
def test_empty_path_is_refused(read, path):
    with refused(UsageError, "path", "empty"):
        read(path)


def test_number_in_place_of_a_path_is_refused():
    with refused(UsageError, "path", "int"):
        read_volume(7)


def test_path_with_a_nul_is_refused_as_no_dicom():
    with refused(NoDicomError, "exist"):
        read_volume("nul\0byte")


def test_corrupt_files_alone_are_refused(tmp_path):
    (tmp_path / "bad").write_bytes(bytes(128) + b"DICM" + b"\xff" * 50)
    with refused(RefusedInputError, "corrupt", "bad"):
        read_volume(tmp_path)


@pytest.fixture
def with_links_and_pipes(tmp_path):
    """A series with links to itself, to one slice, to a pipe and a device, with a pipe and an empty folder x.dcm."""
    folder, outside = tmp_path / "in", tmp_path / "out"
    plan = write_series(folder)
    write_series(outside, Plan(series=3, shape=(9, 5, 6)))
    os.symlink(folder, folder / "loop")
    os.symlink(folder / "slice000.dcm", folder / "twice")
    os.mkfifo(outside / "pipe")
    os.mkfifo(folder / "pipe")
    os.symlink(outside / "pipe", folder / "piped")
    os.symlink("/dev/zero", folder / "zero")
    (folder / "x.dcm").mkdir()
    return plan, folder


@pytest.mark.parametrize("follow_links", [False, True])
def test_links_and_pipes_are_passed_over(with_links_and_pipes, follow_links):
    plan, folder = with_links_and_pipes
    volume = read_volume(folder, follow_links=follow_links)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["files"]["skipped"] == {"link inside the folder": 2, "not a regular file": 3}


def test_pipe_is_refused_as_input(with_links_and_pipes):
    with refused(NoDicomError, "regular"):
        read_volume(with_links_and_pipes[1] / "pipe")


def test_folder_that_is_named_by_a_link_is_read(tmp_path):
    plan = write_series(tmp_path / "ct")
    os.symlink(tmp_path / "ct", tmp_path / "named")
    assert read_volume(tmp_path / "named").report["slices"] == plan.shape[0]


@pytest.fixture
def dicomdir_tree(tmp_path):
    """The tree of a DICOMDIR that comes with pydicom."""
    source = get_testdata_file("DICOMDIR")
    folder = tmp_path / "tree"
    shutil.copytree(os.path.dirname(source), folder, ignore=shutil.ignore_patterns("DICOMDIR-nopatient"))
    return folder


def test_tree_of_a_dicomdir_is_listed_by_its_files(dicomdir_tree):
    listing = list_series(dicomdir_tree)
    assert listing.skipped["DICOMDIR"] >= 1
    slices = [series.slices for series in listing.series if series.modality == "CT"]
    assert slices == [4, 2, 5]  # folders CT2, CT2N and CT5N


def test_dicomdir_is_refused_as_it_only_lists_files(dicomdir_tree):
    with refused(NoDicomError, "DICOMDIR", "lists"):
        read_volume(dicomdir_tree / "DICOMDIR")


def test_single_slice_of_another_scanner_is_refused_as_it_makes_no_volume():
    with refused(RefusedInputError, "single", "volume"):
        read_volume(get_testdata_file("CT_small.dcm"))


def test_single_slice_of_another_scanner_is_listed_without_gaps_and_affine():
    series = list_series(get_testdata_file("CT_small.dcm")).series[0]
    assert series.shape_ijk == [128, 128, 1]
    assert series.affine_ijk_to_lps_mm is None
    assert series.gap_mm == {"min": None, "max": None, "median": None}


def test_progress_of_reading_counts_files_and_then_slices(series_of_7_and_4):
    calls = []
    read_volume(series_of_7_and_4, progress=lambda *call: calls.append(call))
    assert calls == [("scan", n, 7 + 4) for n in range(1, 7 + 4 + 1)] + [("read", n, 7) for n in range(1, 7 + 1)]


def test_last_slice_tilted_by_2_degrees_is_left_with_a_warning(tmp_path):
    """At the end of the stack it leaves no hole."""
    across, along = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    write_series(
        tmp_path, Plan(shape=(7, 5, 6)), set_values(only=6, ImageOrientationPatient=[1, 0, 0, 0, across, along])
    )
    volume = read_volume(tmp_path)
    assert volume.shape_ijk == (6, 5, 7 - 1)
    warning = "1 slice of the series that is read left: in another plane, 2.0 degrees off"
    assert warning in volume.report["warnings"]
    assert warning in list_series(tmp_path).warnings


def test_two_series_without_uids_are_told_apart_by_their_numbers(tmp_path):
    without_uids = {"SeriesInstanceUID": "", "FrameOfReferenceUID": "1.2.3"}
    above = write_series(tmp_path, Plan(series=1, shape=(7, 5, 6)), set_values(**without_uids))
    x, y, z = above.origin
    below = Plan(series=2, shape=(4, 5, 6), name="b{}".format, origin=(x, y, z - 4 * above.gap))
    write_series(tmp_path, below, set_values(**without_uids))
    assert [series.slices for series in list_series(tmp_path).series] == [7, 4]
    volume = read_volume(tmp_path)
    assert volume.shape_ijk == (6, 5, 7)
    assert not any("another plane" in warning for warning in volume.report["warnings"])


def test_3000_planes_are_found_again_in_linear_time_and_only_near_ones_joined():
    random = np.random.default_rng(3)
    turned = np.linalg.qr(random.normal(size=(3000, 3, 3)))[0]
    planes, numbers = Planes(), []
    started = time.process_time()
    for axes in turned:
        plane = tuple(axes[:2].ravel().tolist())
        numbers.append(planes.find(plane))
        assert planes.find(tuple(np.add(plane, 1e-5).tolist())) == numbers[-1]  # rounded otherwise
    assert time.process_time() - started < tolerances.PLANES_S
    first_of = dict(reversed(list(zip(numbers, turned, strict=True))))
    assert len(first_of) > 2900  # few lie near one before them; measured 2993
    apart = max(np.linalg.norm(first_of[n] - axes, axis=1)[:2].max() for n, axes in zip(numbers, turned, strict=True))
    assert apart < SPLIT_ANGLE_RAD
