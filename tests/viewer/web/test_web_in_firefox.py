"""The page of the view in Firefox: it draws, turns, switches the table and measures, and logs no error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import view_scenes as scenes
from browser import wait_for
from firefox import Firefox, open_firefox
from view_pages import SETTLED, facts, wait_until_drawn

pytestmark = [pytest.mark.slow, pytest.mark.opencl]


@pytest.fixture(scope="module")
def firefox() -> Iterator[Firefox]:
    with open_firefox() as opened:
        yield opened


@pytest.fixture
def page(firefox: Firefox, view_server: Any) -> Iterator[Firefox]:
    """The page of a scan of three balls and a mesh; after the test it has logged no error."""
    firefox.get(view_server.address)
    wait_for(firefox, SETTLED)
    yield firefox
    firefox.execute_script("sessionStorage.clear()")  # the next test begins anew
    assert firefox.errors == []


def mean_colors(page: Firefox) -> np.ndarray:
    """What the picture shows on a grid of 24 x 16 fields, (384, 4)."""
    return np.array(
        page.execute_script(
            "const small = document.createElement('canvas').getContext('2d');"
            "small.drawImage(document.querySelector('#scene canvas'), 0, 0, 24, 16);"
            "return [...small.getImageData(0, 0, 24, 16).data];"
        )
    ).reshape(-1, 4)


def test_drag_in_firefox_turns_the_camera_and_the_picture_that_is_drawn(page: Firefox) -> None:
    before, camera = mean_colors(page), facts(page)["camera"]

    page.drag(page.point_of("#scene"), dx=150, dy=30)

    wait_until_drawn(page)
    assert facts(page)["camera"] != camera
    assert np.abs(mean_colors(page) - before).max() > 24  # of 255


def test_button_in_firefox_takes_the_table_away(page: Firefox) -> None:
    assert facts(page)["table"]

    page.click("#table")

    assert wait_for(page, "return !clrecon.facts.table && clrecon.facts.settled")


def test_distance_between_two_clicks_in_firefox_is_that_of_the_places(page: Firefox) -> None:
    upwards = scenes.AFFINE[:3, 2] * 4  # four layers of voxels
    ends = [scenes.middle(0), scenes.middle(0) + upwards]
    page.execute_script("clrecon.run('set_cross', {point: arguments[0]})", ends[0].tolist())
    wait_until_drawn(page)

    page.click("#distance")
    for end in ends:
        page.drag(place_of(page, "sagittal", end))
        wait_until_drawn(page)

    (measure,) = facts(page)["measures"]
    length = float(np.linalg.norm(upwards))
    pixel_mm = length / np.hypot(*np.subtract(*(place_of(page, "sagittal", end) for end in ends)))
    assert measure["value"] == pytest.approx(length, abs=1.5 * pixel_mm)  # both ends are rounded to pixels


def place_of(page: Firefox, view: str, point: np.ndarray) -> tuple[int, int]:
    """The place in the window of a point of the patient in a view."""
    x, y = page.execute_script(
        "const box = document.getElementById(arguments[0]).getBoundingClientRect();"
        "const [x, y] = clrecon.project(arguments[0], arguments[1]); return [box.x + x, box.y + y];",
        view,
        point.tolist(),
    )
    return round(x), round(y)


def test_written_page_is_ready_in_firefox(firefox: Firefox, tmp_path: Path) -> None:
    scenes.make_mesh().save(tmp_path / "page.html")

    firefox.get((tmp_path / "page.html").as_uri())

    assert wait_for(firefox, "return document.documentElement.dataset.ready")
    assert firefox.errors == []
