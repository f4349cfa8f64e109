"""Twins of `clrecon.operators.points`, in plain numpy, and the checks that compare them."""
