"""Lines for narrow terminals: broken between words, never within one, with the rest under the text of its line."""

from __future__ import annotations

import os
import re
import shutil
import textwrap
from typing import Any

__all__ = ["fit", "fit_help", "is_terminal"]

_LABEL = re.compile(r"\s*\S+\s{2,}|\s*")
_COMMAND = re.compile(r"\s*clrecon \S")


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
    return _fit_lines(text, shutil.get_terminal_size().columns)


def _fit_lines(text: str, width: int) -> str:
    return "\n".join(part for line in text.split("\n") for part in _fit_line(line, max(width, 20)))


def _fit_line(line: str, width: int) -> list[str]:
    if len(line) <= width or "\x1b" in line:  # a table with styles has been laid out for the terminal
        return [line]
    label = _LABEL.match(line)
    hang = len(label[0]) if label else 0
    is_command = _COMMAND.match(line) is not None
    if is_command or hang > width // 2 or not line[:hang].strip():
        hang = len(line) - len(line.lstrip()) + 2
    parts = textwrap.wrap(
        line, width - 2 * is_command, subsequent_indent=" " * hang, break_long_words=False, break_on_hyphens=False,
        replace_whitespace=False, expand_tabs=False,
    )  # fmt: skip
    return [f"{part} \\" for part in parts[:-1]] + parts[-1:] if is_command else parts
