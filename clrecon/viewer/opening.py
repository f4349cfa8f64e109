"""Inputs in, what the views of a process share out: objects, painter, and how each view begins."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import MISSING, fields
from pathlib import Path

from clrecon.errors import UsageError
from clrecon.jobs.mesh.levels import choose_level
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.shared.settings import InputSettings
from clrecon.jobs.view.inputs import open_inputs
from clrecon.jobs.view.settings import ViewSettings
from clrecon.system.closing import Closing
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.wording import name_parameter
from clrecon.viewer.objects import ShownScan, wrap_inputs
from clrecon.viewer.painter import Painter
from clrecon.viewer.session import ViewSession

__all__ = ["OpenedView", "check_view_settings", "open_view"]

_OF_A_VIEW = {"iso_value", "preset", "half_way", "space", "labels", "one_file"}
"""Settings of meshes that a view has a meaning for; a label map sets the last one by itself."""


class OpenedView(Closing):
    """What the views of some inputs share.

    Use it as a context manager, or `close` it after its sessions.

    Attributes
    ----------
    objects : list of ShownObject
    painter : Painter
    said : list of str
        What has to be said of the inputs.
    """

    def __init__(
        self,
        inputs: Sequence[str | Path],
        settings: ViewSettings,
        progress: Progress = ignore_progress,
    ):
        scan = settings.scan
        opened = open_inputs(inputs, settings, progress=progress)
        self.objects = wrap_inputs(opened, settings.names)
        self.said = list(dict.fromkeys(text for each in self.objects for text in each.said))
        self._iso_value = self._choose_iso(scan, progress)
        self._space, self._keep_ids = scan.space, scan.keep_ids
        self.painter = Painter(self.objects, device=scan.device, memory=scan.memory)

    def _choose_iso(self, scan: MeshSettings, progress: Progress) -> float | None:
        """Return the iso value to begin with; None: that of the model."""
        first = next((each for each in self.objects if isinstance(each, ShownScan)), None)
        if first is None or (scan.iso_value, scan.preset, scan.half_way) == (None, None, None):
            return None
        choice = choose_level(first.volume, scan, progress)
        level = scan.levels[0] if choice is None else choice.iso_value
        assert isinstance(level, float | int) and math.isfinite(level)
        return float(level)

    def session(self, on_change: Callable[[], None] | None = None) -> ViewSession:
        """Open a view, see `ViewSession`."""
        return ViewSession(
            self.objects,
            self.painter,
            space=self._space,
            iso_value=self._iso_value,
            keep_ids=self._keep_ids,
            on_change=on_change,
        )

    def close(self) -> None:
        """Free what is on the device."""
        self.painter.close()


def open_view(
    inputs: Sequence[str | Path], settings: ViewSettings | None = None, *, progress: Progress | None = None
) -> OpenedView:
    """Read inputs for a view.

    Parameters
    ----------
    inputs : sequence of path
        See `clrecon.jobs.view.inputs.open_inputs`.
    settings : ViewSettings, optional
        How scans are read, masked and cropped, the iso value to begin with, the label map.
    progress : callable, optional

    Raises
    ------
    UsageError
        A setting says how meshes are made, and a view makes none.
    ClreconError
        An input cannot be read, or there is no such device.
    """
    settings = settings or ViewSettings()
    check_view_settings(settings)
    return OpenedView(inputs, settings, progress or ignore_progress)


def check_view_settings(settings: ViewSettings) -> None:
    """Refuse settings that a view has no meaning for, before anything is read.

    Raises
    ------
    UsageError
    """
    scan = settings.scan
    ignored = {own.name for own in fields(InputSettings)} | _OF_A_VIEW
    for own in fields(scan):
        default = own.default if own.default_factory is MISSING else own.default_factory()
        value = getattr(scan, own.name)
        if own.name not in ignored and value != default and not (isinstance(value, Sequence) and not value):
            raise UsageError(
                f"{name_parameter(own.name)} says how a mesh is made, and a view makes none: leave it out, or write a"
                " page instead"
            )
    if isinstance(scan.iso_value, Sequence):
        raise UsageError("a view begins with one iso value: give one, and move the slider")
