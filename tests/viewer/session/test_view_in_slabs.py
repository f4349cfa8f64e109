"""A view of a scan that goes through the device in slabs: what it says, and what it leaves out."""

from __future__ import annotations

from typing import Any

import pytest
import view_scenes as scenes
from open_views import open_sessions

pytestmark = pytest.mark.opencl

PATIENCE = 60.0


@pytest.fixture
def open_session(device):
    with open_sessions(device) as make:
        yield make


def test_scan_that_is_drawn_in_slabs_is_warned_of_as_slow(open_session):
    view = open_session(scenes.make_scan(), memory=80_000)
    pictures: list[Any] = []

    view.picture((24, 20), False, pictures.append)

    assert view.wait(PATIENCE)
    assert len(pictures) == 1
    assert view.facts()["error"] is None
    assert any("in slabs, which is slow" in text for text in view.facts()["warnings"])


@pytest.mark.parametrize(("memory", "has_thumbnails"), [(None, True), (80_000, False)], ids=["whole", "slabs"])
def test_thumbnails_are_drawn_of_each_mode_but_not_of_a_scan_in_slabs(open_session, memory, has_thumbnails):
    view = open_session(scenes.make_scan(), memory=memory)
    thumbnails: dict[str, Any] = {}
    view.picture((24, 20), False, lambda picture: None)
    assert view.wait(PATIENCE)

    view.draw_modes(thumbnails.__setitem__)

    assert view.wait(PATIENCE)
    assert list(thumbnails) == (list(view.model.modes) if has_thumbnails else [])
