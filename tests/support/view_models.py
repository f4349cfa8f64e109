"""Models of views, without a device."""

from __future__ import annotations

from typing import Any

import view_scenes as scenes

from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import show_objects


class Clock:
    """Ten seconds go by between two looks: no two changes are one gesture."""

    now = 0.0

    def __call__(self) -> float:
        self.now += 10.0
        return self.now


def make_model(*subjects: Any, **given: Any) -> ViewModel:
    """Return the model of a view of these objects, of a scan and a mesh by default."""
    shown: list[Any] = list(subjects) or [scenes.make_scan(), scenes.make_mesh()]
    return ViewModel(show_objects(shown), clock=Clock(), **given)
