"""Rows 46 and 47 of the fault list: trees of many files and series, disks that hang, files that cannot be had."""

from __future__ import annotations

import gc
import os
import stat
import threading
import time
import tracemalloc
from functools import partial
from pathlib import Path

import pytest
from dicom_series import element_bytes, insert_after, set_values, write_series
from refusals import refused
from tolerances import HEADER_BYTES, SCAN_PEAK_BYTES_A_FILE
from variants import FOR_RELEASE

from clrecon.errors import RefusedInputError
from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.headers import header
from clrecon.reading.dicom.parse import elements, plain
from clrecon.reading.dicom.parse.elements import PREFIX_BYTES, read_start
from clrecon.reading.dicom.series import scan
from clrecon.reading.dicom.series import scan as disk
from clrecon.reading.dicom.series.scan import CorruptFile, scan_path
from clrecon.reading.dicom.series.series import group_series


def copy_series(folder: Path, series: int, slices: int) -> int:
    """A tree of `series` folders, made from one file by replacing what tells slices and series apart."""
    write_series(folder / "one")
    template = (folder / "one" / "slice000.dcm").read_bytes()
    (folder / "one").rename(folder.parent / "one")
    uid, place = b"\x20\0\x0e\0UI\x1a\0" + b"1.2.826.0.1.3680043.10.1.1", b"-12.5\\31.25\\-400.0"
    assert template.count(uid) == 1 and template.count(place) == 1
    for number in range(series):
        own = template.replace(uid, uid[:8] + b"1.2.826.0.1.3680043.10.%03d" % number)
        (folder / f"{number:05d}").mkdir()
        for k in range(slices):
            data = own.replace(place, b"-12.5\\31.25\\%06.1f" % (1.5 * k))
            assert len(data) == len(template)
            (folder / f"{number:05d}" / f"{k:05d}").write_bytes(data)
    return series * slices


@pytest.mark.fault_row(47)
@pytest.mark.release
@pytest.mark.slow
@pytest.mark.parametrize(("series", "slices"), [(300, 10), pytest.param(3, 1000, marks=FOR_RELEASE)])
def test_each_header_of_a_large_tree_is_read_once_from_its_start_in_little_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, series: int, slices: int
) -> None:
    """No pixels are read; what is kept of a header is bounded."""
    (tmp_path / "tree").mkdir()
    count = copy_series(tmp_path / "tree", series, slices)
    start_lengths: list[int] = []
    parses: list[int] = []
    heads = header.read_headers

    def count_start(file: str, limit: int = PREFIX_BYTES) -> disk.FileStart:
        start_lengths.append(limit)
        return read_start(file, limit)

    monkeypatch.setattr(disk, "read_start", count_start)
    monkeypatch.setattr(scan, "read_headers", lambda *given, **how: parses.append(1) or heads(*given, **how))  # type: ignore[func-returns-value]
    monkeypatch.setattr(elements, "parse_carefully", None)  # plain headers: a call of it fails
    calls: list[tuple[str, int, int]] = []

    gc.collect()
    tracemalloc.start()
    tree = scan_path(tmp_path / "tree", lambda *call: calls.append(call))
    peak = tracemalloc.get_traced_memory()[1]
    gc.collect()  # in a large process Python itself comes late to what is left in circles
    kept = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()

    assert len(tree.slices) == len(parses) == count
    assert start_lengths == [PREFIX_BYTES] * count
    assert kept / count < HEADER_BYTES
    assert peak / count < SCAN_PEAK_BYTES_A_FILE
    assert len(calls) <= scan.PROGRESS_STEPS + 1
    assert calls[-1] == ("scan", count, count)
    assert [len(part.headers) for part in group_series(tree)] == [slices] * series


def test_headers_of_one_series_share_the_objects_of_what_they_have_in_common(tmp_path: Path) -> None:
    write_series(tmp_path, change=set_values(AcquisitionNumber=1))
    for file in tmp_path.iterdir():
        insert_after(file, "Modality", element_bytes("Modality", b"CT"))  # twice, which is warned of
    first, second, *_ = scan_path(tmp_path).slices
    for name in ("series", "phase", "row_cosines", "patient_hash", "frame_of_reference", "transfer_syntax", "warnings"):
        assert getattr(first, name), name  # not an empty one, which all have in common
        assert getattr(first, name) is getattr(second, name), name
    assert not hasattr(first, "__dict__")  # slots


def test_corrupt_files_beside_many_series_are_described_by_the_first_five_in_each(tmp_path: Path) -> None:
    """Work grows with files and series, not with their product."""
    (tmp_path / "tree").mkdir()
    copy_series(tmp_path / "tree", series=50, slices=1)
    tree = scan_path(tmp_path / "tree")
    texts_made: list[CorruptFile] = []

    class Watched(CorruptFile):
        def __str__(self) -> str:
            texts_made.append(self)
            return super().__str__()

    tree.corrupt = [Watched(tmp_path / "bad" / f"{k}", "cut") for k in range(100)]
    series = group_series(tree)
    assert series[0].corrupt == tree.corrupt
    assert all(part.corrupt is series[0].corrupt for part in series)
    assert all("and 95 more" in part.problems[0] for part in series)
    assert len(texts_made) == 5 * len(series)


def test_of_files_that_are_no_dicom_only_the_start_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = write_series(tmp_path)
    for k in range(100):
        (tmp_path / f"{k}.png").write_bytes(b"\x89PNG" + bytes(100_000))
    lengths_read: list[int] = []
    system_read = os.read

    def count_bytes(descriptor: int, limit: int) -> bytes:
        data = system_read(descriptor, limit)
        lengths_read.append(len(data))
        return data

    monkeypatch.setattr(os, "read", count_bytes)
    assert scan_path(tmp_path).skipped == {"not DICOM": 100}
    assert len(lengths_read) == plan.shape[0] + 100
    assert max(lengths_read) <= PREFIX_BYTES


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk is given up after 0.1 s without an answer, not after minutes."""
    monkeypatch.setattr(disk, "DiskReader", partial(disk.DiskReader, notice_s=0.02, give_up_s=0.1))


@pytest.mark.fault_row(46)
def test_series_with_a_file_whose_disk_does_not_answer_is_refused_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hurried: None
) -> None:
    plan = write_series(tmp_path)
    answer = threading.Event()

    def hang(file: str, limit: int = PREFIX_BYTES) -> disk.FileStart:
        if file.endswith("slice003.dcm"):
            answer.wait(20)
        return read_start(file, limit)

    monkeypatch.setattr(disk, "read_start", hang)
    calls: list[tuple[str, int, int]] = []
    try:
        with refused(RefusedInputError, "slice003.dcm", "disk"):
            read_volume(tmp_path, progress=lambda *call: calls.append(call))
    finally:
        answer.set()
    files_read, files = 0, plan.shape[0]
    assert ("no answer yet from slice003.dcm", files_read, files) in calls


@pytest.mark.fault_row(46)
def test_tree_with_a_folder_whose_disk_does_not_answer_is_refused_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hurried: None
) -> None:
    write_series(tmp_path / "there")
    (tmp_path / "gone").mkdir()
    answer = threading.Event()
    scandir = os.scandir

    def hang(folder: str) -> object:
        if str(folder).endswith("gone"):
            answer.wait(20)
        return scandir(folder)

    monkeypatch.setattr(os, "scandir", hang)
    try:
        with refused(RefusedInputError, "gone", "disk"):
            list_series(tmp_path)
    finally:
        answer.set()


def test_files_of_a_slow_disk_are_read_in_order_by_several_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = []
    for k in range(3 * disk.CHUNK + 5):
        (tmp_path / f"{k}").write_bytes(b"%d" % k)
        files.append(str(tmp_path / f"{k}"))
    (tmp_path / "7").unlink()
    reading: list[int] = []
    at_once: list[int] = []

    def slow(file: str, limit: int = PREFIX_BYTES) -> disk.FileStart:
        reading.append(1)
        at_once.append(len(reading))
        time.sleep(0.002)
        reading.pop()
        return read_start(file, limit)

    monkeypatch.setattr(disk, "read_start", slow)
    with disk.DiskReader() as reader:
        starts = list(reader.read_starts(files))

    assert isinstance(starts.pop(7), FileNotFoundError)
    del files[7]
    prefixes = [start.prefix for start in starts if isinstance(start, disk.FileStart)]
    assert prefixes == [Path(file).name.encode() for file in files]
    assert max(at_once[: disk.CHUNK]) == 1  # the first files tell that the disk is slow
    assert 2 < max(at_once) <= disk.MOST_THREADS


@pytest.mark.fault_row(46)
def test_series_with_a_file_that_vanishes_is_refused_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_series(tmp_path)

    def vanish(file: str, limit: int = PREFIX_BYTES) -> disk.FileStart:
        if file.endswith("slice006.dcm"):
            os.unlink(file)
        return read_start(file, limit)

    monkeypatch.setattr(disk, "read_start", vanish)
    with refused(RefusedInputError, "slice006.dcm", "readable"):
        read_volume(tmp_path)


@pytest.mark.fault_row(46)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")
def test_pipe_in_the_place_of_a_file_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    assert stat.S_ISFIFO(os.stat(tmp_path / "pipe").st_mode)
    with refused(OSError, "regular", "file"):
        read_start(tmp_path / "pipe")


def test_error_in_the_thread_of_a_disk_reader_reaches_its_caller() -> None:
    def fail() -> None:
        raise KeyError("inside")

    with disk.DiskReader() as reader, refused(KeyError, "inside"):
        reader.run(fail)


def test_headers_of_a_plain_series_are_parsed_by_the_plain_parser_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = write_series(tmp_path)
    answers = []
    parse = plain.parse_plainly

    def watch(*given: object) -> object:
        answers.append(parse(*given))  # type: ignore[arg-type]
        return answers[-1]

    monkeypatch.setattr("clrecon.reading.dicom.parse.plain.parse_plainly", watch)
    assert len(scan_path(tmp_path).slices) == plan.shape[0]
    assert len(answers) == plan.shape[0]
    assert None not in answers  # None leaves a header to the careful parser
