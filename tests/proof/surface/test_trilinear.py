"""What is decided in a cell, against exact arithmetic and against trilinear fields that are sampled finely."""

from __future__ import annotations

from collections import Counter
from fractions import Fraction
from functools import cache
from itertools import permutations, product

import numpy as np
import pytest
import tolerances
from trilinear_truth import count_euler, find_topology

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.mesh import Mesh
from clrecon.proof.surface.case_table import CORNERS, EDGES, FACES, find_ambiguous_faces
from clrecon.proof.surface.extract import extract_isosurface
from clrecon.proof.surface.trilinear_table import (
    CELL_VERTEX,
    cell_state,
    decide_faces,
    find_regions,
    find_row,
    find_states,
    place_cell_vertices,
    scale_heights,
)

MARGIN = np.full(3, 1e-4)
MOST_DRAWINGS = 2000
"""Cells that are drawn to find one of a kind: one in about 40 has a tunnel."""


@cache
def ambiguous_cases() -> list[int]:
    """Cases with more than one state, or with a tunnel; found when a test asks: it takes seconds."""
    return [case for case in range(256) if len(find_states(case)) > 1 or cell_state(case, 0).tunnels]


def draw_cell(rng, case: int) -> np.ndarray:
    """Heights of the corners of one case, evenly or unevenly spread."""
    sizes = rng.random(8) if rng.random() < 0.5 else np.exp(rng.normal(size=8))
    signs = np.array([1 if case >> corner & 1 else -1 for corner in range(8)])
    return (sizes * signs).astype(np.float32)


def draw_cells(seed: int, count: int):
    """Cells of all ambiguous cases: a third as they come, a third that may have a tunnel, a third that has one."""
    rng = np.random.default_rng(seed)
    for n in range(count):
        for _ in range(MOST_DRAWINGS):
            case = int(rng.choice(ambiguous_cases()))
            heights = draw_cell(rng, case)
            tunnels = cell_state(case, decide_faces(case, heights)).tunnels
            if n % 3 == 0 or (tunnels and (n % 3 == 1 or find_row(case, heights).cell_vertices > 1)):
                yield case, heights
                break
        else:
            raise AssertionError("no cell has a tunnel")


def draw_with_vertices(seed: int, count: int, cell_vertices: int):
    """Cells with that many vertices inside; whole numbers half a unit from the level, so that scaling is exact."""
    rng = np.random.default_rng(seed)
    for _ in range(count * MOST_DRAWINGS):
        case = int(rng.choice(ambiguous_cases()))
        drawn = draw_cell(rng, case)
        heights = np.float32(np.trunc(1000 * drawn) + np.copysign(0.5, drawn))
        if find_row(case, heights).cell_vertices == cell_vertices:
            yield case, heights
            count -= 1
        if count == 0:
            return
    raise AssertionError(f"no cell has {cell_vertices} vertices inside")


def expected_numbers(case: int, heights) -> tuple[int, int, int, int]:
    """Components and Euler numbers inside and outside that `find_row` says the cell has."""
    joined = decide_faces(case, heights)
    row = find_row(case, heights)
    region = find_regions(case, joined)
    inside = len({region[c] for c in range(8) if case >> c & 1})
    outside = len(set(region)) - inside
    eulers = [inside, outside]  # all of them are balls
    tunnel = next((t for t, r in cell_state(case, joined).tunnels if r is row), None)
    if tunnel is not None:  # two parts of one side become one, and some part of the other side a ring
        inside, outside = inside - tunnel.inside, outside - (not tunnel.inside)
        eulers = [euler - 1 for euler in eulers]
    return inside, outside, eulers[0], eulers[1]


@pytest.mark.parametrize("connectivity", [1, 3])
def test_euler_numbers_are_those_of_scikit_image(connectivity):
    from skimage.measure import euler_number

    rng = np.random.default_rng(12)
    for share in np.linspace(0.0, 1.0, 21):
        solid = rng.random(rng.integers(1, 12, 3)) < share
        assert count_euler(solid, connectivity) == euler_number(solid, connectivity=connectivity)


def count_right_cells(seed: int, count: int) -> Counter:
    """How many random cells have the `right` and the `wrong` topology, or a field that sampling leaves `unclear`."""
    found: Counter = Counter()
    for case, heights in draw_cells(seed, count):
        truth = find_topology(heights.astype(np.float64).reshape(2, 2, 2), (20, 31, 48, 64))
        tunnel = find_row(case, heights).cell_vertices > 1
        found["unclear" if truth is None else "right" if truth == expected_numbers(case, heights) else "wrong"] += 1
        found["tunnels"] += tunnel and truth is not None
    return found


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.untraced
def test_150_random_cells_have_the_topology_of_their_trilinear_field():
    found = count_right_cells(seed=1, count=150)
    assert found["wrong"] == 0
    assert found["right"] >= 140  # of some the sampling is too coarse to say it; measured 149
    assert found["tunnels"] >= 45  # a third of the cells have one; measured 54


@pytest.mark.release
@pytest.mark.slow
def test_1000_random_cells_have_the_topology_of_their_trilinear_field():
    found = count_right_cells(seed=2, count=1000)
    assert found["wrong"] == 0
    assert found["right"] >= 975  # of some the sampling is too coarse to say it
    assert found["tunnels"] >= 300  # a third of the cells have one


@pytest.mark.parametrize(("dtype", "low", "high"), [("int16", -32768, 32767), ("uint16", 0, 65535)])
def test_scaled_heights_of_16_bit_voxels_are_exact(dtype, low, high):
    level = np.float32((low + high) // 2 - 0.5)
    voxels = np.concatenate([[low, high], np.random.default_rng(3).integers(low, high, 6)]).astype(dtype)
    heights = voxels.astype(np.float32) - level
    sizes = scale_heights(heights, bits=18)
    ratios = {
        Fraction(size) / Fraction(abs(2 * int(v) - int(2 * level))) for size, v in zip(sizes, voxels, strict=True)
    }
    assert len(ratios) == 1


def test_scaled_heights_are_rounded_towards_zero():
    heights = [1.0, -0.5, 2.0**-29, 2.0**-31]
    assert scale_heights(heights, bits=30) == [2**29, 2**28, 1, 0]


def test_scaled_heights_of_the_smallest_number_keep_it_above_0():
    smallest_of_float32 = 1e-45
    assert scale_heights([0.0, smallest_of_float32], bits=30) == [0, 1 << 6]


def test_scaled_heights_from_the_smallest_to_the_largest_number_fit_into_their_bits():
    bits = 18
    assert max(scale_heights([1.0, 0.0, 1e-45, 3.4e38, -1e-30], bits)) < 2**bits  # float32 has 1e-45 to 3.4e38


def test_ambiguous_face_joins_its_inside_corners_where_its_saddle_is_inside():
    rng = np.random.default_rng(4)
    for _ in range(500):
        case = int(rng.choice(ambiguous_cases()))
        heights = [
            Fraction(int(size) * (1 if case >> c & 1 else -1), 2) for c, size in enumerate(rng.integers(1, 9, 8))
        ]
        joined = decide_faces(case, [float(h) for h in heights])
        for face in find_ambiguous_faces(case):
            a, b, c, d = (heights[corner] for corner in FACES[face])
            saddle = (a * c - b * d) / (a + c - b - d)
            assert bool(joined >> face & 1) == (saddle > 0)


def test_two_cells_decide_their_common_face_in_the_same_way():
    rng = np.random.default_rng(5)
    for axis in range(3):
        upper, lower = 2 * axis + 1, 2 * axis
        for n in range(200):
            left = rng.integers(-4, 4, 8) + 0.5 if n % 2 else rng.normal(size=8)
            right = rng.normal(size=8) * 10.0 ** rng.integers(-6, 7)
            for corner in range(8):
                if not corner >> axis & 1:
                    right[corner] = left[corner | 1 << axis]
            masks = []
            for heights in (left, right):
                case = sum(1 << c for c in range(8) if heights[c] >= 0)
                masks.append(decide_faces(case, heights))
            assert masks[0] >> upper & 1 == masks[1] >> lower & 1


def turn(heights, axes, flips):
    """The cell with its axes permuted and turned round."""
    return (
        heights.reshape(2, 2, 2).transpose(axes)[tuple(slice(None, None, -1 if flip else 1) for flip in flips)].ravel()
    )


def test_decisions_do_not_depend_on_how_the_cell_is_turned():
    turns = list(product(permutations(range(3)), product((0, 1), repeat=3)))
    for case, heights in draw_cells(seed=6, count=60):
        expected = expected_numbers(case, heights)
        for axes, flips in turns[:: 1 + case % 5]:
            turned = turn(heights, axes, flips)
            turned_case = sum(1 << c for c in range(8) if turned[c] > 0)
            assert expected_numbers(turned_case, turned) == expected


def field_at(heights, point):
    weights = [(1 - p, p) for p in point]
    return sum(weights[0][x] * weights[1][y] * weights[2][z] * h for (x, y, z), h in zip(CORNERS, heights, strict=True))


def slope_at(heights, point):
    step = 1e-6
    return np.array([field_at(heights, point + d) - field_at(heights, point - d) for d in step * np.eye(3)]) / (
        2 * step
    )


@pytest.mark.parametrize("cell_vertices", [1, 6])
def test_vertices_inside_cells_lie_on_the_surface_in_the_cell(cell_vertices):
    bound = tolerances.CENTRE_DISTANCE_STEP if cell_vertices == 1 else tolerances.WAIST_DISTANCE_STEP
    margin = np.full(3, 1e-9)
    for case, heights in draw_with_vertices(seed=7, count=100, cell_vertices=cell_vertices):
        points, gradients = place_cell_vertices(find_row(case, heights), case, heights, margin)
        assert len(points) == cell_vertices
        assert ((points >= margin) & (points <= 1 - margin)).all()
        for point, gradient in zip(points, gradients, strict=True):
            slope = slope_at(heights.astype(np.float64), point)
            cosine = gradient @ slope / (np.linalg.norm(gradient) * np.linalg.norm(slope))
            assert cosine > 0.99  # one direction, up to rounding: measured 1 - 2e-16
            assert abs(field_at(heights.astype(np.float64), point)) / np.linalg.norm(slope) < bound


def cell_points(case, heights, row) -> dict:
    points = {CELL_VERTEX + n: p for n, p in enumerate(place_cell_vertices(row, case, heights, MARGIN)[0])}
    for edge, (axis, low, high) in enumerate(EDGES):
        if heights[low] * heights[high] < 0:
            points[edge] = np.array(CORNERS[low], float)
            points[edge][axis] = heights[low] / (heights[low] - heights[high])
    return points


def crosses(p, q, triangle) -> bool:
    """Whether the segment p q goes through the inside of a triangle."""
    a, b, c = triangle
    normal = np.cross(b - a, c - a)
    above, below = (p - a) @ normal, (q - a) @ normal
    if above * below >= 0:
        return False
    hit = p + (q - p) * (above / (above - below))
    return all(np.cross(v - u, hit - u) @ normal > 1e-9 for u, v in ((a, b), (b, c), (c, a)))


def count_crossings(triangles, points) -> int:
    edges = {tuple(sorted(edge)) for a, b, c in triangles for edge in ((a, b), (b, c), (c, a))}
    return sum(
        crosses(points[p], points[q], [points[v] for v in triangle])
        for triangle in triangles
        for p, q in edges
        if p not in triangle and q not in triangle
    )


@pytest.mark.release
@pytest.mark.untraced
def test_triangles_of_a_cell_do_not_cross_each_other():
    rows = [(find_row(case, heights), case, heights) for case, heights in draw_cells(seed=8, count=150)]
    assert len(rows) == 150
    assert [count_crossings(row.triangles, cell_points(case, heights, row)) for row, case, heights in rows] == [0] * 150


def test_triangles_of_a_cell_with_two_exchanged_vertices_are_found_to_cross():
    ((case, heights),) = draw_with_vertices(seed=9, count=1, cell_vertices=6)
    row = find_row(case, heights)
    points = cell_points(case, heights, row)
    first, last = CELL_VERTEX, CELL_VERTEX + 5  # of six inside the cell
    points[first], points[last] = points[last], points[first]
    assert count_crossings(row.triangles, points) > 0


def draw_volume(seed: int) -> Volume:
    rng = np.random.default_rng(seed)
    voxels = (
        rng.normal(0, 100, (4, 5, 4)).astype(np.float32),
        rng.integers(-300, 300, (4, 5, 4)).astype(np.int16),
        rng.random((4, 5, 4)).astype(np.float32) - np.float32(0.5),
    )[seed % 3]
    return Volume(voxels, np.eye(4))


def count_right_surfaces(seeds) -> Counter:
    """How many fields have a `clear` topology, and how many surfaces of them have it, by the topology asked for."""
    found: Counter = Counter()
    for seed in seeds:
        volume = draw_volume(seed)
        rule = choose_iso_rule(volume, 0)
        heights = np.pad(volume.voxels.astype(np.float64), 1, constant_values=rule.outside) - rule.iso_level
        truth = find_topology(heights, (8, 11, 16, 23, 32))
        if truth is None:
            found["unclear"] += 1
            continue
        expected = truth[0] + truth[1] - 1, 2 * truth[2]  # each surface has one part of the space on each side
        for topology in ("separated", "trilinear"):
            vertices, normals, triangles = extract_isosurface(volume, 0, topology=topology)
            quality = Mesh(vertices, triangles, normals).quality()
            assert quality["closed"] and quality["manifold"] and quality["zero_area_faces"] == 0
            found[topology] += (quality["components"], quality["euler_number"]) == expected
        found["clear"] += 1
    return found


def test_surfaces_of_12_random_fields_have_the_topology_of_the_field_unlike_separated_ones():
    found = count_right_surfaces(range(12))
    assert found["clear"] >= 11  # of 12 fields sampling says the topology; measured of all
    assert found["trilinear"] == found["clear"]
    assert found["separated"] < found["clear"] / 4  # measured 0


@pytest.mark.release
@pytest.mark.slow
def test_surfaces_of_100_random_fields_have_the_topology_of_the_field_unlike_separated_ones():
    found = count_right_surfaces(range(100, 200))
    assert found["clear"] >= 95  # of 100 fields sampling says the topology
    assert found["trilinear"] == found["clear"]
    assert found["separated"] < found["clear"] / 10  # measured 4 of 97


@pytest.mark.parametrize("high", [2, 3, 5])
@pytest.mark.parametrize("dtype", ["int16", "float32"])
def test_surfaces_with_saddles_or_samples_at_the_iso_value_are_closed_and_manifold(dtype, high):
    """Whole numbers half a unit from the level give saddles at the level; floats also samples at it."""
    for seed in range(4):
        voxels = np.random.default_rng(seed).integers(0, high, (5, 5, 6)).astype(dtype)
        for iso_value in range(1, high):
            vertices, normals, triangles = extract_isosurface(
                Volume(voxels, np.eye(4)), iso_value, topology="trilinear"
            )
            quality = Mesh(vertices, triangles, normals).quality()
            assert (quality["closed"], quality["manifold"]) == (True, True)
            assert quality["volume_ml"] > 0
            assert (quality["zero_area_faces"], quality["unused_vertices"]) == (0, 0)


def test_ambiguous_faces_of_masks_separate_their_inside_corners():
    """Every saddle of a mask of 0 and 1 lies at the level."""
    for case in range(256):
        assert decide_faces(case, [0.5 if case >> corner & 1 else -0.5 for corner in range(8)]) == 0
