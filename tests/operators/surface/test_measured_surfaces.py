"""What the measures of accuracy say of surfaces by marching cubes."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dicom_series import rotation
from surface_volumes import smooth_volume
from uneven_volume import uneven

from clrecon.geometry import Volume
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.methods import extract_by_method
from clrecon.proof.compare.mesh_cells import find_mesh_cells, measure_cells
from clrecon.proof.compare.mesh_slices import measure_slices
from clrecon.proof.compare.mesh_truth import measure_truth
from clrecon.proof.phantom import PhantomSettings, phantom_truth
from clrecon.reading import read_volume

TILTED = np.eye(4)
TILTED[:3, :3] = rotation((20.0, -35.0, 10.0)) @ np.array([[0.7, 0.0, 0.0], [0.0, 0.7, 0.4], [0.0, 0.0, 1.1]])
TILTED[:3, 3] = (-120.0, 80.0, -700.0)


def uneven_field() -> Volume:
    return uneven(smooth_volume((6, 25, 24)).voxels)


def active_cells(volume: Volume, level: float) -> set[tuple[int, ...]]:
    """Cells of the closed volume with corners on both sides."""
    inside = np.pad(volume.voxels >= level, 1)
    nk, nj, ni = (size - 1 for size in inside.shape)
    corners = [inside[c : c + nk, b : b + nj, a : a + ni] for c, b, a in itertools.product((0, 1), repeat=3)]
    count = np.sum(corners, axis=0)
    return set(map(tuple, (np.argwhere((count > 0) & (count < 8))[:, ::-1] - 1).tolist()))


@pytest.mark.parametrize("made", [lambda: smooth_volume((17, 20, 24), TILTED), uneven_field], ids=["tilted", "uneven"])
@pytest.mark.parametrize("rule", ["linear", "golden"])
def test_marching_cubes_passes_through_the_active_cells(made: Any, rule: str, device: Any) -> None:
    volume = made()
    mesh = extract_isosurface(volume, 100, device=device, vertex_rule=rule)
    assert set(map(tuple, find_mesh_cells(mesh, volume).ijk.tolist())) == active_cells(volume, 100)


@pytest.mark.parametrize("made", [lambda: smooth_volume((17, 20, 24), TILTED), uneven_field], ids=["tilted", "uneven"])
def test_only_the_fine_lattice_sees_the_vertex_rule(made: Any, device: Any) -> None:
    volume = made()
    linear, golden = (extract_isosurface(volume, 100, device=device, vertex_rule=rule) for rule in ("linear", "golden"))
    cells = measure_cells(golden, linear, volume)
    assert (cells.recall, cells.precision, cells.dice, cells.jaccard) == (1.0, 1.0, 1.0, 1.0)
    told: list[Any] = []
    better = measure_slices(linear, volume, 100, progress=lambda *what: told.append(what))
    worse = measure_slices(golden, volume, 100)
    assert better.voxel_dice == worse.voxel_dice == 1.0
    assert better.rows_odd == worse.rows_odd == 0
    assert better.dice > 0.985
    assert worse.dice < better.dice - 0.02
    assert told[0][:2] == ("slices", 0) and told[-1][1] == told[-1][2]


@pytest.mark.parametrize("kind", ["sphere", "torus"])
def test_bias_is_of_the_level_and_scatter_of_the_rule(kind: str, device: Any) -> None:
    truth = phantom_truth(PhantomSettings(kind=kind, size=(96, 96), slices=60, oblique=(20.0, 10.0, 5.0)))
    ijk = np.indices((60, 96, 96)).reshape(3, -1)[::-1].T
    depth = -truth.signed_distance(ijk @ truth.affine[:3, :3].T + truth.affine[:3, 3])
    volume = Volume((np.clip(depth / 3.0, -1.0, 1.0) * 500.0).astype(np.int16).reshape(60, 96, 96), truth.affine)
    found = {
        (level, rule): measure_truth(
            extract_isosurface(volume, level, device=device, vertex_rule=rule), truth, grid=volume, reach_mm=2.0
        )
        for level, rule in itertools.product((0, -100), ("linear", "golden"))
    }
    for rule in ("linear", "golden"):  # 100 HU are 0.6 mm
        moved = found[-100, rule].bias_mm - found[0, rule].bias_mm
        assert moved == pytest.approx(0.6, abs=0.03)
    for level in (0, -100):
        assert found[level, "linear"].scatter_mm < 0.03
        assert found[level, "golden"].scatter_mm > 0.15
        assert found[level, "linear"].normals_median_deg < found[level, "golden"].normals_median_deg / 2
        assert found[level, "linear"].outer_share == 1.0


@pytest.mark.release  # figures of documents; every day: a phantom's, whose truth is known
def test_a_real_scan_gives_the_figures_of_the_documents(real_data: Path, device: Any) -> None:
    scan = read_volume(real_data / "thoracic_0p8mm")
    volume = Volume(scan.voxels[55:], scan.affine)
    linear, golden, thinned = (
        extract_by_method(volume, 200, method, device=device, **more)
        for method, more in (("t-mc", {}), ("t-mc", {"vertex_rule": "golden"}), ("g-mc", {"decimate": 0.9}))
    )
    fine = [measure_slices(mesh, volume, 200) for mesh in (linear, golden, thinned)]
    assert [round(found.dice, 3) for found in fine] == pytest.approx([0.993, 0.952, 0.981], abs=0.0011)
    assert [found.voxel_dice for found in fine[:2]] == [1.0, 1.0]
    assert measure_cells(golden, linear, volume).dice == 1.0
    assert measure_cells(thinned, linear, volume).dice == pytest.approx(0.933, abs=0.002)
