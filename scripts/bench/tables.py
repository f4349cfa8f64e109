"""Results as a markdown table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from results import Key

__all__ = ["format_results", "markdown"]


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Lay out a table with columns of even width."""
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(3, *(len(cell) for cell in column)) for column in zip(*cells, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in cells
    ]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])


def seconds(value: float) -> str:
    """Seconds with three significant digits, in ms below one second."""
    return f"{value:.3g} s" if value >= 1 else f"{1e3 * value:.3g} ms"


def _millions(count: Any) -> str:
    return "-" if count is None else f"{count / 1e6:.2f} M"


def format_results(results: dict[Key, dict[str, Any]]) -> str:
    """One row a ratio: medians of both sides, the median of the ratios and its quartiles."""
    rows = []
    for (name, given, device), result in sorted(results.items()):
        for ratio_name, ratio in result["ratios"].items():
            side = result.get("sides", {}).get(ratio_name)
            own, peer = (seconds(side[f"{who}_s"]["median"]) if side else "-" for who in ("clrecon", "peer"))
            spread = f"{ratio['q1']:.2f} to {ratio['q3']:.2f}"
            triangles = _millions(result.get("triangles"))
            rows.append((name, ratio_name, given, device, triangles, own, peer, f"{ratio['median']:.2f}", spread))
    head = ("case", "against", "input", "device", "triangles", "clrecon", "peer", "ratio", "quartiles")
    return markdown(head, rows)
