"""The case of a whole cloud job: DICOM folder to clean cloud on the disk, in fresh processes."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from measure import alternate, medians, run_program, summarise
from registry import HERE, Job, case

__all__ = ["measure_cloud_chain"]

BAND = (200.0, 3000.0)
EPS_MM, FEWEST = 1.2, 6
CLUSTERERS = ("sklearn", "open3d")
"""What clusters on the other side; scikit-learn is what paper A used."""


@case("cloud-chain", "CT folder to clean cloud file, whole processes, against numpy, scikit-learn and Open3D")
def measure_cloud_chain(job: Job) -> dict[str, Any]:
    """Time paper A's chain with warm caches: HU band, affine, DBSCAN without noise, PLY; one untimed run before."""
    folder = job.input.ct_folder()
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "band_hu": BAND, "eps_mm": EPS_MM, "min_samples": FEWEST}
    with tempfile.TemporaryDirectory(prefix="clrecon-bench-") as scratch:
        cloud, other, report = (Path(scratch) / name for name in ("clrecon.ply", "peer.ply", "report.json"))
        own = [
            sys.executable,
            "-m",
            "clrecon",
            "cloud",
            str(folder),
            "-o",
            str(cloud),
            "--hu",
            f"{BAND[0]:g},{BAND[1]:g}",
        ]
        own += ["--ghost-slices", "drop", "--cluster", f"eps={EPS_MM},min={FEWEST}", "-q", "--report", str(report)]
        own += ["--device", str(job.device.index)]
        parts: list[dict[str, float]] = []

        def run_own() -> float:
            seconds = run_program(own)[0]
            parts.append(json.loads(report.read_text(encoding="utf-8"))["seconds"])
            return seconds

        for clusterer in CLUSTERERS:
            peer = [sys.executable, str(HERE / "peers" / "cloud_chain.py"), str(folder), str(other)]
            peer += [*map(str, (*BAND, EPS_MM, FEWEST)), clusterer, "drop"]
            printed: list[str] = []

            def run_peer(command: list[str] = peer, printed: list[str] = printed) -> float:
                seconds, text = run_program(command)
                printed.append(text)
                return seconds

            ours, theirs = alternate(run_own, run_peer, job.pairs, limit_s=job.limit_s)
            side = summarise(ours, theirs)
            figures["ratios"][clusterer], figures["sides"][clusterer] = side["ratio"], side
            figures[f"peer_{clusterer}"] = json.loads(printed[-1])
        told = json.loads(report.read_text(encoding="utf-8"))
        figures |= {"points": told["points"], "removed": told["removed"], "seconds_by_part": medians(parts[1:])}
    return figures
