"""docs/papers.md from the figures in docs/papers and the table of functions: nothing on the page is typed by hand."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from paper_claims import judge_claims
from paper_functions import PaperFunction, table_of_functions
from paper_sets import SETS

from clrecon.proof.compare.figures import CONTROLS, PAPER

Report = Mapping[str, Any]

_OPENING = """# Both papers reproduced

clrecon implements the methods of two papers on the reconstruction of vertebrae:

- **Paper A** is Khan et al., "CPU-GPU Rendering of CT Scan Images for Vertebra Reconstruction from CT Scan Images with
  a Calibration Policy", Medical Imaging and Radiation Sciences, 2020, DOI 10.31487/j.MIRS.2020.01.02.
- **Paper B** is Liu et al., "Vertebrae CT Images 3D Reconstruction with Improve Marching Cubes Algorithm", J. Harbin
  Inst. Technol. (New Series) 26(6): 69-79, 2019, DOI 10.11916/j.issn.1005-9113.18042.

This page repeats the measurements of both papers with clrecon, gives a verdict on each of their claims, and lists the
command and the Python name of each of their functions. A script writes the page from the reports of `clrecon compare`
(`docs/papers/*.json`):

    python3 scripts/papers/papers.py run --work FOLDER --paper-a CT_FOLDER
    python3 scripts/papers/papers.py page

The scans of the papers are not public. Paper B is repeated on synthetic spines (`clrecon phantom --levels`) with the
paper's numbers of slices and vertebrae. Paper A is repeated on a chest CT with as many voxels as the paper's scan.
[measures.md](measures.md) defines the measures, and [compare.md](compare.md) describes all methods. The main methods
are:

| name | method |
|---|---|
| T-MC | marching cubes over every cell; neighbouring cells share their vertices |
| T-MC, soup | T-MC in NumPy, with separate triangles in every cell that are welded afterwards |
| VTK MC, VTK FE | vtkMarchingCubes and vtkFlyingEdges3D |
| I-MC | marching cubes only in cells that are connected to seed points; here with automatic seeds |
| I-MC, golden | I-MC with each vertex at the golden section of its edge |
| G-MC | T-MC, then decimation by quadric error, without an error bound |
| S-MC | T-MC, then decimation within an error bound; the topology is preserved |"""

_SLICES = """## Sub-voxel slices

Two surfaces can pass through the same cells and still be far apart. clrecon therefore compares the inside of a mesh
with the inside of the trilinear iso surface of the scan on two lattices of points: the voxels, and a lattice that is
three times finer and avoids the planes of the voxels. On the voxels, every surface with one vertex on each crossed edge
has a Dice coefficient of 1. Only the finer lattice shows the error of paper B's golden section, which places each
vertex at 0.618 of its edge. HD95 is the 95th percentile of the distances to the surface of T-MC. It is large for I-MC
on the chest CT, because I-MC leaves out components without seeds."""

_TIMES = """## Paper B, time

Paper B gives its times in Tables 2 and 3, as images without legible numbers. So the tables here have only clrecon's
times, in seconds, from the voxels in memory to the mesh in memory. "First" is the first call in a new process, "later"
is the median of later calls. The last column is the number of cells of the volume, divided by the number of cells that
I-MC visits with automatic seeds."""

_ACCURACY = """## Paper B, accuracy

Table 1 and Fig. 9 of paper B define accuracy as the share of "characteristic voxels" that a method repeats. This is the
recall of the cells that T-MC passes through. Recall does not show where in a cell the surface lies. The table therefore
also has the mean signed distance from the true surface (bias) and its standard deviation (scatter). Bias depends on the
iso value, scatter on the method."""

_SSIM = """## Paper A, SSIM

Paper A compares a picture of the reconstruction with a slice by similarity (SSIM) and mean squared error of the grey
values (MSE). The paper does not say how its pictures were aligned with the slice. Here, pictures and slice have the
same size and position, and a window of -200 to 800 HU. The last five rows are controls, which no method made."""


def make_page(reports: Mapping[str, Report], growing: Mapping[str, Any] | None, rows: Sequence[PaperFunction]) -> str:
    """Return the text of docs/papers.md.

    reports: By name of the set, what `paper_sets.keep_figures` keeps.
    growing: Cells visited from seeds in some of the vertebrae of one series.
    """
    parts = [_OPENING, *_machine(reports), _SLICES, *_slices(reports), *_table_1(reports), _SSIM, *_ssim(reports["a"])]
    parts += [_ACCURACY, *_accuracy(reports["b149"]), _TIMES, *_times(reports, growing)]
    parts += ["## Claims", *judge_claims(reports, growing)]
    parts += [
        "## Functions",
        "The table lists the functions of both papers. The last column links to the page with figures for each.",
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
        f"The figures were measured on {' and '.join(dict.fromkeys((days[0], days[-1])))} with clrecon "
        f"{one['version']} on an {one['processor']} with {one['cores']} cores, of which {min(free):.1f} to "
        f"{min(max(free), one['cores']):.1f} were free. The OpenCL device was {', '.join(devices)}."
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


_BEFORE = {"a": "Chest CT of", "b149": "Spine phantom of"}


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
            f"{_BEFORE[name]} {SETS[name].what}, iso value {report['iso_value_hu']:g} HU:",
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
                _number(_of(row or {}, "warm_s")) or ("" if small is None else f"{small:.3g} (extrapolated)"),
            )
        )  # fmt: skip
    others = [
        ("", "", "", row["title"], _number(row["first_s"]), _number(row["warm_s"]))
        for name, row in ours.items()
        if name not in PAPER
    ]
    read = report["read_s"]
    head = ("row of the paper", "paper, first run, s", "paper, later, s", "method here", "first run, s", "later, s")
    return [
        "## Paper A, Table 1",
        "The scan has 512 x 512 x 95 voxels, as in the paper. The paper used a Core i5 and a GTX 1050. Reading the "
        f"series takes {read['first']:.2f} s in the first run and {read['warm']:.2f} s later, "
        "which the table does not include.",
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
    head = ("method", "recall of cells", "precision of cells", "Dice of cells", "bias, mm", "scatter, mm")
    return [f"{_BEFORE['b149']} {SETS['b149'].what}, iso value {report['iso_value_hu']:g} HU:", _table(head, rows)]


_TIMED = ("t-mc", "g-mc", "s-mc", "i-mc", "i-mc-golden")


def _times(reports: Mapping[str, Report], growing: Mapping[str, Any] | None) -> list[str]:
    head = ("series", "vertebrae", "", "T-MC", "G-MC", "S-MC", "I-MC", "I-MC, golden", "cells / cells visited")
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
            "The next table is for I-MC with one seed on the outer surface of each of 1 to 17 vertebrae of the phantom "
            f"of {SETS['b559'].what}. T-MC makes the whole surface. Both start from a volume on the device:",
            _table(
                ("vertebrae with seeds", "cells visited", "cells / cells visited", "time of I-MC / time of T-MC"), rows
            ),
        ]
    return tables
