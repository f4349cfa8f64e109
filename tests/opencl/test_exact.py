"""The same bits on all devices: what stands before every kernel file, and how quotients and roots are asked for."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest

from clrecon.opencl import kernel_files, read_kernel_source
from clrecon.opencl.quirks import import_pyopencl, rounding_options
from clrecon.opencl.sources import kernel_root

FREE = re.compile(r"\b(dot|cross|length|distance|normalize|mix|mad|rsqrt|native_\w+|half_\w+)\(")
"""Functions that OpenCL lets each driver round in its own way."""


def test_no_kernel_uses_what_drivers_round_in_their_own_way():
    found = []
    for theme in kernel_root().iterdir():
        for file in theme.iterdir() if theme.is_dir() else ():
            if file.name.endswith((".cl", ".h")):
                code = re.sub(r"/\*.*?\*/|//[^\n]*", "", file.read_text(), flags=re.DOTALL)
                found += [f"{theme.name}/{file.name}: {name}" for name in FREE.findall(code)]
    assert found == []


def test_contraction_is_forbidden_once_and_before_every_kernel_file():
    marks = [read_kernel_source(name).count("FP_CONTRACT") for name in kernel_files()]
    assert set(marks) == {1}
    assert all(read_kernel_source(name).index("FP_CONTRACT OFF") < 1000 for name in kernel_files())


@pytest.mark.every_device
def test_a_product_and_a_sum_are_rounded_each(device):
    cl = import_pyopencl()
    source = read_kernel_source("primitives/scan.cl") + (
        "__kernel void try_it(__global float4 *n) { n[0].w = n[0].x * n[0].y + n[0].z; n[1].w = n[1].x / n[1].y;"
        " n[2].w = sqrt(n[2].x); n[3].w = dot3(n[3].xyz, n[3].xyz); }"
    )
    rows = np.zeros((4, 4), np.float32)
    rows[0, :3] = 1.0 + 2.0**-12, 1.0 + 2.0**-12, -1.0
    rows[1, :2], rows[2, 0], rows[3, :3] = (1.0, 3.0), 2.0, (0.1, 0.7, 1.3)
    options = ["-cl-std=CL1.2", *device.build_options, *(f"-D{k}={v}" for k, v in device.kernel_variants.items())]
    program = cl.Program(device.context, source).build(options)
    rows_d = cl.Buffer(device.context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=rows)
    program.try_it(device.queue, (1,), None, rows_d)
    cl.enqueue_copy(device.queue, rows, rows_d)
    squares = rows[3, :3] * rows[3, :3]
    expected = [
        rows[0, 0] * rows[0, 1] + rows[0, 2],
        np.float32(1.0) / np.float32(3.0),
        np.sqrt(np.float32(2.0)),
        squares[0] + squares[1] + squares[2],
    ]
    assert rows[:, 3].tolist() == [float(number) for number in expected]


def test_the_option_is_asked_of_drivers_that_have_it():
    bits = import_pyopencl().device_fp_config
    exact = SimpleNamespace(single_fp_config=bits.FMA | bits.CORRECTLY_ROUNDED_DIVIDE_SQRT)
    assert rounding_options(exact) == ("-cl-fp32-correctly-rounded-divide-sqrt",)
    assert rounding_options(SimpleNamespace(single_fp_config=bits.FMA)) == ()
