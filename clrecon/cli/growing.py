"""Options for the methods of marching cubes, and the description of what was visited."""

from __future__ import annotations

import argparse
from typing import Any

from clrecon.cli.points import parse_point
from clrecon.system.text import count_of

METHOD_NAMES = ("t-mc", "i-mc", "g-mc", "s-mc", "t-mc-soup", "skimage")


def add_methods(parser: argparse.ArgumentParser) -> None:
    """Add --method, --grow-from and --vertex-rule."""
    group = parser.add_argument_group("method", "marching cubes as papers compare them: see docs/methods.md")
    group.add_argument(
        "--method",
        type=str.lower,
        metavar="|".join(METHOD_NAMES),
        help="t-mc: every cell (default); i-mc: only what hangs together with seeds; g-mc: t-mc, then quadric collapse"
        " without a bound; s-mc: t-mc, then decimation within a bound; t-mc-soup, skimage: on the CPU, to compare with",
    )
    group.add_argument(
        "--grow-from",
        type=_parse_seed,
        action="append",
        default=[],
        metavar="auto|X,Y,Z|label:NAME",
        help="seeds of i-mc: auto takes the parts with at least 1/20 of the cells of the largest; a point in mm of the"
        " frame of --space, at most 10 mm from the surface; a label of --labels. May be given again",
    )
    group.add_argument(
        "--vertex-rule",
        type=str.lower,
        metavar="linear|golden|golden-search",
        help="where on an edge a vertex lies: linear (default); golden: at 0.618 whatever the HU, up to 0.6 voxels off;"
        " golden-search: where a cubic crosses the iso value, no better than linear",
    )


def _parse_seed(text: str) -> str | tuple[float, ...]:
    """Read ``auto``, ``label:NAME`` or ``X,Y,Z``."""
    if text.lower() == "auto":
        return "auto"
    if text.lower().startswith("label:"):
        return f"label:{text[6:]}"
    try:
        return parse_point(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is neither auto nor X,Y,Z in mm nor label:NAME") from error


def describe_cells(report: dict[str, Any]) -> list[str]:
    """Describe the cells that each grown surface visited, and what was left out; no line for whole ones."""
    lines: list[str] = []
    for mesh in report["meshes"]:
        cells, growing = mesh["cells"], mesh["growing"]
        if not growing:
            continue
        share = cells["all"] / max(cells["visited"], 1)
        told = [
            f"cells    {cells['visited']:,} visited, {cells['active']:,} active, {cells['all']:,} in all (1 in"
            f" {share:,.0f} visited)",
            f"grown    from {', '.join(growing['from'])}: {growing['components_taken']:,} of"
            f" {count_of(growing['components'], 'part')};"
            f" {100 * growing['cells_left_out_share']:.1f} % of the active cells left"
            f" out, the largest part of them {growing['largest_left_out_cells']:,}",
        ]
        lines += [line for line in told if line not in lines]
    return lines
