"""The tables of docs/contract.md as sets of names, to be compared with what the program really gives."""

from __future__ import annotations

import re
from pathlib import Path

CONTRACT = Path(__file__).resolve().parents[2] / "docs" / "contract.md"


def names_in(heading: str, opening: str = "") -> set[str]:
    """Names in the first column of the first table under `heading`, or after the line that begins with `opening`."""
    section = CONTRACT.read_text(encoding="utf-8").split(f"\n## {heading}", 1)[1].split("\n## ", 1)[0]
    if opening:
        section = section.split(f"\n{opening}", 1)[1]
    names: set[str] = set()
    for line in section[section.index("\n|") + 1 :].splitlines():
        if not line.startswith("|"):
            break
        names.update(re.findall(r"`(\w+)`", line.split("|")[1]))
    return names
