"""Twins of `clrecon.operators.resident`, in plain numpy, and the checks that compare them."""
