"""Twins of `clrecon.operators.primitives`, in plain numpy, and the checks that compare them."""
