"""Times of whole processes: the tables of README and docs/benchmarks.md have them, and meshes are judged rightly."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from house import ABSOLUTE_PATH

import clrecon
from clrecon.proof.phantom import PhantomSettings, write_phantom

import marked_tables  # isort: skip
import whole_processes  # isort: skip

TABLES = [(page, name) for page, made in whole_processes.tables().items() for name in made]


@pytest.mark.parametrize(("page", "name"), TABLES, ids=lambda value: getattr(value, "name", value))
def test_page_has_the_table_of_the_recorded_times(page: Path, name: str) -> None:
    assert marked_tables.find_table(page.read_text(encoding="utf-8"), name) == whole_processes.tables()[page][name]


@pytest.mark.parametrize("path", sorted(whole_processes.FIGURES.glob("*.json")), ids=lambda path: path.stem)
def test_recorded_times_name_no_folder_of_a_machine(path: Path) -> None:
    assert ABSOLUTE_PATH.findall(path.read_text(encoding="utf-8")) == []


def tetrahedron(folder: Path, name: str, *, shift: float = 0.0, turned: bool = False, faces: int = 4) -> Path:
    """A file with a tetrahedron of 20 mm, shifted in mm along each axis, or with its faces turned, or some of them."""
    corners = np.array([(0, 0, 0), (20, 0, 0), (0, 20, 0), (0, 0, 20)], dtype=np.float32) + np.float32(shift)
    triangles = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], dtype=np.uint32)[:faces]
    path = folder / name
    clrecon.Mesh(corners, triangles[:, ::-1].copy() if turned else triangles).save(path)
    return path


@pytest.mark.parametrize(
    ("change", "closed", "in_place", "inside_out"),
    [
        pytest.param({}, True, True, False, id="same"),
        pytest.param({"shift": 50.0}, True, False, False, id="50 mm away"),
        pytest.param({"turned": True}, True, True, True, id="faces turned"),
    ],
)
def test_mesh_of_another_program_is_judged_by_its_place_and_the_side_of_its_faces(
    change: dict[str, Any], closed: bool, in_place: bool, inside_out: bool, tmp_path: Path
) -> None:
    own = tetrahedron(tmp_path, "own.stl")
    judged = whole_processes.judge_mesh(tetrahedron(tmp_path, "other.stl", **change), own, voxel_mm=1.0)
    assert (judged["closed"], judged["in_place"], judged["inside_out"]) == (closed, in_place, inside_out)


def test_mesh_of_another_program_that_lacks_a_face_is_judged_as_open(tmp_path: Path) -> None:
    own = tetrahedron(tmp_path, "own.stl")
    judged = whole_processes.judge_mesh(tetrahedron(tmp_path, "other.stl", faces=3), own, voxel_mm=1.0)
    assert (judged["closed"], judged["in_place"]) == (False, True)


MISSING = whole_processes.Program("gone", "Gone", ("no-such-program",), ("no-such-program",))
FAILING = whole_processes.Program("fails", "Fails", (sys.executable, "-c", "raise SystemExit('no luck')"))


@pytest.fixture
def figures(tmp_path: Path) -> dict[str, Any]:
    """Figures of two programs that make no mesh of a synthetic scan."""
    write_phantom(tmp_path / "ct", PhantomSettings(kind="sphere", size=(24, 24), slices=16))
    return whole_processes.measure_input("a", tmp_path / "ct", [MISSING, FAILING], rounds=1, scratch=tmp_path)


@pytest.mark.parametrize(("name", "why"), [("gone", "not here: no-such-program"), ("fails", "exit code 1: no luck")])
def test_program_that_is_missing_or_fails_has_the_reason_in_its_figures(
    name: str, why: str, figures: dict[str, Any]
) -> None:
    assert figures["programs"][name]["why"] == why


def test_program_that_is_missing_has_a_row_with_the_reason(figures: dict[str, Any], monkeypatch: Any) -> None:
    figures["machine"] = {"processor": "P", "cores": 2, "load_average": None}
    monkeypatch.setattr(whole_processes, "programs", lambda *_: [MISSING, FAILING])
    assert "| Gone | not run (not here: no-such-program) |" in whole_processes.table_of(figures, figures)
