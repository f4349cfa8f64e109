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


def test_no_kernel_calls_a_function_that_drivers_round_in_their_own_way():
    files = [file for folder in kernel_root().iterdir() if folder.is_dir() for file in folder.iterdir()]
    sources = {file: file.read_text() for file in files if file.name.endswith((".cl", ".h"))}
    codes = {file: re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL) for file, text in sources.items()}
    assert len(codes) > len(kernel_files())  # headers too
    assert [f"{file}: {FREE.findall(code)}" for file, code in codes.items() if FREE.search(code)] == []


@pytest.mark.parametrize("name", kernel_files())
def test_pragma_against_contraction_comes_first_and_once_in_every_kernel_file(name):
    before_pragma, *rest = read_kernel_source(name).split("#pragma OPENCL FP_CONTRACT OFF")
    assert len(rest) == 1
    assert "__kernel" not in before_pragma
    assert "FP_CONTRACT" not in before_pragma + rest[0]


FLOATS_OF_DEVICE = """
__kernel void calculate(__global float4 *n)
{
    n[0].w = n[0].x * n[0].y + n[0].z;
    n[1].w = n[1].x / n[1].y;
    n[2].w = sqrt(n[2].x);
    n[3].w = dot3(n[3].xyz, n[3].xyz);
}
"""


@pytest.mark.every_device
def test_sums_of_products_quotients_and_roots_are_rounded_as_numpy_rounds_them(device):
    cl = import_pyopencl()
    a = np.float32(1.0 + 2.0**-12)  # its square needs more than the 24 bits of float32: a fused a * a - 1 keeps them
    x, y, z = np.array([0.1, 0.7, 1.3], np.float32)
    numbers = np.array([(a, a, -1.0, 0.0), (1.0, 3.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (x, y, z, 0.0)], np.float32)

    source = read_kernel_source("primitives/scan.cl") + FLOATS_OF_DEVICE
    variants = [f"-D{name}={value}" for name, value in device.kernel_variants.items()]
    program = cl.Program(device.context, source).build(["-cl-std=CL1.2", *device.build_options, *variants])
    numbers_d = cl.Buffer(device.context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=numbers)
    program.calculate(device.queue, (1,), None, numbers_d)
    cl.enqueue_copy(device.queue, numbers, numbers_d)

    one, two, three = np.float32([1.0, 2.0, 3.0])
    assert numbers[:, 3].tolist() == [a * a - one, one / three, np.sqrt(two), x * x + y * y + z * z]


@pytest.mark.parametrize("is_available", [True, False])
def test_exact_quotients_and_roots_are_asked_of_drivers_that_have_them(is_available):
    bits = import_pyopencl().device_fp_config
    config = bits.FMA | (bits.CORRECTLY_ROUNDED_DIVIDE_SQRT if is_available else 0)
    options = rounding_options(SimpleNamespace(single_fp_config=config))
    assert options == (("-cl-fp32-correctly-rounded-divide-sqrt",) if is_available else ())
