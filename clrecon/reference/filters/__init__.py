"""Twins of `clrecon.operators.filters`."""
