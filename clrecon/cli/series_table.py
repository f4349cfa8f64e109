"""The listing of ``clrecon info`` on the screen: a table that fits the terminal, with problems below it.

If stdout is not a terminal, the text is plain and as wide as necessary, so that nothing is cut or folded that a script
looks for.  Texts from files are put into the table as plain text: they cannot act as markup or terminal sequences.
"""

from __future__ import annotations

import io
import os
import shutil
import sys
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from clrecon.cli.console import is_terminal, printable

if TYPE_CHECKING:
    from rich.table import Table

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
        from rich.cells import cell_len

        longest = max((cell_len(cell) for cell in self.cells), default=0)
        return max(cell_len(self.heading), min(longest, _FOLDED_WIDTH) if self.folds else longest)


class _Sink(io.StringIO):
    """The stream that rich writes to: text in the encoding of stdout, which decides how lines are drawn."""

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(sys.stdout, "encoding", None) or "ascii"


def render_listing(
    listing: dict[str, Any], certificate: Sequence[tuple[str, str]], refused: int | None = None
) -> list[str]:
    """Lay out a listing.

    listing: See `clrecon.jobs.info.InputListing`.
    certificate: sequence of (str, str). Description of the series that was judged, see `clrecon.cli.certificate`.
    refused: Number of a series whose problems are said elsewhere.

    Returns: Lines for stdout; with styles only if stdout is a terminal and ``NO_COLOR`` is not set.
    """
    terminal = is_terminal(sys.stdout)
    width = max(shutil.get_terminal_size().columns, _NARROWEST) if terminal else _UNLIMITED
    entries = listing["series"]  # in the order of their numbers: by patient, study and number in the study
    lines, left_out = _render_table(entries, listing["chosen"], width, terminal and not os.environ.get("NO_COLOR"))
    if left_out:
        lines += _wrap(f"({', '.join(left_out)} left out: a wider window or --json shows them)", width, "")
    told = [entry for entry in entries if entry["number"] != refused]
    stacks = [entry for entry in told if entry["kind"] == "stack"]
    others = [entry for entry in told if entry["kind"] != "stack"]
    for group, what, place in (
        (others, "not read", "problems"),  # which is no fault of an RT object, a capture or a localizer
        (stacks, "problem", "problems"),
        (entries, "warning", "warnings"),
    ):
        for numbers, text in _collect_texts(group, place):
            lines += _wrap(f"series {numbers}: {what}: {printable(text)}", width, "    ")
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
    matrix = [_times(entry["shape_ijk"] and entry["shape_ijk"][:2], "d") for entry in entries]
    yield _Column("matrix", matrix, left_out=5)
    yield _Column("spacing mm", [_times(entry["spacing_mm"], ".4g") for entry in entries])
    yield _Column("extent mm", [_times(entry["extent_mm"], ".0f") for entry in entries], left_out=1)
    thickness = [entry["slice_thickness_mm"] for entry in entries]
    yield _Column("thick", ["-" if t is None else f"{t:.4g}" for t in thickness], left_out=2, right=True)
    tilts = [None if (tilt := entry["tilt_deg"]) is None else round(tilt, 2) for entry in entries]
    yield _Column(
        "tilt",
        ["-" if tilt is None else f"{tilt:+.2f}" if tilt else "0" for tilt in tilts],
        left_out=4,
        right=True,
    )
    yield _Column("description", [printable(entry["description"] or "") for entry in entries], folds=True)


def _kind(entry: dict[str, Any]) -> str:
    """Return the modality, and the kind of object if it is not a stack of slices."""
    modality = printable(entry["modality"])
    return modality if entry["kind"] in ("stack", "other") else f"{modality} {entry['kind']}"


def _times(lengths: Sequence[float] | None, form: str) -> str:
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
    from rich.console import Console, detect_legacy_windows

    styled = styled and not detect_legacy_windows()
    console = Console(
        file=_Sink(),
        width=width,
        color_system="standard" if styled else None,
        force_terminal=styled,
        legacy_windows=False,
        highlight=False,
        markup=False,
        emoji=False,
    )
    with console.capture() as captured:
        console.print(_make_table(columns, entries, chosen))
    return [line.rstrip() for line in captured.get().splitlines()], left_out


def _choose_columns(every: Sequence[_Column], width: int) -> list[_Column] | None:
    """Choose the columns that fit, by importance; None if not even the necessary ones fit."""
    kept = [column for column in every if not column.left_out]
    free = width - sum(column.width for column in kept) - _BETWEEN * (len(kept) - 1)
    if free < 0:
        return None
    for column in sorted(every, key=lambda column: -column.left_out):
        if column.left_out and column.width + _BETWEEN <= free:
            kept.append(column)
            free -= column.width + _BETWEEN
    return [column for column in every if column in kept]


def _make_table(columns: Sequence[_Column], entries: Sequence[dict[str, Any]], chosen: int | None) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(
        box=box.SIMPLE_HEAD, show_edge=False, padding=(0, _BETWEEN - 1, 0, 0), pad_edge=False, header_style="bold"
    )
    for column in columns:
        table.add_column(
            Text(column.heading),
            justify="right" if column.right else "left",
            no_wrap=not column.folds,
            overflow="fold",
            min_width=column.width,
        )
    parted = _are_several(entries, "patient")
    for row, entry in enumerate(entries):
        following = entries[row + 1] if row + 1 < len(entries) else entry
        table.add_row(
            *(Text(column.cells[row]) for column in columns),
            style="bold" if entry["number"] == chosen else "",  # no colours: they are not readable on every ground
            end_section=parted and following["patient"] != entry["patient"],
        )
    return table


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


def _collect_texts(entries: Sequence[dict[str, Any]], place: str) -> Iterator[tuple[str, str]]:
    """Collect texts; a text of several series appears once, with their numbers: ``3, 5-9``."""
    numbers: dict[str, list[int]] = {}
    for entry in entries:
        for text in entry[place]:
            numbers.setdefault(str(text), []).append(entry["number"])
    for text, found in numbers.items():
        runs: list[list[int]] = []
        for number in sorted(found):
            if runs and number == runs[-1][-1] + 1:
                runs[-1].append(number)
            else:
                runs.append([number])
        yield ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs), text


def _wrap(text: str, width: int, indent: str) -> list[str]:
    return textwrap.wrap(
        text,
        width,
        subsequent_indent=indent[: max(width - _NARROWEST, 0)],
        drop_whitespace=True,
        break_on_hyphens=False,
    )
