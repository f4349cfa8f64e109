"""Moving pictures: the cameras of a turntable, and the writing of frames to a file or a folder.

Frames are taken from an iterator and written one by one, so that a thousand need the memory of one.  The name, the
place and the encoder are checked before the first frame is computed.

Pillow writes GIF and APNG, but holds all frames in memory until the end.  Here Pillow compresses each frame as a
separate picture, whose compressed blocks are copied into the animation.  MP4 and WebM are written by the program
ffmpeg: it gets frames through a pipe, and writes the file to a temporary folder.  Every browser and every slide program
plays H.264 in yuv420p; every browser plays VP9 in WebM, for which nobody needs a licence.

Sources: CompuServe, Graphics Interchange Format, version 89a; W3C, Portable Network Graphics, third edition.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import struct
import subprocess
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache, partial
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, UsageError
from clrecon.rendering.pictures.picture import Rendering
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.rendering.views.camera import Camera
from clrecon.system.arguments import explains_arguments
from clrecon.system.files import Staged, StagedFolder, check_folder, check_writable, stage_file, temporary_folder
from clrecon.system.packages import install_command
from clrecon.system.paths import final_mode, keep_existing, system_errors
from clrecon.system.pieces import side_by_side
from clrecon.system.progress import Progress
from clrecon.system.text import guess_word

_ANIMATIONS = (".mp4", ".webm", ".gif", ".apng")
"""Extensions of animations; a name without extension is a folder of PNG files."""

MOST_FRAMES = 10_000
"""Most frames: five minutes at 30 frames per second.  More are a typing error."""

_FASTEST = {".mp4": 120.0, ".webm": 120.0, ".gif": 50.0, ".apng": 120.0, "": 120.0}
"""Most frames per second.  GIF counts hundredths of a second; browsers slow down frames shorter than two."""

_SLOWEST = 0.1


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
    """Return the extension of an animation in lower case; empty for a folder: none, a final slash, or a folder."""
    text = os.fspath(path)
    is_folder = text.endswith(tuple(filter(None, (os.sep, os.altsep)))) or os.path.isdir(text)
    return "" if is_folder else os.path.splitext(text)[1].lower()


def check_animation(path: str | os.PathLike[str], fps: float = 25.0) -> str:
    """Refuse an animation that cannot be written, before a frame is computed; return its `animation_kind`."""
    try:
        text = os.fspath(path)
    except TypeError as error:
        raise UsageError(f"an animation is named by a string or a path, not {type(path).__name__}") from error
    if not text:
        raise UsageError("the name of the animation is empty")
    extension = animation_kind(text)
    if extension and extension not in _ANIMATIONS:
        raise UsageError(
            f"an animation is not written as {extension!r}{guess_word(extension, _ANIMATIONS)}: use one of"
            f" {', '.join(_ANIMATIONS)}, or a name without extension for a folder of PNG files"
        )
    if not isinstance(fps, (int, float)) or not _SLOWEST <= fps <= _FASTEST[extension]:
        kind = extension[1:].upper() or "a folder of frames"
        raise UsageError(f"{kind} takes {_SLOWEST:g} to {_FASTEST[extension]:g} frames a second, not {fps!r}")
    if extension in _ENCODERS:
        find_encoder(extension)
    if extension:
        check_writable(text)
    else:
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
    """Write frames as an animation, whole or not at all.

    Parameters
    ----------
    frames : iterable of Rendering or of ndarray, shape (h, w, 3) or (h, w, 4), uint8
        Frames of one size.  The next frame is requested after the one before has been written.
    path : str or path
        ``.mp4``, ``.webm``, ``.gif``, ``.apng``, or a folder: a name without extension, a name that ends with a slash,
        or an existing folder.  MP4 is H.264 and WebM VP9 (BT.709), an odd side made even by repeating its last row or
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
    with keep_existing(keep=no_clobber), stage_animation(frames, path, fps, total=total, progress=progress) as staged:
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
    """Write an animation under a temporary name; ``commit`` of the yielded object moves it to its place."""
    extension = check_animation(path, fps)
    checked = _checked_frames(frames, extension, total, progress)
    if extension == "":
        with stage_frame_folder(checked, path) as folder:
            yield folder
        return

    def write_all(stream: BinaryIO) -> None:
        if extension in _ENCODERS:
            write_video(stream, checked, fps, extension)
        else:
            (write_gif if extension == ".gif" else write_apng)(stream, checked, fps)

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
        shape = shape or image.shape
        if image.shape != shape:
            raise UsageError(f"frame {done} has shape {image.shape}, the frames before it {shape}")
        if extension in (*_ENCODERS, ".gif") and image.shape[2] == 4:
            if (image[..., 3] != 255).any():
                raise UsageError(
                    f"{extension[1:].upper()} cannot hold a transparent background: choose a background colour,"
                    " APNG or a folder of PNG files"
                )
            image = image[..., :3]
        yield np.array(image, order="C")  # a caller may draw the next frame into the same array
        done += 1
        if progress is not None:
            progress("frames", done, total)
    if done == 0:
        raise UsageError("an animation needs at least one frame")


_FRAME = re.compile(r"frame_[0-9]{4,}\.png")


def check_frame_folder(path: str | os.PathLike[str]) -> Path:
    """Return the folder that will be made or replaced, see `clrecon.system.files.check_folder`."""
    return check_folder(path, _FRAME, "frames")


@contextlib.contextmanager
def stage_frame_folder(frames: Iterator[NDArray[np.uint8]], path: str | os.PathLike[str]) -> Iterator[StagedFolder]:
    """Write frames (h, w, 3 or 4) as frame_0000.png, ... into a folder under a temporary name."""
    load_pillow()
    from PIL import Image

    folder = check_frame_folder(path)
    size = 0
    with contextlib.ExitStack() as stack:
        with system_errors(path):
            staged = stack.enter_context(temporary_folder(folder.parent))
            for number, frame in enumerate(frames):
                with open(staged / f"frame_{number:04d}.png", "xb") as stream:
                    Image.fromarray(frame).save(stream, "PNG")
                    stream.flush()
                    os.fsync(stream.fileno())
                    size += stream.tell()
            staged.chmod(final_mode(folder, 0o777))
        yield StagedFolder(path, staged, folder, size)


_REPEAT_FOR_EVER = b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


_LEAST_OF_PALETTE = 256
"""Pixels along the shorter side that choose the colours of a frame: all of 1024 x 1024 take 10 times as long, and the
dithered frame is as near to it: root of the mean square 0.90 for 0.91, 1.79 for 1.80, 1.64 for 1.62 of 255."""


def write_gif(stream: BinaryIO, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Write frames (h, w, 3), each with 256 colours of its own."""
    load_pillow()
    first = next(frames)
    height, width = first.shape[:2]
    stream.write(b"GIF89a" + struct.pack("<HHBBB", width, height, 0x70, 0, 0) + _REPEAT_FOR_EVER)
    shown = 0
    for number, (palette, blocks) in enumerate(_pack_frames(_gif_picture, chain([first], frames))):
        # Durations in hundredths of a second, rounded so that the total is right.
        delay = round(100.0 * (number + 1) / fps) - shown
        shown += delay
        bits = max(1, (len(palette) // 3 - 1).bit_length())
        palette = palette.ljust(3 << bits, b"\0")
        stream.write(b"\x21\xf9\x04" + struct.pack("<BHBB", 1 << 2, delay, 0, 0))
        stream.write(b"\x2c" + struct.pack("<HHHHB", 0, 0, width, height, 0x80 | (bits - 1)))
        stream.write(palette + blocks)
    stream.write(b"\x3b")


def _pack_frames(pack: Callable[[NDArray[np.uint8]], Any], frames: Iterator[NDArray[np.uint8]]) -> Iterator[Any]:
    """Yield what `pack` makes of each frame; the next one is drawn meanwhile."""
    frame = next(frames, None)
    while frame is not None:
        packed, frame = side_by_side(partial(pack, frame), partial(next, frames, None))
        yield packed


def _gif_picture(frame: NDArray[np.uint8]) -> tuple[bytes, bytes]:
    """Return the palette and the compressed pixels: everything after the last image descriptor of a one-picture GIF."""
    from PIL import Image

    step = max(1, min(frame.shape[:2]) // _LEAST_OF_PALETTE)
    best = Image.fromarray(frame[::step, ::step]).quantize(256, Image.Quantize.MEDIANCUT)
    dithered = Image.fromarray(frame).quantize(palette=best, dither=Image.Dither.FLOYDSTEINBERG)
    data = BytesIO()
    dithered.save(data, "GIF", optimize=False, interlace=False)
    content = data.getvalue()
    flags = content[10]
    position = 13
    palette = b""
    if flags & 0x80:
        palette = content[position : position + (3 << ((flags & 7) + 1))]
        position += len(palette)
    while content[position] == 0x21:  # extensions: a label, then blocks with their length, up to an empty block
        position += 2
        while content[position]:
            position += content[position] + 1
        position += 1
    assert content[position] == 0x2C and content[-1] == 0x3B
    local = content[position + 9]
    position += 10
    if local & 0x80:
        palette = content[position : position + (3 << ((local & 7) + 1))]
        position += len(palette)
    return palette, content[position:-1]


def write_apng(stream: BinaryIO, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Write frames (h, w, 3 or 4) without loss; `stream` must be seekable, as the number of frames comes first."""
    load_pillow()
    first = next(frames)
    height, width = first.shape[:2]
    numerator, denominator = (1, round(fps)) if fps == round(fps) else (1000, round(1000 * fps))
    if denominator > 0xFFFF:
        numerator, denominator = 100, round(100 * fps)
    written = sequence = control_at = 0
    packed = _pack_frames(lambda frame: list(_png_chunks(frame)), chain([first], frames))
    for written, chunks in enumerate(packed, start=1):
        if written == 1:
            stream.write(b"\x89PNG\r\n\x1a\n")
            _write_chunk(stream, *chunks[0])  # IHDR
            control_at = stream.tell()
            _write_chunk(stream, b"acTL", bytes(8))
        control = struct.pack(">IIIIIHHBB", sequence, width, height, 0, 0, numerator, denominator, 0, 0)
        _write_chunk(stream, b"fcTL", control)
        sequence += 1
        for kind, body in chunks:
            if kind == b"IDAT" and written == 1:
                _write_chunk(stream, kind, body)
            elif kind == b"IDAT":
                _write_chunk(stream, b"fdAT", struct.pack(">I", sequence) + body)
                sequence += 1
    _write_chunk(stream, b"IEND", b"")
    end = stream.tell()
    stream.seek(control_at)
    _write_chunk(stream, b"acTL", struct.pack(">II", written, 0))
    stream.seek(end)


def _png_chunks(frame: NDArray[np.uint8]) -> Iterator[tuple[bytes, bytes]]:
    from PIL import Image

    data = BytesIO()
    Image.fromarray(frame).save(data, "PNG")
    content = data.getvalue()
    position = 8
    while position < len(content):
        length, kind = struct.unpack_from(">I4s", content, position)
        yield kind, content[position + 8 : position + 8 + length]
        position += 12 + length


def _write_chunk(stream: BinaryIO, kind: bytes, body: bytes) -> None:
    stream.write(struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)))


_ENCODERS = {
    ".mp4": ("libx264", "H.264", ("-preset", "medium", "-crf", "18", "-movflags", "+faststart")),
    ".webm": ("libvpx-vp9", "VP9", ("-deadline", "good", "-cpu-used", "4", "-row-mt", "1", "-crf", "24", "-b:v", "0")),
}
"""Encoder of ffmpeg for a kind of video, its name, and its options: a quality at which the loss is not visible."""


@lru_cache(maxsize=2)
def find_encoder(extension: str = ".mp4") -> str:
    """Return the ffmpeg to call for a kind of video: that of imageio-ffmpeg, else the one on the PATH."""
    program, (encoder, name, _) = _find_ffmpeg(), _ENCODERS[extension]
    kind = extension[1:].upper()
    advice = f"{install_command('imageio-ffmpeg')}, or put an ffmpeg with {encoder} on the PATH"
    if program is None:
        raise UsageError(f"no encoder for {kind}: {advice}; GIF, APNG and a folder of PNG files need none")
    try:
        listed = subprocess.run([program, "-hide_banner", "-encoders"], capture_output=True, timeout=60).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise UsageError(f"{program} does not run ({error}): {advice}") from error
    if f" {encoder} ".encode() not in listed:
        raise UsageError(f"{program} has no {name} encoder ({encoder}): {advice}")
    return program


def _find_ffmpeg() -> str | None:
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # not installed, or installed without a program for this system
        return shutil.which("ffmpeg")


def write_video(stream: BinaryIO, frames: Iterator[NDArray[np.uint8]], fps: float, extension: str = ".mp4") -> None:
    """Encode frames (h, w, 3) and copy the finished file to a stream."""
    first = next(frames)
    height, width = first.shape[:2]
    with tempfile.TemporaryDirectory(prefix="clrecon-") as folder:
        video = Path(folder) / f"video{extension}"
        errors = Path(folder) / "errors.txt"
        command = _encoder_command(find_encoder(extension), (width + width % 2, height + height % 2), fps, video)
        with open(errors, "wb") as log, _start_encoder(command, log) as encoder:
            assert encoder.stdin is not None
            try:
                for frame in chain([first], frames):
                    encoder.stdin.write(np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge").data)
                encoder.stdin.close()
                code = encoder.wait()
            except BrokenPipeError:
                with contextlib.suppress(OSError):
                    encoder.stdin.close()
                code = encoder.wait() or 1
            except BaseException:
                encoder.kill()
                with contextlib.suppress(OSError):
                    encoder.stdin.close()
                raise
        if code != 0 or not video.exists():
            lines = errors.read_text(errors="replace").split("\n")
            last_line = next((line.strip() for line in reversed(lines) if line.strip()), f"exit code {code}")
            raise OutputError(f"the encoder of {extension[1:].upper()} failed: {last_line}")
        with open(video, "rb") as finished:
            shutil.copyfileobj(finished, stream, 1 << 20)


def _start_encoder(command: list[str], log: BinaryIO) -> subprocess.Popen[bytes]:
    # A session of its own: we handle Ctrl-C; otherwise the encoder would end first and we would see a broken pipe.
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log, start_new_session=os.name == "posix"
    )


def _encoder_command(program: str, size: tuple[int, int], fps: float, path: Path) -> list[str]:
    width, height = size
    encoder, _, options = _ENCODERS[path.suffix]
    # The colour matrix is both applied and named: ffmpeg's default is BT.601, but players assume BT.709 for large
    # pictures.
    colours = "scale=out_range=tv:out_color_matrix=bt709:flags=lanczos+accurate_rnd,format=yuv420p"
    return [
        *(program, "-hide_banner", "-loglevel", "error", "-nostdin", "-y"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6g}", "-i", "pipe:0"),
        *("-an", "-vf", colours, "-c:v", encoder, *options),
        *("-color_primaries", "bt709", "-color_trc", "bt709", "-colorspace", "bt709", "-color_range", "tv"),
        *("-fflags", "+bitexact", "-map_metadata", "-1", os.fspath(path)),
    ]
