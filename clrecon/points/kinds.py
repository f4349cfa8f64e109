"""The kinds of points that a volume gives."""

from __future__ import annotations

KINDS = ("surface", "shell", "voxels")
"""See `clrecon.extract_points`."""
