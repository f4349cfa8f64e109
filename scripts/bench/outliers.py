#!/usr/bin/env python3
"""The next outlier: every command with its common options on an ugly scan, and what of it takes too long.

    python scripts/bench/outliers.py [CT_FOLDER] [--only TEXT] [--json FILE] [--peers-python PEERS/bin/python]

Without CT_FOLDER the scan is a noisy chest with contrast medium, whose surface at 200 HU has 2.6 million triangles in
110,000 components.  Each command runs once as a process of its own, some beside a peer that does the same or less.
The last column says why a command stands out: more than 5 processor seconds, or more than three times the peer's.
The seconds that count are those of the processor, as a busy machine changes them least.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from measure import ROOT, describe_machine, write_json

MOST_SECONDS = 5.0
MOST_OF_PEER = 3.0
SCAN = "--kind contrast --size 512 --slices 120 --spacing 0.7 0.7 2.5 --noise 70"
SPINE = "--kind spine --size 512 --slices 150 --spacing 0.7 0.7 1.5 --noise 40"

COMMANDS = {
    "info": "info {scan} --pixels",
    "mesh": "mesh {scan} -o mesh.stl",
    "mesh, auto": "mesh {scan} -o auto.stl --hu auto",
    "mesh, largest": "mesh {scan} -o largest.ply --keep-largest 1",
    "mesh, keep bone": "mesh {scan} -o kept.stl --keep bone",
    "mesh, solid": "mesh {scan} -o solid.stl --solid",
    "mesh, split": "mesh {scan} -o split.stl --split --keep-largest 300",
    "mesh, cortex": "mesh {scan} -o cortex.ply --surface cortex",
    "mesh, smooth": "mesh {scan} -o smooth.stl --smooth",
    "mesh, decimate": "mesh {scan} -o decimated.stl --decimate 0.9",
    "mesh, smooth, decimate": "mesh {scan} -o refined.stl --smooth --decimate 0.9",
    "mesh, print": "mesh {scan} -o print.stl --for print",
    "mesh, median": "mesh {scan} -o median.stl --preprocess median",
    "mesh, non-local means": "mesh {scan} -o means.stl --preprocess non-local-means",
    "mesh, no table": "mesh {scan} -o bare.stl --remove-table",
    "mesh, 3MF": "mesh {scan} -o mesh.3mf",
    "mesh, VTP": "mesh {scan} -o mesh.vtp",
    "mesh, GLB": "mesh {scan} -o mesh.glb",
    "view, page": "view {scan} --html page.html",
    "cloud": "cloud {scan} -o cloud.ply --normals",
    "cloud, clusters": "cloud {scan} -o clusters.ply --cluster eps=4,min=6 --keep largest:2",
    "cloud, outliers": "cloud {scan} -o inliers.ply --outliers 2",
    "render": "render {scan} -o picture.png",
    "render, no table": "render {scan} -o bare.png --remove-table",
    "render, surface": "render {scan} -o surface.png --iso 200 --shadows --light left",
    "render, GIF": "render {scan} --turntable turn.gif --frames 60 --size 1024x1024",
    "render, MP4": "render {scan} --turntable turn.mp4 --frames 60 --size 1024x1024",
    "export": "export {scan} -o volume.nii.gz",
    "vertebrae": "vertebrae spine -o levels.nii.gz",
    "distance": "distance mesh.stl smooth.stl",
}
"""What is timed, by name; `distance` takes what commands above it have written."""

_READ = "import SimpleITK as s; r = s.ImageSeriesReader(); r.SetFileNames(r.GetGDCMSeriesFileNames({scan!r}))\n"
_MESH = "import pyvista as p; m = p.read('mesh.stl').clean()\n"
PEERS = {
    "mesh": [str(ROOT / "scripts" / "bench" / "peers" / "simpleitk_vtk.py"), "{scan}", "peer.stl", "200", "2"],
    "mesh, smooth": ["-c", _MESH + "m.smooth_taubin(n_iter=20).save('peer.stl')"],
    "mesh, decimate": ["-c", _MESH + "import fast_simplification as f; f.simplify_mesh(m, 0.9).save('peer.stl')"],
    "mesh, median": ["-c", _READ + "s.Median(r.Execute())"],
    "export": ["-c", _READ + "s.WriteImage(r.Execute(), 'peer.nii.gz')"],
}
"""Programs of others, by the command beside which they run: arguments of Python, in the folder of the outputs."""


@dataclass(frozen=True)
class Run:
    """One process: wall and processor seconds, its peak memory, and the last line it said where it failed."""

    wall_s: float
    cpu_s: float
    memory_bytes: int
    error: str | None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scan", metavar="CT_FOLDER", nargs="?")
    parser.add_argument("--only", default="", metavar="TEXT", help="only commands whose names hold this text")
    parser.add_argument("--peers-python", default=sys.executable, metavar="PYTHON", help="has SimpleITK and pyvista")
    parser.add_argument("--json", metavar="FILE", help="write all figures")
    parser.add_argument("--limit", type=float, default=300.0, metavar="S", help="wall seconds a process may take")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        scan = os.path.abspath(options.scan or os.path.join(folder, "scan"))
        phantoms = {"spine": SPINE} if options.scan else {"scan": SCAN, "spine": SPINE}
        for name, words in phantoms.items():
            time_process([sys.executable, "-m", "clrecon", "phantom", name, *words.split()], folder, options.limit)
        rows = {}
        print(
            "| command | wall time, s | processor time, s | peak memory | processor time of the peer, s | |\n"
            "|---|---|---|---|---|---|",
            flush=True,
        )
        for name in COMMANDS:
            if options.only in name:
                rows[name] = time_command(name, scan, folder, options.peers_python, options.limit)
        if options.json:
            write_json(Path(options.json), {"machine": describe_machine(), "runs": rows})
    failed = [name for name, row in rows.items() if row["error"]]
    return 1 if failed else 0


def time_command(name: str, scan: str, folder: str, peers_python: str, limit_s: float) -> dict[str, Any]:
    """Time a command and its peer, and print the row of the table."""
    words = [scan if word == "{scan}" else word for word in COMMANDS[name].split()]
    run = time_process([sys.executable, "-m", "clrecon", *words], folder, limit_s)
    peer = None
    if name in PEERS:
        program = [argument.format(scan=scan) for argument in PEERS[name]]
        peer = time_process([peers_python, *program], folder, limit_s)
    why = judge(run, peer)
    other = "-" if peer is None else peer.error or f"{peer.cpu_s:.1f}"
    memory = f"{1e-9 * run.memory_bytes:.2f} GB"
    label = COMMANDS[name].replace(" {scan}", "")
    print(f"| `{label}` | {run.wall_s:.1f} | {run.cpu_s:.1f} | {memory} | {other} | {why} |", flush=True)
    return {**asdict(run), "peer": None if peer is None else asdict(peer), "why": why}


def judge(run: Run, peer: Run | None) -> str:
    """Say why a command stands out; empty where it does not."""
    if run.error:
        return run.error
    reasons = [f"over {MOST_SECONDS:g} s"] if run.cpu_s > MOST_SECONDS else []
    if peer is not None and not peer.error and run.cpu_s > MOST_OF_PEER * peer.cpu_s:
        reasons.append(f"{run.cpu_s / peer.cpu_s:.1f} times the peer")
    return ", ".join(reasons)


def time_process(command: list[str], folder: str, limit_s: float) -> Run:
    """Run a process to its end, or to the limit, and measure it with all that it starts."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))}
    with tempfile.TemporaryFile() as said:
        start = time.perf_counter()
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=said)
        is_late = threading.Event()

        def end_late() -> None:
            is_late.set()
            process.kill()

        alarm = threading.Timer(limit_s, end_late)
        alarm.start()
        _, status, usage = os.wait4(process.pid, 0)
        alarm.cancel()
        wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        last = said.read().decode(errors="replace").strip().splitlines()[-1:] or ["no word"]
    error = None if process.returncode in (0, 8) else f"exit {process.returncode}: {last[0]}"
    if is_late.is_set():
        error = f"over {limit_s:g} s"
    return Run(wall, usage.ru_utime + usage.ru_stime, 1024 * usage.ru_maxrss, error)


if __name__ == "__main__":
    sys.exit(main())
