"""Operators: computations on a device, called as ``operator(device, inputs..., parameters...)``. Inputs are never
modified.
"""

from clrecon.opencl import Device
from clrecon.opencl.first_use import register


def _check_device(device: Device) -> str:
    from clrecon.operators.first_use import check_ball

    return check_ball(device)


register(_check_device)
