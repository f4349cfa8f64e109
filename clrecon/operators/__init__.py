"""Operators: computations on a device, called as ``operator(device, inputs..., parameters...)``. Inputs are never
modified.
"""

from clrecon.opencl import Device, choose_device, take_device
from clrecon.opencl.select import register

__all__ = ["choose_device", "take_device"]  # from here on they check a device at its first use


def _check_device(device: Device) -> str:
    from clrecon.operators.first_use import check_ball

    return check_ball(device)


register(_check_device, "-m", "clrecon.operators.first_use")
