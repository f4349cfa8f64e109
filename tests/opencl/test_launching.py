"""Kernels are launched with their arguments by name; the names come from the source."""

from __future__ import annotations

import keyword
import re
import warnings

import numpy as np
import pytest
from refusals import refused
from variants import VOXEL_TYPES, daily

from clrecon.opencl import allocate, download, kernel_files, launch, load_program, read_kernel_source, upload
from clrecon.opencl.program import LAUNCHES_BEFORE_TYPES
from clrecon.opencl.quirks import import_pyopencl
from clrecon.opencl.sources import KernelArgument, definitions_of, find_signatures
from clrecon.operators.resident.tables import BrickRanges, compare_bricks

VARIANTS = [
    (),
    ("-DUNEVEN=1", "-DLABELS=1", "-DGRADIENT_OPACITY=1", "-DTAKES_PARTS=1"),
    ("-DRANGE=1",),
    ("-DMASKS=1", "-DLABEL=uchar"),
    ("-DBORDER_INSIDE=1",),
]
"""Options that change which kernels there are, or their arguments."""


def scan_program(device):
    return load_program(device, "primitives/scan.cl", {"SCAN_GROUP": str(device.group_size)})


def scan_buffers(device):
    counts = np.arange(50, dtype=np.uint32)
    return {"counts": upload(device, counts), "block_sums": allocate(device, 4), "n": 50}


@pytest.mark.every_device
def test_arguments_are_passed_by_name_in_any_order(device):
    buffers = scan_buffers(device)
    backwards = dict(reversed(buffers.items()))
    launch(device, scan_program(device)["sum_blocks"], device.group_size, **backwards)
    sums = download(device, np.empty(1, np.uint32), buffers["block_sums"])
    assert sums[0] == sum(range(min(50, 16 * device.group_size)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n": None, "size": 50}, r"sum_blocks is launched without n and with size: it takes counts, block_sums, n"),
        ({"n": None}, r"sum_blocks is launched without n:"),
        ({"more": 1}, r"sum_blocks is launched with more:"),
        ({"n": "many"}, r"sum_blocks: n is uint, not 'many'"),
        ({"n": 2.5}, r"sum_blocks: n is uint, not 2.5"),
        ({"n": -1}, r"sum_blocks: n is uint, not -1"),
        ({"counts": np.zeros(3)}, r"sum_blocks: counts is a buffer, not array"),
    ],
)
def test_a_wrong_argument_is_an_error_before_the_launch(device, change, message, monkeypatch):
    kernel = scan_program(device)["sum_blocks"]
    monkeypatch.setattr(kernel, "cl_kernel", None)  # a launch would call it
    arguments = {name: value for name, value in {**scan_buffers(device), **change}.items() if value is not None}
    with pytest.raises(TypeError, match=message):
        launch(device, kernel, device.group_size, **arguments)


def test_a_trace_refuses_to_write_what_is_for_reading_alone(device, monkeypatch):
    buffers = scan_buffers(device)
    launch(device, scan_program(device)["sum_blocks"], device.group_size, **buffers)
    monkeypatch.setattr(device, "trace", lambda doing: None)
    launch(device, scan_program(device)["sum_blocks"], device.group_size, **buffers)
    buffers["block_sums"] = upload(device, np.zeros(1, np.uint32))
    with refused(TypeError, "sum_blocks", "block_sums"):
        launch(device, scan_program(device)["sum_blocks"], device.group_size, **buffers)


@pytest.mark.every_device
def test_numbers_become_what_the_kernel_takes(device):
    """The driver is given four bytes, whatever a number was."""
    kernel = load_program(device, "surface/label_masks.cl")["sum_volumes"]
    buffers = {name: allocate(device, 4) for name in ("positions", "triangles", "sums")}
    ordered = kernel.order({**buffers, "centre": [1, 2.5, 3, 0], "triangle_count": 7, "triangles_per_sum": np.int64(9)})
    assert ordered[3].dtype == np.float32
    assert ordered[3].tolist() == [1, 2.5, 3, 0]
    assert ordered[4:] == (7, 9)
    assert {type(value) for value in ordered[4:]} == {np.uint32}
    with refused(TypeError, "float4"):
        kernel.order({**buffers, "centre": [1, 2, 3], "triangle_count": 7, "triangles_per_sum": 9})


@pytest.mark.every_device
@pytest.mark.parametrize("dtype", VOXEL_TYPES)
def test_the_hundredth_launch_gives_what_the_first_gives(device, dtype):
    """After some launches pyopencl is told the types of all arguments."""
    values = np.array([[0, 5], [7, 9], [3, 7], [1, 2]], dtype)
    ranges = BrickRanges(upload(device, values), (1, 2, 2), np.dtype(dtype))
    found = []
    for _ in range(LAUNCHES_BEFORE_TYPES + 2):
        states = compare_bricks(device, ranges, np.dtype(dtype).type(7), 8, 0)
        found.append(download(device, np.empty(4, np.uint8), states.states_d).tolist())
    assert found == [[0, 1, 2, 0]] * len(found)


@pytest.mark.parametrize("name", kernel_files())
def test_every_argument_can_be_named_in_python(name):
    for options in VARIANTS:
        for kernel, arguments in find_signatures(read_kernel_source(name), definitions_of(options)).items():
            names = [argument.name for argument in arguments]
            assert len(set(names)) == len(names), kernel
            assert not [name for name in names if keyword.iskeyword(name)], kernel


@pytest.mark.release
@pytest.mark.parametrize("options", daily(1, VARIANTS), ids=lambda options: " ".join(options) or "plain")
def test_names_and_types_are_those_that_the_compiler_knows(options, device):
    cl = import_pyopencl()
    info, access, qualifiers = cl.kernel_arg_info, cl.kernel_arg_address_qualifier, cl.kernel_arg_type_qualifier
    found, known = {}, {}
    for name in kernel_files():
        source = read_kernel_source(name)
        if options and not re.search(r"\b(?:" + "|".join(definitions_of(options[:1])) + r")\b", source):
            continue
        signatures = find_signatures(source, definitions_of(options))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            built = cl.Program(device.context, source).build(
                ["-cl-std=CL1.2", "-cl-kernel-arg-info", *device.build_options, *options]
            )
        for kernel in built.all_kernels():
            found[name, kernel.function_name] = signatures[kernel.function_name]
            try:
                known[name, kernel.function_name] = tuple(
                    KernelArgument(
                        kernel.get_arg_info(n, info.NAME),
                        kernel.get_arg_info(n, info.TYPE_NAME).rstrip("*"),
                        (is_buffer := kernel.get_arg_info(n, info.ADDRESS_QUALIFIER) == access.GLOBAL),
                        is_buffer and not kernel.get_arg_info(n, info.TYPE_QUALIFIER) & qualifiers.CONST,
                    )
                    for n in range(kernel.num_args)
                )
            except cl.Error as error:
                pytest.skip(f"{device.label} does not know the arguments of its kernels: {error}")
    assert found == known
    assert found


SOURCE = """
#define TYPE int
#ifdef WIDE
#undef TYPE
#define TYPE long /* of all numbers */
#endif
#define ADDED_PARAMETERS \\
    , const float added
#define HELPER(a) (a)
#if !defined(WIDE) && LANES > 1
#define MORE_PARAMETERS ADDED_PARAMETERS
#else
#define MORE_PARAMETERS
#endif
/* A __kernel in a comment, void of meaning (really) { */
__kernel __attribute__((vec_type_hint(int))) /* why */
void work(__global const TYPE *restrict data, // the data
    const TYPE count
#ifdef NAMED
    , const float4 place
#elif LANES == 4
    , const uint four
#endif
    MORE_PARAMETERS)
{
}
#if 0
__kernel void never(const int a) { }
#endif
"""


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ((), "data:int* count:int"),
        (("-DWIDE",), "data:long* count:long"),
        (("-DLANES=4",), "data:int* count:int four:uint added:float"),
        (("-DLANES=8", "-DNAMED=1"), "data:int* count:int place:float4 added:float"),
        (("-DLANES=8", "-DNAMED", "-DWIDE", "-cl-mad-enable"), "data:long* count:long place:float4"),
    ],
)
def test_signatures_follow_the_preprocessor(options, expected):
    signatures = find_signatures(SOURCE, definitions_of(options))
    assert list(signatures) == ["work"]
    arguments = [f"{each.name}:{each.type}{'*' * each.is_buffer}" for each in signatures["work"]]
    assert " ".join(arguments) == expected


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        ("1", True), ("0", False), ("SIZE", True), ("MISSING", False), ("!SIZE", False), ("!defined(MISSING)", True),
        ("SIZE == 8 && 3 > 4", False), ("SIZE != 8 || 3 >= 3", True), ("-1 < 0", True), ("SIZE % 3 * 2 - 4", False),
        ("(SIZE + 1) / 3 <= 3", True), ("7 / 2 == 3", True), ("defined SIZE && (MISSING || 1)", True),
    ],
)  # fmt: skip
def test_conditions_are_those_of_c(condition, holds):
    source = f"#if {condition}\n__kernel void work(const int a) {{}}\n#endif\n"
    assert list(find_signatures(source, {"SIZE": "8"})) == (["work"] if holds else [])


@pytest.mark.parametrize(
    "source",
    [
        "#if SIZE(3)\n#endif\n",
        "#if 1 +\n#endif\n",
        "#if 1 < 2 < 3\n#endif\n",
        "#if 2 ** 3\n#endif\n",
        "#warning this\n",
        "#define ONE TWO\n#define TWO ONE\n__kernel void work(const ONE a) {}\n",
        "__kernel void work(unsigned long long a) {}\n",
    ],
)
def test_signature_that_its_reader_does_not_know_is_an_error(source):
    with pytest.raises(ValueError, match=r"#if|#warning|macros that name themselves|a type and a name"):
        find_signatures(source, {})
