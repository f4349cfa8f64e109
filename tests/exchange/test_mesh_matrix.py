"""Meshes in files with known places, read back: ours of every format, and those of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from house import ROOT
from marked_tables import find_table
from mesh_matrix import CASES, MeshCase, read_with_clrecon

import clrecon
from clrecon.errors import RefusedInputError

TABLE = "meshes"


READABLE = [case for case in CASES if not case.refused]
FAR_ROUNDING_MM = 1e-9  # float64 coordinates of 1e5 mm


@pytest.mark.parametrize("case", READABLE, ids=[case.name for case in READABLE])
def test_mesh_of_every_program_is_read_with_its_corners_in_place(case: MeshCase, tmp_path: Path) -> None:
    path = tmp_path / f"a{case.extension}"
    case.write(path)
    mesh = clrecon.read_mesh(path)
    assert (mesh.vertex_count, mesh.triangle_count) == (len(case.vertices), len(case.faces))
    read, true = mesh.vertices[mesh.triangles], case.vertices[case.faces]
    # Where a mirror reverses a triangle, it begins at another corner.
    errors = [np.abs(np.roll(read, turn, axis=1) - true).max(axis=(1, 2)) for turn in range(3)]
    is_far = np.abs(true).max() > 1e4  # corners 100 m from the origin
    rounding = case.tolerance or (FAR_ROUNDING_MM if is_far else 0.0)  # near the origin nothing is rounded
    assert np.min(errors, axis=0).max() <= rounding


@pytest.mark.parametrize("case", READABLE, ids=[case.name for case in READABLE])
def test_mesh_of_every_program_is_read_closed_and_outward_with_names_and_colours(
    case: MeshCase, tmp_path: Path
) -> None:
    path = tmp_path / f"a{case.extension}"
    case.write(path)
    quality = clrecon.read_mesh(path).quality()
    assert quality.closed
    assert quality.outward
    _, _, losses = read_with_clrecon(path, case).partition(",")  # after the error in mm: names, colours ...
    assert losses == ""


REFUSED = [case for case in CASES if case.refused]


@pytest.mark.parametrize("case", REFUSED, ids=[case.name for case in REFUSED])
def test_mesh_that_cannot_be_placed_is_refused(case: MeshCase, tmp_path: Path) -> None:
    path = tmp_path / f"a{case.extension}"
    case.write(path)
    with pytest.raises(RefusedInputError, match=case.refused):
        clrecon.read_mesh(path)


def test_table_of_the_page_has_every_mesh_case_and_its_outcome(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
    lines = find_table(text, TABLE).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    assert len(CASES) >= 40  # there are 58: a list that was lost would agree with an empty table
    assert [row[0] for row in cells] == [case.name for case in CASES]
    for number, case in enumerate(CASES):
        path = tmp_path / f"{number}{case.extension}"
        case.write(path)
        assert cells[number][1] == read_with_clrecon(path, case), case.name
