"""Twins of the operators on whole volumes (primitives, bricks, masks, filters, slices), and their checks."""
