"""Archives as inputs: zip and tar files are unpacked into a private temporary folder, within bounds."""

from __future__ import annotations

import bz2
import lzma
import os
import stat
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath
from shutil import copyfileobj, disk_usage
from typing import IO, Any, NamedTuple

from clrecon.errors import ClreconError, RefusedInputError, UsageError
from clrecon.system.paths import open_regular
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text, format_bytes

PASSWORD_VARIABLE = "CLRECON_ARCHIVE_PASSWORD"
"""Of the environment: the password of encrypted archives; the command line is seen by others."""

_DEEPEST = 2
"""Archives in archives."""

_TARS = (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tbz2", ".tar.xz", ".txz")
_OTHER_ZIPS = (".3mf", ".npz")
"""Files of meshes and clouds that are zip files too."""

_ZIP_STARTS = (b"PK\x03\x04", b"PK\x05\x06")
_PIECE = 1 << 20

_LARGEST_HEADER = 1 << 24
"""Bytes; the headers of a tar file are read as a whole, and files in pieces."""


class Limits(NamedTuple):
    """What an archive may become.

    entries: Files, with those of archives in it.
    ratio: How many times its size; voxels of air around bodies pack 20 times.
    free_bytes: Size up to which the ratio does not matter.
    fetched_bytes: Size of what is fetched from a URL; the largest public series have 9 GB.
    """

    entries: int = 1_000_000
    ratio: float = 100.0
    free_bytes: int = 1 << 30
    fetched_bytes: int = 1 << 36


class _Entry(NamedTuple):
    """A file of an archive: its name there, its size, and whether it is a link, a device or a pipe."""

    name: str
    size: int
    is_special: bool


@contextmanager
def unpacked(
    path: str | os.PathLike[str],
    progress: Progress,
    limits: Limits = Limits(),  # noqa: B008 (a tuple)
) -> Iterator[str | os.PathLike[str]]:
    """Give what an archive holds, a folder or its only file, until the block ends; other paths are given back.

    An archive that is damaged, encrypted without a password, too large, or whose entries lead out of it is a
    `RefusedInputError` or `UsageError`.
    """
    if not is_archive(path):
        yield path
        return
    import tarfile  # these modules are loaded where there is an archive
    import zipfile

    file = Path(path)
    with private_folder(escape_text(file.name)) as folder:
        try:
            _Unpacking(file, folder, progress, limits).unpack(file, folder)
        except (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, OSError) as error:
            reason = escape_text(getattr(error, "strerror", None) or str(error), 120)
            advice = "" if isinstance(error, OSError) and error.errno else ": it is cut or damaged, get it again"
            raise RefusedInputError(f"{escape_text(file.name)} cannot be unpacked ({reason}){advice}") from None
        inside = list(folder.iterdir())
        yield inside[0] if len(inside) == 1 else folder


@contextmanager
def private_folder(name: str) -> Iterator[Path]:
    """Give an empty temporary folder until the block ends; errors of clrecon call it by the `name` of its source."""
    import tempfile

    with tempfile.TemporaryDirectory(prefix="clrecon-") as folder:
        try:
            yield Path(folder)
        except ClreconError as error:  # the folder is none that the user knows
            raise type(error)(str(error).replace(folder, name)) from error


def is_archive(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path is a zip or tar file, by its first bytes, or a packed tar file, by its name."""
    try:
        file = Path(path)
        if not file.is_file() or file.name.lower().endswith(_OTHER_ZIPS):
            return False
        return file.name.lower().endswith(_TARS) or _starts_as_archive(file)
    except (TypeError, ValueError, OSError):
        return False  # reading says what is wrong


def _starts_as_archive(file: Path) -> bool:
    start = _read_start(file)
    return start.startswith(_ZIP_STARTS) or start[257:] == b"ustar"


def _read_start(file: Path) -> bytes:
    with open_regular(file) as stream:
        return stream.read(262)


class _Unpacking:
    """What is unpacked of one input, and what it may still become."""

    def __init__(self, file: Path, folder: Path, progress: Progress, limits: Limits):
        self._name = escape_text(file.name)
        self._folder, self._progress = folder, progress
        self._limits = limits
        self._allowed = max(limits.ratio * file.stat().st_size, float(limits.free_bytes))
        self._files = self._bytes = 0

    def unpack(self, file: Path, folder: Path, depth: int = 1) -> None:
        """Unpack an archive into a folder; one that holds only archives stands for what is in these."""
        with _Zip(file, self._name) if _read_start(file).startswith(_ZIP_STARTS) else _Tar(file) as archive:
            before = self._bytes
            entries = [self._count(entry) for entry in archive.find_entries()]
            self._check_room(self._bytes - before)
            for number, entry in enumerate(entries):
                self._progress("unpack", number, len(entries))
                target = folder.joinpath(*safe_parts(entry.name, self._name))
                target.parent.mkdir(parents=True, exist_ok=True)
                if target.exists():
                    raise RefusedInputError(
                        f"{self._name} holds {escape_text(entry.name, 80)} twice: unpack it yourself, and name the"
                        " folder"
                    )
                with archive.open(entry) as source, target.open("xb") as written:
                    copyfileobj(source, written, _PIECE)
        files = [path for path in folder.rglob("*") if path.is_file()]
        for inner in files if all(map(is_archive, files)) else []:
            if depth == _DEEPEST:
                raise RefusedInputError(f"{self._name} holds archives in archives in archives: unpack it first")
            packed = inner.rename(inner.with_name(f"{inner.name}{inner.suffix}"))
            inner.mkdir()
            self.unpack(packed, inner, depth + 1)
            packed.unlink()

    def _count(self, entry: _Entry) -> _Entry:
        """Refuse an entry with which the archive goes beyond its limits, before anything behind it is looked at."""
        self._files += 1
        self._bytes += entry.size
        if entry.is_special:
            raise RefusedInputError(
                f"{self._name} holds {escape_text(entry.name, 80)}, which is a link or a device: unpack it yourself"
            )
        if self._files > self._limits.entries:
            raise RefusedInputError(f"{self._name} holds more than {self._limits.entries:,} files")
        if self._bytes > self._allowed:
            raise RefusedInputError(
                f"{self._name} becomes more than {format_bytes(self._bytes)}, over {self._limits.ratio:g} times its"
                " size: no scan packs like that; unpack it yourself if you trust it"
            )
        return entry

    def _check_room(self, wanted: int) -> None:
        free = disk_usage(self._folder).free
        if wanted > free:
            raise RefusedInputError(
                f"{self._name} takes {format_bytes(wanted)} unpacked, and the folder for temporary files has"
                f" {format_bytes(free)}: name another with TMPDIR"
            )


def safe_parts(name: str, archive: str) -> tuple[str, ...]:
    """Return the folders and the name of an entry; refuse one that leads out of the archive."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or PureWindowsPath(name).drive or not path.parts or "\0" in name:
        raise RefusedInputError(f"{archive} holds a path that leads out of it: {escape_text(name, 80)}")
    return path.parts


class _Zip:
    """A zip file; no entry gives more bytes than its size says."""

    def __init__(self, file: Path, name: str):
        from zipfile import ZipFile

        self._zip, self._name = ZipFile(file), name
        self._password: bytes | None = None

    def __enter__(self) -> _Zip:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        from zipfile import BadZipFile

        self._zip.close()
        if self._password is not None and isinstance(error, zlib.error | BadZipFile | EOFError):
            # One wrong password of 256 passes the check of zip, which is a byte long.
            raise UsageError(f"the password of {self._name} in {PASSWORD_VARIABLE} is wrong, or the file is damaged")

    def find_entries(self) -> Iterator[_Entry]:
        for entry in self._zip.infolist():
            if entry.flag_bits & 1 and self._password is None:
                self._password = _ask_password(self._name)
            if not entry.is_dir():
                yield _Entry(entry.filename, entry.file_size, stat.S_ISLNK(entry.external_attr >> 16))

    def open(self, entry: _Entry) -> IO[bytes]:
        try:
            return self._zip.open(entry.name, pwd=self._password)
        except RuntimeError:
            raise UsageError(f"{self._name} is encrypted, and the password in {PASSWORD_VARIABLE} is wrong") from None
        except NotImplementedError:
            raise RefusedInputError(
                f"{self._name} is packed or encrypted in a way that Python cannot read: unpack it with another program"
            ) from None


class _Headers:
    """A stream of which a tar file is read: a header that claims more than `_LARGEST_HEADER` bytes is damaged."""

    def __init__(self, stream: IO[bytes]):
        self.stream = stream
        self.seek, self.tell = stream.seek, stream.tell
        self.close = stream.close

    def read(self, size: int = -1) -> bytes:
        if not 0 <= size <= _LARGEST_HEADER:
            raise EOFError(f"a header of {size:,} bytes")
        return self.stream.read(size)


class _Tar:
    """A tar file, whose entries are looked at one after the other: to skip one is to unpack it."""

    def __init__(self, file: Path):
        import gzip
        import tarfile

        openers: dict[bytes, Callable[[Path], Any]] = {b"\x1f\x8b": gzip.open, b"BZ": bz2.open, b"\xfd7": lzma.open}
        self._stream = openers.get(_read_start(file)[:2], open_regular)(file)
        self._tar = tarfile.open(fileobj=_Headers(self._stream), mode="r:")  # type: ignore[call-overload]  # noqa: SIM115
        self._members: dict[str, tarfile.TarInfo] = {}

    def __enter__(self) -> _Tar:
        return self

    def __exit__(self, *_: object) -> None:
        self._tar.close()
        self._stream.close()

    def find_entries(self) -> Iterator[_Entry]:
        for member in self._tar:
            if not member.isdir():
                self._members[member.name] = member
                yield _Entry(member.name, member.size, not member.isfile())
        self._stream.seek(self._tar.offset)  # of the block of zeros at the end, where one that was cut has nothing
        if not self._stream.read(1):
            raise EOFError("it ends early: files are missing")

    def open(self, entry: _Entry) -> IO[bytes]:
        stream = self._tar.extractfile(self._members[entry.name])
        assert stream is not None  # it is a file, see `find_entries`
        return stream


def _ask_password(name: str) -> bytes:
    given = os.environ.get(PASSWORD_VARIABLE)
    if given is None and sys.stdin is not None and sys.stdin.isatty():
        from getpass import getpass

        given = getpass(f"password of {name}: ")
    if not given:
        raise UsageError(f"{name} is encrypted: set its password in the environment as {PASSWORD_VARIABLE}")
    return given.encode()
