"""Names and numbers of vertebrae, and the choice of some of them.

Numbers are those of the VerSe data set (Sekuboyina et al., Medical Image Analysis 73, 2021): 1 to 7 are C1 to C7, 8 to
19 are T1 to T12, 20 to 24 are L1 to L5.
"""

from __future__ import annotations

import re

from clrecon.errors import UsageError

THORACOLUMBAR = tuple([f"T{n}" for n in range(1, 13)] + [f"L{n}" for n in range(1, 6)])
"""Vertebrae of chest and loin from top to bottom: those of a spine phantom without a choice of levels."""

LEVELS = (*(f"C{n}" for n in range(1, 8)), *THORACOLUMBAR)
"""All vertebrae from top to bottom."""

_LONGEST = 200


def level_number(name: str) -> int:
    """Return the number of a level, 1 (C1) to 24 (L5)."""
    return LEVELS.index(name) + 1


def _parse_level(text: str, whole: str) -> int:
    name = text.strip().upper()
    if name not in LEVELS:
        known = text.strip()[:20]
        raise UsageError(f"levels {whole!r}: {known!r} is no level; there are C1 to C7, T1 to T12 and L1 to L5")
    return LEVELS.index(name)


def parse_levels(text: str) -> tuple[str, ...]:
    """Read a choice of levels such as ``"L1-L5"``, ``"C3"`` or ``"C3-C7,T1-T5"``.

    text: Levels, and ranges from the upper to the lower one, with commas between them, in any order.

    Returns: Each level once, from top to bottom.
    """
    if not isinstance(text, str) or len(text) > _LONGEST or not re.fullmatch(r"[ -~]+", text):
        raise UsageError("levels are a text like C1-L5, L4-L5 or C3-C7,T1-T5")
    chosen: list[int] = []
    for part in text.split(","):
        ends = [_parse_level(end, text) for end in part.split("-")]
        if len(ends) > 2:
            raise UsageError(f"levels {text!r}: {part.strip()!r} is no range; a range has two ends, like C3-C7")
        if ends[0] > ends[-1]:
            turned = f"{LEVELS[ends[-1]]}-{LEVELS[ends[0]]}"
            raise UsageError(f"levels {text!r}: {part.strip()!r} runs upwards; name the upper level first: {turned}")
        chosen += range(ends[0], ends[-1] + 1)
    twice = sorted({LEVELS[n] for n in chosen if chosen.count(n) > 1}, key=LEVELS.index)
    if twice:
        raise UsageError(f"levels {text!r} name {', '.join(twice)} more than once")
    return tuple(LEVELS[n] for n in sorted(chosen))


def format_levels(names: tuple[str, ...]) -> str:
    """Return levels as the shortest text that `parse_levels` reads: ``"C3-T5,L1"``."""
    numbers = [LEVELS.index(name) for name in names]
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][-1] + 1:
            parts[-1].append(number)
        else:
            parts.append([number])
    return ",".join(LEVELS[p[0]] if len(p) == 1 else f"{LEVELS[p[0]]}-{LEVELS[p[-1]]}" for p in parts)
