"""The text of a transfer function in clrecon's own form, JSON; docs/transfer_functions.md describes it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

FORMAT = "clrecon transfer function"
VERSION = 1


def transfer_text(
    head: Mapping[str, Any], points: Sequence[Sequence[float]], gradient_opacity: Sequence[Sequence[float]] | None
) -> str:
    """Return a transfer function as text; reading it gives the same function, bit for bit.

    head: Name, description, unit distance and lighting, by the names of the format.
    points: sequence of (hu, red, green, blue, opacity)
    gradient_opacity: sequence of (HU per mm, factor), or None
    """
    first = {"format": FORMAT, "version": VERSION, **head}
    fields = [f'  "{key}": {json.dumps(value)}' for key, value in first.items()]
    fields.append(_rows("points", [{"hu": row[0], "color": row[1:4], "opacity": row[4]} for row in points]))
    if gradient_opacity is not None:
        rows = [{"hu_per_mm": place, "factor": factor} for place, factor in gradient_opacity]
        fields.append(_rows("gradient_opacity", rows))
    return "{\n" + ",\n".join(fields) + "\n}\n"


def _rows(name: str, rows: Sequence[Mapping[str, Any]]) -> str:
    return f'  "{name}": [\n' + ",\n".join(f"    {json.dumps(row)}" for row in rows) + "\n  ]"
