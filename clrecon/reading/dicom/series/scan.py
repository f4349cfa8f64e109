"""Scan of a folder or file: the header of every DICOM file in it is read.

Names, extensions and DICOMDIR files do not decide what is read; they only make a file that is not DICOM a suspect of
being the remains of a slice.  Only regular files are opened; devices and pipes are skipped and counted.  A link into
the folder is skipped too, because its target is found at its own place.  A link out of the folder is followed only on
request: in an archive from a stranger it may lead to any file of the machine.  One that is not followed may stand for a
slice, as an unreadable file may.

The calls that can hang (listing a folder, opening a file, reading its start) run in daemon threads.  A network drive
that does not answer cannot be interrupted, not even with Ctrl-C: the caller waits in another thread, reports after
`_NOTICE_S` what it waits for, and gives up after `_GIVE_UP_S` with an error that names it.  And where a file takes
longer than `_SLOW_FILE_S`, the delay lies in the connection to the disk: then several threads wait at once.  On a warm
cache one thread is fastest, since the parser beside it needs the interpreter's lock.

A slice lost at an end of a stack leaves no hole.  Its file often remains: empty, blank, packed, or with a damaged
start, under a name without suffix as usual on CDs.  So other files beside slices are compared with them by names that
continue their numbering, size, and bytes of a DICOM header: a licence, a viewer, a list or a preview has none of these.
"""

from __future__ import annotations

import os
import re
import stat
import threading
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from time import perf_counter
from typing import Any, NamedTuple, TypeVar

from clrecon.errors import NoDicomError, RefusedInputError
from clrecon.reading.common.selection import Rescale
from clrecon.reading.dicom.headers.header import read_headers
from clrecon.reading.dicom.headers.slice_header import OtherImage, SliceHeader
from clrecon.reading.dicom.parse.elements import FileStart, describe_way_out, has_dicom_mark, read_start, restore_start
from clrecon.reading.dicom.parse.plain import META_START, CorruptFileError
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text

# First bytes of each type, the longest and surest first.
_STARTS = (
    (b"PK\x03\x04", "zip archive"),
    (b"PK\x05\x06", "zip archive"),
    (b"\x1f\x8b", "gzip file"),
    (b"BZh", "bzip2 file"),
    (b"\xfd7zXZ\0", "xz file"),
    (b"\x28\xb5\x2f\xfd", "zstd file"),
    (b"7z\xbc\xaf\x27\x1c", "7z archive"),
    (b"Rar!\x1a\x07", "rar archive"),
    (b"\x89PNG\r\n\x1a\n", "PNG image"),
    (b"\xff\xd8\xff", "JPEG image"),
    (b"\0\0\0\x0cjP  ", "JPEG 2000 image"),
    (b"\xff\x4f\xff\x51", "JPEG 2000 image"),
    (b"II*\0", "TIFF image"),
    (b"MM\0*", "TIFF image"),
    (b"%PDF-", "PDF document"),
    (b"NRRD0", "NRRD volume"),
    (b"ObjectType = Image", "MetaImage volume"),
    (b"\x5c\x01\0\0", "NIfTI volume"),
    (b"\0\0\x01\x5c", "NIfTI volume"),
    (b"\x1c\x02\0\0n+2", "NIfTI volume"),
    (b"glTF", "GLB mesh"),
    (b"ply\n", "PLY mesh or cloud"),
    (b"ply\r", "PLY mesh or cloud"),
    (b'<?xml version="1.0"?>\n<VTKFile', "VTK file"),
    (b"<VTKFile", "VTK file"),
    (b"\x93NUMPY", "NumPy array"),
    (b"\x7fELF", "program"),
    (b"MZ", "program"),
)
_THREEMF_ENTRIES = (b"3D/3dmodel.model", b"[Content_Types].xml")
"""Names of the first entry of a zip archive that is a 3MF file."""
_TAR_MARK = slice(257, 262), b"ustar"

_ARCHIVES = frozenset(
    ("zip archive", "gzip file", "bzip2 file", "xz file", "zstd file", "7z archive", "rar archive", "tar archive")
)
_GRIDS = frozenset(("NRRD volume", "MetaImage volume", "NIfTI volume"))


def describe_container(start: bytes) -> str:
    """Name the type of a file by its first bytes (262 bytes suffice for all); empty if they are unknown."""
    if start.startswith(b"PK\x03\x04") and start[30:].startswith(_THREEMF_ENTRIES):
        return "3MF mesh"
    for mark, kind in _STARTS:
        if start.startswith(mark):
            return kind
    offset, mark = _TAR_MARK
    return "tar archive" if start[offset] == mark else ""


def is_text(start: bytes) -> bool:
    """True where the first bytes of a file are printable ASCII, or a mark of the order of bytes and such."""
    start = start.removeprefix(b"\xef\xbb\xbf")
    return bool(start) and all(32 <= byte < 127 or byte in b"\t\r\n" for byte in start)


def advise_on(kinds: Iterable[str]) -> str:
    """Return advice about files of these types; empty if there is none."""
    kinds = set(kinds)
    packed, grids = sorted(_ARCHIVES & kinds), sorted(_GRIDS & kinds)
    advice = [f"unpack each {' and '.join(packed)} and name the folder"] if packed else []
    if grids or "gzip file" in kinds:
        formats = " or ".join(grids) or "NIfTI volume (.nii.gz)"
        advice.append(f"a {formats} is read when the file itself is named")
    if any("mesh" in kind for kind in kinds):
        advice.append("a mesh is shown with clrecon render and measured with clrecon distance")
    if "NumPy array" in kinds:
        advice.append("a NumPy array says no place in space: from Python make a volume of it, Volume(array, affine)")
    return "; ".join(advice)


_DAMAGED_MARK = "DICOM by its header, but without the mark at byte 128"
DAMAGED_START = "holds a DICOM header, but not where it should be"
EMPTY = "empty"
TEXT = "text"
UNKNOWN = "no DICOM"
_SIZE_BYTES = 256
"""Largest difference in size from a slice: headers of slices differ by a few digits."""
_FEWEST_RANDOM_NAMES = 3
_META_WITHIN = 1024
"""A damaged file may have lost or gained bytes before its meta header; the header begins within this many bytes."""

_META_ELEMENT = re.compile(rb"\x02\0[\0-\x16]\0(UL|UI|OB|SH|AE)")
_SYNTAX_OR_CLASS = re.compile(rb"\x02\0[\x02\x03\x10]\0UI")
_DIGITS = re.compile(r"\d+")
_RANDOM = (re.compile(r"[0-9A-Z_]{6,}"), re.compile(r"[0-9a-f-]{6,}"))
"""Alphabets of names that writers choose at random or count with letters, for example IM00001B."""
_ADDED = frozenset("gz bz2 xz zst zip 7z part partial crdownload tmp bad".split())
"""Suffixes that packers and broken transfers add to a name."""
_PACKED_SLICES = ("gzip file", "bzip2 file", "xz file", "zstd file", "zip archive", "7z archive")
_OF_THE_SYSTEM = frozenset(("thumbs.db", "ehthumbs.db", "desktop.ini"))


class Stranger(NamedTuple):
    """A file that is not DICOM: its path, its size in bytes, and a description of its first bytes."""

    file: str
    size: int
    what: str


@dataclass
class _Slices:
    names: set[str] = field(default_factory=set)
    sizes: list[int] = field(default_factory=list)

    def finish(self) -> None:
        self.sizes.sort()
        self.patterns = {_pattern(name) for name in self.names}
        lengths = {len(name) for name in self.names}
        self.random = None
        if len(self.names) >= _FEWEST_RANDOM_NAMES and len(lengths) == 1:
            self.length = lengths.pop()
            self.random = next((kind for kind in _RANDOM if all(map(kind.fullmatch, self.names))), None)

    def has_name_like(self, name: str) -> bool:
        pattern = _pattern(name)
        if "#" in pattern and pattern in self.patterns:
            return True
        drawn = self.random is not None and len(name) == self.length and self.random.fullmatch(name)
        return bool(drawn) and any(map(str.isdigit, name))

    def has_size_like(self, size: int) -> bool:
        index = bisect_left(self.sizes, size - _SIZE_BYTES)
        return index < len(self.sizes) and self.sizes[index] <= size + _SIZE_BYTES


def _pattern(name: str) -> str:
    """Return a name with a mark in place of every number."""
    return _DIGITS.sub("#", name)


def describe_start(start: bytes) -> str:
    """Describe a file by its first bytes (some kB, or the whole file), which lack the mark of DICOM."""
    if not start:
        return EMPTY
    if _META_ELEMENT.match(start, META_START):
        return _DAMAGED_MARK
    kind = describe_container(start)
    if kind:
        return kind
    if not 0x20 <= start[0] < 0x7F and not start.strip(start[:1]):
        return f"blank, all bytes {start[0]:02X}"
    if _SYNTAX_OR_CLASS.search(start, 0, _META_WITHIN):
        return DAMAGED_START
    return UNKNOWN if b"\0" in start else TEXT


def find_remains(strangers: Sequence[Stranger], slices: Iterable[tuple[str, int | None]]) -> list[tuple[Path, str]]:
    """Find files, by reason, that may be remains of `slices`, {path: bytes}; None: sizes are no measure."""
    folders: dict[str, _Slices] = defaultdict(_Slices)
    paths: set[str] = set()  # of the slices: patterns of names and folders
    for file, size in slices:
        folder, _, name = file.rpartition(os.sep)
        known = folders[folder]
        known.names.add(name)
        if size is not None:
            known.sizes.append(size)
    for folder, known in folders.items():
        known.finish()
        paths.update(f"{_pattern(os.path.basename(folder))}/{pattern}" for pattern in known.patterns)
    judged = ((Path(stranger.file), _judge_stranger(stranger, folders, paths)) for stranger in strangers)
    return [(path, reason) for path, reason in judged if reason]


def _judge_stranger(stranger: Stranger, folders: dict[str, _Slices], paths: set[str]) -> str:
    folder, _, name = stranger.file.rpartition(os.sep)
    if stranger.what in (_DAMAGED_MARK, DAMAGED_START):
        return stranger.what
    known = folders.get(folder)
    stem, point, suffix = name.rpartition(".")
    whole, added = (stem, suffix) if point and suffix.lower() in _ADDED else (name, "")
    if known is None:
        path = f"{_pattern(os.path.basename(folder))}/{_pattern(whole)}"
        alike = "#" in path and path in paths
    elif added and whole in known.names:
        return ""  # a copy of a slice that exists
    else:
        alike = known.has_name_like(whole)
    if alike and (not added or stranger.what in (EMPTY, UNKNOWN, *_PACKED_SLICES) or stranger.what.startswith("blank")):
        return f"named like slices, but {_say_kind(stranger.what)}"
    if known is None or name.startswith(".") or name.lower() in _OF_THE_SYSTEM:
        return ""
    if (stranger.what == UNKNOWN or stranger.what.startswith("blank")) and known.has_size_like(stranger.size):
        return f"as large as the slices beside it, but {_say_kind(stranger.what)}"
    return ""


def _say_kind(kind: str) -> str:
    return kind if kind in (EMPTY, UNKNOWN, TEXT) or kind.startswith("blank") else f"of the kind {kind}"


T = TypeVar("T")

_NOTICE_S = 10.0
_GIVE_UP_S = 300.0  # long enough for a tape library or a sleeping disk
_SLOW_FILE_S = 0.0005
CHUNK = 64
MOST_THREADS = 16


class DiskReader:
    """Reads in separate threads while the caller waits and reports; `touched` is the path that was read last."""

    def __init__(self, progress: Progress | None = None, notice_s: float = _NOTICE_S, give_up_s: float = _GIVE_UP_S):
        self._progress = progress
        self._notice_s, self._give_up_s = notice_s, give_up_s
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
                return self._done.get(timeout=self._notice_s)
            except Empty:
                pass
            if self.touched != seen:
                waited, seen = 0.0, self.touched
                continue
            waited += self._notice_s
            name = escape_text(os.path.basename(self.touched) or self.touched)
            if waited >= self._give_up_s:
                raise RefusedInputError(
                    f"{name}: no answer from the disk or network drive for {waited:.0f} s; is it still connected?"
                )
            if self._progress is not None:
                self._progress(f"no answer yet from {name}", *self._place)


_DICOM_SUFFIXES = (".dcm", ".dic", ".dicom", ".ima")
PROGRESS_STEPS = 1000
_BLANK_START = bytes(128) + b"DICM"
_LINK_INSIDE = "link inside the folder"
LINK_OUT = "link out of the folder"
_LINK_LOST = "link to a file that is not there"
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
