"""Bytes of headers at their limits: heads of elements, tails of files, items without end; without files."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydicom.datadict import keyword_for_tag
from refusals import refused

from clrecon.errors import RefusedInputError
from clrecon.reading.dicom.headers import multiframe
from clrecon.reading.dicom.headers.header import _check_matrix
from clrecon.reading.dicom.headers.multiframe import count_frames
from clrecon.reading.dicom.headers.surplus import _check_tail, check_surplus
from clrecon.reading.dicom.parse import plain, transfer_syntaxes
from clrecon.reading.dicom.parse.elements import _looks_implicit, restore_start
from clrecon.reading.dicom.parse.plain import CorruptFileError, read_pixel_head
from clrecon.reading.dicom.parse.transfer_syntaxes import RLE
from clrecon.reading.dicom.parse.values import ValueProblem, Values, _make_encoding, _Walk
from clrecon.reading.dicom.pixels import decoder_pool, stored
from clrecon.reading.dicom.pixels.decoder_process import DONE, FAILED, NO_DECODER, NO_MEMORY, READY, REPLY, send
from clrecon.reading.dicom.pixels.voxels import OVERLAY_BITS, describe_stray_bits
from clrecon.reading.dicom.series import choice
from clrecon.reading.dicom.series.series import PROBLEMS_SHOWN, Series

pytestmark = pytest.mark.unit

EXPLICIT = _make_encoding(implicit=False, little=True)
SHOWN = [f"bad {number}" for number in range(PROBLEMS_SHOWN)]


def element(tag: int, vr: bytes = b"LO", value: bytes = b"") -> bytes:
    """An element in explicit VR little endian with a short length."""
    return struct.pack("<HH2sH", tag >> 16, tag & 0xFFFF, vr, len(value)) + value


def long_element(tag: int, vr: bytes = b"OB", value: bytes = b"") -> bytes:
    return struct.pack("<HH2sHL", tag >> 16, tag & 0xFFFF, vr, 0, len(value)) + value


def check_tail(tail: bytes) -> None:
    """Look at the bytes behind pixels that end at byte 20."""
    _check_tail(io.BytesIO(bytes(20) + tail), 20, 20 + len(tail), implicit=False, little_endian=True)


@pytest.mark.parametrize(
    "tail",
    [
        element(0x7FE10010),  # eight bytes, the shortest element
        element(0x7FE10010, value=b"AB") + element(0x7FE10011),
        long_element(0xFFFCFFFC, value=bytes(6)),
        element(0x7FE10010) + long_element(0xFFFCFFFC),
        long_element(0xFFFCFFFB) + long_element(0xFFFCFFFD),
    ],
    ids=["shortest", "two", "padding", "private and padding", "around padding"],
)
def test_private_and_padding_elements_behind_the_pixels_are_accepted(tail):
    check_tail(tail)
    with refused(CorruptFileError, len(tail) - 1, "DICOM"):
        check_tail(tail[:-1])  # a byte less is no element


@pytest.mark.parametrize(
    "tail",
    [
        element(0x7FE10010)[:-1],
        element(0x7FE10010) + element(0x7FE10010),
        element(0x7FE00010),
        element(0x7FE10010, value=b"AB")[:-1],
        long_element(0xFFFCFFFC) + element(0xFFFDFFFD),  # nothing follows the trailing padding
        element(0x7FE10010, vr=b"Z["),
        element(0x7FE10010, vr=b"@A"),
        long_element(0x7FE10010)[:-1],
    ],
    ids=["cut", "two", "before", "cut-value", "after-padding", "no-letter", "no-capital", "cut-long"],
)
def test_bytes_behind_the_pixels_that_are_no_elements_are_refused(tail):
    with refused(CorruptFileError, len(tail), "DICOM"):
        check_tail(tail)


CAPITALS = pytest.mark.parametrize("vr", [b"AA", b"DA", b"AZ", b"ZZ", b"LO"])


@CAPITALS
def test_head_with_two_capital_letters_has_them_as_value_representation(vr):
    head = _Walk(element(0x00100010, vr), items_limit=0).read_head(position=0, end=8, encoding=EXPLICIT)
    assert head == (0x00100010, vr, 0, 8)  # with a length of 0, and its value from byte 8 on


@CAPITALS
def test_data_set_whose_first_head_has_two_capital_letters_is_explicit(vr):
    assert _looks_implicit(io.BytesIO(element(0x00080005, vr)), 0) is False
    assert restore_start(element(0x00080005, vr)) is not None


NO_CAPITALS = pytest.mark.parametrize("vr", [b"@A", b"A@", b"[A", b"A[", b"aa"])


@NO_CAPITALS
def test_head_without_two_capital_letters_is_refused_in_explicit_vr(vr):
    with refused(ValueProblem, "VR"):
        _Walk(element(0x00100010, vr), items_limit=0).read_head(position=0, end=8, encoding=EXPLICIT)


@NO_CAPITALS
def test_data_set_whose_first_head_has_no_two_capital_letters_is_implicit(vr):
    assert _looks_implicit(io.BytesIO(element(0x00080005, vr)), 0) is True


@pytest.mark.parametrize("start", [b"", element(0x7FE10010)], ids=["nothing", "another element"])
def test_start_that_is_no_head_of_pixel_data_is_left_open(start):
    assert read_pixel_head(start, 500, implicit=False, little=True) == (None, -1, 0, "")


def test_head_of_pixel_data_in_explicit_vr_has_tag_place_length_and_vr():
    head = long_element(0x7FE00010, b"OW", bytes(4))[:12]
    assert read_pixel_head(head, 500, implicit=False, little=True) == (0x7FE00010, 500 + len(head), 4, "OW")


def test_head_of_pixel_data_of_undefined_length_in_implicit_vr_has_length_minus_1():
    head = struct.pack("<HHL", 0x7FE0, 0x0010, 0xFFFFFFFF)
    assert read_pixel_head(head + bytes(4), 500, implicit=True, little=True) == (0x7FE00010, 500 + len(head), -1, "")


def fragments(count: int) -> io.BytesIO:
    """So many empty items, which one frame in RLE may have, and the end mark."""
    items = struct.pack("<HHL", 0xFFFE, 0xE000, 0) * count
    return io.BytesIO(items + struct.pack("<HHL", 0xFFFE, 0xE0DD, 0))


MOST_ITEMS = 1000 * (1 + 1)
"""A thousand a frame, of which there is one, and as many beside them; the first item is the table of offsets."""


def test_frame_of_1999_fragments_is_found():
    file = fragments(MOST_ITEMS)
    size = len(file.getvalue())
    frames = transfer_syntaxes.find_frames(file, start=0, file_bytes=size, frames=1, transfer_syntax=RLE)
    assert [len(pieces) for pieces in frames] == [1999]


def test_frame_of_2000_fragments_is_refused():
    file = fragments(MOST_ITEMS + 1)
    with refused(RefusedInputError, MOST_ITEMS):
        transfer_syntaxes.find_frames(file, start=0, file_bytes=len(file.getvalue()), frames=1, transfer_syntax=RLE)


FRAGMENTS = [(100, 2), (110, 2), (120, 2), (130, 2)]
"""Places and lengths; each begins 10 bytes behind the one before."""


def firsts_by_table(*offsets, frames=3):
    table = io.BytesIO(struct.pack(f"<{len(offsets)}L", *offsets))
    return transfer_syntaxes._firsts_by_table(table, (0, 4 * len(offsets)), FRAGMENTS, frames)


def test_table_of_offsets_gives_the_first_fragment_of_each_frame():
    assert firsts_by_table(0, 20, 30) == [0, 2, 3]


@pytest.mark.parametrize(
    "offsets",
    [(10, 20, 30), (0, 20, 20), (0, 30, 20), (0, 5, 20)],
    ids=["not from 0", "one twice", "falling", "within a fragment"],
)
def test_table_of_impossible_offsets_gives_no_fragments(offsets):
    assert firsts_by_table(*offsets) == []


def test_table_of_offsets_of_another_number_of_frames_gives_no_fragments():
    assert firsts_by_table(0, 20, 30, frames=2) == []


@pytest.mark.parametrize(("more", "is_warned_of"), [(0, False), (1, True), (2, True)])
def test_zeros_behind_an_even_number_of_pixel_bytes_are_warned_of_from_the_first_on(tmp_path, more, is_warned_of):
    """32 bytes of pixels: an odd number would have one byte of padding."""
    (tmp_path / "a").write_bytes(b"\1" * 40 + bytes(32 + more))
    header: Any = SimpleNamespace(
        transfer_syntax="1.2.840.10008.1.2.1",
        **{"frames": 1, "pixel_bytes": 32, "pixel_offset": 40, "pixel_length": 32 + more, "file_bytes": 72 + more},
        **{"inflate_from": -1, "rows": 4, "columns": 4, "bits_allocated": 16, "signed": True, "float_pixels": False},
        **{"little_endian": True, "file": tmp_path / "a"},
    )
    warnings = check_surplus(SimpleNamespace(), header)  # type: ignore[arg-type]
    assert len(warnings) == is_warned_of
    assert all(f"Pixel Data has {32 + more} bytes" in text and "taken as padding" in text for text in warnings)


@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (5, 0), (0, 0)])
def test_image_without_rows_or_columns_is_refused(rows, columns):
    with refused(ValueProblem, rows, columns):
        _check_matrix(1, "MONOCHROME2", rows=rows, columns=columns)


def test_image_of_one_pixel_is_accepted():
    assert _check_matrix(1, "MONOCHROME2", rows=1, columns=1) is None


def values_of(**raw: tuple[int, bytes, str]) -> Values:
    elements: Any = SimpleNamespace(
        values={tag: value for tag, value, _ in raw.values()},
        vrs={tag: vr for tag, _, vr in raw.values()},
        little_endian=True,
    )
    return Values(elements)


@pytest.mark.parametrize(
    ("text", "frames"), [(b"", 1), (b"0 ", 1), (b"1 ", 1), (b"2 ", 2)], ids=["empty", "0", "1", "2"]
)
def test_number_of_frames_is_at_least_one(text, frames):
    assert count_frames(values_of(frames=(0x00280008, text, "IS")), sop_class="1.2") == frames


def test_number_of_frames_beyond_65536_is_refused():
    with refused(ValueProblem, 65537, "image"):
        count_frames(values_of(frames=(0x00280008, b"65537", "IS")), sop_class="1.2")


@pytest.mark.parametrize(("raw", "vr"), [(b"\1\2", "US"), (b"\1\2\0\0", "UL")], ids=["US", "UL"])
def test_unsigned_number_of_two_bytes_or_of_four_as_ul_is_read(raw, vr):
    assert values_of(rows=(0x00280010, raw, vr)).unsigned("Rows") == 1 + 2 * 256


@pytest.mark.parametrize(
    ("raw", "vr"),
    [(b"\1\2\0\0", "US"), (b"\1\2", "UL"), (b"\1\2\0\0\0", "UL"), (b"\1", "US")],
    ids=["US of 4", "UL of 2", "UL of 5", "US of 1"],
)
def test_unsigned_number_of_another_length_is_refused(raw, vr):
    with refused(ValueProblem, "Rows", "number"):
        values_of(rows=(0x00280010, raw, vr)).unsigned("Rows")


@pytest.mark.parametrize(
    ("raw", "vr"), [(b"\x30\xf8", "SS"), (b"\x30\xf8", "US"), (b"\x30\xf8\xff\xff", "UL"), (b"\x30\xf8", "OW")]
)
def test_padding_value_is_read_as_signed_from_ss_us_ul_and_ow(raw, vr):
    values = values_of(padding=(0x00280120, raw, vr))
    assert values.padding(bits_allocated=16, bits_stored=16, signed=True) == (-2000, -2000)  # lowest and highest


@pytest.mark.parametrize(
    ("raw", "vr"),
    [(b"-2", "IS"), (b"-2000 ", "DS"), (b"\x30\xf8\xff\xff", "US"), (b"\x30", "US"), (b"\0\0\0", "OW")],
    ids=["IS", "DS", "US of 4", "US of 1", "OW of 3"],
)
def test_padding_value_that_is_text_or_of_another_length_is_refused(raw, vr):
    with refused(ValueProblem, "number"):
        values_of(padding=(0x00280120, raw, vr)).padding(bits_allocated=16, bits_stored=16, signed=True)


def test_elements_with_the_bits_of_overlays_are_those_of_the_sixteen_even_groups():
    assert [f"{tag:08X}" for tag in OVERLAY_BITS] == [f"60{group:02X}0102" for group in range(0, 32, 2)]


def test_slices_without_stray_bits_have_no_text_about_them():
    assert describe_stray_bits([None], [SimpleNamespace()]) == (0, "")  # type: ignore[list-item]


def test_elements_that_converters_leave_unassigned_are_those_that_are_read_of_classic_slices():
    assert {keyword_for_tag(tag) for tag in multiframe._UNASSIGNED} == {
        *("AcquisitionDate", "ContentDate", "AcquisitionTime", "ContentTime", "KVP", "TriggerTime"),
        *("ConvolutionKernel", "AcquisitionNumber", "TemporalPositionIdentifier", "PixelPaddingValue"),
        *("PixelPaddingRangeLimit", "RescaleIntercept", "RescaleSlope", "RescaleType", "LossyImageCompression"),
    }


def test_data_set_begins_behind_the_meta_header_or_the_mark():
    meta = element(0x00020010, b"UI", b"1.2.840.10008.1.2.1\0") + long_element(0x00020102, b"OB", b"abc\0")
    behind_mark = 132
    assert multiframe.find_data_set(bytes(132) + meta + element(0x00080005, b"CS")) == behind_mark + len(meta)
    assert multiframe.find_data_set(bytes(140)) == behind_mark


def test_header_of_more_than_256_mib_is_refused_before_its_file_is_opened():
    with refused(ValueProblem, 2**28 + 1, 2**28):
        multiframe._read_header_bytes(Path("none"), SimpleNamespace(pixel_offset=2**28 + 1))  # type: ignore[arg-type]


def test_file_of_a_header_of_256_mib_is_opened():
    with refused(OSError, "none"):  # there is no such file
        multiframe._read_header_bytes(Path("none"), SimpleNamespace(pixel_offset=2**28))  # type: ignore[arg-type]


@pytest.mark.parametrize("tag", sorted(plain.SEQUENCE_TAGS)[::9])
def test_known_sequence_of_undefined_length_is_one_in_implicit_vr(tag):
    key = (tag & 0xFFFF) << 16 | tag >> 16  # group and element as they stand in a file
    assert plain._is_sequence(b"", 0, key)
    assert not plain._is_sequence(bytes(4), 0, key ^ 0x40000000)  # another element


def test_private_element_of_undefined_length_is_a_sequence_where_an_item_follows():
    private = 0x1001 << 16 | 0x0009
    item_tag = struct.pack("<HH", 0xFFFE, 0xE000)
    assert plain._is_sequence(item_tag, 0, private)
    assert not plain._is_sequence(bytes(4), 0, private)


def box(kind: bytes, value: bytes, *, form: str) -> bytes:
    if form == "long":
        return struct.pack(">L4sQ", 1, kind, 16 + len(value)) + value
    return struct.pack(">L4s", 0 if form == "to the end" else 8 + len(value), kind) + value


@pytest.mark.parametrize("form", ["short", "long", "to the end"])
@pytest.mark.parametrize("before", ["short", "long"])
def test_codestream_in_a_jp2_file_is_found(form, before):
    codestream = b"\xff\x4f\xff\x51 codes"
    start = stored._JP2_START + box(b"ftyp", b"jp2 12", form=before)
    after = b"" if form == "to the end" else box(b"uuid", b"more", form="short")
    assert stored._unwrap_jp2(start + box(b"jp2c", codestream, form=form) + after) == codestream


@pytest.mark.parametrize(
    "rest",
    [b"", bytes(7), struct.pack(">L4s", 7, b"uuid") + bytes(20)],
    ids=["nothing", "half a head", "length below 8"],
)
def test_jp2_file_without_a_codestream_is_refused(rest):
    start = stored._JP2_START + box(b"ftyp", b"jp2 12", form="short")
    with refused(RefusedInputError, "JP2"):
        stored._unwrap_jp2(start + rest)


def test_reply_of_a_decoder_is_written_whole_to_a_full_pipe():
    class Narrow(io.BytesIO):
        """Takes three bytes at a time, as a pipe that is full may do."""

        def write(self, part: Any) -> int:
            return super().write(bytes(part[:3]))

    sink = Narrow()
    send(sink, 7, b"a text of some length")
    assert sink.getvalue() == struct.pack(REPLY, 7, 21) + b"a text of some length"


@pytest.mark.parametrize(
    ("kind", "bad", "expected"),
    [
        ("stack", 0, ["lost", "hole"]),
        ("stack", 1, ["bad 0"]),  # what it leaves would only hide the cause
        ("localizer", 0, ["localizer images, not a stack", "lost"]),
        ("localizer", 1, ["bad 0", "localizer images, not a stack"]),
        ("stack", PROBLEMS_SHOWN, SHOWN),
        ("stack", PROBLEMS_SHOWN + 1, [*SHOWN, "and 1 more file with a problem"]),
        ("stack", PROBLEMS_SHOWN + 2, [*SHOWN, "and 2 more files with a problem"]),
    ],
)
def test_problems_of_a_series_are_listed_without_those_that_hide_the_cause(kind, bad, expected):
    series = SimpleNamespace(
        kind=kind,
        others=[SimpleNamespace(problem=f"bad {number}") for number in range(bad)],
        corrupt=[],
        lost=["lost"],
        is_file=False,
        _find_stack_problems=lambda: ["hole"],
    )
    assert Series.problems.func(series) == expected  # type: ignore[attr-defined]


def worker_that_answers(*replies: tuple[int, int]) -> Any:
    """A process that answers with these statuses and counts."""
    answers = iter(replies)
    made = SimpleNamespace(ready=False, why=None, deadline=0.0, _settings={}, _write=lambda data: None)
    made._read_reply = lambda: next(answers)
    made._read_text = lambda count: f"{count} letters"
    made._read_into = lambda target: target.__setitem__(slice(None), bytes(range(len(target))))
    return made


def ask_for_pixels(worker: Any, out: np.ndarray) -> tuple[int, str]:
    """Status and text of the answer; the pixels go into `out`."""
    return decoder_pool._Worker.ask(worker, request={}, data=b"", out=out, seconds=1.0)


def test_pixels_of_a_decoder_are_written_into_the_array_that_was_given():
    out = np.zeros(4, np.uint16)
    assert ask_for_pixels(worker_that_answers((READY, 0), (DONE, 8)), out) == (DONE, "")
    assert out.view(np.uint8).tolist() == list(range(8))


@pytest.mark.parametrize("count", [7, 9], ids=["a byte less", "a byte more"])
def test_decoder_that_answers_with_another_number_of_bytes_is_given_up_and_nothing_written(count):
    out = np.zeros(4, np.uint16)
    with pytest.raises(decoder_pool._WorkerEndedError):
        ask_for_pixels(worker_that_answers((READY, 0), (DONE, count)), out)
    assert not out.any()


@pytest.mark.parametrize("status", [FAILED, NO_MEMORY], ids=["failed", "no memory"])
def test_decoder_that_fails_answers_with_its_text(status):
    worker = worker_that_answers((READY, 0), (status, 5))
    assert ask_for_pixels(worker, np.zeros(4, np.uint16)) == (status, "5 letters")


@pytest.mark.parametrize(
    ("status", "why"),
    [(NO_DECODER, "5 letters"), (FAILED, ""), (NO_MEMORY, ""), (DONE, "")],
    ids=["no decoder", "failed", "no memory", "done"],
)
def test_worker_that_ends_before_it_is_ready_keeps_its_text_only_without_a_decoder(status, why):
    worker = worker_that_answers((status, 5))
    with pytest.raises(decoder_pool._WorkerEndedError):
        ask_for_pixels(worker, np.zeros(4, np.uint16))
    assert (worker.why, worker.ready) == (why, False)


def parse_three_elements(wanted):
    """A file with modality, a private element and tube voltage, of which these tags are wanted."""
    meta = element(0x00020010, b"UI", b"1.2.840.10008.1.2.1\0")
    three = element(0x00080060, b"CS", b"CT") + element(0x00090010, b"LO", b"us") + element(0x00180060, b"DS", b"120 ")
    data = bytes(128) + b"DICM" + meta + three + long_element(0x7FE00010, b"OW", bytes(4))
    parsed = plain.parse_plainly(data, len(data), wanted)
    assert parsed is not None
    return parsed


def test_all_elements_are_kept_where_none_are_named():
    assert parse_three_elements(None).values == {0x00080060: b"CT", 0x00090010: b"us", 0x00180060: b"120 "}


def test_only_the_named_elements_are_kept():
    not_in_the_file = 0x00080005
    parsed = parse_three_elements((not_in_the_file, 0x00180060))
    assert (parsed.values, parsed.vrs) == ({0x00180060: b"120 "}, {0x00180060: "DS"})


@pytest.mark.parametrize(
    ("kind", "count", "problems", "said"),
    [
        ("stack", 5, ["bad"], ["1 other CT series not used: [2: CT, cannot be used]; series 1 is read, by lot"]),
        ("stack", 4, ["bad"], ["1 other CT series not used: [2: CT]; series 1 is read, by lot"]),  # smaller
        ("stack", 9, [], ["1 other CT series not used: [2: CT]; series 1 is read, by lot"]),
        ("localizer", 9, ["bad"], []),
        ("capture", 9, ["bad"], []),
        ("other", 9, ["bad"], []),
    ],
)
def test_other_stacks_are_warned_of_and_larger_faulty_ones_as_not_usable(kind, count, problems, said):
    identity = SimpleNamespace(modality="SR")
    other: Any = SimpleNamespace(
        kind=kind, count=count, problems=problems, describe=lambda: "2: CT", key="b", identity=identity, headers=()
    )
    chosen: Any = SimpleNamespace(count=5, number=1, key="a")
    taken = choice.Choice(chosen, "by lot")
    assert choice.describe_left([chosen, other], taken) == said
    assert choice.describe_left([chosen], taken) == choice.describe_left([chosen, other], taken, wanted="2") == []


@pytest.mark.parametrize(
    ("kind", "modality", "key", "told"),
    [  # the chosen series has the key "a"
        ("other", "unknown", "b", True),
        ("other", "other", "b", True),
        ("other", "SR", "b", False),
        ("other", "SR", "a", True),
        ("capture", "CT", "a", True),
        ("capture", "CT", "b", False),
        ("localizer", "CT", "a", True),
        ("localizer", "CT", "b", False),
    ],
)
@pytest.mark.parametrize("wanted", [None, "1"])
def test_series_that_may_be_harmed_slices_of_the_chosen_one_are_warned_of(kind, modality, key, told, wanted):
    """A slice that lost its modality, its UID or its class leaves no hole at the end of a stack."""
    identity = SimpleNamespace(modality=modality)
    other: Any = SimpleNamespace(kind=kind, count=1, problems=[], describe=lambda: "2: x", key=key, identity=identity)
    other.headers = [SimpleNamespace(row_cosines=(1.0, 0.0, 0.0), column_cosines=(0.0, 1.0, 0.0))]
    chosen: Any = SimpleNamespace(kind="stack", count=5, number=1, key="a", headers=other.headers)
    said = ["not used, though they may be harmed slices of series 1: [2: x]"]
    assert choice.describe_left([chosen, other], choice.Choice(chosen, ""), wanted) == (said if told else [])


def test_localizer_of_the_same_series_that_runs_across_is_not_warned_of():
    def header(row, column):
        return [SimpleNamespace(row_cosines=row, column_cosines=column)]

    scout: Any = SimpleNamespace(kind="localizer", key="a", headers=header((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    chosen: Any = SimpleNamespace(kind="stack", key="a", headers=header((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    assert choice.describe_left([chosen, scout], choice.Choice(chosen, "")) == []
