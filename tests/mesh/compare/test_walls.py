"""Walls of bone, of contrast medium, of metal and of a table are told apart, component by component."""

from __future__ import annotations

import numpy as np
import pytest
from refusals import refused
from variants import daily_rows

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.mesh import Mesh
from clrecon.mesh.compare.walls import (
    Walls,
    _is_near,
    judge_components,
    judge_walls,
    lie_near_line,
    looks_like_bone,
    normals_of,
    sample_walls,
)
from clrecon.mesh.connectivity import label_components
from clrecon.proof.phantom import KINDS, PhantomSettings, make_phantom
from clrecon.proof.surface.extract import extract_isosurface

AFFINE = np.diag((1.0, 1.0, 1.5, 1.0))
SHAPE = (24, 40, 48)


def make_volume(*bodies, noise=12.0, blur=0.8) -> Volume:
    """Balls (i, j, k, radius in mm, HU) in tissue of 40 HU, later ones over earlier ones, blurred."""
    from scipy.ndimage import gaussian_filter

    k, j, i = np.indices(SHAPE)
    hu = np.full(SHAPE, 40.0)
    for at_i, at_j, at_k, radius, value in bodies:
        hu[(i - at_i) ** 2 + (j - at_j) ** 2 + (1.5 * (k - at_k)) ** 2 < radius**2] = value
    hu = gaussian_filter(hu, blur) + np.random.default_rng(1).normal(0, noise, SHAPE)
    return Volume(np.rint(hu).astype(np.int16), AFFINE)


def judge(volume: Volume, iso_value=200.0) -> list:
    """What each component looks like, the largest first."""
    vertices, normals, triangles = extract_isosurface(volume, iso_value)
    mesh = Mesh(vertices, triangles, normals.astype(np.float32))
    count, labels = label_components(mesh.triangles, mesh.vertex_count)
    judged = judge_components(mesh, volume, choose_iso_rule(volume, iso_value), count, labels)
    order = np.argsort(-np.bincount(labels), kind="stable")
    return [judged[component] for component in order]


BONE = ((12, 12, 12, 9, 900), (12, 12, 12, 6.5, 120))
VESSEL = ((34, 20, 12, 11, 380),)


@pytest.mark.parametrize(
    ("bodies", "looks_like"),
    [
        (BONE, "bone"),
        (((20, 20, 12, 10, 1400),), "bone"),  # compact all through
        (VESSEL, "contrast medium"),
        (((20, 20, 12, 10, 3000),), "metal"),
        (((20, 20, 12, 13, 450), (20, 20, 12, 10, -900)), "no bone"),  # the shell of a table
        (((20, 20, 12, 12, 260), (20, 9, 12, 1.9, 800), (24, 30, 12, 1.9, 800)), "faint bone"),
    ],
)
def test_bodies_are_told_as_bone_medium_or_metal_by_their_walls(bodies, looks_like):
    found = judge(make_volume(*bodies))[0]
    assert found["looks_like"] == looks_like
    assert looks_like_bone(found) == ("bone" in looks_like and looks_like != "no bone")


def test_components_are_told_apart_and_crumbs_are_not():
    vessel, bone, marrow, *crumbs = judge(make_volume(*BONE, *VESSEL, (4, 36, 4, 2.0, 1400)))
    assert [one["looks_like"] for one in (vessel, bone, marrow)] == ["contrast medium", "bone", "bone"]
    assert crumbs == [None]
    assert (vessel["compact_share"], bone["contrast_share"]) == (0.0, 0.0)
    assert bone["compact_share"] > 0.5
    assert vessel["contrast_share"] > 0.5
    assert bone["wall_hu"]["median"] > 500.0 > 420.0 > vessel["wall_hu"]["p99"]


def test_a_vessel_that_is_joined_to_bone_is_a_share_of_it():
    along = np.linspace(0.0, 100.0, 501)
    points = np.column_stack([along, np.zeros((501, 2))])
    bone = along < 40.0
    found = judge_walls(Walls(points, np.where(bone, 900.0, 350.0), ~bone))
    assert (found["looks_like"], found["compact_share"]) == ("bone", pytest.approx(0.4, abs=0.01))
    assert found["contrast_share"] == pytest.approx(0.4, abs=0.05)  # up to 60 mm bone is near


def test_walls_are_looked_for_along_normals():
    volume = make_volume(*VESSEL)
    vertices, normals, triangles = extract_isosurface(volume, 200.0)
    walls = sample_walls(vertices, normals, volume, choose_iso_rule(volume, 200.0))
    outside = sample_walls(vertices, -normals, volume, choose_iso_rule(volume, 200.0))
    assert walls.flat.mean() > 0.8
    assert not outside.flat.any()
    assert judge_walls(outside)["wall_hu"]["median"] < 260.0
    with refused(UsageError, "normals", "mesh"):
        normals_of(Mesh(vertices, triangles))


@pytest.mark.parametrize(
    ("kind", "kept_before"), daily_rows(1, [("spine", 0.31), ("contrast", 0.21), ("pelvis", 0.54)])
)
def test_coarse_voxels_are_no_contrast_medium(kind, kept_before):
    """In voxels of 4 mm all is even from 1.5 to 4 mm: `kept_before` of the bone counted as contrast medium."""
    dj, _, dk = KINDS[kind].spacing
    settings = PhantomSettings(kind, (round(64 * dj),) * 2, slices=round(30 * dk), spacing=(4.0, 4.0, 4.0))
    volume = Volume(*make_phantom(settings)[:2])
    vertices, normals, triangles = extract_isosurface(volume, 200.0)
    mesh, rule = Mesh(vertices, triangles, normals.astype(np.float32)), choose_iso_rule(volume, 200.0)
    count, labels = label_components(mesh.triangles, mesh.vertex_count)
    judged = judge_components(mesh, volume, rule, count, labels)
    bone = np.array([looks_like_bone(one) for one in judged])[labels]
    kept = judge_walls(sample_walls(vertices[bone], mesh.normals[bone], volume, rule))
    assert kept["contrast_share"] < 0.025 < 0.15 * kept_before
    whole = judge_walls(sample_walls(vertices, mesh.normals, volume, rule))
    others = [one for one in judged if one is not None and not looks_like_bone(one)]
    if kind == "contrast":  # heart, aorta, vena cava, kidneys
        assert [one["looks_like"] for one in others] == ["contrast medium"] * 5
        assert whole["contrast_share"] > 0.2
    else:
        assert {one["looks_like"] for one in others} <= {"no bone", "metal"}
        assert whole["contrast_share"] < 0.025


@pytest.mark.parametrize("depth", [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0])
def test_a_wall_as_thin_as_a_voxel_is_seen_at_every_half_millimetre(depth):
    values = np.full((3, 3, 21), 300.0, np.float32)
    values[..., 8 + round(depth / 0.25)] = 900.0
    volume = Volume(values, np.diag((0.25, 1.0, 1.0, 1.0)))
    walls = sample_walls(
        np.array([[2.0, 1.0, 1.0]]), np.array([[-1.0, 0.0, 0.0]]), volume, choose_iso_rule(volume, 200)
    )
    assert walls.wall == [900.0]


def test_depths_are_in_voxels_along_the_normal():
    """One slab of even HU that ends 8 mm deep: in voxels of 1 mm that is flat beneath, in slices of 4 mm it is not."""
    for thick, is_flat in ((1.0, True), (4.0, False)):
        k = np.arange(40) * thick
        slab = np.where((k > 20.0) & (k < 28.0 + thick), 300.0, 0.0)
        volume = Volume(np.tile(slab[:, None, None], (1, 4, 4)).astype(np.int16), np.diag((1.0, 1.0, thick, 1.0)))
        points = np.array([[1.5, 1.5, 20.6]])
        walls = sample_walls(points, np.array([[0.0, 0.0, -1.0]]), volume, choose_iso_rule(volume, 100.0))
        assert walls.flat.tolist() == [is_flat]
        assert walls.near_mm == max(15.0, 5.0 * thick)


@pytest.mark.parametrize(
    ("wall_hu", "compact", "metal"), [(599.5, 0, 0), (600.0, 1, 0), (2000.0, 1, 0), (2000.5, 1, 1)]
)
def test_walls_count_as_compact_bone_or_metal_by_their_hu(wall_hu, compact, metal):
    found = judge_walls(Walls(np.zeros((3, 3)), np.full(3, wall_hu), np.zeros(3, bool)))
    assert (found["compact_share"], found["metal_share"], found["contrast_share"]) == (compact, metal, 0.0)


@pytest.mark.parametrize(
    ("wall_hu", "looks_like"),
    [((300, 300, 510), "faint bone"), ((550, 550, 560), "no bone"), ((100, 100, 450), "no bone")],
)
def test_faint_bone_has_both_dense_places_and_a_spread(wall_hu, looks_like):
    walls = Walls(np.zeros((3, 3)), np.array(wall_hu, np.float64), np.zeros(3, bool))
    assert judge_walls(walls)["looks_like"] == looks_like


def test_figures_of_walls_have_one_digit_and_shares_four():
    found = judge_walls(Walls(np.zeros((3, 3)), np.array([100.0, 200.06, 700.0]), np.array([True, False, False])))
    assert found["wall_hu"] == {"median": 200.1, "p90": 600.0, "p99": 690.0}
    assert (found["compact_share"], found["samples"]) == (0.3333, 3)


@pytest.mark.parametrize(("per_mm", "is_flat"), [(47.8, True), (48.2, False)])
def test_a_wall_is_flat_up_to_120_hu_from_its_highest_value_to_its_lowest(per_mm, is_flat):
    """Values fall evenly over the 2.5 mm from the first depth to the last: by 119.5 and by 120.5 HU."""
    hu = 500.0 - per_mm * np.arange(8.0)
    volume = Volume(np.tile(hu[:, None, None], (1, 4, 4)).astype(np.float32), np.eye(4))
    walls = sample_walls(
        np.array([[1.5, 1.5, 0.0]]), np.array([[0.0, 0.0, -1.0]]), volume, choose_iso_rule(volume, 100)
    )
    assert walls.flat.tolist() == [is_flat]
    assert walls.wall == pytest.approx([500.0])


def test_a_cell_and_its_26_neighbours_are_near():
    places = np.stack(np.meshgrid(*[np.arange(-2.0, 4.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * [7.0, 7.0, 7.0]
    middle = (places == [7.0, 0.0, 14.0]).all(axis=1)
    within = (np.abs(places - [7.0, 0.0, 14.0]) <= 7.0).all(axis=1)
    np.testing.assert_array_equal(_is_near(places + 0.5, middle, 7.0), within)
    far = places * [1.0, 2.0, 3.0]  # more cells along one axis than along another
    within = (np.abs(far - [7.0, 0.0, 42.0]) <= 7.0).all(axis=1)
    np.testing.assert_array_equal(_is_near(far + 0.5, middle, 7.0), within)


def test_points_near_any_piece_of_a_line_are_found():
    line = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0]])
    points = np.array([[5.0, 1, 0], [5, 3, 0], [11, 5, 0], [8.5, 5, 0], [-1.5, 0, 0], [-2.5, 0, 0], [10, 12, 1]])
    assert lie_near_line(points, line, 2.0).tolist() == [True, False, True, True, True, False, False]
