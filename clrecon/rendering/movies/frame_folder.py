"""Folders of frames that appear as a whole: made under a temporary name beside their place, then renamed."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, UsageError
from clrecon.system.files import hold_interrupts, temporary_folder
from clrecon.system.log import get_logger
from clrecon.system.targets import (
    existing_stay,
    final_mode,
    is_dicom,
    place_folder,
    refuse_existing,
    resolve_target,
    system_errors,
)

__all__ = ["check_frame_folder", "stage_frame_folder"]

log = get_logger(__name__)

_FRAME = re.compile(r"frame_[0-9]{4,}\.png")


def check_frame_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder that will be made or replaced.

    Raises
    ------
    UsageError
        The folder holds more than frames of an earlier run, or is the current folder.
    OutputError
        The path is not a folder or cannot be replaced, or its parent folder is missing or cannot be written to.
    """
    folder = resolve_target(path)
    with system_errors(path):
        if folder.exists():
            if not folder.is_dir():
                raise OutputError(f"cannot write {path}: it is a file, name a folder or use an extension")
            refuse_existing(path, folder)
            others = [entry.name for entry in os.scandir(folder) if not _FRAME.fullmatch(entry.name)]
            if others:
                raise UsageError(
                    f"the folder {path} holds other things ({len(others)}, such as {sorted(others)[0]!r}):"
                    " name a new or empty one for the frames"
                )
            if any(is_dicom(entry.path) for entry in os.scandir(folder)):
                raise OutputError(f"cannot write {path}: DICOM files are there, which are never replaced")
            if os.path.samefile(folder, os.curdir):  # a process in this folder would then be in a removed one
                raise UsageError(f"the frames replace the folder {path}, which is the current one: name one in it")
            if os.path.ismount(folder):
                raise OutputError(f"cannot write {path}: a disk is mounted there, name a folder in it for the frames")
            if not os.access(folder, os.W_OK):
                raise OutputError(f"cannot write {path}: the folder is there and write-protected")
        elif folder.is_symlink():
            raise OutputError(f"cannot write {path}: it is a symbolic link that leads back to itself")
        if not folder.parent.is_dir():
            raise OutputError(f"cannot write {path}: the folder {folder.parent} does not exist, make it first")
        with temporary_folder(folder.parent):
            pass
    return folder


class StagedFolder:
    """A finished folder of frames under a temporary name beside its place.

    Attributes
    ----------
    size : int
        Total size of its files in bytes.
    """

    def __init__(self, path: str | os.PathLike[str], made: Path, folder: Path, size: int):
        self._path, self._made, self._folder = path, made, folder
        self._keep = existing_stay()
        self.size = size

    def commit(self) -> None:
        """Move the folder to its place; frames of an earlier run are removed at the end of the ``with`` block.

        Raises
        ------
        OutputError
            The system refuses, or an existing folder is kept; an older folder is intact.
        """
        with hold_interrupts():
            place_folder(self._made, self._folder, self._path, keep=self._keep)
        log.info("folder of frames written: %d bytes", self.size)


@contextlib.contextmanager
def stage_frame_folder(frames: Iterator[NDArray[np.uint8]], path: str | os.PathLike[str]) -> Iterator[StagedFolder]:
    """Write frames (h, w, 3 or 4) as frame_0000.png, ... into a folder under a temporary name.

    `StagedFolder.commit` in the ``with`` block moves it to its place; a folder that is not committed is removed at the
    end of the block.
    """
    from clrecon.rendering.pictures.pillow import load_pillow

    load_pillow()
    from PIL import Image

    folder = check_frame_folder(path)
    size = 0
    with contextlib.ExitStack() as stack:
        with system_errors(path):
            made = stack.enter_context(temporary_folder(folder.parent))
            for number, frame in enumerate(frames):
                with open(made / f"frame_{number:04d}.png", "xb") as stream:
                    Image.fromarray(frame).save(stream, "PNG")
                    stream.flush()
                    os.fsync(stream.fileno())
                    size += stream.tell()
            made.chmod(final_mode(folder, 0o777))
        yield StagedFolder(path, made, folder, size)
