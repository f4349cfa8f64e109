"""Twins of the surfaces of labels, in plain numpy: which samples are inside of a label, its surface by HU, and its own
surface from its smoothed mask.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule
from clrecon.labels.label_levels import FULL, KEEP, REACH, Growth, fill_solid, find_boxes, level_biases
from clrecon.proof.surface import extract


def own_labels(labels: NDArray[Any], volume: Volume, grow_mm: float | None) -> NDArray[np.uint16]:
    """Grow labels on the grid of the volume into samples without one, which get the nearest within `grow_mm`, the
    lowest of equally near ones; None: the nearest, in mm, among its 26 neighbours.
    """
    growth = Growth.of(volume, grow_mm)
    offsets, shells = growth.offsets, growth.shells
    reach = growth.reach
    owner = labels.astype(np.uint16)
    none = 65_536
    padded = np.pad(labels.astype(np.int64), [(n, n) for n in reach[::-1]])
    padded[padded == 0] = none
    nk, nj, ni = labels.shape
    for shell in range(shells.max(initial=-1) + 1):
        nearest = np.full(labels.shape, none)
        for di, dj, dk in offsets[shells == shell] + np.array(reach):
            nearest = np.minimum(nearest, padded[dk : dk + nk, dj : dj + nj, di : di + ni])
        grown = (owner == 0) & (nearest < none)
        owner[grown] = nearest[grown]
    return owner


def find_solid(
    volume: Volume,
    labels: NDArray[Any],
    iso_value: float,
    *,
    grow_mm: float | None = None,
    closed: bool = True,
    solid: tuple[int, ...] = (),
) -> NDArray[np.uint16]:
    """Return for each sample the label that it is inside of: its owner where HU reach the iso value, 0 elsewhere."""
    rule = choose_iso_rule(volume, iso_value, closed=closed)
    labels = labels.astype(np.uint16)
    inside = np.where(volume.voxels >= rule.lowest_inside, own_labels(labels, volume, grow_mm), 0).astype(np.uint16)
    for number, box in find_boxes(labels, solid, Growth.of(volume, grow_mm).reach).items():
        fill_solid(inside, labels, number, box, closed)
    return inside


def extract_label(
    volume: Volume, inside: NDArray[np.uint16], number: int, iso_value: float, *, closed: bool = True
) -> extract.Surface:
    """Extract the surface of one label of a small volume, whose samples `find_solid` found.

    Where HU cross the iso level between a sample of the label and one without a label, the vertex lies there, as on the
    surface without labels.  Everywhere else (beside another label, or beside dense samples without a label) it lies
    half way, and its normal follows the label, not HU.
    """
    rule = choose_iso_rule(volume, iso_value, closed=closed)
    grown = np.pad(inside, rule.border)
    dense = extract.sample_grid(volume, rule, rule.border) >= rule.lowest_inside
    if rule.closed:
        dense[[0, -1]] = dense[:, [0, -1]] = dense[:, :, [0, -1]] = False
    return extract.extract_inside(
        volume, rule, grown == number, hu_places=(dense & (grown == number)) | ((grown == 0) & ~dense)
    )


WEIGHTS = (1, 4, 6, 4, 1)
"""Two rounds of [1 2 1]."""


def find_occupancy(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the occupancy of each sample, 0 to 4096; beyond the map its outermost samples are repeated."""
    sums = mask.astype(np.int64)
    for axis in range(3):
        padded = np.pad(sums, [(REACH * (a == axis), REACH * (a == axis)) for a in range(3)], mode="edge")
        parts = [np.take(padded, range(n, n + mask.shape[axis]), axis=axis) for n in range(len(WEIGHTS))]
        sums = sum((weight * part for weight, part in zip(WEIGHTS, parts, strict=True)), np.zeros_like(sums))
    return sums


def extract_label_mask(
    labels: NDArray[Any],
    affine: NDArray[np.float64],
    number: int,
    level: int,
    *,
    closed: bool = True,
    enclosed: Mapping[int, int] | None = None,
) -> extract.Surface:
    """Extract one label's own surface at one level, 1 to `FULL` - 1.

    The samples that carry the label are inside, whatever their occupancy.  On an edge from an inside sample to one

    - without a label, the vertex lies where the label's occupancy crosses the level; an end on the wrong side of the
      level counts as one step on its own side.  Where the occupancy of the other labels is not lower at the label's end
      than at the far end (they lie alongside, not across a gap), that of all labels replaces the label's;
    - with another label, it lies where the leads of both are equal.  The lead at an end is the occupancy of its own
      number less that of the other end's number, at least 1. The lead of an enclosed label, see `find_enclosed`, is
      larger by the amount by which its level is lower than the other's (`START` if that has none);
    - beyond the map, which is closed at its border or not, it lies half way.

    No vertex comes nearer to a sample than `KEEP` of its edge.
    """
    volume, border = Volume(labels, affine), int(closed)
    rule = IsoRule(0.5, FULL // 2, FULL / 2, 0.0, closed)
    inside = np.pad(labels == number, border)
    edges = extract.find_crossed_edges(inside)
    within = np.pad(np.ones(labels.shape, dtype=bool), border)
    leads_out = ~(within[edges.near] & within[edges.far])
    grown = np.pad(labels.astype(np.int64), border, mode="edge")
    occupancy = (FULL // 4096) * find_occupancy(labels == number)
    everyone = (FULL // 4096) * find_occupancy(labels != 0)
    values = [np.pad(field, border, mode="edge") for field in (occupancy, everyone)]
    slopes = [
        np.pad(
            extract.gradients(np.pad(field.astype(np.float64), 1, mode="edge"), False),
            [(border, border)] * 3 + [(0, 0)],
        )
        for field in (occupancy, everyone)
    ]
    starts = inside[edges.near]
    others, next_others = ((values[1] - values[0])[ends] for ends in (edges.near, edges.far))
    alongside = ((others | next_others) != 0) & np.where(starts, others >= next_others, next_others >= others)
    value, next_value = (np.where(alongside, values[1][e], values[0][e]) for e in (edges.near, edges.far))
    value = np.where(starts, np.maximum(value, level + 1), np.minimum(value, level - 1))
    next_value = np.where(starts, np.minimum(next_value, level - 1), np.maximum(next_value, level + 1))
    t = (level - value) / (next_value - value)
    between = ~leads_out & (grown[edges.near] != 0) & (grown[edges.far] != 0)
    biases = level_biases(dict(enclosed or {}), int(labels.max()) + 1)[grown]
    before = biases[edges.near] - biases[edges.far]
    lead, next_lead = (np.maximum(lead, 1) for lead in _find_leads(labels, occupancy, edges, inside, grown, border))
    value, next_value = np.maximum(lead + before, 1), np.maximum(next_lead - before, 1)
    t[between] = (value / (value + next_value))[between]
    t[leads_out] = 0.5
    keep = np.maximum(extract.edge_margins(volume, rule, edges), KEEP)
    t = np.clip(t, keep, 1.0 - keep)
    takes = (alongside & ~between)[:, None]
    slope, next_slope = (np.where(takes, slopes[1][e], slopes[0][e]) for e in (edges.near, edges.far))
    slope, next_slope = (1.0 - t[:, None]) * slope, t[:, None] * next_slope
    slope[leads_out] = next_slope[leads_out] = 0.0
    return extract.build_surface(volume, rule, inside, edges, extract.EdgePlaces(t, slope, next_slope))


def _find_leads(
    labels: NDArray[Any],
    occupancy: NDArray[np.int64],
    edges: extract.CrossedEdges,
    inside: NDArray[np.bool_],
    grown: NDArray[np.int64],
    border: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return for each end of each edge the lead of its number over that of the other end, `occupancy` being that of
    the label whose samples are `inside`, `grown` the number of each sample of the grid.
    """
    starts = inside[edges.near]
    rival_number = np.where(starts, grown[edges.far], grown[edges.near])
    leads = np.zeros((2, len(rival_number)), np.int64)
    values = np.pad(occupancy, border, mode="edge")
    for number in np.unique(rival_number):
        among = rival_number == number
        rival = np.pad((FULL // 4096) * find_occupancy(labels == number), border, mode="edge")
        for end_number, ends in enumerate((edges.near, edges.far)):
            leads[end_number][among] = (values - rival)[ends][among]
    return np.where(starts, leads[0], -leads[0]), np.where(starts, -leads[1], leads[1])
