#!/usr/bin/env python3
"""The trap matrix: where clrecon and other readers place the voxels of difficult CT series.

    python scripts/proof/compare_readers.py [--table NAME] [--only TEXT] [--readers NAMES] [--json FILE] [--markdown]

The table "places" has series whose voxels are easily placed wrongly.  The table "doubts" has series that look right but
are not: a volume of them is wrong.  Each cell has the largest distance in mm of a corner voxel of any slice from its
true place, and S (silent), W (the reader warned) or R (it refused).  The cases of tests/support/trap_cases.py are
written into a temporary folder.  Every reader runs with its defaults, in a new process for every case, with a time
limit.  A reader that is not installed gives n/a.
All of them: pip install SimpleITK highdicom dicom2nifti dicom-numpy dcm2niix nibabel.
"""

from __future__ import annotations

import argparse
import configparser
import datetime
import importlib.metadata
import json
import logging
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support"), str(ROOT / "scripts"), str(ROOT / "scripts" / "guide")]

from reader_peers import READERS  # noqa: E402
from trap_cases import CASES  # noqa: E402
from trap_plan import FIELD_SIZE, Case, Marks, Size  # noqa: E402

SILENT_MM = 0.01
"""Largest error of a voxel in mm; a larger one without a warning is a silent fault (bold in the table)."""
FAULTS = (AttributeError, IndexError, KeyError, NameError, OverflowError, TypeError, UnboundLocalError)
"""Exceptions that mean a fault of a reader, not a refusal."""


@dataclass
class Cell:
    """Result of one reader for one case.

    verdict: S, W, R, crash, timeout or n/a.
    error_mm: Largest distance of a mark from its place; None if no mark was read.
    notes: "mixed": other images are among the slices; "lost": share of the marks that are missing.
    told: First warning, or the refusal.
    """

    verdict: str
    error_mm: float | None = None
    shape: list[int] | None = None
    notes: list[str] | None = None
    told: str = ""

    def is_silent_fault(self, doubtful: bool = False) -> bool:
        """True for a wrong volume without a warning; every volume of a `doubtful` series is wrong."""
        if doubtful:
            return self.verdict == "S"
        doubts = [note for note in self.notes or [] if not note.startswith(("+", "4D"))]
        return self.verdict == "S" and (self.error_mm is None or self.error_mm > SILENT_MM or bool(doubts))

    def text(self) -> str:
        if self.verdict not in ("S", "W"):
            return self.verdict
        number = "-"
        if self.error_mm is not None:
            number = f"{self.error_mm:.3g}" if self.error_mm >= 1.0 else f"{self.error_mm:.3f}".rstrip("0").rstrip(".")
        return ", ".join([f"{number} {self.verdict}", *(self.notes or [])])


def is_installed(reader: str) -> str | None:
    """Return the version of a reader, None if it is not installed."""
    if reader == "clrecon":  # the clrecon of this folder, installed or not
        settings = configparser.ConfigParser()
        settings.read(ROOT / "setup.cfg")
        return settings["metadata"]["version"]
    try:
        return importlib.metadata.version(READERS[reader][0])
    except importlib.metadata.PackageNotFoundError:
        return None


def judge(found: dict[str, Any], truth: Marks) -> Cell:
    """Compare the marks that a child process read with the true ones."""
    if "refused" in found:
        return Cell(found["verdict"], told=found["refused"])
    best = max(found["volumes"], key=lambda volume: np.isin(volume["hu"], truth.hu).sum())
    hu, places = np.array(best["hu"], dtype=int), np.array(best["lps_mm"], dtype=float).reshape(-1, 3)
    known = np.isin(hu, truth.hu)
    order = np.argsort(truth.hu)
    expected = truth.lps_mm[order][np.searchsorted(truth.hu[order], hu[known])]
    errors = np.linalg.norm(places[known] - expected, axis=1)
    notes = list(best["notes"])
    if truth.slices not in best["shape"]:
        count = best["shape"][2]
        notes.append(f"{count} slice{'s' * (count != 1)}")
    if not known.all() and known.any():
        notes.append("mixed")
    lost = 1.0 - np.isin(truth.hu, hu).mean()
    if lost > 0.0 and truth.slices in best["shape"] and not best["notes"]:
        notes, errors = ["HU wrong"], errors[:0]  # all slices are there, but the marks cannot be told apart
    elif lost > 0.0:
        notes.append(f"{lost:.0%} lost")
    if np.isnan(errors).any():
        notes.append("two frames as one")
        errors = errors[~np.isnan(errors)]
    verdict = "W" if found["warnings"] else "S"
    told = found["warnings"][0] if found["warnings"] else ""
    return Cell(verdict, float(errors.max()) if errors.size else None, best["shape"], notes, told)


def read_marks(reader: str, folder: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Read a folder with one reader: its marks and warnings, or its refusal.  Runs in a child process."""
    records: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            records.append(record.getMessage())

    logging.getLogger().addHandler(Listener(logging.WARNING))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            reading = READERS[reader][1](folder, options)
        except Exception as error:
            verdict = f"crash ({type(error).__name__})" if isinstance(error, FAULTS) else "R"
            return {"refused": f"{type(error).__name__}: {error}", "verdict": verdict}
    volumes = []
    for candidate in reading.candidates:
        ijk = np.argwhere(candidate.voxels > 0)
        places = candidate.ijk_to_lps(ijk)
        hu = np.rint(candidate.voxels[tuple(ijk.T)]).astype(int)
        volumes.append(
            {
                "hu": hu.tolist(),
                "lps_mm": places.tolist(),
                "shape": list(candidate.voxels.shape),
                "notes": list(candidate.notes),
            }
        )
    told = [str(warning.message) for warning in caught if not issubclass(warning.category, DeprecationWarning)]
    return {"volumes": volumes, "warnings": [*reading.warnings, *records, *told]}


def ask_reader(reader: str, folder: Path, truth: Marks, options: dict[str, Any], seconds: float) -> Cell:
    """Let one reader read one case in a child process."""
    if is_installed(reader) is None:
        return Cell("n/a")
    with tempfile.TemporaryDirectory() as scratch:
        result = Path(scratch) / "found.json"
        command = [sys.executable, __file__, "--child", reader, str(folder), str(result), json.dumps(options)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=seconds)
        except subprocess.TimeoutExpired:
            return Cell("timeout")
        if not result.is_file():
            return Cell("crash", told=f"exit code {done.returncode}: {done.stderr.strip()[-300:]}")
        found = json.loads(result.read_text())
        # Compiled libraries write their warnings to standard error themselves.
        found.setdefault("warnings", []).extend(
            line for line in done.stderr.splitlines() if "warning" in line.lower() and "refused" not in found
        )
        return judge(found, truth)


def ask_all(case: Case, size: Size, readers: Sequence[str], seconds: float) -> dict[str, Cell]:
    """Fill one row: the case is written once and read by every reader."""
    with tempfile.TemporaryDirectory() as folder:
        truth = case.write(Path(folder), size)
        row = {reader: ask_reader(reader, Path(folder), truth, {}, seconds) for reader in readers}
        if "clrecon" in row and row["clrecon"].verdict == "R" and case.again:
            options = dict(case.again)
            again = ask_reader("clrecon", Path(folder), truth, options, seconds)
            name, value = next(iter(options.items()))
            flag = f"--{name.replace('_', '-')}" + ("" if value is True else f" {value}")
            row["clrecon"].notes = [f"{flag}: {again.text()}"]
    return row


def is_doubtful(name: str) -> bool:
    """True for a case that looks right but is not."""
    return name in CASES and CASES[name].looks_right and not CASES[name].harmless


def describe_cell(cell: Cell, bold: bool, doubtful: bool = False) -> str:
    text = cell.text()
    if cell.verdict == "R" and cell.notes:
        text = f"R; {cell.notes[0]}"
    return f"**{text}**" if bold and cell.is_silent_fault(doubtful) else text


def make_table(rows: dict[str, dict[str, Cell]], readers: Sequence[str], markdown: bool) -> list[str]:
    """Return the lines of the table, one for each case."""
    cells = [["case", *readers]]
    for name, row in rows.items():
        cells.append([name, *(describe_cell(row[reader], markdown, is_doubtful(name)) for reader in readers)])
    if markdown:
        lines = ["| " + " | ".join(line) + " |" for line in cells]
        return [lines[0], "|" + "---|" * len(cells[0]), *lines[1:]]
    widths = [max(len(line[column]) for line in cells) for column in range(len(cells[0]))]
    return ["  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip() for line in cells]


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="TEXT", default="", help="cases whose name holds TEXT")
    parser.add_argument("--table", choices=("places", "doubts", "all"), default="all")
    parser.add_argument("--readers", metavar="NAMES", default=",".join(READERS), help="comma list, default all")
    parser.add_argument("--small", action="store_true", help="24 slices of 7 x 6 instead of 120 of 56 x 48")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write all figures and messages there")
    parser.add_argument("--markdown", action="store_true", help="print the table for docs/calibration.md")
    parser.add_argument("--jobs", metavar="N", type=int, default=1, help="cases at a time")
    parser.add_argument("--timeout", metavar="SECONDS", type=float, default=120.0, help="for one reader and case")
    options = parser.parse_args(arguments)
    options.readers = [name.strip() for name in options.readers.split(",") if name.strip()]
    unknown = [name for name in options.readers if name not in READERS]
    if unknown:
        parser.error(f"unknown readers {', '.join(unknown)}; there are {', '.join(READERS)}")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    options = parse_arguments(arguments)
    chosen = {name: case for name, case in CASES.items() if options.only in name}
    if options.table != "all":
        chosen = {name: case for name, case in chosen.items() if case.looks_right == (options.table == "doubts")}
    size = Size() if options.small else FIELD_SIZE
    with ThreadPoolExecutor(options.jobs) as pool:
        asked = pool.map(lambda case: ask_all(case, size, options.readers, options.timeout), chosen.values())
        rows = dict(zip(chosen, asked, strict=True))
    versions = {reader: is_installed(reader) for reader in options.readers}
    named = ", ".join(f"{reader} {version or 'not installed'}" for reader, version in versions.items())
    today = datetime.date.today().isoformat()
    for line in make_table(rows, options.readers, options.markdown):
        print(line)
    print(f"\n{size.slices} slices of {size.columns} x {size.rows}, {today}: {named}.")
    if options.json:
        found = {name: {reader: asdict(cell) for reader, cell in row.items()} for name, row in rows.items()}
        options.json.write_text(json.dumps({"date": today, "versions": versions, "cases": found}, indent=1) + "\n")
    silent = [
        name for name, row in rows.items() if "clrecon" in row and row["clrecon"].is_silent_fault(is_doubtful(name))
    ]
    for name in silent:
        print(f"clrecon is silently wrong: {name}", file=sys.stderr)
    return 1 if silent else 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        _, _, name, source, target, asked_options = sys.argv
        Path(target).write_text(json.dumps(read_marks(name, Path(source), json.loads(asked_options))))
        sys.exit(0)
    sys.exit(main())
