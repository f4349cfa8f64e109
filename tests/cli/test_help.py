"""Two levels of help: one screen with the options that most people need, and all options by group."""

from __future__ import annotations

import argparse
import shlex

import pytest
from command_lines import parse_command, parser_of

from clrecon.cli.common import SCREEN_LINES
from clrecon.cli.main import COMMANDS, main

SCREEN_COLUMNS = 100


@pytest.fixture(autouse=True)
def screen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal of `SCREEN_COLUMNS`."""
    monkeypatch.setenv("COLUMNS", str(SCREEN_COLUMNS))


def help_of(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What a command that asks for help prints."""
    assert main(arguments) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return captured.out


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_short_help_fits_one_screen_and_names_the_full_help_where_there_is_more(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text, whole = help_of([command, "-h"], capsys), help_of(["help", command], capsys)
    assert help_of([command, "--help"], capsys) == text
    lines = text.split("\n")
    assert len(lines) <= SCREEN_LINES and max(map(len, lines)) <= SCREEN_COLUMNS
    assert lines[0].startswith(f"usage: clrecon {command} ")
    assert COMMANDS[command].help in text
    if text != whole:
        assert f"clrecon help {command}, or clrecon {command} --help-all" in lines[-2]
        assert [line for line in lines if "--help-all" in line] == [lines[-2]]


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_full_help_names_each_option(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(["help", command], capsys)
    assert help_of([command, "--help-all"], capsys) == text
    words = set(text.replace(",", " ").split())
    for action in parser_of(command)._actions:
        if action.help != argparse.SUPPRESS:
            assert set(action.option_strings) <= words


WITHOUT_EXAMPLES = {"completion", "demo", "devices", "info", "selftest"}
"""Commands that need at most an input."""


@pytest.mark.parametrize("command", sorted(COMMANDS.keys() - WITHOUT_EXAMPLES))
def test_two_or_three_examples_of_the_short_help_are_understood(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _, _, examples = help_of([command, "-h"], capsys).replace("\\\n", "").partition("examples:\n")
    lines = [line for line in examples.split("\n\n")[0].split("\n") if line]
    assert 2 <= len(lines) <= 3
    for line in lines:
        for called in line.split("&&"):
            program, *arguments = shlex.split(called)
            assert program == "clrecon"
            parse_command(arguments)


def test_short_help_of_mesh_has_twelve_options_and_three_examples(capsys: pytest.CaptureFixture[str]) -> None:
    text = help_of(["mesh", "-h"], capsys)
    first = [line.split()[0] for line in text.split("\n") if line.startswith("  -")]
    assert len(first) == 12 and {"-o", "--hu", "--for", "--labels", "--device"} <= set(first)
    assert "--topology" not in text and text.count("  clrecon mesh CT_FOLDER") == 3
    assert "iso value in HU, inside is N and above\n" in text
