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

EXPLICIT = _make_encoding(False, True)
SHOWN = [f"bad {number}" for number in range(PROBLEMS_SHOWN)]


def element(tag: int, vr: bytes = b"LO", value: bytes = b"") -> bytes:
    """An element in explicit VR little endian with a short length."""
    return struct.pack("<HH2sH", tag >> 16, tag & 0xFFFF, vr, len(value)) + value


def long_element(tag: int, vr: bytes = b"OB", value: bytes = b"") -> bytes:
    return struct.pack("<HH2sHL", tag >> 16, tag & 0xFFFF, vr, 0, len(value)) + value


def check_tail(tail: bytes) -> None:
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
)
def test_private_and_padding_elements_behind_the_pixels_are_accepted(tail):
    check_tail(tail)


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
def test_bytes_that_are_no_elements_behind_the_pixels_are_told_apart(tail):
    with refused(CorruptFileError, len(tail), "DICOM"):
        check_tail(tail)


@pytest.mark.parametrize("vr", [b"AA", b"DA", b"AZ", b"ZZ", b"LO"])
def test_two_capital_letters_are_a_value_representation(vr):
    assert _Walk(element(0x00100010, vr), 0).read_head(0, 8, EXPLICIT) == (0x00100010, vr, 0, 8)
    assert _looks_implicit(io.BytesIO(element(0x00080005, vr)), 0) is False
    assert restore_start(element(0x00080005, vr)) is not None


@pytest.mark.parametrize("vr", [b"@A", b"A@", b"[A", b"A[", b"aa"])
def test_other_bytes_are_no_value_representation(vr):
    with refused(ValueProblem, "VR"):
        _Walk(element(0x00100010, vr), 0).read_head(0, 8, EXPLICIT)
    assert _looks_implicit(io.BytesIO(element(0x00080005, vr)), 0) is True


def test_head_of_pixel_data_is_read_or_left_open():
    assert read_pixel_head(b"", 500, False, True) == (None, -1, 0, "")
    assert read_pixel_head(element(0x7FE10010), 500, False, True) == (None, -1, 0, "")
    assert read_pixel_head(long_element(0x7FE00010, b"OW", bytes(4))[:12], 500, False, True) == (
        0x7FE00010,
        512,
        4,
        "OW",
    )
    head = struct.pack("<HHL", 0x7FE0, 0x0010, 0xFFFFFFFF) + bytes(4)
    assert read_pixel_head(head, 500, True, True) == (0x7FE00010, 508, -1, "")


def fragments(count: int) -> io.BytesIO:
    items = struct.pack("<HHL", 0xFFFE, 0xE000, 0) * count
    return io.BytesIO(items + struct.pack("<HHL", 0xFFFE, 0xE0DD, 0))


def test_more_than_a_thousand_fragments_a_frame_and_a_thousand_are_refused():
    """The first item is the table of offsets; a frame in RLE may have several fragments."""
    file = fragments(2000)
    assert [len(pieces) for pieces in transfer_syntaxes.find_frames(file, 0, len(file.getvalue()), 1, RLE)] == [1999]
    file = fragments(2001)
    with refused(RefusedInputError, 2000):
        transfer_syntaxes.find_frames(file, 0, len(file.getvalue()), 1, RLE)


def test_a_table_of_offsets_tells_the_first_fragment_of_each_frame():
    table = struct.pack("<3L", 0, 20, 30)
    pieces = [(100, 2), (110, 2), (120, 2), (130, 2)]
    assert transfer_syntaxes._firsts_by_table(io.BytesIO(table), (0, 12), pieces, 3) == [0, 2, 3]
    for offsets in ((10, 20, 30), (0, 20, 20), (0, 30, 20), (0, 5, 20)):
        file = io.BytesIO(struct.pack("<3L", *offsets))
        assert transfer_syntaxes._firsts_by_table(file, (0, 12), pieces, 3) == []
    assert transfer_syntaxes._firsts_by_table(io.BytesIO(table), (0, 12), pieces, 2) == []


@pytest.mark.parametrize(("more", "said"), [(0, False), (1, True), (2, True)])
def test_an_even_number_of_bytes_has_no_byte_of_padding(tmp_path, more, said):
    """32 bytes of pixels; a rest of zeros is told from its first byte on."""
    (tmp_path / "a").write_bytes(b"\1" * 40 + bytes(32 + more))
    header: Any = SimpleNamespace(
        transfer_syntax="1.2.840.10008.1.2.1",
        **{"frames": 1, "pixel_bytes": 32, "pixel_offset": 40, "pixel_length": 32 + more, "file_bytes": 72 + more},
        **{"inflate_from": -1, "rows": 4, "columns": 4, "bits_allocated": 16, "signed": True, "float_pixels": False},
        **{"little_endian": True, "file": tmp_path / "a"},
    )
    warnings = check_surplus(SimpleNamespace(), header)  # type: ignore[arg-type]
    assert [f"Pixel Data has {32 + more} bytes" in text and "taken as padding" in text for text in warnings] == (
        [True] * said
    )


@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (5, 0), (0, 0)])
def test_images_without_rows_or_columns_are_refused(rows, columns):
    _check_matrix(1, "MONOCHROME2", 1, 1)
    with refused(ValueProblem, rows, columns):
        _check_matrix(1, "MONOCHROME2", rows, columns)


def values_of(**raw: tuple[int, bytes, str]) -> Values:
    elements: Any = SimpleNamespace(
        values={tag: value for tag, value, _ in raw.values()},
        vrs={tag: vr for tag, _, vr in raw.values()},
        little_endian=True,
    )
    return Values(elements)


def test_a_single_slice_may_say_that_it_has_one_frame():
    for text in (b"", b"0 ", b"1 "):
        assert count_frames(values_of(frames=(0x00280008, text, "IS")), "1.2") == 1
    assert count_frames(values_of(frames=(0x00280008, b"2 ", "IS")), "1.2") == 2
    with refused(ValueProblem, 65537, "image"):
        count_frames(values_of(frames=(0x00280008, b"65537", "IS")), "1.2")


def test_unsigned_numbers_have_two_bytes_or_four_as_ul():
    assert values_of(rows=(0x00280010, b"\1\2", "US")).unsigned("Rows") == 513
    assert values_of(rows=(0x00280010, b"\1\2\0\0", "UL")).unsigned("Rows") == 513
    for raw, vr in ((b"\1\2\0\0", "US"), (b"\1\2", "UL"), (b"\1\2\0\0\0", "UL"), (b"\1", "US")):
        with refused(ValueProblem, "Rows", "number"):
            values_of(rows=(0x00280010, raw, vr)).unsigned("Rows")


def test_padding_values_are_binary_numbers():
    for raw, vr in ((b"\x30\xf8", "SS"), (b"\x30\xf8", "US"), (b"\x30\xf8\xff\xff", "UL"), (b"\x30\xf8", "OW")):
        assert values_of(padding=(0x00280120, raw, vr)).padding(16, 16, True) == (-2000, -2000)
    for raw, vr in ((b"-2", "IS"), (b"-2000 ", "DS"), (b"\x30\xf8\xff\xff", "US"), (b"\x30", "US"), (b"\0\0\0", "OW")):
        with refused(ValueProblem, "number"):
            values_of(padding=(0x00280120, raw, vr)).padding(16, 16, True)


def test_tags_of_overlays_are_the_sixteen_even_groups():
    assert [f"{tag:08X}" for tag in OVERLAY_BITS] == [f"60{group:02X}0102" for group in range(0, 32, 2)]
    assert describe_stray_bits([None], [SimpleNamespace()]) == (0, "")  # type: ignore[list-item]


def test_elements_that_converters_leave_over_are_listed_and_the_data_set_found():
    assert {keyword_for_tag(tag) for tag in multiframe._UNASSIGNED} == {
        *("AcquisitionDate", "ContentDate", "AcquisitionTime", "ContentTime", "KVP", "TriggerTime"),
        *("ConvolutionKernel", "AcquisitionNumber", "TemporalPositionIdentifier", "PixelPaddingValue"),
        *("PixelPaddingRangeLimit", "RescaleIntercept", "RescaleSlope", "RescaleType", "LossyImageCompression"),
    }
    meta = element(0x00020010, b"UI", b"1.2.840.10008.1.2.1\0") + long_element(0x00020102, b"OB", b"abc\0")
    assert multiframe.find_data_set(bytes(132) + meta + element(0x00080005, b"CS")) == 132 + len(meta)
    assert multiframe.find_data_set(bytes(140)) == 132


def test_a_header_of_more_than_256_mib_is_not_read():
    with refused(ValueProblem, 268435457, 268435456):
        multiframe._read_header_bytes(Path("none"), SimpleNamespace(pixel_offset=2**28 + 1))  # type: ignore[arg-type]
    with pytest.raises(OSError):
        multiframe._read_header_bytes(Path("none"), SimpleNamespace(pixel_offset=2**28))  # type: ignore[arg-type]


@pytest.mark.parametrize("tag", sorted(plain.SEQUENCE_TAGS)[::9])
def test_known_sequences_of_undefined_length_are_sequences_in_implicit_vr(tag):
    key = (tag & 0xFFFF) << 16 | tag >> 16
    assert plain._is_sequence(b"", 0, key)
    assert not plain._is_sequence(bytes(4), 0, key ^ 0x40000000)
    private = struct.unpack("<L", struct.pack("<HH", 0x0009, 0x1001))[0]
    assert plain._is_sequence(struct.pack("<HH", 0xFFFE, 0xE000), 0, private)
    assert not plain._is_sequence(bytes(4), 0, private)


def box(kind: bytes, value: bytes, form: str) -> bytes:
    if form == "long":
        return struct.pack(">L4sQ", 1, kind, 16 + len(value)) + value
    return struct.pack(">L4s", 0 if form == "to the end" else 8 + len(value), kind) + value


@pytest.mark.parametrize("form", ["short", "long", "to the end"])
@pytest.mark.parametrize("before", ["short", "long"])
def test_codestream_in_a_jp2_file_is_found(form, before):
    start = stored._JP2_START + box(b"ftyp", b"jp2 12", before)
    after = b"" if form == "to the end" else box(b"uuid", b"more", "short")
    assert stored._unwrap_jp2(start + box(b"jp2c", b"\xff\x4f\xff\x51 codes", form) + after) == (
        b"\xff\x4f\xff\x51 codes"
    )
    for data in (start, start + bytes(7), start + struct.pack(">L4s", 7, b"uuid") + bytes(20)):
        with refused(RefusedInputError, "JP2"):
            stored._unwrap_jp2(data)


def test_replies_of_decoders_are_written_whole():
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
        ("stack", PROBLEMS_SHOWN, [f"bad {n}" for n in range(PROBLEMS_SHOWN)]),
        (
            "stack",
            PROBLEMS_SHOWN + 2,
            [f"bad {n}" for n in range(PROBLEMS_SHOWN)] + ["and 2 more files with a problem"],
        ),
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


def worker(*replies: tuple[int, int]) -> Any:
    """A process that answers with these statuses and counts."""
    answers = iter(replies)
    made = SimpleNamespace(ready=False, why=None, deadline=0.0, _settings={}, _write=lambda data: None)
    made._read_reply = lambda: next(answers)
    made._read_text = lambda count: f"{count} letters"
    made._read_into = lambda target: target.__setitem__(slice(None), bytes(range(len(target))))
    return made


def test_a_decoder_answers_with_as_many_bytes_as_it_was_asked_for():
    out = np.zeros(4, np.uint16)
    ask = decoder_pool._Worker.ask
    assert ask(worker((READY, 0), (DONE, 8)), {}, b"", out, 1.0) == (DONE, "")
    assert out.view(np.uint8).tolist() == list(range(8))
    for count in (7, 9):
        with pytest.raises(decoder_pool._WorkerEndedError):
            ask(worker((READY, 0), (DONE, count)), {}, b"", out, 1.0)
    for status in (FAILED, NO_MEMORY):
        assert ask(worker((READY, 0), (status, 5)), {}, b"", out, 1.0) == (status, "5 letters")


def test_worker_that_ends_says_why_only_without_a_decoder():
    for status, why in ((NO_DECODER, "5 letters"), (FAILED, ""), (NO_MEMORY, ""), (DONE, "")):
        process = worker((status, 5))
        with pytest.raises(decoder_pool._WorkerEndedError):
            decoder_pool._Worker.ask(process, {}, b"", np.zeros(4, np.uint16), 1.0)
        assert (process.why, process.ready) == (why, False)


def test_all_elements_are_kept_where_none_are_named():
    meta = element(0x00020010, b"UI", b"1.2.840.10008.1.2.1\0")
    own = element(0x00080060, b"CS", b"CT") + element(0x00090010, b"LO", b"us") + element(0x00180060, b"DS", b"120 ")
    data = bytes(128) + b"DICM" + meta + own + long_element(0x7FE00010, b"OW", bytes(4))
    found = plain.parse_plainly(data, len(data), None)
    assert found is not None
    assert found.values == {0x00080060: b"CT", 0x00090010: b"us", 0x00180060: b"120 "}
    some = plain.parse_plainly(data, len(data), (0x00080005, 0x00180060))
    assert some is not None
    assert (some.values, some.vrs) == ({0x00180060: b"120 "}, {0x00180060: "DS"})


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
def test_larger_stacks_that_cannot_be_used_are_told(kind, count, problems, said):
    identity = SimpleNamespace(modality="SR")
    other: Any = SimpleNamespace(
        kind=kind, count=count, problems=problems, describe=lambda: "2: CT", key="b", identity=identity, headers=()
    )
    chosen: Any = SimpleNamespace(count=5, number=1, key="a")
    taken = choice.Choice(chosen, "by lot")
    assert choice.describe_left([chosen, other], taken) == said
    assert choice.describe_left([chosen], taken) == choice.describe_left([chosen, other], taken, "2") == []


@pytest.mark.parametrize(
    ("kind", "modality", "key", "told"),
    [
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
def test_files_that_may_be_harmed_slices_are_told(kind, modality, key, told, wanted):
    """A slice that lost its modality, its UID or its class leaves no hole at the end of a stack."""
    identity = SimpleNamespace(modality=modality)
    other: Any = SimpleNamespace(kind=kind, count=1, problems=[], describe=lambda: "2: x", key=key, identity=identity)
    other.headers = [SimpleNamespace(row_cosines=(1.0, 0.0, 0.0), column_cosines=(0.0, 1.0, 0.0))]
    chosen: Any = SimpleNamespace(kind="stack", count=5, number=1, key="a", headers=other.headers)
    said = ["not used, though they may be harmed slices of series 1: [2: x]"]
    assert choice.describe_left([chosen, other], choice.Choice(chosen, ""), wanted) == (said if told else [])


def test_a_scout_of_the_same_series_that_runs_across_is_not_told():
    def header(row, column):
        return [SimpleNamespace(row_cosines=row, column_cosines=column)]

    scout: Any = SimpleNamespace(kind="localizer", key="a", headers=header((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    chosen: Any = SimpleNamespace(kind="stack", key="a", headers=header((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    assert choice.describe_left([chosen, scout], choice.Choice(chosen, "")) == []
