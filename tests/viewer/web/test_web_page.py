"""The page of the view: keys and commands that there are, and that it stands alone."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

from clrecon.viewer.session.commands import COMMANDS, KEYS, check_command, page_words
from clrecon.viewer.web.server import compose_page

pytestmark = pytest.mark.unit

SCRIPT = "".join((files("clrecon.viewer.web") / name).read_text(encoding="utf-8") for name in ("page.js", "panes.js"))


def test_keys_are_commands_or_what_the_page_does_itself() -> None:
    (block,) = re.findall(r"const OWN = \{(.*?)\n  \};", SCRIPT, re.DOTALL)
    own = set(re.findall(r"(?<![\w.])(\w+): (?:press|\(\))", block))
    assert own == {key.does for key in KEYS.values() if isinstance(key.does, str)}
    at = {"x": 1, "y": 1, "size": [2, 2], "plane": None}
    for key in KEYS.values():
        if not isinstance(key.does, str):
            check_command({**key.does, **(at if key.at_pointer else {})})


def test_every_key_and_tool_has_words() -> None:
    words = page_words()
    listed = [name for rows in words["help"].values() for name, _ in rows]
    for name, key in KEYS.items():
        assert (key.name or name) in listed or not key.words
    tools = re.search(r"const TOOLS = \{(.*?)\};", SCRIPT)
    assert tools is not None
    assert set(re.findall(r': "(\w+)"', tools[1])) == set(words["hints"])


def test_page_asks_only_for_commands_that_there_are() -> None:
    asked = set(re.findall(r"""\b(?:run|last|sumUp)\(["'](\w+)["']""", SCRIPT))
    asked |= set(re.findall(r"""\bdo: ["'](\w+)["']""", SCRIPT)) | set(re.findall(r"""["'](\w+_at)["']""", SCRIPT))
    assert len(asked) > 15
    assert asked - set(COMMANDS) == set()


def test_page_holds_no_open_placeholder_and_no_address() -> None:
    page = compose_page("127.0.0.1:1").content.decode()
    assert not re.search(r"@[A-Z]+@", page)
    assert set(re.findall(r"https?://[\w.]+", page)) == {"http://www.w3.org"}  # the name of SVG
