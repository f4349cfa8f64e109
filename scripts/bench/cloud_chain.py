"""The case of a whole cloud job: DICOM folder to clean cloud on the disk, in fresh processes."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from measure import medians, run_program
from registry import HERE, Job, case
from wall_and_cpu import alternate_twice

BAND = (200.0, 3000.0)
EPS_MM, FEWEST = 1.2, 6
CLUSTERERS = ("sklearn", "open3d")
"""What clusters on the other side; scikit-learn is what paper A used."""


@case("cloud-chain", "CT folder to clean cloud file, whole processes, against numpy, scikit-learn and Open3D")
def measure_cloud_chain(job: Job) -> dict[str, Any]:
    """Time paper A's chain with warm caches, one untimed run before.

    HU band, ghost slices, affine, DBSCAN without noise, PLY; the same steps on both sides.
    """
    folder = job.input.ct_folder()
    figures: dict[str, Any] = {"ratios": {}, "sides": {}, "band_hu": BAND, "eps_mm": EPS_MM, "min_samples": FEWEST}
    with tempfile.TemporaryDirectory(prefix="clrecon-bench-") as scratch:
        cloud, other, report = (Path(scratch) / name for name in ("clrecon.ply", "peer.ply", "report.json"))
        own = [sys.executable, "-m", "clrecon", "cloud", str(folder), "-o", str(cloud)]
        own += ["--hu", f"{BAND[0]:g},{BAND[1]:g}", "--ghost-slices", "drop", "--cluster", f"eps={EPS_MM},min={FEWEST}"]
        own += ["-q", "--report", str(report), "--device", str(job.device.index)]
        parts: list[dict[str, float]] = []

        def run_own() -> None:
            run_program(own)
            parts.append(json.loads(report.read_text(encoding="utf-8"))["seconds"])

        for clusterer in CLUSTERERS:
            peer = [sys.executable, str(HERE / "peers" / "cloud_chain.py"), str(folder), str(other)]
            peer += [*map(str, (*BAND, EPS_MM, FEWEST)), clusterer, "drop"]
            printed: list[str] = []

            def run_peer(command: list[str] = peer, printed: list[str] = printed) -> None:
                printed.append(run_program(command)[1])

            sides = alternate_twice(run_own, run_peer, job.pairs, limit_s=job.limit_s)
            for clock, side in sides.items():
                name = clusterer if clock == "wall" else f"{clusterer}_{clock}"
                figures["ratios"][name], figures["sides"][name] = side["ratio"], side
            figures[f"peer_{clusterer}"] = json.loads(printed[-1])
        told = json.loads(report.read_text(encoding="utf-8"))
        figures |= {"points": told["points"], "removed": told["removed"], "seconds_by_part": medians(parts[1:])}
    return figures
