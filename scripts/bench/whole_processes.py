#!/usr/bin/env python3
"""The same CT folder to an STL by clrecon and other programs, as whole processes: the small table of README.md.

    python scripts/bench/whole_processes.py run --peers-python PEERS/bin/python thorax=CT_FOLDER
    python scripts/bench/whole_processes.py page

`run` makes the phantom of `phantom_command`, the same with a tilted gantry, and runs each program on the phantom and
the named folders in turn: once for its peak memory and its mesh, then `--rounds` times for seconds. PEERS is an
environment with dicom2stl, meshlib, pydicom, scikit-image and trimesh; InVesalius is Debian's package `invesalius`,
which needs `xvfb-run`. A program that is not there, or fails, is a row that says so. The figures are kept in
docs/benchmarks/processes; `page` writes the tables into README.md and docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(ROOT), str(HERE), str(HERE.parent), str(HERE.parent / "guide")]

from marked_tables import markdown_table, put_table  # noqa: E402
from measure import describe_machine, spread, write_json  # noqa: E402

FIGURES = ROOT / "docs" / "benchmarks" / "processes"
README, PAGE = ROOT / "README.md", ROOT / "docs" / "benchmarks.md"
ISO_HU = 200
PHANTOM = ("--size", "512", "--slices", "149", "--spacing", "0.7", "0.7", "1.4")
TILTED = (*PHANTOM, "--tilt", "12")
LIMIT_S = 300.0
IN_PLACE = 1.0
"""Largest median distance from clrecon's surface, in voxels, of a mesh that lies in its place."""


@dataclass(frozen=True)
class Program:
    """A program: its name, the command for a folder and an output, and what it needs to be there."""

    key: str
    name: str
    command: tuple[str, ...]
    needs: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] | None = None
    note: str = ""


def programs(peers_python: str, threads: int) -> list[Program]:
    """Return all programs; IN and OUT stand for the folder and the file."""
    own = (sys.executable, "-m", "clrecon", "mesh", "IN", "-o", "OUT", "--preset", "bone", "-q")
    beside = Path(peers_python).parent / "dicom2stl"
    hu, path = str(ISO_HU), (("PATH", "/usr/bin:/bin"), ("LANG", "C.UTF-8"))
    return [
        Program("clrecon", "clrecon", own),
        Program("clrecon-print", "clrecon, `--for print`", (*own, "--for", "print"),
                note="one piece, smoothed, a tenth of the triangles, checked for cuts"),
        Program("simpleitk-vtk", "SimpleITK + VTK flying edges",
                (sys.executable, str(HERE / "peers" / "simpleitk_vtk.py"), "IN", "OUT", hu, str(threads))),
        Program("pydicom-skimage", "pydicom + scikit-image",
                (peers_python, str(HERE / "peers" / "pydicom_skimage.py"), "IN", "OUT", hu), (peers_python,)),
        Program("meshlib", "MeshLib",
                (peers_python, str(HERE / "peers" / "meshlib_mesh.py"), "IN", "OUT", hu, str(threads)),
                (peers_python,)),
        Program("dicom2stl", "dicom2stl", (str(beside), "-t", "bone", "-i", hu, "-o", "OUT", "IN"), (str(beside),),
                note="smooths and removes nine of ten triangles by default"),
        Program("invesalius", "InVesalius",
                ("xvfb-run", "-a", "invesalius3", "--no-gui", "-i", "IN", "-t", f"{hu},3071", "-e", "OUT"),
                ("xvfb-run", "invesalius3"), path),
    ]  # fmt: skip


def run_once(program: Program, folder: Path, output: Path, *, watch: bool) -> tuple[float, int | None]:
    """Run a program; returns wall seconds and, watched, the peak of the memory of all its processes in bytes."""
    output.unlink(missing_ok=True)
    words = {"IN": str(folder), "OUT": str(output)}
    command = [words.get(part, part) for part in program.command]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with tempfile.TemporaryDirectory() as home:
        if program.environment is not None:
            environment = {**dict(program.environment), "HOME": home}
        start = time.perf_counter()
        with subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as process:
            peak = _watch(process) if watch else None
            try:
                said = process.communicate(timeout=LIMIT_S)[1]
            except subprocess.TimeoutExpired:
                process.kill()
                raise RuntimeError(f"ended after {LIMIT_S:g} s") from None
        seconds = time.perf_counter() - start
    if process.returncode != 0:
        raise RuntimeError(f"exit code {process.returncode}: {(said.strip().splitlines() or [''])[-1][:120]}")
    if not output.is_file():
        raise RuntimeError("wrote no file")
    return seconds, peak


def _watch(process: subprocess.Popen[str]) -> int:
    """Return the largest sum of the memory of a process and its children, shared pages counted once."""
    peak = 0
    until = time.perf_counter() + LIMIT_S
    while process.poll() is None and time.perf_counter() < until:
        peak = max(peak, sum(_own_bytes(number) for number in _family(process.pid)))
        time.sleep(0.01)
    return peak


def _family(number: int) -> list[int]:
    try:
        children = Path(f"/proc/{number}/task/{number}/children").read_text().split()
        if Path(f"/proc/{number}/comm").read_text().strip() == "Xvfb":
            return []
    except OSError:
        return []
    return [number, *(each for child in children for each in _family(int(child)))]


def _own_bytes(number: int) -> int:
    try:
        lines = Path(f"/proc/{number}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return sum(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))


def judge_mesh(path: Path, own: Path, voxel_mm: float) -> dict[str, Any]:
    """Judge a mesh: closed, turned inside out, and its median distance from clrecon's surface of the same level."""
    import numpy as np

    from clrecon import read_mesh
    from clrecon.mesh.compare.distances import SurfaceDistance, sample_surface

    mesh, ours = read_mesh(path), read_mesh(own)
    quality = mesh.quality()
    middle = mesh.vertices.mean(axis=0, dtype=np.float64)
    a, b, c = (mesh.vertices[mesh.triangles[:, n]].astype(np.float64) - middle for n in range(3))
    points = sample_surface(mesh.vertices, mesh.triangles, 2_000)
    away = np.median(SurfaceDistance(ours.vertices, ours.triangles)(points))
    return {
        "triangles": int(len(mesh.triangles)),
        "closed": bool(quality["closed"]),
        "inside_out": bool(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() < 0.0),
        "from_place_mm": round(float(away), 4),
        "in_place": bool(away <= IN_PLACE * voxel_mm),
    }


def measure_input(name: str, folder: Path, known: Sequence[Program], rounds: int, scratch: Path) -> dict[str, Any]:
    """Run all programs on a folder in turn; returns the figures of each, or why there are none."""
    from clrecon import read_volume

    volume = read_volume(folder)
    voxel_mm = float(min(volume.spacing))
    figures: dict[str, Any] = {}
    for program in known:
        output = scratch / f"{program.key}.stl"
        gone = [need for need in program.needs if shutil.which(need) is None]
        if gone:
            figures[program.key] = {"why": f"not here: {', '.join(Path(need).name for need in gone)}"}
            continue
        try:
            _, peak = run_once(program, folder, output, watch=True)
            judged = judge_mesh(output, scratch / "clrecon.stl", voxel_mm)
            figures[program.key] = {**judged, "peak_bytes": peak, "seconds": []}
        except RuntimeError as error:
            figures[program.key] = {"why": str(error).replace(str(scratch), "...").replace(str(folder), "...")}
        print(name, program.key, figures[program.key], flush=True)
    for turn in range(rounds):
        for program in known if turn % 2 == 0 else list(known)[::-1]:
            if "seconds" in figures[program.key]:
                seconds, _ = run_once(program, folder, scratch / "again.stl", watch=False)
                figures[program.key]["seconds"].append(round(seconds, 3))
    for each in figures.values():
        if each.get("seconds"):
            each["seconds"] = spread(each["seconds"])
    shape = list(volume.voxels.shape[::-1])
    return {"name": name, "shape_ijk": shape, "spacing_mm": [float(s) for s in volume.spacing], "programs": figures}


def make_phantoms(work: Path) -> tuple[Path, Path]:
    """Write the phantom, and the same with a tilted gantry."""
    made = []
    for name, options in (("phantom", PHANTOM), ("tilted", TILTED)):
        folder = work / name
        if not folder.is_dir():
            subprocess.run([sys.executable, "-m", "clrecon", "phantom", str(folder), *options, "-q"], check=True)
        made.append(folder)
    return made[0], made[1]


def run(options: argparse.Namespace) -> None:
    """Measure everything and keep the figures."""
    known = programs(options.peers_python, options.threads)
    work = Path(options.work)
    work.mkdir(mode=0o700, parents=True, exist_ok=True)
    phantom, tilted = make_phantoms(work)
    inputs = [("phantom", phantom, options.rounds), ("tilted", tilted, 0)]
    inputs += [(name, Path(folder), options.rounds) for name, _, folder in (g.partition("=") for g in options.inputs)]
    for name, folder, rounds in inputs:
        with tempfile.TemporaryDirectory(dir=work) as scratch:
            figures = measure_input(name, folder, known, rounds, Path(scratch))
        made_up = {"phantom": PHANTOM, "tilted": TILTED}.get(name)
        figures["phantom"] = None if made_up is None else shlex.join(("clrecon", "phantom", "ct", *made_up))
        figures["machine"] = describe_machine()
        figures["versions"] = _versions(options.peers_python)
        write_json(FIGURES / f"{name}.json", figures)


def _versions(peers_python: str) -> dict[str, str]:
    """Versions of the peers that are there."""
    names = ("dicom2stl", "meshlib", "scikit-image")
    asked = f"from importlib.metadata import version as v\nfor n in {names}:\n print(n, v(n))"
    found = {}
    for command in ([peers_python, "-c", asked], ["dpkg-query", "-W", "-f", "${Package} ${Version}", "invesalius"]):
        try:
            text = subprocess.run(command, capture_output=True, text=True).stdout
        except OSError:
            continue
        found.update(dict(line.split() for line in text.splitlines() if len(line.split()) == 2))
    return found


# --- tables ---
def table_of(figures: dict[str, Any], tilted: dict[str, Any]) -> str:
    """Return the table of one input; the last column is of the tilted phantom."""
    head = (
        "from a CT folder to an STL",
        "median time, s",
        "peak memory",
        "closed",
        "in place",
        "inside out",
        "in place, tilted gantry",
    )
    rows = []
    for program in programs("python", 1):
        one, other = figures["programs"].get(program.key), tilted["programs"].get(program.key, {})
        if one is None:
            continue
        if "why" in one:
            rows.append((program.name, f"not run ({one['why']})", *[""] * 5))
            continue
        rows.append((
            program.name, f"{one['seconds']['median']:.1f}", f"{one['peak_bytes'] / 1e9:.2f} GB", _yes(one["closed"]),
            _place(one), _yes(one["inside_out"]), _place(other),
        ))  # fmt: skip
    machine = figures["machine"]
    load = machine["load_average"]
    busy = "" if load is None else f", load average {load[1]:.1f} during the runs"
    return f"{markdown_table(head, rows)}\n\n{machine['processor']}, {machine['cores']} CPU cores{busy}."


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def _place(one: dict[str, Any]) -> str:
    if "why" in one:
        return "fails"
    return "yes" if one["in_place"] else f"no, {one['from_place_mm']:.0f} mm off"


def load(name: str) -> dict[str, Any]:
    """Return the kept figures of an input."""
    loaded: dict[str, Any] = json.loads((FIGURES / f"{name}.json").read_text("utf-8"))
    return loaded


def tables() -> dict[Path, dict[str, str]]:
    """Return the tables of each document by the names of their markers."""
    tilted = load("tilted")
    names = sorted(path.stem for path in FIGURES.glob("*.json") if path.stem != "tilted")
    of_inputs = {f"whole processes, {name}": table_of(load(name), tilted) for name in names}
    return {README: {"whole processes, phantom": of_inputs["whole processes, phantom"]}, PAGE: of_inputs}


def write_pages() -> None:
    """Write the tables into their documents."""
    for page, made in tables().items():
        text = page.read_text("utf-8")
        for name, table in made.items():
            text = put_table(text, name, table)
        page.write_text(text, "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "page"))
    parser.add_argument("inputs", nargs="*", metavar="NAME=CT_FOLDER")
    parser.add_argument("--peers-python", default="python3", help="Python with the packages of the peers")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--work", default=str(Path(tempfile.gettempdir()) / "clrecon-processes"))
    options = parser.parse_intermixed_args()
    write_pages() if options.what == "page" else run(options)


if __name__ == "__main__":
    main()
