"""`VertebraInside`: solid bone, dense and trabecular bone and the canal of one vertebra, and local thickness in mm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.labels import LabelMap
from clrecon.labels.canal import Canal, find_canal
from clrecon.labels.label_levels import count_ml
from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.operators.masks.mask import Mask
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cortex_mesh import CortexReport
from clrecon.operators.surface.label_masks import extract_label_masks
from clrecon.operators.vertebrae.solid import CLOSE_MM, LabelCrop, crop_label, label_margin, make_solid
from clrecon.system.arguments import SurfaceKind, explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.records import Record
from clrecon.system.text import format_volume

MOST_RADIUS_MM = 8.0
"""Bone into which a larger ball fits is not a shell."""


@dataclass(frozen=True, eq=False)
class ShellThickness(Record):
    """How thick a shell of bone is.

    What is not thicker than `limit_mm`, two voxels by their largest step, is not resolved; the other figures are of the
    `resolved_share` of its voxels, at places that are thicker, None where there are none.
    """

    limit_mm: float
    resolved_share: float
    median_mm: float | None
    p95_mm: float | None


def measure_thickness(mask: Mask) -> ShellThickness:
    """Measure the local thickness of a mask: at each voxel that of the largest ball within the mask that holds it.

    The radii begin with the largest step of the voxels, so that three voxels fit across in each direction, and grow by
    half the smallest step.  A ball of lattice points fits into a plate of an odd number of voxels as long as its
    diameter is not above the plate's thickness; of an even number it tells one voxel less.

    References
    ----------
    Hildebrand and Rüegsegger 1997, A new method for the model-independent assessment of thickness in three-dimensional
    images.
    """
    spacing = mask.scan.spacing
    first, step = max(spacing), min(spacing) / 2.0
    radii = np.arange(first, max(MOST_RADIUS_MM, first) + step, step)
    counts = []
    for radius in radii:
        counts.append(mask.open(float(radius)).count)
        if not counts[-1]:
            break
    limit, total = 2.0 * first, mask.count
    if not total or not counts[0]:
        return ShellThickness(limit, 0.0, None, None)
    left = np.maximum.accumulate(np.array([*counts, 0])[::-1])[::-1]  # openings by lattice balls may grow again
    voxel_counts = -np.diff(left)  # voxels whose largest ball is that of each radius
    thickness = 2.0 * radii[: len(voxel_counts)]
    share = np.cumsum(voxel_counts) / voxel_counts.sum()
    median, p95 = (float(thickness[np.searchsorted(share, part)]) for part in (0.5, 0.95))
    return ShellThickness(limit, counts[0] / total, median, p95)


DENSE_HU = (450.0, None)
"""Band of dense bone: values from half way between soft tissue and thin cortex (850 HU) on."""

PARTS = ("dense", "trabecular", "canal", "solid")
"""Parts by the order of their numbers, from 1, in `VertebraInside.to_label_map`; solid is dense and trabecular."""

NEIGHBOUR_HU = 150.0
"""Voxels of other labels from this value on are bone, not canal; spinal cord and dural sac lie below 100 HU."""

_MISSED_SHARE = 0.1
"""Warn where this share of the band around a label lies in the next voxel outside of it."""

LEAST_CANAL_MM = 4.5
"""Lower canals give a warning: pedicles are 6 mm high in the neck and 14 mm in the lumbar spine, less if one slice cuts
both in a vertebra that is tilted sideways."""


@dataclass(frozen=True, eq=False)
class VertebraInside:
    """The parts of one vertebra as masks, made by `vertebra_inside`.

    All masks are of ``volume``, the part of the scan around the vertebra at its place in the patient.

    Attributes
    ----------
    label : int
    name : str
    volume : Volume
        Its axes are in the order that makes the slices as axial as they can be.
    solid : Mask
        All bone, without the canal.
    dense : Mask
        Voxels of the solid bone in the band ``dense_hu``.
    trabecular : Mask
        The rest of the solid bone.
    canal : Mask or None
        Hole of the arch at the pedicles' height; None where the arch is closed nowhere.
    dense_hu : (float, float)
        Both ends included; infinity where an end is open.
    iso_value : float or None
        Level of the solid bone, HU; None: the label's own voxels.
    inside_share : float
        Share of the label's voxels that lie in the scan.
    thickness : ShellThickness
        Of the dense bone.
    canal_found : Canal or None
    cortex : CortexReport or None
        What the fit of the solid bone's surface found, where it was asked for.
    warnings : list of str
    """

    label: int
    name: str
    volume: Volume
    solid: Mask
    dense: Mask
    trabecular: Mask
    canal: Mask | None
    dense_hu: tuple[float, float]
    iso_value: float | None
    inside_share: float
    thickness: ShellThickness
    canal_found: Canal | None
    cortex: CortexReport | None
    warnings: list[str]

    def __reduce__(self) -> NoReturn:
        """Refuse to be pickled or copied: buffers stay with their process."""
        raise TypeError("a VertebraInside belongs to its process: send to_label_map(), as_dict() and the meshes")

    def __repr__(self) -> str:
        parts = ", ".join(f"{name} {format_volume(ml)}" for name, ml in self.volumes_ml.items())
        return f"VertebraInside({self.name}: {parts})"

    @property
    def masks(self) -> dict[str, Mask]:
        """The masks by the names of ``PARTS``, without those that are absent or empty."""
        by_name = {name: getattr(self, name) for name in PARTS}
        return {name: mask for name, mask in by_name.items() if mask is not None and mask.count}

    @cached_property
    def volumes_ml(self) -> dict[str, float]:
        """Volume of each part, ml: the sum over its voxels."""
        voxel_ml = slice_voxel_ml(self.volume)
        everywhere = tuple(slice(0, size) for size in self.volume.voxels.shape)
        return {
            name: count_ml(mask.to_numpy(), 1, everywhere, voxel_ml)  # type: ignore[arg-type]
            for name, mask in self.masks.items()
        }

    def to_label_map(self) -> LabelMap:
        """Return parts that do not overlap as a label map: dense 1, trabecular 2, canal 3, on the grid of ``volume``.

        Raises
        ------
        UsageError
            The slices of the scan are uneven: no label map has such a grid.
        """
        return self._map({name: mask for name, mask in self.masks.items() if name != "solid"})

    @explains_arguments
    def extract_meshes(self, *, memory: int | None = None) -> dict[str, Mesh]:
        """Return the surface of each part, as `extract_label_masks` makes it, by the names of ``PARTS``.

        Dense and trabecular bone share the vertices of their border; the outer surface is that of ``solid``.

        Parameters
        ----------
        memory : int, optional
            Most bytes on the device.

        Raises
        ------
        UsageError
            As `to_label_map`.
        DeviceError
            As `extract_label_masks`.
        """
        meshes: dict[str, Mesh] = {}
        for names in (PARTS[:-1], PARTS[-1:]):
            masks = {name: mask for name, mask in self.masks.items() if name in names}
            label_masks = extract_label_masks(self._map(masks), device=self.solid.device, memory=memory)
            meshes |= {PARTS[number - 1]: mesh for number, mesh in label_masks.items()}
        for mesh in meshes.values():
            mesh.report["certificate"] = self.volume.report
        return {name: meshes[name] for name in PARTS if name in meshes}

    def as_dict(self) -> dict[str, Any]:
        """Return what was found as plain JSON types."""
        canal = self.canal_found
        surface = "cortex" if self.cortex else "iso value"
        return {
            "label": self.label,
            "name": self.name,
            "label_inside_share": self.inside_share,
            "solid_of": "label" if self.iso_value is None else surface,
            "iso_value_hu": self.iso_value,
            "dense_hu": [None if math.isinf(end) else end for end in self.dense_hu],
            "spacing_mm": list(self.volume.spacing),
            "volumes_ml": {name: self.volumes_ml.get(name) for name in PARTS},
            "dense_thickness": self.thickness.as_dict(),
            "canal_height_mm": None if canal is None else canal.height_mm,
            "canal_closed_slices": None if canal is None else canal.closed_slices,
            "cortex": self.cortex and self.cortex.as_dict(),
            "warnings": list(self.warnings),
        }

    def _map(self, masks: dict[str, Mask]) -> LabelMap:
        if self.volume.uneven:
            raise UsageError(
                "the slices of the scan are uneven: parts have masks and volumes, but no label map or mesh"
            )
        voxels = np.zeros(self.volume.voxels.shape, np.uint8)
        for name, mask in masks.items():
            voxels[mask.to_numpy()] = PARTS.index(name) + 1
        return LabelMap(voxels, self.volume.affine, {PARTS.index(name) + 1: name for name in masks})


@explains_arguments
def vertebra_inside(
    volume: Volume,
    labels: LabelMap,
    label: int | str,
    iso_value: float | None = None,
    *,
    surface: SurfaceKind = "hu",
    dense: Sequence[float | None] = DENSE_HU,
    close_mm: float = CLOSE_MM,
    grow_mm: float | None = None,
    device: Device | str | int | None = None,
    memory: int | None = None,
) -> VertebraInside:
    """Look into one vertebra: its solid bone, what of it is dense and what trabecular, and its canal.

    The canal is the largest hole of the arch, slice by slice, joined, and cut at the pedicles' height.  Dense bone is a
    band of HU and no cortex: thin cortex looks thicker and less dense than it is.

    Parameters
    ----------
    volume : Volume
    labels : LabelMap
        On any grid, with filled labels.
    label, iso_value, surface, close_mm, grow_mm
        Of the solid bone, as `vertebra_solid` takes them.
    dense : (low, high)
        Band of HU, both ends included; None leaves an end open.
    device : Device, str or int, optional
        See `clrecon.device`.
    memory : int, optional
        Most bytes on the device.

    Returns
    -------
    VertebraInside

    Raises
    ------
    UsageError
        These are not a Volume and a LabelMap, the map has no such label, the band or a length is no such thing, or a
        growth is given without an iso value.
    RefusedInputError
        The map names another frame of reference, lies outside of the volume, or this label does.
    NoSurfaceError
        No voxel of the label has the iso value, every voxel around it has, or none of its solid bone lies in the band.
    DeviceError
        The device has no room, or it fails.
    """
    band = _checked_dense(dense)
    crop = crop_label(volume, labels, label, label_margin(volume, close_mm, grow_mm))
    with DeviceVolume(crop.volume, device=device, memory=memory) as resident:
        solid, others, cortex = make_solid(resident, crop, iso_value, surface, close_mm, grow_mm)
        in_band = _mark_band(resident, band, solid, crop)
        dense_bone = in_band & solid
        if not dense_bone.count:
            raise _refuse_band(crop, solid, band)
        canal_found = find_canal(solid.to_numpy(), crop.volume) if crop.axial else None
        canal = None
        if canal_found is not None:  # other labels that are bone are neighbours; the cord and the sac have labels too
            canal = Mask.from_array(resident, canal_found.voxels) - (others & _mark_bone(resident))
    trabecular = solid - dense_bone
    dense_bone.name, trabecular.name = name_band(band), f"solid bone without {name_band(band)}"
    if canal is not None:
        canal.name = f"canal of {crop.name}"
    warnings = [*crop.warnings, *_warn_of_canal(crop, canal_found)]
    if iso_value is None:
        warnings += _warn_of_missed(in_band, dense_bone, solid, others, band)
    return VertebraInside(
        crop.number, crop.name, crop.volume, solid, dense_bone, trabecular, canal, band, iso_value,
        crop.inside_share, measure_thickness(dense_bone), canal_found, cortex, warnings,
    )  # fmt: skip


def name_band(band: Sequence[float | None]) -> str:
    """Write a band of HU as text: ``450 HU and above``, ``450 to 900 HU``."""
    low, high = _checked_dense(band)
    if math.isinf(high):
        return f"{low:g} HU and above"
    return f"{high:g} HU and below" if math.isinf(low) else f"{low:g} to {high:g} HU"


def _checked_dense(dense: Sequence[float | None]) -> tuple[float, float]:
    """Return the band of dense bone, infinite where it is open."""
    try:
        low, high = dense
        ends = (-math.inf if low is None else float(low), math.inf if high is None else float(high))
    except (TypeError, ValueError, OverflowError):
        ends = (math.nan, math.nan)
    if not ends[0] <= ends[1] or all(map(math.isinf, ends)):
        raise UsageError(
            f"dense bone is a band of HU, (low, high), the lower one first, None for an open end; not {dense!r}"
        )
    return ends


def _mark_band(resident: DeviceVolume, band: tuple[float, float], solid: Mask, crop: LabelCrop) -> Mask:
    try:
        return Mask.from_band(resident, band)
    except NoSurfaceError:  # the type of the voxels has no such value
        raise _refuse_band(crop, solid, band) from None


def _mark_bone(resident: DeviceVolume) -> Mask:
    try:
        return Mask.from_band(resident, (NEIGHBOUR_HU, math.inf))
    except NoSurfaceError:  # the type of the voxels has no such value
        return Mask.from_array(resident, np.zeros(resident.volume.voxels.shape, np.bool_))


def _refuse_band(crop: LabelCrop, solid: Mask, band: tuple[float, float]) -> NoSurfaceError:
    hu: NDArray[Any] = crop.volume.voxels[solid.to_numpy()]
    return NoSurfaceError(
        f"no voxel of label {crop.number} {crop.name} has {name_band(band)}: its bone runs from {float(hu.min()):g} to"
        f" {float(hu.max()):g} HU"
    )


def _warn_of_canal(crop: LabelCrop, canal: Canal | None) -> list[str]:
    called = f"label {crop.number} {crop.name}"
    if not crop.axial:
        return [f"no canal of {called}: the slices are not axial, and uneven ones are not turned"]
    if canal is None:
        return [f"no canal of {called}: its arch is closed in no slice, nor in some neighbouring slices together"]
    if canal.height_mm < LEAST_CANAL_MM:
        return [
            f"the canal of {called} is {canal.height_mm:.3g} mm high: pedicles are higher; the label has gaps, is cut"
            " or tilted sideways"
        ]
    return []


def _warn_of_missed(in_band: Mask, dense: Mask, solid: Mask, others: Mask, band: tuple[float, float]) -> list[str]:
    """Warn of a label that ends before the dense bone does."""
    beside = in_band & (solid.dilate(min(max(solid.scan.spacing), 3.0)) - solid - others)
    share = beside.count / (beside.count + dense.count)
    if share < _MISSED_SHARE:
        return []
    return [
        f"{100 * share:.0f} % of the bone of {name_band(band)} lies in the next voxel outside of the label:"
        f" masks end before bone does; {name_parameter('iso_value', 'N')} takes it in"
    ]
