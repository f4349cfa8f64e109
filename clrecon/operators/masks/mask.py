"""`Mask`: voxels of a volume that are chosen, one bit each, on a device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import AIR_HU, Volume
from clrecon.geometry.certificate import amend
from clrecon.opencl import Device, Stopwatch, check_budget, upload
from clrecon.operators.masks import voxel_mask
from clrecon.operators.masks.regions import RowSpans, box_spans, checked_box, tube_spans
from clrecon.operators.masks.runs import Components, RowRuns, write_runs
from clrecon.operators.masks.shapes import MaskBits
from clrecon.operators.masks.voxel_mask import check_shape, checked_band, mark_band, mask_bytes, zero_words
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.system.arguments import explains_arguments
from clrecon.system.packages import public_function
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_band

if TYPE_CHECKING:  # label maps load pydicom, which others need not wait for
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh


class Mask(MaskBits):
    """Voxels of a volume that are chosen: one bit each, on a device, in the frame of the volume.

    Make one by `from_band`, `from_labels`, `from_box`, `from_tube` or `from_array`.  Masks of one volume are joined by
    ``&``, ``|``, ``^`` and ``-`` (and not), and inverted by ``~``.  Every operation makes a new mask.

    Attributes
    ----------
    scan : Volume
        The volume whose voxels these are; its HU are not changed.
    device : Device
    memory : int or None
        Most bytes that an operation takes on the device.
    name : str
        What was chosen, in words.
    """

    # Made of

    @classmethod
    @explains_arguments
    def from_band(
        cls,
        volume: Volume | DeviceVolume,
        hu: Sequence[float | None],
        *,
        device: Device | str | int | None = None,
        memory: int | None = None,
        progress: Progress | None = None,
    ) -> Mask:
        """Choose the voxels of a band of HU.

        Parameters
        ----------
        volume : Volume or DeviceVolume
        hu : (float or None, float or None)
            Both ends included; infinity leaves one open.  NaN lies in no band.
        device : Device, str or int, optional
            See `clrecon.device`; a `DeviceVolume` has its own.
        memory : int, optional
            Most bytes on the device; volumes that do not fit beside their mask go there slab by slab.
        progress : callable, optional
            Called as ``progress("mask", slices done, all slices)`` where there are several slabs.

        Raises
        ------
        UsageError
            These are not two numbers, the lower one first, or the volume is too large for masks.
        NoSurfaceError
            The type of the voxels has no value in the band.
        DeviceError
            No device, not even the mask and one slice fit its memory, or it fails.
        """
        band = checked_band(hu)
        name = format_band(*band)
        with open_volume(volume, device, memory, "a mask") as resident:
            for attempt in resident.with_fallback():
                with attempt as (current, _):
                    marked = mark_band(resident, band, progress=progress or ignore_progress)
            mask = cls(resident.volume, marked.mask_d, name, device=current, memory=resident.memory)
        mask._extents = marked
        return mask

    @classmethod
    @explains_arguments
    def from_labels(
        cls,
        volume: Volume | DeviceVolume,
        labels: LabelMap,
        label: Sequence[int | str] | int | str | None = None,
        *,
        device: Device | str | int | None = None,
        memory: int | None = None,
    ) -> Mask:
        """Choose the voxels of labels; each voxel has the label of the map's voxel that holds its centre.

        Parameters
        ----------
        volume : Volume or DeviceVolume
        labels : LabelMap
            On any grid.
        label : int, str or sequence of them, optional
            Numbers or names of labels; all of the map by default.

        Raises
        ------
        UsageError
            ``labels`` is not a LabelMap, or it has no such label.
        RefusedInputError
            The map names another frame of reference, or lies outside of the volume.
        DeviceError
            As for `from_band`.
        """
        chosen = labels.choose(label)
        with open_volume(volume, device, memory, "a mask") as resident:
            voxels = resident.bring(labels).voxels
            wanted = np.zeros(int(np.iinfo(voxels.dtype).max) + 1, np.bool_)
            wanted[list(chosen)] = True
            names = [labels.name(number) for number in chosen]
            return cls._packed(resident, wanted[voxels], f"labels {', '.join(names)}" if names else "no label")

    @classmethod
    @explains_arguments
    def from_array(
        cls,
        volume: Volume | DeviceVolume,
        voxels: ArrayLike,
        *,
        device: Device | str | int | None = None,
        memory: int | None = None,
    ) -> Mask:
        """Choose the voxels that are true in an array.

        Parameters
        ----------
        volume : Volume or DeviceVolume
        voxels : array_like, shape (nk, nj, ni), bool
            Or whole numbers, of which all but 0 are true.

        Raises
        ------
        UsageError
            The shape is not that of the volume, or these are no whole numbers.
        DeviceError
            As for `from_band`.
        """
        array = np.asarray(voxels)
        if array.dtype.kind not in "biu":
            raise UsageError(f"a mask is made of true and false or of whole numbers, not of {array.dtype}")
        with open_volume(volume, device, memory, "a mask") as resident:
            shape = resident.volume.voxels.shape
            if array.shape != shape:
                raise UsageError(f"the array of the mask has shape {array.shape}, the volume {shape}")
            return cls._packed(resident, array if array.dtype == np.bool_ else array != 0, "an array")

    @classmethod
    @explains_arguments
    def from_box(
        cls,
        volume: Volume | DeviceVolume,
        box: Sequence[float | None],
        *,
        device: Device | str | int | None = None,
        memory: int | None = None,
    ) -> Mask:
        """Choose the voxels whose centres lie in a box in the patient, its sides included.

        Parameters
        ----------
        volume : Volume or DeviceVolume
            Oblique, tilted and uneven stacks too: the places of the voxels count.
        box : (x0, x1, y0, y1, z0, z1)
            LPS mm; None or NaN leaves a side open.

        Raises
        ------
        UsageError
            These are not six numbers, the lower one of each pair first, or no voxel lies in the box.
        DeviceError
            As for `from_band`.
        """
        sides = checked_box(box)
        with open_volume(volume, device, memory, "a mask") as resident:
            name = "box " + ", ".join(
                f"{axis} {format_band(low, high, 'mm')}"
                for axis, (low, high) in zip("xyz", sides, strict=True)
                if np.isfinite((low, high)).any()
            )
            return cls._spanned(resident, box_spans(resident.volume, sides), name)

    @classmethod
    @explains_arguments
    def from_tube(
        cls,
        volume: Volume | DeviceVolume,
        points_mm: ArrayLike,
        radius_mm: float,
        *,
        device: Device | str | int | None = None,
        memory: int | None = None,
    ) -> Mask:
        """Choose the voxels whose centres lie within a distance of a line through points, such as that of the spine.

        Parameters
        ----------
        volume : Volume or DeviceVolume
        points_mm : array_like, shape (n, 3)
            LPS mm, joined by straight pieces; of one point the tube is a ball.
        radius_mm : float

        Raises
        ------
        UsageError
            The points are no points, the radius is not above 0, or no voxel lies in the tube.
        DeviceError
            As for `from_band`.
        """
        with open_volume(volume, device, memory, "a mask") as resident:
            spans = tube_spans(resident.volume, points_mm, radius_mm)
            return cls._spanned(resident, spans, f"tube of {float(radius_mm):g} mm round a line")

    # What it holds

    @explains_arguments
    def to_label_map(self, name: str | None = None) -> LabelMap:
        """Return a label map on the grid of the volume, with number 1 where voxels are chosen.

        Parameters
        ----------
        name : str, optional
            Of the label; by default that of the mask.

        Raises
        ------
        UsageError
            The slices of the volume are uneven: no label map has such a grid.
        """
        from clrecon.labels import LabelMap

        if self.scan.uneven:
            raise UsageError("the slices of the volume are uneven, and a label map has even ones: take to_numpy()")
        return LabelMap(self.to_numpy().view(np.uint8), self.scan.affine, {1: name or self.name})

    def to_mesh(self) -> Mesh:
        """Return the surface of the chosen voxels, as `clrecon.extract_label_masks` makes that of a label.

        Raises
        ------
        NoSurfaceError
            No voxel is chosen.
        UsageError
            As `to_label_map`.
        """
        if not self.count:
            raise NoSurfaceError(f"no voxel is chosen ({self.name}): there is no surface")
        extract: Callable[..., dict[int, Mesh]] = public_function("extract_label_masks")
        return extract(self.to_label_map(), device=self.device, memory=self.memory)[1]

    def __rand__(self, label_map: LabelMap) -> LabelMap:
        return self._relabelled(label_map, lambda voxels, chosen: np.where(chosen, voxels, 0))

    def __rsub__(self, label_map: LabelMap) -> LabelMap:
        return self._relabelled(label_map, lambda voxels, chosen: np.where(chosen, 0, voxels))

    def __ror__(self, label_map: LabelMap) -> LabelMap:
        number = max({0, *getattr(label_map, "names", ())}) + 1
        return self._relabelled(
            label_map,
            lambda voxels, chosen: np.where(chosen & (voxels == 0), np.int32(number), voxels),
            {number: self.name},
        )

    def _relabelled(self, labels: LabelMap, change: Callable[..., NDArray[Any]], more: Any = None) -> LabelMap:
        """Return a label map on the grid of the mask with changed voxels and `more` names."""
        from clrecon.labels import LabelMap

        if not isinstance(labels, LabelMap):
            return NotImplemented
        self._check_frame(Volume(labels.voxels, labels.affine))
        return labels.changed(change(labels.voxels, self.to_numpy()), {**labels.names, **(more or {})})

    @explains_arguments
    def apply(self, volume: Volume | DeviceVolume, outside: float = AIR_HU) -> Any:
        """Return a volume with another value at the voxels that are not chosen.

        Parameters
        ----------
        volume : Volume or DeviceVolume
            In the same frame; not changed.
        outside : float
            HU.

        Returns
        -------
        Volume or DeviceVolume
            As ``volume``; its report says what was chosen, under ``region``.

        Raises
        ------
        UsageError
            The volume has other voxels, or their type does not hold the value.
        DeviceError
            The device has no room, or it fails.
        """
        scan = volume.volume if isinstance(volume, DeviceVolume) else volume
        if not isinstance(scan, Volume):
            raise UsageError(f"a mask is applied to a Volume, not to {type(volume).__name__}")
        self._check_frame(scan)
        value = _checked_value(outside, scan.voxels.dtype)
        voxels_d = None
        if isinstance(volume, DeviceVolume) and volume.device is self.device:
            voxels, voxels_d = self._replace(volume, value)
        else:
            voxels = np.where(self.to_numpy(), scan.voxels, value)
        masked = scan.with_voxels(voxels)
        chosen = {"chosen": self.name, "voxels": self.count, "all_voxels": scan.voxels.size, "outside_hu": float(value)}
        masked.report = amend(masked.report, region=chosen)
        return volume.follow(masked, voxels_d) if isinstance(volume, DeviceVolume) else masked

    def _replace(self, resident: DeviceVolume, value: Any) -> tuple[NDArray[Any], Any]:
        """Return the voxels with `value` where none is chosen, and those on the device if it has room, else None."""
        voxels = resident.volume.voxels
        sizes = {"volume": voxels.nbytes, "volume of what is chosen": voxels.nbytes, **mask_bytes(self.shape_ijk)}
        if resident.shortage(sizes):
            return np.where(self.to_numpy(), voxels, value), None
        voxels_d = resident.whole(Stopwatch())
        return voxel_mask.replace_outside(self.device, voxels_d, voxels.dtype, self._mask_d, self.shape_ijk, value)

    @classmethod
    def _packed(cls, resident: DeviceVolume, chosen: NDArray[np.bool_], name: str) -> Mask:
        volume = resident.volume
        check_shape(volume.shape_ijk)
        ni, nj, nk = volume.shape_ijk
        packed = np.zeros((nk, nj, 4 * -(-ni // 32)), np.uint8)
        packed[..., : -(-ni // 8)] = np.packbits(chosen, axis=2, bitorder="little")
        for attempt in resident.with_fallback():
            with attempt as (current, _):
                check_budget(current, mask_bytes(volume.shape_ijk), resident.memory)
                words_d = upload(current, packed.view("<u4").astype(np.uint32, copy=False))
        return cls(volume, words_d, name, device=current, memory=resident.memory)

    @classmethod
    def _spanned(cls, resident: DeviceVolume, spans: RowSpans, name: str) -> Mask:
        volume, n = resident.volume, len(spans.columns)
        check_shape(volume.shape_ijk)
        if not n:
            low, high = volume.bounds
            raise UsageError(
                f"no voxel lies in the {name}: the volume runs from ({', '.join(f'{x:.1f}' for x in low)}) to"
                f" ({', '.join(f'{x:.1f}' for x in high)}) mm"
            )
        sizes = mask_bytes(volume.shape_ijk)
        for attempt in resident.with_fallback():
            with attempt as (device, _):
                check_budget(device, {**sizes, "spans of rows": 8 * n}, resident.memory)
                mask_d = zero_words(device, sizes["mask of the voxels"] // 4)
                runs = RowRuns(upload(device, spans.columns), upload(device, spans.row_counts), n, 0, False)
                parts = Components(runs, 1, upload(device, np.zeros(n, np.int32)))
                write_runs(device, parts, upload(device, np.ones(1, np.uint8)), mask_d, volume.shape_ijk)
        return cls(volume, mask_d, name, device=device, memory=resident.memory)


def _checked_value(value: float, dtype: np.dtype[Any]) -> Any:
    try:
        number = float(value)
        with np.errstate(invalid="ignore", over="ignore"):
            converted = dtype.type(number)
    except (TypeError, ValueError, OverflowError):
        number, converted = np.nan, None
    if converted is None or not np.isfinite(number) or (dtype.kind != "f" and float(converted) != number):
        raise UsageError(f"the value outside is {value!r}: voxels of {dtype} hold no such HU")
    return converted
