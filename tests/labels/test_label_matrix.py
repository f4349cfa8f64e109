"""The matrix of label maps and volumes: every row is exact, warned of or refused, as docs/calibration.md says."""

from __future__ import annotations

from pathlib import Path

import pytest
from label_matrix import PLACES, ROWS, WRITERS, expected_mm, judge, read_back, table_of_places, table_of_rows
from marked_tables import find_table, markdown_table

for library in ("nibabel", "nrrd", "SimpleITK", "highdicom"):
    pytest.importorskip(library)

PAGE = Path(__file__).parents[2] / "docs" / "calibration.md"


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("kind", ["label map", "volume"])
def test_file_is_read_with_the_voxels_and_at_the_place_that_were_written(tmp_path, name, place, kind):
    error_mm = read_back(name, place, kind, tmp_path)  # of the corners; infinite where the voxels are others
    assert error_mm <= expected_mm(name)


@pytest.mark.parametrize("case", ROWS, ids=[case.name for case in ROWS])
def test_odd_label_file_is_exact_warned_of_or_refused_as_its_row_says(tmp_path, case):
    verdict, warning_or_refusal = judge(case, tmp_path)  # writes the file of the row, reads it, compares the voxels
    assert verdict == case.verdict, warning_or_refusal
    assert case.words in warning_or_refusal


@pytest.mark.parametrize(
    ("name", "table"),
    [("places of formats", table_of_places), ("odd label files", table_of_rows)],
    ids=["places", "odd"],
)
def test_table_of_the_page_is_that_of_the_matrix(name, table):
    text = PAGE.read_text(encoding="utf-8")
    assert find_table(text, name) == markdown_table(*table())
