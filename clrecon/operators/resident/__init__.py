"""What of a volume stays on a device: voxels, slabs, bricks, tables of slices."""
