"""Remains of slices: files that are not DICOM but may be what is left of a lost slice.

A slice lost at an end of a stack leaves no hole.  Its file often remains: empty, blank, packed, or with a damaged
start, under a name without suffix as usual on CDs.  So other files beside slices are compared with them: a name that
continues their numbering, their size, bytes of a DICOM header.  A licence, a viewer, a list or a preview has none of
these.
"""

from __future__ import annotations

import os
import re
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from clrecon.dicom.parse.containers import describe_container
from clrecon.dicom.parse.elements import META_START

DAMAGED_MARK = "DICOM by its header, but without the mark at byte 128"
DAMAGED_START = "holds a DICOM header, but not where it should be"
EMPTY, TEXT, UNKNOWN = "empty", "text", "no DICOM"
SIZE_BYTES = 256
"""Largest difference in size from a slice: headers of slices differ by a few digits."""
FEWEST_RANDOM_NAMES = 3
META_WITHIN = 1024
"""A damaged file may have lost or gained bytes before its meta header; the header begins within this many bytes."""

_META_ELEMENT = re.compile(rb"\x02\0[\0-\x16]\0(UL|UI|OB|SH|AE)")
_SYNTAX_OR_CLASS = re.compile(rb"\x02\0[\x02\x03\x10]\0UI")
_DIGITS = re.compile(r"\d+")
_RANDOM = (re.compile(r"[0-9A-Z_]{6,}"), re.compile(r"[0-9a-f-]{6,}"))
"""Alphabets of names that writers choose at random or count with letters, for example IM00001B."""
_ADDED = frozenset("gz bz2 xz zst zip 7z part partial crdownload tmp bad".split())
"""Suffixes that packers and broken transfers add to a name."""
_PACKED = ("gzip file", "bzip2 file", "xz file", "zstd file", "zip archive", "7z archive")
_OF_THE_SYSTEM = frozenset(("thumbs.db", "ehthumbs.db", "desktop.ini"))


class Stranger(NamedTuple):
    """A file that is not DICOM: its path, its size in bytes, and a description of its first bytes."""

    file: str
    size: int
    what: str


@dataclass
class _Slices:
    """Names and sizes of the slices in one folder."""

    names: set[str] = field(default_factory=set)
    sizes: list[int] = field(default_factory=list)

    def finish(self) -> None:
        self.sizes.sort()
        self.patterns = {_pattern(name) for name in self.names}
        lengths = {len(name) for name in self.names}
        self.random = None
        if len(self.names) >= FEWEST_RANDOM_NAMES and len(lengths) == 1:
            self.length = lengths.pop()
            self.random = next((kind for kind in _RANDOM if all(map(kind.fullmatch, self.names))), None)

    def has_name_like(self, name: str) -> bool:
        pattern = _pattern(name)
        if "#" in pattern and pattern in self.patterns:
            return True
        drawn = self.random is not None and len(name) == self.length and self.random.fullmatch(name)
        return bool(drawn) and any(map(str.isdigit, name))

    def has_size_like(self, size: int) -> bool:
        place = bisect_left(self.sizes, size - SIZE_BYTES)
        return place < len(self.sizes) and self.sizes[place] <= size + SIZE_BYTES


def _pattern(name: str) -> str:
    """Return a name with a mark in place of every number."""
    return _DIGITS.sub("#", name)


def describe_start(start: bytes) -> str:
    """Describe a file by its first bytes, which lack the mark of DICOM.

    start: Some kB, or the whole file.
    """
    if not start:
        return EMPTY
    if _META_ELEMENT.match(start, META_START):
        return DAMAGED_MARK
    kind = describe_container(start)
    if kind:
        return kind
    if not 0x20 <= start[0] < 0x7F and not start.strip(start[:1]):
        return f"blank, all bytes {start[0]:02X}"
    if _SYNTAX_OR_CLASS.search(start, 0, META_WITHIN):
        return DAMAGED_START
    return UNKNOWN if b"\0" in start else TEXT


def find_remains(strangers: Sequence[Stranger], slices: Iterable[tuple[str, int | None]]) -> list[tuple[Path, str]]:
    """Find the files that may be remains of a slice.

    slices: iterable of (str, int or None). Path and bytes of the files that hold CT slices; None where they are no
        measure for others.

    Returns: list of (Path, str). Each file with the reason; the reasons contain no names.
    """
    if not strangers:
        return []
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
    found = []
    for stranger in strangers:
        reason = _judge(stranger, folders, paths)
        if reason:
            found.append((Path(stranger.file), reason))
    return found


def _judge(stranger: Stranger, folders: dict[str, _Slices], paths: set[str]) -> str:
    folder, _, name = stranger.file.rpartition(os.sep)
    if stranger.what in (DAMAGED_MARK, DAMAGED_START):
        return stranger.what
    known = folders.get(folder)
    whole, added = _strip_added(name)
    if known is None:
        path = f"{_pattern(os.path.basename(folder))}/{_pattern(whole)}"
        alike = "#" in path and path in paths
    elif added and whole in known.names:
        return ""  # a copy of a slice that exists
    else:
        alike = known.has_name_like(whole)
    if alike and (not added or stranger.what in (EMPTY, UNKNOWN, *_PACKED) or stranger.what.startswith("blank")):
        return f"named like slices, but {_say(stranger.what)}"
    if known is None or name.startswith(".") or name.lower() in _OF_THE_SYSTEM:
        return ""
    if (stranger.what == UNKNOWN or stranger.what.startswith("blank")) and known.has_size_like(stranger.size):
        return f"as large as the slices beside it, but {_say(stranger.what)}"
    return ""


def _strip_added(name: str) -> tuple[str, str]:
    stem, point, suffix = name.rpartition(".")
    return (stem, suffix) if point and suffix.lower() in _ADDED else (name, "")


def _say(what: str) -> str:
    return what if what in (EMPTY, UNKNOWN, TEXT) or what.startswith("blank") else f"of the kind {what}"
