"""Coordinates and indices in files: vertices that stay apart, places that are found, numbers digit for digit."""

from __future__ import annotations

import io

import numpy as np
import pytest

from clrecon.exchange.content import write_lines
from clrecon.exchange.coordinates import _scramble, find_coincident, find_places, rounded_apart

pytestmark = pytest.mark.unit


def test_rounding_brings_no_vertex_to_the_place_of_others():
    """1 km from the origin: 500 pairs of vertices at one place each stay pairs, and no third vertex joins them."""
    rng = np.random.default_rng(3)
    points = 1e6 + rng.uniform(0.0, 2.0, (10_000, 3))
    points[-500:] = points[:500]
    rounded = rounded_apart(points)
    assert np.array_equal(rounded[-500:], rounded[:500])
    assert len(np.unique(rounded, axis=0)) == 10_000 - 500


def test_vertices_at_one_place_get_one_number_whatever_the_sign_of_zero():
    vertices = np.array([[1, 2, 3], [0, 0, 0], [1, 2, 3], [-0.0, 0, 0], [3, 2, 1]])
    first_of_place, place_of_vertex = find_places(vertices)
    assert first_of_place.tolist() == [0, 1, 4]
    assert place_of_vertex.tolist() == [0, 1, 0, 1, 2]


def test_vertices_far_apart_in_a_list_get_the_number_of_their_first_place():
    numbers = np.random.default_rng(1).integers(0, 50, (300_000, 3))  # 125,000 places, over three pieces
    first_of_place, place_of_vertex = find_places(numbers.astype(np.float32))
    _, first, inverse = np.unique(numbers @ (2500, 50, 1), return_index=True, return_inverse=True)
    assert np.array_equal(first_of_place, np.sort(first))
    assert np.array_equal(first_of_place[place_of_vertex], first[inverse])


def test_places_with_one_hash_are_told_apart():
    vertices = np.array([[1, 2, 3], [0, 0, 0], [1, 2, 3], [-0.0, 0, 0], [3, 2, 1]])
    hash_of_1, hash_of_3 = _scramble(vertices[[0, 4], :1])
    y_bits = hash_of_1 ^ hash_of_3 ^ vertices[0, 1].view(np.uint64)  # makes the last vertex hash as the first
    vertices[4, 1:] = y_bits.view(np.float64), 3.0
    assert np.isfinite(vertices).all()
    assert len(np.unique(_scramble(vertices))) == 2

    first_of_place, place_of_vertex = find_places(vertices)

    assert first_of_place.tolist() == [0, 1, 4]
    assert place_of_vertex.tolist() == [0, 1, 0, 1, 2]


def test_coincident_vertices_are_found_among_different_ones_with_the_same_hash():
    vertices = np.random.default_rng(2).random((300_000, 3)).astype(np.float32)
    assert len(np.unique(_scramble(vertices, np.uint32))) < 300_000  # ten pairs of them by chance, 300,000^2 / 2^33
    vertices[[7, 150_000, 299_999]] = vertices[42]
    vertices[8] = vertices[9] * [1, 0, 1]
    vertices[9, 1] = -0.0

    first, second = sorted([[7, 42, 150_000, 299_999], [8, 9]], key=lambda rows: vertices[rows[0]].tolist())
    assert find_coincident(vertices).tolist() == [*first, *second]


@pytest.mark.parametrize("form", ["v %.9g %.9g %.9g\n", "%.9g,%.9g,%.9g;"], ids=["vertices of OBJ", "commas"])
@pytest.mark.parametrize("size", [1e-30, 1e-4, 1e-3, 0.1, 1.0, 250.0, 1e5, 1e7, 1e8, 1e30])
def test_numbers_of_single_precision_are_written_as_python_formats_them(form, size):
    spread = np.random.default_rng(4).uniform(-10.0, 10.0, (2000, 3)) * size
    eighths = np.round(8.0 * spread) / 8.0  # end in zeros or halves of the last digit
    whole = np.round(spread)
    beside = np.nextafter(np.full((4, 3), size, np.float32), np.float32([-1e38, 0.0, 1e38]))
    rows = np.concatenate([spread, eighths, whole, beside]).astype(np.float32)
    for part in (rows, rows[:0], np.float32([[np.nan, np.inf, -0.0]])):
        written = io.BytesIO()
        write_lines(written, form, part)
        assert written.getvalue().decode("ascii") == "".join(form % tuple(row) for row in part.tolist())


@pytest.mark.parametrize("form", ["f %d %d %d\n", "%d,%d,%d;"], ids=["faces of OBJ", "commas"])
@pytest.mark.parametrize("above", [1, 10, 12_345, 4_294_967_296])
def test_whole_numbers_are_written_as_python_formats_them(form, above):
    rows = np.random.default_rng(3).integers(0, above, (500, 3))
    rows[0] = 0, above - 1, min(9, above - 1)
    stream = io.BytesIO()
    write_lines(stream, form, rows)
    assert stream.getvalue().decode() == "".join(form % tuple(row) for row in rows.tolist())
