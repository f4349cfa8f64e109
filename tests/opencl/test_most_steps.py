"""After how many steps a driver ends the loops of a work-item: `Device.most_steps` knows it."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.opencl import allocate, download
from clrecon.opencl.buffers import raw
from clrecon.opencl.quirks import import_pyopencl

SOURCE = """
__kernel void count_steps(__global uint *restrict counts, const uint steps)
{
    uint count = 0;
    for (uint step = 0; step < steps; ++step)
        count += counts[0] + (step & 1u);
    counts[1 + get_global_id(0)] = count;
}
"""


def run_loop(device, steps):
    """Return how many steps of a loop of `steps`, an even number, a work-item makes."""
    cl = import_pyopencl()
    counts_d = allocate(device, 8)
    cl.enqueue_copy(device.queue, raw(counts_d), np.array([0, 0], np.uint32))
    kernel = cl.Program(device.context, SOURCE).build().count_steps
    kernel(device.queue, (1,), (1,), raw(counts_d), np.uint32(steps))
    _, odd_steps = download(device, np.empty(2, np.uint32), counts_d).tolist()
    return 2 * odd_steps


@pytest.mark.every_device
def test_loop_of_20000_steps_is_run_to_its_end_on_every_device(device):
    assert run_loop(device, 20_000) == 20_000  # llvmpipe, the only one with most steps, makes 65,535


@pytest.mark.every_device
def test_loop_of_200000_steps_is_cut_short_only_on_devices_that_have_most_steps(device):
    is_run_to_its_end = run_loop(device, 200_000) == 200_000
    assert is_run_to_its_end == (device.most_steps is None)
