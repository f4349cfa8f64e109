"""Lines for narrow terminals: broken between words, never within one, with the rest under the text of its line."""

from __future__ import annotations

import os
import re
import shutil
import textwrap
from typing import Any

_LABEL = re.compile(r"\s*\S+(?: \S+){0,2}\s{2,}|exit codes: |\s*")
_COMMAND = re.compile(r"\s*clrecon \S")

FULL = 90
"""A line of a help text that has no room for the next word within this length was broken for want of room."""


def is_terminal(stream: Any) -> bool:
    """True if `stream` is a terminal that can show moving lines and styles."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") != "dumb"


def fit(text: str, stream: Any) -> str:
    """Break the lines of a text for a terminal; for files and pipes it stays as it is, a line a fact."""
    return _fit_lines(text, shutil.get_terminal_size().columns) if is_terminal(stream) else text


def fit_help(text: str, stream: Any) -> str:
    """Break the lines of a help text for a terminal, or for the width that COLUMNS says; its examples can be pasted."""
    if not (is_terminal(stream) or os.environ.get("COLUMNS")):
        return text
    width = shutil.get_terminal_size().columns
    return "\n".join(_fit_paragraph(lines, max(width, 20)) for lines in _find_paragraphs(text.split("\n")))


def _find_paragraphs(lines: list[str]) -> list[list[str]]:
    """Put lines together that are one text: broken because they were full, with the rest under the beginning."""
    found: list[list[str]] = []
    for line in lines:
        if found and line.strip() and not _COMMAND.match(line) and not _has_label(line):
            last, indent, hang = found[-1][-1], _indent_of(line), _hang_of(found[-1][0])
            was_full = len(last) + 1 + len(line.split()[0]) > FULL
            if indent == hang > _indent_of(found[-1][0]) or was_full and indent in (_indent_of(last), hang):
                found[-1].append(line)
                continue
        found.append([line])
    return found


def _fit_paragraph(lines: list[str], width: int) -> str:
    if _COMMAND.match(lines[0]) or max(map(len, lines)) <= width:
        return "\n".join(part for line in lines for part in _fit_line(line, width))
    text = " ".join([lines[0].rstrip(), *(line.strip() for line in lines[1:])])
    hang = _hang_of(lines[0]) if _hang_of(lines[0]) <= width // 2 else _indent_of(lines[0])
    return "\n".join(_wrap(text, width, hang))


def _has_label(line: str) -> bool:
    """True for a row of a list: a word or a few, and its text after a gap."""
    return _hang_of(line) > _indent_of(line)


def _indent_of(line: str) -> int:
    return len(line) - len(line.lstrip())


def _hang_of(line: str) -> int:
    """Return where the text of a line begins, after its indentation or its label."""
    label = _LABEL.match(line)
    return len(label[0]) if label else 0


def _fit_lines(text: str, width: int) -> str:
    return "\n".join(part for line in text.split("\n") for part in _fit_line(line, max(width, 20)))


def _fit_line(line: str, width: int) -> list[str]:
    if len(line) <= width or "\x1b" in line:  # a table with styles has been laid out for the terminal
        return [line]
    hang = _hang_of(line)
    is_command = _COMMAND.match(line) is not None
    if is_command or hang > width // 2 or not line[:hang].strip():
        hang = _indent_of(line) + 2
    parts = _wrap(line, width - 2 * is_command, hang)
    return [f"{part} \\" for part in parts[:-1]] + parts[-1:] if is_command else parts


def _wrap(line: str, width: int, hang: int) -> list[str]:
    return textwrap.wrap(
        line, width, subsequent_indent=" " * hang, break_long_words=False, break_on_hyphens=False,
        replace_whitespace=False, expand_tabs=False,
    )  # fmt: skip
