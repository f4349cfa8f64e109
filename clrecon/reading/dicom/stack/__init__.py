"""Stacks: the headers of slices become a stack with an affine."""
