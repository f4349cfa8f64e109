"""`MaskBits`: what a mask holds, its number of voxels, and how masks of one volume are joined."""

from __future__ import annotations

from typing import Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.opencl import Device, check_budget, download, upload
from clrecon.operators.masks import logic
from clrecon.operators.masks.band_mask import VoxelMask, mask_bytes
from clrecon.system.text import format_digits

PLACE_TOLERANCE_MM = 0.01
"""Voxels of two volumes that lie as close are the same."""

Bits = TypeVar("Bits", bound="MaskBits")


class MaskBits:
    """One bit for each voxel of a volume, on a device; what `clrecon.Mask` is made of."""

    def __init__(self, volume: Volume, mask_d: Any, name: str, *, device: Device, memory: int | None = None):
        self.volume, self.device, self.memory, self.name = volume, device, memory, name
        self._mask_d = mask_d
        self._extents: VoxelMask | None = None
        self._count: int | None = None

    def __reduce__(self) -> NoReturn:
        """Refuse to be pickled or copied: buffers stay with their process."""
        raise TypeError("a Mask belongs to its process: send to_numpy(), and make one there")

    def __repr__(self) -> str:
        ni, nj, nk = self.shape_ijk
        return f"Mask({self.name}: {self.count:,} of {ni} x {nj} x {nk} voxels)"

    @property
    def shape_ijk(self) -> tuple[int, int, int]:
        """Voxels along i, j and k."""
        return self.volume.shape_ijk

    @property
    def count(self) -> int:
        """Number of chosen voxels."""
        if self._count is None:
            self._count = logic.count_bits(self.device, self._mask_d, self.shape_ijk)
        return self._count

    @property
    def share(self) -> float:
        """Share of the volume's voxels that are chosen, 0 to 1."""
        return self.count / self.volume.voxels.size

    @property
    def bits(self) -> VoxelMask:
        """The words on the device, with the extents of the rows, for operators."""
        if self._extents is None:
            self._extents = logic.find_extents(self.device, self._mask_d, self.shape_ijk)
        return self._extents

    def to_numpy(self) -> NDArray[np.bool_]:
        """Return the chosen voxels, shape (nk, nj, ni), bool."""
        ni, nj, nk = self.shape_ijk
        words = download(self.device, np.empty((nk, nj, -(-ni // 32)), "<u4"), self._mask_d)
        return np.unpackbits(words.view(np.uint8), axis=2, count=ni, bitorder="little").view(np.bool_)

    __array_ufunc__ = None  # an array and a mask have no common operators

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """Return the chosen voxels, shape (nk, nj, ni), bool, for numpy: always a copy."""
        if copy is False:
            raise ValueError("the bits of a mask are an array only as a copy")
        return self.to_numpy().astype(np.bool_ if dtype is None else dtype, copy=False)

    # Logic

    def __and__(self: Bits, other: Bits) -> Bits:
        return self._combined(other, "and")

    def __or__(self: Bits, other: Bits) -> Bits:
        return self._combined(other, "or")

    def __xor__(self: Bits, other: Bits) -> Bits:
        return self._combined(other, "xor")

    def __sub__(self: Bits, other: Bits) -> Bits:
        return self._combined(other, "and not")

    def __invert__(self: Bits) -> Bits:
        self._check_budget(2)
        made_d = logic.invert(self.device, self._mask_d, self.shape_ijk)
        return self._made(made_d, f"not ({self.name})")

    def _combined(self: Bits, other: Bits, operation: str) -> Bits:
        if not isinstance(other, MaskBits):
            return NotImplemented
        self._check_frame(other.volume)
        self._check_budget(3)
        other_d = other._mask_d
        if other.device is not self.device:  # a device failed, and another took over
            ni, nj, nk = self.shape_ijk
            words = download(other.device, np.empty(-(-ni // 32) * nj * nk, np.uint32), other_d)
            other_d = upload(self.device, words)
        made_d = logic.combine(self.device, self._mask_d, other_d, self.shape_ijk, operation)
        return self._made(made_d, f"({self.name}) {operation} ({other.name})")

    # How

    def _made(self: Bits, mask_d: Any, name: str) -> Bits:
        return type(self)(self.volume, mask_d, name, device=self.device, memory=self.memory)

    def _check_budget(self, masks: int, **more: int) -> None:
        size = mask_bytes(self.shape_ijk)["mask of the voxels"]
        check_budget(self.device, {f"{masks} masks of the voxels": masks * size, **more}, self.memory)

    def _check_frame(self, volume: Volume) -> None:
        """Refuse a volume whose voxels lie elsewhere."""
        own = self.volume
        if volume is own:
            return
        if volume.shape_ijk != own.shape_ijk:
            raise UsageError(f"the mask has {own.shape_ijk} voxels, the other volume {volume.shape_ijk}")
        ni, nj, _ = own.shape_ijk
        turned = np.abs((volume.affine - own.affine)[:3, :2] * (ni, nj)).max()
        away = max(float(turned), float(np.abs(volume.slice_origins() - own.slice_origins()).max()))
        if away > PLACE_TOLERANCE_MM:
            raise UsageError(f"the voxels of the mask and of the other volume lie up to {format_digits(away)} mm apart")
