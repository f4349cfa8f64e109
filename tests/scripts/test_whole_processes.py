"""Whole processes: the tables of README and docs/benchmarks.md have the figures, and a mesh is judged rightly."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import clrecon
from clrecon.proof.phantom import PhantomSettings, write_phantom

import marked_tables  # isort: skip
import whole_processes  # isort: skip

TABLES = [(page, name) for page, made in whole_processes.tables().items() for name in made]


@pytest.mark.parametrize(("page", "name"), TABLES, ids=lambda value: getattr(value, "name", value))
def test_the_pages_have_the_figures(page: Path, name: str) -> None:
    assert marked_tables.find_table(page.read_text(encoding="utf-8"), name) == whole_processes.tables()[page][name]


def test_figures_name_no_folder() -> None:
    for path in whole_processes.FIGURES.glob("*.json"):
        assert str(whole_processes.ROOT) not in path.read_text(encoding="utf-8"), path.name


def tetrahedron(folder: Path, name: str, *, shift: float = 0.0, turned: bool = False, faces: int = 4) -> Path:
    corners = np.array([(0, 0, 0), (20, 0, 0), (0, 20, 0), (0, 0, 20)], dtype=np.float32) + np.float32(shift)
    triangles = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], dtype=np.uint32)[:faces]
    path = folder / name
    clrecon.Mesh(corners, triangles[:, ::-1].copy() if turned else triangles).save(path)
    return path


def test_a_mesh_is_judged(tmp_path: Path) -> None:
    own = tetrahedron(tmp_path, "own.stl")
    judged = {
        name: whole_processes.judge_mesh(tetrahedron(tmp_path, f"{name}.stl", **how), own, 1.0)
        for name, how in {"same": {}, "away": {"shift": 50.0}, "turned": {"turned": True}, "open": {"faces": 3}}.items()
    }
    assert [one["closed"] for one in judged.values()] == [True, True, True, False]
    assert [one["in_place"] for one in judged.values()] == [True, False, True, True]
    assert [judged[name]["inside_out"] for name in ("same", "away", "turned")] == [False, False, True]


def test_a_program_that_is_not_there_or_fails_is_a_row_that_says_why(tmp_path: Path, monkeypatch: Any) -> None:
    write_phantom(tmp_path / "ct", PhantomSettings(kind="sphere", size=(24, 24), slices=16))
    known = [
        whole_processes.Program("gone", "Gone", ("no-such-program",), ("no-such-program",)),
        whole_processes.Program("fails", "Fails", (sys.executable, "-c", "raise SystemExit('no luck')")),
    ]
    figures = whole_processes.measure_input("a", tmp_path / "ct", known, 1, tmp_path)
    assert figures["programs"]["gone"]["why"] == "not here: no-such-program"
    assert figures["programs"]["fails"]["why"] == "exit code 1: no luck"
    figures["machine"] = {"processor": "P", "cores": 2, "load_average": None}
    monkeypatch.setattr(whole_processes, "programs", lambda *_: known)
    assert "| Gone | not run (not here: no-such-program) |" in whole_processes.table_of(figures, figures)
