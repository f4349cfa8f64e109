"""Clouds of points: `PointCloud`, its steps, and which clusters are kept; here is what help texts need."""

POINT_KINDS = ("surface", "cortex", "shell", "voxels")
SURFACE_KINDS = POINT_KINDS[:2]
"""See `clrecon.extract_points`."""
