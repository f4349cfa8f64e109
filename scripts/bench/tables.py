"""Results as a markdown table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from results import Key


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Lay out a table with columns of even width."""
    cells = [[str(cell) for cell in row] for row in (head, *rows)]
    widths = [max(3, *(len(cell) for cell in column)) for column in zip(*cells, strict=True)]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in cells
    ]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])


def seconds(value: float) -> str:
    """Write seconds with three significant digits, in ms below one second."""
    return f"{value:.3g} s" if value >= 1 else f"{1e3 * value:.3g} ms"


def _millions(count: Any) -> str:
    return "-" if count is None else f"{count / 1e6:.2f} M"


def _both_sides(result: dict[str, Any], ratio: str) -> tuple[str, str]:
    """Write the figures of clrecon and the peer in the unit of the ratio: seconds, bytes per voxel, or linearity."""
    side = result.get("sides", {}).get(ratio)
    if side:
        return seconds(side["clrecon_s"]["median"]), seconds(side["peer_s"]["median"])
    scratch = result.get("resident_scratch_bytes_a_voxel")
    if ratio == "scratch" and scratch:
        return f"{scratch['clrecon']['median']:.2f} B/voxel", f"{scratch['peer']['median']:.2f} B/voxel"
    fit = result.get("fits", {}).get({"over_sizes": "voxels", "over_levels": "triangles"}.get(ratio))
    if fit:
        return f"R2 {fit['clrecon']['r2']:.3f}", f"R2 {fit['peer']['r2']:.3f}"
    return "-", "-"


def format_results(results: dict[Key, dict[str, Any]]) -> str:
    """Make a table with a row per ratio: medians of both sides, the median of the ratios and its quartiles."""
    rows = []
    for (name, given, device), result in sorted(results.items()):
        for ratio_name, ratio in result["ratios"].items():
            own, peer = _both_sides(result, ratio_name)
            spread = f"{ratio['q1']:.2f} to {ratio['q3']:.2f}"
            triangles = _millions(result.get("triangles"))
            rows.append((name, ratio_name, given, device, triangles, own, peer, f"{ratio['median']:.2f}", spread))
    head = ("case", "against", "input", "device", "triangles", "clrecon", "peer", "ratio", "quartiles")
    return markdown(head, rows)
