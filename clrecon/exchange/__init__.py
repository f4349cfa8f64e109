"""Mesh files: writers, one module for each format, chosen by the extension of the file."""
