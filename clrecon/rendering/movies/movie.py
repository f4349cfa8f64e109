"""Moving pictures: the cameras of a turntable, and the writing of frames to a file or a folder.

Frames are taken from an iterator and written one by one, so that a thousand need the memory of one.  The name, the
place and the encoder are checked before the first frame is computed.
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
from clrecon.system.arguments import explains_arguments
from clrecon.system.files import Staged, check_writable, stage_file
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress
from clrecon.system.text import guess_word

if TYPE_CHECKING:
    from clrecon.rendering.pictures.picture import Rendering

ANIMATIONS = (".mp4", ".gif", ".apng")
"""Extensions of moving pictures; a name without extension is a folder of PNG files."""

MOST_FRAMES = 10_000
"""Most frames: five minutes at 30 frames per second.  More are a typing error."""

FASTEST = {".mp4": 120.0, ".gif": 50.0, ".apng": 120.0, "": 120.0}
"""Most frames per second.  GIF counts hundredths of a second; browsers slow down frames shorter than two."""

SLOWEST = 0.1
"""Fewest frames per second."""


@explains_arguments
def turntable_cameras(camera: Camera, frames: int, degrees: float = 360.0) -> list[Camera]:
    """Return cameras around the focal point, turning about the axis of the body towards the patient's left.

    Parameters
    ----------
    camera : Camera
        The first camera.
    frames : int
        Number of cameras.
    degrees : float
        Total angle.  Whole turns end one step before the first camera, so that the movie can be repeated; other angles
        end exactly there.

    Raises
    ------
    UsageError
        ``frames`` is not from 1 to 10000, or ``degrees`` is not finite.
    """
    if not isinstance(frames, (int, np.integer)) or not 1 <= frames <= MOST_FRAMES:
        raise UsageError(f"a turntable has 1 to {MOST_FRAMES} frames, not {frames!r}")
    if not np.isfinite(degrees):
        raise UsageError(f"a turntable turns by a finite angle in degrees, not {degrees!r}")
    whole = degrees % 360.0 == 0.0
    step = degrees / max(1, frames if whole else frames - 1)
    return [camera.orbit(step * frame) for frame in range(frames)]


def animation_kind(path: str | os.PathLike[str]) -> str:
    """Return the extension of a moving picture in lower case; empty for a folder: no extension, a final slash, or a
    folder.
    """
    text = os.fspath(path)
    is_folder = text.endswith(tuple(filter(None, (os.sep, os.altsep)))) or os.path.isdir(text)
    return "" if is_folder else os.path.splitext(text)[1].lower()


def check_animation(path: str | os.PathLike[str], fps: float = 25.0) -> str:
    """Refuse a moving picture that cannot be written, before a frame is computed.

    path: ``.mp4``, ``.gif``, ``.apng``, or a folder: a name without extension, a name that ends with a slash, or an
        existing folder.
    fps: Frames per second.

    Returns: The extension, empty for a folder.
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
            f"a moving picture is not written as {extension!r}{guess_word(extension, ANIMATIONS)}: use one of"
            f" {', '.join(ANIMATIONS)}, or a name without extension for a folder of PNG files"
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


@explains_arguments
def write_animation(
    frames: Iterable[Rendering | NDArray[np.uint8]],
    path: str | os.PathLike[str],
    fps: float = 25.0,
    *,
    no_clobber: bool = False,
    total: int = 0,
    progress: Progress | None = None,
) -> int:
    """Write frames as a moving picture, whole or not at all.

    Parameters
    ----------
    frames : iterable of Rendering or of ndarray, shape (h, w, 3) or (h, w, 4), uint8
        Frames of one size.  The next frame is requested after the one before has been written.
    path : str or path
        ``.mp4``, ``.gif``, ``.apng``, or a folder: a name without extension, a name that ends with a slash, or an
        existing folder.  MP4 is H.264 (BT.709, quality 18), an odd side made even by repeating its last row or
        column.  GIF has a palette for each frame, dithered after Floyd and Steinberg, and repeats.  APNG repeats too,
        and keeps every colour and the opacity.  A folder gets frame_0000.png, frame_0001.png, ...
    fps : float
        Frames per second.
    no_clobber : bool
        True: what has that name stays and is an `OutputError`; an empty folder is filled.
    total : int
        Number of frames, for ``progress``.
    progress : callable, optional
        Called as ``progress("frames", done, total)``.

    Returns
    -------
    int
        Bytes written.

    Raises
    ------
    UsageError
        The extension is unknown, there is no encoder, the folder contains other files, or ``fps`` is out of range; or
        there is no frame, frames differ in size, or have opacity that the format would
        lose.
    OutputError
        The file cannot be written; an older one is intact.
    """
    with (
        keep_existing(no_clobber),
        stage_animation(frames, path, fps, total=total, progress=progress) as staged,
    ):
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
    """Write a moving picture under a temporary name; ``commit`` of the yielded object moves it to its place.

    For files that belong together: stage all of them, then commit one after the other.  Files that are not committed
    are removed at the end of the block.  Parameters and errors as in `write_animation`.
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
    """Yield frames as arrays (h, w, 3 or 4), with three channels for formats without opacity; report progress."""
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
