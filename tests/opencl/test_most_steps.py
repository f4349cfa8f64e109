"""After how many steps the loops of a work-item end: what `Device.most_steps` says is so."""

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


def count_steps(device, steps):
    """Return how often a work-item of count_steps goes round, for odd and even steps together."""
    cl = import_pyopencl()
    counts_d = allocate(device, 8)
    cl.enqueue_copy(device.queue, raw(counts_d), np.array([0, 0], np.uint32))
    kernel = cl.Program(device.context, SOURCE).build().count_steps
    kernel(device.queue, (1,), (1,), raw(counts_d), np.uint32(steps))
    return 2 * int(download(device, np.empty(2, np.uint32), counts_d)[1])


@pytest.mark.every_device
def test_loops_end_where_the_device_says(device):
    assert count_steps(device, 20_000) == 20_000
    assert (count_steps(device, 200_000) == 200_000) == (device.most_steps is None)
