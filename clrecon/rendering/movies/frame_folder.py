"""Folders of frames that appear as a whole."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clrecon.system.files import StagedFolder, check_folder, temporary_folder
from clrecon.system.paths import final_mode, system_errors

_FRAME = re.compile(r"frame_[0-9]{4,}\.png")


def check_frame_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder that will be made or replaced, see `clrecon.system.files.check_folder`."""
    return check_folder(path, _FRAME, "frames")


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
