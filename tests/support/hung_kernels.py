"""Kernels that take far too long, in commands of a child process; each ends by itself after some time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]

_CHILD = '''
import sys
from clrecon.opencl.program import Kernel
from clrecon.opencl.quirks import import_pyopencl

SOURCE = """
__kernel void spin(__global uint *numbers, const uint turns)
{
    uint number = numbers[get_global_id(0)];
    for (uint turn = 0; turn < turns; turn++) {
        number = number * 1664525u + 1013904223u;
        number ^= number >> 7;
    }
    numbers[get_global_id(0)] = number;
}
"""
TURNS, WANTED = int(sys.argv.pop(1)), sys.argv.pop(1)
true_enqueue = Kernel.enqueue
kept = []

def enqueue(kernel, queue, items, group, values, first):
    if kernel.name == WANTED and not kept:
        cl = import_pyopencl()
        spin = cl.Program(queue.context, SOURCE).build().spin
        numbers = cl.Buffer(queue.context, cl.mem_flags.READ_WRITE, 4 * group)
        kept.append((spin, numbers))
        import numpy
        spin(queue, (group,), (group,), numbers, numpy.uint32(TURNS))
        queue.flush()
        print("the kernel spins", file=sys.stderr, flush=True)
    return true_enqueue(kernel, queue, items, group, values, first)

Kernel.enqueue = enqueue
from clrecon.cli.main import run
run()
'''

TURNS = 240_000_000
"""About 36 s for a group of 64 work-items on one core of 2020: a test that fails ends too."""


def start_command(kernel: str, *arguments: str | Path, turns: int = TURNS) -> subprocess.Popen[str]:
    """Start a command in which something spins before the first launch of `kernel`, and says so on stderr."""
    return subprocess.Popen(
        [sys.executable, "-c", _CHILD, str(turns), kernel, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(ROOT), "CLRECON_DEVICE_CHECK": "off"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
