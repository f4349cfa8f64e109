"""Parsing: the bytes of a file become elements and their values."""
