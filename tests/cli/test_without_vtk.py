"""Commands in an installation that has neither VTK nor pyvista."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clrecon import read_mesh
from clrecon.cli.main import main
from clrecon.proof.phantom import PhantomSettings, write_phantom

OF_VTK = ("vtk", "vtkmodules", "pyvista")


@pytest.fixture
def without_vtk(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in {*OF_VTK, *(name for name in sys.modules if name.split(".")[0] in OF_VTK)}:
        monkeypatch.setitem(sys.modules, name, None)


def test_meshes_are_smoothed_decimated_printed_compared_and_written(
    device: Any, without_vtk: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(ModuleNotFoundError):
        from vtkmodules import vtkCommonCore  # noqa: F401
    monkeypatch.chdir(tmp_path)
    write_phantom(tmp_path / "ct", PhantomSettings(size=(80, 80), slices=30, spacing=(2.4, 2.4, 3.0)))
    for command in (
        "mesh ct -o a.vtp --smooth",
        "mesh ct -o b.ply --decimate 0.5",
        "mesh ct -o c.stl --for print",
        "cloud ct -o d.vtp",
        "distance b.ply a.vtp -o e.ply --picture e.png",
    ):
        assert main([*command.split(), *([] if "distance" in command else ["--device", str(device.index)])]) == 0, (
            command
        )
    mesh = read_mesh("b.ply")
    assert mesh.closest_points(mesh.vertices[:3])[1] == pytest.approx(0.0, abs=1e-6)
    middle = mesh.vertices[mesh.triangles[:3]].mean(axis=1)
    assert np.isfinite(mesh.ray(middle + [0.0, 0.0, 500.0], middle - (middle + [0.0, 0.0, 500.0]))).all()
