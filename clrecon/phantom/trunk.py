"""Plans of limbs, specimens, a pelvis with metal, a trunk with contrast medium, a water cylinder, and no body."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from clrecon.phantom.fields import Field, coverage, ellipsoid
from clrecon.phantom.parts import Vertebra
from clrecon.phantom.plan import plan_anatomy
from clrecon.phantom.scenes import AIR_HU, Part, Plan
from clrecon.phantom.solids import ball, column, cut, rod
from clrecon.phantom.vertebra import local_bounds, vertebra_distance

COMPACT_HU = 1400.0
SPONGY_HU = 260.0
MARROW_HU = -60.0
MUSCLE_HU = 55.0
FAT_HU = -100.0
METAL_HU = 8000.0
"""Far above the highest 12-bit value, so that it is cut off when stored."""


def _leg(x: float, y: float, size: float) -> list[Part]:
    """Plan a lower leg without ends, `size` times that of a large person: skin and fat, muscle, tibia and fibula as
    tubes.
    """

    def bone(dx: float, dy: float, radius: float, wall: float) -> list[Part]:
        lean = 12.0 * size
        low, high = (x + size * dx - lean, y + size * dy, -400.0), (x + size * dx + lean, y + size * dy, 400.0)
        outer, inner = size * radius, size * (radius - wall)
        return [rod("bone", COMPACT_HU, low, high, outer), rod("tissue", MARROW_HU, low, high, inner)]

    return [
        column("tissue", FAT_HU, (x, y), (52.0 * size, 56.0 * size)),
        column("tissue", MUSCLE_HU, (x, y), (45.0 * size, 49.0 * size)),
        *bone(-6.0, -24.0, 14.0, 5.0),
        *bone(22.0, -4.0, 7.0, 2.8),
    ]


def plan_limb() -> Plan:
    """Plan one lower leg, off the centre of the field of view."""
    return Plan(_leg(38.0, -14.0, 0.95), front=-67.0, back=39.0)


def plan_pair() -> Plan:
    """Plan two legs of two sizes beside each other with air between them."""
    return Plan([*_leg(56.0, 0.0, 0.95), *_leg(-52.0, 17.0, 0.65)], front=-53.0, back=53.0)


def _vertebra(vertebra: Vertebra, center: np.ndarray, axes: np.ndarray, marrow_hu: float) -> list[Part]:
    """Plan cortex and marrow of a vertebra at any place and angle."""
    low, high = local_bounds(vertebra)
    at = (float(center[0]), float(center[1]), float(center[2]))

    def bone(x: Field, y: Field, z: Field) -> Field:
        return vertebra_distance(vertebra, x, y, z)

    def marrow(x: Field, y: Field, z: Field) -> Field:
        # The cortex is thicker behind the body.
        arch = coverage(y - np.float32(vertebra.depth / 2.0 + 1.0), 6.0)
        return np.asarray(bone(x, y, z) - np.float32(1.0) - np.float32(0.6) * arch, dtype=np.float32)

    return [Part("bone", 950.0, bone, low, high, at, axes), Part("bone", marrow_hu, marrow, low, high, at, axes)]


def plan_bones() -> Plan:
    """Plan separate macerated bones: three vertebrae, a rib and a shaft, with air between and in them."""
    levels = {v.name: v for v in plan_anatomy((256.0, 256.0, 300.0), np.eye(3), 0).vertebrae}
    parts: list[Part] = []
    for name, x, z, turn in (("L3", -56.0, 34.0, 0.0), ("L1", 52.0, 30.0, 40.0), ("T8", 50.0, -42.0, -70.0)):
        c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        axes = np.array(((c, 0.0, -s), (0.0, 1.0, 0.0), (s, 0.0, c)))
        reach = local_bounds(levels[name])[1][1] - 12.0
        parts += _vertebra(levels[name], np.array((x, 30.0 - reach, z)), axes, -300.0)
    angles = np.radians(np.linspace(-70.0, 70.0, 9))
    chain = [(-44.0 + 70.0 * math.sin(a), 26.0, -70.0 + 58.0 * math.cos(a)) for a in angles]
    parts += [rod("bone", 900.0, a, b, 4.0) for a, b in zip(chain[:-1], chain[1:], strict=True)]
    shaft = ((-92.0, 20.0, -62.0), (8.0, 20.0, -66.0))
    parts += [rod("bone", COMPACT_HU, *shaft, 10.0), rod("air", AIR_HU, *shaft, 6.0)]
    return Plan(parts, front=-60.0, back=30.0)


def _trunk(width: float, depth: float) -> list[Part]:
    """Plan skin and fat, muscle wall, and fat around the organs: columns without ends of the given half axes."""
    layers = ((0.0, 20.0), (2.0, FAT_HU), (16.0, MUSCLE_HU), (30.0, FAT_HU))
    return [column("tissue", hu, (0.0, 0.0), (width - at, depth - at)) for at, hu in layers]


def _bent_plate(center: tuple[float, float, float], half: tuple[float, float, float], side: float) -> list[Part]:
    """Plan an iliac wing: a piece of the wall of an ellipsoid, 8 mm thick, spongy inside."""

    def keep(x: Field, y: Field, z: Field) -> Field:
        return np.minimum(np.float32(side) * x - np.float32(0.25 * half[0]), z + np.float32(0.55 * half[2]))

    def plate(inset: float, material: str, hu: float) -> Part:
        def distance(x: Field, y: Field, z: Field) -> Field:
            outer = ellipsoid(x, y, z, half)
            return np.minimum(outer - np.float32(inset), np.float32(8.0 - inset) - outer)

        low = (-half[0], -half[1], -half[2])
        return cut(Part(material, hu, distance, low, half, center), keep)

    return [plate(0.0, "bone", 900.0), plate(1.8, "bone", SPONGY_HU)]


def plan_pelvis() -> Plan:
    """Plan a pelvis with metal: a hip prosthesis on the left, a screw through the right sacroiliac joint."""
    parts = [*_trunk(172.0, 112.0), ball("tissue", 12.0, (0.0, -30.0, -30.0), (42.0, 36.0, 34.0))]
    parts += [ball("bone", 700.0, (0.0, 52.0, 46.0), (52.0, 26.0, 56.0))]
    parts += [ball("bone", 180.0, (0.0, 52.0, 46.0), (49.5, 23.5, 53.5))]
    for side in (1.0, -1.0):
        parts += _bent_plate((side * 22.0, 12.0, 52.0), (104.0, 82.0, 88.0), side)
        parts += [rod("bone", 900.0, (side * 84.0, 4.0, -16.0), (side * 10.0, -66.0, -44.0), 9.0, 8.0)]
        parts += [rod("bone", SPONGY_HU, (side * 84.0, 4.0, -16.0), (side * 10.0, -66.0, -44.0), 6.8, 6.0)]
    hip = (-96.0, 0.0, -24.0)
    parts += [ball("bone", 900.0, hip, (23.0, 23.0, 23.0)), ball("bone", 320.0, hip, (21.0, 21.0, 21.0))]
    for side in (1.0, -1.0):
        neck, knee = (side * 96.0, 0.0, -24.0), (side * 136.0, 6.0, -54.0)
        shaft = (side * 128.0, 8.0, -300.0)
        if side < 0.0:
            parts += [rod("bone", 950.0, neck, knee, 13.0), rod("bone", SPONGY_HU, neck, knee, 10.5)]
        parts += [rod("bone", COMPACT_HU, knee, shaft, 16.0), rod("tissue", MARROW_HU, knee, shaft, 8.5)]
    head, joint = (96.0, 0.0, -24.0), (132.0, 6.0, -52.0)
    parts += [
        ball("metal", METAL_HU, head, (26.0, 26.0, 26.0)),
        ball("tissue", 80.0, head, (22.0, 22.0, 22.0)),
        ball("metal", METAL_HU, head, (16.0, 16.0, 16.0)),
        rod("metal", METAL_HU, head, joint, 7.0),
        rod("metal", METAL_HU, joint, (129.0, 8.0, -160.0), 8.0, 5.0),
        rod("metal", METAL_HU, (-108.0, 56.0, 40.0), (-24.0, 48.0, 44.0), 3.6),
    ]
    return Plan(parts, front=-112.0, back=112.0)


def plan_contrast() -> Plan:
    """Plan a trunk full of contrast medium: heart, aorta and kidneys brighter and larger than the spine behind them."""
    anatomy = plan_anatomy((360.0, 300.0, 400.0), np.eye(3), 0)
    width, depth = anatomy.half_width, anatomy.half_depth
    parts = _trunk(width, depth)
    for side in (1.0, -1.0):
        parts.append(ball("tissue", -860.0, (side * 0.5 * width, -8.0, 90.0), (0.40 * width, 0.66 * depth, 120.0)))
    parts.append(ball("tissue", 110.0, (-0.42 * width, -12.0, -52.0), (0.46 * width, 0.62 * depth, 52.0)))
    for vertebra in anatomy.vertebrae:
        parts += _vertebra(vertebra, vertebra.center, vertebra.axes, 190.0)
    for disc in anatomy.discs:
        half, ends = (disc.half_width, disc.half_depth), (-disc.half_length, disc.half_length)
        core = column("tissue", 92.0, (0.0, 0.0), half, ends)
        # painted before the vertebrae, which cover them
        parts.insert(7, dataclasses.replace(core, center=_point(disc.center), axes=disc.axes))
    for rib in anatomy.ribs:
        chain = [_point(point) for point in rib.points]
        parts += [rod("bone", 800.0, start, end, 4.0) for start, end in zip(chain[:-1:2], chain[2::2], strict=False)]
    spine = [_point(v.center) for v in anatomy.vertebrae]
    aorta = [(x + 16.0, y - 40.0, z) for x, y, z in spine]
    parts += [rod("contrast", 400.0, a, b, 13.0) for a, b in zip(aorta[:-1], aorta[1:], strict=True)]
    cava = [(x - 18.0, y - 38.0, z) for x, y, z in spine]
    parts += [rod("contrast", 260.0, a, b, 11.0) for a, b in zip(cava[:-1], cava[1:], strict=True)]
    parts += [
        ball("tissue", 120.0, (20.0, -34.0, 48.0), (58.0, 44.0, 56.0)),
        ball("contrast", 420.0, (26.0, -36.0, 48.0), (48.0, 34.0, 46.0)),
        rod("contrast", 420.0, (10.0, -36.0, 80.0), aorta[4], 15.0, 13.0),
        *(ball("contrast", 300.0, (s * 58.0, spine[13][1] + 6.0, spine[13][2]), (24.0, 20.0, 48.0)) for s in (1, -1)),
    ]
    return Plan(parts, front=-depth, back=depth)


def _point(vector: np.ndarray) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def plan_water() -> Plan:
    """Plan a cylinder of water, 200 mm across, in an acrylic shell of 6 mm."""
    wall = column("water", 120.0, (0.0, 0.0), (106.0, 106.0), (-70.0, 70.0))
    return Plan([wall, column("water", 0.0, (0.0, 0.0), (100.0, 100.0), (-64.0, 64.0))], front=-106.0, back=106.0)


def plan_nothing() -> Plan:
    """Plan no body: only the table remains."""
    return Plan([], front=-40.0, back=40.0)
