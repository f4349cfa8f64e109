"""Inputs in, a view in any number of browsers of this machine out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from clrecon.jobs.view.inputs import ViewSettings, check_view_settings
from clrecon.system.progress import Progress
from clrecon.viewer.session.opening import OpenedView, open_view
from clrecon.viewer.web.listening import has_screen, open_browser
from clrecon.viewer.web.server import WebServer


def serve_view(
    inputs: Sequence[str | Path],
    settings: ViewSettings | None = None,
    *,
    port: int | None = None,
    opens: bool = False,
    progress: Progress | None = None,
    ready: Callable[[WebServer, OpenedView, list[str]], object] = lambda server, view, warnings: None,
) -> None:
    """Show inputs in browsers, until SIGINT (Ctrl-C), SIGTERM or SIGHUP.

    The server listens on 127.0.0.1 alone and lets in what knows its secret, see `clrecon.viewer.web.admission`.

    inputs: See `clrecon.jobs.view.inputs.open_inputs`.
    port: Default: a free one.
    opens: Open the user's browser.
    progress: Of the reading.
    ready: Called with the server, what was read and warnings, once the address can be opened.
    """
    settings = settings or ViewSettings()
    check_view_settings(settings)
    with (
        WebServer(port) as server,
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
