"""Readers of mesh files: binary and text STL, PLY of any program."""
