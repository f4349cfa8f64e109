"""Lines for terminals of 60 columns: no break within a word, commands that can be pasted; pipes get whole lines."""

from __future__ import annotations

import pytest

from clrecon.cli import console
from clrecon.cli.main import COMMANDS, main


class Terminal:
    def isatty(self) -> bool:
        return True


@pytest.fixture
def narrow(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setenv("TERM", "xterm")


def test_lines_break_between_words_and_go_on_under_their_text(narrow):
    line = "surface  200 HU (as given), closed at the border of the volume, and more words that are too long for it"
    parts = console.fit(line, Terminal()).split("\n")
    assert max(map(len, parts)) <= 60 and len(parts) == 2
    assert parts[1].startswith(" " * 9) and parts[1][9] != " "
    assert " ".join(part.strip() for part in parts) == line
    assert console.fit(line, None) == line and console.fit("short", Terminal()) == "short"
    styled = "\x1b[1m" + "table  " * 20
    assert console.fit(styled, Terminal()) == styled
    path = "wrote    /" + "x" * 80
    assert console.fit(path, Terminal()).replace("\n", " ").split() == path.split()  # a word stays whole
    warning = "clrecon: warning: " + "word " * 20
    assert all(part.startswith("  word") for part in console.fit(warning, Terminal()).split("\n")[1:])


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_help_fits_60_columns_and_its_examples_can_be_pasted(command, narrow, capsys):
    assert main([command, "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")
    # what is longer is one word with its indentation, or in brackets that argparse keeps whole
    assert not [line for line in lines if len(line) > 60 and len(line.split()) > 1]
    for line, following in zip(lines, lines[1:], strict=False):
        if line.endswith(" \\"):
            assert following.startswith("    ")


def test_texts_of_help_are_broken_anew_as_a_whole(narrow, capsys):
    """Lines that were full are one text: no short rest of a line before the next."""
    assert main(["view", "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")
    at = next(place for place, line in enumerate(lines) if line.startswith("The page of --html is one file"))
    text = lines[at : lines.index("", at)]
    assert len(text) > 3 and all(line[0] != " " for line in text)
    assert all(len(line) + 1 + len(after.split()[0]) > 60 for line, after in zip(text, text[1:], strict=False))
    at = next(place for place, line in enumerate(lines) if line.startswith("exit codes: 0 done"))
    codes = [line for line in lines[at:] if line]
    assert all(line.startswith(" " * 12) for line in codes[1:])
    assert all(len(line) + 1 + len(after.split()[0]) > 60 for line, after in zip(codes, codes[1:], strict=False))


@pytest.mark.parametrize(
    ("command", "rows"),
    [
        ("mesh", ["  bone  ", "  spongy-bone  ", "  cortical-bone  ", "  skin  "]),
        ("cloud", ["  ghost slices  ", "  masks  ", "  preprocessing  ", "  outliers  ", "  normals  "]),
        ("inside", ["  solid  ", "  dense  ", "  trabecular  ", "  canal  "]),
    ],
)
def test_each_row_of_a_list_keeps_a_line_of_its_own(command, rows, narrow, capsys):
    assert main([command, "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")
    for row in rows:
        assert len([line for line in lines if line.startswith(row)]) == 1, row


def test_words_with_hyphens_stay_whole_and_prose_has_one_margin(narrow, capsys):
    for command in ("mesh", "compare"):
        assert main([command, "--help-all"]) == 0
        lines = capsys.readouterr().out.split("\n")
        assert not [line for line in lines if line.rstrip().endswith(("bilateral-", "soft-", "non-"))]
    assert main(["inside", "--help-all"]) == 0
    lines = capsys.readouterr().out.split("\n")
    at = lines.index("measure dense and trabecular bone and canal of vertebrae, as")
    assert lines[at + 1] == "meshes"
