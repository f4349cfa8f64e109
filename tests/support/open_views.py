"""Painters and sessions of small scenes, closed when a test ends."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import view_scenes as scenes

from clrecon.rendering import Rendering
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.session.session import ViewSession


@contextmanager
def open_painters(device: Any) -> Iterator[Callable[..., tuple[ViewModel, Painter]]]:
    """Yield a function that makes the model and the painter of some subjects, by default of the scan."""
    with ExitStack() as opened:

        def make(*subjects: Any, **given: Any) -> tuple[ViewModel, Painter]:
            objects = show_objects(subjects or [scenes.make_scan()])
            painter = opened.enter_context(Painter(objects, device=device))
            return ViewModel(objects, iso_value=scenes.ISO, **given), painter

        yield make


@contextmanager
def open_sessions(device: Any) -> Iterator[Callable[..., ViewSession]]:
    """Yield a function that makes the session of some subjects, by default of the scan and a mesh."""
    with ExitStack() as opened:

        def make(*subjects: Any, **given: Any) -> ViewSession:
            objects = show_objects(list(subjects) or [scenes.make_scan(), scenes.make_mesh()])
            own = None if "painter" in given else device
            session = ViewSession(objects, iso_value=scenes.ISO, device=own, **given)
            opened.callback(session.close)
            return session

        yield make


def find(model: ViewModel, painter: Painter) -> None:
    """Find the parts of a model."""
    model.take_parts(painter.find_parts(model.state))


def shown_pixels(picture: Rendering) -> int:
    """Number of pixels that are not empty."""
    return int((picture.image[..., 3] > 0).sum())


def search_for_ever(state: Any, progress: Callable[[str, int, int], None]) -> None:
    """Take the place of `Painter.find_parts`: work that ends only when it is cancelled."""
    while True:
        progress("parts", 0, 1)
        time.sleep(0.002)
