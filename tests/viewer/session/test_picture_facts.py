"""When a picture is stale, and which pieces of lines nothing hides in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import view_scenes as scenes

from clrecon.rendering import Rendering
from clrecon.rendering.views.camera import Camera
from clrecon.viewer.model.measures import seen_pieces
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.model.state import VIEWS, picture_key

pytestmark = pytest.mark.unit

CAMERA = Camera(position=(0.0, -100.0, 0.0), focal_point=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), parallel_scale=50.0)
SIZE = (100, 100)


def picture_of_wall(*, columns: tuple[int, int] = (0, SIZE[0]), mm: float) -> Rendering:
    """A picture of a wall from the first to before the last of `columns`, by default over all, `mm` from the eye."""
    depth = np.full(SIZE[::-1], np.nan, np.float32)
    depth[:, slice(*columns)] = mm
    image = np.zeros((*SIZE[::-1], 4), np.uint8)
    return Rendering(image, depth, expected_depth=depth, camera=CAMERA, mode="surface", report={})


def lengths_mm(pieces: list[list[list[float]]]) -> list[float]:
    return [float(np.linalg.norm(np.subtract(last, first))) for first, last in pieces]


LINE_OF_80_MM = np.array([[-40.0, 0.0, 0.0], [40.0, 0.0, 0.0]])
"""100 mm from the eye; a pixel is 1 mm wide."""


@pytest.mark.parametrize(
    ("columns", "wall_mm", "seen_mm"),
    [
        pytest.param((40, 60), 50.0, [30.0, 30.0], id="behind a narrow wall"),
        pytest.param((40, 60), 150.0, [80.0], id="before a wall"),
        pytest.param((0, 100), 50.0, [], id="behind a wide wall"),
    ],
)
def test_line_is_hidden_behind_a_wall_and_seen_beside_and_before_it(columns, wall_mm, seen_mm):
    pieces = seen_pieces(picture_of_wall(columns=columns, mm=wall_mm), [LINE_OF_80_MM], expected=False)
    assert lengths_mm(pieces) == pytest.approx(seen_mm, abs=1.5)  # pixels at its ends


def test_line_on_a_surface_and_line_beside_the_picture_are_seen():
    beside = np.array([[100.0, 0, 0], [200.0, 0, 0]])
    assert len(seen_pieces(picture_of_wall(mm=100.0), [LINE_OF_80_MM, beside], expected=True)) == 2


@pytest.mark.parametrize(("behind_mm", "count"), [(2.4, 1), (2.6, 0)])
def test_line_up_to_half_a_mm_and_two_pixels_behind_a_wall_is_seen(behind_mm, count):
    wall = picture_of_wall(mm=100.0 - behind_mm)
    assert len(seen_pieces(wall, [LINE_OF_80_MM], expected=False)) == count


def changed_views(**changes: object) -> set[str]:
    """The views whose pictures are stale after changes of the state of a view."""
    state = ViewModel(show_objects([scenes.make_scan(), scenes.make_mesh()])).state
    made = replace(state, **changes)
    return {view for view in VIEWS if picture_key(state, view) != picture_key(made, view)}


@pytest.mark.parametrize(
    ("changes", "views"),
    [
        ({"cross": (1.0, 2.0, 3.0)}, {"axial", "coronal", "sagittal"}),
        ({"cross": (1.0, 2.0, 3.0), "mode": "slices"}, {"scene", "axial", "coronal", "sagittal"}),  # of the mode alone
        ({"iso_value": 321.0}, {"scene"}),
        ({"window": (0.0, 80.0)}, {"axial", "coronal", "sagittal", "curve"}),
        ({"table": False}, set(VIEWS)),
        ({"parts_at": 300.0, "tool": "seed", "points": (), "measures": ()}, set()),
    ],
)
def test_change_of_the_view_makes_the_pictures_stale_that_show_it(changes, views):
    assert changed_views(**changes) == views


def test_change_of_the_cross_leaves_the_scene_in_mode_slices_fresh():
    state = replace(ViewModel(show_objects([scenes.make_scan()])).state, mode="slices")
    assert picture_key(state, "scene") == picture_key(replace(state, cross=(1.0, 2.0, 3.0)), "scene")
