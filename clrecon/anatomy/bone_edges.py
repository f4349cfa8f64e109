"""Edges of bone in the slices of a scan: the plateau on each side, found by a walk uphill and a walk downhill."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import METAL_HU

FloatArray = NDArray[Any]

CONTRAST_MEDIUM_HU = 600
"""Vessels and organs with contrast medium stay below this value."""

REACH = 8
"""Longest walk in steps: at a blur of 2 voxels it reaches the plateau."""
FLAT = 4
"""A plateau is flat when the values stay level for this many steps beyond the maximum.  Vessels do; cortex falls off
into marrow."""
FLAT_SIGMAS = 3.5
LARGEST_FLAT_SHARE = 0.75
"""When more than this share of the contrast ends in flat plateaus, these are bone (a homogeneous body)."""
MOST_EDGES = 200_000
"""Largest number of edges taken from one slice and axis, so that noise cannot use up the memory."""
LEAST_BONE_SHARE = 0.2
"""Least share of the edges that must end below metal.  A lone implant has some of these: its rim is blurred."""


@dataclass(frozen=True)
class Background:
    """The material that bone lies in: its mode and width, where bone begins, and the range of the low side, HU."""

    name: str
    mode: float
    noise: float
    seed: int
    lowest: float
    highest: float


@dataclass(frozen=True)
class BoneEdges:
    """Plateaus, steepest steps and flatness of many edges; shapes (n,)."""

    bone: FloatArray
    tissue: FloatArray
    step: FloatArray
    flat: NDArray[np.bool_]

    def where(self, mask: NDArray[np.bool_]) -> BoneEdges:
        return BoneEdges(self.bone[mask], self.tissue[mask], self.step[mask], self.flat[mask])

    @property
    def contrast(self) -> FloatArray:
        return self.bone - self.tissue


def measure_edges(voxels: NDArray[Any], sampled: range, background: Background) -> BoneEdges:
    """Measure the plateaus on both sides of the edges of bone in the sampled slices, along rows and along columns."""
    found = []
    for k in sampled:
        padded = np.pad(np.asarray(voxels[k]), REACH + FLAT, mode="edge")
        with np.errstate(invalid="ignore"):  # two infinite neighbours
            found += [_measure_slice(padded, axis, background) for axis in (0, 1)]
    every = BoneEdges(*(np.concatenate(parts) for parts in zip(*found, strict=True)))
    edges = every.where((every.tissue >= background.lowest) & (every.tissue <= background.highest))
    bone = edges.where(edges.bone <= METAL_HU)
    # These edges are the blurred rim of metal, not bone.
    return bone if len(bone.bone) >= LEAST_BONE_SHARE * len(edges.bone) else bone.where(bone.bone < -math.inf)


def _measure_slice(padded: NDArray[Any], axis: int, background: Background) -> tuple[NDArray[Any], ...]:
    """Measure bone, tissue, steepest step and flatness of the edges of one slice along one axis.

    padded: ndarray, shape (nj + 2 p, ni + 2 p). The slice with its border values continued by p = `REACH` + `FLAT`
        voxels, where every walk ends because values are constant.
    axis: {0, 1}. Along the columns (j) or along the rows (i).
    """
    border = REACH + FLAT
    inside = padded >= background.seed
    inner = (slice(border, -border),) * 2
    along, across = (padded.shape[1], 1) if axis == 0 else (1, padded.shape[1])
    first = inside[inner]
    last = np.roll(inside, -1, axis)[inner]
    crossing = np.flatnonzero(first != last)  # border values are continued: no crossing
    crossing = crossing[:: max(1, -(-len(crossing) // MOST_EDGES))]
    rows, columns = np.divmod(crossing, first.shape[1])
    low = (rows + border) * padded.shape[1] + columns + border
    flat_values, flat_inside = padded.ravel(), inside.ravel()

    def values(at: NDArray[np.intp]) -> NDArray[np.float32]:
        return flat_values[at].astype(np.float32)

    falls = flat_inside[low]
    high = np.where(falls, low, low + along)
    low = np.where(falls, low + along, low)
    uphill = high - low
    step = values(high) - values(low)
    sideways = values(high + across) + values(low + across) - values(high - across) - values(low - across)
    # A lone voxel of noise has no neighbour beside or behind it that is also bone.
    borne_out = flat_inside[high + across] | flat_inside[high - across] | flat_inside[high + uphill]
    kept = borne_out & (step >= 0.25 * np.abs(sideways))
    high, low, uphill, step = high[kept], low[kept], uphill[kept], step[kept]

    top, steep_up = _walk(flat_values, high, uphill)
    bottom, steep_down = _walk(flat_values, low, -uphill, falling=True)
    bone = values(top)
    flat = bone < CONTRAST_MEDIUM_HU
    for beyond in range(1, FLAT + 1):
        flat &= np.abs(values(top + beyond * uphill) - bone) <= FLAT_SIGMAS * background.noise
    return bone, values(bottom), np.maximum(step, np.maximum(steep_up, steep_down)), flat


def _walk(
    values: NDArray[Any], start: NDArray[np.intp], step: NDArray[np.intp], falling: bool = False
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Walk from each start by `step` while the values rise (or fall); return the end and the steepest step."""
    end, steepest = start.copy(), np.zeros(len(start), dtype=np.float32)
    walking = np.arange(len(start))
    for _ in range(REACH):
        here = end[walking]
        beyond = here + step[walking]
        change = values[beyond].astype(np.float32) - values[here].astype(np.float32)
        if falling:
            change = -change
        goes_on = change > 0
        walking, change = walking[goes_on], change[goes_on]
        end[walking] = beyond[goes_on]
        steepest[walking] = np.maximum(steepest[walking], change)
    return end, steepest


def leave_contrast_medium(edges: BoneEdges) -> tuple[BoneEdges, float, float]:
    """Leave out edges that end in flat, faint plateaus (contrast medium), unless most edges do.

    Returns: Share of the contrast that was left out.
    Returns: Share of the contrast that is flat and faint, left out or not.
    """
    total = edges.contrast.sum()
    share = float(edges.contrast[edges.flat].sum() / total) if total else 0.0
    if share > LARGEST_FLAT_SHARE:
        return edges, 0.0, share
    return edges.where(~edges.flat), share, share
