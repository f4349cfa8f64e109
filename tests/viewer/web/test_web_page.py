"""The page of the view: keys and commands that there are, and that it stands alone."""

from __future__ import annotations

import re
from importlib.resources import files

import pytest

from clrecon.viewer.session.commands import COMMANDS, KEYS, check_command, page_words
from clrecon.viewer.web.server import compose_page

pytestmark = pytest.mark.unit

SCRIPT = "".join((files("clrecon.viewer.web") / name).read_text(encoding="utf-8") for name in ("page.js", "panes.js"))


def test_keys_that_are_no_commands_are_what_the_page_does_itself() -> None:
    (block,) = re.findall(r"const OWN = \{(.*?)\n  \};", SCRIPT, re.DOTALL)
    own = set(re.findall(r"(?<![\w.])(\w+): (?:press|onSlice|enlargeBy|turnBy|\(\))", block))

    assert own == {key.does for key in KEYS.values() if isinstance(key.does, str)}


@pytest.mark.parametrize("name", [name for name, key in KEYS.items() if not isinstance(key.does, str)])
def test_command_of_a_key_is_one_that_a_view_takes(name: str) -> None:
    at_pointer = {"x": 1, "y": 1, "size": [2, 2], "plane": None} if KEYS[name].at_pointer else {}

    check_command({**KEYS[name].does, **at_pointer})


def test_every_key_that_has_words_is_listed_in_the_help() -> None:
    listed = [name for rows in page_words()["help"].values() for name, _ in rows]

    assert [name for name, key in KEYS.items() if key.words and (key.name or name) not in listed] == []


def test_every_tool_of_the_page_has_a_hint() -> None:
    (tools,) = re.findall(r"const TOOLS = \{(.*?)\};", SCRIPT)

    assert set(re.findall(r': "(\w+)"', tools)) == set(page_words()["hints"])


def test_page_asks_only_for_commands_that_there_are() -> None:
    asked = set(re.findall(r"""\b(?:run|last|sumUp)\(["'](\w+)["']""", SCRIPT))
    asked |= set(re.findall(r"""\bdo: ["'](\w+)["']""", SCRIPT)) | set(re.findall(r"""["'](\w+_at)["']""", SCRIPT))
    assert {"set_iso", "turn", "mark_at"} <= asked  # the patterns find what the page does ask for
    assert asked - set(COMMANDS) == set()


def test_page_holds_no_open_placeholder_and_no_address() -> None:
    page = compose_page("127.0.0.1:1").content.decode()
    assert not re.search(r"@[A-Z]+@", page)
    assert set(re.findall(r"https?://[\w.]+", page)) == {"http://www.w3.org"}  # the name of SVG
