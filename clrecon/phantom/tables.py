"""Tables that bodies lie on: plates and a head rest, made of thin dense shells around foam.

Each table is planned for a body that ends at y = 0, y downwards; `lay_under` moves it under the back, or under the
front of a prone patient.  HU and thickness are round figures of carbon fibre (100 to 400 HU, 1.5 to 4 mm) around foam
(-930 HU).  The flat table has metal rails, as some real tables have.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from clrecon.phantom.fields import Field
from clrecon.phantom.scenes import Part, Plan

ENDLESS = 1e4
FOAM_HU = -930.0
Distance = Callable[[Field, Field, Field], Field]


def _sandwich(outline: Distance, thickness: float, hu: float, half_width: float, height: float) -> list[Part]:
    """Make a shell `thickness` mm thick around foam, endless along z, from `height` above 0 to 60 mm below."""
    low, high = (-half_width, -height, -ENDLESS), (half_width, 60.0, ENDLESS)
    return [
        Part("table", hu, outline, low, high),
        Part("table", FOAM_HU, lambda x, y, z: outline(x, y, z) - np.float32(thickness), low, high),
    ]


def _flat(plan: Plan) -> list[Part]:
    """Make a plate 24 mm thick and 420 mm wide, with a metal rail along either edge."""

    def outline(x: Field, y: Field, z: Field) -> Field:
        return np.minimum(np.minimum(y, 24.0 - y), np.float32(210.0) - np.abs(x))

    def rail(x: Field, y: Field, z: Field) -> Field:
        return np.minimum(4.0 - np.abs(np.abs(x) - np.float32(200.0)), 4.0 - np.abs(y - 34.0))

    rails = Part("table", 1800.0, rail, (-205.0, 29.0, -ENDLESS), (205.0, 39.0, ENDLESS))
    return [*_sandwich(outline, 3.0, 250.0, 210.0, 0.0), rails]


def _curved(plan: Plan) -> list[Part]:
    """Make a trough 18 mm thick: an arc of 260 mm radius, 400 mm wide."""

    def outline(x: Field, y: Field, z: Field) -> Field:
        radius = np.sqrt(x * x + (y + np.float32(260.0)) ** 2) - np.float32(260.0)
        return np.minimum(np.minimum(radius, 18.0 - radius), np.float32(200.0) - np.abs(x))

    return _sandwich(outline, 2.5, 350.0, 200.0, 100.0)


def _head_rest(plan: Plan) -> list[Part]:
    """Make a bowl of 4 mm close around the head on a foam cushion, and a bar along z that carries it."""
    x0, z0 = plan.rest
    high = np.float32(95.0)  # radius of the bowl

    def bowl(x: Field, y: Field, z: Field) -> Field:
        across = np.sqrt((x - np.float32(x0)) ** 2 + (y + np.float32(84.0)) ** 2)
        along = np.clip(np.abs(z - np.float32(z0)) - np.float32(70.0), 0.0, None)
        radius = np.sqrt(across * across + along * along) - high
        return np.minimum(np.minimum(radius, 4.0 - radius), y + np.float32(60.0))

    def cushion(x: Field, y: Field, z: Field) -> Field:
        across = np.sqrt((x - np.float32(x0)) ** 2 + (y + np.float32(84.0)) ** 2)
        length = np.float32(70.0) - np.abs(z - np.float32(z0))
        return np.minimum(np.minimum(high - across, y + np.float32(40.0)), length)

    def bar(x: Field, y: Field, z: Field) -> Field:
        return np.minimum(30.0 - np.abs(x - np.float32(x0)), np.minimum(y - 14.0, 24.0 - y))

    low, top = (x0 - 105.0, -62.0, -ENDLESS), (x0 + 105.0, 30.0, ENDLESS)
    return [
        Part("table", FOAM_HU, cushion, low, top),
        Part("table", 220.0, bowl, low, top),
        Part("table", 220.0, bar, low, top),
        Part("table", FOAM_HU, lambda x, y, z: bar(x, y, z) - np.float32(2.0), low, top),
    ]


TABLES: dict[str, Callable[[Plan], list[Part]]] = {
    "none": lambda plan: [],
    "flat": _flat,
    "curved": _curved,
    "headrest": _head_rest,
}


def lay_under(plan: Plan, table: str, gap_mm: float, prone: bool) -> list[Part]:
    """Make the parts of a table `gap_mm` under a body: under its back, or under its front when it lies prone.

    plan: Plan of the body.
    table: One of `TABLES`.
    gap_mm: Gap between body and table: at 0 they touch, below 0 the body sinks in.
    """
    down = -1.0 if prone else 1.0
    center = (0.0, plan.front - gap_mm if prone else plan.back + gap_mm, 0.0)
    axes = np.diag((1.0, down, 1.0))
    return [dataclasses.replace(part, center=center, axes=axes) for part in TABLES[table](plan)]
