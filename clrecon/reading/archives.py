"""Archives as inputs: zip and tar files are unpacked into a private temporary folder, within bounds."""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import IO, NamedTuple

from clrecon.errors import RefusedInputError, UsageError
from clrecon.system.paths import open_regular
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text

PASSWORD_VARIABLE = "CLRECON_ARCHIVE_PASSWORD"
"""Of the environment: the password of encrypted archives; the command line is seen by others."""

_DEEPEST = 2
"""Archives in archives."""

_TARS = (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tbz2", ".tar.xz", ".txz")
_OTHER_ZIPS = (".3mf", ".npz")
"""Files of meshes and clouds that are zip files too."""

_PIECE = 1 << 20


class Limits(NamedTuple):
    """What an archive may become.

    entries: Files, with those of archives in it.
    ratio: How many times its size; voxels of air around bodies pack 20 times.
    free_bytes: Size up to which the ratio does not matter.
    """

    entries: int = 1_000_000
    ratio: float = 100.0
    free_bytes: int = 1 << 30


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
    import lzma  # these modules are loaded where there is an archive
    import tarfile
    import tempfile
    import zipfile
    import zlib

    file = Path(path)
    with tempfile.TemporaryDirectory(prefix="clrecon-") as folder:
        try:
            _Unpacking(file, Path(folder), progress, limits).unpack(file, Path(folder))
        except (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, OSError) as error:
            reason = escape_text(getattr(error, "strerror", None) or str(error), 120)
            raise RefusedInputError(f"{escape_text(file.name)} cannot be unpacked: {reason}") from None
        inside = list(Path(folder).iterdir())
        yield inside[0] if len(inside) == 1 else Path(folder)


def is_archive(path: str | os.PathLike[str]) -> bool:
    """Tell whether a path is a zip or tar file, by its first bytes, or a packed tar file, by its name."""
    try:
        file = Path(path)
        if not file.is_file():
            return False
        if file.name.lower().endswith((*_TARS, *_OTHER_ZIPS)):
            return file.name.lower().endswith(_TARS)
        return _starts_as_zip(file) or _read_start(file)[257:] == b"ustar"
    except (TypeError, ValueError, OSError):
        return False  # reading says what is wrong


def _read_start(file: Path) -> bytes:
    with open_regular(file) as stream:
        return stream.read(262)


def _starts_as_zip(file: Path) -> bool:
    return _read_start(file)[:4] in (b"PK\x03\x04", b"PK\x05\x06")


class _Unpacking:
    """What is unpacked of one input, and what it may still become."""

    def __init__(self, file: Path, folder: Path, progress: Progress, limits: Limits):
        self._name = escape_text(file.name)
        self._folder, self._progress = folder, progress
        self._entries = self._bytes = 0
        self._limits = limits
        self._allowed = max(limits.ratio * file.stat().st_size, float(limits.free_bytes))

    def unpack(self, file: Path, folder: Path, depth: int = 1) -> None:
        """Unpack an archive, and those in it, into a folder."""
        reader = _Zip(file, self._name) if _starts_as_zip(file) else _Tar(file)
        with reader as archive:
            entries = archive.find_entries(self._limits.entries)
            self._check(entries)
            for number, entry in enumerate(entries):
                self._progress("unpack", number, len(entries))
                target = folder.joinpath(*_parts(entry.name, self._name))
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as source, target.open("xb") as written:
                    self._copy(source, written)
        for inner in [path for path in folder.rglob("*") if is_archive(path)]:
            if depth == _DEEPEST:
                raise RefusedInputError(f"{self._name} holds archives in archives in archives: unpack it first")
            packed = inner.rename(inner.with_name(f"{inner.name}{inner.suffix}"))
            inner.mkdir()
            self.unpack(packed, inner, depth + 1)
            packed.unlink()

    def _check(self, entries: list[_Entry]) -> None:
        self._entries += len(entries)
        if self._entries > self._limits.entries:
            raise RefusedInputError(f"{self._name} holds more than {self._limits.entries:,} files")
        special = [entry.name for entry in entries if entry.is_special]
        if special:
            raise RefusedInputError(
                f"{self._name} holds {escape_text(special[0], 80)}, which is a link or a device: unpack it yourself"
            )
        wanted = self._bytes + sum(entry.size for entry in entries)
        self._check_size(wanted)
        from shutil import disk_usage

        free = disk_usage(self._folder).free
        if wanted - self._bytes > free:
            raise RefusedInputError(
                f"{self._name} takes {wanted / 1e9:.1f} GB unpacked, and the folder for temporary files has"
                f" {free / 1e9:.1f} GB: name another with TMPDIR"
            )

    def _check_size(self, wanted: int) -> None:
        if wanted > self._allowed:
            raise RefusedInputError(
                f"{self._name} becomes {wanted / 1e9:.1f} GB, more than {self._limits.ratio:g} times its size: no scan"
                " packs like that; unpack it yourself if you trust it"
            )

    def _copy(self, source: IO[bytes], target: IO[bytes]) -> None:
        while piece := source.read(_PIECE):
            self._bytes += len(piece)
            self._check_size(self._bytes)
            target.write(piece)


def _parts(name: str, archive: str) -> tuple[str, ...]:
    """Return the folders and the name of an entry; refuse one that leads out of the archive."""
    path = PurePosixPath(name.replace("\\", "/"))
    if path.is_absolute() or ".." in path.parts or PureWindowsPath(name).drive or not path.parts or "\0" in name:
        raise RefusedInputError(f"{archive} holds a path that leads out of it: {escape_text(name, 80)}")
    return path.parts


class _Zip:
    def __init__(self, file: Path, name: str):
        from zipfile import ZipFile

        self._zip, self._name = ZipFile(file), name
        self._password: bytes | None = None

    def __enter__(self) -> _Zip:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def find_entries(self, _: int) -> list[_Entry]:
        files = [entry for entry in self._zip.infolist() if not entry.is_dir()]
        if any(entry.flag_bits & 1 for entry in files):
            self._password = _ask_password(self._name)
        links = [stat.S_ISLNK(entry.external_attr >> 16) for entry in files]
        return [_Entry(entry.filename, entry.file_size, link) for entry, link in zip(files, links, strict=True)]

    def open(self, entry: _Entry) -> IO[bytes]:
        try:
            return self._zip.open(entry.name, pwd=self._password)
        except RuntimeError:
            raise UsageError(f"{self._name} is encrypted, and the password in {PASSWORD_VARIABLE} is wrong") from None
        except NotImplementedError:
            raise RefusedInputError(
                f"{self._name} is packed or encrypted in a way that Python cannot read: unpack it with another program"
            ) from None


class _Tar:
    def __init__(self, file: Path):
        import tarfile

        self._tar = tarfile.open(file)  # noqa: SIM115 (closed at the end of the block)
        self._members: dict[str, tarfile.TarInfo] = {}

    def __enter__(self) -> _Tar:
        return self

    def __exit__(self, *_: object) -> None:
        self._tar.close()

    def find_entries(self, most: int) -> list[_Entry]:
        entries: list[_Entry] = []
        for member in self._tar:
            if len(entries) > most:
                break
            if not member.isdir():
                self._members[member.name] = member
                entries.append(_Entry(member.name, member.size, not member.isfile()))
        stream = self._tar.fileobj
        assert stream is not None
        stream.seek(self._tar.offset)  # of the block of zeros at the end, where one that was cut has nothing
        if len(entries) <= most and not stream.read(1):
            raise EOFError("it ends early: files are missing")
        return entries

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
