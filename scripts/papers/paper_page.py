"""docs/papers.md from the figures in docs/papers and the table of functions: nothing on the page is typed by hand."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from paper_claims import judge_claims
from paper_functions import PaperFunction, table_of_functions
from paper_sets import SETS

from clrecon.proof.compare.figures import CONTROLS, PAPER

__all__ = ["make_page"]

Report = Mapping[str, Any]

_OPENING = """# Both papers reproduced

clrecon implements two papers on the reconstruction of vertebrae. **Paper A** is "CPU-GPU Rendering of CT Scan Images
for Vertebra Reconstruction from CT Scan Images with a Calibration Policy". **Paper B** is Liu et al., "Vertebrae CT
Images 3D Reconstruction with Improve Marching Cubes Algorithm", J. Harbin Inst. Technol. (New Series) 26(6): 69-79,
2019, DOI 10.11916/j.issn.1005-9113.18042. This page makes their tables again with clrecon, says of each claim what came
of it, and lists where each of their functions is. It is written by a script, from the reports of `clrecon compare`
(`docs/papers/*.json`):

    python3 scripts/papers/papers.py run --work FOLDER --paper-a CT_FOLDER
    python3 scripts/papers/papers.py page

The series of paper B are synthetic spines of its sizes, `clrecon phantom --levels`; that of paper A has its size. The
papers' own scans are not public. [compare.md](compare.md) and [measures.md](measures.md) define the measures."""

_SLICES = """## Sub-voxel slices

Two surfaces can pass through the same cells and be far apart. clrecon therefore also compares mesh and scan on a
lattice that is three times finer than the voxels and does not coincide with their planes. On the lattice of the
voxels every surface with one vertex on each crossed edge looks perfect; the error of paper B's golden constant is
visible only on the finer lattice."""

_TIMES = """## Paper B, time

Paper B, Tables 2 and 3. Its times are pictures in the print and do not survive as numbers, so only ours stand here:
seconds from voxels in memory to the mesh in memory, of the first call in a new process and of later ones (median).
"Visited" are the cells that growing looks at, of all cells."""

_ACCURACY = """## Paper B, accuracy

Paper B, Table 1 and Fig. 9, calls accuracy the share of "characteristic voxels" that a method repeats. That is the
recall of the cells that T-MC passes through. Beside it stands what it does not see: the distance of each surface from
the true one, its mean (bias, which belongs to the level) and its scatter (which belongs to the method)."""

_SSIM = """## Paper A, SSIM

Paper A compares a picture of the reconstruction with a slice, by SSIM and MSE. Pictures and slice are of one size and
in one place here (window -200 to 800 HU), which the paper does not say of its own. The controls are no
reconstructions."""


def make_page(reports: Mapping[str, Report], growing: Mapping[str, Any] | None, rows: Sequence[PaperFunction]) -> str:
    """Return the text of docs/papers.md.

    Parameters
    ----------
    reports : mapping
        By name of the set, what `paper_sets.keep_figures` keeps.
    growing : mapping or None
        Cells visited from seeds in some of the vertebrae of one series.
    rows : sequence of PaperFunction
    """
    parts = [_OPENING, *_machine(reports), _SLICES, *_slices(reports), *_table_1(reports), _SSIM, *_ssim(reports["a"])]
    parts += [_ACCURACY, *_accuracy(reports["b149"]), _TIMES, *_times(reports, growing)]
    parts += ["## Claims", *judge_claims(reports, growing)]
    parts += [
        "## Functions",
        "The table lists every function in the papers. The last column names the pages with figures.",
    ]
    parts += ["\n".join(table_of_functions(rows))]
    return "\n\n".join(part if part.startswith(("|", "#")) else _wrap(part) for part in parts) + "\n"


def _wrap(paragraph: str) -> str:
    """Break what is longer than a line; texts that are broken already stay."""
    return paragraph if "\n" in paragraph else textwrap.fill(paragraph, 120, break_on_hyphens=False)


def _machine(reports: Mapping[str, Report]) -> list[str]:
    one = next(iter(reports.values()))
    days = sorted({report["date"] for report in reports.values()})
    devices = sorted({f"{report['device']} ({report['driver']})" for report in reports.values()})
    free = [report["free_cores"] for report in reports.values()]
    return [
        f"Measured on {' and '.join(dict.fromkeys((days[0], days[-1])))} with clrecon {one['version']}: "
        f"{one['processor']}, {one['cores']} cores of which {min(free):.1f} to {max(free):.1f} were free, device "
        f"{', '.join(devices)}."
    ]


def _done(report: Report) -> list[Mapping[str, Any]]:
    return [row for row in report["methods"] if row["state"] == "done"]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _number(value: float | None, form: str = ".3g") -> str:
    return "" if value is None else format(value, form)


def _of(row: Mapping[str, Any], *names: str) -> Any:
    """Return an entry of an entry, None where one is missing."""
    value: Any = row
    for name in names:
        value = None if value is None else value.get(name)
    return value


def _slices(reports: Mapping[str, Report]) -> list[str]:
    tables = []
    for name in ("a", "b149"):
        report = reports[name]
        rows = [
            (
                row["title"], _number(row["triangles"], ","), _number(_of(row, "slices", "voxel_dice"), ".4f"),
                _number(_of(row, "slices", "dice"), ".4f"), _number(_of(row, "surfaces", "hd95_mm"), ".3f"),
            )
            for row in _done(report) if row["slices"]
        ]  # fmt: skip
        tables += [
            f"{SETS[name].what}, {report['iso_value_hu']:g} HU:",
            _table(("method", "triangles", "Dice, lattice of voxels", "Dice, finer lattice", "HD95 to T-MC, mm"), rows),
        ]
    return tables


def _table_1(reports: Mapping[str, Report]) -> list[str]:
    report = reports["a"]
    ours = {row["name"]: row for row in _done(report)}
    rows = []
    for name, theirs in PAPER.items():
        row = ours.get(name)
        small = _of(row or {}, "small", "scaled_s")
        rows.append(
            (
                str(theirs["method"]), *(_number(_of(theirs, entry)) for entry in ("seconds", "later_s")),
                "" if row is None else row["title"], _number(_of(row or {}, "first_s")),
                _number(_of(row or {}, "warm_s")) or ("" if small is None else f"{small:.3g} (reckoned)"),
            )
        )  # fmt: skip
    others = [
        ("", "", "", row["title"], _number(row["first_s"]), _number(row["warm_s"]))
        for name, row in ours.items()
        if name not in PAPER
    ]
    read = report["read_s"]
    head = ("paper's row", "paper, s", "later, s", "here", "first, s", "later, s")
    return [
        "## Paper A, Table 1",
        "Seconds; 512 x 512 x 95 voxels as in the paper, which measured on a Core i5 and a GTX 1050. Reading the series"
        f" takes {read['first']:.2f} s at first and {read['warm']:.2f} s later and is not in the columns.",
        _table(head, [*rows, *others]),
    ]


_SSIM_OF_PAPER = {"skimage": (0.38, None), "vtk-mc": (0.43, 27246.72), "rays": (0.42, 28613.56), "cloud": (0.56, None)}
"""SSIM and MSE that paper A prints, by our name of the method."""


def _ssim(report: Report) -> list[str]:
    found = report["paper"]
    titles = {row["name"]: row["title"] for row in report["methods"]}
    rows = []
    for name, values in found["methods"].items():
        ssim, mse = _SSIM_OF_PAPER.get(name, (None, None))
        rows.append((titles[name], _number(ssim, ".2f"), _number(mse, ",.0f"), *_pair(values)))
    rows += [(f"*control: {CONTROLS[name]}*", "", "", *_pair(values)) for name, values in found["controls"].items()]
    return [_table(("picture", "paper, SSIM", "paper, MSE", "SSIM here", "MSE here"), rows)]


def _pair(values: Mapping[str, float]) -> tuple[str, str]:
    return _number(values["ssim"], ".3f"), _number(values["mse"], ",.0f")


def _accuracy(report: Report) -> list[str]:
    rows = [
        (
            row["title"], *(_number(_of(row, "cells", name), ".3f") for name in ("recall", "precision", "dice")),
            _number(_of(row, "truth", "bias_mm"), "+.3f"), _number(_of(row, "truth", "scatter_mm"), ".3f"),
        )
        for row in _done(report) if row["cells"]
    ]  # fmt: skip
    head = ("method", "recall of cells", "precision", "Dice", "bias, mm", "scatter, mm")
    return [f"{SETS['b149'].what}, {report['iso_value_hu']:g} HU:", _table(head, rows)]


_TIMED = ("t-mc", "g-mc", "s-mc", "i-mc", "i-mc-golden")


def _times(reports: Mapping[str, Report], growing: Mapping[str, Any] | None) -> list[str]:
    head = ("series", "vertebrae", "", "T-MC", "G-MC", "S-MC", "I-MC", "I-MC, golden", "visited, 1 in")
    tables = []
    for names in (("b54", "b149", "b559"), ("v2", "v3", "v4", "v5", "v12", "b559")):
        rows = []
        for name in names:
            found = {row["name"]: row for row in _done(reports[name])}
            visited, cells = (_of(found.get("i-mc", {}), entry) for entry in ("cells_visited", "cells_all"))
            for kind, label in (("first_s", "first"), ("warm_s", "later")):
                times = [_number(_of(found.get(method, {}), kind)) for method in _TIMED]
                share = f"{cells / visited:.0f}" if kind == "first_s" and visited else ""
                beginning = (SETS[name].what, str(SETS[name].vertebrae)) if kind == "first_s" else ("", "")
                rows.append((*beginning, label, *times, share))
        tables.append(_table(head, rows))
    if growing is not None:
        rows = [
            (str(each["vertebrae"]), f"{each['cells_visited']:,}", f"{each['cells_all'] / each['cells_visited']:.0f}",
             f"{each['warm_s'] / growing['whole_s']:.2f}")
            for each in growing["rows"]
        ]  # fmt: skip
        tables += [
            f"Seeds in some vertebrae of {SETS['b559'].what}; time beside that of T-MC of the whole, from a volume on "
            "the device:",
            _table(("seeds in vertebrae", "cells visited", "of all cells, 1 in", "time / T-MC"), rows),
        ]
    return tables
