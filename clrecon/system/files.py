"""Safe writing: a reader always finds the whole old file or folder, or the whole new one.

A file is written to a temporary one in the same folder (created exclusively, readable by the owner only, with a random
name), flushed to the disk, checked, and only then renamed over the target.  After any failure before the rename,
`KeyboardInterrupt` included, the temporary file is removed and an older target is unchanged.  A killed process cannot
clean up: the next process that writes into the same folder removes its temporary files.

Of a symbolic link the file that it points to is replaced.  A folder is made under a temporary name beside its place.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import secrets
import shutil
import signal
import stat
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

from clrecon.errors import OutputError, UsageError
from clrecon.system import paths
from clrecon.system.text import format_bytes

if TYPE_CHECKING:
    import logging

if sys.platform != "win32":
    import fcntl


_FILES_OF_OTHERS = 200
"""Number of files kept free for libraries, drivers and their caches, beside the files that a job writes."""

_TEMPORARY = re.compile(r"\.clrecon-[0-9a-f]{16}\.(?:tmp|folder)")

_own_folders: dict[str, Path] = {}
"""Where the temporary files and folders that this process is writing lie, by their names."""


def _log() -> logging.Logger:
    from clrecon.system.log import get_logger  # loads logging: help, which reads this file too, need not wait for it

    return get_logger(__name__)


def replace_file(
    path: str | os.PathLike[str],
    write: Callable[[BinaryIO], object],
    verify: Callable[[Path], None] | None = None,
    *,
    expected_bytes: int = 0,
) -> int:
    """Write a file as a whole or not at all; return its size in bytes.

    path: A regular file of that name is replaced; its permissions are kept.  A new file gets those that the umask
        allows.
    verify: Gets the path of the finished temporary file and raises `OutputError` if its contents are wrong.
    expected_bytes: Checked against the free space before anything is written.
    """
    with stage_file(path, write, verify, expected_bytes=expected_bytes) as staged:
        staged.commit()
    return staged.size


class Staged(Protocol):
    """A finished file, or a folder of finished files, that still has a temporary name."""

    size: int
    """Size in bytes."""

    def commit(self) -> None:
        """Put it in the place of its target."""


class StagedFile:
    """A finished file of `size` bytes under a temporary name beside its target."""

    def __init__(self, path: str | os.PathLike[str], temporary: Path, target: Path, stream: BinaryIO, size: int):
        self._path, self._temporary = path, temporary
        self._target, self._stream = target, stream
        self._keep = paths.existing_stay()
        self.size = size

    def commit(self) -> None:
        if sys.platform == "win32":
            with paths.system_errors(self._path):
                self._stream.close()  # Windows cannot rename an open file.
        paths.place_file(self._temporary, self._target, self._path, keep=self._keep)
        _sync_folder(self._target.parent)
        _log().info("file written: %d bytes", self.size)


@contextlib.contextmanager
def stage_file(
    path: str | os.PathLike[str],
    write: Callable[[BinaryIO], object],
    verify: Callable[[Path], None] | None = None,
    *,
    expected_bytes: int = 0,
) -> Iterator[StagedFile]:
    """Write a file under a temporary name; `StagedFile.commit` in the block puts it in place, one after the other."""
    target = paths.checked_target(path)
    with contextlib.ExitStack() as stack:
        with paths.system_errors(path):
            _check_space(path, target.parent, expected_bytes)
            _sweep(target.parent)
            mode = paths.final_mode(target)
            temporary, stream = stack.enter_context(_temporary_file(target.parent))
            write(stream)
            stream.flush()
            size = stream.tell()
            os.fsync(stream.fileno())
            arrived = os.fstat(stream.fileno()).st_size
            if arrived != size:
                raise OutputError(
                    f"cannot write {paths.shown_path(path)}: {size} bytes written, {arrived} arrived on the disk"
                )
            if verify is not None:
                verify(temporary)
            if sys.platform != "win32":
                with contextlib.suppress(PermissionError):  # Some network file systems do not let the mode be changed.
                    os.fchmod(stream.fileno(), mode)
        yield StagedFile(path, temporary, target, stream, size)


@contextlib.contextmanager
def hold_interrupts() -> Iterator[None]:
    """Hold back Ctrl-C, and other signals that this process handles, while several files are put into their places."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handlers = {}
    for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGINT)):
        if callable(signal.getsignal(number)) and number not in handlers:
            handlers[number] = signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])


def allow_open_files(count: int) -> None:
    """Raise the limit of open files of this process, as far as the system allows, for `count` staged files."""
    if sys.platform == "win32":  # Windows: 8192 at most
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = count + _FILES_OF_OTHERS
    if hard != resource.RLIM_INFINITY:
        wanted = min(wanted, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(OSError, ValueError):  # A limit that stays too low shows when a file is opened.
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def check_writable(path: str | os.PathLike[str], *, expected_bytes: int = 0) -> None:
    """Raise `OutputError` if `replace_file` will surely fail: an empty temporary file is made there and removed."""
    target = paths.checked_target(path)
    with paths.system_errors(path):
        _check_space(path, target.parent, expected_bytes)
        with _temporary_file(target.parent):
            pass


def _check_space(path: str | os.PathLike[str], folder: Path, expected_bytes: int) -> None:
    usage = shutil.disk_usage(folder)
    # Some network file systems do not tell their free space and report 0 bytes.
    if usage.total and expected_bytes > usage.free:
        raise OutputError(
            f"cannot write {paths.shown_path(path)}: it needs about {format_bytes(expected_bytes)} and "
            f"{format_bytes(usage.free)} are free in {paths.shown_path(folder)}"
        ) from OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextlib.contextmanager
def _temporary_file(folder: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """Create a file exclusively, readable by the owner only, and remove it at the end unless it was renamed."""
    flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0)
    while True:
        temporary = folder / f".clrecon-{secrets.token_hex(8)}.tmp"
        try:
            with os.fdopen(os.open(temporary, flags, 0o600), "wb") as stream:
                if not _lock_new(stream):
                    continue
                _own_folders[temporary.name] = folder
                try:
                    yield temporary, stream
                except BaseException:
                    with contextlib.suppress(OSError):  # closing writes the buffer and may fail again
                        stream.close()
                    raise
                return
        finally:
            _own_folders.pop(temporary.name, None)
            with contextlib.suppress(OSError):
                temporary.unlink()


@contextlib.contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Make a folder with a random name, removed unless renamed; those of dead processes go at the next writing."""
    _sweep(parent)
    with contextlib.ExitStack() as stack:
        while True:
            folder = parent / f".clrecon-{secrets.token_hex(8)}.folder"
            stack.callback(_own_folders.pop, folder.name, None)
            _own_folders[folder.name] = parent
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            folder.mkdir(mode=0o700)
            if sys.platform == "win32" or _lock_folder(stack, folder):
                break
        yield folder


def _lock_folder(stack: contextlib.ExitStack, folder: Path) -> bool:
    """Lock a new folder until `stack` closes; False when another process was about to remove it in `_sweep`."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except FileNotFoundError:
        return False
    stack.callback(os.close, descriptor)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True
    return folder.exists()


def _lock_new(stream: BinaryIO) -> bool:
    """Lock a new file against `_sweep`; False when another process was about to remove it."""
    if sys.platform != "win32":
        try:
            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            return True  # A file system without locks: no file can be locked, so `_sweep` removes nothing.
    return os.fstat(stream.fileno()).st_nlink > 0


def _sweep(folder: Path) -> None:
    """Remove temporary files and folders of dead processes: names of our pattern that no process has locked.

    Where this process is writing already, that has been done: with a thousand files it would take long for each.
    """
    if sys.platform == "win32" or folder in _own_folders.values():
        return
    with os.scandir(folder) as entries:
        names = [entry.name for entry in entries if _TEMPORARY.fullmatch(entry.name)]
    for name in names:
        temporary = folder / name
        # Vanished meanwhile, owned by another user, or locked by a living process: left alone.
        with contextlib.suppress(OSError):
            is_folder = name.endswith(".folder")
            access = os.O_RDONLY | os.O_DIRECTORY if is_folder else os.O_RDWR
            descriptor = os.open(temporary, access | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                status = os.fstat(descriptor)
                if (is_folder or stat.S_ISREG(status.st_mode)) and status.st_uid == os.geteuid():
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if is_folder:
                        shutil.rmtree(temporary, ignore_errors=True)
                    else:
                        temporary.unlink()
                    _log().info("what a process that has ended left unfinished was removed")
            finally:
                os.close(descriptor)


def _sync_folder(folder: Path) -> None:
    """Write the rename itself to the disk, where the system can; without, it is still the old or the new file."""
    if sys.platform == "win32":
        return
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def check_folder(path: str | os.PathLike[str], pattern: re.Pattern[str], noun: str) -> Path:
    """Return the folder to make or replace; `pattern` are files of earlier runs, `noun` names what will be in it."""
    folder = paths.resolve_target(path)
    with paths.system_errors(path):
        if folder.exists():
            _check_existing(path, folder, pattern, noun)
        elif folder.is_symlink():
            raise OutputError(f"cannot write {path}: it is a symbolic link that leads back to itself")
        if not folder.parent.is_dir():
            raise OutputError(f"cannot write {path}: the folder {folder.parent} does not exist, make it first")
        with temporary_folder(folder.parent):
            pass
    return folder


def _check_existing(path: str | os.PathLike[str], folder: Path, pattern: re.Pattern[str], noun: str) -> None:
    if not folder.is_dir():
        raise OutputError(f"cannot write {path}: it is a file, name a folder or use an extension")
    paths.refuse_existing(path, folder)
    others = [entry.name for entry in os.scandir(folder) if not pattern.fullmatch(entry.name)]
    if others:
        raise UsageError(
            f"the folder {path} holds other things ({len(others)}, such as {sorted(others)[0]!r}):"
            f" name a new or empty one for the {noun}"
        )
    if any(paths.is_dicom(entry.path) for entry in os.scandir(folder)):
        raise OutputError(f"cannot write {path}: DICOM files are there, which are never replaced")
    if os.path.samefile(folder, os.curdir):  # a process in this folder would then be in a removed one
        raise UsageError(f"the {noun} replace the folder {path}, which is the current one: name one in it")
    if os.path.ismount(folder):
        raise OutputError(f"cannot write {path}: a disk is mounted there, name a folder in it for the {noun}")
    if not os.access(folder, os.W_OK):
        raise OutputError(f"cannot write {path}: the folder is there and write-protected")


class StagedFolder:
    """A finished folder, with files of `size` bytes, under a temporary name beside its place."""

    def __init__(self, path: str | os.PathLike[str], staged: Path, folder: Path, size: int):
        self._path, self._made = path, staged
        self._folder = folder
        self._keep = paths.existing_stay()
        self.size = size

    def commit(self) -> None:
        """Move the folder to its place; that of an earlier run is removed at the end of the ``with`` block."""
        with hold_interrupts():
            paths.place_folder(self._made, self._folder, self._path, keep=self._keep)
        _log().info("folder written: %d bytes", self.size)
