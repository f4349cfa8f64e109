"""Where the surface of a field is a wall that no points support: what holes in a cloud leave of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CUBE = 32
"""Nodes along an edge of the cubes in which walls are counted: those of a word."""

OPEN_SHARE = 1.0 / 3.0
"""Share of its faces above which a cube is open.  A body that has lost its inside has walls for half of its faces."""

Words = NDArray[np.uint32]

_BITS = np.array([bin(number).count("1") for number in range(1 << 16)], np.uint8)


@dataclass(frozen=True, eq=False)
class Walls:
    """Faces between an inner and an outer node, by cube of `CUBE` nodes; arrays of shape (cubes_z, cubes_y, cubes_x).

    faces: int64. All faces whose lower node is in the cube.
    walls: int64. Those that no points support: the field itself has one sign on both sides, or a side is far from all
        points.
    enclosed: float64. Volume that the walls of the cube enclose, in cubes of the node spacing: ``sum((x - c) . n) / 3``
        over their middles x, with their mean c and normals n towards the inside.  It is near 0 for flat walls.
    """

    faces: NDArray[np.int64]
    walls: NDArray[np.int64]
    enclosed: NDArray[np.float64]

    @property
    def share(self) -> float:
        """Share of all faces that are walls."""
        return float(self.walls.sum() / max(int(self.faces.sum()), 1))

    @property
    def open(self) -> NDArray[np.bool_]:
        """Cubes in which over a third of the faces are walls."""
        return self.walls > OPEN_SHARE * self.faces

    @property
    def lost(self) -> float:
        """Volume that the walls of open cubes enclose, in cubes of the node spacing; at least 0."""
        return max(float(self.enclosed[self.open].sum()), 0.0)

    def worst(self, count: int) -> list[tuple[int, int, int]]:
        """Return the open cubes (z, y, x) with most walls, at most `count` of them."""
        walls = np.where(self.open, self.walls, 0).ravel()
        order = np.argsort(-walls, kind="stable")[:count]
        return [tuple(map(int, np.unravel_index(at, self.walls.shape))) for at in order if walls[at]]  # type: ignore[misc]


def find_walls(near: Words, negative: Words, inside: Words, nx: int) -> Walls:
    """Count the faces of a surface and those without support; see `clrecon.reference.points.field.find_walls`.

    near, negative, inside: ndarray, shape (nz, ny, words), uint32. Masks of nodes, bit b of word w is node 32 w + b:
        within the bridge of a point, the sign of the field there, and the decided sign.
    nx: Nodes of a row.
    """
    nz, ny, words = near.shape
    shape = (-(-nz // CUBE), -(-ny // CUBE), words)
    faces, walls, enclosed = np.zeros(shape, np.int64), np.zeros(shape, np.int64), np.zeros(shape)
    valid = _valid_bits(nx, words)
    for layer, first in enumerate(range(0, nz, CUBE)):
        parts = [mask[first : first + CUBE + 1] for mask in (near, negative, inside)]
        places, normals, cubes = [], [], []
        for axis, changed, wall, inner in _compare(parts, min(CUBE, nz - first), valid):
            faces[layer] += _count(changed, shape[1])
            found, lower_inside = _list(wall, inner)
            walls[layer] += np.bincount(
                found[:, 1] // CUBE * words + found[:, 2] // CUBE, minlength=shape[1] * words
            ).reshape(shape[1:])
            cubes.append(found[:, 1] // CUBE * words + found[:, 2] // CUBE)
            doubled = 2 * found
            doubled[:, axis] += 1
            normal = np.zeros_like(found)
            normal[:, axis] = np.where(lower_inside, -1, 1)
            places.append(doubled)
            normals.append(normal)
        enclosed[layer] = _enclose(np.concatenate(places), np.concatenate(normals), np.concatenate(cubes), walls[layer])
    return Walls(faces, walls, enclosed)


def count_bits(words: Words) -> int:
    """Return the number of set bits of a mask, layer by layer."""
    return sum(int(_BITS[layer.view(np.uint16)].sum(dtype=np.int64)) for layer in words)


def _valid_bits(nx: int, words: int) -> Words:
    """Return the bits of a row that are nodes."""
    bits = np.arange(32 * words).reshape(words, 32) < nx
    return np.packbits(bits, axis=1, bitorder="little").view(np.uint32).ravel()


def _compare(parts: list[Words], layers: int, valid: Words) -> Iterator[tuple[int, Words, Words, Words]]:
    """Yield for each axis (z, y, x) the faces towards the next node, those without support, and inner lower nodes."""
    for axis in range(3):
        (near, near_next), (negative, negative_next), (inside, inside_next) = (
            _neighbours(mask, axis, layers) for mask in parts
        )
        last = _neighbours(np.broadcast_to(valid, parts[0].shape), 2, layers)[1] if axis == 2 else valid
        changed = (inside ^ inside_next) & valid & last
        supported = near & near_next & (negative ^ negative_next)
        yield axis, changed, changed & ~supported, inside


def _neighbours(mask: Words, axis: int, layers: int) -> tuple[Words, Words]:
    """Return words of nodes, and of their next neighbours along an axis; of z and y without those that have none."""
    if axis == 0:
        return mask[:-1][:layers], mask[1:][:layers]
    mask = mask[:layers]
    if axis == 1:
        return mask[:, :-1], mask[:, 1:]
    after = mask >> np.uint32(1)
    after[:, :, :-1] |= mask[:, :, 1:] << np.uint32(31)
    return mask, after


def _count(words: Words, cubes_y: int) -> NDArray[np.int64]:
    """Return the number of set bits by cube, shape (cubes_y, words)."""
    k, j, word = np.nonzero(words)  # few of them
    bits = _BITS[words[k, j, word].view(np.uint16)].reshape(-1, 2).sum(axis=1)
    count = words.shape[2]
    return np.bincount(j // CUBE * count + word, bits, cubes_y * count).astype(np.int64).reshape(cubes_y, count)


def _list(wall: Words, inside: Words) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the nodes (z, y, x) of set bits, and whether they are inside."""
    k, j, word = np.nonzero(wall)
    bits = [
        np.unpackbits(mask[k, j, word].view(np.uint8).reshape(-1, 4), axis=1, bitorder="little").astype(bool)
        for mask in (wall, inside)
    ]
    row, bit = np.nonzero(bits[0])
    return np.stack([k[row], j[row], 32 * word[row] + bit], axis=1), bits[1][row, bit]


def _enclose(
    doubled: NDArray[np.int64], normals: NDArray[np.int64], cubes: NDArray[np.int64], walls: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the volume that the walls of each cube enclose; `doubled` are twice their middles."""
    size = walls.size

    def by_cube(values: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.bincount(cubes, values, minlength=size).astype(np.float64)

    heights, moments = by_cube((doubled * normals).sum(axis=1)), np.zeros(size)
    for axis in range(3):
        moments += by_cube(doubled[:, axis]) * by_cube(normals[:, axis])
    enclosed: NDArray[np.float64] = (heights - moments / np.maximum(walls.ravel(), 1)) / 6.0
    return enclosed.reshape(walls.shape)
