"""Twins of `clrecon.operators.rays`."""
