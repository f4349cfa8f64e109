"""A real Firefox for the tests of pages, asked in WebDriver BiDi, which it speaks itself; on a screen that is none."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from screens import open_screen

SECONDS = 120.0
"""Until Firefox answers; it takes 2 s to start where nothing else runs."""


@contextmanager
def open_firefox(*, width: int = 1200, height: int = 800) -> Iterator[Firefox]:
    """Start Firefox with a page of a size; skip where it, a screen or selenium's websocket-client is missing."""
    program = shutil.which("firefox-esr") or shutil.which("firefox")
    if program is None or find_spec("websocket") is None:
        if os.environ.get("CLRECON_REQUIRE_BROWSER"):
            pytest.fail("CLRECON_REQUIRE_BROWSER is set: firefox-esr or websocket-client is missing")
        pytest.skip("needs Firefox and websocket-client: apt-get install firefox-esr")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile, open_screen() as display:
        Path(profile, "user.js").write_text('user_pref("webgl.force-enabled", true);\n')  # in software
        command = [program, "--no-remote", "--profile", profile, "--remote-debugging-port=0", "about:blank"]
        environment = os.environ | {"DISPLAY": display}
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        try:
            firefox = Firefox(_find_address(process))
            firefox.set_size(width, height)
            yield firefox
            firefox.close()
        finally:
            process.kill()
            process.communicate()


def _find_address(process: subprocess.Popen[str]) -> str:
    assert process.stderr is not None
    for line in process.stderr:
        if address := re.search(r"BiDi listening on (ws://\S+)", line):
            return address[1]
    raise RuntimeError(f"Firefox ended with {process.wait()} before it listened")


class Firefox:
    """A window of Firefox, with the methods of selenium's drivers that tests use.

    errors: What pages have logged as errors.
    """

    def __init__(self, address: str) -> None:
        import websocket

        self._socket = websocket.create_connection(f"{address}/session", suppress_origin=True, timeout=SECONDS)
        self._count = 0
        self.errors: list[str] = []
        self._ask("session.new", capabilities={})
        self._ask("session.subscribe", events=["log.entryAdded"])
        self._page = self._ask("browsingContext.getTree")["contexts"][0]["context"]

    def close(self) -> None:
        self._ask("browser.close")
        self._socket.close()

    def _ask(self, method: str, **params: Any) -> Any:
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": params}))
        while True:
            answer = json.loads(self._socket.recv())
            if answer.get("method") == "log.entryAdded" and answer["params"]["level"] == "error":
                self.errors.append(answer["params"]["text"])
            if answer.get("id") == self._count:
                assert answer["type"] == "success", answer
                return answer["result"]

    def set_size(self, width: int, height: int) -> None:
        self._ask("browsingContext.setViewport", context=self._page, viewport={"width": width, "height": height})

    def get(self, address: str) -> None:
        self._ask("browsingContext.navigate", context=self._page, url=address, wait="complete")

    def execute_script(self, script: str, *arguments: Any) -> Any:
        """Run the body of a function in the page, with `arguments`; return its result."""
        called = f"(text) => JSON.stringify((function () {{ {script} }}).apply(null, JSON.parse(text)))"
        answer = self._ask(
            "script.callFunction",
            functionDeclaration=called,
            arguments=[{"type": "string", "value": json.dumps(arguments)}],
            target={"context": self._page},
            awaitPromise=False,
        )
        assert answer["type"] == "success", answer["exceptionDetails"]["text"]
        return json.loads(answer["result"].get("value", "null"))

    def point_of(self, selector: str) -> tuple[int, int]:
        """The middle of an element in the window, after it was scrolled into view."""
        x, y = self.execute_script(
            "const one = document.querySelector(arguments[0]); one.scrollIntoView({block: 'nearest'});"
            "const box = one.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2];",
            selector,
        )
        return round(x), round(y)

    def drag(self, start: tuple[int, int], *, dx: int = 0, dy: int = 0, steps: int = 10) -> None:
        """Press the mouse at a place of the window, move it in steps, and let it go; without a way it is a click."""
        moves = (
            [(round(dx * step / steps), round(dy * step / steps)) for step in range(1, steps + 1)] if dx or dy else []
        )
        places = [(start[0] + x, start[1] + y) for x, y in [(0, 0), *moves]]
        acts = [{"type": "pointerMove", "x": x, "y": y, "duration": 15} for x, y in places]
        acts.insert(1, {"type": "pointerDown", "button": 0})
        acts.append({"type": "pointerUp", "button": 0})
        mouse = {"type": "pointer", "id": "mouse", "actions": acts}
        self._ask("input.performActions", context=self._page, actions=[mouse])

    def click(self, selector: str) -> None:
        self.drag(self.point_of(selector))
