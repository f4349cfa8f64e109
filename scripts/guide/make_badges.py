#!/usr/bin/env python3
"""Draw the badges of README.md, docs/images/badges.svg, from setup.cfg and the records in docs/benchmarks.

python scripts/guide/make_badges.py
"""

from __future__ import annotations

import json
import sys
from configparser import ConfigParser
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts" / "proof")]

from make_trust_page import CHECKS, MATRICES, count_wrong  # noqa: E402
from marked_tables import find_table  # noqa: E402

PICTURE = ROOT / "docs" / "images" / "badges.svg"
HEIGHT, GAP, PADDING, LETTER = 20, 6, 7, 5.9
GREY, GREEN = "#555", "#2f7d4f"


def facts() -> dict[str, str]:
    """Return what each badge says: its subject, and the fact."""
    setup = ConfigParser()
    setup.read(ROOT / "setup.cfg")
    versions = [
        line.rpartition(" ")[2]
        for line in setup["metadata"]["classifiers"].splitlines()
        if line.startswith("Programming Language :: Python :: 3.")
    ]
    calibration = (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
    counts = [count_wrong(find_table(calibration, name))["clrecon"] for name in list(MATRICES)[:2]]
    series, wrong = (sum(count[n] for count in counts) for n in (0, 1))
    kernels = json.loads(CHECKS.read_text(encoding="utf-8"))["kernels"]
    return {
        "Python": f"{versions[0]} to {versions[-1]}",
        "licence": setup["metadata"]["license"],
        "difficult series read wrongly": f"{wrong} of {series}",
        "kernel faults missed by the self-test": f"{kernels['missed']} of {kernels['tried']}",
    }


def draw_badges(said: dict[str, str]) -> str:
    """Return an SVG with the badges in a row."""
    left, parts = 0.0, []
    for subject, fact in said.items():
        for text, color in ((subject, GREY), (fact, GREEN)):
            width = LETTER * len(text) + 2 * PADDING
            parts.append(f'<rect x="{left:.1f}" width="{width:.1f}" height="{HEIGHT}" fill="{color}"/>')
            parts.append(
                f'<text x="{left + PADDING:.1f}" y="14" textLength="{width - 2 * PADDING:.1f}">{escape(text)}</text>'
            )
            left += width
        left += GAP
    size = f'width="{left - GAP:.0f}" height="{HEIGHT}"'
    style = 'fill="#fff" font-family="Verdana,DejaVu Sans,sans-serif" font-size="11"'
    return "\n".join([f'<svg xmlns="http://www.w3.org/2000/svg" {size}>', f"<g {style}>", *parts, "</g>", "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(draw_badges(facts()), encoding="utf-8")
