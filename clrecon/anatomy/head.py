"""Heads: whether a scan shows one, and the warning about surfaces and pictures of its skin.

A face, and the whole outer surface of a head, identifies a patient (Chen et al. 2014; Mazura et al. 2012).  The vault
of the skull is told from the scan itself: in slices across the body it is a closed ring of bone around a large area of
soft tissue.  No other part of the body has one: the ring of a vertebra is small, and ribs and pelvis leave gaps.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.affine import column_spacing
from clrecon.geometry.regions import FACES, Regions

SKIN_HU = (-950.0, 150.0)
"""At iso values in this range, between air and bone, the outermost surface is the skin."""
SKIN_SEEN_HU = (-950.0, 100.0)
"""A picture shows the skin if HU in this range are not transparent; colours of bone may begin above the range."""
CLEAR_SKIN_HU = (-950.0, -200.0)
"""At iso values between air and fat the surface is nothing but skin.  A scan without a vault may then be of a face."""
BONE_HU, AIR_HU = 220.0, -400.0
"""Voxels from `BONE_HU` on are bone, and voxels below `AIR_HU` are air."""
SOFT_HU = (-10.0, 110.0)
"""Median HU inside the vault of a skull: brain has 20 to 45; contrast medium and beam hardening increase it."""
PIXEL_MM, SLICE_MM = 2.0, 5.0
"""Pixel size and slice distance of the coarse search for a head."""
VAULT_CM2, VAULT_MM = (35.0, 320.0), (60.0, 210.0)
"""Range of the area that the vault of a skull encloses in a slice, and of the width and length of this area."""
VAULT_SLICES_MM = 12.0
"""Least height over which slices show the vault of a skull."""
TRUNK_CM2 = 330.0
"""A slice of a body with a larger area belongs to a trunk; the largest slice of a head has about 250 cm2."""
_CUT_SHARE = 0.75
"""Share of the border of a slice that is body from which the body counts as cut all round."""
SKIN_CM2 = 40.0
"""From this area on, a label's surface beside the air around a head counts as skin; a face has over 200 cm2."""
BESIDE_MM = 2.0
"""A surface is skin only where there is air at this distance outside of the surface."""
OPEN_MM = 16.0
"""Passages narrower than this do not connect the air of nose, sinuses and ears with the air around a head."""
MOST_SAMPLES = 20_000
"""Triangles that stand for all of a mesh."""

SAID = "a {} of the skin can show a face: treat the file as one that identifies the patient"

_judged: WeakKeyDictionary[Any, bool | None] = WeakKeyDictionary()
_airs: WeakKeyDictionary[Any, tuple[NDArray[np.bool_], NDArray[Any]]] = WeakKeyDictionary()


def warn_of_face(volume: Volume, values: Iterable[float | None], subject: str) -> list[str]:
    """Return the warning about a "surface" or "picture" (`subject`) that shows one of some HU, if it can be a face."""
    if not any(value is not None and shows_face(volume, value) for value in values):
        return []
    return [SAID.format(subject)]


def warn_of_skin(volume: Volume, vertices: NDArray[Any], triangles: NDArray[Any]) -> list[str]:
    """Return the warning about the surface of a label, if it shows the skin of a head, see `measure_skin`."""
    if find_head(volume) is not True or volume.report.get("outside_air") is not None:
        return []
    return [SAID.format("surface")] if measure_skin(volume, vertices, triangles) >= SKIN_CM2 else []


def measure_skin(volume: Volume, vertices: NDArray[Any], triangles: NDArray[Any]) -> float:
    """Measure the area of a surface, whose triangles face outwards, that lies beside the air around a patient, in cm2.

    Right to some cm2: the air is told on a grid of about 2 mm, and at most `MOST_SAMPLES` triangles stand for all.
    """
    if volume not in _airs:
        _airs[volume] = _outer_air(volume)
    outer, steps = _airs[volume]
    every = -(-len(triangles) // MOST_SAMPLES) or 1
    corners = vertices[triangles[::every]].astype(np.float64)
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(crossed, axis=1)
    is_flat = lengths == 0.0
    outwards = crossed / np.where(is_flat, 1.0, lengths)[:, None]
    ijk = volume.lps_to_ijk(corners.mean(axis=1) + BESIDE_MM * outwards)
    cells = np.round(ijk[:, ::-1] / steps).astype(int)
    inside = np.all((cells >= 0) & (cells < outer.shape), axis=1) & ~is_flat
    beside = np.zeros(len(cells), bool)
    beside[inside] = outer[tuple(cells[inside].T)]
    return float(every * 0.5 * lengths[beside].sum() / 100.0)


def _outer_air(volume: Volume) -> tuple[NDArray[np.bool_], NDArray[Any]]:
    """The air around the patient on a coarse grid: every n-th voxel along k, j and i, and these numbers n."""
    from scipy import ndimage

    spacing = np.array(column_spacing(volume.affine))[::-1]
    steps = np.maximum(1, np.round(PIXEL_MM / spacing).astype(int))
    air = volume.voxels[tuple(slice(None, None, step) for step in steps)] < AIR_HU
    reach = 2 * np.round(OPEN_MM / 2.0 / (spacing * steps)).astype(int) + 1
    parts = Regions(ndimage.minimum_filter(air, size=tuple(reach), mode="nearest"), FACES)
    return ndimage.maximum_filter(parts.cells_of(parts.reach_border((0, 1, 2))), size=tuple(reach)) & air, steps


def shows_face(volume: Volume, hu: float) -> bool:
    """Tell whether the outermost surface of a scan at a level can show a face; not where the air was left out."""
    if not SKIN_HU[0] <= hu <= SKIN_HU[1] or volume.report.get("outside_air") is not None:
        return False
    head = find_head(volume)
    return CLEAR_SKIN_HU[0] <= hu <= CLEAR_SKIN_HU[1] if head is None else head


def find_head(volume: Volume) -> bool | None:
    """Tell whether slices show the vault of a skull; False where a trunk fills every slice; None for all else."""
    if volume not in _judged:
        _judged[volume] = _judge_head(volume)
    return _judged[volume]


def _judge_head(volume: Volume) -> bool | None:
    vault = 0.0
    trunk, bodies = 0, 0
    for plane, pixels_mm, step in _coarse_slices(volume):
        vault += step * _has_vault(plane, pixels_mm)
        area = float((plane > AIR_HU).sum()) * pixels_mm[0] * pixels_mm[1] / 100.0
        border = np.concatenate([plane[0], plane[-1], plane[1:-1, 0], plane[1:-1, -1]])
        bodies += area > 0.0
        trunk += area >= TRUNK_CM2 or float((border > AIR_HU).mean()) >= _CUT_SHARE
    if vault >= VAULT_SLICES_MM:
        return True
    return False if bodies and trunk == bodies else None


def _coarse_slices(volume: Volume) -> Iterator[tuple[NDArray[Any], tuple[float, float], float]]:
    """Yield slices across the body, each pixel the highest of those that it stands for, with both their steps in mm."""
    spacing = np.array(column_spacing(volume.affine))[::-1]  # of k, j, i
    upwards = np.abs(volume.affine[2, :3])[::-1] / spacing
    axis = int(np.argmax(upwards))
    across = np.moveaxis(volume.voxels, axis, 0)
    steps = np.delete(spacing, axis)
    every = max(1, int(SLICE_MM / spacing[axis]))
    blocks = [max(1, round(PIXEL_MM / step)) for step in steps]
    for first in range(0, across.shape[0], every):
        plane = across[first]
        starts = [np.arange(0, extent, block) for extent, block in zip(plane.shape, blocks, strict=True)]
        plane = np.maximum.reduceat(np.maximum.reduceat(plane, starts[0], axis=0), starts[1], axis=1)
        yield plane, (blocks[0] * steps[0], blocks[1] * steps[1]), every * spacing[axis]


def _has_vault(plane: NDArray[Any], pixels_mm: tuple[float, float]) -> bool:
    """Tell whether bone encloses an area of soft tissue of the size of a vault."""
    from scipy import ndimage

    bone = plane >= BONE_HU
    pixel_cm2 = pixels_mm[0] * pixels_mm[1] / 100.0
    enclosed, count = ndimage.label(ndimage.binary_fill_holes(bone) & ~bone)
    if count == 0:
        return False
    sizes = np.bincount(enclosed.ravel())[1:] * pixel_cm2
    largest = int(np.argmax(sizes))
    if not VAULT_CM2[0] <= sizes[largest] <= VAULT_CM2[1]:
        return False
    box = ndimage.find_objects(enclosed, max_label=largest + 1)[largest]
    extents = [(part.stop - part.start) * step for part, step in zip(box, pixels_mm, strict=True)]
    if min(extents) < VAULT_MM[0] or max(extents) > VAULT_MM[1]:
        return False
    return bool(SOFT_HU[0] <= float(np.median(plane[enclosed == largest + 1])) <= SOFT_HU[1])
