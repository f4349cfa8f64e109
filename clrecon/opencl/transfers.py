"""Large transfers between numpy's memory and a device with memory of its own: in pinned pieces, that threads fill.

Only pinned memory moves at the speed of the bus, and the driver copies all else through some of its own with one
thread: on an H200, 55 GB/s against 7 up and 13 down, and 1.3 where a buffer is made with its contents.  So clrecon
keeps a few pinned pieces for each opened device.  The transfer of one goes on while threads copy the next."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.opencl.buffers import raw
from clrecon.opencl.device import Command, Device
from clrecon.opencl.launching import wait_for
from clrecon.opencl.quirks import import_pyopencl

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

PIECE_BYTES = 4 << 20
"""A piece is long enough that its transfer hides the start of the next one."""

PIECES = 16
"""Most pieces of a device; they are made as they are needed, at 0.4 ms for a MiB."""

_IN_TRANSFER = 3
"""Pieces on the bus; the others are those that threads copy."""

LEAST_BYTES = 1 << 20
"""Smaller transfers are left to the driver, and smaller arrays copied even if the device could use them in place."""

MOST_THREADS = 8


@cache
def _threads() -> ThreadPoolExecutor:
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(min(MOST_THREADS, os.cpu_count() or 1), thread_name_prefix="clrecon copying")


class _Piece:
    """A pinned piece, with what uses it at the moment: a transfer, or a thread that copies."""

    def __init__(self, device: Device):
        cl = import_pyopencl()
        flags, mode = cl.mem_flags, cl.map_flags.READ | cl.map_flags.WRITE
        self.buffer = cl.Buffer(device.context, flags.READ_WRITE | flags.ALLOC_HOST_PTR, PIECE_BYTES)
        self.memory, _ = cl.enqueue_map_buffer(device.queue, self.buffer, mode, 0, (PIECE_BYTES,), np.uint8)
        self.command: Command | None = None
        self.copying: Future[None] | None = None
        self.is_taken = False  # its contents are still to be sent, or to be copied out

    @property
    def is_free(self) -> bool:
        """True where `free` would not wait."""
        is_copied = self.copying is None or self.copying.done()
        return is_copied and not self.is_taken and (self.command is None or not self.command.is_running)

    def free(self, device: Device) -> _Piece:
        """Wait until nothing uses the piece, and return it."""
        if self.command is not None:
            wait_for(device, self.command)
        if self.copying is not None:
            self.copying.result()
        self.command = self.copying = None
        return self


class PinnedPieces:
    """The pieces of an opened device; one transfer at a time uses them."""

    def __init__(self, device: Device):
        self._device = device
        self._pieces: deque[_Piece] = deque()
        self.lock = threading.Lock()

    def take(self) -> _Piece:
        """Return a piece that nothing uses: the one that was taken longest ago, or a new one before waiting for it."""
        if self._pieces and (len(self._pieces) == PIECES or self._pieces[0].is_free):
            self._pieces.rotate(-1)
        else:
            self._pieces.append(_Piece(self._device))
        piece = self._pieces[-1].free(self._device)
        piece.is_taken = True
        return piece

    def finish(self) -> None:
        """Wait until nothing uses any of them."""
        for piece in self._pieces:
            piece.free(self._device)


def _bytes_of(array: NDArray[Any]) -> NDArray[np.uint8]:
    return array.reshape(-1).view(np.uint8)


def _ranges(size: int) -> Iterator[tuple[int, int]]:
    for start in range(0, size, PIECE_BYTES):
        yield start, min(start + PIECE_BYTES, size)


Landed = Callable[[Any, int], None]
"""Called with a buffer and with how many of its bytes are there for all commands that follow."""


def write_buffer(device: Device, array: NDArray[Any], array_d: Any, landed: Landed | None = None) -> None:
    """Copy a C-contiguous array into a buffer, for all later commands; the array may change afterwards.

    landed: Called after each of several pieces, so that kernels work while the next pieces come.
    """
    cl = import_pyopencl()
    source, action = _bytes_of(array), f"the transfer of {array.nbytes:,} bytes to the device"
    if array.nbytes < LEAST_BYTES:
        source = source.copy()
        with device.lock:
            event = cl.enqueue_copy(device.queue, raw(array_d), source, is_blocking=False)
            device.commands.add(action, event, device.queue, array_d, source)
        return
    pinned = device.of_context(PinnedPieces)
    filling: deque[tuple[_Piece, int, int]] = deque()

    def send() -> None:
        piece, start, end = filling.popleft()
        assert piece.copying is not None
        piece.copying.result()
        with device.lock:
            queue = device.queue
            event = cl.enqueue_copy(
                queue, raw(array_d), piece.memory[: end - start], dst_offset=start, is_blocking=False
            )
            piece.command = device.commands.add(action, event, queue, array_d, piece)
        piece.is_taken = False
        queue.flush()
        if landed is not None:
            landed(array_d, end)

    with pinned.lock:
        for start, end in _ranges(source.nbytes):
            if len(filling) == PIECES - _IN_TRANSFER:
                send()
            piece = pinned.take()
            piece.copying = _threads().submit(np.copyto, piece.memory[: end - start], source[start:end])
            filling.append((piece, start, end))
            while filling and filling[0][0].copying.done():  # type: ignore[union-attr]
                send()
        while filling:
            send()


def read_buffers(device: Device, wanted: Sequence[tuple[NDArray[Any], Any, int]]) -> None:
    """Fill C-contiguous arrays from buffers, each from a byte on, and wait until all are there."""
    cl = import_pyopencl()
    pinned = device.of_context(PinnedPieces)
    coming: deque[tuple[_Piece, NDArray[np.uint8]]] = deque()

    def take_out() -> None:
        piece, target = coming.popleft()
        assert piece.command is not None
        wait_for(device, piece.command)
        piece.copying = _threads().submit(np.copyto, target, piece.memory[: target.nbytes])
        piece.is_taken = False

    with pinned.lock:
        for array, array_d, offset in wanted:
            target, action = _bytes_of(array), f"the transfer of {array.nbytes:,} bytes to the computer"
            for start, end in _ranges(array.nbytes):
                if len(coming) == _IN_TRANSFER:
                    take_out()
                piece = pinned.take()
                with device.lock:
                    queue = device.queue
                    event = cl.enqueue_copy(
                        queue, piece.memory[: end - start], raw(array_d), src_offset=offset + start, is_blocking=False
                    )
                    piece.command = device.commands.add(action, event, queue, array_d, piece)
                queue.flush()
                coming.append((piece, target[start:end]))
        while coming:
            take_out()
        pinned.finish()
