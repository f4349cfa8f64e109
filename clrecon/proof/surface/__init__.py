"""Twins of `clrecon.operators.surface`, in plain numpy, and the checks that compare them."""
