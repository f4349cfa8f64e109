"""Scan of a folder or file: the header of every DICOM file in it is read.

Names, extensions and DICOMDIR files do not decide what is read; they only make a file that is not DICOM a suspect of
being the remains of a slice.  Only regular files are opened; devices and pipes are skipped and counted.  A link into
the folder is skipped too, because its target is found at its own place.  A link out of the folder is followed only on
request: in an archive from a stranger it may lead to any file of the machine.  One that is not followed may stand for a
slice, as an unreadable file may.

The calls that can hang (listing a folder, opening a file, reading its start) run in daemon threads.  A network drive
that does not answer cannot be interrupted, not even with Ctrl-C: the caller waits in another thread, reports after
`NOTICE_S` what it waits for, and gives up after `GIVE_UP_S` with an error that names it.  And where a file takes longer
than `_SLOW_FILE_S`, the delay lies in the connection to the disk: then several threads wait at once.  On a warm cache
one thread is fastest, since the parser beside it needs the interpreter's lock.
"""

from __future__ import annotations

import os
import stat
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from time import perf_counter
from typing import Any, TypeVar

from clrecon.errors import NoDicomError, RefusedInputError
from clrecon.reading.common.selection import Rescale
from clrecon.reading.dicom.headers.header import read_headers
from clrecon.reading.dicom.headers.slice_header import OtherImage, SliceHeader
from clrecon.reading.dicom.parse.elements import (
    META_START,
    CorruptFileError,
    FileStart,
    describe_way_out,
    has_dicom_mark,
    read_start,
    restore_start,
)
from clrecon.reading.dicom.series.foreign_files import Stranger, describe_container, describe_start, find_remains
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text

T = TypeVar("T")

NOTICE_S = 10.0
GIVE_UP_S = 300.0  # long enough for a tape library or a sleeping disk
_SLOW_FILE_S = 0.0005
CHUNK = 64
MOST_THREADS = 16


class DiskReader:
    """Reads in separate threads while the caller waits and reports; `touched` is the path that was read last."""

    def __init__(self, progress: Progress | None = None):
        self._progress = progress
        self._jobs: SimpleQueue[tuple[int, Callable[[], Any]] | None] = SimpleQueue()
        self._done: SimpleQueue[tuple[int, Any, BaseException | None]] = SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._place = (0, 0)
        self.touched = ""

    def __enter__(self) -> DiskReader:
        self._start_threads(1)
        return self

    def __exit__(self, *_: object) -> None:
        for _thread in self._threads:
            self._jobs.put(None)

    def run(self, job: Callable[[], T]) -> T:
        result: T = self._run_all([job])[0]
        return result

    def read_starts(self, files: Sequence[str]) -> Iterator[FileStart | OSError]:
        """Yield the start of every file, or the error of reading it, in order; `CHUNK` files are held at a time."""
        for first in range(0, len(files), CHUNK):
            self._place = (first, len(files))
            chunk = files[first : first + CHUNK]
            count = len(self._threads)
            start = perf_counter()
            parts = self._run_all([partial(self._read_files, chunk[part::count]) for part in range(count)])
            if count == 1 and perf_counter() - start > _SLOW_FILE_S * len(chunk):
                self._start_threads(MOST_THREADS)
            for index in range(len(chunk)):
                yield parts[index % count][index // count]

    def _read_files(self, files: Sequence[str]) -> list[FileStart | OSError]:
        starts: list[FileStart | OSError] = []
        for file in files:
            self.touched = file
            try:
                starts.append(read_start(file))
            except OSError as error:
                starts.append(error)
        return starts

    def _start_threads(self, count: int) -> None:
        while len(self._threads) < count:
            thread = threading.Thread(target=self._work, name="clrecon-disk", daemon=True)
            thread.start()
            self._threads.append(thread)

    def _work(self) -> None:
        while (task := self._jobs.get()) is not None:
            number, job = task
            try:
                self._done.put((number, job(), None))
            except BaseException as error:  # raised again in the caller's thread
                self._done.put((number, None, error))

    def _run_all(self, jobs: Sequence[Callable[[], Any]]) -> list[Any]:
        for task in enumerate(jobs):
            self._jobs.put(task)
        results: list[Any] = [None] * len(jobs)
        for _ in jobs:
            number, result, error = self._wait()
            if error is not None:
                raise error
            results[number] = result
        return results

    def _wait(self) -> tuple[int, Any, BaseException | None]:
        waited, seen = 0.0, self.touched
        while True:
            try:
                return self._done.get(timeout=NOTICE_S)
            except Empty:
                pass
            if self.touched != seen:
                waited, seen = 0.0, self.touched
                continue
            waited += NOTICE_S
            name = escape_text(os.path.basename(self.touched) or self.touched)
            if waited >= GIVE_UP_S:
                raise RefusedInputError(
                    f"{name}: no answer from the disk or network drive for {waited:.0f} s; is it still connected?"
                )
            if self._progress is not None:
                self._progress(f"no answer yet from {name}", *self._place)


_DICOM_SUFFIXES = (".dcm", ".dic", ".dicom", ".ima")
PROGRESS_STEPS = 1000
_BLANK_START = bytes(128) + b"DICM"
_LINK_INSIDE, LINK_OUT, _LINK_LOST = (
    "link inside the folder",
    "link out of the folder",
    "link to a file that is not there",
)
BARE_DATA_SET = "a data set without preamble"
_APPLE_DOUBLE = b"\x00\x05\x16\x07"
"""Start of the "._NAME" files that macOS creates beside files on foreign disks."""


@dataclass(frozen=True)
class CorruptFile:
    """A file or folder that may be or contain a DICOM image but cannot be read as such."""

    file: Path
    reason: str

    def __str__(self) -> str:
        return f"{escape_text(self.file.name)}: {self.reason}"


@dataclass
class Scan:
    """The contents of a folder, or file, slices in the order of their paths.

    skipped: Maps a reason to the number of files (or folders) passed over.
    corrupt: Files that claim to be DICOM but cannot be parsed; files and folders that cannot be read at all.
    suspects: Files that are not DICOM, but look like remains of a slice; links that are not followed or lead nowhere.
    strangers: All other files that are not DICOM.
    """

    slices: list[SliceHeader] = field(default_factory=list)
    others: list[OtherImage] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)
    corrupt: list[CorruptFile] = field(default_factory=list)
    suspects: list[CorruptFile] = field(default_factory=list)
    strangers: list[Stranger] = field(default_factory=list)
    files: int = 0
    rescale: Rescale | None = None
    is_file: bool = False


def scan_path(path: Path, progress: Progress | None = None, *, force: bool = False, follow_links: bool = False) -> Scan:
    """Read headers of all DICOM files at a path; `force`: of bare data sets too; `follow_links`: out of the folder."""
    scan = Scan()
    with DiskReader(progress) as disk:
        files = disk.run(lambda: _list_files(path, scan, disk, follow_links))
        total = scan.files = len(files)
        step = max(1, total // PROGRESS_STEPS)
        for done, (file, start) in enumerate(zip(files, disk.read_starts(files), strict=True), start=1):
            _take_file(file, start, scan, force)
            if progress is not None and (done % step == 0 or done == total):
                progress("scan", done, total)
    if scan.strangers:
        slices: dict[str, int | None] = {str(header.file): header.file_bytes for header in scan.slices}
        slices |= {str(image.file): None for image in scan.others if image.kind == "broken"}
        scan.suspects += [CorruptFile(*remains) for remains in find_remains(scan.strangers, slices.items())]
    return scan


def _take_file(file: str, start: FileStart | OSError, scan: Scan, force: bool) -> None:
    marked = isinstance(start, OSError) or has_dicom_mark(start.prefix)
    if isinstance(start, FileStart) and not marked and not (force and restore_start(start.prefix)):
        scan.skipped[describe_container(start.prefix) or "not DICOM"] += 1
        reason = _suspect(file, start.prefix)
        if reason:
            scan.suspects.append(CorruptFile(Path(file), reason))
        else:
            scan.strangers.append(Stranger(str(Path(file)), start.size, describe_start(start.prefix)))
        return
    try:
        if isinstance(start, OSError):
            raise start
        headers = read_headers(Path(file), start, force=force)
    except CorruptFileError as error:
        scan.skipped["corrupt"] += 1
        scan.corrupt.append(CorruptFile(Path(file), str(error)))
    except OSError as error:
        scan.skipped["not readable"] += 1
        why = f": {error.strerror}" if error.strerror else ""
        scan.corrupt.append(CorruptFile(Path(file), f"not readable{why}"))
    else:
        if headers is None:
            scan.skipped["DICOMDIR"] += 1
        elif isinstance(headers, OtherImage):
            scan.others.append(headers)
        else:
            scan.slices.extend(headers)


def _suspect(file: str, start: bytes) -> str:
    """Say why a file without the mark of DICOM may be the remains of an image; empty without a reason."""
    name = os.path.basename(file)
    if name.startswith("._") and start.startswith(_APPLE_DOUBLE):
        return ""
    if 0 < len(start) < META_START and _BLANK_START.startswith(start):
        return "cut within the preamble"
    if restore_start(start) is not None:
        return f"{BARE_DATA_SET} ({describe_way_out()})"
    return "named like DICOM but is none" if os.path.splitext(name)[1].lower() in _DICOM_SUFFIXES else ""


def _list_files(path: Path, scan: Scan, disk: DiskReader, follow_links: bool) -> list[str]:
    """List the regular files at `path`, sorted, and count those that are passed over."""
    disk.touched = str(path)
    try:
        if path.is_file():
            scan.is_file = True
            return [str(path)]
        if not path.is_dir():
            problem = "is neither a folder nor a regular file" if os.path.lexists(path) else "does not exist"
            raise NoDicomError(f"{escape_text(str(path), 256)} {problem}")
        with os.scandir(path):
            pass
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise NoDicomError(f"{escape_text(str(path), 256)} cannot be read: {reason}") from error

    listing = _Found(os.path.realpath(path), follow_links, [str(path)])
    visited: set[str] = set()
    while listing.folders:
        disk.touched = folder = listing.folders.pop()
        real_path = os.path.realpath(folder) if follow_links else folder
        if real_path in visited:
            continue
        visited.add(real_path)
        try:
            with os.scandir(folder) as entries:
                for entry in entries:
                    if entry.is_symlink():
                        _sort_link(entry, listing, scan)
                    elif entry.is_file(follow_symlinks=False):
                        listing.files.append(entry.path)
                    elif entry.is_dir(follow_symlinks=False):
                        listing.folders.append(entry.path)
                    else:
                        scan.skipped["not a regular file"] += 1
        except OSError:
            scan.skipped["folder not readable"] += 1
            scan.corrupt.append(CorruptFile(Path(folder), "folder not readable"))
    for left in (scan.corrupt, scan.suspects):
        left.sort(key=lambda entry: entry.file)  # a folder is listed in any order
    files = sorted(listing.files)
    if follow_links:  # a file may be reached at its own place and through links
        files = sorted({os.path.realpath(file): file for file in reversed(files)}.values())
    return files


@dataclass
class _Found:
    """The regular files found so far in the folder `root`, and the folders that are still to be listed."""

    root: str
    follow_links: bool
    folders: list[str]
    files: list[str] = field(default_factory=list)


def _sort_link(entry: os.DirEntry[str], listing: _Found, scan: Scan) -> None:
    try:
        mode = entry.stat().st_mode
    except OSError:
        scan.skipped[_LINK_LOST] += 1
        scan.suspects.append(CorruptFile(Path(entry.path), _LINK_LOST))
        return
    target = os.path.realpath(entry.path)
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        scan.skipped["not a regular file"] += 1
    elif target == listing.root or target.startswith(listing.root.rstrip(os.sep) + os.sep):
        scan.skipped[_LINK_INSIDE] += 1
    elif listing.follow_links:
        (listing.files if stat.S_ISREG(mode) else listing.folders).append(entry.path)
    else:
        scan.skipped[LINK_OUT] += 1
        scan.suspects.append(CorruptFile(Path(entry.path), LINK_OUT))


def advise_on_links() -> str:
    return f"{name_parameter('follow_links', True)} follows links"
