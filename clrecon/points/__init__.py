"""Clouds of points: `PointCloud`, its steps, and which clusters are kept; names are loaded when first used."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clrecon.points.cloud import PointCloud, PointStep
    from clrecon.points.ghost_slices import drop_ghost_slices, fill_ghost_slices
    from clrecon.points.keep import keep_clusters


__all__ = ["PointCloud", "PointStep", "drop_ghost_slices", "fill_ghost_slices", "keep_clusters"]

POINT_KINDS = ("surface", "cortex", "shell", "voxels")
SURFACE_KINDS = POINT_KINDS[:2]
"""See `clrecon.extract_points`."""

_MODULES = {
    "cloud": ("PointCloud", "PointStep"),
    "ghost_slices": ("drop_ghost_slices", "fill_ghost_slices"),
    "keep": ("keep_clusters",),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f"clrecon.points.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
