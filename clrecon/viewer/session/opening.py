"""Inputs in, what the views of a process share out: objects, painter, and how each view begins."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from clrecon.errors import RefusedInputError
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.mesh.surfaces import choose_level
from clrecon.jobs.view import ViewSettings
from clrecon.jobs.view.inputs import Reader, check_view_settings, open_inputs
from clrecon.rendering.pictures.picture import check_image_path
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.system.base_classes import Closing
from clrecon.system.files import check_writable
from clrecon.system.light_dataclass import replace
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.drawing.saving import save_shown
from clrecon.viewer.drawing.shown_meshes import shows_fits
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import ShownObject, ShownScan, wrap_inputs
from clrecon.viewer.model.saved_view import read_view, restore_elsewhere, restore_view
from clrecon.viewer.session.session import ViewSession


def read_objects(inputs: Sequence[str | Path], settings: ViewSettings, progress: Progress) -> list[ShownObject]:
    """Read the inputs of a view; see `clrecon.jobs.view.inputs.open_inputs`."""
    return wrap_inputs(open_inputs(inputs, settings, progress=progress), settings.names)


def choose_iso(objects: Sequence[ShownObject], scan: MeshSettings, progress: Progress) -> float | None:
    """Return the iso value to begin with, by the first scan; None: that of the model."""
    first = next((each for each in objects if isinstance(each, ShownScan)), None)
    if first is None or (scan.iso_value, scan.preset, scan.half_way) == (None, None, None):
        return None
    choice = choose_level(first.volume, scan, progress)
    level = scan.levels[0] if choice is None else choice.iso_value
    assert isinstance(level, float | int) and math.isfinite(level)
    return float(level)


class OpenedView(Closing):
    """What the views of some objects share, and what has to be `said` of them; a context manager.

    carried: A view of other objects that the model shows, see `carry_view`.
    """

    def __init__(
        self,
        objects: Sequence[ShownObject],
        settings: ViewSettings,
        progress: Progress = ignore_progress,
        *,
        carried: Mapping[str, Any] | None = None,
    ):
        scan = settings.scan
        self.objects = list(objects)
        self.said = list(dict.fromkeys(chain(*(each.said for each in self.objects))))
        self._iso_value = choose_iso(self.objects, scan, progress)
        self._space, self._keep_ids = scan.space, scan.keep_ids
        self._progress = progress
        has_scan = any(isinstance(each, ShownScan) for each in self.objects)
        self._fitted = scan.surface == "cortex" and has_scan
        self._saved = carried if settings.state is None else read_view(settings.state)
        self._carried = carried
        self.painter = Painter(self.objects, device=scan.device, memory=scan.memory)
        self._begins_with_bone = has_scan and not self._fitted and (self._saved, self._iso_value) == (None, None)
        self._begins_bare = self._begins_with_bone and not scan.remove_table and self._take_table(progress)

    def _take_table(self, progress: Progress) -> bool:
        """Take the tables of the scans away for the first picture; where a body is not sure they stay, with a word."""
        try:
            self.painter.remove_table(progress)
        except RefusedInputError as error:
            self.said.append(f"the table is shown: {error}")
            return False
        return True

    def session(self, on_change: Callable[[], None] | None = None) -> ViewSession:
        session = ViewSession(
            self.objects,
            self.painter,
            space=self._space,
            iso_value=self._iso_value,
            keep_ids=self._keep_ids,
            on_change=on_change,
        )
        if self._saved is not None:
            session.restore(self._saved)
        elif self._fitted:
            session.set_fitted(True)
        elif self._begins_with_bone:
            session.begin_with_bone(bare=self._begins_bare)
        return session

    def model(self, aspect: float) -> ViewModel:
        """Return what a view begins with, with the table taken away where the saved view says so."""
        model = ViewModel(self.objects, space=self._space, iso_value=self._iso_value)
        model.set_aspect(aspect)
        if self._carried is not None:
            bare = self._carried.get("table_shown") is False and self._take_table(self._progress)
            restore_elsewhere({**self._carried, "table_shown": not bare}, model)
        elif self._saved is not None:
            if model.scans and self._saved.get("table_shown") is False:
                self.painter.remove_table(self._progress)
            restore_view(self._saved, model)
        elif self._fitted:
            model.set_fitted(True)
        elif self._begins_with_bone:
            model.begin_with_bone(bare=self._begins_bare)
        return model

    def close(self) -> None:
        self.painter.close()


def open_view(
    inputs: Sequence[str | Path], settings: ViewSettings | None = None, *, progress: Progress | None = None
) -> OpenedView:
    """Read inputs for a view; the settings say how, and with which iso value it begins."""
    settings = settings or ViewSettings()
    check_view_settings(settings)
    progress = progress or ignore_progress
    return OpenedView(read_objects(inputs, settings, progress), settings, progress)


def draw_view(
    inputs: Sequence[str | Path],
    settings: ViewSettings,
    output: str | Path,
    size: Sequence[int] = (1024, 1024),
    *,
    no_clobber: bool = False,
    progress: Progress = ignore_progress,
) -> tuple[list[str], list[str]]:
    """Draw what a view of the inputs begins with, as its key p saves it; return warnings, and lines about the file."""
    check_image_path(output)
    load_pillow()
    with keep_existing(keep=no_clobber):
        check_writable(output)
    with open_view(inputs, settings, progress=progress) as view:
        return view.said, _draw_opened(view, output, size, no_clobber=no_clobber, progress=progress)


def draw_carried(
    source: str,
    labels: str | None,
    scan: MeshSettings,
    output: Path,
    *,
    size: Sequence[int],
    carried: str,
    read: Reader,
) -> list[str]:
    """Draw a scan, with its label map if the view has one, as a view of another scan shows it; return warnings.

    carried: JSON of `carry_view`.
    read: See `open_inputs`.
    """
    saved = json.loads(carried)
    choice = LabelChoice(labels) if labels is not None and "labels" in saved["objects"] else None
    settings = ViewSettings(scan=replace(scan, labels=choice))
    objects = wrap_inputs(open_inputs([source], settings, read=read), ())
    with OpenedView(objects, settings, carried=saved) as view:
        _draw_opened(view, output, size)
        return view.said


def _draw_opened(
    view: OpenedView,
    output: str | Path,
    size: Sequence[int],
    *,
    no_clobber: bool = False,
    progress: Progress = ignore_progress,
) -> list[str]:
    model, painter = view.model(size[0] / size[1]), view.painter
    if any(each.kind in ("cluster", "rest") and not each.is_plain for each in model.state.parts):
        model.take_parts(painter.find_parts(model.state, progress))
    if shows_fits(model.state):
        painter.fit_scans(model.state, progress)
    return save_shown(output, painter, model.state, size=size, no_clobber=no_clobber, progress=progress)
