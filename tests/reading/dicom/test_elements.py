"""The plain parser answers what the careful one (pydicom) answers, or nothing; reads of the start of a file."""

from __future__ import annotations

import io
import os
import random
import struct
import subprocess
import sys
import warnings
from pathlib import Path

import pydicom
import pytest
from dicom_series import Plan, make_dataset, save_dataset, write_series
from pydicom.datadict import DicomDictionary
from pydicom.uid import UID, DeflatedExplicitVRLittleEndian, ExplicitVRBigEndian, ImplicitVRLittleEndian
from pydicom.valuerep import EXPLICIT_VR_LENGTH_16, EXPLICIT_VR_LENGTH_32

from clrecon.reading import list_series, read_volume
from clrecon.reading.dicom.parse import elements, plain
from clrecon.reading.dicom.parse import transfer_syntaxes as codecs
from clrecon.reading.dicom.parse.elements import parse_carefully
from clrecon.reading.dicom.parse.plain import CorruptFileError
from clrecon.reading.dicom.parse.values import WANTED_TAGS

CORPUS = Path(pydicom.__file__).parent / "data" / "test_files"
MUTATIONS = 6000
TOKENS = [
    bytes.fromhex(digits)
    for digits in (
        "feff00e0 feff0de0 feffdde0 feff00e0ffffffff feff0de000000000 feffdde000000000 ffffffff e07f1000 e07f0800"
        " 08000500 53510000ffffffff 554e0000ffffffff e17f1000 4f57 554e 0000 1000"
    ).split()
]
"""What mutations put in: delimiters, undefined lengths, pixel tags, a character set, value representations."""


def assert_parsed_alike(data: bytes, size: int) -> bool:
    """True where the plain parser answers; then the careful one gives the same."""
    found = plain.parse_plainly(data, size, WANTED_TAGS)
    if found is None:
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            expected = parse_carefully(io.BytesIO(data), size, WANTED_TAGS)
        except (CorruptFileError, OSError) as error:
            pytest.fail(f"the careful parser refuses ({error}) what the plain one reads: {data.hex()}")
    assert found == expected
    return True


def corpus() -> dict[str, bytes]:
    """pydicom's own files with the mark of DICOM: the header and a little more."""
    found = {}
    for path in sorted(CORPUS.rglob("*")):
        if path.is_file():
            data = path.read_bytes()
            if data[128:132] == b"DICM":
                found[str(path.relative_to(CORPUS))] = data
    return found


def test_value_representations_and_sequences_of_the_plain_parser_are_those_of_pydicom() -> None:
    assert set(plain.SHORT_VRS.values()) == {str(vr) for vr in EXPLICIT_VR_LENGTH_16}
    assert set(plain.LONG_VRS.values()) == {str(vr) for vr in EXPLICIT_VR_LENGTH_32}
    assert {DicomDictionary[tag][0] for tag in plain.SEQUENCE_TAGS} == {"SQ"}
    assert not any(tag >> 16 & 1 for tag in DicomDictionary)  # private elements are known by their items alone
    assert plain.CHARACTER_SET in WANTED_TAGS


def test_names_of_transfer_syntaxes_are_those_of_pydicom_and_all_can_be_decoded() -> None:
    assert len(codecs.SYNTAX_NAMES) == 14  # those that clrecon/reading/dicom/parse/transfer_syntaxes.py lists
    assert all(UID(uid).name == name for uid, name in codecs.SYNTAX_NAMES.items())
    assert not any(codecs.describe_undecodable(uid) for uid in codecs.SYNTAX_NAMES)


def test_files_of_pydicom_are_parsed_alike_by_both_parsers_and_most_by_the_plain_one() -> None:
    files = corpus()
    taken = [name for name, data in files.items() if assert_parsed_alike(data, len(data))]
    assert len(files) > 120  # measured 163: another version of pydicom may have fewer
    assert len(taken) > len(files) // 2  # measured 85
    assert {"CT_small.dcm", "MR_small.dcm", "MR_small_implicit.dcm", "J2K_pixelrep_mismatch.dcm"} <= set(taken)


@pytest.mark.fuzz
def test_mutated_files_are_parsed_alike_by_both_parsers_or_left_by_the_plain_one() -> None:
    bases = []
    for data in corpus().values():
        found = plain.parse_plainly(data, len(data), WANTED_TAGS)
        if found is not None:
            bases.append(data[: found.pixel_offset + 40])
    dice = random.Random(46)
    taken = 0
    for _ in range(MUTATIONS):
        mutated = bytearray(dice.choice(bases))
        for _ in range(dice.choice((1, 1, 1, 2, 3, 6))):
            mutate(mutated, dice)
        taken += assert_parsed_alike(bytes(mutated), len(mutated) + dice.choice((0, 5000)))
    assert MUTATIONS // 10 < taken < MUTATIONS * 9 // 10  # both answers occur often; measured 24 % taken


def mutate(data: bytearray, dice: random.Random) -> None:
    place = dice.randrange(128, len(data)) if len(data) > 200 else 128
    kind = dice.randrange(6)
    token = dice.choice(TOKENS)
    if kind == 0:
        data[place] = dice.randrange(256)
    elif kind == 1:
        data[place : place + len(token)] = token
    elif kind == 2:
        data[place:place] = token
    elif kind == 3:
        del data[place : place + dice.choice((1, 2, 4, 8, 20))]
    elif kind == 4:
        other = dice.randrange(128, len(data))
        data[place:place] = data[other : other + dice.choice((8, 12, 16, 40, 100))]
    else:
        data[place] ^= 1 << dice.randrange(8)


def encode(tag: tuple[int, int], vr: bytes, value: bytes, implicit: bool, length: int | None = None) -> bytes:
    """One element; `length` in place of the true one."""
    length = len(value) if length is None else length
    if implicit:
        return struct.pack("<HHL", *tag, length) + value
    if vr in plain.SHORT_VRS:
        return struct.pack("<HH2sH", *tag, vr, length & 0xFFFF) + value
    return struct.pack("<HH2sHL", *tag, vr, 0, length) + value


def wrap(body: bytes, implicit: bool) -> bytes:
    """A whole file around the elements of `body`."""
    syntax = b"1.2.840.10008.1.2\0" if implicit else b"1.2.840.10008.1.2.1\0"
    meta = encode((2, 0x0002), b"UI", b"1.2.840.10008.5.1.4.1.1.2\0", implicit=False)
    meta += encode((2, 0x0010), b"UI", syntax, implicit=False)
    return bytes(128) + b"DICM" + meta + body + encode((0x7FE0, 0x0010), b"OW", bytes(8), implicit=implicit)


TAGS = [
    *((tag >> 16, tag & 0xFFFF) for tag in (*WANTED_TAGS, 0x00081110, 0x00081140, 0x00400275, 0x00080016)),
    *((0x0009, 0x0010), (0x0029, 0x1010), (0x7FE1, 0x0010), (0x7FE0, 0x0001), (0x6000, 0x3000), (0x0008, 0x9999)),
]
VRS = [b"CS", b"DS", b"UI", b"US", b"LO", b"SQ", b"UN", b"OB", b"OW", b"UT", b"ZZ", b"\0\0"]


def make_element(chance: random.Random, implicit: bool, depth: int = 3) -> bytes:
    """An element by chance: a value, a stray delimiter, or a sequence of items, some with wrong lengths."""
    tag, vr = chance.choice(TAGS), chance.choice(VRS)
    if chance.randrange(16) == 0:
        return struct.pack("<HHL", 0xFFFE, chance.choice([0xE000, 0xE00D, 0xE0DD]), 0)
    if depth == 0 or chance.randrange(3):
        wrong = chance.choice([None] * 12 + [0, 2, 0xFFFFFFFF])
        return encode(tag, vr, chance.randbytes(2 * chance.randrange(7)), implicit=implicit, length=wrong)
    items = b""
    for _ in range(chance.randrange(3)):
        content = b"".join(make_element(chance, implicit, depth - 1) for _ in range(chance.randrange(4)))
        if chance.randrange(2):
            items += struct.pack("<HHL", 0xFFFE, 0xE000, 0xFFFFFFFF) + content
            items += struct.pack("<HHL", 0xFFFE, 0xE00D, chance.choice([0, 0, 0, 0, 8]))
        else:
            off = chance.choice([0] * 10 + [-2, 2, 8])
            items += struct.pack("<HHL", 0xFFFE, 0xE000, max(len(content) + off, 0)) + content
    tag = chance.choice([(0x0008, 0x1110), (0x0040, 0x0275), (0x0009, 0x1010), (0x6000, 0x3000), tag])
    vr = chance.choice([b"SQ", b"SQ", b"SQ", vr])
    if chance.randrange(2):
        return encode(tag, vr, items, implicit=implicit)
    end = struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)
    return encode(tag, vr, items + chance.choice([end] * 6 + [b""]), implicit=implicit, length=0xFFFFFFFF)


@pytest.mark.release
@pytest.mark.fuzz
@pytest.mark.parametrize("implicit", [False, True])
def test_random_headers_are_parsed_alike_by_both_parsers_or_left_by_the_plain_one(implicit: bool) -> None:
    chance = random.Random(176)
    for _ in range(300):
        whole = wrap(b"".join(make_element(chance, implicit) for _ in range(chance.randrange(7))), implicit=implicit)
        assert_parsed_alike(whole, len(whole))


def item(content: bytes, defined: bool = True) -> bytes:
    if defined:
        return struct.pack("<HHL", 0xFFFE, 0xE000, len(content)) + content
    return struct.pack("<HHL", 0xFFFE, 0xE000, 0xFFFFFFFF) + content + struct.pack("<HHL", 0xFFFE, 0xE00D, 0)


def nest(levels: int, implicit: bool = False) -> bytes:
    """A sequence of undefined length in a sequence, so many levels deep."""
    content = b""
    for _ in range(levels):
        content = encode(
            (0x0008, 0x1110), b"SQ", item(content, defined=False) + SEQUENCE_END, implicit=implicit, length=0xFFFFFFFF
        )
    return content


SEQUENCE_END = struct.pack("<HHL", 0xFFFE, 0xE0DD, 0)
ITEM_END = struct.pack("<HHL", 0xFFFE, 0xE00D, 0)
NAME = encode((0x0008, 0x0060), b"CS", b"CT", implicit=True)
NESTED_CHARSET = encode((0x0008, 0x0005), b"CS", b"x\0y ", implicit=False)


def sequence(items: bytes, implicit: bool, tag: tuple[int, int] = (0x0008, 0x1110)) -> bytes:
    return encode(tag, b"SQ", items + SEQUENCE_END, implicit=implicit, length=0xFFFFFFFF)


DOUBTFUL = {
    "a character set inside, which pydicom refuses": (False, sequence(item(NESTED_CHARSET), implicit=False)),
    "an item that ends before its length": (True, sequence(item(ITEM_END + NAME), implicit=True)),
    "an element over the end of its item": (True, sequence(item(NAME)[:-2] + NAME[8:] + b"..", implicit=True)),
    "no item in a sequence": (True, sequence(NAME, implicit=True)),
    "a delimiter between elements": (True, ITEM_END),
    "nested deeper than anybody writes": (False, nest(plain.DEEPEST + 1)),
    "bytes of undefined length": (
        False,
        encode((0x0009, 0x1010), b"OB", item(b"1234") + SEQUENCE_END, implicit=False, length=0xFFFFFFFF),
    ),
    "an unknown element of undefined length": (True, sequence(item(NAME), implicit=True, tag=(0x6000, 0x3000))),
    "an unknown representation": (False, encode((0x0009, 0x1010), b"ZZ", b"1234", implicit=False)),
    "a character set that pydicom looks up": (False, NESTED_CHARSET),
    "explicit under implicit": (True, encode((0x0008, 0x0060), b"CS", b"CT", implicit=False)),
    "implicit under explicit": (False, NAME),
}


@pytest.mark.parametrize("case", DOUBTFUL)
def test_doubtful_headers_are_left_to_the_careful_parser(case: str) -> None:
    implicit, doubtful = DOUBTFUL[case]
    assert plain.parse_plainly(wrap(b"", implicit=implicit), 500, WANTED_TAGS) is not None
    assert plain.parse_plainly(wrap(doubtful, implicit=implicit), 500, WANTED_TAGS) is None


def test_plain_parser_reads_the_deepest_nesting_it_allows() -> None:
    assert assert_parsed_alike(wrap(nest(plain.DEEPEST), implicit=False), 5000)
    assert assert_parsed_alike(wrap(nest(plain.DEEPEST, implicit=True), implicit=True), 5000)


@pytest.mark.parametrize("syntax", [plain.IMPLICIT_LITTLE, "1.2.840.10008.1.2.1"])
def test_sequences_of_undefined_length_are_read_by_the_plain_parser(tmp_path: Path, syntax: str) -> None:
    """The quick way is taken for them: nearly every archive writes some."""
    ds = make_dataset(Plan(syntax=syntax), 0)
    inner = pydicom.Dataset()
    inner.ReferencedSOPInstanceUID = "1.2.3"
    inner.is_undefined_length_sequence_item = True
    block = ds.private_block(0x0009, "clrecon test", create=True)
    for tag in (0x00081110, block.get_tag(0x10)):
        ds.add_new(tag, "SQ", [inner, pydicom.Dataset()])
        ds[tag].is_undefined_length = True
    save_dataset(ds, tmp_path / "file")
    data = (tmp_path / "file").read_bytes()
    assert data.count(b"\xff\xff\xff\xff") == 4  # of two sequences and the first item of each
    assert assert_parsed_alike(data, len(data))


@pytest.mark.parametrize("cut", range(1, 12))
def test_header_that_is_cut_is_left_to_the_careful_parser(tmp_path: Path, cut: int) -> None:
    write_series(tmp_path, Plan(shape=(1, 4, 4)))
    data = (tmp_path / "slice000.dcm").read_bytes()
    end = plain.parse_plainly(data, len(data), WANTED_TAGS).pixel_offset
    assert plain.parse_plainly(data[: end - cut], len(data), WANTED_TAGS) is None
    assert assert_parsed_alike(data[:end], len(data))


@pytest.mark.parametrize(
    "large", [elements.PREFIX_BYTES, 256 * 1024], ids=["than the first prefix", "than the second too"]
)
def test_headers_longer_than_what_is_read_first_are_read_whole(tmp_path: Path, large: int) -> None:
    """A private element alone fills what is read first, 16 KiB, or what is read then, 256 KiB."""

    def change(ds: pydicom.Dataset, k: int) -> None:
        ds.private_block(0x0009, "clrecon test", create=True).add_new(0x10, "OB", bytes(large))

    plan = write_series(tmp_path, change=change)
    assert (read_volume(tmp_path).voxels == plan.hu()).all()


@pytest.mark.parametrize(
    ("syntax", "careful"),
    [(plain.IMPLICIT_LITTLE, False), ("1.2.840.10008.1.2.1", False), (DeflatedExplicitVRLittleEndian, True)],
)
def test_pydicom_is_loaded_only_where_it_is_needed(tmp_path: Path, syntax: str, careful: bool) -> None:
    write_series(tmp_path, Plan(syntax=syntax))
    # What numpy loads by itself, before 2.0 its masked arrays too, does not count.
    code = (
        "import sys, numpy; had = set(sys.modules); import clrecon; clrecon.read_volume(sys.argv[1]);"
        "print([n in sys.modules.keys() - had for n in sys.argv[2:]])"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(elements.__file__).parents[4])}
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path), "pydicom", "numpy.ma", "clrecon.anatomy.iso_choice"],
        capture_output=True,
        text=True,
        env=environment,
        check=True,
    )
    assert done.stdout.strip() == str([careful, False, False])


@pytest.mark.fault_row(46)
@pytest.mark.parametrize(
    "charset", ["ISO_IR 100", "NOT_A_CHARSET", "ISO 2022 IR 6\\ISO 2022 IR 87", "\\ISO 2022 IR 149", "UTF-8", "latin1 "]
)
def test_series_is_read_whatever_its_character_set_says(tmp_path: Path, charset: str) -> None:
    from dicom_series import set_raw

    plan = write_series(tmp_path, change=set_raw("SpecificCharacterSet", charset))
    for file in tmp_path.iterdir():
        assert_parsed_alike(file.read_bytes(), file.stat().st_size)
    assert (read_volume(tmp_path).voxels == plan.hu()).all()
    assert list_series(tmp_path).series[0].description == "series 1"


@pytest.mark.parametrize(
    ("syntax", "is_plain"),
    [(ImplicitVRLittleEndian, True), (DeflatedExplicitVRLittleEndian, False), (ExplicitVRBigEndian, False)],
    ids=["implicit", "deflated", "big endian"],
)
def test_deflated_and_big_endian_headers_are_left_to_the_careful_parser(
    tmp_path: Path, syntax: str, is_plain: bool
) -> None:
    save_dataset(make_dataset(Plan(syntax=syntax), 0), tmp_path / "file")
    data = (tmp_path / "file").read_bytes()
    assert assert_parsed_alike(data, len(data)) == is_plain
