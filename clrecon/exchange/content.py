"""The input of a writer: points in the frame in which they are written, and the facts that the file may contain.

The certificate of the volume stands in comments, a fact a line: name, blank, value, for example ``tilt_deg 12.5``.
Nine significant digits make the lines of one volume the same in every file.  Only the names below are written: a caller
can put anything into a report, so entries of another form are left out, and texts become one line of plain ASCII.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, islice
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import OutputError, UsageError
from clrecon.exchange.page_slices import PackedSlices
from clrecon.geometry import frame_from_lps
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.pieces import chunks, side_by_side

LINE_LENGTH = 256
"""Longest line.  Readers of PLY keep comments in buffers of fixed size; a widely used one has 1024 bytes."""
_LINES_READ = 64
"""Most lines that are taken over from a file: no certificate of ours has more."""
WARNINGS_WRITTEN = 20
_RUNS_WRITTEN = 12
_NUMBERS = (
    "grid_residual_max_mm",
    "grid_residual_rms_mm",
    "grid_tolerance_mm",
    "tilt_deg",
    "slice_thickness_mm",
    "padding_share",
)
_HASH = re.compile(r"[0-9a-f]{16}")
_AXES = re.compile(r"[LRPASI]{3}")


def certificate_lines(report: Mapping[str, Any], *, keep_ids: bool = False) -> tuple[str, ...]:
    """Return the lines for a file from ``volume.report`` (docs/contract.md); none if nothing is known.

    They are printable ASCII, at most `LINE_LENGTH`, without ``=``: readers look for ``SPACE=`` anywhere.
    """
    return tuple(_plain(line) for line in (*_facts(report, keep_ids), *_faults(report)))


def plain_lines(lines: Iterable[object]) -> tuple[str, ...]:
    """Return lines that a file had, at most `_LINES_READ` of them, in the form that `certificate_lines` gives them."""
    return tuple(_plain(str(line)) for line in islice(lines, _LINES_READ))


def _facts(report: Mapping[str, Any], keep_ids: bool) -> Iterator[str]:
    for name in _NUMBERS:
        yield from _line(name, [("", report.get(name))])
    gaps, dropped = _mapping(report.get("gap_mm")), _mapping(report.get("dropped"))
    runs = report.get("gap_runs")
    yield from _line("gap_mm", [(end, gaps.get(end)) for end in ("min", "max", "median")])
    if isinstance(runs, list) and 0 < len(runs) <= _RUNS_WRITTEN:
        pairs = [(word, _mapping(run).get(key)) for run in runs for word, key in (("", "count"), ("x", "gap_mm"))]
        yield from _line("gap_runs", pairs)
    overlap = _mapping(_mapping(report.get("thickness")).get("overlap_mm"))
    yield from _line("slice_overlap_mm", [(end, overlap.get(end)) for end in ("min", "max")])
    left = sum(count for count in dropped.values() if isinstance(count, int))
    numbers = (("used", report.get("slices")), ("dropped", left), ("missing", report.get("slices_missing")))
    yield from _line("slices", numbers)
    phase = _mapping(report.get("phase"))
    yield from _line("phase", [("", phase.get("number")), ("of", phase.get("of"))])
    yield from (f"dropped {count} {reason}" for reason, count in dropped.items())
    axes = str(_mapping(report.get("orientation")).get("axes"))
    if _AXES.fullmatch(axes):
        yield f"axes {axes}"
    affine = report.get("affine_ijk_to_lps_mm")
    if isinstance(affine, list) and len(affine) == 4 and all(isinstance(row, list) for row in affine):
        yield from _line("affine_ijk_to_lps_mm", [("", value) for value in chain(*affine)])
    frame = report.get("frame_of_reference_hash")
    if keep_ids and isinstance(frame, str) and _HASH.fullmatch(frame):
        yield f"frame_of_reference {frame}"


def _faults(report: Mapping[str, Any]) -> Iterator[str]:
    gates = report.get("gates")
    if isinstance(gates, list):
        judged = [gate for gate in gates if isinstance(gate, Mapping) and gate.get("ok") is not None]
        failed = [gate for gate in judged if not gate["ok"]]
        yield f"gates {len(judged) - len(failed)} passed {len(failed)} failed"
        yield from (f"gate_failed {gate.get('name')}: {gate.get('text')}" for gate in failed)
    warnings = report.get("warnings")
    if isinstance(warnings, list):
        yield from (f"warning {text}" for text in warnings[:WARNINGS_WRITTEN])
        if len(warnings) > WARNINGS_WRITTEN:
            yield f"warning and {len(warnings) - WARNINGS_WRITTEN} more, in the report"


def _mapping(value: Any) -> Mapping[Any, Any]:
    return value if isinstance(value, Mapping) else {}


def _line(name: str, pairs: Iterable[tuple[str, Any]]) -> Iterator[str]:
    """Return one line of numbers, each after its word; no line if one of the values is not a number."""
    words = [name]
    for word, value in pairs:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return
        words += [word] * bool(word) + [f"{round(value, 9) + 0.0:.9g}"]
    yield " ".join(words)


def _plain(text: str) -> str:
    ascii_text = text.encode("ascii", "backslashreplace").decode("ascii").replace("=", ":")
    line = "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in ascii_text)
    return line if len(line) <= LINE_LENGTH else line[: LINE_LENGTH - 3] + "..."


def checked_columns(
    owner: str, columns: Mapping[str, NDArray[np.floating]], unit: str, count: int
) -> dict[str, NDArray[np.float32]]:
    """Return numbers by name as float32; those not one a unit, or with a name that no file holds, are refused."""
    checked = {}
    for name, values in columns.items():
        array = np.asarray(values)
        if array.shape != (count,) or array.dtype.kind not in "biuf":
            raise UsageError(
                f"{owner}[{name!r}] are {array.dtype} of shape {array.shape}: one number a {unit} is needed, ({count},)"
            )
        if not isinstance(name, str) or not (name.isascii() and name.isidentifier()):
            raise UsageError(f"values have names of letters, digits and _ that begin with a letter, not {name!r}")
        checked[name] = np.ascontiguousarray(array, np.float32)
    return checked


_LINES_AT_ONCE = 1 << 14
BONE_COLOR = (0.89, 0.86, 0.78)
"""Colour of a surface without one of its own, in formats that must have one."""


@dataclass(frozen=True, kw_only=True)
class PointContent:
    """Points as they go into a file: those of a cloud, or the vertices of a mesh.

    vertices: (n, 3), float32, or float64 far from the origin; mm in `space`, ``LPS`` or ``RAS``.
    to_lps: (3, 3). Rotation from `space` to LPS.
    affine: (4, 4). Index (i, j, k) of the volume to LPS mm, whatever `space` is.
    certificate: Facts about the volume; one printable ASCII line each.
    inside: The values that the surface encloses, for example "below -400 HU"; None for those from the iso value on.
    hu, labels, ijk: (n,), (n,) and (n, 3).
    values: Numbers at the points by name, (n,), in PLY, VTP, NPZ and GLB; NaN where there is none.
    """

    vertices: NDArray[np.floating]
    normals: NDArray[np.float32] | None
    space: str
    to_lps: NDArray[np.float64]
    iso_value_hu: float | None
    affine: NDArray[np.float64] | None
    certificate: tuple[str, ...] = ()
    inside: str | None = None
    hu: NDArray[np.float32] | None = None
    labels: NDArray[np.int32] | None = None
    ijk: NDArray[np.int32] | None = None
    values: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def is_double(self) -> bool:
        """True where coordinates need more digits than float32 has."""
        return self.vertices.dtype == np.float64

    @property
    def number(self) -> str:
        """Format of a coordinate in text files: enough digits to get back the same float32, or 1e-9 mm at 1e5 mm."""
        return "%.15g" if self.is_double else "%.9g"

    @property
    def remarks(self) -> list[str]:
        """Facts for formats that have comments: space, unit and, if known, iso value and certificate."""
        remarks = [f"SPACE={self.space}", "UNIT=mm"]
        if self.iso_value_hu is not None:
            remarks.append(f"ISO_VALUE_HU={self.iso_value_hu:.9g}")
        if self.inside is not None:
            remarks.append(f"INSIDE={self.inside}")
        return remarks + [f"CERTIFICATE {line}" for line in self.certificate]


@dataclass(frozen=True, eq=False)
class Pieces:
    """Parts of a mesh, for a format that shows them one by one: that of each triangle (m,), the volume of each."""

    of_triangle: NDArray[np.integer]
    names: tuple[str, ...]
    volumes_ml: tuple[float | None, ...]


@dataclass(frozen=True, kw_only=True)
class Content(PointContent):
    """A mesh as it goes into a file, with name, colour (red, green, blue, 0 to 1) and pieces where a format has them.

    face_values: Numbers at the triangles by name, (m,), in PLY and VTP; NaN where there is none.
    title: Name of the label as its file has it, on pages in place of `name`, which can be one of a file.
    slices: Of the scan, on pages.
    color: None: the colour of the format's writer.
    vertex_colors: (n, 3). A colour for each vertex, in PLY, in place of `color`.
    """

    triangles: NDArray[np.uint32]
    face_values: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    name: str | None = None
    title: str | None = None
    color: tuple[float, float, float] | None = None
    vertex_colors: NDArray[np.uint8] | None = None
    pieces: Pieces | None = None
    slices: PackedSlices | None = None


@dataclass(frozen=True)
class Assembly:
    """Several meshes in the same space as they go into one file, each an object with a name and a colour of its own."""

    parts: tuple[Content, ...]


def write_lines(stream: IO[bytes], form: str, rows: NDArray[Any]) -> None:
    """Write a line of text for each row of numbers (n, k), of at least 0 where they are whole: ``%d``."""
    format_rows = _format_whole_numbers if rows.dtype.kind in "iu" else _format_numbers
    text = b""
    for lines in chunks(len(rows), _LINES_AT_ONCE):
        # Streams pack what they get, meanwhile the next lines are made.
        text, _ = side_by_side(partial(format_rows, form, rows[lines]), partial(stream.write, text))
    stream.write(text)


def _format_numbers(form: str, rows: NDArray[Any]) -> bytes:
    if rows.dtype == np.float32 and form.count("%") == form.count(_SINGLE) and _have_nine_digits(rows):
        return _format_singles(form, rows)
    # One % for many lines takes two thirds of the time of one % for each line.
    return (form * len(rows) % tuple(rows.ravel().tolist())).encode("ascii")


_SINGLE = "%.9g"
_TENS = 10.0 ** np.arange(-3, 8)
"""Sizes of numbers from which on one decimal fewer is written: twelve below the first, one from the last on."""

_POWERS = 10.0 ** np.arange(13)


def _have_nine_digits(rows: NDArray[np.float32]) -> bool:
    """Tell whether float64 holds the nine digits of all numbers exactly, and ``%.9g`` writes none with an exponent."""
    sizes = np.abs(rows)
    return bool(((sizes < 1e8) & ((sizes >= 1e-4) | (sizes == 0.0))).all())


def _format_singles(form: str, rows: NDArray[np.float32]) -> bytes:
    """Do what `_format_numbers` does in three fifths of the time, as `_format_whole_numbers` does."""
    numbers = np.abs(rows.reshape(len(rows), -1).T.astype(np.float64))
    decimals = 12 - np.searchsorted(_TENS, numbers.ravel(), side="right").reshape(numbers.shape)
    scale = _POWERS[decimals]
    scaled = np.rint(numbers * scale)  # exact before it is rounded: 24 bits and those of a power of five up to 12
    whole = np.floor(scaled / scale)
    decimal_digits = (scaled - whole * scale) * _POWERS[12 - decimals]
    high = np.floor(decimal_digits / 1e6)
    low = (decimal_digits - 1e6 * high).astype(np.int32)
    high = high.astype(np.int32)
    width = len(str(int(whole.max())))
    canvas, columns = _start_canvas(form, _SINGLE, len(rows), 1 + width + 1 + 12)  # sign, digits, point, decimals
    for column, number in enumerate(columns):
        canvas[:, number] = np.where(np.signbit(rows[:, column]), ord("-"), 0)
        _put_digits(canvas, number + 1, width, whole[column].astype(np.int32))
        is_shown = np.zeros(len(rows), dtype=bool)  # no zeros at the end
        for part, first in ((low[column], 8), (high[column], 2)):
            for digit in range(5, -1, -1):
                rest = part // 10
                value = part - 10 * rest
                part = rest
                is_shown |= value > 0
                canvas[:, number + width + first + digit] = np.where(is_shown, value + ord("0"), 0)
        canvas[:, number + width + 1] = np.where(is_shown, ord("."), 0)
    return canvas.tobytes().translate(None, b"\0")


def _start_canvas(form: str, code: str, lines: int, width: int) -> tuple[NDArray[np.uint8], list[int]]:
    """Return the bytes of lines, with NUL for numbers, and the column at which each number begins."""
    texts = form.encode("ascii").split(code.encode("ascii"))
    canvas = np.tile(np.frombuffer(bytes(width).join(texts), dtype=np.uint8), (lines, 1))
    ends = np.cumsum([len(text) + width for text in texts[:-1]])
    return canvas, (ends - width).tolist()


def _put_digits(canvas: NDArray[np.uint8], column: int, digits: int, number: NDArray[Any]) -> None:
    """Write whole numbers from a column on, all digits of a place at once, without zeros before them."""
    for digit in range(digits - 1, -1, -1):
        rest = number // 10
        canvas[:, column + digit] = np.where((number > 0) | (digit == digits - 1), number - 10 * rest + ord("0"), 0)
        number = rest


def _format_whole_numbers(form: str, rows: NDArray[Any]) -> bytes:
    """Do what `_format_numbers` does in half of the time: all digits of a place at once, NUL where there is none."""
    numbers = rows.reshape(len(rows), -1).T
    digits = len(str(int(numbers.max())))
    canvas, columns = _start_canvas(form, "%d", len(rows), digits)
    for column, number in zip(columns, numbers, strict=True):
        _put_digits(canvas, column, digits, number)
    text = canvas.tobytes()
    return text.translate(None, b"\0") if b"\0" in text else text


def parts_of(content: Content | Assembly) -> tuple[Content, ...]:
    return content.parts if isinstance(content, Assembly) else (content,)


def facts_for_file(report: Mapping[str, Any], space: str, *, keep_ids: bool = False) -> dict[str, Any]:
    """Return entries of a `PointContent`: of the frame and a report of mesh or cloud, of which nothing else is written.

    report: ``iso_value_hu``, ``inside_hu``, ``affine_ijk_to_lps_mm``, and ``certificate`` (the report of a volume) or
        ``certificate_lines`` (those of a file that was read).
    keep_ids: With the hash of the frame of reference.
    """
    iso_value, affine = report.get("iso_value_hu"), report.get("affine_ijk_to_lps_mm")
    certificate, lines = report.get("certificate"), report.get("certificate_lines")
    return {
        "space": space.upper(),
        "to_lps": frame_from_lps(space).T,
        "iso_value_hu": None if iso_value is None else float(iso_value),
        "affine": None if affine is None else np.array(affine, dtype=np.float64).reshape(4, 4),
        "certificate": (
            certificate_lines(certificate, keep_ids=keep_ids)
            if isinstance(certificate, Mapping)
            else plain_lines(lines if isinstance(lines, (list, tuple)) else ())
        ),
        "inside": _describe_inside(report.get("inside_hu")),
    }


def _describe_inside(ends: Sequence[float | None] | None) -> str | None:
    """Describe the values within these ends; None where the upper end is open."""
    if ends is None or ends[1] is None:
        return None
    return f"below {ends[1]:.9g} HU" if ends[0] is None else f"{ends[0]:.9g} to {ends[1]:.9g} HU"


class Writable(Protocol):
    @property
    def triangle_count(self) -> int: ...
    @property
    def vertices(self) -> NDArray[np.floating]: ...
    def check(self) -> None: ...
    def describe(self, space: str, *, keep_ids: bool = False) -> Content: ...
    def describe_parts(self, space: str, most: int, *, keep_ids: bool = False) -> Content: ...


def check_same(words: str, actual: object, expected: object) -> None:
    """Refuse a finished file in which this is not as it was written."""
    if actual != expected:
        raise refuse_file(words, actual, expected)


def refuse_file(words: str, actual: object, expected: object) -> OutputError:
    """Return the error for a file whose contents differ from what was written."""
    return OutputError(
        f"the file did not arrive on the disk as it was written: {actual} {words}, {expected} expected; "
        "an older file is intact, check the disk and try again"
    )
