"""Twins of `clrecon.operators.primitives`."""
