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


def slices(**columns: list) -> list[Any]:
    """Stand-ins for headers with these attributes."""
    return [SimpleNamespace(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]


def thick(*thickness: float | None) -> list[Any]:
    return slices(slice_thickness_mm=list(thickness))


def test_the_median_of_an_even_count_lies_between_the_middle_two():
    assert (median([3.0, 1.0, 2.0]), median([1.0, 8.0, 4.0, 2.0]), median([5.0])) == (2.0, 3.0, 5.0)


def test_cross_product_is_that_of_the_formula():
    assert _cross(np.array([1.0, 2.0, 3.0]), np.array([5.0, 7.0, 11.0])).tolist() == [1.0, 4.0, -3.0]


@pytest.mark.parametrize("step", [0.5, 8.0])
def test_tolerance_of_even_gaps_grows_with_them(step):
    distances = step * np.arange(5.0)
    line = measure_line(np.outer(distances, [0.0, 0.6, 0.8]), distances)
    assert line.tolerance_mm == max(POSITION_TOLERANCE_MM, POSITION_TOLERANCE_GAPS * step)
    assert (line.gap_min_mm, line.gap_median_mm, line.gap_max_mm) == (step, step, step)


def test_gaps_that_are_equal_one_after_the_other_are_one_run():
    assert summarise_gaps(np.array([0.0, 1, 2, 4, 6, 8, 9])) == [
        {"count": 2, "gap_mm": 1.0},
        {"count": 3, "gap_mm": 2.0},
        {"count": 1, "gap_mm": 1.0},
    ]


def test_a_run_begins_and_ends_anywhere():
    """`RUN_LENGTH` equal gaps at the first, the last and a middle place, between gaps that differ."""
    others = 2.0 ** np.arange(2, 2 + 2 * RUN_LENGTH)
    for before in (0, 1, RUN_LENGTH):
        for length in (RUN_LENGTH - 1, RUN_LENGTH, RUN_LENGTH + 1):
            gaps = np.concatenate([others[:before], np.ones(length), others[before : 2 * before]])
            is_run = np.arange(len(gaps)) - before
            expected = (is_run >= 0) & (is_run < length) & (length >= RUN_LENGTH)
            assert _find_runs(gaps).tolist() == expected.tolist()


def test_thickness_and_overlap_are_measured_where_every_slice_states_it():
    found = facts_of_thickness(thick(3.0, 3.0, 5.0), np.array([0.0, 2.0, 5.0]))
    assert found == {
        "min_mm": 3.0,
        "max_mm": 5.0,
        "median_mm": 3.0,
        "overlap_mm": {"min": 1.0, "max": 1.0, "median": 1.0},
        "overlap_percent": 40.0,
    }
    assert facts_of_thickness(thick(3.0, None, 3.0), np.array([0.0, 2.0, 4.0])) is None
    assert facts_of_thickness(thick(3.0, 0.0, 3.0), np.array([0.0, 2.0, 4.0])) is None
    assert facts_of_thickness(thick(3.0), np.array([0.0])) is None


def test_the_worst_gap_is_that_of_the_largest_multiple_of_its_own_thickness():
    """2 mm between slices of 1 mm are worse than 12 mm between slices of 9 mm."""
    thickness = [1.0, 1.0, 9.0, 9.0, 1.0, 1.0]
    distances = np.cumsum([0.0, 2.0, 5.0, 12.0, 5.0, 1.5])
    stack: Any = SimpleNamespace(slices=thick(*thickness), distances_mm=distances)
    assert _judge_thickness(stack)["measured"] == 2.0


def test_the_stated_gap_is_compared_along_the_normal_and_along_the_table():
    positions = np.outer(np.arange(4.0), [0.0, 3.0, 4.0])  # 5 mm along the table, 4 mm along the normal
    assert measure_stated_gap(slices(stated_gap_mm=[None, 5.0, None, None]), positions, 4.0) == (5.0, 5.0, 0.0)
    assert measure_stated_gap(slices(stated_gap_mm=[4.0] * 4), positions, 4.0) == (4.0, 4.0, 0.0)
    assert measure_stated_gap(slices(stated_gap_mm=[2.0] * 4), positions, 4.0) == (2.0, 4.0, 0.5)
    assert measure_stated_gap(slices(stated_gap_mm=[None] * 4), positions, 4.0) is None


def headers(*thickness: float) -> list[Any]:
    count = len(thickness)
    columns: dict[str, list] = {"phase": [()] * count, "slice_thickness_mm": list(thickness), "padding": [None] * count}
    for name in ("slope", "intercept", "bits_stored", "high_bit", "bits_allocated", "signed"):
        columns[name] = [1] * count
    return slices(**columns, photometric=["MONOCHROME2"] * count, rescale_type=["HU"] * count)


def test_thin_slices_may_differ_in_thickness_too():
    assert not list(describe_differences(headers(0.5, 0.5, 0.5)))
    ((text, is_so),) = describe_differences(headers(0.5, 0.5, 0.75, 0.0))
    assert text == "SliceThickness differs along the stack"
    assert [is_so(header) for header in headers(0.5, 0.75, 0.0)] == [False, True, False]


def test_a_long_even_stack_is_looked_at_in_three_windows_first(monkeypatch):
    seen = []

    def read_nothing(file, wanted, *, force):
        seen.append(file)
        return SimpleNamespace(values={})

    monkeypatch.setattr(mixtures, "read_elements", read_nothing)
    stack = slices(file=list(range(100)), frames=[1] * 100, position_mm=[(0.0, 0.0, k) for k in range(100)])
    assert find_alternation(stack, even=True) is None
    assert seen == [*range(32), *range(34, 66), *range(68, 100)]
    seen.clear()
    find_alternation(stack, even=False)
    find_alternation(stack[:96], even=True)
    assert seen == [*range(100), *range(96)]


def test_elements_but_series_rows_and_overlays_are_compared():
    study, series, rows, overlay, length = 0x0020000D, 0x0020000E, 0x00280010, 0x60003000, 0x00080000
    assert _is_compared(study) and _is_compared(0x00080032) and _is_compared(0x00281050)
    assert not any(map(_is_compared, (series, rows, overlay, length)))
    assert Alternation(0x00091001, (), False).name == "(0009,1001)"
    assert Alternation(0x00180060, (), False).name == "KVP"
    assert _shorten(bytes(64)) == bytes(64) and len(_shorten(bytes(65))) == 11


def part(number: int, first: int | None, frames: int = 10, parts: int | None = 3) -> Any:
    return SimpleNamespace(concatenation=Concatenation("1.2", number, parts, first, frames))


@pytest.mark.parametrize(
    "parts",
    [
        [part(1, 0), part(2, 10), part(3, 20), part(3, 20)],
        [part(1, None), part(2, None), part(3, None)],
        [part(1, 0), part(2, None), part(3, 21)],
        [SimpleNamespace(concatenation=None)],
    ],
    ids=["one part twice", "no starts", "the end of part 2 is not known", "no concatenation"],
)
def test_parts_of_a_concatenation_that_may_be_whole_are_not_told(parts: list[Any]) -> None:
    assert describe_missing_parts(parts) == []


def test_parts_of_a_concatenation_that_do_not_fit_are_told():
    assert describe_missing_parts([part(3, 20), part(1, 0), part(2, 11)]) == [
        "file 2 of a concatenation starts at frame 11, the one before it ends at frame 10 "
        "(ConcatenationFrameOffsetNumber (0020,9228))",
        "file 3 of a concatenation starts at frame 20, the one before it ends at frame 21 "
        "(ConcatenationFrameOffsetNumber (0020,9228))",
    ]


@pytest.mark.parametrize(
    ("parts", "missing"),
    [
        ([part(1, 0), part(3, 20)], "file 2 of the 3 of a concatenation is missing"),
        ([part(2, 10, parts=None), part(4, 30, parts=None)], "files 1, 3 of the 4 of a concatenation are missing"),
    ],
    ids=["of a known number", "up to the last that is there"],
)
def test_parts_of_a_concatenation_that_are_missing_are_told(parts: list[Any], missing: str) -> None:
    assert describe_missing_parts(parts) == [f"{missing} (InConcatenationNumber (0020,9162))"]


def test_a_damaged_start_is_found_from_its_first_byte_on():
    assert describe_start(b"\2\0\x10\0UI" + bytes(8)) == DAMAGED_START
    assert describe_start(bytes(700) + b"\1\2\0\x10\0UI\0") == DAMAGED_START
    assert describe_start(b"\xff" * 9) == "blank, all bytes FF"


@pytest.mark.parametrize(
    ("names", "like"), [(["A0001B7Q", "A0001C2X"], False), (["A0001B7Q", "A0001C2X", "ZZ9"], False)]
)
def test_names_at_random_are_told_from_three_of_one_length_on(names, like):
    of = _Slices(set(names))
    of.finish()
    assert of.has_name_like("Q1X4Z8KK") == like
    of = _Slices({"A0001B7Q", "A0001C2X", "A0009C2X"})
    of.finish()
    assert of.has_name_like("Q1X4Z8KK") and not of.has_name_like("Q1X4Z8K") and not of.has_name_like("QQQQQQQQ")


def test_a_disk_that_does_not_answer_is_given_up_after_300_seconds():
    told, waits = [], []

    def get(timeout: float) -> Any:
        waits.append(timeout)
        raise Empty

    reader = DiskReader(lambda *said: told.append(said))
    reader._done = SimpleNamespace(get=get)  # type: ignore[assignment]
    reader.touched = "folder/IM0001"
    with refused(RefusedInputError, "IM0001", 300):
        reader._wait()
    assert waits == [10.0] * 30
    assert told == [("no answer yet from IM0001", 0, 0)] * 29


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
def test_padding_counts_where_twelve_stored_bits_can_hold_it(signed, padding, fits):
    header: Any = SimpleNamespace(bits_stored=12, signed=signed, padding=padding)
    assert _fits_stored_bits(header) == fits


def test_values_that_are_no_hu_are_counted():
    assert _describe_unfit(np.array([np.nan, 1.0, np.nan])) == "2 NaN and 0 infinite values of 3"
    assert _describe_unfit(np.array([-np.inf, 1.0])) == "0 NaN and 1 infinite values of 2"
    assert _describe_unfit(np.array([-3.0, 2e9])) == "values from -3 to 2e+09"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_float_pixels_reach_up_to_a_thousand_million(sign):
    header: Any = SimpleNamespace(name="IM1", padding=None, float_pixels=True, slope=1.0, intercept=0.0)
    for value in (1e9, 1e9 + 0.5):
        source: Any = SimpleNamespace(load=lambda header, out, value=value: np.array([[0.0, sign * value]]))
        out = np.empty((1, 2))
        if value == 1e9:
            assert _fill_slice(source, header, out)[1:3] == (min(0.0, sign * value), max(0.0, sign * value))
            assert out.tolist() == [[0.0, sign * value]]
        else:
            with refused(RefusedInputError, "IM1", "Float"):
                _fill_slice(source, header, out)


def test_a_phase_counts_its_slices():
    shown = [str(Phase(2, "order", "1", tuple(thick(*[1.0] * count)))) for count in (1, 2)]
    assert shown == ["2: order 1, 1 slice", "2: order 1, 2 slices"]


def test_padding_takes_the_middle_value_of_the_air_beside_it():
    """The lower one of the middle two; not what lies beside corners, and nothing denser than air."""
    voxels = np.array([[[-300, -990, 40, 7], [-1000, 0, -980, 7], [-300, -960, 40, 7]]], np.int16)
    mask = np.zeros((3, 4), bool)
    mask[1, 1] = True
    padding = PaddingMasks(voxels)
    padding.add(0, pack_mask(mask))
    assert padding.count == 1
    assert padding.fill() == -990.0  # of -1000, -990, -980 and -960
    assert voxels[0, 1, 1] == -990


@pytest.mark.parametrize(
    ("seconds", "are"),
    [
        ([[1, 10, 20], [2, 11, 21]], True),
        ([[1, 10, 20], [2, 11, 21], [3, 12, 22]], True),
        ([[3, 12, 22], [1, 10, 20], [2, 11, 21]], True),
        ([[1, 10, 20], [2, 11, 21], [3, 22, 23]], False),  # the second visit of the last after the third of the first
        ([[1, 2, 3], [4, 5, 6], [7, 8, 9]], True),  # the table stopped at each place
        ([[1, 11, 21], [2, 12, 22], [30, 41, 51], [31, 42, 52]], True),  # two stops of two places
        ([[1, 11, 21], [2, 12, 22], [30, 41, 51], [42, 43, 52]], False),
    ],
)
def test_visits_of_all_places_are_one_pass_after_the_other(seconds, are):
    values = [[(f"1000{second:02d}",) for second in visits] for visits in seconds]
    assert _are_passes(values, ("AcquisitionTime",)) == are


def test_decoders_find_numpy_but_nothing_of_the_current_folder(tmp_path, monkeypatch):
    ours, others = Path(np.__file__).parents[1], Path(np.__file__).parents[2]
    for folder in (tmp_path, others, ours):
        monkeypatch.syspath_prepend(str(folder))
    monkeypatch.syspath_prepend("relative")
    for folder in (tmp_path, others, ours):
        monkeypatch.chdir(folder)
        found = _find_modules()
        assert "relative" not in found
        assert [str(one) in found for one in (tmp_path, others)] == [one != folder for one in (tmp_path, others)]
        assert str(ours) in found


@pytest.mark.parametrize(
    ("overlays", "expected"),
    [([12], (0, 0, True, None)), ([12, 13, 14, 15], (0, 0, False, None)), ([], (1, 0, True, (4101, 5)))],
)
def test_bits_above_the_stored_ones_are_sign_or_overlay(overlays, expected, monkeypatch):
    """Twelve stored bits of 16: -1 with its sign extended, and 5 with the lowest bit above set."""
    values = {0x60000102 + 0x20000 * number: struct.pack("<H", bit) for number, bit in enumerate(overlays)}
    monkeypatch.setattr(stray_bits, "read_elements", lambda file, wanted, force: SimpleNamespace(values=values))
    header: Any = SimpleNamespace(
        bits_allocated=16, bits_stored=12, high_bit=11, signed=True, float_pixels=False, file="a", little_endian=True
    )
    assert stray_bits.find_stray_bits(header, np.array([[-1, 4101]], np.int16), None) == expected


def test_copies_lie_where_the_first_of_them_does():
    """Each slice lies 0.6 of the tolerance beyond the one before: the third is no copy of the first."""
    count = 3
    copies = slices(
        frame_of_reference=["1.2"] * count,
        position_mm=[(0.0, 0.0, 0.6 * SAME_POSITION_MM * number) for number in range(count)],
        di_mm=[1.0] * count,
        dj_mm=[1.0] * count,
        row_cosines=[(1.0, 0.0, 0.0)] * count,
        column_cosines=[(0.0, 1.0, 0.0)] * count,
    )
    assert _sort_copies(copies, lambda one, other: True) == [copies[:2], copies[2:]]
    assert _sort_copies(copies, lambda one, other: False) == [[one] for one in copies]


def test_a_doubt_about_the_order_is_said_once():
    own = headers(1.0, 1.0)
    for header in own:
        header.has_slope = header.has_intercept = True
        header.lossy = header.modality_lut = header.quadruped = False
        header.warnings = ()
        header.di_mm = header.dj_mm = 1.0
    places = SimpleNamespace(copies=0, phases=())
    line = SimpleNamespace(gap_median_mm=None)
    for said, doubt, expected in (([], "A doubt", ["A doubt"]), (["A doubt."], "A doubt", ["A doubt."]), ([], "", [])):
        stack = SimpleNamespace(slices=own, warnings=said, line=line)
        series: Any = SimpleNamespace(kind="stack", stack=stack, places=places, find_doubt=lambda doubt=doubt: doubt)
        assert certificate.collect_series_warnings(series) == expected


@pytest.mark.parametrize(
    ("declared", "coded", "doubtful"),
    [
        (False, None, ""),
        (False, False, ""),
        (True, True, ""),
        (True, None, "no sign"),
        (True, False, "no sign"),
        (False, True, "a sign"),
    ],
)
def test_sign_of_decoded_bits_is_doubted_where_header_and_code_differ(declared, coded, doubtful):
    header: Any = SimpleNamespace(bits_stored=12, signed=declared)
    frame: Any = SimpleNamespace(bits=10, signed=coded)
    stored._settle_sign(header, frame, np.array([[0, 511]], np.int16))  # without the tenth bit both readings agree
    high = np.array([[0, 512]], np.int16)
    stored._settle_sign(header, SimpleNamespace(bits=12, signed=coded), high)  # type: ignore[arg-type]
    if not doubtful:
        stored._settle_sign(header, frame, high)
        return
    with pytest.raises(RefusedInputError, match=f"has 10 bits and {doubtful}, the header says 12 bits with"):
        stored._settle_sign(header, frame, high)


def test_copies_and_kernels_that_are_mixed_are_told():
    def told(copies: int, *kernels: str) -> list[str]:
        own = slices(phase=[(("KVP", "120"), ("ConvolutionKernel", kernel)) for kernel in kernels])
        places = SimpleNamespace(copies=copies, phases=(), interleaved=False)
        series: Any = SimpleNamespace(places=places, phase=None, stack=SimpleNamespace(slices=own) if own else None)
        return certificate._describe_what_was_left(series)

    assert told(0, "B30", "B30") == told(0) == []
    assert told(1, "B30") == ["1 duplicate slice dropped: same place, same pixels as another"]
    assert told(2, "B30", "B70", "B30") == [
        "2 duplicate slices dropped: same place, same pixels as another",
        "ConvolutionKernel differs between slices (2 kernels): sharp and soft are mixed",
    ]
