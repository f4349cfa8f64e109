"""Check of the field around a cloud: the distances on nodes, and which nodes are inside."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.jobs.selftest.check import Check, require_close, require_equal
from clrecon.opencl import Device, download
from clrecon.operators.points.field import LEAST_SHARE, FieldSettings, Masks, NodeField, decide_signs
from clrecon.reference.points import field as twin

FIELD_MM = 5e-5
"""float32 sums of heights of up to 2 mm, at places up to 150 mm; measured 1e-5."""

ROUNDS = 3
"""Odd: what inverts the signs in each round is not seen after an even number."""

SETTINGS = FieldSettings(0.65, 1.5, 0.1, 1.3)


def _two_balls() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return points on two balls of 14 and 6 mm, and their normals, of which one in twenty points inward."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(7000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = 14.0 * normals
    points[6000:] = 6.0 * normals[6000:] + (0.0, 0.0, 130.0)
    normals[::20] *= -1.0
    return points.astype(np.float32), normals.astype(np.float32)


def _fetch(masks: Masks, mask_d: Any) -> NDArray[np.bool_]:
    """Return a mask of nodes, shape (nz, ny, nx)."""
    nx, ny, nz = masks.shape
    found = download(masks.device, np.empty((nz, ny, 4 * masks.words), np.uint8), mask_d)
    return np.unpackbits(found, axis=2, bitorder="little")[:, :, :nx].astype(bool)


def _check_field(device: Device) -> str:
    points, normals = _two_balls()
    field = NodeField(device, points, normals, SETTINGS)
    nodes, masks, h = field.nodes, field.masks, SETTINGS.spacing
    expected = twin.measure_field(
        points, normals, nodes.corner, h, nodes.shape, reach=SETTINGS.reach, smoothing=SETTINGS.smoothing
    )
    near = np.isfinite(expected.value) & (expected.squared <= np.float32(SETTINGS.bridge) ** 2)
    core = near & (expected.squared <= np.float32(h) ** 2)
    negative = _fetch(masks, masks.negative_d)
    require_equal(_fetch(masks, masks.near_d), near, "near nodes of a field")
    require_equal(_fetch(masks, masks.core_d), core, "core of a field")
    clear = near & (np.abs(np.where(near, expected.value, 0.0)) > FIELD_MM)
    require_equal(negative[clear], expected.value[clear] <= 0.0, "signs of a field")
    require_equal(negative[~near], np.zeros(int((~near).sum()), bool), "signs far from a field")
    signs = decide_signs(masks, field.limits, ROUNDS)
    decided = twin.decide_signs(near, core, negative, ROUNDS)
    require_equal(
        (signs.votes, signs.against, signs.regions, signs.outside_is_inside),
        (decided.votes, decided.against, decided.regions, bool(decided.inside[0, 0, 0])),
        "votes of regions",
    )
    require_equal(_fetch(masks, signs.inside_d), decided.inside, "nodes inside")
    far = float(np.float32(SETTINGS.bridge))
    filled = twin.fill_nodes(expected, near, decided, far, LEAST_SHARE * h)
    apart = require_close(field.fill(signs), filled, FIELD_MM, "the field on nodes")
    return f"{field.bricks} bricks of nodes within {apart:.1g} mm, signs of {nodes.count:,} nodes equal"


CHECKS = (
    Check(
        "field around points",
        (
            "merge_rows", "mark_reached", "sort_normals", "measure_nodes", "fill_far", "place_bricks",
            "count_runs", "list_runs", "count_joins", "list_joins", "count_votes", "paint_regions", "flood_signs",
        ),
        _check_field,
    ),
)  # fmt: skip
