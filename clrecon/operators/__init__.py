"""Operators: computations on a device, called as ``operator(device, inputs..., parameters...)``. Inputs are never
modified.
"""
