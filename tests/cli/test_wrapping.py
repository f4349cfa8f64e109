"""Lines for terminals of 60 columns: no break within a word, commands that can be pasted; pipes get whole lines."""

from __future__ import annotations

from itertools import pairwise

import pytest

from clrecon.cli import console
from clrecon.cli.main import COMMANDS, main

COLUMNS = 60
"""Width of the terminal of these tests."""


class Terminal:
    def isatty(self) -> bool:
        return True


@pytest.fixture
def narrow(monkeypatch):
    """A terminal of `COLUMNS`."""
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    monkeypatch.setenv("TERM", "xterm")


LONG_LINE = "surface  200 HU (as given), closed at the border of the volume, and more words that are too long for it"


def test_long_line_is_broken_between_words_and_goes_on_under_its_text(narrow):
    first, second = console.fit(LONG_LINE, Terminal()).split("\n")

    assert max(len(first), len(second)) <= COLUMNS
    assert first.startswith("surface  ")
    under_the_text = " " * len("surface  ")
    assert second.startswith(under_the_text) and not second.startswith(under_the_text + " ")
    assert f"{first} {second.strip()}" == LONG_LINE


def test_long_warning_goes_on_two_letters_in(narrow):
    first, *others = console.fit("clrecon: warning: " + "word " * 20, Terminal()).split("\n")
    assert others
    assert all(line.startswith("  word") for line in others)


def test_word_longer_than_the_terminal_stays_whole(narrow):
    path = "/" + "x" * 80
    assert console.fit(f"wrote    {path}", Terminal()).split() == ["wrote", path]


@pytest.mark.parametrize(
    ("text", "stream"),
    [
        pytest.param(LONG_LINE, None, id="into a file"),
        pytest.param("short", Terminal(), id="short"),
        pytest.param("\x1b[1m" + "table  " * 20, Terminal(), id="with colours"),
    ],
)
def test_line_that_needs_no_break_stays_as_it_is(text, stream, narrow):
    assert console.fit(text, stream) == text


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_fits_60_columns_and_its_examples_can_be_pasted(command, narrow, capsys):
    assert main([command, "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")
    # what is longer is one word with its indentation, or in brackets that argparse keeps whole
    assert not [line for line in lines if len(line) > COLUMNS and len(line.split()) > 1]
    for line, following in zip(lines, lines[1:], strict=False):
        if line.endswith(" \\"):
            assert following.startswith("    ")


def is_filled(lines: list[str], columns: int) -> bool:
    """Whether the first word of each line would not have fitted into the line before it."""
    return all(len(line) + 1 + len(after.split()[0]) > columns for line, after in pairwise(lines))


def test_paragraph_of_help_is_broken_anew_as_a_whole_in_a_narrow_terminal(narrow, capsys):
    assert main(["view", "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")

    start = next(place for place, line in enumerate(lines) if line.startswith("The page of --html is one file"))
    paragraph = lines[start : lines.index("", start)]
    assert len(paragraph) > 3  # enough lines to see how they are filled: measured 6
    assert all(line[0] != " " for line in paragraph)
    assert is_filled(paragraph, COLUMNS)


def test_exit_codes_of_help_go_on_under_their_text_in_a_narrow_terminal(narrow, capsys):
    assert main(["view", "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")

    start = next(place for place, line in enumerate(lines) if line.startswith("exit codes: 0 done"))
    codes = [line for line in lines[start:] if line]
    assert len(codes) > 1
    assert all(line.startswith(" " * len("exit codes: ")) for line in codes[1:])
    assert is_filled(codes, COLUMNS)


@pytest.mark.parametrize(
    ("command", "rows"),
    [
        ("mesh", ["  bone  ", "  spongy-bone  ", "  cortical-bone  ", "  skin  "]),
        ("cloud", ["  ghost slices  ", "  masks  ", "  preprocessing  ", "  outliers  ", "  normals  "]),
        ("inside", ["  solid  ", "  dense  ", "  trabecular  ", "  canal  "]),
    ],
)
def test_each_row_of_a_list_in_help_begins_a_line(command, rows, narrow, capsys):
    assert main([command, "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")
    assert {row: sum(line.startswith(row) for line in lines) for row in rows} == dict.fromkeys(rows, 1)


@pytest.mark.parametrize("command", ["mesh", "compare"])
def test_word_with_a_hyphen_stays_whole_in_a_narrow_help(command, narrow, capsys):
    assert main([command, "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")
    assert any("bilateral-2d" in line for line in lines)
    assert not [line for line in lines if line.rstrip().endswith(("bilateral-", "soft-", "non-"))]


def test_prose_of_a_narrow_help_has_no_margin(narrow, capsys):
    assert main(["inside", "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")
    start = lines.index("measure dense and trabecular bone and canal of vertebrae, as")
    assert lines[start + 1] == "meshes"
