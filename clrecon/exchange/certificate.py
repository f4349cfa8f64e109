"""The certificate of the volume that a mesh was made of, as short lines for the comments of its file.

Each line holds one fact: name, blank, value, for example ``tilt_deg 12.5``.  Numbers have nine significant digits, so
that the lines of one volume are the same in every file.  Only the names below are written to a file.  A caller can put
anything into a report, so entries of another form are left out, and texts become one line of plain ASCII.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from typing import Any

LINE_LENGTH = 256
"""Longest line.  Readers of PLY keep comments in buffers of fixed size; a widely used one has 1024 bytes."""
LINES_READ = 64
"""Most lines that are taken over from a file: no certificate of ours has more."""
WARNINGS_WRITTEN = 20
RUNS_WRITTEN = 12
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
    """Return the lines for a file.

    report: ``volume.report``, see docs/contract.md.
    keep_ids: With the hash of the frame of reference.

    Returns: At most `LINE_LENGTH` printable ASCII characters each, none of them ``=``: readers look for ``SPACE=``
        anywhere. Empty if nothing is known.
    """
    return tuple(_plain(line) for line in (*_facts(report, keep_ids), *_faults(report)))


def plain_lines(lines: Iterable[object]) -> tuple[str, ...]:
    """Return lines that a file had, at most `LINES_READ` of them, in the form that `certificate_lines` gives them."""
    return tuple(_plain(str(line)) for line in islice(lines, LINES_READ))


def _facts(report: Mapping[str, Any], keep_ids: bool) -> Iterator[str]:
    for name in _NUMBERS:
        yield from _line(name, [("", report.get(name))])
    gaps, dropped, runs = _mapping(report.get("gap_mm")), _mapping(report.get("dropped")), report.get("gap_runs")
    yield from _line("gap_mm", [(end, gaps.get(end)) for end in ("min", "max", "median")])
    if isinstance(runs, list) and 0 < len(runs) <= RUNS_WRITTEN:
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
        yield from _line("affine_ijk_to_lps_mm", [("", value) for row in affine for value in row])
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
