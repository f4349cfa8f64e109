"""What a surface is grown from: points, voxels of a mask or of labels, or the largest components of its cells."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.system.arguments import array_or_empty, name_parameter
from clrecon.system.light_dataclass import dataclass

AUTO = "auto"
"""Word for: the components with at least `AUTO_SHARE` of the cells of the largest."""

AUTO_SHARE = 0.05

SEED_REACH_MM = 10.0
"""A seed point selects the component of the nearest active cell, whose centre must be no farther away than this."""


@dataclass(frozen=True)
class Seeds:
    """Seeds of one surface; the components of all of them together are grown, with `auto` the largest components too.

    `points` are (n, 3), float64, LPS mm; `voxels` bits of the voxels that are seeds, (nk, nj, ceil(ni / 32)) uint32.
    """

    auto: bool
    points: NDArray[np.float64]
    voxels: NDArray[np.uint32] | None
    names: tuple[str, ...]

    @classmethod
    def read(cls, grow_from: Any, resident: DeviceVolume) -> Seeds:
        """Read the parameter ``grow_from`` of `extract_isosurface`: "auto", (3,) float, LabelMap, (LabelMap, label),
        Mask, or a list of these.

        Only those parts of the surface are made whose cells are connected with a seed, through faces of which one to
        three corners are inside; triangles of other parts are never made.  A point in LPS mm grows from the nearest
        cell of the surface, which is not more than `SEED_REACH_MM` away. A label or mask grows all parts that have one
        of its voxels at their inner side.  "auto" takes the parts with at least `AUTO_SHARE` of the cells of the
        largest.
        """
        items = _split_seeds(grow_from)
        points: list[NDArray[np.float64]] = []
        marked: NDArray[np.bool_] | None = None
        names: list[str] = []
        for item in items:
            if isinstance(item, str) and item == AUTO:
                names.append(AUTO)
                continue
            voxels, name = _read_voxels(item, resident)
            if voxels is None:
                point = _read_point(item)
                points.append(point)
                names.append(_describe_point(point))
                continue
            if not voxels.any():
                raise UsageError(f"{name_parameter('grow_from')}: {name} has no voxel in the volume")
            marked = voxels if marked is None else marked | voxels
            names.append(name)
        placed = np.array(points, np.float64).reshape(-1, 3)
        check_points(resident.volume, placed)
        return cls(AUTO in names, placed, None if marked is None else pack_seeds(marked), tuple(names))


def _split_seeds(grow_from: Any) -> list[Any]:
    if isinstance(grow_from, str) or hasattr(grow_from, "to_numpy") or hasattr(grow_from, "numbers"):
        return [grow_from]
    if isinstance(grow_from, np.ndarray):
        return list(np.atleast_2d(grow_from))
    if not isinstance(grow_from, Sequence) or not len(grow_from):
        return [grow_from]
    pair = len(grow_from) == 2 and hasattr(grow_from[0], "numbers") and isinstance(grow_from[1], (int, str))
    numbers = all(isinstance(item, (int, float, np.number)) for item in grow_from)
    return [grow_from] if pair or numbers else list(grow_from)


def _read_voxels(item: Any, resident: DeviceVolume) -> tuple[NDArray[np.bool_] | None, str]:
    """Return the voxels of a Mask, a LabelMap or one of its labels; None where the item is none of them."""
    shape = resident.volume.voxels.shape
    if hasattr(item, "to_numpy"):
        voxels = np.asarray(item.to_numpy(), bool)
        if voxels.shape != shape:
            raise UsageError(
                f"{name_parameter('grow_from')}: the mask has {voxels.shape} voxels, the volume has {shape}"
            )
        return voxels, str(getattr(item, "name", "a mask"))
    label_map, label = (item[0], item[1]) if isinstance(item, tuple) and len(item) == 2 else (item, None)
    if not hasattr(label_map, "numbers"):
        return None, ""
    brought = resident.bring(label_map).voxels
    if label is None:
        return brought != 0, "all labels"
    number = label_map.find(label)
    return brought == number, f"label {label_map.name(number)}"


def _read_point(item: Any) -> NDArray[np.float64]:
    point = array_or_empty(item)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise UsageError(
            f"{name_parameter('grow_from')} is {AUTO!r}, a point of three numbers in LPS mm, a label or a mask,"
            f" not {item!r}"
        )
    return point


def _describe_point(point: ArrayLike) -> str:
    return ",".join(f"{n:g}" for n in np.asarray(point))


def check_points(volume: Volume, points: NDArray[np.float64]) -> None:
    if not len(points):
        return
    size = np.array(volume.shape_ijk)
    for point, ijk in zip(points, volume.lps_to_ijk(points), strict=True):
        if not ((ijk >= -0.5) & (ijk <= size - 0.5)).all():
            low, high = volume.bounds
            box = ", ".join(f"{axis} {a:.1f} to {b:.1f}" for axis, a, b in zip("xyz", low, high, strict=True))
            raise UsageError(
                f"seed {_describe_point(point)} lies outside of the volume, which runs from {box} mm (LPS): check its"
                " coordinates and their frame, LPS or RAS"
            )


def pack_seeds(voxels: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Pack voxels (nk, nj, ni) into words of 32 along i, shape (nk, nj, ceil(ni / 32))."""
    padded = np.pad(voxels, ((0, 0), (0, 0), (0, -voxels.shape[2] % 32)))
    return np.packbits(padded, axis=2, bitorder="little").view("<u4").astype(np.uint32, copy=False)
