"""Signed distances of one vertebra in its own frame: body, arch with its processes, and spinal canal."""

from __future__ import annotations

import numpy as np

from clrecon.phantom.cervical import cervical_bounds, cervical_shape, facet_seats
from clrecon.phantom.fields import Field, capsule, ellipse, smooth_union
from clrecon.phantom.parts import Vertebra


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
    half_x, half_y, half_z = vertebra.width / 2.0, vertebra.depth / 2.0, vertebra.height / 2.0
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
    """Return the distance to pedicles, articular processes, laminae, transverse and spinous processes; |x| serves both
    sides.
    """
    side = np.abs(x)
    wide, deep, high = vertebra.canal_half_width, vertebra.canal_half_depth, vertebra.height
    middle = vertebra.depth / 2.0 + deep
    rear = middle + deep
    lumbar = vertebra.lumbar
    half_room = vertebra.room / 2.0
    thin, short = 0.15 * vertebra.room, 0.03 * vertebra.room

    def rod(thoracic: tuple[float, ...], lumbar_rod: tuple[float, ...], across: Field = side) -> Field:
        ax, ay, az, bx, by, bz, radius_a, radius_b, flatten = _mix(thoracic, lumbar_rod, lumbar)
        return capsule(across, y, z, (ax, ay, az * high), (bx, by, bz * high), radius_a, radius_b, flatten)

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
    """Return points along the middle of the upper articular process, local mm, with x of the left side.

    C1 has none: what lies above it is not part of the phantom.
    """
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
    """Return the distance to the bone before cutting, and those to what is cut out of it, mm, positive inside; x, y, z
    are local mm.
    """
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
    """Return the distance to the outer surface of the bone, mm, positive inside; x, y, z are local mm.

    It is exact on the surface and of first order near it; `clrecon.phantom.truth` has true distances.

    Returns: ndarray, of the type and the broadcast shape of x, y and z
    """
    bone, cuts = vertebra_shape(vertebra, x, y, z)
    for cut in cuts:
        bone = np.minimum(bone, -cut)
    return bone
