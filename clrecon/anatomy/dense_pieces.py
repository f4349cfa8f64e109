"""Pieces as dense as bone: which of them belong to the body, which are equipment, and what share of the bone stays.

A piece is a connected component of cells that hold voxels above `DENSE_HU`.  Three facts tell bone from a table:

- Plastic and carbon fibre have next to no voxels above `HARD_HU`; bone has, teeth and metal too.
- A table moves through the scanner along the step of the slices, so its cross section is the same in all of them:
  its columns of cells are full from the first slice to the last.  Bones taper and bend.
- Plates and rails are thin.

A patient is wrapped in soft tissue, of which there is more than of bone; a dry specimen has none.  Of a patient a
piece is kept where most of it lies within the body, and a piece beside it that is large enough to be a second body.
Of a specimen every piece is kept that is no table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.body_cells import DENSE_HU, Cells, Mask
from clrecon.system.gates import Gate, at_least, unmeasured

__all__ = ["BONE_KEPT", "DensePieces", "find_dense_pieces", "judge_bone", "judge_circle"]

Float64Array = NDArray[np.float64]

BONE_KEPT = 0.98
"""Least share of the bone that stays; below it what was found is not the body."""
HARD_SHARE = 0.005
"""Pieces of bone have at least this share of hard voxels, tables none; a thin cortex in coarse voxels has 0.02."""
SOLID_HU = 200.0
"""Cells with this mean are bone; noise lifts single voxels over any bound."""
SOFT_PER_SOLID = 0.5
"""Cells of soft tissue for one cell of bone: patients have 2 and more (a head), dry specimens below 0.1."""
STRAIGHT_SHARE = 0.95
"""A column of cells is of a table when this share of it is dense enough."""
STRAIGHT_MM = 60.0
"""In shorter scans bones are as straight as a table."""
UNIFORM_HU = 100.0
"""Largest deviation of the HU along a table: noise and shadows.  The cortex of a bone changes its thickness."""
RAIL_MM = 10.0
"""Thickness up to which what is straight, uniform and hard is a rail or a plate; shafts of long bones are thicker."""
CABLE_MM, CABLE_ML = 5.0, 3.0
"""A hard piece beside a patient is a cable when it is no thicker than this and takes no more room."""
BODY_ML = 10.0
"""A hard piece beside a patient is another body when it takes this much room, with what it encloses in a slice."""
LONG_MM = 150.0
"""Thin pieces without hard voxels beside a specimen, and thin plates, are equipment when they are longer than this."""
GROWTH_MM = 6.0
"""What is less dense and hangs on a bone of a specimen belongs to it as far as this."""
INSIDE, HARD_INSIDE = 0.5, 0.25
"""A piece belongs to a patient with this share of it within the body; where it is hard, with less."""


@dataclass(frozen=True)
class DensePieces:
    """What was decided.

    Attributes
    ----------
    specimen : bool
        The scan shows dry bone without soft tissue.
    added : ndarray, shape (ck, cj, ci), bool
        Cells that belong to the body beside those that were found by their thickness.
    counted : ndarray, shape (ck, cj, ci), bool
        Dense cells that count as bone.
    """

    specimen: bool
    added: Mask
    counted: Mask


@dataclass(frozen=True)
class _Pieces:
    """Connected components, with the voxels of each; entry 0 is what is in none."""

    labels: NDArray[np.int32]
    dense: Float64Array
    hard: Float64Array

    @property
    def is_hard(self) -> Mask:
        """Pieces of bone or metal; all of them where none is hard, which then tells nothing."""
        hard = (self.hard >= HARD_SHARE * self.dense) & (self.dense > 0)
        return np.asarray(hard if hard.any() else self.dense > 0)

    def share_in(self, cells: Cells, mask: Mask) -> Float64Array:
        """Share of the dense voxels of each that lies in the mask."""
        within = np.bincount(self.labels[mask], weights=cells.dense[mask], minlength=len(self.dense))
        return np.asarray(within / np.maximum(self.dense, 1.0))

    def cells_of(self, chosen: Mask) -> Mask:
        picked = chosen.copy()
        picked[0] = False
        return np.asarray(picked[self.labels])


def _label(cells: Cells, mask: Mask) -> _Pieces:
    from scipy import ndimage

    labels, count = ndimage.label(mask, np.ones((3, 3, 3)))
    dense, hard = (_sum_by(labels, of, count) for of in (cells.dense, cells.hard))
    return _Pieces(labels, dense, hard)


def _sum_by(labels: NDArray[np.int32], of: NDArray[Any], count: int) -> Float64Array:
    """Sum for each label; 0 for label 0."""
    labelled = labels > 0
    return np.bincount(labels[labelled], weights=of[labelled], minlength=count + 1).astype(np.float64)


def find_dense_pieces(cells: Cells, tissue: Mask, thick: Mask, body: Mask) -> DensePieces:
    """Decide on every dense piece.

    Parameters
    ----------
    cells : Cells
    tissue : ndarray, shape (ck, cj, ci), bool
        Cells that are no air.
    thick : ndarray, shape (ck, cj, ci), bool
        Of these the thick ones.
    body : ndarray, shape (ck, cj, ci), bool
        What was found by its thickness, without margin; all False where there is nothing.
    """
    from scipy import ndimage

    solid = cells.mean > SOLID_HU
    soft = thick & ~ndimage.binary_dilation(solid, iterations=2)
    specimen = np.count_nonzero(soft) < SOFT_PER_SOLID * np.count_nonzero(solid)
    return (_of_specimen if specimen else _of_patient)(cells, tissue, body)


def _of_patient(cells: Cells, tissue: Mask, body: Mask) -> DensePieces:
    """Pieces that lie for the most part in the body are added; hard ones that reach into it count.

    A hard piece apart from the body counts too, unless it is a cable, and a large one is added: a second body.  What is
    as straight as a table is one.
    """
    pieces = _label(cells, cells.dense > 0)
    hard = pieces.is_hard
    inside = pieces.share_in(cells, body)
    added = (inside >= INSIDE) | (hard & (inside >= HARD_INSIDE))
    straight = np.broadcast_to((tissue & ~body).mean(axis=0) >= STRAIGHT_SHARE, body.shape)
    loose = hard & ~added & (pieces.share_in(cells, straight) < 0.5)
    apart = loose & (inside == 0.0)
    if apart.any():
        apart &= (_thickness(cells, pieces, apart) > CABLE_MM) | (pieces.dense * cells.voxel_ml > CABLE_ML)
    large = apart & (_room(cells, pieces, apart) >= BODY_ML)
    mask = pieces.cells_of(added)
    if large.any():
        mask |= _with_edges(cells, pieces.cells_of(large), tissue)
    return DensePieces(False, mask, pieces.cells_of(added | apart | (loose & (inside > 0.0))))


def _of_specimen(cells: Cells, tissue: Mask, body: Mask) -> DensePieces:
    """All pieces are added and count but tables: straight plates and rails, long thin pieces without hard voxels."""
    table = tissue & _straight_plates(cells, tissue)
    pieces = _label(cells, (cells.dense > 0) & ~table)
    kept = pieces.is_hard
    soft = (pieces.dense > 0) & ~kept
    if soft.any():
        soft &= ~((_lengths(cells, pieces) >= LONG_MM) & (_thickness(cells, pieces, soft) <= RAIL_MM))
    bone = pieces.cells_of(kept | soft)
    return DensePieces(True, _with_edges(cells, bone, tissue & ~table) if bone.any() else bone, bone)


def _with_edges(cells: Cells, bone: Mask, tissue: Mask) -> Mask:
    """Dry bone and what is less dense and hangs on it."""
    from scipy import ndimage

    rounds = max(1, round(GROWTH_MM / cells.across))
    return np.asarray(ndimage.binary_dilation(bone, iterations=rounds, mask=tissue) | bone)


def _straight_plates(cells: Cells, tissue: Mask) -> Mask:
    """Columns of the slice, shape (cj, ci), that plates and rails fill from the first slice to the last.

    Columns without hard voxels are taken as they are.  Those with them may be of a shaft that lies on the table: they
    count where they make up a rail or a wide plate of one HU from end to end.
    """
    from scipy import ndimage

    straight = np.asarray(tissue.mean(axis=0) >= STRAIGHT_SHARE)
    if tissue.shape[0] * cells.size_mm[2] < STRAIGHT_MM or not straight.any():
        return np.zeros_like(straight)
    dense, hard = (of.sum(axis=0, dtype=np.float64) for of in (cells.dense, cells.hard))
    table = straight & (hard < HARD_SHARE * np.maximum(dense, 1.0))
    firm = straight & ~table
    if not firm.any():
        return table
    groups, count = ndimage.label(firm, np.ones((3, 3)))
    numbers = np.arange(count + 1)
    size = cells.size_mm[1::-1]
    uniform = ndimage.maximum(cells.mean.std(axis=0), groups, numbers) <= UNIFORM_HU
    wall = ndimage.maximum(_depth(firm, size), groups, numbers)
    whole = ndimage.maximum(_depth(ndimage.binary_fill_holes(firm), size), groups, numbers)
    wide = np.array([False, *(_diagonal(box, size) >= LONG_MM for box in ndimage.find_objects(groups))])
    plates = uniform & ((whole <= RAIL_MM) | (wide & (wall <= RAIL_MM)))
    plates[0] = False
    return np.asarray(table | plates[groups])


def _diagonal(box: tuple[slice, ...], size_mm: tuple[float, ...]) -> float:
    return math.hypot(*((part.stop - part.start) * length for part, length in zip(box, size_mm, strict=True)))


def _lengths(cells: Cells, pieces: _Pieces) -> Float64Array:
    """Diagonal of the box of each piece, mm."""
    from scipy import ndimage

    return np.array([0.0, *(_diagonal(box, cells.size_mm[::-1]) for box in ndimage.find_objects(pieces.labels))])


def _depth(mask: Mask, size_mm: tuple[float, ...]) -> Float64Array:
    """About the thickness at each cell of a mask, mm: twice the way out of it, less one cell."""
    from scipy import ndimage

    way = ndimage.distance_transform_edt(np.pad(mask, 1), sampling=size_mm)
    return np.asarray(2.0 * way[tuple(slice(1, -1) for _ in mask.shape)] - min(size_mm))


def _thickness(cells: Cells, pieces: _Pieces, chosen: Mask) -> Float64Array:
    """Thickness of each chosen piece where it is thickest, mm; 0 of others."""
    from scipy import ndimage

    thickest = np.zeros(len(chosen))
    boxes = ndimage.find_objects(pieces.labels)
    for number in np.flatnonzero(chosen):
        box = boxes[number - 1]
        thickest[number] = _depth(pieces.labels[box] == number, cells.size_mm[::-1]).max()
    return thickest


def _room(cells: Cells, pieces: _Pieces, chosen: Mask) -> Float64Array:
    """Room of each chosen piece with what it encloses in a slice, ml; 0 of others."""
    from scipy import ndimage

    room = np.zeros(len(chosen))
    boxes = ndimage.find_objects(pieces.labels)
    for number in np.flatnonzero(chosen):
        layers = pieces.labels[boxes[number - 1]] == number
        room[number] = sum(np.count_nonzero(ndimage.binary_fill_holes(layer)) for layer in layers)
    return room * math.prod(cells.size_mm) / 1000.0


def judge_bone(cells: Cells, pieces: DensePieces, kept: Mask) -> tuple[dict[str, Any], Gate]:
    """Count the dense voxels that stay.

    Parameters
    ----------
    cells : Cells
    pieces : DensePieces
    kept : ndarray, shape (ck, cj, ci), bool
        The body with its margin.

    Returns
    -------
    facts : dict
        ``specimen``, ``bone_voxels`` (above 300 HU, that count), ``bone_voxels_removed``, ``bone_kept`` (share, None
        without any), ``other_voxels_removed`` (above 300 HU, of what is no bone: tables, cables).
    gate : dict
        ``bone_kept``, at least `BONE_KEPT`.
    """
    bone = int(cells.dense[pieces.counted].sum(dtype=np.int64))
    lost = int(cells.dense[pieces.counted & ~kept].sum(dtype=np.int64))
    removed = int(cells.dense[~kept].sum(dtype=np.int64))
    share = 1.0 - lost / bone if bone else None
    facts = {
        "specimen": pieces.specimen,
        "bone_voxels": bone,
        "bone_voxels_removed": lost,
        "bone_kept": None if share is None else round(share, 6),
        "other_voxels_removed": removed - lost,
    }
    what = f"share of the {bone:,} voxels of bone above {DENSE_HU:g} HU that stay without the table"
    if share is None:
        return facts, unmeasured("bone_kept", BONE_KEPT, None, f"no bone above {DENSE_HU:g} HU")
    return facts, at_least("bone_kept", share, BONE_KEPT, None, what)


def judge_circle(cells: Cells, inside: Mask) -> tuple[dict[str, Any], Gate]:
    """Count what bone a circle cuts, to a cell.

    Parameters
    ----------
    cells : Cells
    inside : ndarray, shape (cj, ci), bool
        Cells of a slice with their centre in the circle.

    Returns
    -------
    facts : dict
        ``bone_voxels`` (above 300 HU, of pieces of bone), ``bone_voxels_removed``, of these ``bone_voxels_apart`` in
        pieces that lie wholly outside, and ``bone_kept``: the share that stays (None without bone).
    gate : dict
        ``bone_in_circle``, at least `BONE_KEPT`.
    """
    pieces = _label(cells, cells.dense > 0)
    hard = (pieces.hard >= HARD_SHARE * pieces.dense) & (pieces.dense > 0)
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
    what = f"share of the {bone:,} voxels of bone above {DENSE_HU:g} HU that lie in the circle"
    if share is None:
        return facts, unmeasured("bone_in_circle", BONE_KEPT, None, f"no bone above {DENSE_HU:g} HU")
    return facts, at_least("bone_in_circle", share, BONE_KEPT, None, what)
