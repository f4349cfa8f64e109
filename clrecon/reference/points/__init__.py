"""Twins of `clrecon.operators.points`."""
