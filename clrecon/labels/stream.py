"""Whole numbers out of a stream of bytes, slice by slice, within the memory that the file can account for.

Headers are written by strangers: a small file may promise a huge array.  Nothing is taken before the promise was
compared with the bytes that are there, and what is compressed is inflated one slice at a time.
"""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Iterator
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from clrecon.dicom.text import escape_text
from clrecon.errors import RefusedInputError
from clrecon.labels.label_map import LARGEST_NUMBER

__all__ = ["LARGEST_GRID", "check_size", "empty_labels", "iterate_slices", "read_bytes", "show_name"]

DEFLATE_RATIO = 1032
"""Deflate cannot shrink anything further than this (zlib's technical note)."""

LARGEST_GRID = 2**32
"""Voxels; 1000 slices of 2048 x 2048."""

LARGEST_SLICE_BYTES = 2**28
"""As they are stored: slices are inflated one at a time."""


def show_name(path: Path) -> str:
    """The name of a file for messages."""
    return escape_text(path.name)


def check_size(name: str, shape: tuple[int, ...], item_bytes: int, file_bytes: int, compressed: bool) -> None:
    """Compare what a header promises with what the file can hold.

    Parameters
    ----------
    name : str
        Of the file.
    shape : tuple of int
    item_bytes : int
        Bytes a number.
    file_bytes : int
        Size of the file.
    compressed : bool
        The data are deflated.

    Raises
    ------
    RefusedInputError
        The sizes are impossible.
    """
    if min(shape) < 1 or prod(shape) > LARGEST_GRID:
        raise RefusedInputError(
            f"{name} says that it has {' x '.join(map(str, shape))} voxels: at least 1 an axis and at most"
            f" {LARGEST_GRID:,} altogether are read"
        )
    if prod(shape[:-1]) * item_bytes > LARGEST_SLICE_BYTES:
        raise RefusedInputError(
            f"{name} says that a slice has {' x '.join(map(str, shape[:-1]))} numbers of {item_bytes} bytes: at most"
            f" {LARGEST_SLICE_BYTES:,} bytes are read"
        )
    promised = prod(shape) * item_bytes
    possible = file_bytes * (DEFLATE_RATIO if compressed else 1)
    if promised > possible:
        raise RefusedInputError(
            f"{name} is cut or corrupt: {' x '.join(map(str, shape))} numbers of {item_bytes} bytes cannot come from"
            f" a file of {file_bytes:,} bytes"
        )


def empty_labels(name: str, shape: tuple[int, int, int]) -> NDArray[np.uint16]:
    """Zeros of `shape` that take memory where something else is written, or a refusal where there is none for them."""
    size = 2 * prod(shape)
    try:
        if size <= physical_memory_bytes():
            return np.zeros(shape, dtype=np.uint16)
    except MemoryError:
        pass
    raise RefusedInputError(
        f"{name} has {' x '.join(map(str, shape[::-1]))} voxels: {size / 2**30:,.1f} GiB, more memory than there is"
    )


def physical_memory_bytes() -> float:
    """Memory of this computer, infinite where the system does not tell."""
    try:
        return float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows
        return math.inf


def read_bytes(stream: BinaryIO, count: int, name: str, where: str) -> bytes:
    """Exactly `count` bytes of a stream, which may be compressed.

    Raises
    ------
    RefusedInputError
        The stream ends before, or is corrupt.
    """
    parts, missing = [], count
    try:
        while missing > 0:
            part = stream.read(missing)
            if not part:
                raise RefusedInputError(f"{name} is cut: it ends in {where}, {missing:,} bytes before its end")
            parts.append(part)
            missing -= len(part)
    except (EOFError, zlib.error, OSError) as error:
        raise RefusedInputError(f"{name} is cut or corrupt in {where}: {escape_text(str(error))}") from error
    return b"".join(parts)


def check_end(stream: BinaryIO, name: str) -> None:
    """Read to the end of compressed data, where their checksum is."""
    try:
        stream.read(1)
    except (EOFError, zlib.error, OSError) as error:
        raise RefusedInputError(f"{name} is cut or corrupt at its end: {escape_text(str(error))}") from error


def iterate_slices(
    stream: BinaryIO, count: int, items: int, dtype: np.dtype[Any], scale: tuple[float, float], name: str
) -> Iterator[NDArray[Any]]:
    """Yield `count` slices of `items` label numbers each, flat.

    Parameters
    ----------
    stream : file
    count, items : int
    dtype : dtype
        As stored: integers, or floats that hold whole numbers.
    scale : (float, float)
        Slope and intercept of the stored numbers.
    name : str
        Of the file, for messages.

    Raises
    ------
    RefusedInputError
        The data end early, or hold fractions, negative or too large numbers; the slice is named.
    """
    for k in range(count):
        where = f"slice {k + 1} of {count}"
        stored = np.frombuffer(read_bytes(stream, items * dtype.itemsize, name, where), dtype=dtype)
        if scale != (1.0, 0.0):
            stored = stored * scale[0] + scale[1]
        yield _as_labels(stored, name, where)
    check_end(stream, name)


def _as_labels(stored: NDArray[Any], name: str, where: str) -> NDArray[Any]:
    if stored.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            broken = ~(stored == np.floor(stored))  # NaN and infinity among them: infinity is caught below
        if broken.any():
            raise RefusedInputError(
                f"{name} is not a label map: {where} holds {float(stored[broken][0]):g}; labels are whole numbers,"
                " probabilities and CT images are not"
            )
    low, high = float(stored.min()), float(stored.max())
    if low < 0 or high > LARGEST_NUMBER:
        raise RefusedInputError(
            f"{name} is not a label map that can be read: {where} holds {low if low < 0 else high:g};"
            f" labels run from 0 to {LARGEST_NUMBER:,}"
        )
    return stored.astype(np.uint16)
