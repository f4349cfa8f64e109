#!/usr/bin/env python3
"""Write the tables of docs/trust.md from figures that are kept.

    python scripts/proof/make_trust_page.py
    python scripts/proof/make_trust_page.py record fuzz=FILE kernels=FILE python=FILE

The first takes the figures from docs/benchmarks and the tables of docs/calibration.md.  The second first keeps counts
of what ``fuzz.py --json``, ``mutate_kernels.py --results`` and ``mutate_python.py --json`` wrote.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / "scripts" / "guide"), str(ROOT / "scripts" / "proof")]

from kernel_mutations import all_mutations  # noqa: E402
from marked_tables import find_table, markdown_table, put_table  # noqa: E402

BENCHMARKS = ROOT / "docs" / "benchmarks"
PAGE, CHECKS = ROOT / "docs" / "trust.md", BENCHMARKS / "checks.json"
NO_HU = ("jaw", "longbone")
"""Phantoms whose values are not HU: a level in HU, and the surface that starts from one, do not apply to them."""
RULES = {"fitted": "`--surface cortex`", "auto": "`--hu auto`", "preset": "preset, 200 HU"}
MATRICES = {
    "series that are easily placed wrongly": "DICOM series that are easily placed wrongly",
    "series that look right": "DICOM series that look right and are not",
    "readers of formats": "volumes and label maps in other formats",
    "readers of odd label files": "odd and damaged label maps",
    "volumes that were written": "volumes written by `clrecon export`",
    "meshes": "mesh files",
}
"""Names of tables in docs/calibration.md, and what their rows are."""


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def accuracy_table() -> str:
    """Return the distance of surfaces from the true one: mean over phantoms, worst phantom, and lost walls."""
    rows = []
    for path in sorted((BENCHMARKS / "levels").glob("phantoms*.json")):
        figures = json.loads(path.read_text(encoding="utf-8"))
        title = path.stem.replace("phantoms_", " (seed ") + ")" if "_" in path.stem else ""
        for group in dict.fromkeys(one["group"] for one in figures if "best" in one):
            phantoms = [one for one in figures if one["group"] == group]
            errors = (errors_of_rule(phantoms, rule) for rule in RULES)
            cells = [f"{mean:.2f}, {worst:.2f}, {_percent(lost)}" for mean, worst, lost in errors]
            rows.append([f"{group}{title}", len(phantoms), *cells])
    titles = (f"{title}: mean mm, worst mm, lost" for title in RULES.values())
    return markdown_table(["phantoms with a known surface", "number", *titles], rows)


def errors_of_rule(phantoms: Sequence[dict[str, Any]], rule: str) -> tuple[float, float, float]:
    """Return the mean distance over phantoms and that of the worst, in mm, and the mean share of lost surface."""
    figures = [one[rule] for one in phantoms if rule == "auto" or one["name"] not in NO_HU]
    errors = [one["mean_mm"] for one in figures]
    return fmean(errors), max(errors), fmean(one["lost_share"] for one in figures)


def count_wrong(table: str) -> dict[str, tuple[int, int, int]]:
    """Return cases, silent faults (bold) and refusals by reader, of a table; empty: a file that was not written."""
    lines = [line[2:-2].split(" | ") for line in table.splitlines()]
    counts = {}
    for column, reader in enumerate(lines[0][1:], start=1):
        tried = [cells[column] for cells in lines[2:] if cells[column] not in ("", "-", "n/a")]
        refused = sum(cell.startswith(("R", "refused", "crash")) for cell in tried)
        counts[reader] = len(tried), sum("**" in cell for cell in tried), refused
    return counts


def matrix_table(text: str) -> str:
    """Return what readers make of difficult files: files that were read wrongly without a word, and refusals."""
    rows = []
    for name, title in MATRICES.items():
        counts = count_wrong(find_table(text, name))
        own, others = counts.pop("clrecon"), counts.items()
        cells = [f"{wrong} of {cases}, {refused} refused" for cases, wrong, refused in (own, *dict(others).values())]
        peers = "; ".join(f"{reader} {cell}" for (reader, _), cell in zip(others, cells[1:], strict=True))
        rows.append([title, cells[0], peers])
    return markdown_table(["files", "read wrongly by clrecon", "read wrongly by others with their defaults"], rows)


def checks_table(checks: dict[str, Any]) -> str:
    """Return what tests and self-test noticed of faults that were made on purpose."""
    fuzz, kernels, python = checks["fuzz"], checks["kernels"], checks["python"]
    rows: list[Sequence[object]] = [
        ["damaged input", f"{fuzz['cases']:,}", f"{fuzz['faults']:,} faults (crash, hang, silently wrong result)"],
        ["kernel changes tried", f"{kernels['tried']:,} of {kernels['changes']:,}", _noticed(kernels, "the self-test")],
        *(
            [f"code changes tried in `clrecon/{room}`", f"{counts['tried']:,}", _noticed(counts, "the tests")]
            for room, counts in sorted(python.items())
        ),
    ]
    return markdown_table(["test", "cases", "result"], rows)


def _noticed(counts: dict[str, int], by: str) -> str:
    return f"{counts['caught']:,} noticed by {by}, {counts['equivalent']:,} without effect, {counts['missed']:,} missed"


def device_table() -> str:
    """Return the devices of the records in docs/benchmarks."""
    records = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(BENCHMARKS.rglob("*-*.json"))]
    seen = Counter(
        (record["machine"]["processor"], f"PoCL {record['device']['driver']}")
        for record in records
        if isinstance(record, dict) and isinstance(record.get("device"), dict)
    )
    cards = [record["steps"]["device"] for record in records if "comparison" in record]
    rows = [[*device, f"{count} benchmarks"] for device, count in sorted(seen.items())]
    rows += [[card["name"], f"{card['driver']}, {card['version']}", "[gpu.md](gpu.md)"] for card in cards]
    return markdown_table(["device", "driver", "records"], rows)


def make_tables(checks: Path = CHECKS) -> dict[str, Callable[[], str]]:
    """Return what makes each table of the page, by its name."""
    calibration = ROOT / "docs" / "calibration.md"
    return {
        "accuracy": accuracy_table,
        "difficult files": lambda: matrix_table(calibration.read_text(encoding="utf-8")),
        "faults on purpose": lambda: checks_table(json.loads(checks.read_text(encoding="utf-8"))),
        "devices": device_table,
    }


def condense(kind: str, found: Any) -> dict[str, Any]:
    """Return the counts of what one of the three scripts wrote."""
    if kind == "fuzz":
        return {"cases": found["cases"], "faults": len(found["faults"])}
    if kind == "kernels":
        outcomes = Counter(result["caught"] for result in found.values())
        equivalent = sum(bool(mutation.reason) for mutation in all_mutations())
        missed = max(outcomes[False] - equivalent, 0)
        counts = {"caught": outcomes[True], "equivalent": outcomes[False] - missed, "missed": missed}
        return {"changes": len(all_mutations()), "tried": len(found), **counts}
    rooms: dict[str, Any] = {}
    for room in sorted({row["room"] for row in found}):
        outcomes = Counter(row["outcome"] for row in found if row["room"] == room)
        missed = sum(outcomes[outcome] for outcome in ("survived", "not run", "late"))
        caught = outcomes.total() - missed - outcomes["equivalent"]
        tried = {"tried": outcomes.total(), "caught": caught, "equivalent": outcomes["equivalent"], "missed": missed}
        rooms[room] = tried
    return rooms


def keep_records(arguments: Sequence[str], checks: Path) -> None:
    """Keep the counts of files, KIND=FILE, beside those that are there."""
    kept = json.loads(checks.read_text(encoding="utf-8")) if checks.exists() else {}
    for argument in arguments:
        kind, _, file = argument.partition("=")
        kept[kind] = condense(kind, json.loads(Path(file).read_text(encoding="utf-8")))
    checks.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


def main(arguments: Sequence[str], page: Path = PAGE, checks: Path = CHECKS) -> int:
    """Write the page, after the records that were given are kept."""
    if arguments[:1] == ["record"]:
        keep_records(arguments[1:], checks)
    elif arguments:
        raise SystemExit(__doc__)
    text = page.read_text(encoding="utf-8")
    for name, make in make_tables(checks).items():
        text = put_table(text, name, make())
    page.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
