"""Twins of `clrecon.operators.masks`, in plain numpy, and the checks that compare them."""
