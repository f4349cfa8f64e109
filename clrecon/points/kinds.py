"""The kinds of points that a volume gives."""

from __future__ import annotations

__all__ = ["KINDS"]

KINDS = ("surface", "shell", "voxels")
"""See `clrecon.extract_points`."""
