"""scripts/programs: the module of 3D Slicer as far as Python goes, and the workflow of Snakemake."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
from command_lines import parse_command
from house import ROOT
from refusals import refused

from clrecon import read_mesh
from clrecon.proof.phantom import PhantomSettings, write_phantom

import ClreconSurface  # isort: skip


@pytest.fixture
def program(tmp_path: Path) -> str:
    """A command clrecon of this Python."""
    path = tmp_path / "clrecon"
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m clrecon "$@"\n')
    path.chmod(0o755)
    return str(path)


@pytest.mark.skipif(sys.platform == "win32", reason="the command of this test is a script of a shell")
def test_module_of_slicer_makes_a_surface_in_lps(device: Any, program: str, tmp_path: Path) -> None:
    write_phantom(tmp_path / "ct", PhantomSettings(kind="sphere", size=(32, 32), slices=24))
    mesh_file = str(tmp_path / "bone.ply")

    report = ClreconSurface.make_surface(program, str(tmp_path / "ct"), mesh_file, surface="hu")

    assert report["space"] == "lps"
    assert len(read_mesh(mesh_file).triangles) == report["triangles"]


@pytest.mark.skipif(sys.platform == "win32", reason="the command of this test is a script of a shell")
def test_module_of_slicer_shows_the_line_of_clrecon_for_a_folder_without_scan(program: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with refused(RuntimeError, "DICOM"):
        ClreconSurface.make_surface(program, str(tmp_path / "empty"), str(tmp_path / "bone.ply"))


def test_module_of_slicer_names_a_command_that_is_not_there(tmp_path: Path) -> None:
    with refused(RuntimeError, "no-clrecon"):
        ClreconSurface.make_surface(str(tmp_path / "no-clrecon"), "ct", "bone.ply")


def test_commands_of_the_workflow_are_understood() -> None:
    text = (ROOT / "scripts" / "programs" / "Snakefile").read_text(encoding="utf-8")
    commands = [line.strip().strip('"') for line in text.splitlines() if line.strip().startswith('"clrecon ')]
    assert len(commands) == 2
    for command in commands:
        filled = command.replace("{input}", "in").replace("{output.mesh}", "a.ply").replace("{output.report}", "a.json")
        parse_command(shlex.split(filled.replace("{output}", "a.png"))[1:])
