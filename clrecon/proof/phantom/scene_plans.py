"""Plans of scenes: heads, limbs, specimens, trunks, and the table from the kind of a scene to its plan.

Bone of jaw, long bone, hand, hip and mouse is compact all over, with marrow of tissue's values in it: its volume at
half of the way from tissue to bone is that of its parts.  Walls are three voxels thick and more."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from clrecon.proof.phantom.fields import Field, coverage, ellipsoid
from clrecon.proof.phantom.scenes import (
    AIR_HU,
    METAL_HU,
    Part,
    Plan,
    Point,
    ball,
    box,
    column,
    cut,
    lay_under,
    rod,
    to_point,
)
from clrecon.proof.phantom.settings import PhantomSettings
from clrecon.proof.phantom.spine_parts import Vertebra
from clrecon.proof.phantom.spine_plan import plan_anatomy
from clrecon.proof.phantom.vertebra import local_bounds, vertebra_distance

_SKULL_COMPACT_HU = 1350.0
_DIPLOE_HU = 620.0
_PETROUS_HU = 1900.0
_TOOTH_HU = 2600.0
_VAULT = (71.0, 90.0, 68.0)
"""Half axes of the vault, mm."""
_VAULT_Z = 10.0
_FLOOR_Z = -42.0
"""z of the base of the skull, mm, relative to the middle of the vault."""


def _wall(x: Field, y: Field, z: Field) -> Field:
    """Return the thickness of the vault: 3 mm at the temples, 8 mm at forehead and occiput."""
    return np.float32(3.0) + np.float32(5.0) * np.clip(np.abs(y) / np.float32(_VAULT[1]), 0.0, 1.0)


def _depth_in_vault(x: Field, y: Field, z: Field) -> Field:
    """Return the distance to the inner surface of the vault, positive within it."""
    return np.asarray(ellipsoid(x, y, z, _VAULT) - _wall(x, y, z), dtype=np.float32)


def _depth_in_diploe(x: Field, y: Field, z: Field) -> Field:
    """Return a distance positive in the diploe, which lies between two tables of 1.2 mm where the wall is thick."""
    outer = ellipsoid(x, y, z, _VAULT)
    wall = _wall(x, y, z)
    between = np.minimum(outer - np.float32(1.2), wall - np.float32(1.2) - outer)
    return np.minimum(between, wall - np.float32(3.5))


def _vault(material: str, hu: float) -> list[Part]:
    """Plan the vault: compact bone, the diploe between its two tables, and the contents."""
    whole = ball("bone", _SKULL_COMPACT_HU, (0.0, 0.0, _VAULT_Z), _VAULT)
    layers = (
        whole,
        dataclasses.replace(cut(whole, _depth_in_diploe), hu=_DIPLOE_HU),
        dataclasses.replace(cut(whole, _depth_in_vault), material=material, hu=hu),
    )
    return [cut(layer, lambda x, y, z: z - np.float32(_FLOOR_Z)) for layer in layers]


def _base() -> list[Part]:
    """Plan the floor of the skull with the foramen magnum, and the two petrous pyramids."""
    level = _VAULT_Z + _FLOOR_Z
    plate = column("bone", _SKULL_COMPACT_HU, (0.0, 4.0), (52.0, 66.0), (level - 5.0, level + 2.0))
    hole = column("bone", _SKULL_COMPACT_HU, (0.0, 36.0), (15.0, 17.0), (level - 9.0, level + 9.0)).distance
    plate = cut(plate, lambda x, y, z: -hole(x, y - np.float32(32.0), z))
    pyramids = [
        rod("bone", _PETROUS_HU, (side * 12.0, 4.0, level + 1.0), (side * 56.0, 26.0, level + 2.0), 7.0, 10.0)
        for side in (1.0, -1.0)
    ]
    return [plate, *pyramids]


def _face(inside_material: str, inside_hu: float) -> list[Part]:
    """Plan orbits, maxilla with its sinuses, cheek bones, teeth and a mandible that touches no other bone."""
    level = _VAULT_Z + _FLOOR_Z
    parts: list[Part] = []
    for side in (1.0, -1.0):
        orbit = (side * 32.0, -66.0, level + 12.0)
        cheek = (side * 62.0, -38.0, level - 8.0)
        parts += [
            ball("bone", _SKULL_COMPACT_HU, orbit, (21.0, 24.0, 20.0)),
            ball(inside_material, inside_hu, (orbit[0], orbit[1] - 4.0, orbit[2]), (19.0, 24.0, 18.0)),
            ball("bone", _SKULL_COMPACT_HU, (side * 24.0, -60.0, level - 22.0), (19.0, 20.0, 20.0)),
            ball("air", AIR_HU, (side * 24.0, -60.0, level - 22.0), (17.2, 18.2, 18.2)),
            rod("bone", _SKULL_COMPACT_HU, (side * 44.0, -70.0, level - 10.0), cheek, 4.5, 2.5),
            rod("bone", _SKULL_COMPACT_HU, cheek, (side * 60.0, -2.0, level - 2.0), 2.5, 3.0),
        ]
        corner = (side * 46.0, -14.0, level - 60.0)
        parts += [
            rod("bone", _SKULL_COMPACT_HU, (side * 52.0, -6.0, level - 12.0), corner, 4.5, 5.5),
            rod("bone", _SKULL_COMPACT_HU, corner, (side * 10.0, -76.0, level - 66.0), 5.5, 7.0),
        ]
        for angle in np.radians(np.linspace(8.0, 80.0, 6)):
            x, y = side * 26.0 * np.sin(angle), -52.0 - 28.0 * np.cos(angle)
            parts.append(rod("bone", _TOOTH_HU, (x, y, level - 50.0), (x, y, level - 40.0), 2.8))
    parts.append(rod("bone", _SKULL_COMPACT_HU, (-10.0, -76.0, level - 66.0), (10.0, -76.0, level - 66.0), 7.0))
    return parts


def plan_dry_skull() -> Plan:
    """Plan a macerated skull: a thin dense vault with base and face, air inside and outside, no soft tissue."""
    parts = [*_vault("air", AIR_HU), *_base(), *_face("air", AIR_HU)]
    return Plan(parts, front=-92.0, back=_VAULT[1], rest=(0.0, _VAULT_Z))


def plan_head() -> Plan:
    """Plan the same skull in soft tissue: scalp, face, brain, eyes, neck, and air in sinuses, nose and throat."""
    level = _VAULT_Z + _FLOOR_Z
    skin = tuple(half + 7.0 for half in _VAULT)
    soft = [
        column("tissue", 45.0, (0.0, 22.0), (56.0, 58.0), (-1e4, level)),
        ball("tissue", 30.0, (0.0, 0.0, _VAULT_Z), (skin[0], skin[1], skin[2])),
        ball("tissue", 10.0, (0.0, -38.0, level - 20.0), (66.0, 62.0, 66.0)),
        rod("tissue", 20.0, (0.0, -96.0, level - 2.0), (0.0, -104.0, level - 18.0), 7.0, 11.0),
    ]
    eyes = [ball("tissue", 12.0, (side * 32.0, -78.0, level + 12.0), (12.0, 12.0, 12.0)) for side in (1, -1)]
    airway = [
        rod("air", AIR_HU, (0.0, -84.0, level - 16.0), (0.0, -30.0, level - 16.0), 6.0),
        rod("air", AIR_HU, (0.0, -30.0, level - 16.0), (0.0, -16.0, level - 90.0), 8.0),
    ]
    parts = [*soft, *_vault("tissue", 36.0), *_base(), *_face("tissue", -80.0), *eyes, *airway]
    return Plan(parts, front=-115.0, back=skin[1], rest=(0.0, _VAULT_Z))


COMPACT_HU = 1400.0
_SPONGY_HU = 260.0
MARROW_HU = -60.0
MUSCLE_HU = 55.0
FAT_HU = -100.0


def _leg(x: float, y: float, size: float) -> list[Part]:
    """Plan a leg without ends, `size` times a large person's: skin and fat, muscle, tibia and fibula."""

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
    spot = to_point(center)

    def bone(x: Field, y: Field, z: Field) -> Field:
        return vertebra_distance(vertebra, x, y, z)

    def marrow(x: Field, y: Field, z: Field) -> Field:
        # The cortex is thicker behind the body.
        arch = coverage(y - np.float32(vertebra.depth / 2.0 + 1.0), 6.0)
        return np.asarray(bone(x, y, z) - np.float32(1.0) - np.float32(0.6) * arch, dtype=np.float32)

    return [Part("bone", 950.0, bone, low, high, spot, axes), Part("bone", marrow_hu, marrow, low, high, spot, axes)]


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

        return cut(Part(material, hu, distance, (-half[0], -half[1], -half[2]), half, center), keep)

    return [plate(0.0, "bone", 900.0), plate(1.8, "bone", _SPONGY_HU)]


def plan_pelvis() -> Plan:
    """Plan a pelvis with metal: a hip prosthesis on the left, a screw through the right sacroiliac joint."""
    parts = [*_trunk(172.0, 112.0), ball("tissue", 12.0, (0.0, -30.0, -30.0), (42.0, 36.0, 34.0))]
    parts += [ball("bone", 700.0, (0.0, 52.0, 46.0), (52.0, 26.0, 56.0))]
    parts += [ball("bone", 180.0, (0.0, 52.0, 46.0), (49.5, 23.5, 53.5))]
    for side in (1.0, -1.0):
        parts += _bent_plate((side * 22.0, 12.0, 52.0), (104.0, 82.0, 88.0), side)
        parts += [rod("bone", 900.0, (side * 84.0, 4.0, -16.0), (side * 10.0, -66.0, -44.0), 9.0, 8.0)]
        parts += [rod("bone", _SPONGY_HU, (side * 84.0, 4.0, -16.0), (side * 10.0, -66.0, -44.0), 6.8, 6.0)]
    hip = (-96.0, 0.0, -24.0)
    parts += [ball("bone", 900.0, hip, (23.0, 23.0, 23.0)), ball("bone", 320.0, hip, (21.0, 21.0, 21.0))]
    for side in (1.0, -1.0):
        neck, knee = (side * 96.0, 0.0, -24.0), (side * 136.0, 6.0, -54.0)
        shaft = (side * 128.0, 8.0, -300.0)
        if side < 0.0:
            parts += [rod("bone", 950.0, neck, knee, 13.0), rod("bone", _SPONGY_HU, neck, knee, 10.5)]
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
        parts.insert(7, dataclasses.replace(core, center=to_point(disc.center), axes=disc.axes))
    for rib in anatomy.ribs:
        chain = [to_point(point) for point in rib.points]
        parts += [rod("bone", 800.0, start, end, 4.0) for start, end in zip(chain[:-1:2], chain[2::2], strict=False)]
    spine = [to_point(v.center) for v in anatomy.vertebrae]
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


def plan_water() -> Plan:
    """Plan a cylinder of water, 200 mm across, in an acrylic shell of 6 mm."""
    wall = column("water", 120.0, (0.0, 0.0), (106.0, 106.0), (-70.0, 70.0))
    return Plan([wall, column("water", 0.0, (0.0, 0.0), (100.0, 100.0), (-64.0, 64.0))], front=-106.0, back=106.0)


def plan_nothing() -> Plan:
    """Plan no body: only the table remains."""
    return Plan([], front=-40.0, back=40.0)


def _tubes(
    chains: Sequence[tuple[Sequence[Point], float]], wall: float, bone_hu: float, marrow_hu: float
) -> list[Part]:
    """Plan closed bones along chains of points with their outer radius: all of bone first, then the marrow in it."""

    def along(material: str, hu: float, inset: float) -> list[Part]:
        return [
            rod(material, hu, a, b, radius - inset)
            for points, radius in chains
            if radius > inset
            for a, b in itertools.pairwise(points)
        ]

    return [*along("bone", bone_hu, 0.0), *along("tissue", marrow_hu, wall)]


def _arch(angle_deg: float, z: float) -> Point:
    """Return a place on the arch of the jaw: 0 is the chin, 90 the patient's left end."""
    angle = math.radians(angle_deg)
    return 26.0 * math.sin(angle), 22.0 - 48.0 * math.cos(angle), z


def plan_jaw() -> Plan:
    """Plan a mandible with nine teeth and an implant in soft tissue, air in the mouth and before the lips."""
    angles = np.linspace(-90.0, 90.0, 15)
    body = [([_arch(float(angle), z) for angle in angles], 6.4) for z in (-7.6, -1.0)]
    parts = [
        column("tissue", 50.0, (0.0, 6.0), (40.0, 42.0)),
        ball("air", AIR_HU, (0.0, 2.0, 10.0), (13.0, 15.0, 7.0)),
        *_tubes(body, 2.2, 1400.0, 60.0),
    ]
    teeth = (-66.0, -50.0, -36.0, -22.0, -8.0, 8.0, 22.0, 52.0, 68.0)
    lost = 37.0
    parts += [rod("bone", 1900.0, _arch(angle, 0.0), _arch(angle, 13.0), 3.0) for angle in teeth]
    parts += [rod("metal", METAL_HU, _arch(lost, -4.0), _arch(lost, 12.0), 2.0)]
    return Plan(parts, front=-36.0, back=48.0)


def plan_long_bone() -> Plan:
    """Plan a shaft of 3.1 mm with a lattice of trabeculae 0.16 mm thick, in saline in a plastic tube."""
    parts = [
        column("table", 120.0, (0.0, 0.0), (1.96, 1.96)),
        column("tissue", 0.0, (0.0, 0.0), (1.84, 1.84)),
        rod("bone", 2600.0, (-0.08, 0.0, -5.0), (0.08, 0.0, 5.0), 1.55),
        rod("tissue", 0.0, (-0.08, 0.0, -5.0), (0.08, 0.0, 5.0), 1.2),
    ]

    def within(x: Field, y: Field, z: Field) -> Field:
        return np.asarray(np.float32(1.35) - np.sqrt(x * x + y * y), dtype=np.float32)

    jitter = np.random.default_rng(20)
    for axis, first, second in itertools.product(range(3), np.arange(-0.9, 1.0, 0.6), np.arange(-0.9, 1.0, 0.6)):
        ends = np.insert(np.add((first, second), jitter.uniform(-0.05, 0.05, (2, 2))), axis, (-1.5, 1.5), axis=1)
        parts.append(cut(rod("bone", 2600.0, to_point(ends[0]), to_point(ends[1]), 0.08), within))
    return Plan(parts, front=-1.96, back=1.96)


def plan_hand() -> Plan:
    """Plan a flat hand: 14 phalanges, 5 metacarpals and 8 wrist bones, 2.5 mm apart and more, in fingers and a palm."""
    bones: list[tuple[Sequence[Point], float]] = []
    flesh: list[Part] = []
    lengths, radii = (42.0, 27.0, 16.0, 11.0), (4.6, 4.4, 4.0, 3.6)
    for base, lean, scale, first in (
        ((27.0, 0.0, -44.0), 0.6, 0.9, 1),
        ((17.0, 0.0, -42.0), 0.12, 0.98, 0),
        ((2.0, -1.0, -42.0), 0.0, 1.02, 0),
        ((-13.0, 0.0, -42.0), -0.1, 0.96, 0),
        ((-28.0, 1.0, -43.0), -0.2, 0.82, 0),
    ):
        direction = np.array((math.sin(lean), 0.0, math.cos(lean)))
        joint = np.array(base)
        for length, radius in list(zip(lengths, radii, strict=True))[first:]:
            start, joint = joint + radius * direction, joint + scale * length * direction
            bones.append(([to_point(start), to_point(joint - radius * direction)], radius))
            joint = joint + 2.8 * direction
        flesh.append(rod("tissue", 60.0, base, to_point(joint), 10.0, 8.0))
    places = [(x, y, z) for (z, y), x in itertools.product(((-51.0, 0.0), (-63.5, 1.0)), (-22.0, -8.0, 6.0, 20.0))]
    wrist = [([(x - 0.7, y, z), (x + 0.7, y, z)], 5.0) for x, y, z in places]
    palm = ball("tissue", 60.0, (-4.0, 0.0, -30.0), (40.0, 13.0, 34.0))
    arm = column("tissue", 60.0, (-2.0, 0.0), (30.0, 13.0), (-1e4, -40.0))
    return Plan([palm, arm, *flesh, *_tubes([*bones, *wrist], 2.2, 1250.0, 60.0)], front=-13.0, back=13.0)


def plan_hip() -> Plan:
    """Plan the left hip of a slim person: a stem in the femur and a head of metal in a socket of bone."""
    head, neck = (-16.0, 0.0, 22.0), (16.0, 4.0, -4.0)
    tip = (14.0, 6.0, -38.0)
    ilium = [(-18.0, 8.0, 44.0), (-26.0, 16.0, 140.0)]
    parts = [
        column("tissue", FAT_HU, (0.0, 2.0), (74.0, 64.0)),
        column("tissue", 60.0, (0.0, 2.0), (66.0, 56.0)),
        *_tubes([(ilium, 15.0), ([head, (-70.0, -24.0, 16.0)], 11.0)], 5.5, 1350.0, 60.0),
        *_tubes([([(17.0, 4.0, -8.0), (13.0, 7.0, -180.0)], 15.5)], 6.0, 1350.0, 60.0),
        ball("bone", 1350.0, head, (26.0, 26.0, 26.0)),
        column("tissue", 60.0, (head[0] + 8.0, 0.0), (22.0, 30.0), (-12.0, 14.0)),
        ball("tissue", 60.0, head, (18.0, 18.0, 18.0)),
        ball("metal", METAL_HU, head, (14.0, 14.0, 14.0)),
        rod("metal", METAL_HU, head, neck, 6.0),
        rod("metal", METAL_HU, neck, tip, 6.5, 5.0),
    ]
    return Plan(parts, front=-62.0, back=66.0)


def plan_mouse() -> Plan:
    """Plan the hind part of a mouse: lumbar spine, pelvis and legs, in a half pipe of plastic."""
    parts = [
        column("table", 110.0, (0.0, 0.0), (12.4, 12.4)),
        column("air", AIR_HU, (0.0, 0.0), (11.6, 11.6)),
        box("air", AIR_HU, (-14.0, -14.0, -1e4), (14.0, -2.0, 1e4)),
        column("tissue", FAT_HU, (0.0, 1.4), (10.2, 10.2)),
        column("tissue", 40.0, (0.0, 1.4), (9.5, 9.5)),
        ball("air", AIR_HU, (1.5, -3.5, 2.0), (1.6, 1.2, 2.2)),
    ]
    legs: list[tuple[Sequence[Point], float]] = []
    for side in (1.0, -1.0):
        hip, knee = (side * 3.6, 3.0, -0.6), (side * 6.6, -2.6, 2.6)
        legs += [([hip, knee], 0.85), ([(side * 6.4, -3.6, 0.6), (side * 4.6, 2.0, -4.0)], 0.7)]
        legs += [([(side * 1.8, 6.2, 3.4), (side * 2.3, 3.6, -0.8), (side * 1.6, 0.0, -4.0)], 0.65)]
        for z in (-2.6, 0.4, 3.4):
            parts.append(rod("bone", 1300.0, (side * 0.6, 8.0, z), (side * 2.4, 8.3, z + 0.5), 0.36))
    parts += [rod("bone", 1300.0, (0.0, 8.0, z - 0.5), (0.0, 8.0, z + 0.5), 0.85) for z in (-5.6, -2.6, 0.4, 3.4)]
    parts += [rod("bone", 1300.0, (0.0, 8.0, z), (0.0, 10.1, z), 0.36) for z in (-2.6, 0.4, 3.4)]
    return Plan([*parts, *_tubes(legs, 0.37, 1300.0, 40.0)], front=-8.8, back=12.4)


PLANS: dict[str, Callable[[], Plan]] = {
    "skull": plan_dry_skull,
    "head": plan_head,
    "bones": plan_bones,
    "limb": plan_limb,
    "pair": plan_pair,
    "pelvis": plan_pelvis,
    "contrast": plan_contrast,
    "water": plan_water,
    "empty": plan_nothing,
    "jaw": plan_jaw,
    "longbone": plan_long_bone,
    "hand": plan_hand,
    "hip": plan_hip,
    "mouse": plan_mouse,
}
"""The planning function of each kind of `clrecon.proof.phantom.settings.KINDS` that is a scene."""


def plan_scene(settings: PhantomSettings) -> list[Part]:
    """Plan all parts of the scene in the order of painting: the table first, then the body that lies on it."""
    plan = PLANS[settings.kind]()
    return [*lay_under(plan, settings.table_used, settings.table_gap_mm, settings.prone), *plan.parts]
