"""Inputs in, a view in any number of browsers of this machine out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from clrecon.jobs.view.inputs import ViewSettings, check_view_settings
from clrecon.system.progress import Progress
from clrecon.viewer.drawing.saving import check_names
from clrecon.viewer.session.opening import OpenedView, open_view
from clrecon.viewer.web.connection import ignore_line
from clrecon.viewer.web.listening import has_screen, open_browser
from clrecon.viewer.web.server import WebServer


def serve_view(
    inputs: Sequence[str | Path],
    settings: ViewSettings | None = None,
    *,
    port: int | None = None,
    opens: bool = True,
    save_as: Sequence[str] = (),
    wrote: Callable[[str], object] = ignore_line,
    progress: Progress | None = None,
    ready: Callable[[WebServer, OpenedView, list[str]], object] = lambda server, view, warnings: None,
) -> None:
    """Show inputs in browsers, until SIGINT (Ctrl-C), SIGTERM or SIGHUP.

    The server listens on 127.0.0.1 alone and lets in what knows its secret, see `clrecon.viewer.web.admission`.

    inputs: See `clrecon.jobs.view.inputs.open_inputs`.
    port: Default: a free one.
    opens: Open the user's browser.
    save_as: Files that a save writes into the current folder, in place of a download; numbered where they exist.
    wrote: Called with a line for each of these.
    progress: Of the reading.
    ready: Called with the server, what was read and warnings, once the address can be opened.
    """
    settings = settings or ViewSettings()
    check_view_settings(settings)
    check_names(save_as)
    with (
        WebServer(port, save_as=save_as, wrote=wrote) as server,
        open_view(inputs, settings, progress=progress) as view,
        view.session() as first,  # nobody looks through it: it builds kernels while the address is being opened
    ):

        def begin(folder: Path) -> None:
            first.prepare()
            warnings = list(view.said)
            if opens and has_screen():
                open_browser(server.address, folder)
            elif opens:
                warnings.append(
                    "no browser was opened: there is no screen; open the address on a computer that has one"
                )
            ready(server, view, warnings)

        server.serve(view.session, begin)
