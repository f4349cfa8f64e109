#!/usr/bin/env python3
"""The matrices of volumes: what clrecon and other readers get of files with known places, and of those that it writes.

    python scripts/proof/compare_volume_readers.py [--write]

Prints three tables; with --write they go into docs/calibration.md: formats that are read, odd files, volumes that
`clrecon export` wrote.  The files are those of tests/support/label_matrix.py and volume_matrix.py.
Readers that are not installed are left out: pip install SimpleITK nibabel pynrrd pyvista.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support"), str(ROOT / "scripts"), str(ROOT / "scripts" / "guide")]

from compare_mesh_readers import find_version  # noqa: E402
from label_matrix import KINDS, PLACES, ROWS, judge  # type: ignore[import-not-found]  # noqa: E402
from marked_tables import markdown_table, put_table  # noqa: E402
from volume_files import WRITERS  # type: ignore[import-not-found]  # noqa: E402
from volume_matrix import EXPORTS, PEERS, Truth, describe, read_with_clrecon, write_export  # noqa: E402

PAGE = ROOT / "docs" / "calibration.md"


@contextmanager
def hear() -> Iterator[Callable[[], bool]]:
    """Catch what is said: the function that is given tells whether there were warnings, of libraries in C too."""
    records: list[logging.LogRecord] = []
    listener = logging.Handler(logging.WARNING)
    listener.emit = records.append  # type: ignore[method-assign, assignment]
    logging.getLogger().addHandler(listener)
    before = os.dup(2)
    with tempfile.TemporaryFile() as said, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        os.dup2(said.fileno(), 2)

        def was_told() -> bool:
            said.seek(0)
            text = said.read().lower()
            return bool(records or caught or any(word in text for word in (b"warning:", b"warn|", b"err|")))

        try:
            yield was_told
        finally:
            os.dup2(before, 2)
            os.close(before)
            logging.getLogger().removeHandler(listener)


def ask(peer: str, path: Path, truth: Truth) -> str:
    """Return the cell of another reader, which runs in a process of its own: it may crash."""
    if not path.name.endswith(PEERS[peer][2]):
        return "-"
    with ProcessPoolExecutor(1) as pool:
        try:
            return pool.submit(read_with_peer, peer, path, truth).result()
        except BrokenProcessPool:
            return "crash"


def read_with_peer(peer: str, path: Path, truth: Truth) -> str:
    """Return the cell of another reader that does not crash."""
    read = PEERS[peer][1]
    try:
        with hear() as was_told:
            voxels, affine = read(path)
            return str(describe((voxels, affine, was_told()), truth))
    except Exception as error:
        print(f"{path.name}: {peer}: {type(error).__name__}: {str(error)[-200:]}", file=sys.stderr)
        return "R"


def join(cells: list[str]) -> str:
    """Return one cell of several places or kinds: the worst ones, each once."""
    kept = [cell for cell in dict.fromkeys(cells) if cell != "0"] or ["0"]
    return " / ".join(kept)


def table_of_formats(folder: Path, peers: list[str]) -> str:
    """Return the table of formats: each written by others, with label maps and with CT."""
    rows = []
    for number, name in enumerate(WRITERS):
        for place, affine in PLACES.items():
            cells: dict[str, list[str]] = {peer: [] for peer in ("clrecon", *peers)}
            for kind, make in KINDS.items():
                truth = Truth(make(), affine)
                target = folder / f"{number}{place}{kind}"
                target.mkdir()
                path = WRITERS[name](target / name, truth.voxels, affine)
                cells["clrecon"].append(describe(read_file_with_clrecon(path, kind), truth))
                for peer in peers:
                    cells[peer].append(ask(peer, path, truth))
            rows.append([f"`{name}`, {place}", *(join(cells[peer]) for peer in ("clrecon", *peers))])
    return str(markdown_table(["file", "clrecon", *peers], rows))


def read_file_with_clrecon(path: Path, kind: str) -> tuple[np.ndarray, np.ndarray, bool]:
    """Read a label map or a volume with clrecon."""
    import clrecon

    if kind == "volume":
        return read_with_clrecon(path)
    labels = clrecon.read_labels(path)
    return labels.voxels, labels.affine, bool(labels.warnings)


def table_of_odd_files(folder: Path, peers: list[str]) -> str:
    """Return the table of odd grid files: what clrecon makes of each label map, and what others get."""
    rows = []
    for number, case in enumerate(ROWS):
        if case.file is None:
            continue
        ours, theirs = folder / f"ours{number}", folder / f"theirs{number}"
        ours.mkdir()
        theirs.mkdir()
        path, voxels, affine = case.file(theirs)
        cells = [ask(peer, path, Truth(voxels, affine)) for peer in peers]
        rows.append([case.name, judge(case, ours)[0], *cells])
    return str(markdown_table(["file", "clrecon", *peers], rows))


def table_of_exports(folder: Path, peers: list[str]) -> str:
    """Return the table of volumes that clrecon wrote."""
    rows = []
    for number, (one, extension) in enumerate(EXPORTS):
        target = folder / f"out{number}"
        target.mkdir()
        path, _ = write_export(one, extension, target)
        if one.refused(extension):
            rows.append([f"{one.name}, `{extension}`", "R", *["" for _ in peers]])
            continue
        truth = one.truth()
        cells = [describe(read_with_clrecon(path), truth), *(ask(peer, path, truth) for peer in peers)]
        rows.append([f"{one.name}, `{extension}`", *cells])
    return str(markdown_table(["scan, file", "clrecon", *peers], rows))


TABLES: dict[str, Callable[[Path, list[str]], str]] = {
    "readers of formats": table_of_formats,
    "readers of odd label files": table_of_odd_files,
    "volumes that were written": table_of_exports,
}


def main() -> None:
    """Make the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--write", action="store_true", help="put the tables into docs/calibration.md")
    options = parser.parse_args()
    peers = [name for name, peer in PEERS.items() if find_version(peer[0])]
    text = PAGE.read_text(encoding="utf-8")
    for name, make in TABLES.items():
        with tempfile.TemporaryDirectory() as folder:
            table = make(Path(folder), peers)
        print(f"{name}\n{table}\n")
        text = put_table(text, name, table) if options.write else text
    print(", ".join(f"{name} {find_version(PEERS[name][0])}" for name in peers))
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
