"""A scan to pictures in files."""
