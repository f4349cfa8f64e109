"""Twins of `clrecon.operators.rays`, in plain numpy, and the checks that compare them."""
