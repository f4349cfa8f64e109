"""Twin of `clrecon.operators.points.field`: a signed distance around a cloud with normals, on nodes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

FAR = np.float32(np.inf)
"""Squared distance of nodes that no point reaches."""

_SIDES = tuple(product(range(3), (1, -1)))


@dataclass(frozen=True, eq=False)
class FieldTwin:
    """The field on nodes, (nz, ny, nx).

    value: mm. Mean of <x - p, n>; NaN where no point has weight.
    squared: mm^2. Squared distance to the nearest point, in the arithmetic of float32; `FAR` beyond the reach.
    """

    value: NDArray[np.float64]
    squared: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class SignsTwin:
    """Which nodes are inside, shape (nz, ny, nx), and the votes for far regions."""

    inside: NDArray[np.bool_]
    votes: int
    against: int
    regions: int


def measure_field(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    corner: NDArray[np.float32],
    spacing: float,
    shape: tuple[int, int, int],
    *,
    reach: float,
    smoothing: float,
) -> FieldTwin:
    """Average the distances from the planes of the points around each node, (nx, ny, nz) from `corner` on, in mm.

    A point at distance d < R, the reach, has the weight ``(1 - d^2 / R^2)^2 / (d^2 + s^2)``, s being the smoothing.
    """
    h, reach32 = np.float32(spacing), np.float32(reach)
    nx, ny, nz = shape
    summed, weights = np.zeros((2, nz, ny, nx))
    squared = np.full((nz, ny, nx), FAR, dtype=np.float32)
    most = int(reach / spacing + 0.501)  # from the nearest node on
    nearest = np.rint((points - corner) / h).astype(np.int64)
    steps = np.arange(-most, most + 1)
    for dk in steps:
        for dj in steps:
            for di in steps:
                node = nearest + (di, dj, dk)
                on_grid = ((node >= 0) & (node < shape)).all(axis=1)
                i, j, k = node[on_grid].T
                node_points = corner + node[on_grid].astype(np.float32) * h
                away = node_points - points[on_grid]
                x, y, z = away.T
                squares = x * x + (y * y + z * z)
                used = squares < reach32 * reach32
                nodes = k[used], j[used], i[used]
                exact = squares[used].astype(np.float64)
                weight = (1.0 - exact / float(reach32) ** 2) ** 2 / (exact + float(np.float32(smoothing)) ** 2)
                height = (away[used].astype(np.float64) * normals[on_grid][used]).sum(axis=1)
                np.add.at(summed, nodes, weight * height)
                np.add.at(weights, nodes, weight)
                np.minimum.at(squared, nodes, squares[used])
    with np.errstate(invalid="ignore"):
        return FieldTwin(summed / weights, squared)


def _shifted(mask: NDArray[np.bool_], axis: int, step: int) -> NDArray[np.bool_]:
    """Return for each node the bit of its neighbour; False beyond the nodes."""
    result = np.zeros_like(mask)
    to, source = [slice(None)] * 3, [slice(None)] * 3
    to[axis], source[axis] = (slice(None, -1), slice(1, None)) if step > 0 else (slice(1, None), slice(None, -1))
    result[tuple(to)] = mask[tuple(source)]
    return result


def decide_signs(
    near: NDArray[np.bool_], core: NDArray[np.bool_], negative: NDArray[np.bool_], rounds: int
) -> SignsTwin:
    """Decide which nodes, (nz, ny, nx), are inside.

    Nodes of `core`, within one spacing of a point, keep the sign of the field.  Far nodes, those that are not near,
    farther than B, form regions over their six neighbours; each pair of a near and a far neighbour is a vote with the
    near node's sign, and a region takes the sign of most of its votes, outside where they are even.  The signs of far
    nodes then flood the near nodes that are not of `core`, one neighbour farther in each of `rounds` rounds.  Nodes
    that both signs reach in one round, or none ever, keep their own.
    """
    from scipy import ndimage

    regions, count = ndimage.label(~near)
    votes = np.zeros((2, count + 1), dtype=np.int64)
    for axis, step in _SIDES:
        voter, sign = _shifted(near, axis, step), _shifted(negative, axis, step)
        for which in (0, 1):
            votes[which] += np.bincount(regions[voter & (sign == bool(which))], minlength=count + 1)
    votes[:, 0] = 0
    inside = np.where(near, negative, (votes[1] > votes[0])[regions])
    reached = ~near
    for _ in range(rounds):
        signs = np.zeros((2, *near.shape), dtype=bool)
        for axis, step in _SIDES:
            there, sign = _shifted(reached, axis, step), _shifted(inside, axis, step)
            signs[0] |= there & ~sign
            signs[1] |= there & sign
        new = (signs[0] | signs[1]) & ~reached & ~core
        inside = np.where(new & (signs[0] != signs[1]), signs[1], inside)
        reached |= new
    return SignsTwin(inside, int(votes.sum()), int(votes.min(axis=0).sum()), count)


def fill_nodes(
    field: FieldTwin, near: NDArray[np.bool_], signs: SignsTwin, far_value: float, least: float
) -> NDArray[np.float64]:
    """Return the volume, positive inside: near nodes have |f|, `least` to `far_value`, all others `far_value`."""
    size = np.where(near, np.clip(np.abs(field.value), least, far_value), far_value)
    return np.where(signs.inside, size, -size)
