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
from clrecon.operators.primitives.scan import SCAN_PER_ITEM
from clrecon.operators.resident.tables import BrickRanges, compare_bricks

VARIANTS = [
    (),
    ("-DUNEVEN=1", "-DLABELS=1", "-DGRADIENT_OPACITY=1", "-DTAKES_PARTS=1"),
    ("-DRANGE=1",),
    ("-DMASKS=1", "-DLABEL=uchar"),
    ("-DBORDER_INSIDE=1",),
]
"""Options that change which kernels there are, or their arguments."""


def sum_blocks_kernel(device):
    """The kernel that adds up the counts of each block: of as many as SCAN_PER_ITEM for each work-item of a group."""
    return load_program(device, "primitives/scan.cl", {"SCAN_GROUP": str(device.group_size)})["sum_blocks"]


def sum_blocks_arguments(device):
    """The arguments of sum_blocks for the counts 0 to 49."""
    counts = np.arange(50, dtype=np.uint32)
    return {"counts": upload(device, counts), "block_sums": allocate(device, 4), "n": len(counts)}


@pytest.mark.every_device
def test_kernel_takes_its_arguments_by_name_in_reversed_order(device):
    arguments = sum_blocks_arguments(device)
    backwards = dict(reversed(arguments.items()))
    launch(device, sum_blocks_kernel(device), device.group_size, **backwards)

    [block_sum] = download(device, np.empty(1, np.uint32), arguments["block_sums"])
    counts_in_block = min(arguments["n"], SCAN_PER_ITEM * device.group_size)
    assert block_sum == sum(range(counts_in_block))  # the counts are 0, 1, 2 ...


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
def test_wrong_argument_is_refused_before_the_launch(device, change, message, monkeypatch):
    kernel = sum_blocks_kernel(device)
    monkeypatch.setattr(kernel, "cl_kernel", None)  # a launch would call it
    arguments = {name: value for name, value in {**sum_blocks_arguments(device), **change}.items() if value is not None}
    with pytest.raises(TypeError, match=message):
        launch(device, kernel, device.group_size, **arguments)


def test_launch_under_a_trace_refuses_an_input_buffer_as_output(device, monkeypatch):
    monkeypatch.setattr(device, "trace", lambda doing: None)
    arguments = sum_blocks_arguments(device)
    launch(device, sum_blocks_kernel(device), device.group_size, **arguments)  # its output was allocated

    arguments["block_sums"] = upload(device, np.zeros(1, np.uint32))  # uploaded: to be read alone
    with refused(TypeError, "sum_blocks", "block_sums"):
        launch(device, sum_blocks_kernel(device), device.group_size, **arguments)


def order_sum_volumes(device, **numbers):
    """The arguments of the kernel sum_volumes as they are given to the driver, without its three buffers."""
    kernel = load_program(device, "surface/label_masks.cl")["sum_volumes"]
    buffers = {name: allocate(device, 4) for name in ("positions", "triangles", "sums")}
    return kernel.order({**buffers, **numbers})[len(buffers) :]


@pytest.mark.every_device
def test_numbers_are_given_to_the_driver_as_the_types_of_the_kernel(device):
    centre, triangle_count, triangles_per_sum = order_sum_volumes(
        device, centre=[1, 2.5, 3, 0], triangle_count=7, triangles_per_sum=np.int64(9)
    )
    assert (centre.dtype, centre.tolist()) == (np.float32, [1, 2.5, 3, 0])
    assert (type(triangle_count), triangle_count) == (np.uint32, 7)
    assert (type(triangles_per_sum), triangles_per_sum) == (np.uint32, 9)


def test_three_numbers_for_a_float4_are_refused(device):
    with refused(TypeError, "float4"):
        order_sum_volumes(device, centre=[1, 2, 3], triangle_count=7, triangles_per_sum=9)


@pytest.mark.every_device
@pytest.mark.parametrize("dtype", VOXEL_TYPES)
def test_launches_after_pyopencl_knows_the_argument_types_give_what_the_first_gives(device, dtype):
    lowest_and_highest = np.array([[0, 5], [7, 9], [3, 7], [1, 2]], dtype)
    below, above, between = 0, 1, 2  # states of the four bricks at the iso value 7
    ranges = BrickRanges(upload(device, lowest_and_highest), (1, 2, 2), np.dtype(dtype))
    launches = []
    for _ in range(LAUNCHES_BEFORE_TYPES + 2):
        states = compare_bricks(device, ranges, level=np.dtype(dtype).type(7), ni=8, border=0)
        launches.append(download(device, np.empty(4, np.uint8), states.states_d).tolist())
    assert launches == [[below, above, between, below]] * (LAUNCHES_BEFORE_TYPES + 2)


@pytest.mark.parametrize("name", kernel_files())
def test_every_kernel_argument_has_a_name_of_its_own_that_python_accepts(name):
    signatures = [find_signatures(read_kernel_source(name), definitions_of(options)) for options in VARIANTS]
    assert any(signatures), "there is no kernel in this file"
    for kernel, arguments in (item for variant in signatures for item in variant.items()):
        names = [argument.name for argument in arguments]
        assert len(set(names)) == len(names), kernel
        assert not any(keyword.iskeyword(name) for name in names), kernel


def build_with_argument_info(device, source, options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return (
            import_pyopencl()
            .Program(device.context, source)
            .build(["-cl-std=CL1.2", "-cl-kernel-arg-info", *device.build_options, *options])
        )


def arguments_by_compiler(kernel):
    """The arguments of a built kernel, as the compiler of the device knows them."""
    cl = import_pyopencl()
    info, access, qualifiers = cl.kernel_arg_info, cl.kernel_arg_address_qualifier, cl.kernel_arg_type_qualifier
    return tuple(
        KernelArgument(
            kernel.get_arg_info(n, info.NAME),
            kernel.get_arg_info(n, info.TYPE_NAME).rstrip("*"),
            (is_buffer := kernel.get_arg_info(n, info.ADDRESS_QUALIFIER) == access.GLOBAL),
            is_buffer and not kernel.get_arg_info(n, info.TYPE_QUALIFIER) & qualifiers.CONST,
        )
        for n in range(kernel.num_args)
    )


@pytest.mark.release
@pytest.mark.parametrize("options", daily(1, VARIANTS), ids=lambda options: " ".join(options) or "plain")
def test_argument_names_and_types_read_from_sources_are_those_of_the_compiler(options, device):
    by_reader, by_compiler = {}, {}
    for name in kernel_files():
        source = read_kernel_source(name)
        if options and not re.search(r"\b(?:" + "|".join(definitions_of(options[:1])) + r")\b", source):
            continue  # the same kernels as without options
        signatures = find_signatures(source, definitions_of(options))
        for kernel in build_with_argument_info(device, source, options).all_kernels():
            by_reader[name, kernel.function_name] = signatures[kernel.function_name]
            try:
                by_compiler[name, kernel.function_name] = arguments_by_compiler(kernel)
            except import_pyopencl().Error as error:
                pytest.skip(f"{device.label} does not know the arguments of its kernels: {error}")
    assert by_reader
    assert by_reader == by_compiler


def read_arguments(source: str, *options: str) -> str:
    """The arguments of the only kernel `work` of a source as "name:type", buffers as "name:type*"."""
    signatures = find_signatures(source, definitions_of(options))
    assert list(signatures) == ["work"]
    return " ".join(f"{each.name}:{each.type}{'*' * each.is_buffer}" for each in signatures["work"])


def test_arguments_of_a_kernel_have_their_names_and_types_whatever_qualifiers_attributes_and_comments_say():
    source = """
/* A __kernel in a comment, void of meaning (really) { */
__kernel __attribute__((vec_type_hint(int))) /* why */
void work(__global const float *restrict data, // the data
    const int count)
{
}
"""
    assert read_arguments(source) == "data:float* count:int"


@pytest.mark.parametrize(("options", "type_of_data"), [((), "int"), (("-DWIDE",), "long")], ids=["first", "second"])
def test_argument_has_the_type_that_its_macro_was_defined_as_last(options, type_of_data):
    source = """
#define TYPE int
#ifdef WIDE
#undef TYPE
#define TYPE long /* of all numbers */
#endif
__kernel void work(__global const TYPE *data, const TYPE count) { }
"""
    assert read_arguments(source, *options) == f"data:{type_of_data}* count:{type_of_data}"


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        ((), "count:int"),
        (("-DLANES=4",), "count:int four:uint"),
        (("-DLANES=8",), "count:int"),
        (("-DNAMED=1",), "count:int place:float4"),
        (("-DNAMED", "-cl-mad-enable"), "count:int place:float4"),
        (("-DNAMED=1", "-DLANES=4"), "count:int place:float4"),
    ],
    ids=["neither", "elif", "elif of another value", "ifdef", "ifdef without a value", "both"],
)
def test_kernel_has_the_arguments_of_the_branch_that_its_options_choose(options, arguments):
    source = """
__kernel void work(const int count
#ifdef NAMED
    , const float4 place
#elif LANES == 4
    , const uint four
#endif
    ) { }
"""
    assert read_arguments(source, *options) == arguments


@pytest.mark.parametrize(
    ("options", "arguments"),
    [(("-DLANES=8",), "count:int added:float"), (("-DLANES=1",), "count:int"), (("-DLANES=8", "-DWIDE"), "count:int")],
    ids=["holds", "second part fails", "first part fails"],
)
def test_kernel_has_the_arguments_of_a_macro_of_several_lines_where_its_condition_holds(options, arguments):
    source = """
#define ADDED_PARAMETERS \\
    , const float added
#if !defined(WIDE) && LANES > 1
#define MORE_PARAMETERS ADDED_PARAMETERS
#else
#define MORE_PARAMETERS
#endif
__kernel void work(const int count MORE_PARAMETERS) { }
"""
    assert read_arguments(source, *options) == arguments


def test_macro_with_parameters_does_not_replace_an_argument_of_its_name():
    source = """
#define count(a) (a)
__kernel void work(const int count) { }
"""
    assert read_arguments(source) == "count:int"


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        ("1", True), ("0", False), ("SIZE", True), ("MISSING", False), ("!SIZE", False), ("!defined(MISSING)", True),
        ("SIZE == 8 && 3 > 4", False), ("SIZE != 8 || 3 >= 3", True), ("-1 < 0", True), ("SIZE % 3 * 2 - 4", False),
        ("(SIZE + 1) / 3 <= 3", True), ("7 / 2 == 3", True), ("defined SIZE && (MISSING || 1)", True),
    ],
)  # fmt: skip
def test_kernel_in_a_condition_is_found_where_the_condition_holds_in_c(condition, holds):
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
def test_source_that_the_reader_of_signatures_does_not_understand_is_refused(source):
    with pytest.raises(ValueError, match=r"#if|#warning|macros that name themselves|a type and a name"):
        find_signatures(source, {})
