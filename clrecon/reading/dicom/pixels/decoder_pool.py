"""Decoding of compressed frames in processes of their own, with limits on time and memory.

Each decoding thread gets a process (see `decoder_process`), which lives as long as the pool.  A process that crashes,
hangs or wants too much memory is ended, and the one file gets an error.  Nothing is ever decoded in this process
itself.  Frames and pixels go through pipes, so nothing is left behind when either side is killed.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.reading.dicom.pixels.decoder_process import DONE, FAILED, NO_DECODER, NO_MEMORY, READY, REPLY
from clrecon.system.base_classes import Closing
from clrecon.system.log import get_logger
from clrecon.system.text import escape_text

log = get_logger(__name__)

SCRIPT = Path(__file__).with_name("decoder_process.py")

_START_SECONDS = 120.0
_FRAME_SECONDS = 60.0
_SECONDS_PER_MIB = 1.0
"""Limit of a frame: `_FRAME_SECONDS`, and this much more for each MiB of its pixels, a hundred times the usual time."""

_STOPPED_SECONDS = 2.0
"""When this process stood still longer (Ctrl-Z, a sleeping laptop), the decoders did too, and their time starts
again."""

_FRAME_MEMORY_BYTES = 256 * 2**20
_MEMORY_PER_PIXEL_BYTE = 32
"""Memory limit of a decoder: `_FRAME_MEMORY_BYTES`, and this much more for each byte of pixels; OpenJPEG takes 10."""

_ENVIRONMENT = {
    # One thread each: there are as many processes as cores, and each idle thread costs memory and time.
    **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"),
    # Memory of one frame is kept for the next (glibc): returning it each time takes longer than decoding RLE.
    **dict.fromkeys(("MALLOC_MMAP_THRESHOLD_", "MALLOC_TRIM_THRESHOLD_"), str(1 << 28)),
    "MALLOC_TOP_PAD_": str(1 << 24),
}

_ERROR_TEXT_BYTES = 1000
_OUT_OF_TIME = tuple(getattr(signal, name, None) for name in ("SIGXCPU", "SIGALRM"))


class DecoderError(RefusedInputError):
    """A frame that cannot be decoded, or no process to decode it in.  The message names no file."""


class DecoderPool(Closing):
    """Processes that decode frames of one size; a context manager, safe to use from several threads at once.

    decoders: Names of `decoder_process.DECODERS` that will be asked for, or MODULE:FUNCTION.
    seconds, memory_bytes: Limits for one frame; by default they grow with the bytes of its pixels.  The limit on memory
        holds where RLIMIT_AS does (Linux); Windows and macOS have the limit on time alone.
    """

    def __init__(
        self, decoders: list[str], frame_bytes: int, *, seconds: float | None = None, memory_bytes: int | None = None
    ):
        mebibytes = frame_bytes / 2**20
        self.seconds = _FRAME_SECONDS + _SECONDS_PER_MIB * mebibytes if seconds is None else seconds
        self.memory_bytes = (
            _FRAME_MEMORY_BYTES + _MEMORY_PER_PIXEL_BYTE * frame_bytes if memory_bytes is None else memory_bytes
        )
        self._decoders = decoders
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._workers: list[_Worker] = []
        self._idle: list[_Worker] = []
        self._watchdog: threading.Thread | None = None

    def decode(self, data: bytes, decoder: str, out: NDArray[Any]) -> None:
        """Decode one codestream into `out` (rows, columns), C-contiguous and of the type that the decoder returns."""
        request = {
            "decoder": decoder,
            "length": len(data),
            "rows": out.shape[0],
            "columns": out.shape[1],
            "dtype": out.dtype.str,
        }
        worker = self._take()
        try:
            status, text = worker.ask(request, data, out, self.seconds)
        except _WorkerEndedError:
            raise DecoderError(self._bury(worker)) from None
        except BaseException:
            self._bury(worker)
            raise
        with self._lock:
            if not worker.overdue:
                self._idle.append(worker)
        if worker.overdue:  # the frame arrived at the moment its time was over
            self._bury(worker)
        if status == NO_MEMORY:
            raise DecoderError(f"need more than {self.memory_bytes // 2**20} MiB of memory to decode")
        if status != DONE:
            raise DecoderError(f"do not decode ({text})")

    def kill(self) -> None:
        """End all processes at once; frames that are being decoded in other threads raise errors."""
        self._stopping.set()
        with self._lock:
            workers = list(self._workers)
        for worker in workers:
            worker.process.kill()

    def close(self) -> None:
        self._stopping.set()
        with self._lock:
            workers = self._workers
            self._workers, self._idle = [], []
        for worker in workers:
            # It has no state to lose, and a process that was forked meanwhile may keep its input open.
            worker.process.kill()
        for worker in workers:
            worker.wait()
        if self._watchdog is not None:
            self._watchdog.join()
            self._watchdog = None

    def process_ids(self) -> list[int]:
        """Ids of the processes that are alive."""
        with self._lock:
            return [worker.process.pid for worker in self._workers]

    def _take(self) -> _Worker:
        with self._lock:
            if self._stopping.is_set():
                raise DecoderError("are not decoded: reading was stopped")
            if self._idle:
                return self._idle.pop()
            if self._watchdog is None:
                self._watchdog = threading.Thread(target=self._watch, name="decoder watchdog", daemon=True)
                self._watchdog.start()
            worker = _Worker(self._decoders, self.seconds, self.memory_bytes)
            self._workers.append(worker)
            return worker

    def _watch(self) -> None:
        """End processes that take too long: this works on every system and with every decoder."""
        interval, before = min(0.5, self.seconds / 4), time.monotonic()
        while not self._stopping.wait(interval):
            now = time.monotonic()
            stopped = now - before - interval
            with self._lock:
                for worker in self._workers:
                    if stopped > _STOPPED_SECONDS:
                        worker.deadline += stopped
                    elif worker.deadline < now:
                        worker.overdue = True
                        worker.process.kill()
            before = now

    def _bury(self, worker: _Worker) -> str:
        """Remove a dead or useless process from the pool; return what happened to it."""
        ended_itself = worker.wait()
        with self._lock:
            if worker in self._workers:
                self._workers.remove(worker)
        code = worker.process.returncode
        if self._stopping.is_set():
            return "are not decoded: reading was stopped"
        if not worker.ready:
            return (
                "cannot be decoded: the process for it does not start "
                f"({worker.why or f'exit code {code}'}); uncompressed images need none"
            )
        log.info("a decoder process was given up with exit code %s", code)
        if worker.overdue or -code in _OUT_OF_TIME:
            return f"take longer than {self.seconds:g} s to decode"
        if not ended_itself:
            return "do not decode (wrong answer of the decoder)"
        return f"crash the decoder ({f'signal {-code}' if code < 0 else f'exit code {code}'})"


class _WorkerEndedError(Exception):
    """The process has ended, or its answers make it useless."""


class _Worker:
    """One process and its pipes; used by one thread at a time."""

    def __init__(self, decoders: list[str], seconds: float, memory_bytes: int):
        self.ready = False
        self.overdue = False
        self.why = ""
        self.deadline = time.monotonic() + _START_SECONDS
        if getattr(sys, "frozen", False) or not sys.executable:
            raise DecoderError("cannot be decoded: that needs a Python interpreter to start, and this program has none")
        with ExitStack() as theirs, ExitStack() as ours:
            requests, self._input = _open_pipe(theirs, ours)
            self._output, replies = _open_pipe(ours, theirs)
            number = -1
            if sys.platform.startswith("linux"):
                # We hold the other end of this pipe: the system tells the process when we have ended (see `end_with`).
                number = _open_pipe(theirs, ours)[0].fileno()
            try:
                self.process = subprocess.Popen(
                    [sys.executable, "-I", "-S", str(SCRIPT), str(number)],
                    stdin=requests,
                    stdout=replies,
                    stderr=subprocess.DEVNULL,
                    pass_fds=[number] if number >= 0 else [],
                    env={**os.environ, **_ENVIRONMENT},
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )
            except OSError as error:
                raise DecoderError(
                    f"cannot be decoded: no process can be started for it ({error.strerror or error}); "
                    "uncompressed images need none"
                ) from error
            self._ours = ours.pop_all()
        path = _find_modules()
        self._settings = {"path": path, "decoders": decoders, "seconds": seconds, "memory_bytes": memory_bytes}

    def ask(self, request: dict[str, Any], data: bytes, out: NDArray[Any], seconds: float) -> tuple[int, str]:
        """Have one frame decoded into `out`; return the status and, if it is not `DONE`, a text."""
        try:
            if not self.ready:
                self._write(json.dumps(self._settings).encode() + b"\n")
                status, count = self._read_reply()
                if status != READY:
                    self.why = self._read_text(count) if status == NO_DECODER else ""
                    raise _WorkerEndedError
                self.ready = True
            self.deadline = time.monotonic() + seconds
            self._write(json.dumps(request).encode() + b"\n")
            self._write(data)
            status, count = self._read_reply()
            if status == DONE and count == out.nbytes:
                self._read_into(out.data.cast("B"))
                text = ""
            elif status in (FAILED, NO_MEMORY):
                text = self._read_text(count)
            else:
                raise _WorkerEndedError
        except OSError as error:
            raise _WorkerEndedError from error
        self.deadline = float("inf")
        return status, text

    def wait(self) -> bool:
        """Wait for the end of the process and close the pipes; False when it took long and had to be killed."""
        self._input.close()
        try:
            self.process.wait(2.0)
            ended_itself = not self.overdue
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            ended_itself = False
        self._ours.close()
        return ended_itself

    def _write(self, data: bytes) -> None:
        part = memoryview(data)
        while part:
            part = part[self._input.write(part) :]

    def _read_into(self, target: memoryview) -> None:
        done = 0
        while done < len(target):
            count = self._output.readinto(target[done:])  # type: ignore[attr-defined]  # raw, as bufsize is 0
            if not count:
                raise _WorkerEndedError
            done += count

    def _read_reply(self) -> tuple[int, int]:
        head = bytearray(struct.calcsize(REPLY))
        self._read_into(memoryview(head))
        return struct.unpack(REPLY, head)  # type: ignore[return-value]

    def _read_text(self, count: int) -> str:
        if count > _ERROR_TEXT_BYTES:
            raise _WorkerEndedError
        text = bytearray(count)
        self._read_into(memoryview(text))
        return escape_text(text.decode("ascii", "replace"), 120)


def _open_pipe(reader: ExitStack, writer: ExitStack) -> tuple[FileIO, FileIO]:
    """Open a pipe whose descriptors are above 2, even if the program has closed its standard streams."""
    numbers = os.pipe()
    read, write = (open(_lift(number), mode, 0) for number, mode in zip(numbers, ("rb", "wb"), strict=True))
    return reader.enter_context(read), writer.enter_context(write)  # type: ignore[arg-type, return-value]


def _lift(number: int) -> int:
    if number > 2 or sys.platform == "win32":
        return number
    import fcntl

    lifted = fcntl.fcntl(number, fcntl.F_DUPFD_CLOEXEC, 3)
    os.close(number)
    return lifted


def _find_modules() -> list[str]:
    """Return where the process looks for modules: not in the current folder, which may hold any, if without numpy."""
    try:
        here = {os.getcwd()} - {str(Path(np.__file__).parents[1])}
    except OSError:
        here = set()  # the folder was deleted
    return [entry for entry in sys.path if isinstance(entry, str) and os.path.isabs(entry) and entry not in here]
