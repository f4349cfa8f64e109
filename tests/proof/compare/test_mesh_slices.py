"""Meshes that are cut into slices again."""

from __future__ import annotations

import numpy as np
import pytest
import sample_meshes as samples
from refusals import refused
from sample_meshes import SHEARED, placed

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.proof.compare.mesh_slices import measure_slices

pytestmark = pytest.mark.unit


def block(affine=None, low=3, high=8, size=12) -> Volume:
    """Voxels of 100 HU from `low` to `high` along each axis, 0 HU around them."""
    voxels = np.zeros((size,) * 3, np.float32)
    voxels[low : high + 1, low : high + 1, low : high + 1] = 100.0
    return Volume(voxels, np.eye(4) if affine is None else affine)


@pytest.mark.parametrize("affine", [np.eye(4), SHEARED], ids=["even", "sheared"])
@pytest.mark.parametrize("finer", [1, 2, 3, 5])
def test_lattice_points_inside_a_box_are_counted_as_by_its_bounds(affine, finer):
    on = block(affine)
    offsets = (0.137, 0.271, 0.389)
    low, side = 2.6, 5.8  # voxels
    box = placed(samples.box(low=(low,) * 3, size=(side,) * 3), on)
    found = measure_slices(box, on, 50.0, finer=finer, offsets=offsets)
    places = [(np.arange(-99, 99) + offset) / finer for offset in offsets]  # from before the box to behind it
    assert found.points_mesh == np.prod([((low < place) & (place < low + side)).sum() for place in places])
    assert found.rows_odd == 0
    assert found.voxel_dice == 1.0
    assert found.dice == 2.0 * found.points_common / (found.points_mesh + found.points_hu)


@pytest.mark.parametrize(
    ("mesh", "finer"),
    [
        pytest.param(samples.box(low=(3.0,) * 3, size=(5.0,) * 3), 1, id="box with edges on rows"),
        pytest.param(
            samples.sphere(centre=(5.0, 5.0, 5.0), radius=3.0, rounds=0), 2, id="octahedron with corners on rows"
        ),
    ],
)
def test_rows_through_edges_and_corners_of_a_mesh_cross_it_an_even_number_of_times(mesh, finer):
    on = block()
    assert measure_slices(placed(mesh, on), on, 50.0, finer=finer, offsets=(0, 0, 0)).rows_odd == 0


def test_lattice_points_on_the_lower_faces_of_a_box_are_inside_and_on_the_upper_outside():
    on = block()
    from_3_to_8 = samples.box(low=(3.0,) * 3, size=(5.0,) * 3)
    found = measure_slices(placed(from_3_to_8, on), on, 50.0, finer=1, offsets=(0, 0, 0))
    assert found.points_mesh == len([3, 4, 5, 6, 7]) ** 3


def test_mesh_that_is_open_across_many_rows_is_refused():
    on = block()
    vertices, triangles = samples.box(low=(2.6,) * 3, size=(5.8,) * 3)
    faced = np.flatnonzero(np.ptp(vertices[triangles][:, :, 0], axis=1) == 0.0)  # across the rows
    with refused(UsageError, "mesh", "open"):
        measure_slices(placed((vertices, np.delete(triangles, faced[0], axis=0)), on), on, 50.0)


def test_rows_through_a_small_hole_are_left_out_of_mesh_and_volume():
    on = block(size=20, low=5, high=14)
    vertices, triangles = samples.sphere(centre=(9.5, 9.5, 9.5), radius=6.0, rounds=3)
    # The triangle nearest to the pole of the rows: they leave the ball through the hole.
    hole = int(np.argmin(np.linalg.norm(vertices[triangles].mean(axis=1) - [15.5, 9.5, 9.5], axis=1)))
    whole = measure_slices(placed((vertices, triangles), on), on, 50.0, finer=5)
    holed = measure_slices(placed((vertices, np.delete(triangles, hole, axis=0)), on), on, 50.0, finer=5)
    assert whole.rows_odd == 0
    assert 1 <= holed.rows_odd < 20  # a facet is three rows wide; measured 15
    points_a_voxel, ball_voxels, block_voxels = 5, 2 * 6.0, 10.0
    lost_mesh, lost_hu = whole.points_mesh - holed.points_mesh, whole.points_hu - holed.points_hu
    assert lost_mesh / holed.rows_odd == pytest.approx(points_a_voxel * ball_voxels, abs=2.0)  # rows end within a step
    assert lost_hu / holed.rows_odd == pytest.approx(points_a_voxel * block_voxels, abs=1.0)


def test_empty_mesh_is_refused():
    with refused(NoSurfaceError, "triangles", "mesh"):
        measure_slices(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.uint32)), block(), 50.0)


def test_mesh_beyond_the_volume_is_refused_with_its_bounds():
    on = block()
    beyond = placed(samples.box(low=(2.6, 30.0, 2.6), size=(5.8,) * 3), on)
    with refused(UsageError, "volume", 2.6, 30.0):
        measure_slices(beyond, on, 50.0)


@pytest.mark.parametrize(
    ("arguments", "facts"),
    [
        ({"iso_value": 50.0, "finer": 0}, (1, 16, 0)),
        ({"iso_value": 50.0, "offsets": (0.1, 0.2, 1.0)}, ("offsets", 0.1, 0.2)),
        ({"iso_value": (50.0, 70.0)}, (50.0, 70.0)),
    ],
    ids=["no points", "offset of a whole step", "two iso values"],
)
def test_wrong_argument_of_a_comparison_of_slices_is_refused_with_its_value(arguments, facts):
    on = block()
    with refused(UsageError, *facts):
        measure_slices(placed(samples.box(low=(2.6,) * 3, size=(5.8,) * 3), on), on, **arguments)
