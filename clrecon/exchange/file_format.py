"""A file format as its writer, its check and its limits, and how a file of it comes to its place."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

from clrecon.errors import OutputError, UsageError
from clrecon.exchange.content import Assembly, PointContent
from clrecon.system.files import StagedFile, stage_file
from clrecon.system.text import guess_word

FOUR_GIB = 2**32 - 1
NO_LIMIT = 2**62

Contents = TypeVar("Contents", bound=PointContent | Assembly)


@dataclass(frozen=True)
class FileFormat(Generic[Contents]):
    """A file format of meshes or clouds.

    estimate: Estimates the size of the file in bytes; exact or rather too small.
    write: Writes the contents to a stream.
    verify: Reads the file back and raises `OutputError` unless sizes and counts are those of the contents.
    most_bytes: Largest file that the format, or common readers of it, can handle.
    """

    estimate: Callable[[Contents], int]
    write: Callable[[BinaryIO, Contents], None]
    verify: Callable[[Path, Contents], None]
    most_bytes: int


def find_extension(path: str | os.PathLike[str], formats: Mapping[str, Any], noun: str) -> str:
    """Return the extension of a file in lower case, such as ``.ply``.

    formats: Its keys are the extensions that are written.
    noun: What the file holds, "mesh" or "cloud".
    """
    try:
        extension = os.path.splitext(os.fspath(path))[1].lower()
    except TypeError as error:
        raise UsageError(f"a {noun} file is named by a string or a path, not {type(path).__name__}") from error
    if extension not in formats:
        found = f"the extension {extension!r}{guess_word(extension, formats)}" if extension else "no extension"
        raise UsageError(f"the name of the {noun} file has {found}: use one of {', '.join(formats)}")
    return extension


def stage_content(
    content: Contents, path: str | os.PathLike[str], chosen: FileFormat[Contents], counted: str, others: str
) -> AbstractContextManager[StagedFile]:
    """Write contents under a temporary name; see `clrecon.system.files.stage_file`.

    counted: What it holds, for example "12 triangles", for a message.
    others: Formats without a limit, for a message.
    """
    expected_bytes = chosen.estimate(content)
    if expected_bytes > chosen.most_bytes:
        kind = os.path.splitext(os.fspath(path))[1][1:].upper()
        raise OutputError(
            f"{counted} make a {kind} file of about {expected_bytes / 2**30:.1f} GiB, at most 4 GiB can be"
            f" read: write {others}"
        )
    return stage_file(
        path,
        lambda stream: chosen.write(stream, content),
        lambda temporary: chosen.verify(temporary, content),
        expected_bytes=expected_bytes,
    )
