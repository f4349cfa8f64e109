"""The functions of cl/include/inlined.h give the same bits as the driver's; PoCL 3.0 alone gets them."""

from __future__ import annotations

import itertools
import re
from typing import Any

import numpy as np
import pytest

from clrecon.errors import DeviceError
from clrecon.opencl import allocate, download, load_program, program, quirks, read_kernel_source, upload
from clrecon.opencl.quirks import import_pyopencl

HEADER = "include/inlined.h"

FLOATS = np.array(
    [0.0, -0.0, 1.0, -1.0, 0.5, -0.3, 1.7, -2.5, 3e9, -8388609.5, 1e-40, 3e38, np.inf, -np.inf, np.nan], np.float32
)
TYPES: dict[str, Any] = {
    "char": np.int8, "uchar": np.uint8, "short": np.int16, "ushort": np.uint16, "int": np.int32, "uint": np.uint32,
    "long": np.int64, "ulong": np.uint64,
}  # fmt: skip
VALUES = {
    "float": FLOATS,
    **{
        name: np.array([info.min, info.min + 1, info.max, info.max // 3, 0, 1, 7], dtype)
        for name, dtype in TYPES.items()
        for info in (np.iinfo(dtype),)
    },
}

OF_THREE = """
__kernel void of_{vector}(
    __global const {type} *a, __global const {type} *b, __global const {type} *c, __global {type} *out)
{{
    const size_t at = get_global_id(0);
    const {vector} p = {load}(at, a), q = {load}(at, b), r = {load}(at, c);
    {stores}
}}
"""
ONE_BY_ONE = "#define LOAD(at, from) ((from)[at])\n#define STORE(number, at, to) ((to)[at] = (number))\n"
ORDER = ["min(p, q)", "max(p, q)", "clamp(p, min(q, r), max(q, r))"]
NUMBERS = ["fmin(p, q)", "fmax(p, q)", "fabs(p)", "sqrt(p)", "floor(p)", "ceil(p)", "fma(p, q, r)"]
CASES: dict[str, tuple[str, int, list[str]]] = {
    **{of: (of, 0, ORDER) for of in ("char", "uchar", "short", "ushort", "long")},
    **{of: (of, 0, [*ORDER, "popcount(p)", "popcount(q ^ r)"]) for of in ("int", "uint", "ulong")},
    "short3": ("short", 3, ORDER),
    "uchar16": ("uchar", 16, ORDER),
    "int8": ("int", 8, [*ORDER, "convert_int8(convert_short8(p))"]),
    "float": ("float", 0, [*ORDER, *NUMBERS, "isnan(p) ? 1.0f : isnan(q) ? 2.0f : 3.0f"]),
    "float2": ("float", 2, [*ORDER, *NUMBERS]),
    "float3": ("float", 3, [*ORDER, *NUMBERS]),
    "float4": ("float", 4, [*ORDER, *NUMBERS]),
    "float8": ("float", 8, [*ORDER, *NUMBERS, "convert_float8(convert_int8(choose_small(p, q)))"]),
}
SMALL = """
static inline float8 choose_small(const float8 p, const float8 q)
{
    return fabs(p) < 1e6f ? p : fabs(q) < 1e6f ? q : (float8)(0.75f);
}
"""


def all_kernels() -> str:
    """A kernel for each of `CASES`, that stores some results of three numbers, or of three vectors of them."""
    parts = [ONE_BY_ONE, SMALL]
    for vector, (of, width, results) in CASES.items():
        load, store = (f"vload{width}", f"vstore{width}") if width else ("LOAD", "STORE")
        stores = "\n    ".join(
            f"{store}({result}, at * {len(results)} + {n}, out);" for n, result in enumerate(results)
        )
        parts.append(OF_THREE.format(vector=vector, type=of, load=load, stores=stores))
    return "".join(parts)


def compute_case(device, built, vector: str) -> np.ndarray:
    """The results of one of `CASES` for all triples of its values."""
    of, width, results = CASES[vector]
    values, width = VALUES[of], width or 1
    triples = np.array(list(itertools.product(values, repeat=3)), values.dtype).T
    n = triples.shape[1] // width
    out_d = allocate(device, n * width * len(results) * values.itemsize)
    inputs = (upload(device, np.ascontiguousarray(part[: n * width])) for part in triples)
    getattr(built, f"of_{vector}")(device.queue, (n,), (1,), *inputs, out_d)
    return download(device, np.empty(n * width * len(results), values.dtype), out_d)


@pytest.fixture
def of_pocl(device):
    """A device of PoCL, of any version: its compiler is clang."""
    if not quirks.is_pocl(device.platform):
        pytest.skip("the header is for PoCL alone")
    return device


@pytest.mark.seconds
@pytest.mark.every_device
def test_inlined_functions_give_the_bits_of_those_of_pocl(of_pocl):
    theirs, ours = (
        import_pyopencl().Program(of_pocl.context, text + all_kernels()).build(["-cl-std=CL1.2"])
        for text in ("", read_kernel_source(HEADER))
    )
    for vector in CASES:
        expected = compute_case(of_pocl, theirs, vector)
        found = compute_case(of_pocl, ours, vector)
        is_number = ~np.isnan(expected)
        assert np.array_equal(~np.isnan(found), is_number), vector
        assert found[is_number].tobytes() == expected[is_number].tobytes(), vector
        # measured 5 unlike results of uchar, the fewest, and 210 of floats
        assert len(np.unique(expected)) > 3, f"{vector}: the kernel has written next to nothing"


@pytest.mark.parametrize(
    ("platform", "version", "header"),
    [
        ("Portable Computing Language", (3, 0, 2), HEADER),
        ("Portable Computing Language", (3, 1), ""),
        ("Portable Computing Language", (6, 0), ""),
        ("rusticl", (3, 0), ""),
    ],
)
def test_pocl_3_0_alone_gets_the_header_of_inlined_functions(platform, version, header):
    assert quirks.first_header(platform, version) == header


@pytest.mark.every_device
def test_header_of_inlined_functions_precedes_the_kernels_on_devices_that_need_it(device, monkeypatch):
    built_sources = []
    monkeypatch.setattr(program, "_build_from_source", lambda device, source, options: built_sources.append(source))
    monkeypatch.setattr(device, "programs", {})
    monkeypatch.setattr(device, "keeps_binaries", False)
    with pytest.raises((DeviceError, AttributeError)):  # nothing is built
        load_program(device, "primitives/compact.cl")

    [source] = built_sources
    kernels = read_kernel_source("primitives/compact.cl")
    assert source.endswith(kernels)
    assert (HEADER in source.removesuffix(kernels)) == bool(device.first_header)


def test_header_of_inlined_functions_defines_each_function_that_it_undefines():
    text = read_kernel_source(HEADER)
    undefined = set(re.findall(r"(?m)^#undef (\w+)$", text))
    defined = set(re.findall(r"(?m)^#define (\w+)\(", text))
    assert {"fmin", "sqrt", "popcount"} < undefined
    assert undefined <= defined
