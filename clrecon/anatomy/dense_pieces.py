"""Pieces as dense as bone, connected components of cells that hold voxels above `DENSE_HU`: which belong to the body.

docs/table.md has the rules.  What lies in soft tissue is left to the patient: it may be the bone of a thin limb.  A dry
specimen has no soft tissue; there a piece is kept if it is not a table.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.body_cells import DENSE_HU, Cells, spread_mask
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.regions import CORNERS, Mask, Regions, find_holes
from clrecon.system.light_dataclass import dataclass
from clrecon.system.records import Gate, at_least, unmeasured

METAL_SHARE = 0.25
"""Least share of voxels above `SURE_METAL_HU` among the dense voxels of a piece of metal; their blurred edges are the
rest.  Jaws with teeth have a share below 0.1."""
BAR_MM, BAR_RATIO = 50.0, 3.0
"""Least length of a bar, in mm and as a multiple of its larger thickness."""
SECTION_MM = 12.0
"""Least length of the sections into which a bar is divided to measure its evenness."""
_SECTION_SPREAD, _EVEN_SECTIONS = 0.1, 0.75
"""At least this share of the sections of a bar differ by at most the first number, a share, from their median."""
_BEND_CELLS = 0.5
"""Largest distance of the middles of these sections from the axis, root mean square, in cells."""
THIN_MM = 10.0
"""A bar thicker than this must be solid along its axis, because the shafts of bones of this thickness are hollow."""
FEWEST_CELLS = 8
"""Smaller pieces have no shape."""
_RING_CELLS, _SOFT_RING = 2, 0.8
"""A piece lies in soft tissue if at least this share of the cells within so many cells of it is tissue."""


def find_equipment(cells: Cells, pieces: Regions, chosen: Mask, tissue: Mask) -> Mask:
    """Return which of the chosen pieces (count + 1,) are bars or metal and do not lie in soft tissue."""
    is_equipment = np.zeros_like(chosen)
    for number in np.flatnonzero(chosen).tolist():
        box, piece = pieces.crop(number, _RING_CELLS)
        # A clip on a rail is one piece with it: without the metal a bar is left.
        bar = piece & ~spread_mask(cells.metal[box] > 0)
        metal, dense = (of[box][piece].sum(dtype=np.float64) for of in (cells.metal, cells.dense))
        if metal >= METAL_SHARE * dense or _is_bar(bar, cells.mean[box], cells.size_mm[::-1]):
            ring = spread_mask(piece, _RING_CELLS) & ~piece
            is_equipment[number] = not ring.any() or tissue[box][ring].mean() < _SOFT_RING
    return is_equipment


def _is_bar(piece: Mask, hu: NDArray[np.float32], size_mm: tuple[float, ...]) -> bool:
    """Tell whether a piece is straight, long, and of the same cross section from end to end."""
    if np.count_nonzero(piece) < FEWEST_CELLS:
        return False
    weights = np.maximum(hu[piece].astype(np.float64), 1.0)
    offsets = np.argwhere(piece) * np.array(size_mm)
    offsets -= np.average(offsets, axis=0, weights=weights)
    _, axes = np.linalg.eigh((offsets.T * weights) @ offsets)
    across, along = offsets @ axes[:, :2], offsets @ axes[:, 2]
    cell = math.sqrt(size_mm[1] * size_mm[2])
    length, widths = np.ptp(along), np.ptp(across, axis=0) + cell
    if length < max(BAR_MM, BAR_RATIO * widths.max()):
        return False
    middles, sums = _measure_sections(along, across, weights, float(np.abs(axes[:, 2]) @ size_mm))
    even = np.abs(sums - np.median(sums)) <= _SECTION_SPREAD * np.median(sums)
    if even.mean() < _EVEN_SECTIONS or np.mean(np.sum(middles[even] ** 2, axis=1)) > (_BEND_CELLS * cell) ** 2:
        return False
    on_axis = np.sum(across**2, axis=1) <= cell**2
    is_solid = len(np.unique(along[on_axis] // SECTION_MM)) >= _EVEN_SECTIONS * length / SECTION_MM
    return bool(is_solid or widths.min() <= THIN_MM)


def _measure_sections(
    along: Float64Array, across: Float64Array, weights: Float64Array, cell_mm: float
) -> tuple[Float64Array, Float64Array]:
    """Divide a bar, without its ends, in sections; return middles, (n, 2) mm, and weights, cells spread along it."""
    ends = along.min() + 0.5 * cell_mm, along.max() - 0.5 * cell_mm
    edges = np.linspace(*ends, max(2, int((ends[1] - ends[0]) / SECTION_MM) + 1))
    shares = np.clip((edges[:, None] - along + 0.5 * cell_mm) / cell_mm, 0.0, 1.0)
    parts = np.diff(shares, axis=0) * weights
    sums = parts.sum(axis=1)
    return (parts @ across) / np.maximum(sums, 1e-9)[:, None], sums


Piece = tuple[int, tuple[float, ...]]
"""Number of voxels of a piece, and its middle, ijk."""

BONE_KEPT = 0.98
"""Least share of the bone that must stay; if less stays, the body was not found."""
_HARD_SHARE = 0.005
"""Least share of hard voxels in a piece of bone.  Tables have none; a thin cortex in coarse voxels has 0.02."""
SOLID_HU = 200.0
"""Cells whose mean is higher are bone.  The mean is used because noise lifts single voxels over any bound."""
_SOFT_PER_SOLID = 0.5
"""Cells of soft tissue for each cell of bone; patients have 2 or more (a head), dry specimens less than 0.1."""
_STRAIGHT_SHARE = 0.95
"""A column of cells belongs to a table when at least this share of it is dense enough."""
STRAIGHT_MM = 60.0
"""Couches are searched only in scans of at least this height; in shorter scans bones are as straight as a couch."""
UNIFORM_HU = 100.0
"""Largest standard deviation of the HU along a couch, due to noise and shadows; the cortex of a bone varies more."""
RAIL_MM = 10.0
"""Straight, uniform, hard pieces up to this thickness are rails or plates; shafts of long bones are thicker."""
CABLE_MM, CABLE_ML = 5.0, 3.0
"""A hard piece beside a patient is a cable if neither its thickness nor its volume is larger than these values."""
BODY_ML = 10.0
"""A hard piece beside a patient is a second body from this volume on; areas that it encloses in a slice count too."""
LONG_MM = 150.0
"""Beside a specimen, thin pieces without hard voxels and wide thin plates are equipment from this length on."""
GROWTH_MM = 6.0
"""Less dense tissue that touches a bone of a specimen belongs to the bone up to this distance."""
_MOST_SAID = 3
"""Most pieces that are named."""
BONELESS_ML = 3.0
"""Pieces of the body without bone are reported from this volume on."""
INSIDE, _HARD_INSIDE = 0.5, 0.25
"""Least share of a piece within the body if it belongs to the patient; for hard pieces the second, lower value."""


@dataclass(frozen=True)
class DensePieces:
    """Decision on all dense pieces: cells (ck, cj, ci) of the body, and of bone; `specimen` is bone without tissue."""

    specimen: bool
    added: Mask
    counted: Mask


@dataclass(frozen=True)
class _Pieces:
    """Connected components, with the number of voxels of each; entry 0 is for cells in no component."""

    regions: Regions
    dense: Float64Array
    hard: Float64Array

    @property
    def is_hard(self) -> Mask:
        """Pieces of bone or metal.  If no piece is hard, hardness tells nothing and all pieces count."""
        hard = (self.hard >= _HARD_SHARE * self.dense) & (self.dense > 0)
        return np.asarray(hard if hard.any() else self.dense > 0)

    def share_in(self, cells: Cells, mask: Mask) -> Float64Array:
        """Return for each piece the share of its dense voxels that lies in the mask."""
        return np.asarray(self.regions.sum_of(cells.dense * mask) / np.maximum(self.dense, 1.0))


def _label(cells: Cells, mask: Mask) -> _Pieces:
    regions = Regions(mask, CORNERS)
    return _Pieces(regions, regions.sum_of(cells.dense), regions.sum_of(cells.hard))


def find_dense_pieces(cells: Cells, tissue: Mask, thick: Mask, body: Mask) -> DensePieces:
    """Decide for every dense piece whether it belongs to the body and whether it counts as bone.

    tissue, thick, body: Cells (ck, cj, ci) that are not air, the thick ones, and those found by their thickness.
    """
    solid = cells.mean > SOLID_HU
    soft = thick & ~spread_mask(solid, 2)
    specimen = np.count_nonzero(soft) < _SOFT_PER_SOLID * np.count_nonzero(solid)
    return _of_specimen(cells, tissue) if specimen else _of_patient(cells, tissue, body)


def _of_patient(cells: Cells, tissue: Mask, body: Mask) -> DensePieces:
    """Decide for the scan of a patient, see docs/table.md; pieces that lie mostly within the body are added."""
    pieces = _label(cells, cells.dense > 0)
    hard = pieces.is_hard
    inside = pieces.share_in(cells, body)
    added = (inside >= INSIDE) | (hard & (inside >= _HARD_INSIDE))
    straight = np.broadcast_to((tissue & ~body).mean(axis=0) >= _STRAIGHT_SHARE, body.shape)
    loose = hard & ~added & (pieces.share_in(cells, straight) < 0.5)
    loose &= ~find_equipment(cells, pieces.regions, loose, tissue)
    apart = loose & (inside == 0.0)
    if apart.any():
        apart &= (_thickness(cells, pieces, apart) > CABLE_MM) | (pieces.dense * cells.voxel_ml > CABLE_ML)
    large = apart & (_room(cells, pieces, apart) >= BODY_ML)
    mask = pieces.regions.cells_of(added)
    if large.any():
        mask |= _with_edges(cells, pieces.regions.cells_of(large), tissue)
    return DensePieces(False, mask, pieces.regions.cells_of(added | apart | (loose & (inside > 0.0))))


def _of_specimen(cells: Cells, tissue: Mask) -> DensePieces:
    """Decide for a specimen: pieces are added and count, but for straight plates, rails and long thin ones not hard."""
    table = tissue & _straight_plates(cells, tissue)
    pieces = _label(cells, (cells.dense > 0) & ~table)
    bones = pieces.is_hard
    soft = (pieces.dense > 0) & ~bones
    if soft.any():
        soft &= ~(
            (pieces.regions.measure_diagonals(cells.size_mm) >= LONG_MM) & (_thickness(cells, pieces, soft) <= RAIL_MM)
        )
    bone = pieces.regions.cells_of(bones | soft)
    return DensePieces(True, _with_edges(cells, bone, tissue & ~table) if bone.any() else bone, bone)


def _with_edges(cells: Cells, bone: Mask, tissue: Mask) -> Mask:
    """Return dry bone and the less dense cells that touch it."""
    for _ in range(max(1, round(GROWTH_MM / cells.across))):
        bone = bone | (spread_mask(bone) & tissue)
    return bone


def _straight_plates(cells: Cells, tissue: Mask) -> Mask:
    """Return the columns, shape (cj, ci), that plates and rails fill from the first slice to the last.

    Columns without hard voxels are accepted at once.  Columns with hard voxels may belong to the shaft of a bone that
    lies on the table: they count only where they form a rail or a wide plate of uniform HU from end to end.
    """
    from scipy import ndimage

    straight = np.asarray(tissue.mean(axis=0) >= _STRAIGHT_SHARE)
    if tissue.shape[0] * cells.size_mm[2] < STRAIGHT_MM or not straight.any():
        return np.zeros_like(straight)
    dense, hard = (of.sum(axis=0, dtype=np.float64) for of in (cells.dense, cells.hard))
    table = straight & (hard < _HARD_SHARE * np.maximum(dense, 1.0))
    firm = straight & ~table
    if not firm.any():
        return table
    groups, count = ndimage.label(firm, np.ones((3, 3)))
    numbers = np.arange(count + 1)
    size = cells.size_mm[1::-1]
    uniform = ndimage.maximum(cells.mean.std(axis=0), groups, numbers) <= UNIFORM_HU
    wall = ndimage.maximum(_depth(firm, size), groups, numbers)
    whole = ndimage.maximum(_depth(ndimage.binary_fill_holes(firm), size), groups, numbers)
    wide = Regions(firm[None], CORNERS).measure_diagonals((*cells.size_mm[:2], 0.0)) >= LONG_MM
    plates = uniform & ((whole <= RAIL_MM) | (wide & (wall <= RAIL_MM)))
    plates[0] = False
    return np.asarray(table | plates[groups])


def _depth(mask: Mask, size_mm: tuple[float, ...]) -> Float64Array:
    """Estimate the thickness at each cell of a mask, mm: twice the distance to the outside, less one cell."""
    from scipy import ndimage

    depth = ndimage.distance_transform_edt(np.pad(mask, 1), sampling=size_mm)
    return np.asarray(2.0 * depth[tuple(slice(1, -1) for _ in mask.shape)] - min(size_mm))


def _thickness(cells: Cells, pieces: _Pieces, chosen: Mask) -> Float64Array:
    """Return the largest thickness of each chosen piece, mm; 0 for the others."""
    thickest = np.zeros(len(chosen))
    for number in np.flatnonzero(chosen).tolist():
        thickest[number] = _depth(pieces.regions.crop(number)[1], cells.size_mm[::-1]).max()
    return thickest


def _room(cells: Cells, pieces: _Pieces, chosen: Mask) -> Float64Array:
    """Return the volume of each chosen piece with the regions that it encloses in each slice, ml; 0 for the others."""

    room = np.zeros(len(chosen))
    for number in np.flatnonzero(chosen).tolist():
        _, layers = pieces.regions.crop(number)
        room[number] = np.count_nonzero(layers | find_holes(layers))
    return room * math.prod(cells.size_mm) / 1000.0


def judge_bone(cells: Cells, pieces: DensePieces, chosen: Mask) -> tuple[dict[str, Any], Gate]:
    """Count the dense voxels that stay in the body (`chosen`), and judge ``bone_kept`` by `BONE_KEPT`."""
    bone = int(cells.dense[pieces.counted].sum(dtype=np.int64))
    lost = int(cells.dense[pieces.counted & ~chosen].sum(dtype=np.int64))
    removed = int(cells.dense[~chosen].sum(dtype=np.int64))
    share = 1.0 - lost / bone if bone else None
    facts = {
        "specimen": pieces.specimen,
        "bone_voxels": bone,
        "bone_voxels_removed": lost,
        "bone_kept": None if share is None else round(share, 6),
        "other_voxels_removed": removed - lost,
    }
    words = f"share of the {bone:,} voxels of bone above {DENSE_HU:g} HU that stay without the table"
    return facts, _judge_share("bone_kept", share, words)


def _judge_share(name: str, share: float | None, words: str) -> Gate:
    if share is None:
        return unmeasured(name, BONE_KEPT, None, f"no bone above {DENSE_HU:g} HU")
    return at_least(name, share, BONE_KEPT, None, words)


def find_removed(cells: Cells, pieces: DensePieces, chosen: Mask) -> list[Piece]:
    """Return the largest pieces of bone that are removed; parameters as of `judge_bone`."""
    lost = _label(cells, pieces.counted & ~chosen)
    return _list_largest(cells, lost.regions, lost.dense, cells.dense)


def find_boneless(cells: Cells, chosen: Mask, tissue: Mask) -> list[Piece]:
    """Return the largest pieces of the body (`chosen`) that hold no bone, beside others that do."""
    parts = _label(cells, chosen)
    has_bone = parts.is_hard & (parts.hard > 0.0)
    if not has_bone.any():
        return []
    voxels = math.prod(cells.step) * parts.regions.sum_of(tissue)
    voxels[has_bone | (voxels * cells.voxel_ml < BONELESS_ML)] = 0.0
    return _list_largest(cells, parts.regions, voxels, tissue)


def _list_largest(cells: Cells, regions: Regions, voxels: Float64Array, weights: NDArray[Any]) -> list[Piece]:
    """Return the pieces with the most voxels, at most `_MOST_SAID`, with their middles."""
    largest = []
    for number in np.argsort(-voxels, kind="stable")[:_MOST_SAID]:
        if voxels[number]:
            places = regions.places_of(number)
            middle = np.average(places[::-1], axis=1, weights=weights[places])
            ijk = tuple((place + 0.5) * step - 0.5 for place, step in zip(middle, cells.step, strict=True))
            largest.append((int(voxels[number]), ijk))
    return largest


def judge_circle(cells: Cells, inside: Mask) -> tuple[dict[str, Any], Gate]:
    """Count the voxels of bone that a circle cuts off, to a cell (cj, ci), and judge ``bone_in_circle`` by `BONE_KEPT`.

    ``bone_voxels`` are above 300 HU in pieces of bone, ``bone_voxels_apart`` in pieces that lie wholly outside.
    """
    pieces = _label(cells, cells.dense > 0)
    hard = (pieces.hard >= _HARD_SHARE * pieces.dense) & (pieces.dense > 0)
    stays = pieces.share_in(cells, np.broadcast_to(inside, cells.dense.shape))
    bone = int(pieces.dense[hard].sum())
    lost = round(float((pieces.dense * (1.0 - stays))[hard].sum()))
    share = 1.0 - lost / bone if bone else None
    facts = {
        "bone_voxels": bone,
        "bone_voxels_removed": lost,
        "bone_voxels_apart": int(pieces.dense[hard & (stays == 0.0)].sum()),
        "bone_kept": None if share is None else round(share, 6),
    }
    words = f"share of the {bone:,} voxels of bone above {DENSE_HU:g} HU that lie in the circle"
    return facts, _judge_share("bone_in_circle", share, words)
