"""`BaseVolume`: what a volume holds, and where its voxels lie; `clrecon.geometry.volume.Volume` has the rest."""

from __future__ import annotations

import sys
from copy import deepcopy
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array, checked_affine, checked_points
from clrecon.geometry.certificate import Certificate, amend
from clrecon.geometry.grid import Grid
from clrecon.geometry.uneven import UnevenStack

Own = TypeVar("Own", bound="BaseVolume")

AIR_HU = -1024
"""HU given to voxels that hold no measurement (padding): the floor of the 12-bit CT number scale.  Air is -1000 HU, so
a lower value stays outside every surface of something denser than air."""

METAL_HU = 2000.0
"""Highest value of cortical bone; enamel and metal are above."""

DEVICE_DTYPES = tuple(np.dtype(name) for name in ("int8", "uint8", "int16", "uint16", "int32", "float32"))
"""Voxel types that go to a device unchanged; others are converted once, when a Volume is made."""


def _device_ready(voxels: NDArray[Any]) -> NDArray[Any]:
    """Return `voxels` C-contiguous, in native byte order and in one of `DEVICE_DTYPES`; refuse values outside its
    range.
    """
    dtype = voxels.dtype.newbyteorder("=")
    if dtype == np.bool_:
        dtype = np.dtype(np.uint8)
    elif dtype.kind == "f" and dtype != np.float32:
        dtype = np.dtype(np.float32)
        if np.abs(voxels).max() > np.finfo(np.float32).max and np.isfinite(voxels).all():
            raise UsageError("the voxels go beyond the range of float32")
    elif dtype.kind in "iu" and dtype not in DEVICE_DTYPES:
        limits = np.iinfo(np.int32)
        low, high = int(voxels.min()), int(voxels.max())
        if low < limits.min or high > limits.max:
            raise UsageError(f"voxels run from {low} to {high}: integers beyond 32 bits are not supported")
        dtype = np.dtype(np.int32)
    elif dtype not in DEVICE_DTYPES:
        raise UsageError(f"voxels of type {voxels.dtype} are not supported: use integers or floats")
    return np.ascontiguousarray(voxels, dtype=dtype)


def _as_array(voxels: ArrayLike) -> NDArray[Any]:
    if "numpy.ma" in sys.modules:  # where it is not loaded, no array is masked; to load it takes 10 ms
        import numpy.ma as masked  # waits where another thread is about to load it: half loaded, it has no MaskedArray

        if isinstance(voxels, masked.MaskedArray) and masked.is_masked(voxels):
            raise UsageError("masked voxels: fill them first, for CT with voxels.filled(clrecon.geometry.AIR_HU)")
    try:
        return np.asarray(voxels)
    except ValueError as error:
        raise UsageError(f"voxels are no array of numbers: {error}") from error


def _value_range(voxels: NDArray[Any]) -> tuple[float, float] | None:
    """Return the lowest and highest finite number, found slice by slice; None where no number is finite."""
    low, high = np.inf, -np.inf
    for layer in voxels:
        values = layer[np.isfinite(layer)] if layer.dtype.kind == "f" else layer
        if values.size:
            low, high = min(low, float(values.min())), max(high, float(values.max()))
    return (low, high) if low <= high else None


class BaseVolume(Grid):
    """Voxels in HU with their affine; `clrecon.geometry.volume.Volume` says what the arguments are."""

    def __init__(
        self,
        voxels: ArrayLike,
        affine: ArrayLike,
        report: dict[str, Any] | None = None,
        slice_positions: ArrayLike | None = None,
        *,
        hu_range: tuple[float, float] | None = None,
    ):
        array = _as_array(voxels)
        if array.ndim != 3:
            raise UsageError(f"voxels have three axes (k, j, i), these have shape {array.shape}")
        if array.size == 0:
            raise UsageError(f"the volume is empty: its shape is {array.shape}")
        super().__init__(_device_ready(array), checked_affine(affine))
        self._stack: UnevenStack | None = None
        if slice_positions is not None:
            self._stack = UnevenStack.of(self._affine, slice_positions, self._voxels.shape[0])
        self.report: dict[str, Any] = {"warnings": []} if report is None else report
        self._hu_range = hu_range

    @property
    def certificate(self) -> Certificate | None:
        """The report of a volume that was read; None where the volume was made from arrays."""
        return self.report if isinstance(self.report, Certificate) else None

    @property
    def hu_range(self) -> tuple[float, float] | None:
        """Lowest and highest finite value, None where no value is finite; searched anew where voxels can be written."""
        if self._hu_range is None or self._voxels.flags.writeable:
            self._hu_range = _value_range(self._voxels)
        return self._hu_range

    @property
    def affine(self) -> Float64Array:
        """4x4 float64, index (i, j, k) to LPS mm (read-only); where the slices are `uneven` only nominal along k."""
        return self._affine

    @property
    def uneven(self) -> bool:
        """True when the slices lie where `slice_origins` says and not at the affine's even steps."""
        return self._stack is not None

    def ijk_to_lps(self, points: ArrayLike) -> Float64Array:
        """Map index coordinates (n, 3), fractions allowed, to LPS mm (n, 3), float64; exact for uneven slices too."""
        if self._stack is not None:
            return self._stack.ijk_to_lps(checked_points(points))
        return super().ijk_to_lps(points)

    def lps_to_ijk(self, points: ArrayLike) -> Float64Array:
        """Map LPS mm (n, 3) to index coordinates (n, 3), float64; the inverse of `ijk_to_lps`."""
        if self._stack is not None:
            return self._stack.lps_to_ijk(checked_points(points))
        return super().lps_to_ijk(points)

    def slice_origins(self, border: int = 0) -> Float64Array:
        """Positions in LPS mm of voxel (0, 0, k) for k from ``-border`` to ``nk - 1 + border``.

        border: Number of further positions beyond either end, in the steps of the ends.

        Returns: ndarray, shape (nk + 2 * border, 3), float64
        """
        k = np.arange(-border, self._voxels.shape[0] + border, dtype=np.float64)
        if self._stack is not None:
            return self._stack.origins_at(k)
        return self._affine[:3, 3] + k[:, None] * self._affine[:3, 2]

    def with_voxels(self: Own, voxels: ArrayLike, report: dict[str, Any] | None = None) -> Own:
        """Return a volume with other values at the same places.

        ``hu_range`` of the copied report is that of the new values.  Its other entries about voxels, such as
        ``padding_share`` and ``padding_hu``, still describe the series as it was read.

        voxels: array_like, shape (nk, nj, ni)
        report: In place of a copy of this volume's.
        """
        array = _as_array(voxels)
        if array.shape != self._voxels.shape:
            raise UsageError(f"the voxels have shape {array.shape}, those of this volume {self._voxels.shape}")
        positions = None if self._stack is None else self.slice_origins()
        if report is not None:
            return type(self)(array, self._affine, report, positions)
        report, found = deepcopy(self.report), None
        if report.get("hu_range") is not None:
            found = _value_range(array)
            report = amend(report, hu_range=None if found is None else list(found))
        return type(self)(array, self._affine, report, positions, hu_range=found)

    def release_slices(self, first: int, end: int) -> None:
        """Let slices ``first`` to ``end - 1`` of a memory-mapped volume leave memory, because they are not needed soon.

        The values stay the same: the slices are read again when they are used.  Other volumes are not affected.
        """
        if self._mapping is not None:
            self._mapping.release(self._voxels[first:end])
