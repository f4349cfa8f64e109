"""Twins of `clrecon.operators.filters`, in plain numpy, and the checks that compare them."""
