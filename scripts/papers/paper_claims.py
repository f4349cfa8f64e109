"""What the papers claim, and what came of it here: each verdict is made from the figures."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import median
from typing import Any

Report = Mapping[str, Any]

CLEAR = 1.1
"""A ratio of times below this is no difference."""

ACCURACY_OF_PAPER = 0.955
VISITED_OF_PAPER = 400
FIRST_OF_A, LATER_OF_A = 300.0, 2.0


def _rows(report: Report) -> dict[str, Mapping[str, Any]]:
    return {row["name"]: row for row in report["methods"] if row["state"] == "done"}


def judge_claims(reports: Mapping[str, Report], growing: Mapping[str, Any] | None) -> list[str]:
    """Return a paragraph for each claim: the claim, the verdict, the figures."""
    return [
        _faster(reports),
        _golden_time(reports),
        _accuracy(reports["b149"]),
        _visited(reports, growing),
        _ssim(reports["a"]),
        _latency(reports["a"]),
    ]


def _claim(text: str, verdict: str, figures: str) -> str:
    return f"**{text}** {verdict} {figures}"


def _ratios(reports: Mapping[str, Report], slower: str, faster: str) -> list[float]:
    found = [_rows(reports[name]) for name in ("b54", "b149", "b559")]
    return [rows[slower]["warm_s"] / rows[faster]["warm_s"] for rows in found if slower in rows and faster in rows]


def _faster(reports: Mapping[str, Report]) -> str:
    ratios = _ratios(reports, "t-mc", "i-mc")
    welded = _rows(reports["b149"])
    soup = welded["t-mc-soup"]["warm_s"] / welded["i-mc"]["warm_s"]
    if not ratios or min(ratios) >= CLEAR:
        verdict = "Holds here."
    elif max(ratios) < CLEAR:
        verdict = "Does not hold on a device that processes all cells in parallel."
    else:
        verdict = "Holds on some series."
    each = ", ".join(f"{ratio:.2f}" for ratio in ratios)
    return _claim(
        "I-MC is faster than T-MC.",
        verdict,
        f"In later calls T-MC takes {each} times as long as I-MC on the phantoms of 54, 149 and 559 slices, "
        "respectively. T-MC of the paper welds its triangles afterwards, as T-MC, soup does in NumPy: that takes "
        f"{soup:.0f} times as long as I-MC on the phantom of 149 slices. So the gain of I-MC in the paper comes from "
        "shared vertices, which T-MC here has too, and not from growing.",
    )


def _golden_time(reports: Mapping[str, Report]) -> str:
    ratios = _ratios(reports, "i-mc", "i-mc-golden")
    rows = _rows(reports["b149"])
    linear, golden = rows["i-mc"]["truth"]["scatter_mm"], rows["i-mc-golden"]["truth"]["scatter_mm"]
    if not ratios or median(ratios) < CLEAR:
        verdict = "Does not hold."
    else:
        verdict = "Holds here." if min(ratios) >= CLEAR else "Holds on some series."
    each = ", ".join(f"{ratio:.2f}" for ratio in ratios)
    return _claim(
        "The golden section is faster than linear interpolation.",
        verdict,
        f"In later calls I-MC with linear interpolation takes {each} times as long as with the golden section, on the "
        "phantoms of 54, 149 and 559 slices, respectively. The golden section is less accurate: the scatter of the "
        f"surface is {golden:.3f} mm instead of {linear:.3f} mm on the phantom of 149 slices.",
    )


def _accuracy(report: Report) -> str:
    rows = _rows(report)
    found = {
        name: rows[name]["cells"]["recall"] for name in ("g-mc", "s-mc", "i-mc") if rows.get(name, {}).get("cells")
    }
    golden = rows["i-mc-golden"]
    above = [name for name, recall in found.items() if recall >= ACCURACY_OF_PAPER]
    verdict = "Holds for " + ", ".join(rows[name]["title"] for name in above) + "." if above else "Does not hold here."
    each = ", ".join(f"{recall:.2%} for {rows[name]['title']}" for name, recall in found.items())
    return _claim(
        f"Accuracy above {ACCURACY_OF_PAPER:.1%}.",
        verdict,
        f"On the phantom of 149 slices the recall of the cells of T-MC is {each}. I-MC leaves out the components "
        "without a seed; in the others it passes through the same cells as T-MC. So does I-MC with vertices at the "
        f"golden section (precision {golden['cells']['precision']:.1%}), because recall does not show where in a cell "
        "the surface lies.",
    )


def _visited(reports: Mapping[str, Report], growing: Mapping[str, Any] | None) -> str:
    shares = []
    for name in ("b54", "b149", "b559"):
        row = _rows(reports[name]).get("i-mc")
        if row and row["cells_visited"]:
            shares.append(row["cells_all"] / row["cells_visited"])
    verdict = "Holds." if shares and min(shares) >= VISITED_OF_PAPER else "Depends on the grown region."
    each = ", ".join(f"one cell in {share:.0f}" for share in shares)
    figures = f"With automatic seeds, I-MC visits {each} on the phantoms of 54, 149 and 559 slices, respectively."
    if growing is not None:
        few = growing["rows"][0]
        share = few["cells_all"] / few["cells_visited"]
        figures += (
            f" On the last phantom, with seeds in {few['vertebrae']} of 17 vertebrae, I-MC visits one cell in"
            f" {share:.0f}. So the number depends on the grown region, not on the method."
        )
    return _claim(f"About {VISITED_OF_PAPER} times fewer voxels visited.", verdict, figures)


def _ssim(report: Report) -> str:
    found = report["paper"]
    black = found["controls"]["black"]["ssim"]
    best = max(found["methods"].values(), key=lambda each: each["ssim"])["ssim"]
    verdict = (
        "SSIM says nothing about the quality of a method here."
        if black >= best - 0.05
        else "A black picture scores less here."
    )
    return _claim(
        "SSIM of 0.56 shows the better reconstruction.",
        verdict,
        f"The SSIM is {black:.2f} for a black picture, at most {best:.2f} for the methods here, and "
        f"{found['controls']['next']['ssim']:.2f} for the next slice of the same scan.",
    )


def _latency(report: Report) -> str:
    rows = _rows(report)
    return _claim(
        f"Marching cubes take {FIRST_OF_A:g} s on a CPU and {LATER_OF_A:g} s on a GPU.",
        "No longer holds.",
        f"scikit-image takes {rows['skimage']['warm_s']:.2f} s on the CPU. clrecon takes "
        f"{rows['t-mc']['first_s']:.2f} s in the first run and {rows['t-mc']['warm_s']:.2f} s in later runs, on the "
        "device named above.",
    )
