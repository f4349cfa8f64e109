"""The view that slices in space are shown from when none is named."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.geometry.grid import Grid
from clrecon.rendering.pictures.modes import MODES
from clrecon.rendering.views.directions import LEAST_COSINE, SLICES_VIEWS, default_view, find_view


def stack(normal: np.ndarray) -> Grid:
    """Return a grid of slices across a direction."""
    across = np.linalg.svd(normal[None])[2]
    affine = np.eye(4)
    affine[:3, :3] = across[[1, 2, 0]].T
    return Grid(np.zeros((2, 2, 2), np.int8), affine)


@pytest.mark.parametrize("normal", np.eye(3))
def test_slices_across_the_axes_of_the_patient_are_seen_from_the_first_view(normal: np.ndarray) -> None:
    assert default_view("slices", stack(normal)) == SLICES_VIEWS[0] == (30.0, 30.0)


def random_normals() -> np.ndarray:
    """500 unit vectors."""
    normals = np.random.default_rng(3).normal(size=(500, 3))
    return normals / np.linalg.norm(normals, axis=1)[:, None]


def cosine(view, normal: np.ndarray) -> float:
    """Between the direction of a view and the normal of slices: 0 for slices seen from their edge."""
    return float(abs(find_view(view)[0] @ normal))


def test_slices_of_500_directions_are_not_seen_from_their_edge() -> None:
    seen = [cosine(default_view("slices", stack(normal)), normal) for normal in random_normals()]

    assert min(seen) > 0.15  # more than 8 degrees off the edge; measured 0.21


def test_slices_are_seen_from_the_first_view_that_shows_enough_of_them() -> None:
    enough = [normal for normal in random_normals() if cosine(SLICES_VIEWS[0], normal) >= LEAST_COSINE]

    assert {default_view("slices", stack(normal)) for normal in enough} == {SLICES_VIEWS[0]}


def test_every_view_of_slices_is_the_default_of_some_direction() -> None:
    assert {default_view("slices", stack(normal)) for normal in random_normals()} == set(SLICES_VIEWS)


@pytest.mark.parametrize("mode", sorted(MODES.keys() - {"slices"}))
def test_other_modes_are_seen_from_the_front(mode: str) -> None:
    assert default_view(mode, stack(np.array([0.0, 0.0, 1.0]))) == "anterior"
