"""Checks of what is asked of triangle meshes: which triangles cut each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.jobs.selftest.check import Check, require_equal
from clrecon.opencl import Device
from clrecon.operators.surface.decimation import mark_crossings, plan_crossings
from clrecon.reference.surface import crossings as twin


def _scatter(count: int, seed: int) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return triangles of three sizes at random, in pairs at one place, of which every other one shares a vertex."""
    random = np.random.default_rng(seed)
    size = random.choice([0.4, 1.0, 5.0], (count, 1, 1), p=[0.6, 0.35, 0.05])
    places = np.repeat(random.uniform(-20.0, 20.0, (count // 2, 1, 3)), 2, axis=0)
    corners = places + size * random.normal(size=(count, 3, 3))
    triangles = np.arange(3 * count, dtype=np.uint32).reshape(-1, 3)
    triangles[::4, 2] = triangles[1::4, 0]
    return corners.reshape(-1, 3).astype(np.float32), triangles


def _check_crossings(device: Device) -> str:
    """Compare the marks of triangles that cut each other; none of these is so flat that float32 cannot tell."""
    vertices, triangles = _scatter(1600, 3)
    found = mark_crossings(device, plan_crossings(vertices, triangles))
    require_equal(found, twin.mark_crossings(vertices, triangles), "triangles that cut each other")
    return f"{int(found.sum()):,} of {len(found):,} triangles that cut another one"


CHECKS = (Check("triangles that cut each other", ("mark_crossings", "clear_words"), _check_crossings),)
