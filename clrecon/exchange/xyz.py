"""XYZ: text, a point a line, ``x y z hu``; the head names frame, unit, iso value, certificate and columns.

Every program reads such a table; the lines of the head begin with ``#``.  Normals and labels have no place in it.
"""

from __future__ import annotations

import codecs
import io
import re
from itertools import chain
from pathlib import Path
from typing import BinaryIO

import numpy as np

from clrecon.errors import RefusedInputError
from clrecon.exchange.content import PointContent, check_same, refuse_file, write_lines
from clrecon.exchange.raw_content import RawCloud, columns_of, read_remarks, say_cut
from clrecon.system.paths import open_regular
from clrecon.system.pieces import chunks
from clrecon.system.text import escape_text, is_number

_CHUNK = 1 << 14
_PIECE = 1 << 22
_LONGEST_HEAD = 1 << 10
"""Most lines before the first point."""
_LONGEST_LINE = 1 << 14
"""Most characters of a line of the head, and of the first point."""
_MOST_WARNINGS = 3
"""Most lines that are warned of."""
_BYTE_ORDER_MARK = codecs.BOM_UTF8.decode("latin-1")
_COMMENTS = ("#", "//", "%")


def _header(content: PointContent) -> bytes:
    columns = "x y z" if content.hu is None else "x y z hu"
    return "".join(f"# {remark}\n" for remark in [*content.remarks, columns]).encode("ascii")


def estimate(content: PointContent) -> int:
    """Return the size of the file in bytes, rather too small: a number takes 2 to 13 characters and a blank."""
    return len(_header(content)) + len(content.vertices) * (6 if content.hu is None else 8)


def write(stream: BinaryIO, content: PointContent) -> None:
    """Write the head and the points: nine digits, enough to get back the same float32, and fifteen far away."""
    stream.write(_header(content))
    form = " ".join([content.number] * 3 + ["%.9g"] * (content.hu is not None)) + "\n"
    for lines in chunks(len(content.vertices), _CHUNK):
        rows = content.vertices[lines]
        if content.hu is not None:
            rows = np.column_stack([rows, content.hu[lines]])
        write_lines(stream, form, rows)


def verify(path: Path, content: PointContent) -> None:
    header = _header(content)
    with path.open("rb") as stream:
        check_same("in the header", stream.read(len(header)), header)
        lines, end = 0, b""
        while piece := stream.read(_PIECE):
            lines += piece.count(b"\n")
            end = piece[-1:]
    check_same("points", lines, len(content.vertices))
    if end != b"\n":
        raise refuse_file("at the end", repr(end), "a line end")


def read_cloud(path: Path) -> RawCloud:
    """Read a table of numbers: three columns or more, parted by blanks, tabulators, commas or semicolons.

    Lines that begin with ``#``, ``//`` or ``%`` are comments.  The last line before the first point names the columns
    if it has a word for each of them, also as a comment: ``//X Y Z scalar_HU``.  Columns without names beyond the third
    are left out.  Another line there with words and numbers is refused if a number comes first, else warned of.
    """
    name = escape_text(path.name)
    head: list[str] = []
    try:
        with open_regular(path) as binary, io.TextIOWrapper(binary, encoding="latin-1", newline=None) as stream:
            first = stream.readline(_LONGEST_LINE).removeprefix(_BYTE_ORDER_MARK)
            while first and not _numbers_in(first):
                _check_head(first, len(head), name)
                head.append(first)
                if len(head) > _LONGEST_HEAD:
                    raise RefusedInputError(f"{name} is no table of points: {_LONGEST_HEAD:,} lines hold no numbers")
                first = stream.readline(_LONGEST_LINE)
            if not first:
                raise RefusedInputError(f"{name} holds no line of numbers: a line of a point is 'x y z' or more")
            count = _numbers_in(first)
            if count < 3:
                raise RefusedInputError(f"{name} has {count} numbers a line, a point has three at least")
            mark = next((mark for mark in ";," if mark in first), None)
            rest = chain([first], stream)
            table = np.loadtxt(rest, comments="#", delimiter=mark, ndmin=2, dtype=np.float64)
    except (ValueError, OSError, OverflowError, MemoryError) as error:
        raise say_cut(name, error) from error
    warnings = [
        f"line {number} holds words and numbers and is left out, {escape_text(' '.join(_words(line)))!r}: if it is a"
        " point, correct it; if not, mark it as a comment with #"
        for number, line in enumerate(head, start=1)
        if not _is_comment(line) and any(map(is_number, _words(line)))
    ][:_MOST_WARNINGS]
    words = _words(head[-1].lstrip("#/% \t")) if head else []
    fits = len(words) == count and [word.lower() for word in words[:3]] == ["x", "y", "z"]
    names = words if fits and len({word.lower() for word in words}) == count else None
    if names is None and count > 3:
        warnings.append(f"columns 4 to {count} have no names in a line before the first point and are left out")
    rows = table[:, 3:] if names else table[:, :0]
    return RawCloud(
        "XYZ",
        table[:, :3],
        columns_of(rows, names[3:] if names else ()),
        warnings=warnings,
        **read_remarks(line.lstrip("#/% \t") for line in head),
    )


def _check_head(line: str, number: int, name: str) -> None:
    """Refuse a line before the first point that begins with a number and is no point."""
    words = _words(line)
    if words and not _is_comment(line) and is_number(words[0]):
        wrong = next(word for word in words if not is_number(word))
        raise RefusedInputError(
            f"{name} has {escape_text(wrong)!r} in place of a number in line {number + 1}: correct the point, or mark"
            " the line as a comment with #"
        )


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith(_COMMENTS)


def _words(line: str) -> list[str]:
    return [word for word in re.split(r"[;,\s]+", line.strip()) if word]


def _numbers_in(line: str) -> int:
    """Return the count of numbers in a line; 0 if one of its words is not a number."""
    words = _words(line)
    return len(words) if all(map(is_number, words)) else 0
