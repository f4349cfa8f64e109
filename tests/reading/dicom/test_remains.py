"""Files without suffix beside the slices: what may be left of one is a reason to refuse, what is none is not."""

from __future__ import annotations

import gzip
import random
from pathlib import Path

import numpy as np
import pytest
from dicom_series import Plan, make_dataset, save_dataset, set_values, write_series
from pydicom.data import get_testdata_file
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.series.scan import UNKNOWN, Stranger, describe_start, find_remains, scan_path

COUNT = 12
UID = "1.2.826.0.1.3680043.10.1.77.{}"
STYLES = {
    "IM0001": lambda k: f"IM{k + 1:04d}",
    "I10": lambda k: f"I{10 * (k + 1)}",
    "UID": lambda k: UID.format(1000 + 37 * k),
    "numbers": lambda k: f"{k + 1}",
    "suffix number": lambda k: f"CT.{k:03d}",
    "hexadecimal": lambda k: random.Random(k).randbytes(4).hex().upper(),
    "counted with letters": lambda k: "IM00000" + "0123456789ABCDEFGHIJ"[k + 4],
    "folders": lambda k: f"S{k:03d}/IMAGE",
}
JUNK = random.Random(5).randbytes(5000)


def damage_mark(data):
    return data[:128] + b"DIXM" + data[132:]


def swap_media_class(data):
    """Storage of CT images becomes that of a DICOMDIR."""
    old, new = b"1.2.840.10008.5.1.4.1.1.2\0", b"1.2.840.10008.1.3.10" + bytes(6)
    assert data.count(old) == 2
    return data.replace(old, new, 1)


DAMAGE = {
    "empty": (lambda data: b"", "empty"),
    "zeroed": (lambda data: bytes(len(data)), "blank, all bytes 00"),
    "erased": (lambda data: b"\xff" * len(data), "blank, all bytes FF"),
    "gzipped": (gzip.compress, "of the kind gzip file"),
    "mark": (damage_mark, "without the mark at byte 128"),
    "preamble cut": (lambda data: data[100:], "but not where it should be"),
    "mark and preamble cut": (lambda data: data[132:], "data set without preamble"),
    "shifted": (lambda data: b"\r" + data, "but not where it should be"),
    "first sector": (lambda data: bytes(512) + data[512:], "but no DICOM"),
    "junk": (lambda data: JUNK[: len(data)], "but no DICOM"),
    "pointer": (lambda data: b"version https://git-lfs.github.com/spec/v1\n", "but text"),
}


def plan_with(style):
    return Plan(shape=(COUNT, 5, 6), name=STYLES[style])


@pytest.fixture(params=STYLES)
def series_named(request, tmp_path):
    """The plan of a series whose files are named in one of the styles, and its folder."""
    return write_series(tmp_path, plan_with(request.param)), tmp_path


def damage_last(plan, folder, damage):
    """Damage the file of the last slice in one of the ways of `DAMAGE`; its path."""
    change, _ = DAMAGE[damage]
    file = folder / plan.name(COUNT - 1)
    file.write_bytes(change(file.read_bytes()))
    return file


@pytest.mark.parametrize("damage", DAMAGE)
def test_series_with_remains_of_its_last_slice_is_refused_until_they_are_removed(series_named, damage):
    plan, folder = series_named
    file = damage_last(plan, folder, damage)
    _, reason = DAMAGE[damage]
    with refused(RefusedInputError, file.name) as refusal:
        read_volume(folder)
    assert reason in str(refusal.value)
    file.unlink()
    assert read_volume(folder).voxels.shape[0] == COUNT - 1


@pytest.mark.parametrize("damage", DAMAGE)
def test_remains_of_a_slice_fail_the_gate_of_files_with_a_warning_that_does_not_name_them(series_named, damage):
    plan, folder = series_named
    file = damage_last(plan, folder, damage)
    listing = list_series(folder)
    gates = {gate["name"]: gate for gate in listing.certificate["gates"]}
    assert (gates["readable"]["ok"], gates["readable"]["measured"]) == (False, 1)
    assert any(warning.startswith("1 skipped: ") for warning in listing.warnings)
    is_a_common_word = len(file.name) < 4  # "12" may stand in any warning
    assert is_a_common_word or not any(file.name in warning for warning in listing.warnings)


@pytest.mark.parametrize("suffix", [".gz", ".bz2", ".part", ".tmp"])
def test_packed_file_refuses_the_series_where_the_slice_of_its_name_is_missing(tmp_path, suffix):
    plan = write_series(tmp_path, plan_with("IM0001"))
    last = tmp_path / plan.name(COUNT - 1)
    packed = last.with_name(last.name + suffix)
    packed.write_bytes(gzip.compress(last.read_bytes()))
    assert np.array_equal(read_volume(tmp_path).voxels, plan.hu())  # a copy of a slice that is there
    last.unlink()
    with refused(RefusedInputError, packed.name):
        read_volume(tmp_path)


def damage_last_under_another_name(folder, more_bytes):
    """The last slice becomes random bytes, of its size and some more, under a name that no slice has."""
    plan = write_series(folder, plan_with("IM0001"))
    last = folder / plan.name(COUNT - 1)
    content = random.Random(1).randbytes(last.stat().st_size)
    last.unlink()
    (folder / "FOUND.CHK").write_bytes(content + bytes(more_bytes))


@pytest.mark.parametrize("more_bytes", [0, 256])
def test_damaged_file_up_to_256_bytes_larger_than_a_slice_refuses_the_series_under_another_name(tmp_path, more_bytes):
    """Headers of slices differ by a few digits."""
    damage_last_under_another_name(tmp_path, more_bytes)
    with refused(RefusedInputError, "FOUND.CHK", "DICOM"):
        read_volume(tmp_path)


def test_damaged_file_more_than_256_bytes_larger_than_a_slice_is_nobodys_slice_under_another_name(tmp_path):
    damage_last_under_another_name(tmp_path, more_bytes=256 + 1)
    assert read_volume(tmp_path).report["warnings"] == []


def test_usual_files_beside_slices_are_skipped_without_a_warning(tmp_path):
    plan = write_series(tmp_path, plan_with("IM0001"))
    size = (tmp_path / plan.name(0)).stat().st_size
    beside = {
        "LICENSE": b"Permission is hereby granted\n" * 40,
        "README": b"x" * size,
        "README.1ST": b"read me",
        "VERSION": b"",
        "LOCKFILE": b"",
        "AUTORUN.INF": b"[autorun]\r\n",
        "VIEWER.EXE": b"MZ" + JUNK,
        "viewer.so": b"\x7fELF" + JUNK,
        "JPEG.DLL": b"MZ\x90" + bytes(size - 3),
        "Thumbs.db": b"\xd0\xcf\x11\xe0" + bytes(size - 4),
        ".DS_Store": b"\0\0\0\1Bud1" + bytes(size - 8),
        "._IM0001": b"\0\5\x16\7" + bytes(size - 4),
        "index.xml": b"<?xml version='1.0'?><file>1.2.840.10008.5.1.4.1.1.2</file>",
        "IM0001.jpg": b"\xff\xd8\xff\xe0" + JUNK,
        "IM0013.jpg": b"\xff\xd8\xff\xe0" + JUNK,
        "IM0001.xml": b"<a/>",
        "database.sqlite": b"SQLite format 3\0" + JUNK + b"1.2.840.10008.1.2.1\0",
        "slices.nii.gz": gzip.compress(bytes(900)),
        "IM0001.gz": gzip.compress(b"a copy"),
        "pad.bin": bytes(200),
    }
    for name, content in beside.items():
        (tmp_path / name).write_bytes(content)
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == [] and all(gate["ok"] is not False for gate in volume.report["gates"])
    assert volume.report["files"]["found"] == COUNT + len(beside)


def test_dicomdir_beside_slices_is_skipped_without_a_warning(tmp_path):
    plan = write_series(tmp_path, plan_with("IM0001"))
    (tmp_path / "DICOMDIR").write_bytes(Path(get_testdata_file("DICOMDIR")).read_bytes())
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["files"]["skipped"] == {"DICOMDIR": 1}
    assert volume.report["warnings"] == []


def test_image_that_says_it_is_a_dicomdir_is_read_with_a_warning(tmp_path):
    plan = write_series(tmp_path, plan_with("IM0001"))
    last = tmp_path / plan.name(COUNT - 1)
    last.write_bytes(swap_media_class(last.read_bytes()))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert "the meta header says that it is a DICOMDIR: read as the image that it holds" in volume.report["warnings"][0]


def test_slice_with_a_damaged_modality_refuses_the_series(tmp_path):
    write_series(tmp_path, plan_with("IM0001"), set_values(only=COUNT - 1, Modality="C_T"))
    with refused(RefusedInputError, "IM0012", "Modality", "0008,0060"):
        read_volume(tmp_path)


@pytest.mark.parametrize("path", [".", "../ct", "ct/../../ct/"])
def test_remains_of_a_slice_are_found_however_the_folder_is_named(tmp_path, monkeypatch, path):
    plan = write_series(tmp_path / "ct", plan_with("IM0001"))
    (tmp_path / "ct" / "ct").mkdir()
    (tmp_path / "ct" / plan.name(COUNT - 1)).write_bytes(b"")
    monkeypatch.chdir(tmp_path / "ct")
    with refused(RefusedInputError, "IM0012", "slices"):
        read_volume(path)


def test_remains_at_both_ends_of_a_stack_are_both_named(tmp_path):
    plan = write_series(tmp_path, plan_with("IM0001"))
    for k in (0, COUNT - 1):
        (tmp_path / plan.name(k)).write_bytes(b"")
    with refused(RefusedInputError, "IM0001", "IM0012"):
        read_volume(tmp_path)


def test_remains_of_a_slice_in_a_folder_apart_from_all_slices_are_skipped_with_a_warning(tmp_path):
    """All slices are in one other folder: nothing there can be of their stack."""
    plan = write_series(tmp_path / "ct", plan_with("IM0001"))
    save_dataset(make_dataset(plan, 0), tmp_path / "old" / "IM0001")
    file = tmp_path / "old" / "IM0001"
    file.write_bytes(damage_mark(file.read_bytes()))
    volume = read_volume(tmp_path)
    assert np.array_equal(volume.voxels, plan.hu())
    assert volume.report["warnings"] == ["1 skipped: DICOM by its header, but without the mark at byte 128"]


@pytest.mark.parametrize(
    ("start", "what"), [(b"", "empty"), (b"\0", "blank, all bytes 00"), (b"ab", "text"), (b"a\0b", "no DICOM")]
)
def test_file_is_described_by_its_first_bytes(start, what):
    assert describe_start(start) == what


@pytest.mark.parametrize("size", [0, 1, 255, 256, 257])
def test_file_of_any_size_beside_a_broken_slice_is_a_remain_by_its_name_alone(tmp_path, size):
    """Of a broken slice no size is known."""
    strangers = [Stranger(str(tmp_path / name), size, UNKNOWN) for name in ("notes", "IM2")]
    broken_slice = (str(tmp_path / "IM1"), None)
    assert find_remains(strangers, [broken_slice]) == [(tmp_path / "IM2", "named like slices, but no DICOM")]


@pytest.mark.parametrize("size", [0, 1, 255, 256, 257])
def test_file_of_any_size_beside_slices_of_one_size_and_a_broken_one_is_a_remain(tmp_path, size):
    notes = Stranger(str(tmp_path / "notes"), size, UNKNOWN)
    known = [(str(tmp_path / "IM1"), None), (str(tmp_path / "IM3"), 256)]
    assert find_remains([notes], known) == [(tmp_path / "notes", "as large as the slices beside it, but no DICOM")]


def test_file_of_three_bytes_beside_a_broken_slice_is_no_remain(tmp_path):
    """It has neither a name like those of slices nor their size."""
    write_series(tmp_path, plan_with("IM0001"), set_values(only=COUNT - 1, Modality="C_T"))
    (tmp_path / "notes").write_bytes(b"a\0b")
    scan = scan_path(tmp_path)
    assert [image.kind for image in scan.others] == ["broken"]
    assert len(scan.strangers) == 1
    assert scan.suspects == []
