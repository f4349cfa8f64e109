"""A folder of frames, which appears as a whole: made under another name beside its place and renamed."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, UsageError
from clrecon.files import system_errors

__all__ = ["check_frame_folder", "write_frame_folder"]

_FRAME = re.compile(r"frame_[0-9]{4,}\.png")


def check_frame_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder that is going to be made or replaced.

    Raises
    ------
    UsageError
        It is there and holds more than frames of an earlier run.
    OutputError
        It is no folder, or what it is to stand in is missing or cannot be written to.
    """
    folder = Path(os.path.realpath(path))
    with system_errors(path):
        if folder.exists():
            if not folder.is_dir():
                raise OutputError(f"cannot write {path}: it is a file, name a folder or use an extension")
            others = [entry.name for entry in os.scandir(folder) if not _FRAME.fullmatch(entry.name)]
            if others:
                raise UsageError(
                    f"the folder {path} holds other things ({len(others)}, such as {sorted(others)[0]!r}):"
                    " name a new or empty one for the frames"
                )
        if not folder.parent.is_dir():
            raise OutputError(f"cannot write {path}: the folder {folder.parent} does not exist, make it first")
        _make_beside(folder).rmdir()
    return folder


def write_frame_folder(frames: Iterator[NDArray[np.uint8]], path: str | os.PathLike[str]) -> int:
    """Write frames (h, w, 3 or 4) as frame_0000.png, ... and return their bytes together."""
    from clrecon.rendering.pillow import load_pillow

    load_pillow()
    from PIL import Image

    folder = check_frame_folder(path)
    size = 0
    with system_errors(path):
        made = _make_beside(folder)
        try:
            for number, frame in enumerate(frames):
                with open(made / f"frame_{number:04d}.png", "xb") as stream:
                    Image.fromarray(frame).save(stream, "PNG")
                    stream.flush()
                    os.fsync(stream.fileno())
                    size += stream.tell()
            _swap(made, folder)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    return size


def _make_beside(folder: Path) -> Path:
    made = folder.parent / f".clrecon-{secrets.token_hex(8)}.frames"
    made.mkdir()
    return made


def _swap(made: Path, folder: Path) -> None:
    """Put `made` into the place of `folder`, whose frames of an earlier run are removed when that is done."""
    older = made.with_suffix(".older")
    if folder.exists():
        folder.rename(older)
    try:
        made.rename(folder)
    except BaseException:
        if older.exists():
            older.rename(folder)
        raise
    shutil.rmtree(older, ignore_errors=True)
