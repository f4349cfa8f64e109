"""Operators: computations on a device, called as ``operator(device, inputs..., parameters...)``. Inputs are never
modified.

What parameters mean wherever nothing else is said:

voxels, mask_d: (nk, nj, ni); of bits (nk, nj, words), uint32, bit b of word w being voxel i = 32 w + b.
points, triangles: (n, 3), LPS mm; (m, 3), uint32, indices of vertices.
shape_ijk, size: (ni, nj, nk); (width, height).
memory: Bytes that may be taken on the device; None is all of its memory.
background: A colour; None: transparent.
progress: Called as ``progress(stage, done, all)``.
warnings: Gets a line each time that the device had no room for what was planned.
"""

from clrecon.opencl import Device, choose_device, take_device
from clrecon.opencl.select import register

__all__ = ["choose_device", "take_device"]  # from here on they check a device at its first use


def _check_device(device: Device) -> str:
    from clrecon.operators.first_use import check_ball

    return check_ball(device)


register(_check_device, "-m", "clrecon.operators.first_use")
