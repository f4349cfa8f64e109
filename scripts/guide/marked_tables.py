"""Tables in documents, between two markers, that a script writes and a test compares with their figures."""

from __future__ import annotations

import re
from collections.abc import Sequence


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table of markdown without padding, as the documents have them."""
    lines = [head, ["---"] * len(head), *rows]
    text = "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines)
    return text.replace("| --- |", "|---|").replace(" --- |", "---|").replace("|| ", "|")


def _block(name: str) -> re.Pattern[str]:
    return re.compile(
        rf"(<!-- {re.escape(name)}: made by .*? -->\n)(.*?)(\n<!-- end of {re.escape(name)} -->)", re.DOTALL
    )


def find_table(text: str, name: str) -> str:
    """Return what stands between the markers of this name."""
    found = _block(name).findall(text)
    if len(found) != 1:
        raise ValueError(f"{len(found)} tables are marked {name!r}, not one")
    return str(found[0][1])


def put_table(text: str, name: str, table: str) -> str:
    """Return the text with another table between the markers of this name."""
    find_table(text, name)
    return _block(name).sub(lambda block: block[1] + table + block[3], text)
