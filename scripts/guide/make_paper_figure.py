#!/usr/bin/env python3
"""Draw the figure of docs/paper.md from the figures of docs/benchmarks/levels/phantoms.json.

python scripts/guide/make_paper_figure.py
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "scripts" / "guide"), str(ROOT / "scripts" / "proof")]

from make_trust_page import BENCHMARKS, RULES, errors_of_rule  # noqa: E402

FIGURE = ROOT / "docs" / "images" / "paper-accuracy.png"
COLORS = {"fitted": "#1f5fa8", "auto": "#7fa8d0", "preset": "#b5651d"}


def group_errors() -> dict[str, dict[str, tuple[float, float]]]:
    """Return mean and worst distance from the true surface, in mm, by group of phantoms and rule."""
    phantoms: list[dict[str, Any]] = json.loads((BENCHMARKS / "levels" / "phantoms.json").read_text(encoding="utf-8"))
    groups: dict[str, list[dict[str, Any]]] = {}
    for phantom in phantoms:
        if "best" in phantom:
            groups.setdefault(phantom["group"], []).append(phantom)
    return {group: {rule: errors_of_rule(of_group, rule)[:2] for rule in RULES} for group, of_group in groups.items()}


def draw(path: Path) -> None:
    """Draw a bar for each group and rule, its whisker up to the worst phantom."""
    from matplotlib.figure import Figure

    errors = group_errors()
    figure = Figure(figsize=(8, 3.6), dpi=150, layout="constrained")
    axes = figure.subplots()
    for place, (rule, title) in enumerate(RULES.items()):
        rows = [row + 0.26 * (place - 1) for row in range(len(errors))]
        means, worst = zip(*(of_group[rule] for of_group in errors.values()), strict=True)
        axes.barh(rows, means, height=0.24, color=COLORS[rule], label=title.strip("`"))
        axes.hlines(rows, means, worst, color="black", linewidth=1)
    axes.set_yticks(range(len(errors)), list(errors))
    axes.invert_yaxis()
    axes.set_xlabel("mean distance from the true surface, mm (whisker: worst phantom)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="center right", bbox_to_anchor=(1.0, 0.53))
    figure.savefig(path, metadata={"Software": None})


if __name__ == "__main__":
    draw(FIGURE)
