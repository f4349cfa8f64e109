"""Bytes of a file to elements and their values."""
