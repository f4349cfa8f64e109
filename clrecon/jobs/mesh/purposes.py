"""Purposes of meshes: names that stand for settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from clrecon.errors import UsageError
from clrecon.system.text import guess_word


@dataclass(frozen=True)
class Purpose:
    """A name that stands for settings.

    settings: Fields of `MeshSettings` that it sets if they are not given.
    description: One line.
    is_for_print: The surface has to be closed and of bone, and what a printer needs to know of it is measured.
    """

    name: str
    settings: dict[str, Any]
    description: str
    is_for_print: bool = False


PURPOSES: dict[str, Purpose] = {
    purpose.name: purpose
    for purpose in (
        Purpose(
            "print",
            {"keep": "bone", "keep_largest": 1, "solid": True, "smooth": 20, "decimate": 0.9, "strict": True},
            "one closed piece, of solid bone at iso values of bone; size and thickness of walls are said",
            is_for_print=True,
        ),
        Purpose(
            "paper-b",
            {"preprocess": "bilateral-2d,open:1", "method": "i-mc", "vertex_rule": "golden"},
            "improved marching cubes as Liu et al. 2019 have it; the vertex rule linear is more exact",
        ),
    )
}


def find_purpose(name: str) -> Purpose:
    """Return the purpose of this name."""
    if name not in PURPOSES:
        raise UsageError(f"a mesh can be for {', '.join(PURPOSES)}, not for {name!r}{guess_word(name, PURPOSES)}")
    return PURPOSES[name]
