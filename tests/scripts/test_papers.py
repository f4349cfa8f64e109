"""The page on both papers: what it names is there, and it says what the figures say."""

from __future__ import annotations

import shlex
from dataclasses import replace

import pytest
from command_lines import parse_command
from house import ROOT

import paper_functions  # isort: skip
import papers  # isort: skip

PAGE = papers.PAGE.read_text(encoding="utf-8")
ROWS = paper_functions.load_functions()


def test_each_function_has_its_place_test_and_figure() -> None:
    assert paper_functions.find_faults(ROWS, PAGE) == []


@pytest.mark.parametrize("row", [row for row in ROWS if row.command], ids=lambda row: str(row.number))
def test_commands_of_the_papers_are_understood(row: paper_functions.PaperFunction) -> None:
    assert row.command is not None
    parse_command(shlex.split(row.command))


def test_the_page_is_what_the_script_makes() -> None:
    assert papers.make_page_from(papers.FIGURES) == PAGE


def test_figures_name_no_folder() -> None:
    for path in papers.FIGURES.glob("*.json"):
        text = path.read_text(encoding="utf-8")
        assert "/work" not in text and str(ROOT) not in text and "PatientName" not in text, path.name


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
def test_a_wrong_row_is_found(change: dict, words: str) -> None:
    assert words in paper_functions.find_faults([replace(ROWS[0], **change), *ROWS[1:]], PAGE)
