"""`GridFile`: the header of a file in our words and frame (LPS), before any voxel is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.formats.stream import VoxelBytes, check_end, check_size, read_bytes
from clrecon.geometry.affine import Float64Array
from clrecon.sources.rescale import Rescale


@dataclass(frozen=True)
class Purpose:
    """The purpose of reading a file, for messages: its noun."""

    noun: str


LABEL_MAP = Purpose("label map")
VOLUME = Purpose("volume")


@dataclass(frozen=True)
class GridFile:
    """A grid of numbers in a file.

    name: Name of the file, for messages on the terminal; it is never written to reports.
    kind: "NIfTI-1", "NIfTI-2", "NRRD" or "MetaImage".
    shape_ijk: (ni, nj, nk).
    layers: Numbers of one voxel, side by side in the file; 1 except for layered label maps.
    dtype: Type as stored, with its byte order.
    slope, intercept: The value of a stored number is ``stored * slope + intercept``.
    affine: ndarray, shape (4, 4), float64. Index (i, j, k) to LPS mm.
    voxel_bytes: Where the numbers are.
    warnings: Doubtful points of the header; they contain no names.
    extension: The bytes between the header and the voxels (NIfTI).
    fields: All fields of the header (NRRD).
    rescale: Slope and intercept that the user gave in place of those of the header.
    """

    name: str
    purpose: Purpose
    kind: str
    shape_ijk: tuple[int, int, int]
    dtype: np.dtype[Any]
    affine: Float64Array
    voxel_bytes: VoxelBytes
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

    def iterate_slices(self) -> Iterator[NDArray[Any]]:
        """Yield the stored slices in the order of k, shape (nj, ni), with layers (nj, ni, layers); read-only."""
        ni, nj, nk = self.shape_ijk
        shape = (nj, ni) if self.layers == 1 else (nj, ni, self.layers)
        count = nj * ni * self.layers * self.dtype.itemsize
        try:
            with self.voxel_bytes.open(self.name) as stream:
                for k in range(nk):
                    raw = read_bytes(stream, count, self.name, self.place(k))
                    yield np.frombuffer(raw, dtype=self.dtype).reshape(shape)
                check_end(stream, self.name)
        except OSError as error:
            raise RefusedInputError(f"{self.name} cannot be read: {error.strerror or error}") from error

    def place(self, k: int) -> str:
        """Describe slice `k` for messages."""
        return f"slice {k + 1} of {self.shape_ijk[2]}"
