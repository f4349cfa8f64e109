"""Twins of `clrecon.operators.reformat`."""
