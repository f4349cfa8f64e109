"""Cases of reading: one CT series beside the readers that people use, and large trees of headers."""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from measure import alternate, run_program, spread, summarise
from registry import HERE, Job, case
from trees import write_tree

READ_SERIES = HERE / "peers" / "read_series.py"
TREES = ((100, 10), (1_000, 10), (10_000, 10))
"""Series and slices of each: 1,000, 10,000 and 100,000 files."""
RUNS = 3


@case("reading", "CT folder to HU in memory: against pydicom's loop, SimpleITK and dcm2niix; warm file cache")
def measure_reading(job: Job) -> dict[str, Any]:
    """Time the readers in one process after the imports (``..._warm``), and in fresh processes (``..._process``).

    dcm2niix is a program whose start costs next to nothing and which writes an uncompressed NIfTI file, to memory
    where the system has such a folder.  It is compared with `read_volume` in a running Python, and with a whole
    process that starts Python, loads numpy and reads.
    """
    folder = job.input.ct_folder()
    ratios: dict[str, Any] = {}
    sides: dict[str, Any] = {}
    shapes = {}

    def pair(name: str, own: Callable[[], float], peer: Callable[[], float]) -> None:
        summary = summarise(*alternate(own, peer, job.pairs, limit_s=job.limit_s))
        ratios[name], sides[name] = summary["ratio"], summary

    readers = _load_readers()
    for name in ("pydicom", "simpleitk"):
        pair(f"{name}_warm", _timer(readers["clrecon"], folder), _timer(readers[name], folder))
    for name, read in readers.items():
        shapes[name] = list(read(str(folder)).shape)
    own = _process("clrecon", folder)
    for name in ("pydicom", "simpleitk"):
        pair(f"{name}_process", own, _process(name, folder))
    converter = shutil.which("dcm2niix", path=str(Path(sys.executable).parent)) or shutil.which("dcm2niix")
    if converter:
        with tempfile.TemporaryDirectory(prefix="clrecon-bench-", dir=_memory_folder()) as scratch:
            command = [converter, "-z", "n", "-b", "n", "-w", "1", "-o", scratch, "-f", "volume", str(folder)]
            pair("dcm2niix_warm", _timer(readers["clrecon"], folder), lambda: run_program(command)[0])
            pair("dcm2niix_process", own, lambda: run_program(command)[0])
    scan = _load_scan()
    seconds = [_time(lambda: scan(folder)) for _ in range(max(job.pairs, RUNS))]
    files = sum(1 for path in folder.iterdir() if path.is_file())
    return {
        "ratios": ratios,
        "sides": sides,
        "shapes": shapes,
        "equal_shapes": len({tuple(shape) for shape in shapes.values()}) == 1,
        "files": files,
        "scan_seconds": spread(seconds),
        "scan_seconds_a_file": spread([second / files for second in seconds]),
        "dcm2niix_writes_to": None if not converter else str(_memory_folder() or "the folder for temporary files"),
        "file_cache": "warm: one untimed run of each beforehand",
    }


@case("scan-tree", "headers of 1,000, 10,000 and 100,000 files; at 1,000 against pydicom without pixels")
def measure_scan_tree(job: Job, trees: Sequence[tuple[int, int]] = TREES, runs: int = RUNS) -> dict[str, Any]:
    """Measure seconds and growth of resident memory per file, in fresh processes.  The input is not used."""
    points: list[dict[str, Any]] = []
    ratios, sides = {}, {}
    scan = _load_scan()
    with tempfile.TemporaryDirectory(prefix="clrecon-bench-", dir=_memory_folder()) as scratch:
        for series, slices in trees:
            folder = Path(scratch) / f"{series}x{slices}"
            write_tree(folder, series, slices)
            if not points:
                own, peer = partial(_time, partial(scan, folder)), partial(_time, partial(_read_headers, folder))
                summary = summarise(*alternate(own, peer, job.pairs, limit_s=job.limit_s))
                ratios["pydicom_headers"], sides["pydicom_headers"] = summary["ratio"], summary
            command = [sys.executable, str(READ_SERIES), "scan", str(folder)]
            points.append(_describe_runs([json.loads(run_program(command)[1]) for _ in range(runs)]))
            shutil.rmtree(folder)
    first, last = points[0], points[-1]
    name = "processor_seconds_a_file"
    return {"ratios": ratios, "sides": sides, "trees": points, f"{name}_growth": last[name]["min"] / first[name]["min"]}


def _describe_runs(runs: list[dict[str, Any]]) -> dict[str, Any]:
    files = runs[0]["files"]
    known = [run["bytes"] / files for run in runs if run["bytes"] is not None]
    return {
        "files": files,
        "series": runs[0]["series"],
        "seconds": spread([run["seconds"] for run in runs]),
        "seconds_a_file": spread([run["seconds"] / files for run in runs]),
        "processor_seconds_a_file": spread([run["processor"] / files for run in runs]),
        "group_seconds": spread([run["group"] for run in runs]),
        "resident_bytes_a_file": spread(known) if known else None,
    }


def _load_readers() -> dict[str, Callable[[str], Any]]:
    from peers.read_series import READERS

    return READERS


def _load_scan() -> Callable[[Path], Any]:
    from clrecon.reading.dicom.series.scan import scan_path

    return scan_path


def _read_headers(folder: Path) -> int:
    """Read headers with pydicom: no pixels, and only the tags that a stack needs."""
    import pydicom

    tags = ["SeriesInstanceUID", "ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "Rows", "Columns"]
    found = [
        pydicom.dcmread(path, stop_before_pixels=True, specific_tags=tags)  # type: ignore[arg-type]
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    ]
    return len(found)


def _time(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def _timer(read: Callable[[str], Any], folder: Path) -> Callable[[], float]:
    return partial(_time, partial(read, str(folder)))


def _process(reader: str, folder: Path) -> Callable[[], float]:
    command = [sys.executable, str(READ_SERIES), reader, str(folder)]
    return lambda: run_program(command)[0]


def _memory_folder() -> Path | None:
    """Return a folder in memory if the system has one."""
    folder = Path("/dev/shm")
    return folder if folder.is_dir() else None
