"""The patient's body in a scan: found without table and blankets, or cut out by the circle that was reconstructed.

Dense cells of about 2 mm, and the cavities that they enclose, are opened slice by slice (morphological opening), which
removes plates: table tops, shells, straps.  Thick pieces are kept, and thin parts that hang on them unless they are as
long as a table (docs/table.md).  A margin stays untouched, so that the edge of the skin is as it was measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy import dense_pieces
from clrecon.anatomy.body_cells import DENSE_HU, PIECE, Cells, count_cells, grow, measure_cells, spread_mask
from clrecon.errors import RefusedInputError, UsageError
from clrecon.geometry.certificate import amend
from clrecon.geometry.regions import FACES, IN_SLICE, Mask, Regions, find_holes
from clrecon.geometry.resample import air_of
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import explains_arguments, name_parameter
from clrecon.system.pieces import in_threads
from clrecon.system.progress import Progress, Steps
from clrecon.system.records import Gate
from clrecon.system.text import format_ml

TISSUE_HU = -300
"""Cells with higher values are tissue: blankets and foam lie below this value, fat above it."""
OPENING_MM = 7.0
"""Half the thickness of plates that a morphological opening removes; couch tops and shells are 2 to 12 mm thick."""
THICK_MM = 11.0
"""A piece beside the body is kept if a circle of this radius fits into it (into a hand, not into a strap or edge)."""
LONG_MM = 100.0
"""Thin parts that are attached to the body are kept if they are shorter than this (an ear, not a couch)."""
SMALL_MM2 = 2500.0
"""Enclosed regions of a slice up to this area are always filled: bowel gas, sinuses, the airways."""
_LUNG_WALL, _AIR_WALL = 0.2, 0.7
"""Least share of a cavity's wall that must be thick tissue: for lung, and for larger regions of air."""
LUNG_HU, MOST_AIR = -950.0, 0.2
"""Lung has less than the share `MOST_AIR` of its cells below `LUNG_HU`; air, foam and blankets have a larger share."""
FOAM_HU, FOAM_WALL, FOAM_MM = -900.0, 0.3, 10.0
"""A region is foam, not lung, if most of it is below `FOAM_HU`, at most the share `FOAM_WALL` of its wall is thick, and
the region is nowhere thicker than 2 `FOAM_MM`; the lungs of three scans are thicker."""
_FEWEST_UNMEASURED = 16
"""Least number of connected cells of one value that count as unmeasured; smaller groups occur by chance."""
MARGIN_MM = 3.0
"""Width of the margin around the body in which values are kept: it contains the blurred edge of the skin."""
BODY_STEPS = 5
"""Steps of the search for the body, as progress counts them."""
AIR_RANGE_HU = (-1100.0, -900.0)
"""Values outside of the body in this range are air; removed voxels get their median."""


@explains_arguments
def remove_table(volume: Volume, *, allow_bone_loss: bool = False, progress: Progress | None = None) -> Volume:
    """Turn everything outside the patient's body into air: table, blankets, cables.

    Bone and all else within the body keep their values; so does a margin of 3 mm around it.  Dry specimens are kept
    whole, see ``clrecon.anatomy.dense_pieces``.  Look at the result: a part of the table that lies within the margin
    stays.

    Parameters
    ----------
    volume : Volume
        A scan in HU.
    allow_bone_loss : bool
        Go on where less than 98 % of the bone stays; the gate ``bone_kept`` has failed then.
    progress : callable, optional
        Called as ``progress("mask", steps done, steps)``.

    Returns
    -------
    Volume
        A volume with the same places; ``report["remove_table"]`` has ``voxels_removed``, ``dense_voxels_removed``
        (above -300 HU), ``removed_share`` (of all voxels), ``body_share``, ``air_hu`` and the facts of ``judge_bone``;
        ``bone_removed`` lists the largest pieces of bone that were removed, each with its ``voxels`` above 300 HU,
        ``ml`` and ``at_mm``, LPS mm of its middle.  ``kept_without_bone`` lists pieces apart from the body that were
        kept and hold no bone, such as paddles of a fixation mask, in the same way.  ``report["gates"]`` has the gate
        ``bone_kept`` too.

    Raises
    ------
    RefusedInputError
        Nothing is thick and dense enough to be a body, and there is no bone; or the gate fails.
    """
    slices = count_cells(volume)[0]
    steps = Steps(progress, "mask", slices + BODY_STEPS + len(volume.voxels))
    cells = measure_cells(volume, steps.take_slice)
    body, pieces = _find_body(cells, steps)
    bone, gate = dense_pieces.judge_bone(cells, pieces, body)
    removed = _place_pieces(volume, cells, dense_pieces.find_removed(cells, pieces, body))
    if gate["ok"] is False and not allow_bone_loss:
        raise RefusedInputError(
            f"the table cannot be told from the body: of {bone['bone_voxels']:,} voxels of bone above 300 HU"
            f" {bone['bone_voxels_removed']:,} would be removed with it (bone_kept {bone['bone_kept']:.3f}, at least"
            f" {dense_pieces.BONE_KEPT:g} is needed): {describe_pieces(removed)}; leave the table in, or, where this is"
            f" no bone, use {name_parameter('allow_bone_loss', True)}"
        )
    step = cells.step

    def outside(k: int) -> Mask:
        _, nj, ni = volume.voxels.shape
        return np.asarray(~np.repeat(np.repeat(body[k // step[2]], step[0], 1), step[1], 0)[:nj, :ni])

    figures = {"body_share": round(float(body.mean()), 4), **bone, "bone_removed": removed}
    boneless = [] if pieces.specimen else dense_pieces.find_boneless(cells, body, cells.mean > TISSUE_HU)
    figures["kept_without_bone"] = _place_pieces(volume, cells, boneless)
    return _turn_into_air(volume, outside, "remove_table", figures, steps, gate)


def _place_pieces(volume: Volume, cells: Cells, pieces: list[dense_pieces.Piece]) -> list[dict[str, Any]]:
    return [
        {
            "voxels": voxels,
            "ml": round(voxels * cells.voxel_ml, 4),
            "at_mm": [round(float(x), 1) for x in volume.ijk_to_lps([ijk])[0]],
        }
        for voxels, ijk in pieces
    ]


def describe_pieces(pieces: list[dict[str, Any]]) -> str:
    """Say how large pieces are and where: ``8.2 ml around (140, 10, -4) mm LPS``."""
    places = (", ".join(f"{x:.0f}" for x in piece["at_mm"]) for piece in pieces)
    return ", ".join(f"{format_ml(piece['ml'])} around ({at}) mm LPS" for piece, at in zip(pieces, places, strict=True))


@explains_arguments
def mask_field_of_view(volume: Volume, radius_mm: float | None = None, *, progress: Progress | None = None) -> Volume:
    """Turn everything outside of a circle around the centre of the slices into air.

    Parameters
    ----------
    volume : Volume
        A scan in HU.
    radius_mm : float, optional
        Default: the largest circle that fits the slice, which is what scanners reconstruct.
    progress : callable, optional
        Called as ``progress("mask", steps done, steps)``.

    Returns
    -------
    Volume
        A volume with the same places; ``report["field_of_view"]`` has ``radius_mm``, ``voxels_removed``,
        ``dense_voxels_removed`` (above -300 HU), ``removed_share``, ``air_hu`` and the facts of ``judge_circle``.
        Without a radius ``report["gates"]`` has the gate ``bone_in_circle``: a circle that was not chosen should cut no
        bone.

    Raises
    ------
    UsageError
        The radius is not a number above 0, or so short that no voxel is left.
    """
    _, nj, ni = volume.voxels.shape
    di, dj, _ = volume.spacing
    largest = min(ni * di, nj * dj) / 2.0
    radius = largest if radius_mm is None else float(radius_mm)
    if not (math.isfinite(radius) and radius > 0.0):
        raise UsageError(f"the radius of the field of view is a length in mm above 0, not {radius:g}")
    j, i = np.ogrid[:nj, :ni]
    offsets = np.stack(np.broadcast_arrays(i - (ni - 1) / 2.0, j - (nj - 1) / 2.0), axis=-1)
    mask = np.linalg.norm(offsets @ volume.affine[:3, :2].T, axis=-1) > radius
    if mask.all():
        raise UsageError(f"a field of view of {radius:g} mm holds no voxel: they are {di:.3g} x {dj:.3g} mm")
    steps = Steps(progress, "mask", count_cells(volume)[0] + len(volume.voxels))
    cells = measure_cells(volume, steps.take_slice)
    si, sj, _ = cells.step
    _, cj, ci = cells.mean.shape
    middle = np.ix_(np.minimum(np.arange(cj) * sj + sj // 2, nj - 1), np.minimum(np.arange(ci) * si + si // 2, ni - 1))
    bone, gate = dense_pieces.judge_circle(cells, ~mask[middle])
    figures = {"radius_mm": round(radius, 3), **bone}
    judged = gate if radius_mm is None else None
    return _turn_into_air(volume, lambda k: mask, "field_of_view", figures, steps, judged)


def _turn_into_air(
    volume: Volume, outside: Callable[[int], Mask], name: str, figures: dict[str, Any], steps: Steps, gate: Gate | None
) -> Volume:
    """Give the voxels outside the value of the air there; `outside` returns the mask of a slice."""
    voxels = np.empty_like(volume.voxels, subok=False)
    counts = np.zeros((2, len(voxels)), dtype=np.int64)
    air = _air_level(volume, outside)

    def clear_slices(slices: slice) -> None:
        for k in range(slices.start, slices.stop):
            layer, mask = volume.voxels[k], outside(k)
            counts[:, k] = np.count_nonzero(mask), np.count_nonzero(mask & (layer > TISSUE_HU))
            np.copyto(voxels[k], layer)
            np.copyto(voxels[k], air, where=mask)
            volume.release_slices(k, k + 1)

    in_threads(clear_slices, len(voxels), PIECE, steps.take_slice)
    removed, dense = counts.sum(axis=1).tolist()
    share = removed / voxels.size
    facts = {"voxels_removed": removed, "dense_voxels_removed": dense, "removed_share": round(share, 4), **figures}
    facts["air_hu"] = float(air)
    masked = volume.with_voxels(voxels)
    masked.report = amend(masked.report, **{name: facts})
    if gate is not None:
        masked.report = amend(masked.report, gates=[*masked.report.get("gates", []), gate])
    return masked


def _air_level(volume: Volume, outside: Callable[[int], Mask]) -> Any:
    """Return the median of the air outside, so that no surface appears where the mask ends; `AIR_HU` without any."""
    low, high = AIR_RANGE_HU
    pieces = []
    for k in range(0, volume.voxels.shape[0], -(-volume.voxels.shape[0] // 16)):
        values = volume.voxels[k][outside(k)][::7]
        pieces.append(values[(values >= low) & (values <= high)])
    air = np.sort(np.concatenate(pieces))
    if len(air):
        return air[(len(air) - 1) // 2]
    return volume.dtype.type(air_of(volume.dtype))


def find_body(volume: Volume, *, steps: Steps | None = None) -> tuple[Mask, tuple[int, int, int]]:
    """Find the patient's body with its margin: cells (ck, cj, ci), and the voxels of a cell along i, j, k."""
    steps = steps or Steps(None, "mask", count_cells(volume)[0] + BODY_STEPS)
    cells = measure_cells(volume, steps.take_slice)
    return _find_body(cells, steps)[0], cells.step


def _find_body(cells: Cells, steps: Steps) -> tuple[Mask, dense_pieces.DensePieces]:
    """Find the body with its margin, in `BODY_STEPS` steps, and decide on all pieces as dense as bone."""
    across = cells.across
    dense_enough = cells.mean > TISSUE_HU
    thick = grow(grow(dense_enough, -OPENING_MM / across), OPENING_MM / across) & dense_enough
    steps.take()
    tissue = dense_enough | _find_cavities(cells.mean, dense_enough, thick, across)
    steps.take()
    body = _thick_parts(tissue, across)
    steps.take()
    pieces = dense_pieces.find_dense_pieces(cells, dense_enough, thick, body)
    if not (body.any() or pieces.added.any()):
        raise RefusedInputError(
            f"no body found: nothing above {TISSUE_HU:g} HU is {2 * OPENING_MM:g} mm thick, and there is no bone"
            f" ({_describe_dense(cells)});"
            " leave the table in"
        )
    body |= _thin_parts(tissue, body, cells.size_mm)
    body |= pieces.added
    steps.take()
    body |= find_holes(body)
    body = grow(body, MARGIN_MM / across)
    steps.take()
    return body, pieces


def _describe_dense(cells: Cells) -> str:
    dense = int(cells.dense.sum(dtype=np.int64))
    if not dense:
        return f"no voxel above {DENSE_HU:g} HU"
    return f"{dense:,} voxels above {DENSE_HU:g} HU, all of tables, rails or cables by their shape"


def _thick_parts(tissue: Mask, across: float) -> Mask:
    """Return the largest piece left after opening, and the others that are thick; all False if nothing is left."""
    core = grow(tissue, -OPENING_MM / across)
    pieces = Regions(core, FACES)
    if pieces.count == 0:
        return np.zeros_like(tissue)
    is_thick = pieces.sum_of(grow(core, -(THICK_MM - OPENING_MM) / across)) > 0
    is_thick[1 + int(pieces.sizes[1:].argmax())] = True
    return grow(pieces.cells_of(is_thick), OPENING_MM / across) & tissue


def _find_cavities(cells: NDArray[np.float32], tissue: Mask, thick: Mask, across: float) -> Mask:
    """Find lungs, bowel and sinuses, slice by slice: cells that are not dense but belong to the body.

    Lung is denser than air and has thick tissue beside it; it may touch the border of the scan.  Air counts where dense
    cells enclose it and it is small, or where nearly all of its wall is thick.  So the inside of a table does not count
    (its wall is thin shells), nor the gap between back and table (one side of its wall is the thin table top).
    """
    unmeasured = grow(find_unmeasured(cells), 2)
    regions = Regions(~tissue & ~unmeasured, IN_SLICE)
    thick_wall = regions.sum_of(grow(thick, 1)) / np.maximum(regions.sum_of(grow(tissue, 1)), 1.0)
    at_border = unmeasured
    at_border[:, [0, -1]] = at_border[:, :, [0, -1]] = True
    is_open = regions.sum_of(grow(at_border, 1)) > 0
    is_lung = regions.sum_of(cells < LUNG_HU) < MOST_AIR * regions.sizes
    small = regions.sizes * across**2 < SMALL_MM2
    foam = is_lung & ~small & (thick_wall > _LUNG_WALL) & (thick_wall <= FOAM_WALL)
    foam &= regions.sum_of(cells < FOAM_HU) > 0.5 * regions.sizes
    if foam.any():
        foam &= regions.sum_of(grow(regions.cells_of(foam), -FOAM_MM / across)) == 0
    is_cavity = np.where(is_lung, thick_wall > _LUNG_WALL, ~is_open & (small | (thick_wall > _AIR_WALL)))
    return regions.cells_of(is_cavity & ~foam)


def find_unmeasured(cells: NDArray[Any]) -> Mask:
    """Mark regions of one value that begin at the corners of a slice: padding, air without noise."""
    unmeasured = np.zeros(cells.shape, dtype=bool)

    def mark_layers(layers: slice) -> None:
        for layer, out in zip(cells[layers], unmeasured[layers], strict=True):
            for corner in set(layer[np.ix_((0, -1), (0, -1))].flat):
                out |= layer == corner
        regions = Regions(unmeasured[layers], IN_SLICE)
        unmeasured[layers] = regions.cells_of(regions.reach_border() & (regions.sizes >= _FEWEST_UNMEASURED))

    in_threads(mark_layers, len(cells), PIECE)
    return unmeasured


def _thin_parts(tissue: Mask, body: Mask, cell_mm: tuple[float, float, float]) -> Mask:
    """Find dense parts that touch the body and are not long."""
    pieces = Regions(tissue & ~body, FACES)
    hangs = pieces.sum_of(spread_mask(body)) > 0
    return pieces.cells_of(hangs & (pieces.measure_diagonals(cell_mm) < LONG_MM))
