"""Runs of points on a lattice, against the trilinear field point by point."""

from __future__ import annotations

import numpy as np
import pytest
from sample_meshes import torus
from surface_volumes import OBLIQUE, random_volume, smooth_volume
from uneven_volume import uneven

from clrecon.exchange.vtp import make_polydata
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.mesh import Mesh
from clrecon.mesh.compare.iso_distance import trilinear_values
from clrecon.proof.compare.mesh_slices import Lattice, count_points, exclusive_or, find_level_runs, find_piercings

pytestmark = pytest.mark.unit


def noise() -> Volume:
    return random_volume((5, 7, 9))


def uneven_noise() -> Volume:
    return uneven(random_volume((6, 5, 4)).voxels)


def filled(keys: np.ndarray, lattice: Lattice) -> np.ndarray:
    """The points inside, shape (nk, nj, ni)."""
    ni, nj, nk = lattice.shape_ijk
    ends = np.zeros(nk * nj * (ni + 1), dtype=bool)
    ends[keys] = True
    return np.logical_xor.accumulate(ends.reshape(nk, nj, ni + 1), axis=2)[:, :, :-1]


def points_of(lattice: Lattice) -> np.ndarray:
    """Index coordinates of all points, shape (n, 3)."""
    nk, nj, ni = np.indices(lattice.shape_ijk[::-1]).reshape(3, -1)
    return (np.column_stack([ni, nj, nk]) + lattice.offsets) / lattice.finer - lattice.border


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize(("finer", "offsets"), [(1, (0.0, 0.0, 0.0)), (3, (0.137, 0.271, 0.389)), (2, (0.0, 0.5, 0.9))])
@pytest.mark.parametrize("make_volume", [smooth_volume, noise, uneven_noise])
def test_runs_of_lattice_points_inside_are_those_of_the_trilinear_field(make_volume, finer, offsets, closed):
    volume = make_volume()
    level = float(np.median(volume.voxels)) + 0.37  # which no point has: float32 and float64 agree
    rule = choose_iso_rule(volume, level, closed=closed)
    lattice = Lattice.over(volume, rule, finer, offsets)
    wanted = trilinear_values(volume, rule, points_of(lattice)) >= rule.iso_level
    ni, nj, _ = volume.shape_ijk
    layers_at_once = 4

    keys = find_level_runs(volume, rule, lattice, most=layers_at_once * ni * nj)

    assert (np.diff(keys) > 0).all()  # ends of runs in rising order
    assert np.array_equal(filled(keys, lattice).ravel(), wanted)
    assert count_points(keys) == np.count_nonzero(wanted)


@pytest.mark.parametrize(
    ("value", "closed", "inside"),
    [
        pytest.param(0, True, 0, id="below the level, closed"),
        pytest.param(0, False, 0, id="below the level, open"),
        pytest.param(9, True, 4 * 5 * 6, id="above the level, closed"),
        pytest.param(9, False, 3 * 4 * 5, id="above the level, open: the points of its cells"),
    ],
)
def test_lattice_counts_no_point_of_a_constant_volume_below_the_level_and_all_of_one_above(value, closed, inside):
    volume = Volume(np.full((4, 5, 6), value, np.int16), OBLIQUE)
    rule = choose_iso_rule(volume, 5.0, closed=closed)
    lattice = Lattice.over(volume, rule, finer=1, offsets=(0.0, 0.0, 0.0))
    assert count_points(find_level_runs(volume, rule, lattice)) == inside


def test_exclusive_or_of_runs_has_the_points_of_one_alone():
    one, other = np.array([1, 4, 6, 9]), np.array([2, 4, 6, 7, 20, 21])
    apart = exclusive_or(one, other)
    assert apart.tolist() == [1, 2, 7, 9, 20, 21]
    assert (count_points(one), count_points(other), count_points(apart)) == (6, 4, 4)
    assert exclusive_or(one, one).tolist() == []


def test_lattice_points_inside_a_mesh_are_those_that_vtk_finds():
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersModeling import vtkSelectEnclosedPoints

    volume = Volume(np.zeros((9, 10, 11), np.int16), OBLIQUE)
    lattice = Lattice.over(volume, choose_iso_rule(volume, 5.0), finer=3, offsets=(0.137, 0.271, 0.389))
    vertices, triangles = torus(major=3.0, minor=1.2)
    mesh = Mesh(volume.ijk_to_lps(vertices[:, [0, 2, 1]] + [5.0, 4.5, 4.0]), triangles[:, ::-1])
    keys = find_piercings(volume.lps_to_ijk(mesh.vertices), mesh.triangles, lattice)
    select = vtkSelectEnclosedPoints()
    select.SetInputData(make_polydata(volume.ijk_to_lps(points_of(lattice)), np.zeros((0, 3), np.uint32), None))
    select.SetSurfaceData(mesh.to_pyvista())
    select.SetTolerance(1e-9)
    select.Update()
    enclosed = vtk_to_numpy(select.GetOutput().GetPointData().GetArray("SelectedPoints"))
    assert 500 < enclosed.sum() == count_points(keys)  # measured 2,007 of 35,640 points
    assert np.array_equal(filled(keys, lattice).ravel(), enclosed.astype(bool))
