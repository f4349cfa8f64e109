"""Walls of bone, of contrast medium, of metal and of a table are told apart, component by component."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from variants import daily

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.mesh import Mesh
from clrecon.mesh.compare.walls import (
    Walls,
    judge_components,
    judge_walls,
    lie_near,
    lie_near_line,
    looks_like_bone,
    normals_of,
    sample_walls,
)
from clrecon.mesh.connectivity import label_components
from clrecon.proof.phantom import KINDS, PhantomSettings, make_phantom
from clrecon.proof.surface.extract import extract_isosurface

COARSE_CONTRAST_SHARE = 0.025
"""Of bone in voxels of 4 mm; 0.21 to 0.54 of it counted as contrast medium while depths were in mm."""

AFFINE = np.diag((1.0, 1.0, 1.5, 1.0))
SHAPE = (24, 40, 48)


def blurred_balls(*balls, noise_hu=12.0, blur_voxels=0.8) -> Volume:
    """Balls (i, j, k, radius in mm, HU) in tissue of 40 HU, later ones over earlier ones, blurred."""
    from scipy.ndimage import gaussian_filter

    k, j, i = np.indices(SHAPE)
    hu = np.full(SHAPE, 40.0)
    for at_i, at_j, at_k, radius, value in balls:
        hu[(i - at_i) ** 2 + (j - at_j) ** 2 + (1.5 * (k - at_k)) ** 2 < radius**2] = value
    hu = gaussian_filter(hu, blur_voxels) + np.random.default_rng(1).normal(0, noise_hu, SHAPE)
    return Volume(np.rint(hu).astype(np.int16), AFFINE)


def judge_components_of(volume: Volume, iso_value=200.0) -> list:
    """What each component of the surface looks like, the largest first."""
    vertices, normals, triangles = extract_isosurface(volume, iso_value)
    mesh = Mesh(vertices, triangles, normals.astype(np.float32))
    count, labels = label_components(mesh.triangles, mesh.vertex_count)
    judged = judge_components(mesh, volume, choose_iso_rule(volume, iso_value), count, labels)
    order = np.argsort(-np.bincount(labels), kind="stable")
    return [judged[component] for component in order]


CORTEX_AND_MARROW = ((12, 12, 12, 9, 900), (12, 12, 12, 6.5, 120))
VESSEL = ((34, 20, 12, 11, 380),)
COMPACT = ((20, 20, 12, 10, 1400),)
METAL = ((20, 20, 12, 10, 3000),)
SHELL_OF_A_TABLE = ((20, 20, 12, 13, 450), (20, 20, 12, 10, -900))
FAINT_BONE = ((20, 20, 12, 12, 260), (20, 9, 12, 1.9, 800), (24, 30, 12, 1.9, 800))
CRUMB = ((4, 36, 4, 2.0, 1400),)


@pytest.mark.parametrize(
    ("bodies", "looks_like", "is_bone"),
    [
        (CORTEX_AND_MARROW, "bone", True),
        (COMPACT, "bone", True),
        (FAINT_BONE, "faint bone", True),
        (VESSEL, "contrast medium", False),
        (METAL, "metal", False),
        (SHELL_OF_A_TABLE, "no bone", False),
    ],
    ids=["cortex and marrow", "compact bone", "faint bone", "vessel", "metal", "shell of a table"],
)
def test_a_body_looks_like_bone_contrast_medium_or_metal_by_its_walls(bodies, looks_like, is_bone):
    judged, *_ = judge_components_of(blurred_balls(*bodies))  # the largest component
    assert judged["looks_like"] == looks_like
    assert looks_like_bone(judged) == is_bone


@pytest.fixture(scope="module")
def vessel_bone_marrow_and_crumb():
    """What the four components look like: a vessel, cortex outside and inside, and a ball of 2 mm."""
    return judge_components_of(blurred_balls(*CORTEX_AND_MARROW, *VESSEL, *CRUMB))


def test_each_component_of_one_surface_is_judged_by_its_own_walls(vessel_bone_marrow_and_crumb):
    vessel, cortex, marrow, _ = vessel_bone_marrow_and_crumb
    assert [part["looks_like"] for part in (vessel, cortex, marrow)] == ["contrast medium", "bone", "bone"]


def test_a_component_of_too_few_vertices_is_not_judged(vessel_bone_marrow_and_crumb):
    *_, crumb = vessel_bone_marrow_and_crumb
    assert crumb is None


def test_most_walls_of_a_vessel_count_as_contrast_medium_and_none_as_compact_bone(vessel_bone_marrow_and_crumb):
    vessel, *_ = vessel_bone_marrow_and_crumb
    assert vessel["contrast_share"] > 0.5
    assert vessel["compact_share"] == 0.0


def test_most_walls_of_cortex_count_as_compact_bone_and_none_as_contrast_medium(vessel_bone_marrow_and_crumb):
    _, cortex, *_ = vessel_bone_marrow_and_crumb
    assert cortex["compact_share"] > 0.5
    assert cortex["contrast_share"] == 0.0


def test_walls_of_a_vessel_of_380_hu_end_below_those_of_cortex_of_900_hu(vessel_bone_marrow_and_crumb):
    vessel, cortex, *_ = vessel_bone_marrow_and_crumb
    assert vessel["wall_hu"]["p99"] < 380 + 3 * 12.0  # three times the noise
    assert cortex["wall_hu"]["median"] > 500.0  # the half way between 120 and 900 HU


def test_a_vessel_that_is_joined_to_bone_is_a_share_of_it_up_to_where_bone_is_near():
    """Walls along 100 mm: compact bone up to 40 mm, then contrast medium, of which 20 mm lie near bone."""
    x = np.linspace(0.0, 100.0, 501)
    is_bone = x < 40.0
    walls = Walls(np.column_stack([x, np.zeros((501, 2))]), np.where(is_bone, 900.0, 350.0), ~is_bone)
    judged = judge_walls(walls)
    assert judged["looks_like"] == "bone"
    assert judged["compact_share"] == pytest.approx(40 / 100, abs=2 / 501)  # of 501 points, one at either end
    assert judged["contrast_share"] == pytest.approx(1 - (40 + 20) / 100, abs=2 / 501)


@pytest.fixture(scope="module")
def surface_of_a_vessel():
    """Vertices, normals and the volume of a vessel of 380 HU in tissue of 40."""
    volume = blurred_balls(*VESSEL)
    vertices, normals, _ = extract_isosurface(volume, 200.0)
    return vertices, normals, volume


def test_walls_against_the_normals_are_flat_in_a_vessel(surface_of_a_vessel):
    vertices, normals, volume = surface_of_a_vessel
    walls = sample_walls(vertices, normals, volume, choose_iso_rule(volume, 200.0))
    assert walls.flat.all()


def test_walls_along_turned_normals_show_the_tissue_outside(surface_of_a_vessel):
    vertices, normals, volume = surface_of_a_vessel
    walls = sample_walls(vertices, -normals, volume, choose_iso_rule(volume, 200.0))
    assert not walls.flat.any()
    # The surface itself is the highest: in HU, measured 199.5.
    assert judge_walls(walls)["wall_hu"]["median"] == pytest.approx(200.0, abs=1.0)


def test_walls_of_a_mesh_without_normals_are_refused():
    with refused(UsageError, "normals", "mesh"):
        normals_of(Mesh(np.eye(3), [[0, 1, 2]]))


@pytest.fixture(scope="module", params=daily(1, ["spine", "contrast", "pelvis"]))
def coarse_phantom(request):
    """A phantom in voxels of 4 mm, where all HU are even from 1.5 to 4 mm deep.

    Its kind, what its components look like, the shares of walls of the whole surface, and those of bone alone.
    """
    kind = request.param
    dj, _, dk = KINDS[kind].spacing
    settings = PhantomSettings(kind, (round(64 * dj),) * 2, slices=round(30 * dk), spacing=(4.0, 4.0, 4.0))
    voxels, affine, _ = make_phantom(settings)
    volume = Volume(voxels, affine)
    rule = choose_iso_rule(volume, 200.0)
    vertices, normals, triangles = extract_isosurface(volume, 200.0)
    mesh = Mesh(vertices, triangles, normals.astype(np.float32))
    count, labels = label_components(mesh.triangles, mesh.vertex_count)
    components = judge_components(mesh, volume, rule, count, labels)
    is_bone = np.array([looks_like_bone(component) for component in components])[labels]
    whole = judge_walls(sample_walls(vertices, mesh.normals, volume, rule))
    of_bone = judge_walls(sample_walls(vertices[is_bone], mesh.normals[is_bone], volume, rule))
    return kind, components, whole, of_bone


def test_bone_in_coarse_voxels_is_no_contrast_medium(coarse_phantom):
    *_, of_bone = coarse_phantom
    assert of_bone["contrast_share"] < COARSE_CONTRAST_SHARE


def test_components_other_than_bone_in_coarse_voxels_are_contrast_medium_where_there_is_some(coarse_phantom):
    kind, components, whole, _ = coarse_phantom
    others = [part["looks_like"] for part in components if part is not None and not looks_like_bone(part)]
    if kind == "contrast":
        assert others == ["contrast medium"] * 5  # heart, aorta, vena cava, two kidneys
        assert whole["contrast_share"] > 0.2
    else:
        assert set(others) <= {"no bone", "metal"}
        assert whole["contrast_share"] < COARSE_CONTRAST_SHARE


def look_into(volume: Volume, point, towards, iso_value: float) -> Walls:
    """The wall beneath one point of a surface whose inside lies `towards`."""
    normal = -np.array([towards], float)
    return sample_walls(np.array([point], float), normal, volume, choose_iso_rule(volume, iso_value))


@pytest.mark.parametrize("depth_mm", [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
def test_a_wall_as_thin_as_a_voxel_is_seen_at_every_half_millimetre(depth_mm):
    """300 HU in voxels of 0.25 mm along i, but 900 HU in one, at that depth under the point at i = 8, x = 2 mm."""
    values = np.full((3, 3, 21), 300.0, np.float32)
    values[..., 8 + round(depth_mm / 0.25)] = 900.0
    volume = Volume(values, np.diag((0.25, 1.0, 1.0, 1.0)))
    assert look_into(volume, (2.0, 1.0, 1.0), (1, 0, 0), 200.0).wall == [900.0]


def even_slab(slice_mm: float) -> Volume:
    """300 HU from z = 20 mm to one slice beyond 28 mm, and 0 HU elsewhere."""
    z = np.arange(40) * slice_mm
    slab = np.where((z > 20.0) & (z < 28.0 + slice_mm), 300.0, 0.0)
    return Volume(np.tile(slab[:, None, None], (1, 4, 4)).astype(np.int16), np.diag((1.0, 1.0, slice_mm, 1.0)))


@pytest.mark.parametrize(("slice_mm", "is_flat"), [(1.0, True), (4.0, False)])
def test_depths_are_in_voxels_along_the_normal(slice_mm, is_flat):
    """A slab of even HU that ends 8 mm deep is flat beneath in slices of 1 mm, but not in slices of 4 mm.

    A wall is flat where the HU are even from 1.5 to 4 voxels deep: down to 4 mm, and to 16 mm.
    """
    assert look_into(even_slab(slice_mm), (1.5, 1.5, 20.6), (0, 0, 1), 100.0).flat.tolist() == [is_flat]


@pytest.mark.parametrize(("slice_mm", "near_mm"), [(1.0, 15.0), (4.0, 20.0)])
def test_walls_within_15_mm_or_five_slices_are_near(slice_mm, near_mm):
    assert look_into(even_slab(slice_mm), (1.5, 1.5, 20.6), (0, 0, 1), 100.0).near_mm == near_mm


@pytest.mark.parametrize(
    ("wall_hu", "compact", "metal"), [(599.5, 0, 0), (600.0, 1, 0), (2000.0, 1, 0), (2000.5, 1, 1)]
)
def test_walls_count_as_compact_bone_from_600_hu_and_as_metal_above_2000(wall_hu, compact, metal):
    judged = judge_walls(Walls(np.zeros((3, 3)), np.full(3, wall_hu), np.zeros(3, bool)))
    assert (judged["compact_share"], judged["metal_share"], judged["contrast_share"]) == (compact, metal, 0.0)


@pytest.mark.parametrize(
    ("wall_hu", "looks_like"),
    [((300, 300, 510), "faint bone"), ((550, 550, 560), "no bone"), ((100, 100, 450), "no bone")],
    ids=["dense and spread", "dense but even", "spread but not dense"],
)
def test_faint_bone_has_both_dense_walls_and_a_spread_of_them(wall_hu, looks_like):
    walls = Walls(np.zeros((3, 3)), np.array(wall_hu, np.float64), np.zeros(3, bool))
    assert judge_walls(walls)["looks_like"] == looks_like


def test_hu_of_walls_is_rounded_to_one_decimal_and_shares_to_four():
    wall_hu = np.array([100.0, 200.06, 700.0])  # percentiles between them: 90 % at 600.01, 99 % at 690.0
    judged = judge_walls(Walls(np.zeros((3, 3)), wall_hu, np.array([True, False, False])))
    assert judged["wall_hu"] == {"median": 200.1, "p90": 600.0, "p99": 690.0}
    assert (judged["compact_share"], judged["samples"]) == (0.3333, 3)


@pytest.mark.parametrize(("fall_hu", "is_flat"), [(119.5, True), (120.5, False)])
def test_a_wall_is_flat_up_to_120_hu_from_its_highest_value_to_its_lowest(fall_hu, is_flat):
    """Values fall evenly from 500 HU over the 2.5 mm from the first depth to the last."""
    hu = 500.0 - fall_hu / 2.5 * np.arange(8.0)
    volume = Volume(np.tile(hu[:, None, None], (1, 4, 4)).astype(np.float32), np.eye(4))
    walls = look_into(volume, (1.5, 1.5, 0.0), (0, 0, 1), 100.0)
    assert walls.flat.tolist() == [is_flat]
    assert walls.wall == pytest.approx([500.0])


@pytest.mark.parametrize(
    "spacing", [(7.0, 7.0, 7.0), (7.0, 14.0, 21.0)], ids=["a cell apart", "more cells along j and k"]
)
def test_points_in_a_cell_and_its_26_neighbours_are_near(spacing):
    """Points in a grid, each half a millimetre into its cell of 7 mm; one of them is marked."""
    places = np.stack(np.meshgrid(*[np.arange(-2.0, 4.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * spacing
    marked = np.multiply([1, 0, 2], spacing)
    is_marked = (places == marked).all(axis=1)
    is_neighbour = (np.abs(places - marked) <= 7.0).all(axis=1)
    np.testing.assert_array_equal(lie_near(places + 0.5, is_marked, size_mm=7.0, cells=3**0.5), is_neighbour)


POINTS_BESIDE_AN_L = {
    "beside the first piece": ((5.0, 1, 0), True),
    "too far from the first piece": ((5.0, 3, 0), False),
    "beside the second piece": ((11.0, 5, 0), True),
    "on the other side of the second piece": ((8.5, 5, 0), True),
    "before the beginning": ((-1.5, 0, 0), True),
    "too far before the beginning": ((-2.5, 0, 0), False),
    "too far beyond the end": ((10.0, 12, 1), False),
}


@pytest.mark.parametrize(("point", "is_near"), POINTS_BESIDE_AN_L.values(), ids=POINTS_BESIDE_AN_L)
def test_a_point_is_near_a_line_within_2_mm_of_any_piece_or_end(point, is_near):
    line = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0]])
    assert lie_near_line(np.array([point]), line, distance=2.0).tolist() == [is_near]
