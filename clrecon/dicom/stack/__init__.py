"""Headers of slices to a stack with an affine."""
