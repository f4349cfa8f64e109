"""The matrix of label maps and volumes: every row is exact, warned of or refused, as docs/calibration.md says."""

from __future__ import annotations

from pathlib import Path

import pytest
from label_matrix import EXACT, PLACES, ROWS, WRITERS, expected_mm, judge, read_back, table_of_places, table_of_rows
from marked_tables import find_table, markdown_table

for library in ("nibabel", "nrrd", "SimpleITK", "highdicom"):
    pytest.importorskip(library)

PAGE = Path(__file__).parents[2] / "docs" / "calibration.md"


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", ["label map", "volume"])
def test_places_are_those_that_were_written(tmp_path, name, place, kind):
    assert read_back(name, place, kind, tmp_path) <= expected_mm(name)


@pytest.mark.parametrize("case", ROWS, ids=[case.name for case in ROWS])
def test_odd_files_are_exact_warned_of_or_refused(tmp_path, case):
    verdict, said = judge(case, tmp_path)
    assert (verdict, said if verdict == EXACT else "") == (case.verdict, ""), said
    assert case.words in said


def test_the_tables_of_the_page_are_those_of_the_matrix():
    text = PAGE.read_text(encoding="utf-8")
    for name, (head, rows) in {"places of formats": table_of_places(), "odd label files": table_of_rows()}.items():
        assert find_table(text, name) == markdown_table(head, rows)
