"""The view that slices in space are shown from when none is named."""

from __future__ import annotations

import numpy as np
import pytest

from clrecon.geometry.grid import Grid
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


def test_slices_show_whatever_way_they_lie() -> None:
    normals = np.random.default_rng(3).normal(size=(500, 3))
    seen = set()
    for normal in normals / np.linalg.norm(normals, axis=1)[:, None]:
        view = default_view("slices", stack(normal))
        seen.add(view)
        cosine = abs(find_view(view)[0] @ normal)
        first = abs(find_view(SLICES_VIEWS[0])[0] @ normal)
        assert cosine > 0.15 and (first < LEAST_COSINE or view == SLICES_VIEWS[0])
    assert seen == set(SLICES_VIEWS)


def test_other_modes_are_seen_from_the_front() -> None:
    assert default_view("dvr", stack(np.array([0.0, 0.0, 1.0]))) == "anterior"
