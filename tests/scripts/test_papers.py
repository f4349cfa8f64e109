"""The page on both papers: the names, tests and commands in it exist, and its figures are the recorded ones."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest
from command_lines import parse_command
from house import ABSOLUTE_PATH

import paper_functions  # isort: skip
import papers  # isort: skip

PAGE = papers.PAGE.read_text(encoding="utf-8")
ROWS = paper_functions.load_functions()


def test_each_function_of_the_papers_has_its_name_test_and_figure() -> None:
    assert paper_functions.find_faults(ROWS, PAGE) == []


@pytest.mark.parametrize("row", [row for row in ROWS if row.command], ids=lambda row: str(row.number))
def test_command_of_a_function_of_the_papers_is_understood(row: paper_functions.PaperFunction) -> None:
    assert row.command is not None
    parse_command(shlex.split(row.command))


def test_page_on_the_papers_is_what_the_script_makes_of_the_figures() -> None:
    assert papers.make_page_from(papers.FIGURES) == PAGE


@pytest.mark.parametrize("path", sorted(papers.FIGURES.glob("*.json")), ids=lambda path: path.stem)
def test_recorded_figures_of_the_papers_name_no_folder_and_no_patient(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert ABSOLUTE_PATH.findall(text) == []
    assert "PatientName" not in text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"python": "clrecon.no_such_name"}, "1: no clrecon.no_such_name"),
        ({"python": None}, "1: neither a name in Python nor a note that says why"),
        ({"test": "tests/mesh/test_mesh.py::test_nothing"}, "1: no test tests/mesh/test_mesh.py::test_nothing"),
        ({"test": None}, "1: no test"),
        ({"figure": "no_page.md"}, "1: no page no_page.md"),
        ({"figure": "#no-section"}, "1: no section #no-section"),
        ({"number": 3}, "the rows are not 1 to 62"),
    ],
)
def test_fault_of_a_row_of_the_functions_of_the_papers_is_named(change: dict, words: str) -> None:
    assert words in paper_functions.find_faults([replace(ROWS[0], **change), *ROWS[1:]], PAGE)
