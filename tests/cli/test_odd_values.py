"""Every option of every command with values that nobody should give: refused in words, or taken."""

from __future__ import annotations

import argparse
import gettext
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_lines import parser_of
from variants import FOR_RELEASE

from clrecon.cli.common import Parser
from clrecon.cli.main import main

NINES = "9" * 400
ODD = (
    "", " ", "--", "-0", "-1", "nan", "-inf", "1e200", "1e-320", NINES, "9" * 5000, "x" * 5000, "\u0663", "\ud800",
    "a\0b", "%s", ",", "1,nan,inf", "1e200,1e200,1e200", "2:1", "-inf:inf", "half:nan,1", "=a", "a=nan", f"{NINES}x1",
    "1e308,-1e308,1e308,-1e308,1e308,-1e308", "--json",
)  # fmt: skip

INPUTS = {
    "mesh": ("{there}/scan", "-o", "{nowhere}/bone.stl"),
    "render": ("{there}/scan", "-o", "{nowhere}/bone.png"),
    "info": ("{there}/scan",),
    "phantom": ("{nowhere}/phantom",),
    "bench": ("{there}/scan", "--report", "{nowhere}/bench.json"),
    "demo": ("{nowhere}/demo",),
    "compare": ("{there}/scan", "-o", "{nowhere}/report"),
}
"""Arguments that end a command after its options were checked, before a device is opened: a folder that is missing."""

_MOVIE = "--turntable={nowhere}/a.gif"
BESIDE = {"--grow": "--labels={there}/a.nii", "--frames": _MOVIE, "--fps": _MOVIE, "--degrees": _MOVIE,
          "--max-deviation": "--smooth"}  # fmt: skip
"""Options without which others mean nothing."""


def list_options(command: str) -> Iterator[argparse.Action]:
    actions = parser_of(command)._actions
    yield from (action for action in actions if action.option_strings and action.nargs != 0)


OPTIONS = [(command, action) for command in INPUTS for action in list_options(command)]


def is_read_as_another(place: int) -> bool:
    """True where an earlier option of the list takes its values by the same function."""
    action = OPTIONS[place][1]
    return any((earlier.type, earlier.nargs) == (action.type, action.nargs) for _, earlier in OPTIONS[:place])


def ways_to_say(action: argparse.Action, value: str) -> list[list[str]]:
    name = action.option_strings[-1]
    if isinstance(action.nargs, int):
        return [[name, *[value] * action.nargs]]
    return [[f"{name}={value}"]]


@pytest.fixture
def untranslated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Argparse looks for a translation of each of its words: a third of the time of a call."""
    monkeypatch.setattr(gettext, "dgettext", lambda domain, text: text)
    monkeypatch.setattr(gettext, "dngettext", lambda domain, one, many, count: one if count == 1 else many)


@pytest.mark.usefixtures("untranslated")
@pytest.mark.parametrize(
    ("command", "action"),
    [
        pytest.param(*option, marks=FOR_RELEASE if is_read_as_another(place) else ())
        for place, option in enumerate(OPTIONS)
    ],
    ids=[f"{command}{action.option_strings[-1]}" for command, action in OPTIONS],
)
def test_odd_values_of_an_option_are_refused_in_one_line_each_and_write_nothing(
    command: str, action: argparse.Action, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scan").mkdir()
    places = {"there": str(tmp_path), "nowhere": str(tmp_path / "nowhere")}
    beside = [BESIDE[action.option_strings[-1]]] if action.option_strings[-1] in BESIDE else []
    base = [text.format(**places) for text in (*INPUTS[command], *beside)]
    wrong = []
    for value in ODD:
        for said in ways_to_say(action, value):
            code = main([command, *base, *said])
            lines = capfd.readouterr().err.splitlines()
            errors = [line for line in lines if line.startswith("clrecon: error: ")]
            if code not in (2, 3, 4, 6) or len(lines) != 1 or errors != lines or len(lines[0]) > 1200:
                wrong.append((value[:40], said[0][:40], code, [line[:200] for line in lines]))
    assert wrong == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scan"]


@pytest.mark.parametrize("value", ["--", "---", "-", "--json"])
def test_value_of_dashes_after_an_equals_sign_is_the_value(value: str) -> None:
    parser = Parser(prog="clrecon")
    parser.add_argument("--text")
    parser.add_argument("--number", nargs="?", type=str.upper)
    given = parser.parse_args([f"--text={value}", f"--number={value}"])
    assert (given.text, given.number) == (value, value.upper())
