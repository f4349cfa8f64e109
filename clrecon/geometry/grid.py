"""Where voxels lie: `Grid` by an affine, `UnevenStack` by the place of each slice, and `BaseVolume`, which has both.

Rows and columns of an uneven stack run in the same directions in every slice.  Between slices k and k + 1 every point
moves along the step from one position to the next: the map is linear in each layer, continuous across slices, and exact
at every voxel.
"""

from __future__ import annotations

import sys
from copy import deepcopy
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import (
    Float64Array,
    apply_affine,
    checked_affine,
    checked_points,
    column_spacing,
    map_points,
    slice_normal,
)
from clrecon.geometry.certificate import Certificate, amend
from clrecon.system.base_classes import MappedArray, Message
from clrecon.system.light_dataclass import dataclass
from clrecon.system.memory import allocate_voxels, find_mapping, iterate_layers


def may_change(array: NDArray[Any]) -> bool:
    """True where an array, or one whose memory it shows, can be written."""
    return array.flags.writeable or (isinstance(array.base, np.ndarray) and may_change(array.base))


class Grid(Message):
    """Voxels (nk, nj, ni) and their affine, checked by the subclass, which becomes read-only: index (i, j, k) to LPS
    mm.

    It pickles and copies as `clrecon.system.base_classes` says: memory-mapped voxels are sent as their place in the
    file.
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
        """Map index coordinates (n, 3) or (3,), fractions allowed, to LPS mm of that shape, float64."""
        return map_points(lambda ijk: apply_affine(self._affine, ijk), points)

    def lps_to_ijk(self, points: ArrayLike) -> Float64Array:
        """Map LPS mm (n, 3) or (3,) to index coordinates of that shape, float64; the inverse of `ijk_to_lps`."""
        return map_points(lambda lps: apply_affine(self._inverse, lps), points)


POSITION_TOLERANCE_MM = 0.01
POSITION_TOLERANCE_GAPS = 0.01
"""A residual up to 1 % of the gap (or 0.01 mm if larger) is due to rounding and does not make a stack uneven."""


def position_tolerance(gap_mm: float) -> float:
    """Return the largest distance in mm of a slice from even places that is taken as rounding."""
    return max(POSITION_TOLERANCE_MM, POSITION_TOLERANCE_GAPS * gap_mm)


def fit_line(positions: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Fit step and origin (LPS mm) by least squares to positions (n, 3) that are numbered 0 to n - 1, n >= 2."""
    k = np.arange(len(positions), dtype=np.float64)
    centre, mean = k.mean(), positions.mean(axis=0)
    step = (k - centre) @ (positions - mean) / np.sum((k - centre) ** 2)
    return step, mean - centre * step


def fit_even(positions: Float64Array, normal: Float64Array) -> tuple[Float64Array, Float64Array, bool]:
    """Return step and origin (3,), LPS mm, of even places fitted to positions (n, 3), n >= 2, and whether all are so.

    None may be further off than `position_tolerance` of the median gap along the normal.
    """
    step, origin = fit_line(positions)
    off = np.linalg.norm(positions - (origin + np.arange(len(positions))[:, None] * step), axis=1)
    usual = float(np.median(np.abs(np.diff(positions @ normal))))
    return step, origin, bool(off.max() <= position_tolerance(usual))


@dataclass(frozen=True)
class UnevenStack(Message):
    """Positions (nk, 3) of all slices, LPS mm, the steps along i and j that they share (3, 2), and their normal."""

    in_plane: Float64Array
    positions: Float64Array
    normal: Float64Array

    @classmethod
    def of(cls, affine: Float64Array, positions: ArrayLike, slices: int) -> UnevenStack:
        """Check positions against an affine, which gives the in-plane steps and the direction of growing k."""
        table = np.array(checked_points(positions))
        if len(table) != slices or slices < 2:
            raise UsageError(f"{len(table)} slice positions for {slices} slices: one each, and at least two")
        if not np.isfinite(table).all():
            raise UsageError("slice positions hold NaN or infinite numbers")
        normal = slice_normal(affine)
        if normal @ affine[:3, 2] < 0.0:
            normal = -normal
        gaps = np.diff(table @ normal)
        if gaps.min() <= 0.0:
            k = int(gaps.argmin())
            raise UsageError(
                f"slice positions advance along the slice step of the affine, but from slice {k} to {k + 1} they go"
                f" {gaps[k]:.4g} mm"
            )
        in_plane = np.array(affine[:3, :2])
        table.flags.writeable = in_plane.flags.writeable = normal.flags.writeable = False
        return cls(in_plane, table, normal)

    def origins_at(self, k: Float64Array) -> Float64Array:
        """Return positions (n, 3) at slice coordinates (n,); fractions and coordinates beyond the ends are allowed."""
        layer = np.nan_to_num(np.clip(np.floor(k), 0, len(self.positions) - 2)).astype(np.int64)
        part = (k - layer)[:, None]
        with np.errstate(invalid="ignore"):  # a point that is not finite has no place
            return self.positions[layer] * (1.0 - part) + self.positions[layer + 1] * part

    def ijk_to_lps(self, points: Float64Array) -> Float64Array:
        """Map index coordinates (n, 3) to LPS mm (n, 3)."""
        return self.origins_at(points[:, 2]) + points[:, :2] @ self.in_plane.T

    def lps_to_ijk(self, points: Float64Array) -> Float64Array:
        """Map LPS mm (n, 3) to index coordinates (n, 3)."""
        heights = self.positions @ self.normal
        with np.errstate(invalid="ignore"):
            wanted = points @ self.normal
        layer = np.clip(np.searchsorted(heights, wanted, side="right") - 1, 0, len(heights) - 2)
        k = layer + (wanted - heights[layer]) / (heights[layer + 1] - heights[layer])
        in_slice = points - self.origins_at(k)
        return np.column_stack([in_slice @ np.linalg.pinv(self.in_plane).T, k])


Own = TypeVar("Own", bound="BaseVolume")

AIR_HU = -1024
"""HU given to voxels that hold no measurement (padding): the floor of the 12-bit CT number scale.  Air is -1000 HU, so
a lower value stays outside every surface of something denser than air."""

METAL_HU = 2000.0
"""Highest value of cortical bone; enamel and metal are above."""

DEVICE_DTYPES = tuple(np.dtype(name) for name in ("int8", "uint8", "int16", "uint16", "int32", "float32"))
"""Voxel types that go to a device unchanged; others are converted once, when a Volume is made."""


def _device_ready(voxels: NDArray[Any]) -> NDArray[Any]:
    """Return `voxels` C-contiguous, in native byte order and one of `DEVICE_DTYPES`; refuse those outside its range."""
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
    if getattr(voxels, "ndim", 0) == 3 and getattr(voxels, "chunks", None) and 0 not in voxels.shape:  # type: ignore[union-attr]
        return _read_chunked(voxels)
    try:
        return np.asarray(voxels)
    except ValueError as error:
        raise UsageError(f"voxels are no array of numbers: {error}") from error


def _read_chunked(source: Any) -> NDArray[Any]:
    """Read an array of zarr, Dask or h5py by layers of its chunks, in the type of a volume."""
    voxels = mapping = None
    for first, end in iterate_layers(source):
        layer = _device_ready(np.asarray(source[first:end]))
        if voxels is None:
            voxels = allocate_voxels(source.shape, layer.dtype, may_map=True)
            mapping = find_mapping(voxels)
        voxels[first:end] = layer
        if mapping is not None:
            mapping.release(voxels[first:end])
    assert voxels is not None  # it is not empty
    return voxels


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
        if self._hu_range is None or may_change(self._voxels):
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
        """Map index coordinates (n, 3) or (3,), fractions allowed, to LPS mm, float64; exact for uneven slices too."""
        return super().ijk_to_lps(points) if self._stack is None else map_points(self._stack.ijk_to_lps, points)

    def lps_to_ijk(self, points: ArrayLike) -> Float64Array:
        """Map LPS mm (n, 3) or (3,) to index coordinates of that shape, float64; the inverse of `ijk_to_lps`."""
        return super().lps_to_ijk(points) if self._stack is None else map_points(self._stack.lps_to_ijk, points)

    def slice_origins(self, border: int = 0) -> Float64Array:
        """LPS mm (n, 3) of voxel (0, 0, k), k from ``-border`` to ``nk - 1 + border``, in the steps of the ends."""
        k = np.arange(-border, self._voxels.shape[0] + border, dtype=np.float64)
        if self._stack is not None:
            return self._stack.origins_at(k)
        return self._affine[:3, 3] + k[:, None] * self._affine[:3, 2]

    def alike(self: Own, voxels: ArrayLike, affine: ArrayLike, *more: Any, **known: Any) -> Own:
        """Return another volume of the same kind, of the arguments of a `Volume`; one on a device gives one there."""
        return type(self)(voxels, affine, *more, **known)

    def with_voxels(self: Own, voxels: ArrayLike, report: dict[str, Any] | None = None) -> Own:
        """Return a volume with other values (nk, nj, ni) at the same places.

        ``hu_range`` of the copied report, which a given one replaces, is that of the new values.  Its other entries
        about voxels, such as ``padding_share`` and ``padding_hu``, still describe the series as it was read.
        """
        array = _as_array(voxels)
        if array.shape != self._voxels.shape:
            raise UsageError(f"the voxels have shape {array.shape}, those of this volume {self._voxels.shape}")
        positions = None if self._stack is None else self.slice_origins()
        if report is not None:
            return self.alike(array, self._affine, report, positions)
        report, hu_range = deepcopy(self.report), None
        if report.get("hu_range") is not None:
            hu_range = _value_range(array)
            report = amend(report, hu_range=None if hu_range is None else list(hu_range))
        return self.alike(array, self._affine, report, positions, hu_range=hu_range)

    def release_slices(self, first: int, end: int) -> None:
        """Let slices ``first`` to ``end - 1`` of a memory-mapped volume leave memory until they are used again."""
        if self._mapping is not None:
            self._mapping.release(self._voxels[first:end])
