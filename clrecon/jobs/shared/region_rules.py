"""Region rules: the texts by which a job is told which part of a scan is of interest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from clrecon.errors import UsageError

REGION_FORMS = "box:X0,X1,Y0,Y1,Z0,Z1, hu:LO,HI, label:FILE:NAME, mask:FILE, seed:X,Y,Z, tube:MM and tube:MM:FILE"
"""The forms of a region rule, for messages and help."""

_COUNTS = {"box": 6, "hu": 2, "seed": 3, "tube": 1}


@dataclass(frozen=True)
class RegionRule:
    """One rule.

    kind: {"box", "hu", "label", "mask", "seed", "tube"}
    numbers: Of a box (x0, x1, y0, y1, z0, z1), infinite where a side is open; of HU the lowest and the highest; of a
        seed a point; of a tube its radius.  Lengths are mm.
    path: Label map, or file of a centre line; a tube without one goes along the spinal canal.
    name: Label in the map.
    """

    kind: str
    numbers: tuple[float, ...] = ()
    path: str | None = None
    name: str | None = None

    def __str__(self) -> str:
        """Describe the rule in its own form; a file by its name alone."""
        from clrecon.system.text import escape_text

        numbers = ",".join("" if math.isinf(number) else f"{number:g}" for number in self.numbers)
        file = None if self.path is None else escape_text(self.path.replace("\\", "/").rsplit("/", 1)[-1])
        return ":".join(part for part in (self.kind, numbers, file, self.name) if part)


def parse_region_rules(rules: str | Sequence[str]) -> tuple[RegionRule, ...]:
    """Read region rules.

    rules: ``box:X0,X1,Y0,Y1,Z0,Z1`` in mm, where an empty side is open; ``hu:LO,HI``, both ends included;
        ``label:FILE:NAME``, a label of a label map by name or number; ``mask:FILE``, all labels of a label map;
        ``seed:X,Y,Z``, what is joined to this point; ``tube:MM``, what lies so near to the middle of the spinal canal,
        or with ``tube:MM:FILE`` to another centre line.
    """
    parsed = tuple(_parse(str(rule).strip()) for rule in ([rules] if isinstance(rules, str) else rules))
    kinds = {rule.kind for rule in parsed}
    if "seed" in kinds and not kinds & {"hu", "label", "mask"}:
        raise UsageError(
            "a region's seed grows within HU or labels: give a rule hu:LO,HI, label:FILE:NAME or mask:FILE too"
        )
    return parsed


def _parse(rule: str) -> RegionRule:
    kind, _, rest = rule.partition(":")
    kind = kind.lower()
    numbers: tuple[float, ...] | None = ()
    path = name = ""
    if kind == "label":
        path, _, name = rest.rpartition(":")
        is_known = bool(path and name.strip())
    elif kind == "mask":
        path = rest
        is_known = bool(path)
    else:
        words, _, path = rest.partition(":") if kind == "tube" else (rest, "", "")
        numbers = _numbers(words, ends=kind in ("box", "hu"))
        is_known = numbers is not None and len(numbers) == _COUNTS.get(kind)
    if numbers is None or not is_known:
        raise UsageError(f"the region rule {rule!r:.200} is not known: the rules are {REGION_FORMS}")
    _check(rule, kind, numbers)
    return RegionRule(kind, numbers, path or None, name.strip() or None)


def _numbers(text: str, *, ends: bool) -> tuple[float, ...] | None:
    """Read numbers between commas, None where one is none.  With `ends` an empty one is an open side: an infinite
    number, downward and upward in turns.
    """
    words = [word.strip() for word in text.split(",")]
    try:
        return tuple(
            math.copysign(math.inf, place % 2 - 0.5) if ends and not word else float(word)
            for place, word in enumerate(words)
        )
    except ValueError:
        return None


def _check(rule: str, kind: str, numbers: tuple[float, ...]) -> None:
    """Refuse numbers that no region can have."""
    has_ends = kind in ("box", "hu")
    if any(math.isnan(number) or (math.isinf(number) and not has_ends) for number in numbers):
        raise UsageError(f"the region rule {rule!r:.200} needs finite numbers")
    for low, high in zip(numbers[::2], numbers[1::2], strict=True) if has_ends else ():
        if low > high or (kind == "box" and low == high):
            raise UsageError(
                f"the region rule {rule!r:.200} holds nothing: give the lower end first, {high:g} is not above {low:g}"
            )
    if kind == "tube" and not numbers[0] > 0.0:
        raise UsageError(f"the radius of a tube is a length in mm above 0, not {numbers[0]:g} ({rule!r:.200})")
