"""Signed distances of cervical vertebrae in their own frames: the ring of C1, C2 with its dens, and C3 to C7.

A shape is the bone before anything is cut out of it, and what is cut out: the spinal canal and the foramina of the
transverse processes.  All is symmetric: |x| serves both sides.  The origin of C1 is the middle of its ring, that of the
others the middle of their body.
"""

from __future__ import annotations

from functools import reduce

import numpy as np

from clrecon.phantom.fields import Field, capsule, ellipse, smooth_union
from clrecon.phantom.parts import Vertebra

Point = tuple[float, float, float]


def cervical_bounds(vertebra: Vertebra) -> tuple[Point, Point]:
    """Return the lowest and highest corner, local mm, of a box that holds the whole vertebra."""
    if vertebra.name == "C1":
        return (-42.0, -19.0, -13.0), (42.0, 36.0, 13.0)
    if vertebra.name == "C2":
        return (-30.0, -13.0, -21.0), (30.0, 50.0, 28.0)
    side = vertebra.canal_half_width + 25.0
    back = vertebra.depth / 2.0 + 2.0 * vertebra.canal_half_depth + 34.0
    return (-side, -vertebra.depth / 2.0 - 4.0, -1.6 * vertebra.height - 6.0), (side, back, vertebra.height / 2.0 + 8.0)


def facet_seats(vertebra: Vertebra) -> list[Point]:
    """Return points along the middle of the upper articular process, local mm, with x of the left side."""
    if vertebra.name == "C1":
        return []
    if vertebra.name == "C2":
        return [(8.6, 0.5, 6.6), (11.0, 0.5, 6.0), (13.4, 0.5, 5.2)]
    wide, middle = vertebra.canal_half_width, vertebra.depth / 2.0 + vertebra.canal_half_depth
    return [(wide + 3.6, middle - 0.6, 3.6), (wide + 3.6, middle + 0.4, 2.0), (wide + 3.6, middle + 1.4, 0.4)]


def cervical_shape(vertebra: Vertebra, x: Field, y: Field, z: Field) -> tuple[Field, list[Field]]:
    """Return the distance to the bone before cutting, and those to what is cut out, mm, positive inside."""
    side = np.abs(x)
    if vertebra.name == "C1":
        return _atlas(side, y, z)
    if vertebra.name == "C2":
        return _axis(vertebra, side, y, z)
    return _typical(vertebra, side, y, z)


def _unite(parts: list[Field], blend_mm: float) -> Field:
    return reduce(lambda a, b: smooth_union(a, b, blend_mm), parts)


def _foramen(side: Field, y: Field, at: tuple[float, float], half: tuple[float, float]) -> Field:
    """Return the distance to a canal along z through a transverse process."""
    return ellipse(side - np.float32(at[0]), y - np.float32(at[1]), *half)


def _canal(vertebra: Vertebra, x: Field, y: Field) -> Field:
    center_y = vertebra.depth / 2.0 + vertebra.canal_half_depth - 0.6
    return ellipse(x, y - np.float32(center_y), vertebra.canal_half_width, vertebra.canal_half_depth)


def _atlas(side: Field, y: Field, z: Field) -> tuple[Field, list[Field]]:
    """Two arches, lateral masses with hollow joint faces, and long transverse processes; no body."""
    parts = [
        # anterior arch, with its tubercle
        capsule(side, y, z, (0.0, -12.0, 0.0), (12.5, -7.0, 0.0), 2.6, 3.0, 0.62),
        capsule(side, y, z, (0.0, -13.6, -0.5), (0.0, -12.6, 0.0), 2.2, 2.6, 0.7),
        # lateral mass
        capsule(side, y, z, (15.0, -5.5, 0.0), (16.5, 3.5, 0.5), 4.2, 4.4, 0.80),
        # posterior arch, with its tubercle
        capsule(side, y, z, (16.0, 4.0, 1.0), (13.5, 15.0, 0.5), 2.6, 2.2, 0.62),
        capsule(side, y, z, (13.5, 15.0, 0.5), (7.0, 23.5, 0.0), 2.2, 2.2, 0.60),
        capsule(side, y, z, (7.0, 23.5, 0.0), (0.0, 26.0, 0.0), 2.2, 2.6, 0.60),
        capsule(side, y, z, (0.0, 26.0, 0.0), (0.0, 29.0, 0.0), 2.4, 2.0, 0.7),
        # transverse process, a plate that holds the foramen
        capsule(side, y, z, (18.0, -0.5, 0.0), (30.0, 2.0, -0.5), 5.2, 4.6, 1.5),
        capsule(side, y, z, (30.0, 2.0, -0.5), (35.0, 3.5, -1.0), 4.0, 3.0, 1.0),
    ]
    return _unite(parts, 2.0), [_foramen(side, y, (25.0, 0.8), (2.9, 2.7))]


def _axis(vertebra: Vertebra, side: Field, y: Field, z: Field) -> tuple[Field, list[Field]]:
    """A body with the dens, broad upper joint faces, a strong arch and a broad bifid spinous process."""
    half_z = vertebra.height / 2.0
    wide, middle = vertebra.canal_half_width, vertebra.depth / 2.0 + vertebra.canal_half_depth
    rear = middle + vertebra.canal_half_depth
    wall = ellipse(side, y, vertebra.width / 2.0, vertebra.depth / 2.0)
    plate = np.float32(half_z) - np.abs(z)
    body = -smooth_union(-wall, -plate, 2.0)
    parts = [
        body,
        # dens: a neck and a head with a rounded tip
        capsule(side, y, z, (0.0, -0.5, half_z - 2.0), (0.0, -1.5, half_z + 6.5), 5.4, 4.2),
        capsule(side, y, z, (0.0, -1.5, half_z + 6.5), (0.0, -1.0, half_z + 11.0), 4.4, 3.4),
        # upper joint faces, sloping down to the sides
        capsule(side, y, z, (7.5, 0.5, half_z - 4.5), (13.0, 0.5, half_z - 5.6), 4.8, 4.2, 1.10),
        # pedicle and pars, to the lower articular process
        capsule(side, y, z, (9.0, 3.0, 1.0), (wide + 3.0, middle + 1.0, -2.0), 3.6, 3.2),
        capsule(side, y, z, (wide + 3.0, middle + 1.0, -2.0), (wide + 3.4, middle + 6.0, -7.0), 3.2, 2.3),
        # lamina
        capsule(side, y, z, (wide + 1.5, middle + 4.5, -2.0), (0.0, rear + 4.0, -3.0), 2.5, 2.8, 0.45),
        # spinous process with two tips
        capsule(side, y, z, (0.0, rear + 3.0, -3.0), (0.0, rear + 13.0, -6.0), 3.0, 3.0, 0.55),
        capsule(side, y, z, (0.5, rear + 12.0, -6.0), (4.6, rear + 18.0, -8.5), 2.6, 2.0, 0.70),
        # transverse process
        capsule(side, y, z, (9.0, 2.5, -2.5), (19.5, 5.0, -5.5), 4.4, 4.0, 1.30),
    ]
    return _unite(parts, 2.0), [_canal(vertebra, side, y), _foramen(side, y, (15.4, 2.6), (2.2, 2.2))]


def _typical(vertebra: Vertebra, side: Field, y: Field, z: Field) -> tuple[Field, list[Field]]:
    """C3 to C7: uncinate processes, articular pillars, forked transverse processes with foramina; C3 to C6 have a
    short spinous process with two tips, C7 a long one with one.
    """
    half_x, half_y, half_z = vertebra.width / 2.0, vertebra.depth / 2.0, vertebra.height / 2.0
    wide, middle = vertebra.canal_half_width, half_y + vertebra.canal_half_depth
    rear = middle + vertebra.canal_half_depth
    last = vertebra.name == "C7"
    level = np.minimum(np.abs(z) / np.float32(half_z), 1.2)
    girth = np.float32(0.92) + np.float32(0.08) * level * level
    wall = ellipse(side, y, half_x * girth, half_y * girth)
    radius2 = (side / half_x) ** 2 + (y / half_y) ** 2
    plate = np.float32(half_z) - np.float32(0.8) * np.maximum(1.0 - radius2, 0.0) - np.abs(z)
    body = -smooth_union(-wall, -plate, 1.6)
    down = (7.8, -3.0) if last else (6.8, -4.4)  # of C7 farther back: T1 has the joints of the chest
    root, tip = half_x + 9.5, (7.5 if last else 0.0)
    parts = [
        body,
        # uncinate process, on the rim of the upper plate
        capsule(
            side, y, z, (half_x - 1.2, -0.05 * half_y, half_z - 1.4), (half_x - 0.8, 0.55 * half_y, half_z - 0.8),
            1.6, 1.6,
        ),
        # pedicle
        capsule(side, y, z, (half_x - 2.5, 0.4 * half_y, 0.6), (wide + 3.2, middle - 0.5, 0.6), 2.5, 2.6, 0.85),
        # articular pillar: its joint faces look up and back, and down and forwards
        capsule(side, y, z, (wide + 3.6, middle - 1.0, 3.6), (wide + 3.4, middle + 3.6, -0.8), 2.3, 2.8),
        capsule(side, y, z, (wide + 3.4, middle + 3.6, -0.8), (wide + 3.0, middle + down[0], down[1]), 2.8, 2.1),
        # lamina
        capsule(side, y, z, (wide + 2.0, middle + 4.6, -0.6), (0.0, rear + 3.2, -1.8), 1.9, 2.1, 0.62),
        # transverse process: a plate round the foramen with two tips
        capsule(side, y, z, (half_x - 1.0, 0.15 * half_y, -0.4), (root, 0.35 * half_y, -1.6), 4.0, 4.4, 1.6),
        capsule(side, y, z, (root, 0.35 * half_y - 2.8, -1.8), (root + 3.4, 0.35 * half_y - 4.0, -2.4), 1.8, 1.5),
        capsule(
            side, y, z, (root, 0.35 * half_y + 2.8, -1.8), (root + 4.2 + tip, 0.35 * half_y + 4.6 + 0.6 * tip, -2.8),
            2.0, 1.8,
        ),
    ]  # fmt: skip
    if last:
        parts += [capsule(side, y, z, (0.0, rear + 2.6, -2.0), (0.0, rear + 26.0, -9.5), 2.3, 3.0, 0.62)]
    else:
        parts += [
            capsule(side, y, z, (0.0, rear + 2.6, -1.8), (0.0, rear + 9.0, -3.0), 2.0, 1.9, 0.75),
            capsule(side, y, z, (0.4, rear + 8.5, -3.0), (3.6, rear + 13.5, -4.0), 1.7, 1.5, 0.85),
        ]
    wide_hole = 1.7 if last else 2.5
    holes = [_foramen(side, y, (half_x + 4.4, 0.25 * half_y), (wide_hole + 0.2, wide_hole))]
    return _unite(parts, 1.6), [_canal(vertebra, side, y), *holes]
