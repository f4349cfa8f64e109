"""``clrecon info``: the listing of an input, a table that fits the terminal, plain and uncut where stdout is none."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from itertools import groupby, zip_longest
from typing import Any
from unicodedata import combining, east_asian_width

from clrecon.cli import common
from clrecon.cli.console import Console, is_terminal, printable
from clrecon.jobs.settings import InfoSettings
from clrecon.system.light_dataclass import dataclass

_DIRECTIONS = {"L": "left", "R": "right", "P": "back", "A": "front", "S": "head", "I": "feet"}
_FIRST = {"HF": "head first", "FF": "feet first"}
_LYING = {"S": "supine", "P": "prone", "DR": "on the right side", "DL": "on the left side"}
_RUNS_SHOWN = 6
_OBLIQUE_DEG = 0.05
_SAME = 0.01
"""Lengths are shown as equal if they differ by less than this share of a gap."""
_FINEST_MM = 0.001


def describe_certificate(certificate: dict[str, Any] | None) -> list[tuple[str, str]]:
    """Describe a series by its certificate: (subject, text) pairs, the gates last; no pairs without a certificate."""
    if certificate is None:
        return []
    return [*_describe_places(certificate), *_describe_values(certificate), *_describe_gates(certificate["gates"])]


def _describe_places(of: dict[str, Any]) -> Iterator[tuple[str, str]]:
    size = " x ".join(str(count) for count in of["shape_ijk"])
    if of["spacing_mm"] is None:
        yield "voxels", f"{size}; their places are refused"
    else:
        box = "" if of["extent_mm"] is None else f"; the box is {_format_lengths(of['extent_mm'], '.1f')} mm"
        yield "voxels", f"{size} of {_format_lengths(of['spacing_mm'], '.4g')} mm{box}"
    if of["orientation"] is not None:
        yield "directions", _describe_directions(of["orientation"], of["patient_position"])
    if of["anatomical_orientation"] is not None:
        yield "anatomy", "QUADRUPED: an animal; back is dorsal, front ventral, head cranial, feet caudal (trunk)"
    if of["grid_residual_max_mm"] is not None:
        yield "positions", _describe_residual(of)
        yield "gaps", _describe_gaps(of)
    if of["thickness"] is not None:
        yield "thickness", _describe_thickness(of["thickness"], of["gap_mm"]["median"])
    if of["tilt_deg"] is not None:
        edge = "front" if of["tilt_deg"] > 0.0 else "back"
        tilted = abs(of["tilt_deg"]) > _OBLIQUE_DEG
        tilt_text = f"{of['tilt_deg']:+.2f} degrees ({edge} edge towards the head), kept exactly as a shear"
        yield "tilt", tilt_text if tilted else "none"
    reasons = "".join(f", {count} dropped ({reason})" for reason, count in of["dropped"].items())
    missing = f", {of['slices_missing']} missing" if of["slices_missing"] else ""
    yield "slices", f"{of['slices']} used{reasons or ', none dropped'}{missing}"
    if of["phase"] is not None:
        phase = of["phase"]
        yield "phase", f"{phase['number']} of {phase['of']}, {phase['keyword']} {phase['value']}"


def _describe_directions(orientation: dict[str, Any], position: str | None) -> str:
    row, column, normal = (_DIRECTIONS[letter] for letter in orientation["axes"])
    text = f"rows run to the {row}, columns to the {column}, slices to the {normal}"
    if orientation["off_axis_deg"] > _OBLIQUE_DEG:
        text += f", their normal {orientation['off_axis_deg']:.1f} degrees off that axis"
    if not orientation["right_handed"]:
        text += "; left-handed"
    if position:
        words = [_FIRST.get(position[:2], ""), _LYING.get(position[2:], "")]
        text += f"; {', '.join(words)} ({position})" if all(words) else f"; patient position {position}"
    return text


def _describe_residual(of: dict[str, Any]) -> str:
    largest, rms, allowed = (of[f"grid_{name}_mm"] for name in ("residual_max", "residual_rms", "tolerance"))
    if of["uneven"]:
        far = f"up to {largest:.3g} mm off even steps (rms {rms:.3g}, allowed {allowed:.3g})"
        return f"uneven, {far}" + (": each slice has its own place" if of["spacing_mm"] else "")
    return f"within {max(largest, _FINEST_MM):.3g} mm of even steps (allowed {allowed:.3g})"


def _describe_gaps(of: dict[str, Any]) -> str:
    low, high, usual = (of["gap_mm"][name] for name in ("min", "max", "median"))
    stated = of["stated_gap_mm"]
    note = "" if stated is None else f"; SpacingBetweenSlices says {stated:g}"
    runs = of["gap_runs"]
    if not high:
        return f"none, all slices are at one place{note}"
    if runs and len(runs) <= _RUNS_SHOWN:
        return ", then ".join(f"{run['count']} of {run['gap_mm']:.4g}" for run in runs) + f" mm{note}"
    if high - low > _SAME * usual:
        return f"{low:.4g} to {high:.4g} mm, usually {usual:.4g}{note}"
    return f"{usual:.4g} mm{note}"


def _describe_thickness(thickness: dict[str, Any], usual_gap: float) -> str:
    low, high = thickness["min_mm"], thickness["max_mm"]
    text = f"{low:g} mm" if low == high else f"{low:g} to {high:g} mm"
    least, most, overlap = (thickness["overlap_mm"][name] for name in ("min", "max", "median"))
    if most - least > _SAME * usual_gap:
        return f"{text}: {_overlaps(least, most, _SAME * usual_gap)}"
    if abs(overlap) <= _SAME * usual_gap:
        return f"{text}: neighbouring slices touch"
    percent = thickness["overlap_percent"]
    share = "" if percent is None else f" ({abs(percent):.0f} % of the gap)"
    between = f"{overlap:.3g} mm overlap" if overlap > 0.0 else f"{-overlap:.3g} mm not measured"
    return f"{text}: {between} between neighbouring slices{share}"


def _overlaps(least: float, most: float, nothing: float) -> str:
    """Describe by how much neighbouring slices overlap where that differs; below 0 is what lies between them."""
    least, most = (0.0 if abs(length) <= nothing else length for length in (least, most))
    if least >= 0.0:
        return f"neighbouring slices overlap by {least:.3g} to {most:.3g} mm"
    if most <= 0.0:
        return f"{abs(most):.3g} to {-least:.3g} mm between neighbouring slices are not measured"
    return f"neighbouring slices overlap by up to {most:.3g} mm, or up to {-least:.3g} mm between them are not measured"


def _describe_values(of: dict[str, Any]) -> Iterator[tuple[str, str]]:
    rescale = of["rescale"]
    slope, intercept = (_span(rescale[name]) for name in ("slope", "intercept"))
    span = "" if of["hu_range"] is None else f"{of['hu_range'][0]:g} to {of['hu_range'][1]:g} "
    kind = rescale["type"] or "HU (the type is not stated)"
    given = ", as given" if rescale.get("given") else ""
    yield "values", f"{span}{kind}; slope {slope}, intercept {intercept}{given}"
    if of["padding_share"] is None:
        yield "padding", "not looked at" + (" (--pixels reads it)" if of["spacing_mm"] else "")
    else:
        yield "padding", f"{100.0 * of['padding_share']:.1f} % of the voxels hold no measurement"
    yield "stored", "; ".join(of["transfer_syntax_names"]) + "; with lossy compression" * of["lossy"]
    frame = of["frame_of_reference_hash"]
    yield "frame", f"{frame} (hash of the FrameOfReferenceUID)" if frame else "no FrameOfReferenceUID"


def _describe_gates(gates: list[dict[str, Any]]) -> Iterator[tuple[str, str]]:
    passed = sum(gate["ok"] is True for gate in gates)
    failed = [gate for gate in gates if gate["ok"] is False]
    unknown = [gate["name"] for gate in gates if gate["ok"] is None]
    text = f"{passed} kept, {len(failed)} failed"
    yield "gates", text + (f", not measured: {', '.join(unknown)}" if unknown else "")
    for gate in failed:
        yield "FAILED", f"{gate['name']}: {gate['text']}"


def _span(ends: list[float]) -> str:
    return f"{ends[0]:g}" if ends[0] == ends[1] else f"{ends[0]:g} to {ends[1]:g}"


_UNLIMITED = 100_000
_FOLDED_WIDTH = 20
"""The description is folded to this width before a column is left out."""
_BETWEEN = 2
_NARROWEST = 20


@dataclass(frozen=True)
class _Column:
    """A column: its heading, the text of each row, and `left_out`: small numbers are left out first, 0 never."""

    heading: str
    cells: list[str]
    left_out: int = 0
    right: bool = False
    folds: bool = False

    @property
    def width(self) -> int:
        """Width of the column in characters; a column that folds needs at most `_FOLDED_WIDTH`."""
        longest = max(map(_width, self.cells), default=0)
        return max(_width(self.heading), min(longest, _FOLDED_WIDTH) if self.folds else longest)


def _width(text: str) -> int:
    """Return the columns of a terminal that a text takes: Chinese, Japanese and Korean characters take two."""
    if text.isascii():
        return len(text)
    return sum(0 if combining(one) else 1 + (east_asian_width(one) in "WF") for one in text)


def _fold(text: str, width: int) -> list[str]:
    """Break a text between words, and words that are wider, into lines of at most so many columns, one at least."""
    lines = [""]
    for part in re.findall(r"\S+|\s+", text):
        if _width(lines[-1] + part) <= width:
            lines[-1] += part
        elif not part.isspace():
            lines += [""] * bool(lines[-1])
            for character in part:
                if _width(lines[-1] + character) > width:
                    lines.append("")
                lines[-1] += character
    return lines


def render_listing(
    listing: dict[str, Any], certificate: Sequence[tuple[str, str]], refused: int | None = None
) -> list[str]:
    """Lay out a listing, styled on a terminal; `certificate` is of the judged series, `refused` was said elsewhere."""
    terminal = is_terminal(sys.stdout)
    width = max(shutil.get_terminal_size().columns, _NARROWEST) if terminal else _UNLIMITED
    is_styled = terminal and not os.environ.get("NO_COLOR") and sys.platform != "win32"  # old consoles show the codes
    entries = listing["series"]  # in the order of their numbers: by patient, study and number in the study
    lines, left_out = _render_table(entries, listing["chosen"], width, is_styled)
    if left_out:
        lines += _wrap(f"({', '.join(left_out)} left out: a wider window or --json shows them)", width, "")
    shown = [entry for entry in entries if entry["number"] != refused]
    stacks = [entry for entry in shown if entry["kind"] == "stack"]
    others = [entry for entry in shown if entry["kind"] != "stack"]
    for group, label, field in (
        (others, "not read", "problems"),  # which is no fault of an RT object, a capture or a localizer
        (stacks, "problem", "problems"),
        (entries, "warning", "warnings"),
    ):
        for numbers, text in _collect_texts(group, field):
            lines += _wrap(f"series {numbers}: {label}: {printable(text)}", width, "    ")
    if certificate:
        judged = "as clrecon mesh would read it" if listing["chosen"] else "refused"
        lines += ["", f"series {listing['certificate']['series']['number']}, {judged}"]
        lines += [
            line for what, text in certificate for line in _wrap(f"  {what:<11}{printable(text)}", width, " " * 13)
        ]
    return lines


def _are_several(entries: Sequence[dict[str, Any]], key: str) -> bool:
    return len({entry[key] for entry in entries} - {None}) > 1


def _columns(entries: Sequence[dict[str, Any]], chosen: int | None) -> Iterator[_Column]:
    """Make all columns that are not empty, from left to right."""
    yield _Column("", ["*" if entry["number"] == chosen else " " for entry in entries])
    yield _Column("series", [str(entry["number"]) for entry in entries], right=True)
    if _are_several(entries, "patient"):
        yield _Column("patient", [str(entry["patient"] or "-") for entry in entries], right=True)
    if _are_several(entries, "study"):
        yield _Column("study", [str(entry["study"] or "-") for entry in entries], right=True)
    yield _Column("hash", [printable(entry["uid_hash"] or "-") for entry in entries], left_out=3)
    yield _Column("kind", [_kind(entry) for entry in entries])
    yield _Column("slices", [str(entry["slices"]) for entry in entries], right=True)
    if any(entry["phases"] for entry in entries):
        yield _Column("phases", [str(len(entry["phases"]) or "-") for entry in entries], right=True)
    matrix = [_format_lengths(entry["shape_ijk"] and entry["shape_ijk"][:2], "d") for entry in entries]
    yield _Column("matrix", matrix, left_out=5)
    yield _Column("spacing mm", [_format_lengths(entry["spacing_mm"], ".4g") for entry in entries])
    yield _Column("extent mm", [_format_lengths(entry["extent_mm"], ".0f") for entry in entries], left_out=1)
    thickness = [entry["slice_thickness_mm"] for entry in entries]
    yield _Column("thick", ["-" if t is None else f"{t:.4g}" for t in thickness], left_out=2, right=True)
    tilts = [entry["tilt_deg"] for entry in entries]
    shown = ["-" if tilt is None else f"{round(tilt, 2) or 0:+.2f}".replace("+0.00", "0") for tilt in tilts]
    yield _Column("tilt", shown, left_out=4, right=True)
    yield _Column("description", [printable(entry["description"] or "") for entry in entries], folds=True)


def _kind(entry: dict[str, Any]) -> str:
    """Return the modality, and the kind of object if it is not a stack of slices."""
    modality = printable(entry["modality"])
    return modality if entry["kind"] in ("stack", "other") else f"{modality} {entry['kind']}"


def _format_lengths(lengths: Sequence[float] | None, form: str) -> str:
    return " x ".join(f"{length:{form}}" for length in lengths) if lengths else "-"


def _render_table(
    entries: Sequence[dict[str, Any]], chosen: int | None, width: int, styled: bool
) -> tuple[list[str], list[str]]:
    """Return the lines of the table and the headings of columns that did not fit; a plain list if no table fits."""
    every = list(_columns(entries, chosen))
    columns = _choose_columns(every, width)
    if columns is None:
        return _render_list(every, width), []
    left_out = [column.heading for column in every if column not in columns]
    widths = [column.width for column in columns]
    for number, column in enumerate(columns):
        if column.folds:
            longest = max(map(_width, (column.heading, *column.cells)))
            widths[number] = min(longest, width - sum(widths) - _BETWEEN * (len(widths) - 1) + widths[number])
    rule = "\u2500" if (getattr(sys.stdout, "encoding", None) or "ascii").lower().startswith("utf") else "-"
    heading = _join_cells(columns, widths, [column.heading for column in columns], bold=styled)
    lines = [heading, rule * (sum(widths) + _BETWEEN * (len(widths) - 1))]
    parted = _are_several(entries, "patient")
    for row, entry in enumerate(entries):
        if parted and row and entries[row - 1]["patient"] != entry["patient"]:
            lines.append("")
        is_chosen = styled and entry["number"] == chosen  # no colours: they are not readable on every ground
        folded = [_fold(column.cells[row], space) for column, space in zip(columns, widths, strict=True)]
        lines += [_join_cells(columns, widths, cells, bold=is_chosen) for cells in zip_longest(*folded, fillvalue="")]
    return lines, left_out


def _join_cells(columns: Sequence[_Column], widths: Sequence[int], cells: Sequence[str], *, bold: bool) -> str:
    filled = [(" " * (width - _width(cell)), cell) for cell, width in zip(cells, widths, strict=True)]
    padded = ("".join(pair if column.right else pair[::-1]) for column, pair in zip(columns, filled, strict=True))
    line = (" " * _BETWEEN).join(padded).rstrip()
    return f"\x1b[1m{line}\x1b[0m" if bold else line


def _choose_columns(every: Sequence[_Column], width: int) -> list[_Column] | None:
    """Choose the columns that fit, by importance; None if not even the necessary ones fit."""
    shown = [column for column in every if not column.left_out]
    free = width - sum(column.width for column in shown) - _BETWEEN * (len(shown) - 1)
    if free < 0:
        return None
    for column in sorted(every, key=lambda column: -column.left_out):
        if column.left_out and column.width + _BETWEEN <= free:
            shown.append(column)
            free -= column.width + _BETWEEN
    return [column for column in every if column in shown]


def _render_list(columns: Sequence[_Column], width: int) -> list[str]:
    """Write the contents of the table as a list, one fact a line."""
    lines = []
    for row, mark in enumerate(columns[0].cells):
        series, *facts = columns[1:]
        lines.append(f"{mark} {series.heading} {series.cells[row]}")
        for column in facts:
            if column.cells[row] not in ("", "-"):
                lines += _wrap(f"    {column.heading}: {column.cells[row]}", width, " " * 8)
    return lines


def _collect_texts(entries: Sequence[dict[str, Any]], field: str) -> Iterator[tuple[str, str]]:
    """Collect texts; a text of several series appears once, with their numbers: ``3, 5-9``."""
    numbers: dict[str, list[int]] = {}
    for entry in entries:
        for text in entry[field]:
            numbers.setdefault(str(text), []).append(entry["number"])
    for text, numbered in numbers.items():
        following = groupby(enumerate(sorted(numbered)), lambda counted: counted[1] - counted[0])
        runs = [[number for _, number in run] for _, run in following]
        yield ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs), text


def _wrap(text: str, width: int, indent: str) -> list[str]:
    return textwrap.wrap(
        text,
        width,
        subsequent_indent=indent[: max(width - _NARROWEST, 0)],
        drop_whitespace=True,
        break_on_hyphens=False,
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        'The series marked * is the one that "clrecon mesh" would use; its certificate and gates are below the table.\n'
        "Only headers are read, unless --pixels is given. Exit code 0: a series can be used; 4: all are refused\n"
        "(their problems are listed), or a gate failed with --strict; 2: there is no CT series."
    )
    common.add_input(parser)
    common.add_fields(parser, InfoSettings)
    common.add_reading(parser)


def run(options: argparse.Namespace, console: Console) -> int:
    from clrecon.jobs.info import describe_input

    facts = describe_input(options.input, common.make_settings(InfoSettings, options), progress=console.progress)
    console.result(facts.listing)
    if not options.json and not options.quiet:
        lines = render_listing(facts.listing, describe_certificate(facts.listing["certificate"]), facts.refused)
        for line in lines:
            console.say(line)
    for note in facts.notes:
        console.warn(note, with_json=True)
    if facts.problem is not None:
        raise facts.problem
    return 0
