"""docs/paper.md: its length, its references, and figures that are those of the records."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from house import ROOT

import make_paper_figure  # isort: skip
from make_trust_page import MATRICES, count_wrong  # isort: skip
from marked_tables import find_table  # isort: skip

DOCS = ROOT / "docs"
PAPER = (DOCS / "paper.md").read_text(encoding="utf-8")
BODY = PAPER.split("\n---\n", 1)[1]
CITED = set(re.findall(r"@(\w+)", BODY))


def test_paper_has_the_length_that_joss_asks_for() -> None:
    assert 750 <= len(BODY.split()) <= 1750  # words


def test_references_of_the_paper_are_those_that_it_cites() -> None:
    entries = re.findall(r"^@\w+\{(\w+),", (DOCS / "paper.bib").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(entries) == sorted(CITED)


@pytest.mark.parametrize("name", re.findall(r"\]\((images/[^)]+)\)", BODY))
def test_figure_of_the_paper_is_there(name: str) -> None:
    assert (DOCS / name).is_file()


@pytest.mark.parametrize("rule", ["fitted", "preset"])
def test_distances_in_the_paper_are_those_of_the_records(rule: str) -> None:
    means = [mean for mean, *_ in (of_group[rule] for of_group in make_paper_figure.group_errors().values())]
    assert f"{min(means):.2f} to {max(means):.2f} mm" in " ".join(BODY.split())


def test_misread_and_refused_series_of_the_paper_are_those_of_the_page_of_calibration() -> None:
    page = (DOCS / "calibration.md").read_text(encoding="utf-8")
    of_dicom = list(MATRICES)[:2]  # the others are of other formats
    tables = [count_wrong(find_table(page, name)) for name in of_dicom]
    readers = {
        name: [sum(counts) for counts in zip(*(table[name] for table in tables), strict=True)] for name in tables[0]
    }
    cases, wrong, refused = readers.pop("clrecon")
    others = [wrong for _, wrong, _ in readers.values()]
    text = " ".join(BODY.split())
    assert f"On {cases} series" in text
    assert f"for {min(others)} to {max(others)} series" in text
    assert f"does so for {'none' if wrong == 0 else wrong} and refuses {refused}," in text


def test_figure_is_drawn_from_the_records(tmp_path: Path) -> None:
    make_paper_figure.draw(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 10_000  # measured 44,411 bytes
