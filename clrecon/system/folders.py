"""Folders that appear as a whole: made under a temporary name beside their place, then renamed."""

from __future__ import annotations

import os
import re
from pathlib import Path

from clrecon.errors import OutputError, UsageError
from clrecon.system.files import hold_interrupts, temporary_folder
from clrecon.system.log import get_logger
from clrecon.system.targets import existing_stay, is_dicom, place_folder, refuse_existing, resolve_target, system_errors

log = get_logger(__name__)


def check_folder(path: str | os.PathLike[str], own: re.Pattern[str], what: str) -> Path:
    """Return the folder that will be made or replaced.

    own: Names of files that an earlier run can have written.
    what: What will be in it, for messages: "frames".
    """
    folder = resolve_target(path)
    with system_errors(path):
        if folder.exists():
            _check_existing(path, folder, own, what)
        elif folder.is_symlink():
            raise OutputError(f"cannot write {path}: it is a symbolic link that leads back to itself")
        if not folder.parent.is_dir():
            raise OutputError(f"cannot write {path}: the folder {folder.parent} does not exist, make it first")
        with temporary_folder(folder.parent):
            pass
    return folder


def _check_existing(path: str | os.PathLike[str], folder: Path, own: re.Pattern[str], what: str) -> None:
    if not folder.is_dir():
        raise OutputError(f"cannot write {path}: it is a file, name a folder or use an extension")
    refuse_existing(path, folder)
    others = [entry.name for entry in os.scandir(folder) if not own.fullmatch(entry.name)]
    if others:
        raise UsageError(
            f"the folder {path} holds other things ({len(others)}, such as {sorted(others)[0]!r}):"
            f" name a new or empty one for the {what}"
        )
    if any(is_dicom(entry.path) for entry in os.scandir(folder)):
        raise OutputError(f"cannot write {path}: DICOM files are there, which are never replaced")
    if os.path.samefile(folder, os.curdir):  # a process in this folder would then be in a removed one
        raise UsageError(f"the {what} replace the folder {path}, which is the current one: name one in it")
    if os.path.ismount(folder):
        raise OutputError(f"cannot write {path}: a disk is mounted there, name a folder in it for the {what}")
    if not os.access(folder, os.W_OK):
        raise OutputError(f"cannot write {path}: the folder is there and write-protected")


class StagedFolder:
    """A finished folder under a temporary name beside its place.

    size: Total size of its files in bytes.
    """

    def __init__(self, path: str | os.PathLike[str], made: Path, folder: Path, size: int):
        self._path, self._made, self._folder = path, made, folder
        self._keep = existing_stay()
        self.size = size

    def commit(self) -> None:
        """Move the folder to its place; that of an earlier run is removed at the end of the ``with`` block."""
        with hold_interrupts():
            place_folder(self._made, self._folder, self._path, keep=self._keep)
        log.info("folder written: %d bytes", self.size)
