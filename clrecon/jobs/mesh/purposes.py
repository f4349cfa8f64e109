"""Purposes of meshes: names that stand for settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from clrecon.errors import UsageError

__all__ = ["PURPOSES", "Purpose", "find_purpose"]


@dataclass(frozen=True)
class Purpose:
    """A name that stands for settings.

    Attributes
    ----------
    name : str
    settings : dict
        Fields of `MeshSettings` that it sets if they are not given.
    description : str
        One line.
    """

    name: str
    settings: dict[str, Any]
    description: str


PURPOSES: dict[str, Purpose] = {
    purpose.name: purpose
    for purpose in (
        Purpose(
            "print",
            {"keep": "bone", "keep_largest": 1, "smooth": 20, "decimate": 0.9, "strict": True},
            "one closed piece, of bone at iso values of bone; size and thickness of walls are said",
        ),
    )
}


def find_purpose(name: str) -> Purpose:
    """Return the purpose of this name.

    Raises
    ------
    UsageError
        There is no purpose of this name.
    """
    if name not in PURPOSES:
        raise UsageError(f"a mesh can be for {', '.join(PURPOSES)}, not for {name!r}")
    return PURPOSES[name]
