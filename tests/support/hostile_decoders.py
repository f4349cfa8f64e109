"""Decoders that do what hostile bytes make real ones do; `decoder_process` takes them by MODULE:FUNCTION."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import numpy as np


def copy(data: bytes, request: Any) -> Any:
    """The bytes are the pixels."""
    return np.frombuffer(data, request["dtype"]).reshape(request["rows"], request["columns"])


def nap(data: bytes, request: Any) -> Any:
    """As `copy`, after a second."""
    time.sleep(1.0)
    return copy(data, request)


def crash(data: bytes, request: Any) -> Any:
    os.kill(os.getpid(), signal.SIGSEGV)
    time.sleep(60)


def leave(data: bytes, request: Any) -> Any:
    os._exit(7)


def hang(data: bytes, request: Any) -> Any:
    """In C code, with the interpreter's lock held: no Python of that process runs meanwhile."""
    sum(range(10**18))


def allocate(data: bytes, request: Any) -> Any:
    held = []
    while True:
        held.append(np.ones(1 << 20))


def give_another_shape(data: bytes, request: Any) -> Any:
    return np.zeros((request["rows"] + 1, request["columns"]), request["dtype"])


def fail(data: bytes, request: Any) -> Any:
    raise ValueError("no such\nmarker \x1b[31m")


def print_much(data: bytes, request: Any) -> Any:
    print("noise" * 100_000, flush=True)
    os.write(1, b"noise" * 1000)
    os.write(2, b"noise" * 1000)
    return copy(data, request)


def list_handles(data: bytes, request: Any) -> Any:
    """Numbers of the open files, in the first pixels."""
    pixels = np.zeros((request["rows"], request["columns"]), request["dtype"])
    handles = [int(name) for name in os.listdir("/proc/self/fd")]
    pixels.flat[: len(handles)] = handles
    return pixels
