"""A view of a scan that goes through the device in slabs: what it says, and what it leaves out."""

from __future__ import annotations

from typing import Any

import pytest
import view_scenes as scenes
from open_views import open_sessions

pytestmark = pytest.mark.opencl

PATIENCE = 60.0
MEMORY = 80_000
"""Bytes, of which the voxels of the scan alone would take 77,440."""


@pytest.fixture
def open_session(device):
    """A function that opens the session of objects, by default of a scan of three balls and a mesh."""
    with open_sessions(device) as make:
        yield make


def test_scan_that_is_drawn_in_slabs_is_warned_of_as_slow(open_session):
    view = open_session(scenes.make_scan(), memory=MEMORY)
    pictures: list[Any] = []

    view.picture((24, 20), moving=False, then=pictures.append)

    assert view.wait(PATIENCE)
    assert len(pictures) == 1
    assert view.facts()["error"] is None
    assert any("in slabs, which is slow" in text for text in view.facts()["warnings"])


@pytest.mark.parametrize(("memory", "has_thumbnails"), [(None, True), (MEMORY, False)], ids=["whole", "slabs"])
def test_thumbnails_are_drawn_of_each_mode_but_not_of_a_scan_in_slabs(open_session, memory, has_thumbnails):
    view = open_session(scenes.make_scan(), memory=memory)
    thumbnails: dict[str, Any] = {}
    view.picture((24, 20), moving=False, then=lambda picture: None)
    assert view.wait(PATIENCE)

    view.draw_modes(thumbnails.__setitem__)

    assert view.wait(PATIENCE)
    assert list(thumbnails) == (list(view.model.modes) if has_thumbnails else [])
