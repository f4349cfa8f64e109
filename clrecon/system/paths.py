"""Paths of files and folders: what may be opened, and targets, where something is put.

Only regular files are opened, no pipes or devices, for which a reader might wait without end.  A target is checked
before the work, and put in its place by the last step.  With `keep_existing` both refuse to replace what exists, also
what another process has put there meanwhile.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import stat
import sys
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

from clrecon.errors import OutputError, UsageError
from clrecon.system.arguments import name_parameter
from clrecon.system.text import escape_character, guess_word

# A pipe or device put in the place of a file must not make the reader wait for a writer.
_READ = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


def extension_of(path: str | os.PathLike[str]) -> str:
    """Return the extension of a file in lower case, such as ``.ply``; empty for none."""
    return os.path.splitext(os.fspath(path))[1].lower()


def find_extension(path: str | os.PathLike[str], known: Iterable[str], noun: str, hint: str = "") -> str:
    """Return the extension of a file to write, one of those known; a refusal names the `noun` ("mesh") and `hint`."""
    try:
        extension, name = extension_of(path), os.path.basename(path)
    except TypeError as error:
        raise UsageError(f"a {noun} file is named by a string or a path, not {type(path).__name__}") from error
    if extension not in known:
        ending = f"the extension {extension!r}{hint or guess_word(extension, known)}" if extension else "no extension"
        if os.fspath(path) and not name:
            raise UsageError(f"the name of the {noun} file ends with a slash, as that of a folder: name a file in it")
        if name.lower() in known:
            raise UsageError(f"the name of the {noun} file is only an extension: put a name before {name}")
        raise UsageError(f"the name of the {noun} file has {ending}: use one of {', '.join(known)}")
    return extension


def open_regular(path: str | os.PathLike[str], buffering: int = -1) -> BinaryIO:
    """Open a regular file for reading, as ``open(path, "rb", buffering)`` does."""
    descriptor = os.open(path, _READ)
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return os.fdopen(descriptor, "rb", buffering)
    os.close(descriptor)
    raise OSError(errno.EINVAL, "it is no regular file")


def read_regular(path: str | os.PathLike[str], limit: int) -> bytes:
    """Read a regular file of at most `limit` bytes; raises OSError for a larger one, and as `open_regular` does."""
    with open_regular(path) as stream:
        data = stream.read(limit + 1)
    if len(data) > limit:
        raise OSError(errno.EFBIG, f"it is larger than {limit:,} bytes")
    return data


_existing_stay: ContextVar[bool] = ContextVar("existing_stay", default=False)

_OPEN_FILES = re.compile(r"/dev/fd|/proc/[^/]+(/task/[^/]+)?/fd")
"""Folders whose entries are the open files of a process; /dev/stdout is a link into one."""

_MOST_LINKS = 40

_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK)
"""Errors of file systems without hard links."""

_ADVICE = {
    errno.ENOSPC: "the disk is full: free some space or choose another folder",
    errno.EDQUOT: "the disk quota is used up: free some space or choose another folder",
    errno.EFBIG: "the file grew beyond the largest size that is allowed here",
    errno.EROFS: "the file system is read-only: choose another folder",
    errno.EACCES: "permission denied: choose another folder or change its permissions",
    errno.EPERM: "the system does not permit it: choose another folder",
    errno.ENAMETOOLONG: "the name is too long: choose a shorter one",
    errno.ELOOP: "it is a symbolic link that leads back to itself",
    errno.EMFILE: "too many files are open at once: write fewer, or raise the limit (ulimit -n)",
}

_KINDS: tuple[tuple[Callable[[int], bool], str], ...] = (
    (stat.S_ISDIR, "a folder: name a file in it"),
    (stat.S_ISFIFO, "a FIFO: only regular files are written"),
    (stat.S_ISSOCK, "a socket: only regular files are written"),
    (stat.S_ISBLK, "a block device: only regular files are written"),
    (stat.S_ISCHR, "a character device: only regular files are written"),
)


@contextlib.contextmanager
def keep_existing(*, keep: bool) -> Iterator[None]:
    """In the ``with`` block, refuse every target that exists or, with False, replace it, as outside of such blocks."""
    token = _existing_stay.set(keep)
    try:
        yield
    finally:
        _existing_stay.reset(token)


def existing_stay() -> bool:
    return _existing_stay.get()


def _there_already(path: str | os.PathLike[str]) -> OutputError:
    return OutputError(
        f"{shown_path(path)} exists already and stays ({name_parameter('no_clobber', True)}): name another"
    )


def refuse_existing(path: str | os.PathLike[str], target: Path) -> None:
    """Raise `OutputError` in a block of `keep_existing` if the target is there; an empty folder is as good as none."""
    if not existing_stay() or not os.path.lexists(target):
        return
    with system_errors(path):
        if not target.is_dir() or next(target.iterdir(), None) is not None:
            raise _there_already(path)


def shown_path(path: str | os.PathLike[str]) -> str:
    """Return the path as a message shows it: one line without terminal control characters."""
    return "".join(c if c.isprintable() else escape_character(c) for c in os.fspath(path))


@contextlib.contextmanager
def system_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn errors of the system into one line that names the target and says what to do."""
    try:
        yield
    except OSError as error:
        advice = _missing_advice(path) if error.errno == errno.ENOENT else _ADVICE.get(error.errno or 0)
        reason = advice or error.strerror or str(error) or type(error).__name__
        raise OutputError(f"cannot write {shown_path(path)}: {reason}") from error


def _missing_advice(path: str | os.PathLike[str]) -> str:
    """Say why nothing can be made at a path: its folder is gone, or is one of the system's that takes no files."""
    if os.path.isdir(os.path.dirname(os.path.realpath(path))):
        return "files cannot be made in this folder: choose another folder"
    return "the folder vanished while the file was written"


def resolve_target(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path behind all links, whether something is there or not."""
    text = os.fspath(path)
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        raise OutputError(
            f"cannot write {shown_path(path)}: the name has characters that no file name of this system can have"
        ) from None
    if "\0" in text:
        raise OutputError(f"cannot write {shown_path(path)}: the name holds a null character")
    try:
        absolute = os.path.abspath(text)
    except FileNotFoundError:
        raise OutputError(
            f"cannot write {shown_path(path)}: the current folder has been deleted, change to another one"
        ) from None
    with system_errors(path):
        if _is_open_stream(absolute):
            raise OutputError(
                f"cannot write {shown_path(path)}: it leads to an open stream, such as standard output; only regular"
                " files are written"
            )
        return Path(os.path.realpath(text))


def _is_open_stream(absolute: str) -> bool:
    """True where a path leads to an open file of a process: a pipe, or one whose replacement is not seen."""
    for _ in range(_MOST_LINKS):
        folder = os.path.realpath(os.path.dirname(absolute))
        if _OPEN_FILES.fullmatch(folder):
            return True
        entry = os.path.join(folder, os.path.basename(absolute))
        if not os.path.islink(entry):
            return False
        absolute = os.path.join(folder, os.readlink(entry))
    return False


def checked_target(path: str | os.PathLike[str]) -> Path:
    """Resolve symbolic links and return the path to replace, after checking that it may be replaced."""
    text = os.fspath(path)
    with system_errors(path):
        if not text or text.endswith(tuple(filter(None, (os.sep, os.altsep)))):
            raise OutputError(f"cannot write {shown_path(path)!r}: this names a folder, name a file in it")
        target = resolve_target(path)
        refuse_existing(path, target)
        folder = target.parent
        if not folder.exists():
            raise OutputError(
                f"cannot write {shown_path(path)}: the folder {shown_path(folder)} does not exist, make it first"
            )
        if not folder.is_dir():
            raise OutputError(f"cannot write {shown_path(path)}: {shown_path(folder)} is not a folder")
        try:
            mode = os.stat(target).st_mode
        except FileNotFoundError:
            return target
        for is_kind, words in _KINDS:
            if is_kind(mode):
                raise OutputError(f"cannot write {shown_path(path)}: it is {words}")
        if not os.access(target, os.W_OK):
            raise OutputError(f"cannot write {shown_path(path)}: the file is there and write-protected")
        if is_dicom(target):
            raise OutputError(f"cannot write {shown_path(path)}: a DICOM file is there, which is never replaced")
    return target


def is_dicom(path: str | os.PathLike[str]) -> bool:
    """True for a file with the mark of DICOM: measured data are not overwritten, they cannot be made again."""
    try:
        with open_regular(path, 0) as stream:
            return stream.read(132)[128:] == b"DICM"
    except OSError:
        return False


def final_mode(target: Path, new: int = 0o666) -> int:
    """Return the permissions of a finished file: those of the file that it replaces, else `new` as the umask allows."""
    try:
        return stat.S_IMODE(os.stat(target).st_mode) & 0o777
    except FileNotFoundError:
        # The umask can only be read by setting it.  Meanwhile it is strict, so a file that another thread makes then is
        # too private, never too open.
        umask = os.umask(0o077)
        os.umask(umask)
        return new & ~umask


def place_file(temporary: Path, target: Path, path: str | os.PathLike[str], *, keep: bool) -> None:
    """Rename a finished file to its target in the same folder; `keep`: fail if it exists, even since a moment ago."""
    with system_errors(path):
        if not keep:
            os.replace(temporary, target)
            return
        try:
            if sys.platform == "win32":
                os.rename(temporary, target)
            else:
                _link_new(temporary, target)
        except FileExistsError:
            raise _there_already(path) from None


def _link_new(temporary: Path, target: Path) -> None:
    """Rename on POSIX, with FileExistsError if the target exists."""
    try:
        os.link(temporary, target)
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise
        # The name is taken first, by an empty file that only this process can have made.
        os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))
        try:
            os.replace(temporary, target)
        except OSError:
            os.unlink(target)
            raise
    else:
        os.unlink(temporary)


def place_folder(staged: Path, folder: Path, path: str | os.PathLike[str], *, keep: bool) -> None:
    """Rename a finished folder to its place; an older one gets the temporary name for its owner to remove."""
    with system_errors(path):
        if keep:
            with contextlib.suppress(OSError):
                folder.rmdir()  # only an empty one
            try:
                staged.rename(folder)
            except OSError as error:
                if error.errno in (errno.EEXIST, errno.ENOTEMPTY, errno.ENOTDIR):
                    raise _there_already(path) from None
                raise
            return
        older = staged.with_suffix(".older")
        try:
            if folder.exists():
                folder.rename(older)
            staged.rename(folder)
        finally:
            if older.exists():
                older.rename(staged if folder.exists() else folder)
