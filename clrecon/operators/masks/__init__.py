"""Masks of voxels on a device, one bit a voxel."""
