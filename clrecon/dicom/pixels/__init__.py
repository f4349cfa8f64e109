"""Stored pixels of slices to voxels in HU."""
