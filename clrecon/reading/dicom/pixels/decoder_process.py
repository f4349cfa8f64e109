"""The process that decodes compressed frames.  `decoder_pool` runs this file as a script; clrecon never imports it.

Decoders are C code that may get malicious bytes.  Here they may crash, hang or ask for all memory, and only this
process ends.  It imports numpy and the decoders in use, not clrecon and not pydicom, and starts in a tenth of a second.

Standard input starts with one line of JSON with settings.  Then come requests: a line of JSON, followed by the number
of bytes of the compressed frame that it states.  For each request, standard output gets a status, a count and that many
bytes: the pixels in C order, or a text with the error.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import struct
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, BinaryIO

REPLY = "<BQ"
"""Format of a reply's head: status, and number of bytes that follow."""

READY, DONE, FAILED, NO_MEMORY, NO_DECODER = range(5)

_SIZE_WITHOUT_PROC = 1 << 30
"""Address space, in bytes, that is assumed to be in use where the system does not tell: more than the imports need."""

Decoder = Callable[[bytes, dict[str, Any]], Any]


def decode_by_openjpeg(data: bytes, request: dict[str, Any]) -> Any:
    """Decode JPEG 2000, High-Throughput JPEG 2000 too."""
    from openjpeg import decode

    return decode(data, 0)


def decode_by_imagecodecs(function: str, data: bytes, request: dict[str, Any]) -> Any:
    """Decode what one function of imagecodecs does: `jpeg8_decode` JPEG lossless, by libjpeg-turbo."""
    import imagecodecs

    return getattr(imagecodecs, function)(data)


def decode_by_jpeg_ls(data: bytes, request: dict[str, Any]) -> Any:
    import numpy as np
    from jpeg_ls import decode_pixel_data

    pixels, info = decode_pixel_data(data)
    width = 1 if info["bits_per_sample"] <= 8 else 2
    return np.frombuffer(pixels, f"<u{width}").reshape(info["height"], info["width"])


def decode_by_rle(data: bytes, request: dict[str, Any]) -> Any:
    """Decode DICOM's own run length encoding."""
    import numpy as np
    from rle.rle import decode_frame

    bits = 8 * np.dtype(request["dtype"]).itemsize
    pixels = decode_frame(data, request["rows"] * request["columns"], bits, "<")
    return np.frombuffer(pixels, f"<u{bits // 8}").reshape(request["rows"], request["columns"])


# Decoders import at the start: before memory is limited, and where a missing package can be reported.
DECODERS: dict[str, tuple[Decoder, tuple[str, ...]]] = {
    "openjpeg": (decode_by_openjpeg, ("openjpeg",)),
    "jpeg_ls": (decode_by_jpeg_ls, ("jpeg_ls",)),
    "rle": (decode_by_rle, ("rle.rle",)),
    "imagecodecs jpeg": (partial(decode_by_imagecodecs, "jpeg8_decode"), ("imagecodecs", "imagecodecs._jpeg8")),
    "imagecodecs jpeg_ls": (partial(decode_by_imagecodecs, "jpegls_decode"), ("imagecodecs", "imagecodecs._jpegls")),
    "imagecodecs jpeg_2000": (partial(decode_by_imagecodecs, "jpeg2k_decode"), ("imagecodecs", "imagecodecs._jpeg2k")),
}


def load_decoder(name: str) -> Decoder:
    """Find a decoder by its name, or by MODULE:FUNCTION, and import the packages that it needs."""
    if ":" in name:
        module, _, function = name.partition(":")
        return getattr(importlib.import_module(module), function)
    decoder, modules = DECODERS[name]
    for module in ("numpy", *modules):
        importlib.import_module(module)
    return decoder


def take_standard_output() -> BinaryIO:
    """Move standard output to another descriptor and return it; output that decoders print is discarded."""
    sink = os.fdopen(os.dup(1), "wb", buffering=0)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    return sink


def send(sink: BinaryIO, status: int, body: Any = b"") -> None:
    body = memoryview(body).cast("B")
    for part in (memoryview(struct.pack(REPLY, status, len(body))), body):
        done = 0
        while done < len(part):
            done += sink.write(part[done:])


def limit_memory(more_bytes: int) -> None:
    """Allow `more_bytes` of address space beyond the use after the imports, and no core files, where the system can."""
    try:
        import resource
    except ImportError:
        return  # Windows
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            used = int(file.read().split()[0]) * resource.getpagesize()
    except OSError:
        used = _SIZE_WITHOUT_PROC
    for resource_kind, limit in ((resource.RLIMIT_CORE, 0), (resource.RLIMIT_AS, used + more_bytes)):
        try:
            resource.setrlimit(resource_kind, (limit, limit))
        except (OSError, ValueError):
            pass  # a stricter limit is set, or the system (macOS) does not know this one


def limit_time(seconds: float, orphan: bool) -> None:
    """End this process when the next frame takes too long, as the parent does; an orphan by the wall clock too."""
    try:
        import resource
    except ImportError:
        return
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    soft = int(time.process_time() + seconds) + 2
    if hard == resource.RLIM_INFINITY or soft < hard:
        resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))
    if orphan:
        signal.alarm(int(seconds) + 5)


def end_with(lifeline: int) -> None:
    """Let the system end this process (SIGIO, else the alarm), even in a decoder, when its parent closes the pipe."""
    if lifeline < 0:
        return
    import fcntl
    import select

    fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(lifeline, fcntl.F_SETFL, fcntl.fcntl(lifeline, fcntl.F_GETFL) | os.O_ASYNC)
    poll = select.poll()
    poll.register(lifeline)
    if poll.poll(0):
        os._exit(1)  # it ended before we asked


def answer(decoder: Decoder, data: bytes, request: dict[str, Any]) -> tuple[int, Any]:
    """Decode one frame; return the status of the reply and its body."""
    import numpy as np

    expected = np.dtype(request["dtype"])
    try:
        frame = np.asarray(decoder(data, request))
        if frame.shape != (request["rows"], request["columns"]) or frame.dtype.itemsize != expected.itemsize:
            return FAILED, f"an image of shape {frame.shape}, {frame.dtype.name}".encode()
        return DONE, np.ascontiguousarray(frame, frame.dtype.newbyteorder("<")).view(expected)
    except MemoryError:
        return NO_MEMORY, b""
    except Exception as error:
        # Decoders raise any error on malicious bytes; each means that this frame cannot be decoded.
        return FAILED, f"{type(error).__name__}: {error}".encode("ascii", "replace")[:200]


def main() -> None:
    """Answer requests until standard input ends."""
    if hasattr(signal, "SIGINT"):
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all processes; the parent decides
    lifeline = int(sys.argv[1])
    end_with(lifeline)
    source, sink = sys.stdin.buffer, take_standard_output()
    settings = json.loads(source.readline() or b"null")
    if settings is None:
        return
    sys.path[:] = settings["path"]
    try:
        decoders = {name: load_decoder(name) for name in settings["decoders"]}
    except Exception as error:
        send(sink, NO_DECODER, f"{type(error).__name__}: {error}".encode("ascii", "replace")[:200])
        return
    limit_memory(settings["memory_bytes"])
    send(sink, READY)
    while line := source.readline():
        request = json.loads(line)
        data = source.read(request["length"])
        if len(data) < request["length"]:
            return
        limit_time(settings["seconds"], lifeline < 0)
        status, body = answer(decoders[request["decoder"]], data, request)
        if hasattr(signal, "alarm"):
            signal.alarm(0)  # the next frame may take long to arrive
        send(sink, status, body)
        del data, body


if __name__ == "__main__":
    try:
        main()
    except BrokenPipeError:
        pass  # the parent has ended
    os._exit(0)
