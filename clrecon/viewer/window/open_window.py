"""Inputs in, a view in a window out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from clrecon.errors import UsageError
from clrecon.jobs.view.inputs import ViewSettings, check_view_settings
from clrecon.system.display import DisplayProbe
from clrecon.system.files import check_writable
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import escape_text
from clrecon.viewer.window.file_names import free_name

if TYPE_CHECKING:
    from clrecon.viewer.session.opening import OpenedView
    from clrecon.viewer.session.session import ViewSession


def open_window(
    inputs: Sequence[str | Path],
    settings: ViewSettings | None = None,
    *,
    save_as: Sequence[str] = (),
    progress: Progress | None = None,
    ready: Callable[[OpenedView], None] = lambda view: None,
    say: Callable[[str], None] = lambda words: None,
    describe: Callable[[str], str] = str,
    probe: DisplayProbe | None = None,
) -> list[str]:
    """Show inputs in a window until it is closed.

    inputs: See `clrecon.jobs.view.inputs.open_inputs`.
    save_as: Files that a save writes; the extension says as what.
    progress: Of the reading; called in a thread.
    ready: Called with what was read, when it is shown.
    say: Gets a line for each file that was written.
    describe: Returns the words for a stage of the progress.
    probe: One that was started before.

    Returns: The lines that were said.
    """
    probe = probe or DisplayProbe()  # it takes half a second, in which VTK is imported
    settings, tell = settings or ViewSettings(), progress or ignore_progress
    check_view_settings(settings)
    _check_names(save_as)
    if not all(Path(path).exists() for path in inputs):  # this is said without a window
        _open(inputs, settings, tell).close()
    from clrecon.viewer.window.window import show_window

    opened: list[OpenedView] = []
    said: list[str] = []

    def load(shown: Progress) -> ViewSession:
        def both(stage: str, done: int, total: int) -> None:
            shown(stage, done, total)
            tell(stage, done, total)

        view = _open(inputs, settings, both)
        opened.append(view)
        return view.session()

    def note(line: str) -> None:
        said.append(line)
        say(line)

    try:
        show_window(
            load,
            save_as=save_as,
            say=note,
            describe=describe,
            loaded=lambda: ready(opened[0]),
            probe=probe,
        )
    finally:
        for view in opened:
            view.close()
    return said


def _open(inputs: Sequence[str | Path], settings: ViewSettings, progress: Progress) -> OpenedView:
    from clrecon.viewer.session.opening import open_view  # which loads OpenCL: the window is there by then

    return open_view(inputs, settings, progress=progress)


def _check_names(names: Sequence[str]) -> None:
    """Refuse names of files that cannot be written, before anything is read."""
    if not names:
        return
    from clrecon.viewer.drawing.saving import KINDS

    known = [ending for endings in KINDS.values() for ending in endings]
    for name in names:
        if not any(name.lower().endswith(ending) for ending in known):
            raise UsageError(
                f"{escape_text(Path(name).name)}: the extension says as what it is written, one of"
                f" {', '.join(dict.fromkeys(known))}"
            )
        check_writable(free_name(name))
