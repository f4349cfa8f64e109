"""`GridFile`: the header of a file in our words and frame (LPS), and its numbers as a stream, slice by slice.

A header may be wrong or hostile: a small file can promise a huge array, or name any file of the machine.  The promised
size is compared with the bytes that are there before memory is taken, and voxels are inflated slice by slice.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import prod
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, BinaryIO, Protocol, cast

import numpy as np
from isal import igzip, igzip_threaded, isal_zlib
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry.affine import Float64Array
from clrecon.reading.common.selection import Rescale
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.packages import import_package
from clrecon.system.paths import open_regular
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text

_DEFLATE_RATIO = 1032
"""Highest compression ratio of Deflate (zlib's technical note)."""

_LARGEST_GRID = 2**36
"""Most voxels of a grid: 4096 slices of 4096 x 4096."""

_SCAN_RATIO = 100
"""Highest compression ratio of scans, whose air packs well; beyond, a file may be made to fill the disk."""

_LARGEST_SLICE_BYTES = 2**28
"""Most stored bytes of a slice; slices are inflated one at a time."""

_LARGEST_SURPLUS = 4096
"""Most bytes that may follow the last number: some writers fill up a block."""

_CHUNK = 2**18
_UNPACKING_ERRORS: tuple[type[Exception], ...] = (EOFError, OSError, isal_zlib.error)  # type: ignore[assignment]


class VoxelSource(Protocol):
    """Where the numbers of a grid are, as `file_bytes` stored: in a file (`VoxelBytes`), or in chunks of a folder."""

    @property
    def path(self) -> Path: ...
    @property
    def compressed(self) -> bool: ...
    @property
    def file_bytes(self) -> int: ...

    def iterate_slices(self, grid: GridFile) -> Iterator[NDArray[Any]]:
        """See `GridFile.iterate_slices`."""


@dataclass(frozen=True)
class VoxelBytes:
    """The place of a grid's numbers in the file itself, or in the one that its header names.

    offset, skip: Bytes in the file before the numbers or their compressed stream; inflated bytes before the numbers.
    packing: {"raw", "gzip", "zlib"}
    """

    path: Path
    offset: int = 0
    packing: str = "raw"
    skip: int = 0

    @property
    def compressed(self) -> bool:
        return self.packing != "raw"

    @property
    def file_bytes(self) -> int:
        return self.path.stat().st_size

    def iterate_slices(self, grid: GridFile) -> Iterator[NDArray[Any]]:
        ni, nj, nk = grid.shape_ijk
        shape = (nj, ni) if grid.layers == 1 else (nj, ni, grid.layers)
        count = nj * ni * grid.layers * grid.dtype.itemsize
        with self.open(grid.name) as stream:
            for k in range(nk):
                raw = read_bytes(stream, count, grid.name, grid.place(k))
                yield np.frombuffer(raw, dtype=grid.dtype).reshape(shape)
            check_end(stream, grid.name)

    @contextmanager
    def open(self, name: str) -> Iterator[BinaryIO]:
        """Open the stream at the first number; `name` is for messages."""
        with open_regular(self.path) as file:
            file.seek(self.offset)
            stream: BinaryIO = file
            if self.packing == "gzip":
                stream = open_gzip(file)
            elif self.packing == "zlib":
                stream = cast(BinaryIO, ZlibFile(file))
            read_bytes(stream, self.skip, name, "its header")
            yield stream


def open_gzip(file: BinaryIO) -> BinaryIO:
    """Return the inflated bytes of a gzip file, to read.  ISA-L inflates scans in half of zlib's time."""
    return cast(BinaryIO, igzip.IGzipFile(fileobj=file))


class ZlibFile(io.RawIOBase):
    """The inflated bytes of a zlib stream; its checksum is compared at the end."""

    def __init__(self, file: BinaryIO):
        super().__init__()
        self._file, self._inflater = file, isal_zlib.decompressobj()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill `buffer` with what one step inflates; return the number of bytes, 0 at the end."""
        target = memoryview(buffer).cast("B")
        while len(target) and not self._inflater.eof:  # 0 would mean no limit
            packed = self._inflater.unconsumed_tail or self._file.read(_CHUNK)
            part = self._inflater.decompress(packed, len(target))
            if part:
                target[: len(part)] = part
                return len(part)
            if not packed:
                raise EOFError("the compressed data end early")
        return 0


def check_size(name: str, shape: tuple[int, ...], item_bytes: int, file_bytes: int, compressed: bool) -> None:
    """Compare the size that a header promises with what the file can hold."""
    if min(shape) < 1 or prod(shape) > _LARGEST_GRID:
        raise RefusedInputError(
            f"{name} says that it has {' x '.join(map(str, shape))} voxels: at least 1 an axis and at most"
            f" {_LARGEST_GRID:,} altogether are read"
        )
    if prod(shape[:-1]) * item_bytes > _LARGEST_SLICE_BYTES:
        raise RefusedInputError(
            f"{name} says that a slice has {' x '.join(map(str, shape[:-1]))} numbers of {item_bytes} bytes: at most"
            f" {_LARGEST_SLICE_BYTES:,} bytes are read"
        )
    promised = prod(shape) * item_bytes
    possible = file_bytes * (_DEFLATE_RATIO if compressed else 1)
    if promised > possible:
        raise RefusedInputError(
            f"{name} is cut or corrupt: {' x '.join(map(str, shape))} numbers of {item_bytes} bytes cannot come from"
            f" a file of {file_bytes:,} bytes"
        )


def read_bytes(stream: BinaryIO, count: int, name: str, section: str) -> bytes:
    """Read exactly `count` bytes of a stream, which may be compressed."""
    parts, missing = [], count
    try:
        while missing > 0:
            part = stream.read(missing)
            if not part:
                raise RefusedInputError(f"{name} is cut: it ends in {section}, {missing:,} bytes before its end")
            parts.append(part)
            missing -= len(part)
    except _UNPACKING_ERRORS as error:
        raise RefusedInputError(f"{name} is cut or corrupt in {section}: {escape_text(str(error))}") from error
    return parts[0] if len(parts) == 1 else b"".join(parts)


def check_end(stream: BinaryIO, name: str) -> None:
    """Read to the end of the data, where the checksum of a compressed stream is."""
    surplus = 0
    try:
        while part := stream.read(_LARGEST_SURPLUS + 1):
            surplus += len(part)
            if surplus > _LARGEST_SURPLUS:
                raise RefusedInputError(f"{name} is corrupt: it holds more numbers than its header says")
    except _UNPACKING_ERRORS as error:
        raise RefusedInputError(f"{name} is cut or corrupt at its end: {escape_text(str(error))}") from error


def file_beside(header: Path, named: str) -> Path:
    """Return the file of voxels that a header names, in the folder of the header or below it."""
    name, shown = escape_text(header.name), escape_text(named)
    paths = (PurePosixPath(named), PureWindowsPath(named))
    if "\0" in named or any(path.anchor or ".." in path.parts for path in paths):
        raise RefusedInputError(f"{name} says that its voxels are in '{shown}': only files beside it are read")
    folder = header.parent.resolve()
    try:
        target = (folder / named).resolve(strict=True)
    except (OSError, RuntimeError) as error:
        raise RefusedInputError(f"{name} says that its voxels are in '{shown}', which is not there") from error
    if not target.is_relative_to(folder):
        raise RefusedInputError(f"{name} says that its voxels are in '{shown}', a link to another folder: not read")
    if not target.is_file():
        raise RefusedInputError(f"{name} says that its voxels are in '{shown}', which is no regular file")
    return target


LABEL_MAP = "label map"
VOLUME = "volume"
"""Purposes of reading a file, the nouns for messages."""


@dataclass(frozen=True)
class GridFile:
    """A grid of numbers in a file.

    name: Of the file, for messages on the terminal; it is never written to reports.
    kind: "NIfTI-1", "NIfTI-2", "NRRD", "MetaImage" or "OME-Zarr".
    layers: Numbers of one voxel, side by side in the file; 1 except for layered label maps.
    dtype: Type as stored, with its byte order.
    slope, intercept: The value of a stored number is ``stored * slope + intercept``; the user may have given them.
    warnings: Doubtful points of the header; they contain no names.
    extension: The bytes between the header and the voxels (NIfTI).
    """

    name: str
    purpose: str
    kind: str
    shape_ijk: tuple[int, int, int]
    dtype: np.dtype[Any]
    affine: Float64Array
    voxel_bytes: VoxelSource
    slope: float = 1.0
    intercept: float = 0.0
    layers: int = 1
    warnings: tuple[str, ...] = ()
    extension: bytes = b""
    fields: Mapping[str, Any] = field(default_factory=dict)
    rescale: Rescale | None = None

    def __post_init__(self) -> None:
        shape = self.shape_ijk if self.layers == 1 else (self.layers, *self.shape_ijk)
        check_size(self.name, shape, self.dtype.itemsize, self.voxel_bytes.file_bytes, self.voxel_bytes.compressed)

    @property
    def scaled(self) -> bool:
        """True when the stored numbers have to be scaled to get the values."""
        return (self.slope, self.intercept) != (1.0, 0.0)

    @property
    def may_be_mapped(self) -> bool:
        """True where a volume that is larger than the free memory may go to a file."""
        stored = self.voxel_bytes.file_bytes
        return prod(self.shape_ijk) * self.dtype.itemsize <= _SCAN_RATIO * stored

    def iterate_slices(self) -> Iterator[NDArray[Any]]:
        """Yield the stored slices in the order of k, shape (nj, ni), with layers (nj, ni, layers); read-only."""
        try:
            yield from self.voxel_bytes.iterate_slices(self)
        except OSError as error:
            raise RefusedInputError(f"{self.name} cannot be read: {error.strerror or error}") from error

    def place(self, k: int) -> str:
        return f"slice {k + 1} of {self.shape_ijk[2]}"


def import_extra(module: str, purpose: str) -> Any:
    return import_package(module, f"this {purpose}")


@dataclass(frozen=True, eq=False)
class VolumeContent:
    """What a volume file holds: voxels (nk, nj, ni) int16, int32 or float32, affine, the certificate in ASCII lines."""

    voxels: NDArray[Any]
    affine: Float64Array
    lines: tuple[str, ...]
    progress: Progress


_ISAL_LEVEL = 3
"""Level of ISA-L: files are 1 % smaller than those of level 1 of zlib, and packed in a quarter of the time."""


def open_packer(stream: BinaryIO) -> Any:
    """Return a file that packs by gzip into a stream, with a thread for each core."""
    return igzip_threaded.open(stream, "wb", compresslevel=_ISAL_LEVEL, threads=-1)


def write_slices(stream: Any, content: VolumeContent) -> None:
    for k, layer in enumerate(content.voxels):
        stream.write(layer.astype(layer.dtype.newbyteorder("<"), copy=False).tobytes())
        content.progress("write", k + 1, len(content.voxels))
