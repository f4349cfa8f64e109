"""Plots of results as PNG: bars of all ratios, and curves of time over size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from results import Key

OWN, PEER, GOOD, BAD = "#1f5fa8", "#b5651d", "#1f5fa8", "#b03030"
_UNITS = {"voxels": (1e-6, "million voxels"), "triangles": (1e-6, "million triangles")}


def plot_ratios(results: dict[Key, dict[str, Any]], path: Path) -> int:
    """Draw one bar per ratio with its quartiles, grouped by case; returns the number of bars."""
    from matplotlib.figure import Figure

    bars: list[tuple[str, dict[str, float]]] = []
    for (name, given, device), result in sorted(results.items(), reverse=True):
        for ratio_name, ratio in reversed(result["ratios"].items()):
            bars.append((f"{name}, {ratio_name.replace('_', ' ')}\n{given}, {device}", ratio))
    if not bars:
        raise ValueError("there are no ratios to draw")
    figure = Figure(figsize=(9, 1.2 + 0.48 * len(bars)), dpi=110, layout="constrained")
    axes = figure.subplots()
    for place, (_, ratio) in enumerate(bars):
        middle = ratio["median"]
        axes.barh(place, middle - 1.0, left=1.0, height=0.62, color=GOOD if middle >= 1 else BAD, alpha=0.85)
        axes.plot([ratio["q1"], ratio["q3"]], [place, place], color="black", linewidth=2.2, solid_capstyle="butt")
        axes.text(max(1.0, middle, ratio["q3"]), place, f"  {middle:.2f}", va="center", fontsize=8)
    axes.set_yticks(range(len(bars)), [label for label, _ in bars], fontsize=7)
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set_xscale("log", base=2)  # twice as fast and half as fast are equally long bars
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.set_xlim(
        0.8 * min(0.9, *(ratio["q1"] for _, ratio in bars), *(ratio["median"] for _, ratio in bars)),
        1.3 * max(1.5, *(ratio["q3"] for _, ratio in bars), *(ratio["median"] for _, ratio in bars)),
    )
    axes.set_ylim(-0.6, len(bars) - 0.4)
    axes.set_xlabel("peer / clrecon, median of pairs; black: quartiles; above 1 clrecon is better")
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path)
    return len(bars)


def plot_scaling(result: dict[str, Any], path: Path) -> None:
    """Draw time over voxels and over triangles with the fitted lines of a `scaling` result."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), dpi=110, layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, over, points in zip(panels, ("voxels", "triangles"), (result["sizes"], result["levels"]), strict=True):
        scale, unit = _UNITS[over]
        x = [scale * point[over] for point in points]
        for side, colour, name in (("clrecon", OWN, "clrecon"), ("peer", PEER, "vtkFlyingEdges3D")):
            middle = [1e3 * point[f"{side}_s"]["median"] for point in points]
            low = [1e3 * point[f"{side}_s"]["q1"] for point in points]
            high = [1e3 * point[f"{side}_s"]["q3"] for point in points]
            axes.vlines(x, low, high, color=colour, linewidth=2)
            fit = result["fits"].get(over, {}).get(side)
            label = name
            if fit:
                ends = [min(x), max(x)]
                axes.plot(ends, [1e3 * (fit["intercept"] + fit["slope"] * end / scale) for end in ends], color=colour)
                label += f", line: R² = {fit['r2']:.4f}"
            axes.plot(x, middle, "o", color=colour, label=label)
        axes.set_xlabel(unit)
        axes.set_ylabel("ms, median and quartiles")
        axes.set_xlim(left=0)
        axes.set_ylim(bottom=0)
        axes.legend(fontsize=8, frameon=False, loc="upper left")
        axes.spines[["top", "right"]].set_visible(False)
    slices = [point["slices"] for point in result["sizes"]]
    panels[0].set_title(f"{min(slices)} to {max(slices)} slices at {result['parameters']['hu']:g} HU", fontsize=9)
    hus = [point["hu"] for point in result["levels"]]
    panels[1].set_title(f"{len(hus)} iso values from {max(hus):g} to {min(hus):g} HU", fontsize=9)
    threads = result["parameters"]["peer_threads"]
    figure.suptitle(f"{result['input']['name']}, {result['device']['name']}; peer on {threads} threads", fontsize=9)
    figure.savefig(path)
