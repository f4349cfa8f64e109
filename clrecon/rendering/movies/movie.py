"""Moving pictures: the cameras of a turntable, and frames one after the other to a file or a folder.

Frames are taken from an iterator and written as they come, so that a thousand of them need the memory of one.  Before
the first is asked for, everything is checked that can be: the name, the place, the encoder.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.rendering.views.camera import Camera
from clrecon.system.files import Staged, check_writable, stage_file
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from clrecon.rendering.pictures.picture import Rendering

__all__ = [
    "ANIMATIONS",
    "MOST_FRAMES",
    "animation_kind",
    "check_animation",
    "stage_animation",
    "turntable_cameras",
    "write_animation",
]

ANIMATIONS = (".mp4", ".gif", ".apng")
"""Extensions of moving pictures; a name without one is a folder of PNG files."""

MOST_FRAMES = 10_000
"""More are a slip of the keyboard: five minutes at 30 a second."""

FASTEST = {".mp4": 120.0, ".gif": 50.0, ".apng": 120.0, "": 120.0}
"""Frames a second; GIF counts hundredths of a second, and browsers slow down what is below two of them."""

SLOWEST = 0.1
"""Frames a second."""


def turntable_cameras(camera: Camera, frames: int, degrees: float = 360.0) -> list[Camera]:
    """Cameras around the focal point, about the axis of the body and towards the patient's left.

    Parameters
    ----------
    camera : Camera
        The first one.
    frames : int
        How many.
    degrees : float
        Whole turns end one step before the first camera, so that the motion can be repeated; other angles end there.

    Raises
    ------
    UsageError
        `frames` is not from 1 to 10000, or `degrees` is not finite.
    """
    if not isinstance(frames, (int, np.integer)) or not 1 <= frames <= MOST_FRAMES:
        raise UsageError(f"a turntable has 1 to {MOST_FRAMES} frames, not {frames!r}")
    if not np.isfinite(degrees):
        raise UsageError(f"a turntable turns by a finite angle in degrees, not {degrees!r}")
    whole = degrees % 360.0 == 0.0
    step = degrees / max(1, frames if whole else frames - 1)
    return [camera.orbit(step * frame) for frame in range(frames)]


def animation_kind(path: str | os.PathLike[str]) -> str:
    """Extension of a moving picture in lower case, empty for a folder: without one, with a slash, or there as one."""
    text = os.fspath(path)
    is_folder = text.endswith(tuple(filter(None, (os.sep, os.altsep)))) or os.path.isdir(text)
    return "" if is_folder else os.path.splitext(text)[1].lower()


def check_animation(path: str | os.PathLike[str], fps: float = 25.0) -> str:
    """Refuse what cannot be written, before any frame is computed.

    Parameters
    ----------
    path : str or path
        ``.mp4``, ``.gif``, ``.apng``, or a folder: a name without extension, with a slash at its end, or that is one.
    fps : float
        Frames a second.

    Returns
    -------
    str
        The extension, empty for a folder.

    Raises
    ------
    UsageError
        Another extension, no encoder, a folder that holds other things, or an impossible `fps`.
    OutputError
        The place cannot be written to.
    """
    try:
        text = os.fspath(path)
    except TypeError as error:
        raise UsageError(f"a moving picture is named by a string or a path, not {type(path).__name__}") from error
    if not text:
        raise UsageError("the name of the moving picture is empty")
    extension = animation_kind(text)
    if extension and extension not in ANIMATIONS:
        raise UsageError(
            f"a moving picture is not written as {extension!r}: use one of {', '.join(ANIMATIONS)},"
            " or a name without extension for a folder of PNG files"
        )
    if not isinstance(fps, (int, float)) or not SLOWEST <= fps <= FASTEST[extension]:
        kind = extension[1:].upper() or "a folder of frames"
        raise UsageError(f"{kind} takes {SLOWEST:g} to {FASTEST[extension]:g} frames a second, not {fps!r}")
    if extension == ".mp4":
        from clrecon.rendering.movies.video import find_encoder

        find_encoder()
    if extension:
        check_writable(text)
    else:
        from clrecon.rendering.movies.frame_folder import check_frame_folder

        check_frame_folder(text)
    return extension


def write_animation(
    frames: Iterable[Rendering | NDArray[np.uint8]],
    path: str | os.PathLike[str],
    fps: float = 25.0,
    *,
    total: int = 0,
    progress: Progress | None = None,
) -> int:
    """Write frames as a moving picture, whole or not at all.

    Parameters
    ----------
    frames : iterable of Rendering or of ndarray, shape (h, w, 3) or (h, w, 4), uint8
        All of one size.  It is asked for the next frame when the one before has been written.
    path : str or path
        See `check_animation`.  MP4 is H.264 (BT.709, quality 18), an odd side made even by repeating its last row or
        column.  GIF has a palette a frame, dithered after Floyd and Steinberg, and repeats, as does APNG, which keeps
        every colour and the opacity.  A folder gets frame_0000.png, frame_0001.png, ...
    fps : float
        Frames a second.
    total : int
        How many are to come, for `progress`.
    progress : callable, optional
        Called as ``progress("frames", done, total)``.

    Returns
    -------
    int
        Bytes written.

    Raises
    ------
    UsageError
        As in `check_animation`; no frame, frames of several sizes, or opacity that the format would lose.
    OutputError
        The file cannot be written; an older one is intact.
    """
    with stage_animation(frames, path, fps, total=total, progress=progress) as staged:
        staged.commit()
    return staged.size


@contextlib.contextmanager
def stage_animation(
    frames: Iterable[Rendering | NDArray[np.uint8]],
    path: str | os.PathLike[str],
    fps: float = 25.0,
    *,
    total: int = 0,
    progress: Progress | None = None,
) -> Iterator[Staged]:
    """Write a moving picture under a temporary name; ``commit`` of what is yielded puts it in place.

    For files that belong together: stage all of them, then commit one after the other.  What is not committed is
    removed at the end of the block.  Parameters and errors as in `write_animation`.
    """
    extension = check_animation(path, fps)
    checked = _checked_frames(frames, extension, total, progress)
    if extension == "":
        from clrecon.rendering.movies.frame_folder import stage_frame_folder

        with stage_frame_folder(checked, path) as folder:
            yield folder
        return
    if extension == ".mp4":
        from clrecon.rendering.movies.video import write_video as write
    elif extension == ".gif":
        from clrecon.rendering.movies.animated_files import write_gif as write
    else:
        from clrecon.rendering.movies.animated_files import write_apng as write

    def write_all(stream: BinaryIO) -> None:
        write(stream, checked, fps)

    with stage_file(path, write_all) as file:
        yield file


def _checked_frames(
    frames: Iterable[Rendering | NDArray[np.uint8]], extension: str, total: int, progress: Progress | None
) -> Iterator[NDArray[np.uint8]]:
    """Frames as arrays (h, w, 3 or 4), the formats without opacity get three channels; says how many are done."""
    shape: tuple[int, ...] | None = None
    done = 0
    for frame in frames:
        image = np.asarray(getattr(frame, "image", frame))
        if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4) or image.size == 0:
            raise UsageError(f"frame {done} is no picture of uint8 (h, w, 3 or 4): {image.dtype} {image.shape}")
        if shape is None:
            shape = image.shape
        elif image.shape != shape:
            raise UsageError(f"frame {done} has shape {image.shape}, the frames before it {shape}")
        if extension in (".mp4", ".gif") and image.shape[2] == 4:
            if (image[..., 3] != 255).any():
                raise UsageError(
                    f"{extension[1:].upper()} cannot hold a transparent background: choose a background colour,"
                    " APNG or a folder of PNG files"
                )
            image = image[..., :3]
        yield np.ascontiguousarray(image)
        done += 1
        if progress is not None:
            progress("frames", done, total)
    if done == 0:
        raise UsageError("a moving picture needs at least one frame")
