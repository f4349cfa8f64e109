"""The page of the view: what it shares with the window, and that it stands alone."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

from clrecon.rendering.looks.window import WINDOWS
from clrecon.viewer.session.commands import COMMANDS
from clrecon.viewer.web.page import compose_page
from clrecon.viewer.window.window_keys import KEYS

pytestmark = pytest.mark.unit

SCRIPT = (files("clrecon.viewer.web") / "page.js").read_text(encoding="utf-8")


def test_its_keys_are_those_of_the_window() -> None:
    (block,) = re.findall(r"const ACTIONS = \{(.*?)\n  \};", SCRIPT, re.DOTALL)
    keys = set(re.findall(r"(?<![\w.])(\w+): (?:press|\(\))", block))
    assert len(keys) > 15
    assert keys - set(KEYS) == set()


def test_it_asks_for_commands_that_there_are() -> None:
    asked = set(re.findall(r"""\b(?:run|last|sumUp)\(["'](\w+)["']""", SCRIPT))
    asked |= set(re.findall(r"""\bdo: ["'](\w+)["']""", SCRIPT)) | set(re.findall(r"""["'](\w+_at)["']""", SCRIPT))
    assert len(asked) > 15
    assert asked - set(COMMANDS) == set()


def test_it_holds_no_place_that_was_not_filled_and_no_address() -> None:
    page = compose_page("127.0.0.1:1").content.decode()
    assert not re.search(r"@[A-Z]+@", page)
    assert set(re.findall(r"https?://[\w.]+", page)) == {"http://www.w3.org"}  # the name of SVG


def test_its_windows_are_those_of_pictures() -> None:
    script = (files("clrecon.viewer.web") / "page.js").read_text(encoding="utf-8")
    presets = re.search(r"const PRESETS = \{(.*?)\};", script)
    assert presets is not None
    found = re.findall(r"(\w+): \[(-?\d+), (\d+)\]", presets[1])
    assert len(found) == 4
    for name, level, width in found:
        assert WINDOWS[name] == (int(level) - 0.5 * int(width), int(level) + 0.5 * int(width))
