"""Signed distances of one vertebra in its own frame, how far vertebrae reach, and facet joints that nearly touch.

Of the neck: the ring of C1, C2 with its dens, and C3 to C7.  A shape is the bone before anything is cut out of it, and
what is cut out: the spinal canal and the foramina of the transverse processes.  All is symmetric: |x| serves both
sides.  The origin of C1 is the middle of its ring, that of the others the middle of their body.

Of the others: body, arch with its processes, and spinal canal.

Upper articular processes are widened up to a gap of the vertebra above."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import reduce
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from clrecon.geometry.affine import Float64Array
from clrecon.proof.phantom.fields import Field, Point, capsule, ellipse, nearest_on_surface, smooth_union
from clrecon.proof.phantom.spine_parts import SpineChoice, Vertebra, level_number


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


def _foramen(side: Field, y: Field, middle: tuple[float, float], half: tuple[float, float]) -> Field:
    """Return the distance to a canal along z through a transverse process."""
    return ellipse(side - np.float32(middle[0]), y - np.float32(middle[1]), *half)


def _canal(vertebra: Vertebra, x: Field, y: Field) -> Field:
    center_y = vertebra.depth / 2.0 + vertebra.canal_half_depth - 0.6
    return ellipse(x, y - np.float32(center_y), vertebra.canal_half_width, vertebra.canal_half_depth)


def _atlas(side: Field, y: Field, z: Field) -> tuple[Field, list[Field]]:
    """Two arches, lateral masses with hollow joint faces, and long transverse processes; no body."""
    parts = [
        # anterior arch, with its tubercle
        capsule((side, y, z), (0.0, -12.0, 0.0), (12.5, -7.0, 0.0), 2.6, 3.0, 0.62),
        capsule((side, y, z), (0.0, -13.6, -0.5), (0.0, -12.6, 0.0), 2.2, 2.6, 0.7),
        # lateral mass
        capsule((side, y, z), (15.0, -5.5, 0.0), (16.5, 3.5, 0.5), 4.2, 4.4, 0.80),
        # posterior arch, with its tubercle
        capsule((side, y, z), (16.0, 4.0, 1.0), (13.5, 15.0, 0.5), 2.6, 2.2, 0.62),
        capsule((side, y, z), (13.5, 15.0, 0.5), (7.0, 23.5, 0.0), 2.2, 2.2, 0.60),
        capsule((side, y, z), (7.0, 23.5, 0.0), (0.0, 26.0, 0.0), 2.2, 2.6, 0.60),
        capsule((side, y, z), (0.0, 26.0, 0.0), (0.0, 29.0, 0.0), 2.4, 2.0, 0.7),
        # transverse process, a plate that holds the foramen
        capsule((side, y, z), (18.0, -0.5, 0.0), (30.0, 2.0, -0.5), 5.2, 4.6, 1.5),
        capsule((side, y, z), (30.0, 2.0, -0.5), (35.0, 3.5, -1.0), 4.0, 3.0, 1.0),
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
        capsule((side, y, z), (0.0, -0.5, half_z - 2.0), (0.0, -1.5, half_z + 6.5), 5.4, 4.2),
        capsule((side, y, z), (0.0, -1.5, half_z + 6.5), (0.0, -1.0, half_z + 11.0), 4.4, 3.4),
        # upper joint faces, sloping down to the sides
        capsule((side, y, z), (7.5, 0.5, half_z - 4.5), (13.0, 0.5, half_z - 5.6), 4.8, 4.2, 1.10),
        # pedicle and pars, to the lower articular process
        capsule((side, y, z), (9.0, 3.0, 1.0), (wide + 3.0, middle + 1.0, -2.0), 3.6, 3.2),
        capsule((side, y, z), (wide + 3.0, middle + 1.0, -2.0), (wide + 3.4, middle + 6.0, -7.0), 3.2, 2.3),
        # lamina
        capsule((side, y, z), (wide + 1.5, middle + 4.5, -2.0), (0.0, rear + 4.0, -3.0), 2.5, 2.8, 0.45),
        # spinous process with two tips
        capsule((side, y, z), (0.0, rear + 3.0, -3.0), (0.0, rear + 13.0, -6.0), 3.0, 3.0, 0.55),
        capsule((side, y, z), (0.5, rear + 12.0, -6.0), (4.6, rear + 18.0, -8.5), 2.6, 2.0, 0.70),
        # transverse process
        capsule((side, y, z), (9.0, 2.5, -2.5), (19.5, 5.0, -5.5), 4.4, 4.0, 1.30),
    ]
    return _unite(parts, 2.0), [_canal(vertebra, side, y), _foramen(side, y, (15.4, 2.6), (2.2, 2.2))]


def _typical(vertebra: Vertebra, side: Field, y: Field, z: Field) -> tuple[Field, list[Field]]:
    """C3 to C7: uncinate processes, pillars, forked transverse processes; C7 alone has one long spinous tip."""
    half_x, half_y = vertebra.width / 2.0, vertebra.depth / 2.0
    half_z = vertebra.height / 2.0
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
            (side, y, z), (half_x - 1.2, -0.05 * half_y, half_z - 1.4), (half_x - 0.8, 0.55 * half_y, half_z - 0.8),
            1.6, 1.6,
        ),
        # pedicle
        capsule((side, y, z), (half_x - 2.5, 0.4 * half_y, 0.6), (wide + 3.2, middle - 0.5, 0.6), 2.5, 2.6, 0.85),
        # articular pillar: its joint faces look up and back, and down and forwards
        capsule((side, y, z), (wide + 3.6, middle - 1.0, 3.6), (wide + 3.4, middle + 3.6, -0.8), 2.3, 2.8),
        capsule((side, y, z), (wide + 3.4, middle + 3.6, -0.8), (wide + 3.0, middle + down[0], down[1]), 2.8, 2.1),
        # lamina
        capsule((side, y, z), (wide + 2.0, middle + 4.6, -0.6), (0.0, rear + 3.2, -1.8), 1.9, 2.1, 0.62),
        # transverse process: a plate round the foramen with two tips
        capsule((side, y, z), (half_x - 1.0, 0.15 * half_y, -0.4), (root, 0.35 * half_y, -1.6), 4.0, 4.4, 1.6),
        capsule((side, y, z), (root, 0.35 * half_y - 2.8, -1.8), (root + 3.4, 0.35 * half_y - 4.0, -2.4), 1.8, 1.5),
        capsule(
            (side, y, z), (root, 0.35 * half_y + 2.8, -1.8), (root + 4.2 + tip, 0.35 * half_y + 4.6 + 0.6 * tip, -2.8),
            2.0, 1.8,
        ),
    ]  # fmt: skip
    if last:
        parts += [capsule((side, y, z), (0.0, rear + 2.6, -2.0), (0.0, rear + 26.0, -9.5), 2.3, 3.0, 0.62)]
    else:
        parts += [
            capsule((side, y, z), (0.0, rear + 2.6, -1.8), (0.0, rear + 9.0, -3.0), 2.0, 1.9, 0.75),
            capsule((side, y, z), (0.4, rear + 8.5, -3.0), (3.6, rear + 13.5, -4.0), 1.7, 1.5, 0.85),
        ]
    wide_hole = 1.7 if last else 2.5
    holes = [_foramen(side, y, (half_x + 4.4, 0.25 * half_y), (wide_hole + 0.2, wide_hole))]
    return _unite(parts, 1.6), [_canal(vertebra, side, y), *holes]


def local_bounds(vertebra: Vertebra) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the lowest and highest corner, local mm, of a box that holds the whole vertebra."""
    if vertebra.is_cervical:
        return cervical_bounds(vertebra)
    side = max(vertebra.width / 2.0 + 24.0, vertebra.canal_half_width + 26.0)
    back = vertebra.depth / 2.0 + 2.0 * vertebra.canal_half_depth + 40.0
    below = -1.45 * vertebra.height - 4.0
    return (-side, -vertebra.depth / 2.0 - 3.0, below), (side, back, 0.8 * vertebra.height + 4.0)


def canal_distance(vertebra: Vertebra, x: Field, y: Field) -> Field:
    """Return the distance to the wall of the spinal canal, positive inside the canal."""
    center_y = vertebra.depth / 2.0 + vertebra.canal_half_depth - 0.8
    return ellipse(x, y - np.float32(center_y), vertebra.canal_half_width, vertebra.canal_half_depth)


def _body_distance(vertebra: Vertebra, x: Field, y: Field, z: Field) -> Field:
    """Return the distance to a waisted elliptic cylinder with slightly hollow endplates and a flattened back."""
    half_x, half_y = vertebra.width / 2.0, vertebra.depth / 2.0
    half_z = vertebra.height / 2.0
    level = np.minimum(np.abs(z) / np.float32(half_z), 1.2)
    # 9 % waist at mid height, a small lip at the rims
    girth = np.float32(0.91) + np.float32(0.09) * level * level
    wall = ellipse(x, y, half_x * girth, half_y * girth)
    back = np.float32(half_y * 0.93) * girth - y
    wall = -smooth_union(-wall, -back, 3.0)
    radius2 = (x / half_x) ** 2 + (y / half_y) ** 2
    plate = np.float32(half_z) - np.float32(1.6) * np.maximum(1.0 - radius2, 0.0) - np.abs(z)
    return -smooth_union(-wall, -plate, 1.6)


def _mix(thoracic: tuple[float, ...], lumbar: tuple[float, ...], share: float) -> tuple[float, ...]:
    return tuple(t + share * (u - t) for t, u in zip(thoracic, lumbar, strict=True))


def _arch_distance(vertebra: Vertebra, x: Field, y: Field, z: Field) -> Field:
    """Return the distance to pedicles, laminae and all processes; |x| serves both sides."""
    side = np.abs(x)
    wide, deep = vertebra.canal_half_width, vertebra.canal_half_depth
    high = vertebra.height
    middle = vertebra.depth / 2.0 + deep
    rear = middle + deep
    lumbar = vertebra.lumbar
    half_room = vertebra.room / 2.0
    thin, short = 0.15 * vertebra.room, 0.03 * vertebra.room

    def rod(thoracic: tuple[float, ...], lumbar_rod: tuple[float, ...], across: Field = side) -> Field:
        ax, ay, az, bx, by, bz, radius_a, radius_b, flatten = _mix(thoracic, lumbar_rod, lumbar)
        return capsule((across, y, z), (ax, ay, az * high), (bx, by, bz * high), radius_a, radius_b, flatten)

    inner = 0.29 * vertebra.width, 0.24 * vertebra.depth
    distance = rod(
        (*inner, 0.17, wide + 3.0, middle + 1.0, 0.17, 2.9, 3.1, 0.55),
        (*inner, 0.16, wide + 3.8, middle + 1.0, 0.15, 3.9, 4.1, 0.55),
    )
    parts = [
        # pars between the articular processes
        rod(
            (wide + 2.5, middle + 2.0, 0.25, wide + 0.5, middle + 6.0, -0.30, 3.0, 3.0, 1.0),
            (wide + 4.2, middle + 1.5, 0.25, wide + 1.5, middle + 6.8, -0.32, 4.0, 3.8, 1.0),
        ),
        # superior articular process: in front of and lateral to the inferior one of the level above
        rod(
            (wide + 2.0, middle + 2.5, 0.15, wide + 1.8, middle + 4.0 - half_room, 0.62 - short, 2.8, 2.4 - thin, 1.0),
            (wide + 4.8, middle + 3.0, 0.15, wide + 6.0, middle + 4.6 - half_room, 0.60 - short, 3.6, 3.2 - thin, 1.0),
        ),
        # inferior articular process
        rod(
            (wide, middle + 6.5, -0.20, wide - 0.5, middle + 9.8 + half_room, -0.68, 2.9, 2.3 - thin, 1.0),
            (wide + 0.8, middle + 7.0, -0.20, wide - 0.8, middle + 9.8 + half_room, -0.72, 3.6, 3.0 - thin, 1.0),
        ),
        # lamina
        rod(
            (wide, middle + 5.0, 0.02, 0.0, rear + 3.4, -0.20, 2.5, 2.7, 0.40),
            (wide + 0.5, middle + 5.5, 0.0, 0.0, rear + 3.8, -0.14, 2.6, 2.9, 0.42),
        ),
        # transverse process
        rod(
            (wide + 3.0, middle + 3.5, 0.15, wide + 19.0, middle + 14.5, 0.22, 3.6, 4.4, 0.80),
            (wide + 4.0, middle + 2.0, 0.14, 0.5 * vertebra.width + 18.0, middle + 6.0, 0.20, 3.4, 2.4, 0.50),
        ),
        # spinous process: slender and steep in the chest, a tall plate in the loin
        rod(
            (0.0, rear + 3.0, -0.15, 0.0, rear + 25.0, -1.15, 2.8, 2.4, 0.60),
            (0.0, rear + 4.0, -0.16, 0.0, rear + 28.0, -0.32, 2.5, 3.4, 0.38),
            x,
        ),
    ]
    for part in parts:
        distance = smooth_union(distance, part, 3.0)
    return distance


def upper_facet_seats(vertebra: Vertebra) -> list[tuple[float, float, float]]:
    """Return points along the middle of the left upper articular process, local mm; C1 has none."""
    if vertebra.is_cervical:
        return facet_seats(vertebra)
    wide, middle = vertebra.canal_half_width, vertebra.depth / 2.0 + vertebra.canal_half_depth
    low = _mix((2.0, 2.5, 0.15), (4.8, 3.0, 0.15), vertebra.lumbar)
    top = _mix((1.8, 4.0, 0.62), (6.0, 4.6, 0.60), vertebra.lumbar)
    seats = []
    for share in (0.5, 0.75, 1.0):
        x, y, z = (a + share * (b - a) for a, b in zip(low, top, strict=True))
        seats.append((wide + x, middle + y, z * vertebra.height))
    return seats


def vertebra_shape(vertebra: Vertebra, x: Field, y: Field, z: Field) -> tuple[Field, list[Field]]:
    """Return distances, mm, positive inside, at local x, y, z: to the uncut bone, and to what is cut out of it."""
    if vertebra.is_cervical:
        bone, cuts = cervical_shape(vertebra, x, y, z)
    else:
        bone = smooth_union(_body_distance(vertebra, x, y, z), _arch_distance(vertebra, x, y, z), 2.0)
        cuts = [canal_distance(vertebra, x, y)]
    for cx, cy, cz, radius in vertebra.facets:
        ball = np.sqrt((x - np.float32(cx)) ** 2 + (y - np.float32(cy)) ** 2 + (z - np.float32(cz)) ** 2)
        np.maximum(bone, np.float32(radius) - ball, out=bone)
    return bone, cuts


def vertebra_distance(vertebra: Vertebra, x: Field, y: Field, z: Field) -> Field:
    """Return the distance to the outer surface, mm, positive inside, exact on it, at local x, y, z."""
    bone, cuts = vertebra_shape(vertebra, x, y, z)
    for cut in cuts:
        bone = np.minimum(bone, -cut)
    return bone


_STEP_MM = 3.0
_RIM_MM = 1.0
"""Bone is looked for on a lattice; thin ends between its points reach this much farther."""


def _body_reach(vertebra: Vertebra, direction: Float64Array) -> float:
    """Return how far a vertebral body, or the space in the ring of C1, reaches from its middle."""
    x, y, z = vertebra.axes @ direction
    return float(np.hypot(x * vertebra.width, y * vertebra.depth) + abs(z) * vertebra.height) / 2.0


def body_extent(vertebrae: Sequence[Vertebra], direction: ArrayLike) -> tuple[float, float]:
    """Return the lowest and highest place of the vertebral bodies along a unit vector, mm."""
    along = np.asarray(direction, dtype=np.float64)
    middles = [float(v.center @ along) for v in vertebrae]
    reaches = [_body_reach(v, along) for v in vertebrae]
    return (
        min(m - r for m, r in zip(middles, reaches, strict=True)),
        max(m + r for m, r in zip(middles, reaches, strict=True)),
    )


def bone_points(vertebra: Vertebra) -> Float64Array:
    """Return the points (n, 3), mm of the plan, of a lattice of 3 mm that lie in a vertebra or up to 1 mm beside it."""
    low, high = local_bounds(vertebra)
    axes = [np.arange(a, b + _STEP_MM, _STEP_MM) for a, b in zip(low, high, strict=True)]
    x, y, z = (part.ravel() for part in np.meshgrid(*axes, indexing="ij"))
    bone = vertebra_distance(vertebra, x, y, z) > -_RIM_MM
    return vertebra.center + np.stack((x, y, z), axis=1)[bone] @ vertebra.axes


def bone_extent(vertebrae: Sequence[Vertebra], direction: ArrayLike) -> tuple[float, float]:
    """Return the lowest and highest place of whole vertebrae along a unit vector, mm, with a rim of about 1 mm."""
    along = np.asarray(direction, dtype=np.float64)
    places = np.concatenate([bone_points(vertebra) for vertebra in vertebrae]) @ along
    return float(places.min()) - _RIM_MM, float(places.max()) + _RIM_MM


def centring_shift(vertebrae: Sequence[Vertebra], choice: SpineChoice) -> Float64Array:
    """Return the shift along z that puts the bones, or in a short volume the bodies alone, into its middle."""
    normal = np.array(choice.normal)
    slope = float(normal[2])
    if abs(slope) < 0.5:
        normal, slope = np.array((0.0, 0.0, 1.0)), 1.0
    low, high = bone_extent(vertebrae, normal)
    if choice.length_mm is not None and high - low > choice.length_mm:
        low, high = body_extent(vertebrae, normal)
    return np.array((0.0, 0.0, -(low + high) / 2.0 / slope))


LARGEST_GAP_MM = 1.5
"""Largest gap: the shapes themselves lie farther apart."""

_LARGEST_BALL_MM = 6.0
_ROUNDS = 40


def _distance_to(vertebra: Vertebra, points: Float64Array) -> Float64Array:
    """Return the distance from points (n, 3) outside of a vertebra and near it, in mm of the plan, to its surface."""

    def surface(local: Float64Array) -> Float64Array:
        return np.asarray(vertebra_distance(vertebra, *local.T), dtype=np.float64)

    local = (points - vertebra.center) @ vertebra.axes.T
    # the 26 neighbours in a cube
    grid = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.any(grid != 0.0, axis=1)]
    ways = grid / np.linalg.norm(grid, axis=1)[:, None]
    # starts at three distances in all directions: the processes of the vertebra may lie on any side
    starts = np.concatenate([local[:, None] + reach * ways for reach in (2.0, 4.0, 7.0)], axis=1)
    targets = np.repeat(local, starts.shape[1], axis=0)
    nearest = nearest_on_surface(surface, targets, starts.reshape(-1, 3), _ROUNDS)
    return nearest.reshape(len(points), -1).min(axis=1)


def close_facets(vertebrae: Sequence[Vertebra], gap_mm: float) -> list[Vertebra]:
    """Widen upper articular processes, from top to bottom, by balls `gap_mm` from the neighbour above."""
    closed = list(vertebrae[:1])
    for lower in vertebrae[1:]:
        upper = closed[-1]
        if level_number(lower.name) == level_number(upper.name) + 1:
            seats = np.array([(side * x, y, z) for (x, y, z), side in product(upper_facet_seats(lower), (1.0, -1.0))])
            free = _distance_to(upper, lower.center + seats @ lower.axes)
            radii = np.minimum(free - gap_mm, _LARGEST_BALL_MM)
            lower = dataclasses.replace(lower, facets=np.column_stack((seats, radii))[radii > 0.5])
        closed.append(lower)
    return closed
