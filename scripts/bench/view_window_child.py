"""The window of a view in a process of its own, with a clock: JSON on standard output when it is closed."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

__all__: list[str] = []


def main(arguments: list[str]) -> None:
    """Show a file: ``view_window_child.py STARTED DEVICE HU FILE``, with the wall clock at the start of the process."""
    started, device, hu, path = float(arguments[0]), arguments[1], float(arguments[2]), arguments[3]
    marks: dict[str, Any] = {"started": started, "draw_ms": []}

    def mark(name: str) -> None:
        marks.setdefault(name, time.time() - started)

    from clrecon.jobs.mesh.settings import MeshSettings
    from clrecon.jobs.view.inputs import ViewSettings
    from clrecon.viewer.window import glass, window_content
    from clrecon.viewer.window.open_window import open_window

    draw: Callable[..., bool] = glass.Glass.draw
    show_slice: Callable[..., None] = window_content.WindowContent._show_slice
    show_picture: Callable[..., None] = window_content.WindowContent._show_picture
    pictures: list[list[Any]] = []

    def timed_draw(self: Any) -> bool:
        begun = time.perf_counter()
        drawn = draw(self)
        if drawn:
            mark("words_s")
            if pictures:
                marks["draw_ms"].append(round(1000.0 * (time.perf_counter() - begun), 2))
        return drawn

    def timed_slice(self: Any, *given: Any) -> None:
        show_slice(self, *given)
        mark("first_slice_s")

    def timed_picture(self: Any, made: Any) -> None:
        show_picture(self, made)
        mark("first_picture_s")
        report = made.report
        pictures.append([time.time(), report["ms"], report["sharp"], made.size[0], self.facts["mode"]])

    setattr(glass.Glass, "draw", timed_draw)  # noqa: B010
    setattr(window_content.WindowContent, "_show_slice", timed_slice)  # noqa: B010
    setattr(window_content.WindowContent, "_show_picture", timed_picture)  # noqa: B010
    settings = ViewSettings(scan=MeshSettings(device=device, iso_value=hu))
    open_window([path], settings, ready=lambda view: mark("read_s"))
    print(json.dumps({**marks, "pictures": pictures}))


if __name__ == "__main__":
    main(sys.argv[1:])
