"""Where scans come from: a path, an archive, a URL, or bytes in memory; within a block each of them is a path.

What is no path goes to a private folder among the temporary files, within bounds, and is read like any other.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from clrecon.errors import UsageError
from clrecon.reading.archives import Limits, private_folder, unpacked
from clrecon.reading.urls import BUCKETS, DICOMWEB, WEB, Entry, check_url, is_url, shown_url
from clrecon.system.progress import Progress

Source = str | os.PathLike[str] | bytes | Sequence[bytes]
"""A path, a URL, or the bytes of one or several files."""


_BYTES = (bytes, bytearray, memoryview)


class Remote(Protocol):
    """What a URL names."""

    def list_entries(self) -> list[Entry]:
        """Ask for the files."""

    def fetch(self, folder: Path, progress: Progress, limits: Limits) -> None:
        """Put the files into an empty folder, all of them, or raise the error that `opened` describes."""


@contextmanager
def opened(
    source: Source,
    progress: Progress,
    limits: Limits = Limits(),  # noqa: B008 (a tuple)
) -> Iterator[str | os.PathLike[str]]:
    """Give a source as a path, of a folder or a file, until the block ends; a path is given back.

    `UnreachableError` is a server that does not answer, `UsageError` a URL that cannot be right, or one that wants
    other credentials, `NoDicomError` one at which there is nothing, and `RefusedInputError` what came damaged,
    incomplete or beyond the limits.
    """
    remote = open_remote(source) if isinstance(source, str) and is_url(source) else None
    if remote is None and not isinstance(source, (*_BYTES, list, tuple)):
        with unpacked(source, progress, limits) as inside:  # type: ignore[arg-type]
            yield inside
        return
    with private_folder(shown_url(source) if isinstance(source, str) else "the bytes") as folder:
        if remote is not None:
            remote.fetch(folder, progress, limits)
        else:
            _write_bytes([source] if isinstance(source, _BYTES) else source, folder)  # type: ignore[arg-type, list-item]
        files = list(folder.iterdir())
        with unpacked(files[0] if len(files) == 1 else folder, progress, limits) as inside:
            yield inside


def open_remote(url: str) -> Remote:
    """Return what a URL names, before anything is asked of its server."""
    parts = check_url(url)
    if parts.scheme in DICOMWEB:
        from clrecon.reading.dicomweb import Instances

        return Instances(parts)
    if parts.scheme in WEB:
        from clrecon.reading.web import WebFile

        return WebFile(parts)
    from clrecon.reading.buckets import Bucket, FileSystem

    return Bucket(parts) if parts.scheme in BUCKETS else FileSystem(url)


def _write_bytes(contents: Sequence[bytes], folder: Path) -> None:
    if not contents or not all(isinstance(content, _BYTES) for content in contents):
        raise UsageError("a scan in memory is the bytes of one file, or a list of the bytes of several")
    for number, content in enumerate(contents, start=1):
        (folder / f"{number:06d}").write_bytes(content)
