"""Twins of `clrecon.operators.masks`."""
