"""Resident data of a volume on a device: voxels, slabs, bricks, tables of slices."""
