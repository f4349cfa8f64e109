"""Twins of `clrecon.operators.reformat`, in plain numpy, and the checks that compare them."""
