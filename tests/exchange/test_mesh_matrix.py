"""Meshes in files with known places, read back: ours of every format, and those of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from house import ROOT
from mesh_matrix import CASES, MeshCase, read_with_clrecon

import clrecon
from clrecon.errors import RefusedInputError

TABLE = "meshes"


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_every_corner_comes_back_to_its_place(case: MeshCase, tmp_path: Path) -> None:
    path = tmp_path / f"a{case.extension}"
    case.write(path)
    if case.refused:
        with pytest.raises(RefusedInputError, match=case.refused):
            clrecon.read_mesh(path)
        return
    mesh = clrecon.read_mesh(path)
    assert mesh.vertex_count == len(case.vertices) and mesh.triangle_count == len(case.faces)
    found, true = mesh.vertices[mesh.triangles], case.vertices[case.faces]
    # Where a mirror turns a triangle round, it begins at another corner.
    errors = [np.abs(np.roll(found, turn, axis=1) - true).max(axis=(1, 2)) for turn in range(3)]
    rounding = case.tolerance or (1e-9 if "away" in case.name else 0.0)
    assert np.min(errors, axis=0).max() <= rounding
    quality = mesh.quality()
    assert quality.closed and quality.outward
    assert read_with_clrecon(path, case).partition(",")[2] == ""


def test_table_of_the_page_has_every_mesh_case_and_its_outcome(tmp_path: Path) -> None:
    from marked_tables import find_table

    text = (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
    lines = find_table(text, TABLE).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    assert [row[0] for row in cells] == [case.name for case in CASES]
    assert len(CASES) >= 40
    for number, case in enumerate(CASES):
        path = tmp_path / f"{number}{case.extension}"
        case.write(path)
        assert cells[number][1] == read_with_clrecon(path, case), case.name
