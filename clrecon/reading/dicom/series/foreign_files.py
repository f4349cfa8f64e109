"""Files that are not DICOM: what they are, so that a message can say what to do, and which may be lost slices.

A slice lost at an end of a stack leaves no hole.  Its file often remains: empty, blank, packed, or with a damaged
start, under a name without suffix as usual on CDs.  So other files beside slices are compared with them by names that
continue their numbering, size, and bytes of a DICOM header: a licence, a viewer, a list or a preview has none of these.
"""

from __future__ import annotations

import os
import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from clrecon.reading.dicom.parse.elements import META_START
from clrecon.system.light_dataclass import dataclass, field

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
EMPTY, TEXT, UNKNOWN = "empty", "text", "no DICOM"
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
