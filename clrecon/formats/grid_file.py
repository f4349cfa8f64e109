"""`GridFile`: what the header of a file says of its voxels, in our words and frames, before any of them is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.formats.stream import VoxelBytes, check_end, check_size, read_bytes
from clrecon.geometry.affine import Float64Array

__all__ = ["LABEL_MAP", "VOLUME", "GridFile", "Purpose"]


@dataclass(frozen=True)
class Purpose:
    """What a file is read as, for messages: the noun, and the extra that brings what reads it."""

    noun: str
    extra: str


LABEL_MAP = Purpose("label map", "labels")
VOLUME = Purpose("volume", "volumes")


@dataclass(frozen=True)
class GridFile:
    """A grid of numbers in a file.

    Attributes
    ----------
    name : str
        Of the file, for messages on the terminal; never for reports.
    purpose : Purpose
    kind : str
        "NIfTI-1", "NIfTI-2", "NRRD" or "MetaImage".
    shape_ijk : tuple of int
        (ni, nj, nk).
    layers : int
        Numbers a voxel, side by side in the file; 1 but for layered label maps.
    dtype : dtype
        As stored, with its byte order.
    slope, intercept : float
        A number means ``stored * slope + intercept``.
    affine : ndarray, shape (4, 4), float64
        Index (i, j, k) to LPS mm.
    voxel_bytes : VoxelBytes
        Where the numbers are.
    warnings : tuple of str
        What was doubtful in the header; no names.
    extension : bytes
        What stands between the header and the voxels (NIfTI).
    fields : mapping
        All fields of the header (NRRD).

    Raises
    ------
    RefusedInputError
        Sizes that are impossible, or that the file cannot hold.
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

    def __post_init__(self) -> None:
        shape = self.shape_ijk if self.layers == 1 else (self.layers, *self.shape_ijk)
        check_size(self.name, shape, self.dtype.itemsize, self.voxel_bytes.file_bytes, self.voxel_bytes.compressed)

    @property
    def scaled(self) -> bool:
        """True when the stored numbers are not what they mean."""
        return (self.slope, self.intercept) != (1.0, 0.0)

    def iterate_slices(self) -> Iterator[NDArray[Any]]:
        """Yield the slices in the order of k as they are stored, shape (nj, ni), of layers (nj, ni, layers); read-only.

        Raises
        ------
        RefusedInputError
            The data end early or are corrupt; the slice is named.
        """
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
        """Slice `k` for messages."""
        return f"slice {k + 1} of {self.shape_ijk[2]}"
