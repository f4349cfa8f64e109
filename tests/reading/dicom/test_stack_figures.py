"""Figures of a stack, of its gaps and of its parts: closed cases without files."""

from __future__ import annotations

import struct
from pathlib import Path
from queue import Empty
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.geometry.grid import POSITION_TOLERANCE_GAPS, POSITION_TOLERANCE_MM
from clrecon.reading.common.padding import PaddingMasks, pack_mask
from clrecon.reading.dicom.headers.slice_header import Concatenation
from clrecon.reading.dicom.pixels import stored
from clrecon.reading.dicom.pixels import voxels as stray_bits
from clrecon.reading.dicom.pixels.decoder_pool import _find_modules
from clrecon.reading.dicom.pixels.voxels import _describe_unfit, _fill_slice, _fits_stored_bits
from clrecon.reading.dicom.series import certificate
from clrecon.reading.dicom.series.certificate import _judge_thickness
from clrecon.reading.dicom.series.phases import SAME_POSITION_MM, Phase, _are_passes, _sort_copies
from clrecon.reading.dicom.series.scan import DAMAGED_START, DiskReader, _Slices, describe_start
from clrecon.reading.dicom.series.series import describe_missing_parts
from clrecon.reading.dicom.stack import mixtures
from clrecon.reading.dicom.stack.fit import (
    RUN_LENGTH,
    _cross,
    _find_runs,
    facts_of_thickness,
    measure_line,
    measure_stated_gap,
    median,
    summarise_gaps,
)
from clrecon.reading.dicom.stack.mixtures import (
    Alternation,
    _is_compared,
    _shorten,
    describe_differences,
    find_alternation,
)

pytestmark = pytest.mark.unit


def headers_with(**columns: list) -> list[Any]:
    """Stand-ins for headers of slices: each attribute has a list of its values, slice by slice."""
    return [SimpleNamespace(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]


def headers_of_thickness(*thickness: float | None) -> list[Any]:
    return headers_with(slice_thickness_mm=list(thickness))


@pytest.mark.parametrize(
    ("values", "expected"),
    [([3.0, 1.0, 2.0], 2.0), ([1.0, 8.0, 4.0, 2.0], 3.0), ([5.0], 5.0)],
    ids=["odd", "even", "one"],
)
def test_median_is_the_middle_value_or_lies_between_the_middle_two(values, expected):
    assert median(values) == expected


def test_cross_product_is_that_of_numpy():
    one, other = np.array([1.0, 2.0, 3.0]), np.array([5.0, 7.0, 11.0])
    assert _cross(one, other).tolist() == np.cross(one, other).tolist()


@pytest.mark.parametrize("step", [0.5, 8.0])
def test_tolerance_of_even_gaps_is_a_share_of_them_and_no_less_than_a_least_one(step):
    distances = step * np.arange(5.0)
    line = measure_line(np.outer(distances, [0.0, 0.6, 0.8]), distances)
    assert line.tolerance_mm == max(POSITION_TOLERANCE_MM, POSITION_TOLERANCE_GAPS * step)
    assert (line.gap_min_mm, line.gap_median_mm, line.gap_max_mm) == (step, step, step)


def test_equal_gaps_one_after_the_other_are_summarised_as_one_run():
    assert summarise_gaps(np.array([0.0, 1, 2, 4, 6, 8, 9])) == [
        {"count": 2, "gap_mm": 1.0},
        {"count": 3, "gap_mm": 2.0},
        {"count": 1, "gap_mm": 1.0},
    ]


@pytest.mark.parametrize("before", [0, 1, RUN_LENGTH], ids="{} gaps before".format)
@pytest.mark.parametrize("length", [RUN_LENGTH - 1, RUN_LENGTH, RUN_LENGTH + 1], ids="{} equal gaps".format)
def test_equal_gaps_are_a_run_from_the_run_length_on_wherever_they_begin(before, length):
    """As many different gaps stand before and after them."""
    different = 2.0 ** np.arange(2, 2 + 2 * RUN_LENGTH)
    gaps = np.concatenate([different[:before], np.ones(length), different[before : 2 * before]])
    expected = np.zeros(len(gaps), bool)
    expected[before : before + length] = length >= RUN_LENGTH
    assert _find_runs(gaps).tolist() == expected.tolist()


def test_thickness_and_overlap_are_summarised_over_all_slices():
    facts = facts_of_thickness(headers_of_thickness(3.0, 3.0, 5.0), np.array([0.0, 2.0, 5.0]))
    assert facts == {
        "min_mm": 3.0,
        "max_mm": 5.0,
        "median_mm": 3.0,
        "overlap_mm": {"min": 1.0, "max": 1.0, "median": 1.0},  # 3 mm on 2, and (3 + 5) / 2 on 3
        "overlap_percent": 40.0,  # of the mean gap of 2.5 mm
    }


@pytest.mark.parametrize(
    "thickness", [(3.0, None, 3.0), (3.0, 0.0, 3.0), (3.0,)], ids=["not stated once", "zero once", "one slice"]
)
def test_thickness_is_not_summarised_where_a_slice_lacks_it_or_there_is_one(thickness):
    distances = 2.0 * np.arange(len(thickness))
    assert facts_of_thickness(headers_of_thickness(*thickness), distances) is None


def test_gate_of_gaps_measures_the_largest_multiple_of_the_thickness_of_the_slices_beside_it():
    """2 mm between slices of 1 mm are worse than 12 mm between slices of 9 mm."""
    thickness = [1.0, 1.0, 9.0, 9.0, 1.0, 1.0]
    distances = np.cumsum([0.0, 2.0, 5.0, 12.0, 5.0, 1.5])
    stack: Any = SimpleNamespace(slices=headers_of_thickness(*thickness), distances_mm=distances)
    assert _judge_thickness(stack)["measured"] == 2.0


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        pytest.param([None, 5.0, None, None], (5.0, 5.0, 0.0), id="that along the table, once"),
        pytest.param([4.0] * 4, (4.0, 4.0, 0.0), id="that along the normal"),
        pytest.param([2.0] * 4, (2.0, 4.0, 0.5), id="half of that along the normal"),
        pytest.param([None] * 4, None, id="none"),
    ],
)
def test_stated_gap_is_compared_with_the_nearer_of_those_along_normal_and_table(stated, expected):
    """Stated and measured gap in mm, and by which share they differ."""
    positions = np.outer(np.arange(4.0), [0.0, 3.0, 4.0])  # 5 mm along the table, 4 mm along the normal
    assert measure_stated_gap(headers_with(stated_gap_mm=stated), positions, usual=4.0) == expected


def equal_headers(*thickness: float) -> list[Any]:
    """Stand-ins for headers that differ in their thickness in mm alone."""
    count = len(thickness)
    columns: dict[str, list] = {"phase": [()] * count, "slice_thickness_mm": list(thickness), "padding": [None] * count}
    for name in ("slope", "intercept", "bits_stored", "high_bit", "bits_allocated", "signed"):
        columns[name] = [1] * count
    return headers_with(**columns, photometric=["MONOCHROME2"] * count, rescale_type=["HU"] * count)


def test_slices_of_another_thickness_are_described_as_different_and_unstated_ones_are_not():
    ((text, differs),) = describe_differences(equal_headers(0.5, 0.5, 0.75, 0.0))
    assert text == "SliceThickness differs along the stack"
    assert [differs(header) for header in equal_headers(0.5, 0.75, 0.0)] == [False, True, False]


def test_slices_of_one_thickness_are_not_described_as_different():
    assert not list(describe_differences(equal_headers(0.5, 0.5, 0.5)))


@pytest.fixture
def files_read(monkeypatch):
    """Numbers of the slices whose elements are read; they have none."""
    numbers = []

    def read_nothing(file, wanted, *, force):
        numbers.append(file)
        return SimpleNamespace(values={})

    monkeypatch.setattr(mixtures, "read_elements", read_nothing)
    return numbers


def stack_of(count):
    """Headers of so many slices, a mm apart, of files that are named by their numbers."""
    return headers_with(file=list(range(count)), frames=[1] * count, position_mm=[(0.0, 0.0, k) for k in range(count)])


def test_elements_of_an_even_stack_of_100_slices_are_read_in_three_windows_of_32(files_read):
    assert find_alternation(stack_of(100), even=True) is None
    assert files_read == [*range(32), *range(34, 66), *range(68, 100)]


@pytest.mark.parametrize(("count", "even"), [(100, False), (96, True)], ids=["uneven", "96 slices"])
def test_elements_of_an_uneven_or_shorter_stack_are_read_in_all_slices(files_read, count, even):
    find_alternation(stack_of(count), even=even)
    assert files_read == [*range(count)]


@pytest.mark.parametrize("tag", [0x0020000D, 0x00080032, 0x00281050], ids=["study", "time", "window"])
def test_elements_of_study_time_and_window_are_compared_along_a_stack(tag):
    assert _is_compared(tag)


@pytest.mark.parametrize(
    "tag", [0x0020000E, 0x00280010, 0x60003000, 0x00080000], ids=["series", "rows", "overlay", "length of a group"]
)
def test_elements_of_series_pixels_and_overlays_are_not_compared_along_a_stack(tag):
    assert not _is_compared(tag)


def test_alternation_is_named_by_keyword_or_by_tag_where_there_is_none():
    assert Alternation(tag=0x00180060, groups=(), certain=False).name == "KVP"
    assert Alternation(tag=0x00091001, groups=(), certain=False).name == "(0009,1001)"


def test_values_of_more_than_64_bytes_are_compared_by_a_hash():
    assert _shorten(b"a" * 64) == b"a" * 64
    assert len(_shorten(b"a" * 65)) == 8 + len("...")


def part(number: int, *, first: int | None, parts: int | None = 3) -> Any:
    """A file of a concatenation: part `number`, of 10 frames, the first of which is `first`, from 0."""
    return SimpleNamespace(concatenation=Concatenation("1.2", number, parts, first, 10))


@pytest.mark.parametrize(
    "parts",
    [
        [part(1, first=0), part(2, first=10), part(3, first=20), part(3, first=20)],
        [part(1, first=None), part(2, first=None), part(3, first=None)],
        [part(1, first=0), part(2, first=None), part(3, first=21)],
        [SimpleNamespace(concatenation=None)],
    ],
    ids=["one part twice", "no starts", "the end of part 2 is not known", "no concatenation"],
)
def test_concatenation_that_may_be_whole_has_no_missing_parts(parts: list[Any]) -> None:
    assert describe_missing_parts(parts) == []


def test_parts_of_a_concatenation_that_start_at_other_frames_than_the_last_ended_are_described():
    assert describe_missing_parts([part(3, first=20), part(1, first=0), part(2, first=11)]) == [
        "file 2 of a concatenation starts at frame 11, the one before it ends at frame 10 "
        "(ConcatenationFrameOffsetNumber (0020,9228))",
        "file 3 of a concatenation starts at frame 20, the one before it ends at frame 21 "
        "(ConcatenationFrameOffsetNumber (0020,9228))",
    ]


@pytest.mark.parametrize(
    ("parts", "missing"),
    [
        ([part(1, first=0), part(3, first=20)], "file 2 of the 3 of a concatenation is missing"),
        (
            [part(2, first=10, parts=None), part(4, first=30, parts=None)],
            "files 1, 3 of the 4 of a concatenation are missing",
        ),
    ],
    ids=["of a known number", "up to the last that is there"],
)
def test_parts_of_a_concatenation_that_are_missing_are_described(parts: list[Any], missing: str) -> None:
    assert describe_missing_parts(parts) == [f"{missing} (InConcatenationNumber (0020,9162))"]


@pytest.mark.parametrize(
    "start",
    [b"\2\0\x10\0UI" + bytes(8), bytes(700) + b"\1\2\0\x10\0UI\0"],
    ids=["at the first byte", "behind 700 bytes"],
)
def test_start_with_a_meta_header_at_another_place_is_described_as_damaged(start):
    assert describe_start(start) == DAMAGED_START


def test_start_of_equal_bytes_is_described_as_blank():
    assert describe_start(b"\xff" * 9) == "blank, all bytes FF"


def slices_named(*names):
    """The names of slices, whose likeness is asked for."""
    named = _Slices(set(names))
    named.finish()
    return named


@pytest.mark.parametrize(
    "names", [("A0001B7Q", "A0001C2X"), ("A0001B7Q", "A0001C2X", "ZZ9")], ids=["two", "two and one of another length"]
)
def test_random_name_is_not_like_those_of_fewer_than_three_slices_of_its_length(names):
    assert not slices_named(*names).has_name_like("Q1X4Z8KK")


def test_random_name_is_like_those_of_three_slices_with_its_length_and_kind_of_letters():
    slices = slices_named("A0001B7Q", "A0001C2X", "A0009C2X")
    assert slices.has_name_like("Q1X4Z8KK")
    assert not slices.has_name_like("Q1X4Z8K")  # shorter
    assert not slices.has_name_like("QQQQQQQQ")  # without digits


def test_disk_that_does_not_answer_is_told_every_10_seconds_and_given_up_after_300():
    calls, waits = [], []

    def get(timeout: float) -> Any:
        waits.append(timeout)
        raise Empty

    reader = DiskReader(lambda *call: calls.append(call))
    reader._done = SimpleNamespace(get=get)  # type: ignore[assignment]
    reader.touched = "folder/IM0001"
    with refused(RefusedInputError, "IM0001", 300):
        reader._wait()
    assert waits == [10.0] * 30
    assert calls == [("no answer yet from IM0001", 0, 0)] * 29


@pytest.mark.parametrize(
    ("signed", "padding", "fits"),
    [
        (True, (-2048, 2047), True),
        (True, (-2048, 2048), False),
        (True, (-2049, 0), False),
        (False, (0, 4095), True),
        (False, (0, 4096), False),
        (False, (-1, 0), False),
    ],
)
def test_declared_padding_counts_where_twelve_stored_bits_can_hold_it(signed, padding, fits):
    header: Any = SimpleNamespace(bits_stored=12, signed=signed, padding=padding)
    assert _fits_stored_bits(header) == fits


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ([np.nan, 1.0, np.nan], "2 NaN and 0 infinite values of 3"),
        ([-np.inf, 1.0], "0 NaN and 1 infinite values of 2"),
        ([-3.0, 2e9], "values from -3 to 2e+09"),
    ],
    ids=["NaN", "infinite", "huge"],
)
def test_values_that_cannot_be_hu_are_described_by_their_counts_or_range(values, text):
    assert _describe_unfit(np.array(values)) == text


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["above", "below"])
def test_float_pixels_up_to_a_thousand_million_are_read_and_larger_ones_refused(sign):
    header: Any = SimpleNamespace(name="IM1", padding=None, float_pixels=True, slope=1.0, intercept=0.0)

    def fill_with(value):
        source: Any = SimpleNamespace(load=lambda header, out: np.array([[0.0, value]]))
        out = np.empty((1, 2))
        facts = _fill_slice(source, header, out)
        return (facts.low, facts.high), out.tolist()

    most = sign * 1e9
    assert fill_with(most) == ((min(0.0, most), max(0.0, most)), [[0.0, most]])
    with refused(RefusedInputError, "IM1", "Float"):
        fill_with(sign * (1e9 + 0.5))


@pytest.mark.parametrize(("count", "text"), [(1, "2: order 1, 1 slice"), (2, "2: order 1, 2 slices")])
def test_text_of_a_phase_has_its_number_element_value_and_slices(count, text):
    assert str(Phase(2, "order", "1", tuple(headers_of_thickness(*[1.0] * count)))) == text


def test_padding_is_filled_with_the_lower_middle_value_of_the_air_beside_it():
    """Not with what lies beside corners, nor anything denser than air."""
    voxels = np.array([[[-300, -990, 40, 7], [-1000, 0, -980, 7], [-300, -960, 40, 7]]], np.int16)
    mask = np.zeros((3, 4), bool)
    mask[1, 1] = True
    padding = PaddingMasks(voxels)
    padding.add(0, pack_mask(mask))
    assert padding.count == 1
    assert padding.fill() == -990.0  # of -1000, -990, -980 and -960
    assert voxels[0, 1, 1] == -990


@pytest.mark.parametrize(
    ("seconds", "are_passes"),
    [
        pytest.param([[1, 10, 20], [2, 11, 21]], True, id="two places"),
        pytest.param([[1, 10, 20], [2, 11, 21], [3, 12, 22]], True, id="three places"),
        pytest.param([[3, 12, 22], [1, 10, 20], [2, 11, 21]], True, id="places out of order"),
        pytest.param([[1, 10, 20], [2, 11, 21], [3, 22, 23]], False, id="a second visit after a third"),
        pytest.param([[1, 2, 3], [4, 5, 6], [7, 8, 9]], True, id="the table stopped at each place"),
        pytest.param([[1, 11, 21], [2, 12, 22], [30, 41, 51], [31, 42, 52]], True, id="two stops of two places"),
        pytest.param([[1, 11, 21], [2, 12, 22], [30, 41, 51], [42, 43, 52]], False, id="a visit late at a stop"),
    ],
)
def test_times_of_visits_are_passes_where_each_pass_ends_before_the_next(seconds, are_passes):
    """Seconds at which each place was scanned for the first, second and third time."""
    values = [[(f"1000{second:02d}",) for second in visits] for visits in seconds]
    assert _are_passes(values, ("AcquisitionTime",)) == are_passes


@pytest.mark.parametrize("current", ["tmp", "above packages", "packages"])
def test_decoders_find_modules_of_all_folders_of_the_path_but_the_current_one(tmp_path, monkeypatch, current):
    packages, above_packages = Path(np.__file__).parents[1], Path(np.__file__).parents[2]
    folders = {"tmp": tmp_path, "above packages": above_packages, "packages": packages}
    for folder in folders.values():
        monkeypatch.syspath_prepend(str(folder))
    monkeypatch.syspath_prepend("relative")
    monkeypatch.chdir(folders[current])

    found = _find_modules()

    assert "relative" not in found
    for name in ("tmp", "above packages"):
        assert (str(folders[name]) in found) == (name != current)
    assert str(packages) in found  # of numpy, wherever one is


@pytest.mark.parametrize(
    ("overlays", "expected"),
    [
        ([12], stray_bits.StrayBits(odd=0, signs=True)),
        ([12, 13, 14, 15], stray_bits.StrayBits(odd=0, signs=False)),
        ([], stray_bits.StrayBits(odd=1, signs=True, example=(4101, 5))),
    ],
    ids=["overlay in the bit that is set", "overlays in all upper bits", "no overlay"],
)
def test_bit_above_the_stored_ones_is_stray_unless_an_overlay_is_in_it(overlays, expected, monkeypatch):
    """Twelve stored bits of 16: -1 with its sign extended, and 5 with the lowest bit above set (4101)."""
    values = {0x60000102 + 0x20000 * number: struct.pack("<H", bit) for number, bit in enumerate(overlays)}
    monkeypatch.setattr(stray_bits, "read_elements", lambda file, wanted, force: SimpleNamespace(values=values))
    header: Any = SimpleNamespace(
        bits_allocated=16, bits_stored=12, high_bit=11, signed=True, float_pixels=False, file="a", little_endian=True
    )
    assert stray_bits.find_stray_bits(header, np.array([[-1, 4101]], np.int16), left_out=None) == expected


def slices_in_steps_below_the_tolerance():
    """Three slices, each 0.6 of the tolerance of one position beyond the one before."""
    return headers_with(
        frame_of_reference=["1.2"] * 3,
        position_mm=[(0.0, 0.0, 0.6 * SAME_POSITION_MM * number) for number in range(3)],
        di_mm=[1.0] * 3,
        dj_mm=[1.0] * 3,
        row_cosines=[(1.0, 0.0, 0.0)] * 3,
        column_cosines=[(0.0, 1.0, 0.0)] * 3,
    )


def test_slices_of_the_same_pixels_are_copies_where_the_first_of_them_lies():
    copies = slices_in_steps_below_the_tolerance()
    assert _sort_copies(copies, lambda one, other: True) == [copies[:2], copies[2:]]  # the third is too far


def test_slices_of_other_pixels_at_one_position_are_no_copies():
    copies = slices_in_steps_below_the_tolerance()
    assert _sort_copies(copies, lambda one, other: False) == [[one] for one in copies]


@pytest.mark.parametrize(
    ("warnings", "doubt", "expected"),
    [([], "A doubt", ["A doubt"]), (["A doubt."], "A doubt", ["A doubt."]), ([], "", [])],
    ids=["new", "already there", "none"],
)
def test_doubt_about_the_order_of_slices_is_warned_of_once(warnings, doubt, expected):
    headers = equal_headers(1.0, 1.0)
    for header in headers:
        header.has_slope = header.has_intercept = True
        header.lossy = header.modality_lut = header.quadruped = False
        header.warnings = ()
        header.di_mm = header.dj_mm = 1.0
    places = SimpleNamespace(copies=0, phases=())
    line = SimpleNamespace(gap_median_mm=None)
    stack = SimpleNamespace(slices=headers, warnings=warnings, line=line)
    series: Any = SimpleNamespace(kind="stack", stack=stack, places=places, find_doubt=lambda: doubt)
    assert certificate.collect_series_warnings(series) == expected


SIGNS = [(False, None), (False, False), (True, True), (True, None), (True, False), (False, True)]
"""Whether the header says that pixels are signed, and what the codestream says; None where it says nothing."""


@pytest.mark.parametrize(
    ("declared", "coded", "doubtful"), [(True, None, "no sign"), (True, False, "no sign"), (False, True, "a sign")]
)
def test_pixels_with_the_tenth_bit_are_refused_where_header_and_codestream_differ_in_sign(declared, coded, doubtful):
    header: Any = SimpleNamespace(bits_stored=12, signed=declared)
    frame: Any = SimpleNamespace(bits=10, signed=coded)
    with pytest.raises(RefusedInputError, match=f"has 10 bits and {doubtful}, the header says 12 bits with"):
        stored._settle_sign(header, frame, np.array([[0, 512]], np.int16))


@pytest.mark.parametrize(("declared", "coded"), SIGNS)
def test_pixels_below_the_tenth_bit_or_of_all_stored_bits_are_accepted(declared, coded):
    header: Any = SimpleNamespace(bits_stored=12, signed=declared)
    pixels = np.array([[0, 511]], np.int16)  # without the tenth bit both readings agree
    assert stored._settle_sign(header, SimpleNamespace(bits=10, signed=coded), pixels) is None  # type: ignore[arg-type]
    assert stored._settle_sign(header, SimpleNamespace(bits=12, signed=coded), pixels + 1) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(("declared", "coded"), SIGNS[:3])
def test_pixels_with_the_tenth_bit_are_accepted_where_header_and_codestream_agree(declared, coded):
    header: Any = SimpleNamespace(bits_stored=12, signed=declared)
    frame: Any = SimpleNamespace(bits=10, signed=coded)
    assert stored._settle_sign(header, frame, np.array([[0, 512]], np.int16)) is None


@pytest.mark.parametrize(
    ("copies", "kernels", "expected"),
    [
        pytest.param(0, ["B30", "B30"], [], id="nothing"),
        pytest.param(0, [], [], id="no stack"),
        pytest.param(1, ["B30"], ["1 duplicate slice dropped: same place, same pixels as another"], id="one copy"),
        pytest.param(
            2,
            ["B30", "B70", "B30"],
            [
                "2 duplicate slices dropped: same place, same pixels as another",
                "ConvolutionKernel differs between slices (2 kernels): sharp and soft are mixed",
            ],
            id="two copies and two kernels",
        ),
    ],
)
def test_dropped_copies_and_mixed_kernels_are_described(copies, kernels, expected):
    headers = headers_with(phase=[(("KVP", "120"), ("ConvolutionKernel", kernel)) for kernel in kernels])
    places = SimpleNamespace(copies=copies, phases=(), interleaved=False)
    stack = SimpleNamespace(slices=headers) if headers else None
    series: Any = SimpleNamespace(places=places, phase=None, stack=stack)
    assert certificate._describe_what_was_left(series) == expected
