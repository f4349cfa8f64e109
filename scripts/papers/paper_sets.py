"""The series on which the tables of both papers are made again, and what is kept of a comparison."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

MAIN = ("t-mc", "t-mc-soup", "skimage", "vtk-mc", "vtk-fe", "i-mc", "i-mc-golden", "g-mc", "s-mc")
TABLE = ("t-mc", "i-mc", "i-mc-golden", "g-mc", "s-mc")


@dataclass(frozen=True, kw_only=True)
class PaperSet:
    """A series, and the methods that are compared on it.

    name: Of the file in docs/papers.
    what: In the tables.
    phantom: Arguments of ``clrecon phantom`` that make the series.
    iso_value: HU.
    methods: Empty: all.
    paper: True: with the pictures against the middle slice.
    truth: True: measured against the true surface of the phantom.
    """

    name: str
    what: str
    vertebrae: int
    phantom: tuple[str, ...]
    iso_value: float = 226.0
    methods: tuple[str, ...] = TABLE
    paper: bool = False
    truth: bool = False


def _spine(levels: str, spacing: str, slices: int | None = None) -> tuple[str, ...]:
    arguments = ("--levels", levels, "--size", "512", "--spacing", *spacing.split(), "--noise", "12")
    return arguments if slices is None else (*arguments, "--slices", str(slices))


SETS = {
    each.name: each
    for each in (
        PaperSet(
            name="a", what="512 x 512 x 95 voxels", vertebrae=3, phantom=_spine("T6-T8", "0.644531 0.644531 0.8", 95),
            iso_value=200.0, methods=(), paper=True,
        ),
        PaperSet(
            name="b54", what="54 slices of 2.5 mm", vertebrae=4, phantom=_spine("T12-L3", "0.7 0.7 2.5", 54),
            methods=TABLE,
        ),
        PaperSet(
            name="b149", what="149 slices of 1.4 mm", vertebrae=12, phantom=_spine("C1-C7,T1-T5", "0.7 0.7 1.4", 149),
            methods=MAIN, truth=True,
        ),
        PaperSet(name="b559", what="559 slices of 1.0 mm", vertebrae=17, phantom=_spine("T1-L5", "0.7 0.7 1.0", 559)),
        PaperSet(name="v2", what="L4 and L5", vertebrae=2, phantom=_spine("L4-L5", "0.7 0.7 1.0")),
        PaperSet(name="v3", what="L3 to L5", vertebrae=3, phantom=_spine("L3-L5", "0.7 0.7 1.0")),
        PaperSet(name="v4", what="L2 to L5", vertebrae=4, phantom=_spine("L2-L5", "0.7 0.7 1.0")),
        PaperSet(name="v5", what="L1 to L5", vertebrae=5, phantom=_spine("L1-L5", "0.7 0.7 1.0")),
        PaperSet(name="v12", what="T1 to T12", vertebrae=12, phantom=_spine("T1-T12", "0.7 0.7 1.0")),
    )
}  # fmt: skip
"""In the order of the page.  The 17 vertebrae of the papers are those of b559."""

_KEPT = (
    "date", "version", "shape_ijk", "spacing_mm", "iso_value_hu", "reference", "device", "driver", "processor", "cores",
    "free_cores", "versions", "read_s", "paper",
)  # fmt: skip
_KEPT_OF_METHODS = (
    "name", "title", "state", "error", "triangles", "points", "first_s", "warm_s", "kernels_ms", "memory_bytes",
    "cells_visited", "cells_all", "quality", "cells", "slices", "surfaces", "truth", "pictures", "reasons", "small",
)  # fmt: skip


def keep_figures(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a report of ``clrecon compare`` that the page needs; no path and no certificate."""
    kept = {name: report[name] for name in _KEPT}
    kept["methods"] = [{name: row[name] for name in _KEPT_OF_METHODS} for row in report["methods"]]
    return kept
