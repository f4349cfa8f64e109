"""A scan to meshes in files."""
