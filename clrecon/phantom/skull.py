"""Plans of a head: a dry skull (a specimen with air inside and outside), and the same skull with soft tissue."""

from __future__ import annotations

import dataclasses

import numpy as np

from clrecon.phantom.fields import Field, ellipsoid
from clrecon.phantom.scenes import AIR_HU, Part, Plan
from clrecon.phantom.solids import ball, column, cut, rod

COMPACT_HU = 1350.0
DIPLOE_HU = 620.0
PETROUS_HU = 1900.0
TOOTH_HU = 2600.0
VAULT = (71.0, 90.0, 68.0)
"""Half axes of the vault, mm."""
VAULT_Z = 10.0
FLOOR_Z = -42.0
"""z of the base of the skull, mm, relative to the middle of the vault."""


def _wall(x: Field, y: Field, z: Field) -> Field:
    """Return the thickness of the vault: 3 mm at the temples, 8 mm at forehead and occiput."""
    return np.float32(3.0) + np.float32(5.0) * np.clip(np.abs(y) / np.float32(VAULT[1]), 0.0, 1.0)


def _above_floor(x: Field, y: Field, z: Field) -> Field:
    return np.asarray(z - np.float32(FLOOR_Z), dtype=np.float32)


def _depth_in_vault(x: Field, y: Field, z: Field) -> Field:
    """Return the distance to the inner surface of the vault, positive within it."""
    return np.asarray(ellipsoid(x, y, z, VAULT) - _wall(x, y, z), dtype=np.float32)


def _depth_in_diploe(x: Field, y: Field, z: Field) -> Field:
    """Return a distance positive in the diploe, which lies between two tables of 1.2 mm where the wall is thick."""
    outer = ellipsoid(x, y, z, VAULT)
    wall = _wall(x, y, z)
    between = np.minimum(outer - np.float32(1.2), wall - np.float32(1.2) - outer)
    return np.minimum(between, wall - np.float32(3.5))


def _vault(material: str, hu: float) -> list[Part]:
    """Plan the vault: compact bone, the diploe between its two tables, and the contents."""
    whole = ball("bone", COMPACT_HU, (0.0, 0.0, VAULT_Z), VAULT)
    layers = (
        whole,
        dataclasses.replace(cut(whole, _depth_in_diploe), hu=DIPLOE_HU),
        dataclasses.replace(cut(whole, _depth_in_vault), material=material, hu=hu),
    )
    return [cut(layer, _above_floor) for layer in layers]


def _base() -> list[Part]:
    """Plan the floor of the skull with the foramen magnum, and the two petrous pyramids."""
    level = VAULT_Z + FLOOR_Z
    plate = column("bone", COMPACT_HU, (0.0, 4.0), (52.0, 66.0), (level - 5.0, level + 2.0))
    hole = column("bone", COMPACT_HU, (0.0, 36.0), (15.0, 17.0), (level - 9.0, level + 9.0)).distance
    plate = cut(plate, lambda x, y, z: -hole(x, y - np.float32(32.0), z))
    pyramids = [
        rod("bone", PETROUS_HU, (side * 12.0, 4.0, level + 1.0), (side * 56.0, 26.0, level + 2.0), 7.0, 10.0)
        for side in (1.0, -1.0)
    ]
    return [plate, *pyramids]


def _face(inside_material: str, inside_hu: float) -> list[Part]:
    """Plan orbits, maxilla with its sinuses, cheek bones, teeth and a mandible that touches no other bone."""
    level = VAULT_Z + FLOOR_Z
    parts: list[Part] = []
    for side in (1.0, -1.0):
        orbit = (side * 32.0, -66.0, level + 12.0)
        parts += [
            ball("bone", COMPACT_HU, orbit, (21.0, 24.0, 20.0)),
            ball(inside_material, inside_hu, (orbit[0], orbit[1] - 4.0, orbit[2]), (19.0, 24.0, 18.0)),
            ball("bone", COMPACT_HU, (side * 24.0, -60.0, level - 22.0), (19.0, 20.0, 20.0)),
            ball("air", AIR_HU, (side * 24.0, -60.0, level - 22.0), (17.2, 18.2, 18.2)),
            rod("bone", COMPACT_HU, (side * 44.0, -70.0, level - 10.0), (side * 62.0, -38.0, level - 8.0), 4.5, 2.5),
            rod("bone", COMPACT_HU, (side * 62.0, -38.0, level - 8.0), (side * 60.0, -2.0, level - 2.0), 2.5, 3.0),
        ]
        corner = (side * 46.0, -14.0, level - 60.0)
        parts += [
            rod("bone", COMPACT_HU, (side * 52.0, -6.0, level - 12.0), corner, 4.5, 5.5),
            rod("bone", COMPACT_HU, corner, (side * 10.0, -76.0, level - 66.0), 5.5, 7.0),
        ]
        for angle in np.radians(np.linspace(8.0, 80.0, 6)):
            x, y = side * 26.0 * np.sin(angle), -52.0 - 28.0 * np.cos(angle)
            parts.append(rod("bone", TOOTH_HU, (x, y, level - 50.0), (x, y, level - 40.0), 2.8))
    parts.append(rod("bone", COMPACT_HU, (-10.0, -76.0, level - 66.0), (10.0, -76.0, level - 66.0), 7.0))
    return parts


def plan_dry_skull() -> Plan:
    """Plan a macerated skull: a thin dense vault with base and face, air inside and outside, no soft tissue."""
    parts = [*_vault("air", AIR_HU), *_base(), *_face("air", AIR_HU)]
    return Plan(parts, front=-92.0, back=VAULT[1], rest=(0.0, VAULT_Z))


def plan_head() -> Plan:
    """Plan the same skull in soft tissue: scalp, face, brain, eyes, neck, and air in sinuses, nose and throat."""
    level = VAULT_Z + FLOOR_Z
    skin = tuple(half + 7.0 for half in VAULT)
    soft = [
        column("tissue", 45.0, (0.0, 22.0), (56.0, 58.0), (-1e4, level)),
        ball("tissue", 30.0, (0.0, 0.0, VAULT_Z), (skin[0], skin[1], skin[2])),
        ball("tissue", 10.0, (0.0, -38.0, level - 20.0), (66.0, 62.0, 66.0)),
        rod("tissue", 20.0, (0.0, -96.0, level - 2.0), (0.0, -104.0, level - 18.0), 7.0, 11.0),
    ]
    eyes = [ball("tissue", 12.0, (side * 32.0, -78.0, level + 12.0), (12.0, 12.0, 12.0)) for side in (1, -1)]
    airway = [
        rod("air", AIR_HU, (0.0, -84.0, level - 16.0), (0.0, -30.0, level - 16.0), 6.0),
        rod("air", AIR_HU, (0.0, -30.0, level - 16.0), (0.0, -16.0, level - 90.0), 8.0),
    ]
    parts = [*soft, *_vault("tissue", 36.0), *_base(), *_face("tissue", -80.0), *eyes, *airway]
    return Plan(parts, front=-115.0, back=skin[1], rest=(0.0, VAULT_Z))
