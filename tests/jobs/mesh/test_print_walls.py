"""Walls of a print, and of the bone that it shows, on plates whose thickness is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from thin_walls import Shape, Values, draw_shape

from clrecon import Mesh, Volume, read_mesh
from clrecon.cli.main import main

PLATE_MM, ENDS_MM, SLOPE = 12.0, 18.0, 1.1


def draw_plate(*, thickness_mm: float, marrow_mm: float = 0.0) -> Volume:
    """A round plate that grows to a rim of 5 mm, by `SLOPE` mm a mm, with a layer of marrow in its middle."""

    def in_plate(x: Values, y: Values, z: Values) -> np.ndarray:
        far = np.hypot(x, y)
        whole = np.clip(thickness_mm + SLOPE * (far - PLATE_MM), thickness_mm, 5.0)
        return (2.0 * np.abs(z) < whole) & (far < ENDS_MM)

    def hu(x: Values, y: Values, z: Values) -> Values:
        is_marrow = (2.0 * np.abs(z) < marrow_mm) & (np.hypot(x, y) < PLATE_MM)
        around = np.where(np.abs(z) > 7.0, -1000.0, 50.0)
        return np.where(is_marrow, 250.0, np.where(in_plate(x, y, z), 1100.0, around))

    size_mm, spacing = (42.0, 42.0, 18.0), (0.5, 0.5, 0.6)
    return draw_shape(Shape(hu, in_plate, size_mm, spacing, blur_mm=0.5, noise=20.0, bone_hu=1100.0, tissue_hu=50.0))


def plate_share(mesh: Mesh) -> float:
    """Share of a surface on which the plate is thinnest."""
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    x, y, _ = corners.mean(axis=1).T
    return float(areas[np.hypot(x, y) < PLATE_MM].sum() / areas.sum())


def print_plate(tmp_path: Path, device: Any, volume: Volume, *more: str) -> tuple[Mesh, dict[str, Any]]:
    """Mesh a volume for a print, with further options; return the mesh and the report."""
    volume.save(tmp_path / "ct.nii.gz")
    given = ["mesh", str(tmp_path / "ct.nii.gz"), "-o", str(tmp_path / "a.ply"), "--for", "print", *more]
    assert main([*given, "--device", str(device.index), "--report", str(tmp_path / "a.json")]) == 0
    return read_mesh(tmp_path / "a.ply"), json.loads((tmp_path / "a.json").read_text())


@pytest.mark.opencl
@pytest.mark.parametrize(("thickness_mm", "surface"), [(0.6, "hu"), (0.8, "hu"), (0.6, "cortex")])
def test_share_of_bone_below_a_millimetre_is_that_of_the_plate(
    device: Any, tmp_path: Path, thickness_mm: float, surface: str
) -> None:
    mesh, report = print_plate(tmp_path, device, draw_plate(thickness_mm=thickness_mm), "--surface", surface)
    bone, share = report["print"]["bone_wall"], plate_share(mesh)
    assert share > 0.3  # enough of the surface to judge: measured 0.32 and more
    assert bone["thin_share"] == pytest.approx(share, abs=0.04)  # measured 0.006 to 0.026 apart
    assert bone["p5_mm"] == pytest.approx(thickness_mm, abs=0.1)  # measured 0.02 to 0.06 apart
    assert bone["not_measured"] < 0.01 * bone["samples"]  # measured 15 of 20,000 and fewer
    of_print = report["print"]["wall"]["thin_share"]
    assert of_print == pytest.approx(share if surface == "cortex" else 0.0, abs=0.04)


@pytest.mark.opencl
def test_two_thin_cortices_are_one_wall_of_bone(device: Any, tmp_path: Path) -> None:
    _, report = print_plate(tmp_path, device, draw_plate(thickness_mm=1.5, marrow_mm=0.5))
    bone = report["print"]["bone_wall"]
    # Below 1 mm is thin, as each cortex of 0.5 mm alone would be; the plate measured 0 and 1.18 mm.
    assert bone["thin_share"] < 0.01 and bone["p5_mm"] > 1.1


@pytest.mark.opencl
def test_a_print_without_walls_of_bone_has_its_own_alone(
    device: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    volume = draw_plate(thickness_mm=2.0)
    metal = volume.with_voxels(np.where(volume.voxels > 500, 3000, volume.voxels).astype(np.int16))
    _, report = print_plate(tmp_path, device, metal, "--hu", "1800")
    # Of metal of 2 mm, blurred, and no bone.
    assert report["print"]["bone_wall"] is None and report["print"]["wall"]["median_mm"] > 1.0
    told = capsys.readouterr().out
    assert "walls of the print: " in told and "walls of the bone" not in told
