"""`Grid`: an array of voxels and the affine that places them, the base of volumes and label maps."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clrecon.geometry.affine import Float64Array, apply_affine, column_spacing
from clrecon.system.base_classes import MappedArray, Message
from clrecon.system.memory import find_mapping


class Grid(Message):
    """Voxels and their affine: the base class of `Volume` and of `clrecon.labels.LabelMap`.

    It pickles and copies as `clrecon.system.base_classes` says: memory-mapped voxels are sent as their place in the
    file.

    voxels: ndarray, shape (nk, nj, ni). Checked by the subclass.
    affine: ndarray, shape (4, 4), float64. Index (i, j, k) to LPS mm, checked too; it becomes read-only.
    """

    def __init__(self, voxels: NDArray[Any], affine: Float64Array):
        self._voxels = voxels
        self._mapping = find_mapping(voxels)
        self._affine = affine
        self._inverse = np.asarray(np.linalg.inv(affine), dtype=np.float64)
        self._affine.flags.writeable = self._inverse.flags.writeable = False

    def __getstate__(self) -> dict[str, object]:
        voxels = {} if self._mapping is None else {"_voxels": MappedArray(self._voxels, self._mapping)}
        return {**super().__getstate__(), **voxels, "_mapping": None}

    def __setstate__(self, state: dict[str, object]) -> None:
        super().__setstate__(state)
        self._mapping = find_mapping(self._voxels)

    @property
    def voxels(self) -> NDArray[Any]:
        """The voxels, shape (nk, nj, ni)."""
        return self._voxels

    @property
    def shape(self) -> tuple[int, int, int]:
        """(nk, nj, ni), the shape of `voxels`; `shape_ijk` is its reverse."""
        nk, nj, ni = self._voxels.shape
        return nk, nj, ni

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the voxels."""
        return self._voxels.dtype

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the voxels, shape (nk, nj, ni), for numpy; a copy only where one is asked for or the type changes."""
        wanted = self._voxels.dtype if dtype is None else np.dtype(dtype)
        if wanted == self._voxels.dtype:
            return self._voxels.copy() if copy else self._voxels
        if copy is False:
            raise ValueError(f"voxels of type {self._voxels.dtype} are {wanted} only as a copy")
        return self._voxels.astype(wanted)

    @property
    def affine(self) -> Float64Array:
        """4x4 float64, index (i, j, k) to LPS mm (read-only)."""
        return self._affine

    @property
    def spacing(self) -> tuple[float, float, float]:
        """(di, dj, dk) in mm: the lengths of the affine's three steps."""
        return column_spacing(self._affine)

    @property
    def shape_ijk(self) -> tuple[int, int, int]:
        """(ni, nj, nk), the reverse of ``voxels.shape``."""
        nk, nj, ni = self._voxels.shape
        return ni, nj, nk

    def ijk_to_lps(self, points: ArrayLike) -> Float64Array:
        """Map index coordinates (n, 3), fractions allowed, to LPS mm (n, 3), float64."""
        return apply_affine(self._affine, points)

    def lps_to_ijk(self, points: ArrayLike) -> Float64Array:
        """Map LPS mm (n, 3) to index coordinates (n, 3), float64; the inverse of `ijk_to_lps`."""
        return apply_affine(self._inverse, points)
