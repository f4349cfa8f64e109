"""The table of what both papers contain: where each function is in clrecon, and which test holds it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAPERS_FOLDER = ROOT / "docs"
COUNT = 62
"""Functions that both papers contain."""

_TABLE = Path(__file__).parent / "functions.json"


@dataclass(frozen=True, kw_only=True)
class PaperFunction:
    """One function of the papers.

    number: 1 to 62, in the order of the papers.
    paper: Paper and section.
    command: Arguments of ``clrecon`` that run it; None where only Python does.
    python: A public name, ``clrecon.read_volume``, or ``module:name``.
    test: File and name of a test, ``tests/room/test_file.py::test_name``.
    figure: Page in docs, or ``#section`` of docs/papers.md, with the figure that belongs to it.
    note: What is not there, and why: such a row may lack the other entries.
    """

    number: int
    function: str
    paper: str
    command: str | None = None
    python: str | None = None
    test: str | None = None
    figure: str | None = None
    note: str | None = None


def load_functions(path: Path = _TABLE) -> list[PaperFunction]:
    """Return the rows of the table, as they stand in the file."""
    return [PaperFunction(**row) for row in json.loads(path.read_text(encoding="utf-8"))]


def find_faults(rows: Sequence[PaperFunction], page: str) -> list[str]:
    """Return what is wrong with the table, a line each: names that are not there, and rows without an explanation.

    page: Text of docs/papers.md; its sections are looked up.
    """
    numbers = [row.number for row in rows]
    faults = [] if numbers == list(range(1, COUNT + 1)) else [f"the rows are not 1 to {COUNT}"]
    sections = {_anchor(line) for line in page.splitlines() if line.startswith("#")}
    for row in rows:
        faults += [f"{row.number}: {fault}" for fault in _faults_of(row, sections)]
    return faults


def _faults_of(row: PaperFunction, sections: set[str]) -> Iterator[str]:
    if row.python is None and row.note is None:
        yield "neither a name in Python nor a note that says why"
    if row.python is not None:
        if not _is_there(row.python):
            yield f"no {row.python}"
        if row.test is None:
            yield "no test"
        if row.figure is None:
            yield "no figure"
    if row.test is not None and not _is_test(row.test):
        yield f"no test {row.test}"
    if row.figure is not None:
        name, _, section = row.figure.partition("#")
        if name and not (PAPERS_FOLDER / name).is_file():
            yield f"no page {name}"
        if not name and section not in sections:
            yield f"no section {row.figure}"


def _is_there(python: str) -> bool:
    """Whether ``clrecon.name`` or ``module:name.attribute`` can be imported."""
    module, _, names = python.partition(":")
    if not names:
        module, _, names = python.rpartition(".")
    try:
        found = import_module(module)
        for name in names.split("."):
            found = getattr(found, name)
    except (ImportError, AttributeError):
        return False
    return True


def _is_test(name: str) -> bool:
    file, _, function = name.partition("::")
    path = ROOT / file
    return path.is_file() and re.search(rf"^def {re.escape(function)}\(", path.read_text("utf-8"), re.M) is not None


def _anchor(heading: str) -> str:
    """Return the anchor of a heading in Markdown."""
    return re.sub(r"[^\w\- ]", "", heading.lstrip("#").strip().lower()).replace(" ", "-")


def table_of_functions(rows: Sequence[PaperFunction]) -> list[str]:
    """Return the table in Markdown, a line each."""
    lines = [
        "| number | function | section of the paper | command | Python | test in `tests/` | figures |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        command = "" if row.command is None else f"`clrecon {row.command}`".replace("|", "\\|")
        name = "" if row.python is None else f"`{row.python.replace(':', '.')}`"
        test = "" if row.test is None else "`{}` `{}`".format(*row.test.removeprefix("tests/").split("::"))
        figure = row.note or ""
        if row.figure is not None:
            link = f"[{row.figure.lstrip('#').removesuffix('.md').replace('-', ' ')}]({row.figure})"
            figure = f"{link} {figure}".strip()
        lines.append(f"| {row.number} | {row.function} | {row.paper} | {command} | {name} | {test} | {figure} |")
    return lines
