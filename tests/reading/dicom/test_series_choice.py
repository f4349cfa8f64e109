"""What is found in a folder, how it is grouped, listed and chosen, and what is said of the rest."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time

import numpy as np
import pydicom
import pytest
from dicom_series import ROOT, Plan, make_dataset, save_dataset, set_raw, set_values, write_series
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


def hash_of(series: int) -> str:
    return hashlib.sha256(f"{ROOT}.{series}".encode()).hexdigest()[:16]


@pytest.fixture
def two_series(tmp_path):
    """Series 2 of 7 slices and series 5 of 4, in files that do not tell."""
    write_series(tmp_path, Plan(series=5, shape=(4, 5, 6), name="a{}".format))
    write_series(tmp_path, Plan(series=2, name="sub/b{}".format))
    return tmp_path


def test_listing_has_the_names_of_the_contract(two_series):
    entries = [entry.as_dict() for entry in list_series(two_series).series]
    assert [list(entry)[: len(CONTRACT)] for entry in entries] == [CONTRACT, CONTRACT]
    assert json.loads(json.dumps(entries)) == entries


def test_listing_begins_with_the_largest_series_and_chooses_it(two_series):
    listing = list_series(two_series)
    assert listing.chosen == 1
    assert [(entry.number, entry.slices) for entry in listing.series] == [(1, 7), (2, 4)]


def test_listing_describes_a_series_by_its_stack(two_series):
    entry = list_series(two_series).series[0].as_dict()
    expected = {
        "uid_hash": hash_of(2), "description": "series 2", "modality": "CT",
        "shape_ijk": [6, 5, 7], "spacing_mm": pytest.approx([0.5, 0.7, 1.25]),
        "gap_mm": pytest.approx({"min": 1.25, "max": 1.25, "median": 1.25}),
        "tilt_deg": pytest.approx(0, abs=1e-6), "uneven": False, "warnings": [], "problems": [],
    }  # fmt: skip
    assert {name: entry[name] for name in expected} == expected
    assert np.array(entry["affine_ijk_to_lps_mm"])[:3, 3] == pytest.approx([-12.5, 31.25, -400.0])  # of the plan
    assert entry["grid_residual_max_mm"] < 1e-9


def test_the_largest_series_is_taken_and_the_rest_said(two_series):
    volume = read_volume(two_series)
    assert volume.report["series"] == {"number": 1, "uid_hash": hash_of(2), "modality": "CT"}
    assert volume.report["warnings"] == [
        "1 other CT series not used: [2: CT, 4 slices]; series 1 is read, with the most slices"
    ]
    assert volume.report["files"] == {"found": 11, "used": 7, "skipped": {}}
    assert list_series(two_series).warnings == volume.report["warnings"]


@pytest.mark.parametrize("wanted", [2, "2", "series 5", "SERIES 5", "es 5", f"{ROOT}.5", hash_of(5)])
def test_a_series_is_named_in_many_ways(two_series, wanted):
    assert read_volume(two_series, wanted).report["series"]["number"] == 2


@pytest.mark.parametrize("wanted", [3, "neck", "", "9", "1.2.4"])
def test_an_unknown_name_lists_what_is_there(two_series, wanted):
    with refused(UsageError, repr(wanted), "CT", 1, 7, 2, 4):
        read_volume(two_series, wanted)


def test_a_vague_name_lists_those_that_match(two_series):
    write_series(
        two_series, Plan(series=8, shape=(3, 5, 6), name="neck{}".format), set_values(SeriesDescription="neck")
    )
    with pytest.raises(UsageError) as caught:
        read_volume(two_series, "erie")
    assert str(caught.value) == (
        "2 series match series 'erie': [1: CT, 7 slices], [2: CT, 4 slices] (\"clrecon info\" describes them)"
    )


def test_the_start_of_a_hash_or_uid_names_a_series(two_series):
    for wanted in (hash_of(5)[:4], hash_of(5)[:10].upper(), f"{ROOT}.5"[:-1] + "5"):
        assert read_volume(two_series, wanted).report["series"]["number"] == 2
    with refused(UsageError, "series", 2, 4):
        read_volume(two_series, hash_of(5)[:3])  # three characters are not enough
    with refused(UsageError, 2, "series"):
        read_volume(two_series, ROOT)  # the start of both UIDs


def test_two_series_of_equal_size_need_a_choice(tmp_path):
    write_series(tmp_path, Plan(series=1))
    write_series(tmp_path, Plan(series=2, name="x{}".format))
    with refused(RefusedInputError, "CT", 2, 7, 1):
        read_volume(tmp_path)
    listing = list_series(tmp_path)
    assert listing.chosen is None
    assert "choose one with series" in listing.warnings[0]
    assert read_volume(tmp_path, series=2).report["series"]["uid_hash"] == hash_of(2)


def test_a_faulty_largest_series_is_not_passed_over(two_series):
    file = two_series / "sub" / "b3"
    ds = pydicom.dcmread(file)
    set_raw("PixelSpacing", "0\\0")(ds, 3)
    ds.save_as(file)
    with refused(RefusedInputError, "b3", "PixelSpacing", 1):
        read_volume(two_series)
    smaller = read_volume(two_series, 2)
    assert smaller.voxels.shape == (4, 5, 6)
    assert smaller.report["warnings"] == []  # it was asked for


def test_of_two_equal_series_the_usable_one_is_taken(tmp_path):
    write_series(tmp_path, Plan(series=1), set_raw("PixelSpacing", "0\\0", only=3))
    write_series(tmp_path, Plan(series=2, name="x{}".format))
    volume = read_volume(tmp_path)
    assert volume.report["series"]["uid_hash"] == hash_of(2)
    assert volume.report["warnings"] == [
        "1 other CT series not used: [1: CT, 7 slices, cannot be used];"
        " series 2 is read, the only one of its size that can be used"
    ]
    write_series(tmp_path, Plan(series=3, name="y{}".format))
    with refused(RefusedInputError, "CT", 2, 7, 3) as caught:
        read_volume(tmp_path)
    assert "[1: " not in repr(caught.value)


def test_of_equal_series_without_a_usable_one_none_is_taken(tmp_path):
    for number in (1, 2):
        spoil = set_raw("PixelSpacing", "0\\0", only=3)
        write_series(tmp_path, Plan(series=number, name=f"{number}-{{}}".format), spoil)
    write_series(tmp_path, Plan(series=3, shape=(4, 5, 6), name="3-{}".format))
    with refused(RefusedInputError, "PixelSpacing", 7, 1, 3):
        read_volume(tmp_path)


@pytest.mark.parametrize("frames", [7, 300], ids=["as many", "more"])
def test_old_multi_frame_images_do_not_win_over_a_usable_stack(tmp_path, frames):
    """Without the places of its frames a file is one image of unknown content, whatever number of frames it claims."""
    plan = write_series(tmp_path, Plan(series=1))
    ds = make_dataset(Plan(series=2), 0)
    ds.NumberOfFrames = frames
    save_dataset(ds, tmp_path / "many")
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == [
        "1 other CT series not used: [2: CT, 1 slice]; series 1 is read, with the most slices"
    ]
    with refused(RefusedInputError, frames, "SOP"):
        read_volume(tmp_path, 2)


@pytest.mark.parametrize("by_type", [True, False], ids=["ImageType", "orientation"])
def test_a_localizer_in_the_series_is_parted(tmp_path, by_type):
    plan = write_series(tmp_path)
    scout = make_dataset(Plan(angles=(90, 0, 0) if not by_type else (0, 0, 0), shape=(1, 9, 9)), 0)
    if by_type:
        scout.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
    save_dataset(scout, tmp_path / "scout")
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.spacing[2] == pytest.approx(1.25)
    left = "1 slice of the series that is read left: in another plane, 90.0 degrees off"
    told = ["1 other CT series not used: [2: CT, 1 slice]; series 1 is read, with the most slices", left]
    alike = ["not used, though they may be harmed slices of series 1: [2: CT, 1 slice, localizer]"]
    assert volume.report["warnings"] == (alike if by_type else told)
    assert read_volume(tmp_path, f"{ROOT}.1").report["slices"] == 7
    assert len(list_series(tmp_path).series) == 2


def test_a_secondary_capture_in_the_series_is_parted(tmp_path):
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


def test_other_modalities_are_listed_and_never_chosen(tmp_path):
    change = set_values(Modality="MR", SOPClassUID=MRImageStorage)
    write_series(tmp_path, change=change)
    with refused(NoDicomError, "MR", "CT", 1):
        read_volume(tmp_path)
    listing = list_series(tmp_path)
    assert (listing.chosen, listing.series[0].modality, listing.series[0].slices) == (None, "MR", 7)
    assert listing.series[0].problems == ["modality MR is not CT"]
    write_series(tmp_path, Plan(series=2, shape=(3, 5, 6), name="ct{}".format))
    assert read_volume(tmp_path).report["series"]["modality"] == "CT"
    with refused(NoDicomError, "MR", "CT", 1):
        read_volume(tmp_path, 1)


def test_single_slices_never_win(tmp_path):
    for number in (1, 2):
        write_series(tmp_path, Plan(series=number, shape=(1, 5, 6), name=f"{number}-{{}}".format))
    with refused(RefusedInputError, 2, "surface"):
        read_volume(tmp_path)
    with refused(RefusedInputError, "surface"):
        read_volume(tmp_path / "1-0")


def test_files_without_series_uid_go_by_folder(tmp_path):
    plan = write_series(tmp_path, change=set_values(SeriesInstanceUID=None))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["series"]["uid_hash"] is None
    assert "no SeriesInstanceUID" in volume.report["warnings"][0]


def test_hostile_descriptions_come_out_in_one_printable_line(tmp_path):
    write_series(tmp_path, change=set_raw("SeriesDescription", "a\n\x1b[31m../\x00b" + "x" * 100))
    text = list_series(tmp_path).series[0].description
    assert text.isprintable() and len(text) == 64
    assert text.startswith("a\\n\\x1b[31m../\\x00bxx")


def test_descriptions_keep_their_character_set(tmp_path):
    write_series(tmp_path, change=set_values(SpecificCharacterSet="ISO_IR 192", SeriesDescription="Rücken 背骨"))
    assert list_series(tmp_path).series[0].description == "Rücken 背骨"


def test_report_holds_no_patient_data_and_no_folder(tmp_path):
    folder = tmp_path / "Doe^John"
    plan = Plan(tilt_deg=3, name="Doe{}.dcm".format)

    def spoil(ds, k):
        ds.SeriesDescription = "Doe, spine"
        if k in (2, 3, 6):
            ds.RescaleType = "US"

    write_series(folder, plan, spoil)
    write_series(folder / "Doe2", Plan(series=2, shape=(3, 5, 6), name="Doe{}.dcm".format), spoil)
    (folder / "Doe2" / "Doe9").write_bytes(bytes(128) + b"DICM" + b"\xff" * 50)
    (folder / "Doe2" / "Doe8.dcm").write_text("none")
    volume, listing = read_volume(folder), list_series(folder)
    said = json.dumps([volume.report, listing.warnings, [entry.warnings for entry in listing.series]])
    assert "SECRET" not in said and "Doe" not in said and str(tmp_path) not in said
    assert volume.report["warnings"] == [
        "gantry tilt -3.00 degrees: kept exactly, as a shear",
        "RescaleType is 'US': the values are not HU (3 of 7 slices, the first at -397.50 mm)",
        "1 corrupt file skipped",
        "1 skipped: named like DICOM but is none",
        "1 other CT series not used: [2: CT, 3 slices]; series 1 is read, with the most slices",
    ]


def test_a_refusal_names_files_and_not_the_description(tmp_path):
    write_series(tmp_path, Plan(leave_out=(2,)), set_values(SeriesDescription="Doe, spine"))
    with refused(RefusedInputError, "slice001.dcm", "slice003.dcm", 1):
        read_volume(tmp_path)


# --- what else lies in a folder ---


def test_folders_without_images_are_refused(tmp_path):
    with pytest.raises(NoDicomError, match="does not exist"):
        read_volume(tmp_path / "nowhere")
    with pytest.raises(NoDicomError, match="no DICOM images in .*: 0 files looked at"):
        read_volume(tmp_path)
    (tmp_path / "empty").touch()
    (tmp_path / "text.dcm").write_text("DICM " * 100)
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(300))
    with pytest.raises(NoDicomError, match=r"3 files looked at \(PNG image: 1, not DICOM: 2\)"):
        list_series(tmp_path)
    with pytest.raises(NoDicomError, match=r"1 file looked at \(not DICOM: 1\)"):
        read_volume(tmp_path / "text.dcm")
    with pytest.raises(UsageError, match="a path is a string or a path object, not int"):
        read_volume(7)
    for empty in ("", " "):
        for read in (read_volume, list_series):
            with pytest.raises(UsageError, match="the input path is empty"):
                read(empty)
    with pytest.raises(NoDicomError):
        read_volume("nul\0byte")


def test_corrupt_files_alone_are_refused(tmp_path):
    (tmp_path / "bad").write_bytes(bytes(128) + b"DICM" + b"\xff" * 50)
    with refused(RefusedInputError, "DICOM"):
        read_volume(tmp_path)


def test_links_and_pipes_are_passed_over(tmp_path):
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
    for follow in (False, True):
        volume = read_volume(folder, follow_links=follow)
        assert np.array_equal(volume.voxels, plan.hu())
        assert volume.report["files"]["skipped"] == {"link inside the folder": 2, "not a regular file": 3}
    with refused(NoDicomError, "regular"):
        read_volume(folder / "pipe")
    os.symlink(folder, tmp_path / "named")
    assert read_volume(tmp_path / "named").report["slices"] == 7


def test_dicomdir_tree_of_pydicom_lists_its_series(tmp_path):
    source = get_testdata_file("DICOMDIR")
    folder = tmp_path / "tree"
    shutil.copytree(
        os.path.dirname(source), folder, ignore=lambda where, names: [n for n in names if n == "DICOMDIR-nopatient"]
    )
    listing = list_series(folder)
    assert listing.skipped["DICOMDIR"] >= 1
    ct = [entry for entry in listing.series if entry.modality == "CT"]
    assert [entry.slices for entry in ct] == [4, 2, 5]  # folders CT2, CT2N and CT5N
    with refused(NoDicomError, "DICOMDIR", "lists"):
        read_volume(folder / "DICOMDIR")


def test_single_slice_of_pydicom_is_listed_and_refused():
    with refused(RefusedInputError, "surface"):
        read_volume(get_testdata_file("CT_small.dcm"))
    entry = list_series(get_testdata_file("CT_small.dcm")).series[0]
    assert entry.shape_ijk == [128, 128, 1]
    assert entry.affine_ijk_to_lps_mm is None and entry.gap_mm == {"min": None, "max": None, "median": None}


def test_progress_counts_files_and_slices(two_series):
    calls = []
    read_volume(two_series, progress=lambda *call: calls.append(call))
    assert calls == [("scan", n, 11) for n in range(1, 12)] + [("read", n, 7) for n in range(1, 8)]


def test_slices_in_another_plane_of_the_series_are_said(tmp_path):
    """One at the end of the stack leaves no hole."""
    across, along = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    write_series(tmp_path, Plan(), set_values(6, ImageOrientationPatient=[1, 0, 0, 0, across, along]))
    volume = read_volume(tmp_path)
    assert volume.shape_ijk == (6, 5, 6)
    told = "1 slice of the series that is read left: in another plane, 2.0 degrees off"
    assert told in volume.report["warnings"] and told in list_series(tmp_path).warnings


def test_series_without_uids_are_parted_by_their_numbers(tmp_path):
    together = {"SeriesInstanceUID": "", "FrameOfReferenceUID": "1.2.3"}
    write_series(tmp_path, Plan(series=1), set_values(**together))
    below = Plan(series=2, shape=(4, 5, 6), name="b{}".format, origin=(-12.5, 31.25, -400 - 4 * 1.25))
    write_series(tmp_path, below, set_values(**together))
    assert [entry.slices for entry in list_series(tmp_path).series] == [7, 4]
    volume = read_volume(tmp_path)
    assert volume.shape_ijk == (6, 5, 7)
    assert not any("another plane" in text for text in volume.report["warnings"])


def test_a_series_of_many_planes_is_parted_in_linear_time():
    generator = np.random.default_rng(3)
    turned = np.linalg.qr(generator.normal(size=(3000, 3, 3)))[0]
    planes, numbers = Planes(), []
    started = time.process_time()
    for axes in turned:
        plane = tuple(axes[:2].ravel().tolist())
        numbers.append(planes.find(plane))
        assert planes.find(tuple(np.add(plane, 1e-5).tolist())) == numbers[-1]
    assert time.process_time() - started < 10.0  # 18 s where each is held against all others
    firsts = dict(reversed(list(zip(numbers, turned, strict=True))))
    apart = max(np.linalg.norm(firsts[n] - axes, axis=1)[:2].max() for n, axes in zip(numbers, turned, strict=True))
    assert len(firsts) > 2900 and apart < SPLIT_ANGLE_RAD
