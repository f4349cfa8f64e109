"""Pixels: the stored values of slices become voxels in HU."""
