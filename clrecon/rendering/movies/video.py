"""MP4 by the program ffmpeg: it gets frames through a pipe, and writes the file to a temporary folder.

Every browser and every slide program plays H.264 in yuv420p.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, UsageError
from clrecon.system.packages import install_command

QUALITY = 18
"""x264's constant rate factor; at 18 the loss is not visible."""


@lru_cache(maxsize=1)
def find_encoder() -> str:
    """Return the ffmpeg to call: that of imageio-ffmpeg, else the one on the PATH."""
    program = _find_ffmpeg()
    if program is None:
        raise UsageError(f"no encoder for MP4: {_advice()}; GIF, APNG and a folder of PNG files need none")
    try:
        listed = subprocess.run([program, "-hide_banner", "-encoders"], capture_output=True, timeout=60).stdout
    except (OSError, subprocess.SubprocessError) as error:
        raise UsageError(f"{program} does not run ({error}): {_advice()}") from error
    if b" libx264 " not in listed:
        raise UsageError(f"{program} has no H.264 encoder (libx264): {_advice()}")
    return program


def _advice() -> str:
    return f"{install_command('imageio-ffmpeg')}, or put an ffmpeg with libx264 on the PATH"


def _find_ffmpeg() -> str | None:
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):  # not installed, or installed without a program for this system
        return shutil.which("ffmpeg")


def write_video(stream: BinaryIO, frames: Iterator[NDArray[np.uint8]], fps: float) -> None:
    """Encode frames (h, w, 3) and copy the finished file to a stream."""
    first = next(frames)
    height, width = first.shape[:2]
    with tempfile.TemporaryDirectory(prefix="clrecon-") as folder:
        made = Path(folder) / "video.mp4"
        errors = Path(folder) / "errors.txt"
        command = _command(find_encoder(), (width + width % 2, height + height % 2), fps, made)
        with open(errors, "wb") as log, _start(command, log) as encoder:
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
        if code != 0 or not made.exists():
            lines = errors.read_text(errors="replace").split("\n")
            said = next((line.strip() for line in reversed(lines) if line.strip()), f"exit code {code}")
            raise OutputError(f"the encoder of MP4 failed: {said}")
        with open(made, "rb") as finished:
            shutil.copyfileobj(finished, stream, 1 << 20)


def _start(command: list[str], log: BinaryIO) -> subprocess.Popen[bytes]:
    # A session of its own: we handle Ctrl-C; otherwise the encoder would end first and we would see a broken pipe.
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log, start_new_session=os.name == "posix"
    )


def _command(program: str, size: tuple[int, int], fps: float, path: Path) -> list[str]:
    width, height = size
    # The colour matrix is both applied and named: ffmpeg's default is BT.601, but players assume BT.709 for large
    # pictures.
    colours = "scale=out_range=tv:out_color_matrix=bt709:flags=lanczos+accurate_rnd,format=yuv420p"
    return [
        *(program, "-hide_banner", "-loglevel", "error", "-nostdin", "-y"),
        *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6g}", "-i", "pipe:0"),
        *("-an", "-vf", colours, "-c:v", "libx264", "-preset", "medium", "-crf", str(QUALITY)),
        *("-color_primaries", "bt709", "-color_trc", "bt709", "-colorspace", "bt709", "-color_range", "tv"),
        *("-movflags", "+faststart", "-fflags", "+bitexact", "-map_metadata", "-1", os.fspath(path)),
    ]
