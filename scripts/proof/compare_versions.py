#!/usr/bin/env python3
"""Comparison of two checkouts of clrecon: the same commands are run with both, and all outputs compared byte for byte.

    python scripts/proof/compare_versions.py OLD NEW [CT ...] [--labels FILE [--vertebra L3]] [--device D]
                                             [--only TEXT] [--phantoms NAMES]

OLD and NEW are folders of the project: `git worktree add ../old COMMIT` makes such a folder.  Each runs with the
environment in its own `.venv-test` or `.venv`; a missing environment is made.  Three phantoms are compared (a spine, an
oblique skull with tilted slices, and three vertebrae with their label map), unless --phantoms names others or none, and
after them the series of each CT_FOLDER.

Exit codes, meshes, clouds, volumes, label maps, pages, pictures, reports and the text on the console are compared.  In
reports, the names in VOLATILE are ignored, such as times and the size of a process.  Left out are selftest, bench and
compare, whose figures are times, and demo, which is phantom, mesh and render.  The exit status is 0 when nothing
differs, and 1 with a line for each difference.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from _environment import find_python  # noqa: E402

VOLATILE = frozenset({"seconds", "kernel_seconds", "seconds_a_frame", "peak_memory_bytes", "version"})
"""Names in reports whose values differ between runs, or always differ between versions."""

PHANTOMS = {
    "spine": ["--kind", "spine", "--size", "128x128", "--slices", "60", "--spacing", "1.4", "1.4", "2.0"],
    "skull": [
        *("--kind", "skull", "--size", "112x96", "--slices", "70", "--spacing", "2.0", "2.2", "2.5"),
        *("--tilt", "9", "--oblique", "5", "-8", "20", "--table", "headrest"),
    ],
    "levels": ["--levels", "L2-L4", "--size", "128x96", "--spacing", "1.4", "1.4", "1.5", "--scoliosis", "6"],
}

LABEL_MAPS = ("levels.nrrd", "materials.nrrd")
"""Label maps that phantoms have beside them."""

COMMANDS = (
    *("mesh", "cloud", "inside", "render", "view", "export", "vertebrae", "corridor", "stats", "distance", "batch"),
    *("info", "devices", "phantom", "selftest", "bench", "compare", "demo", "completion", "help"),
)

MESHES = {
    "bone.stl": [],
    "auto.ply": ["--hu", "auto", "--space", "ras"],
    "topology.glb": ["--hu", "250", "--topology", "trilinear", "--open"],
    "two.obj": ["--hu", "180,400", "--memory", "24MB"],
    "range.vtp": ["--hu", "100:300"],
    "below.stl": ["--below", "-400", "--keep-largest", "2"],
    "body.3mf": ["--preset", "skin", "--remove-table", "--keep-largest", "1"],
    "kept.ply": ["--keep", "bone", "--min-volume", "0.5", "--split"],
    "refined.ply": ["--keep-largest", "1", "--smooth", "--decimate", "0.9", "--strict"],
    "print.3mf": ["--for", "print"],
    "wrong.xyz": [],
    "nothing.stl": ["--hu", "5000"],
}

LABEL_MESHES = {"labels.ply": [], "solid.ply": ["--solid"], "masks.ply": ["--surface", "mask"]}

CLOUDS = {
    "surface.ply": ["--normals"],
    "shell.npz": ["--points", "shell", "--hu", "250", "--remove-table"],
    "kept.xyz": ["--cluster", "eps=4,min=6", "--keep", "largest:2", "--space", "ras"],
    "voxels.las": ["--points", "voxels", "--denoise", "grid"],
}

VOLUMES = {
    "ct.nii.gz": [],
    "step.mha": ["--resample", "2", "--remove-table"],
    "part.nrrd": ["--filter", "bilateral", "--around", "0,-150,-300,40"],
}

OF_VERTEBRAE = {
    "corridor": [["-o", "line.ply", "--picture", "line.png"], ["--screw", "0,0,0,0,0,40,5"]],
    "inside": [["-o", "inside.stl", "--hu", "250"], ["-o", "dense.glb", "--dense", "350:900", "--picture", "part.png"]],
}

_SMALL = ["--size", "200x160"]
PICTURES = {
    "bone.png": [],
    "skin.png": ["--preset", "skin", "--view", "left", "--light", "left"],
    "mip.png": ["--mode", "mip", "--view", "30,20", "--values", "mip.npy"],
    "minip.png": ["--mode", "minip", "--clip-box", "-60,60,,,,"],
    "mean.png": ["--mode", "mean", "--perspective"],
    "drr.png": ["--preset", "x-ray"],
    "surface.png": ["--iso", "250", "--shadows", "--light", "left", "--depth", "depth.npy", "--memory", "24MB"],
    "slice.png": ["--mode", "slice", "--view", "axial", "--thickness", "6", "--combine", "max"],
    "slices.png": ["--mode", "slices", "--slices", "12"],
    "coloured.png": ["--mode", "slices", "--preset", "skin", "--slice-opacity", "0.3", "--light", "left"],
    "curve.png": ["--curve", "auto", "--cpr", "stretched", "--values", "cpr.npy"],
    "cue.png": ["--iso", "200", "--color", "orange", "--depth-cue", "0.4", "--light", "none", "--clip", "0,0,0,0,1,0"],
    "jitter.png": ["--preset", "muscle", "--jitter", "--ray-step", "1.5", "--light", "0.5,-1,1"],
    "letters.png": ["--letters", "--scale-bar", "--caption", "A caption", "--background", "white"],
    "turn.apng": ["--turntable", "turn.apng", "--frames", "3", "--size", "64x64"],
    "wrong.png": ["--mode", "mip", "--iso", "200"],
}


def main() -> int:
    options = _parse()
    with tempfile.TemporaryDirectory() as scratch:
        differences = list(_compare_all(options, Path(scratch)))
    for line in differences:
        print(line)
    print("no difference" if not differences else f"{len(differences)} differences")
    return 1 if differences else 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("inputs", type=Path, nargs="*", metavar="CT_FOLDER")
    parser.add_argument("--labels", type=Path, help="label map of the last CT_FOLDER")
    parser.add_argument("--device", default="0")
    parser.add_argument("--only", default="", help="only commands whose words hold this text")
    parser.add_argument("--vertebra", default="L3", help="name or number in FILE (default: %(default)s)")
    parser.add_argument("--phantoms", default=",".join(PHANTOMS), metavar="NAMES", help="comma list, may be empty")
    options = parser.parse_args()
    options.labels = options.labels and options.labels.absolute()
    return options


def _program(checkout: Path) -> list[str]:
    """Return the command that calls clrecon of a checkout."""
    python = find_python(checkout)
    if python is None:
        return [sys.executable, str((checkout / "scripts" / "run.py").resolve())]
    return [python, "-m", "clrecon"]


def _compare_all(options: argparse.Namespace, scratch: Path) -> Iterator[str]:
    old, new = _program(options.old), _program(options.new)
    inputs: dict[str, Path] = {}
    for name in filter(None, options.phantoms.split(",")):
        inputs[name] = scratch / name
        for program, folder in ((old, scratch / f"{name}.old"), (new, inputs[name])):
            subprocess.run([*program, "phantom", str(folder), *PHANTOMS[name], "-q"], check=True)
        yield from (f"phantom {name}: {line}" for line in _compare_folders(scratch / f"{name}.old", inputs[name]))
    inputs.update((folder.name, folder.absolute()) for folder in options.inputs)
    for name, folder in [("none", scratch), *inputs.items()]:
        labels = next((path for path in (folder / file for file in LABEL_MAPS) if path.exists()), None)
        if options.labels is not None and options.inputs and folder.name == options.inputs[-1].name:
            labels = options.labels
        vertebra = options.vertebra if labels == options.labels else "L3"
        given = (folder, labels, vertebra, options.device)
        commands = list(_commands_alone()) if name == "none" else list(_commands(*given))
        if name != "none":
            commands.append(
                _distance_of([scratch / f"new-{name}-{number}" for number in range(len(commands))], commands)
            )
        for number, command in enumerate(commands):
            if options.only not in " ".join(command):
                continue
            pair = [scratch / f"{side}-{name}-{number}" for side in ("old", "new")]
            texts = [_run([*program, *command], place) for program, place in zip((old, new), pair, strict=True)]
            shown = " ".join(command).replace(str(folder), name)
            found = [*_differing_lines(*texts), *_compare_folders(*pair)]
            print(f"{'differs' if found else 'equal'}  {shown}", file=sys.stderr, flush=True)
            yield from (f"{shown}: {line}" for line in found)


def _commands_alone() -> Iterator[list[str]]:
    yield ["--version"]
    yield ["help"]
    yield from (["help", command] for command in COMMANDS)
    yield from (["completion", shell] for shell in ("bash", "zsh", "fish"))
    yield ["devices", "--json"]


def _commands(folder: Path, labels: Path | None, vertebra: str, device: str) -> Iterator[list[str]]:
    yield ["info", str(folder), "--pixels", "--json"]
    yield ["info", str(folder), "--strict"]
    for name, arguments in CLOUDS.items():
        yield ["cloud", str(folder), "-o", name, *arguments, "--device", device, "--report", f"{name}.json"]
    for name, arguments in VOLUMES.items():
        yield ["export", str(folder), "-o", name, *arguments, "--device", device]
    yield ["view", str(folder), "--html", "page.html", "--hu", "250", "--keep-largest", "3", "--device", device]
    yield ["vertebrae", str(folder), "-o", "spine.nii.gz", "--picture", "spine.png", "--report", "spine.json"]
    if labels is not None:
        own = ["--labels", str(labels)]
        yield ["stats", str(folder), *own, "--csv", "stats.csv", "--report", "stats.json"]
        yield ["cloud", str(folder), "-o", "labels.ply", *own, "--device", device, "--report", "labels.json"]
        own += ["--label", vertebra]
        for command, ways in OF_VERTEBRAE.items():
            for way in ways:
                yield [command, str(folder), *own, *way, "--device", device, "--report", "report.json"]
    for name, arguments in MESHES.items():
        yield ["mesh", str(folder), "-o", name, *arguments, "--device", device, "--report", f"{name}.json"]
    for name, arguments in LABEL_MESHES.items() if labels is not None else ():
        own = ["--labels", str(labels), *arguments]
        yield ["mesh", str(folder), "-o", name, *own, "--device", device, "--report", f"{name}.json"]
    for name, arguments in PICTURES.items():
        picture = [] if "--turntable" in arguments else ["-o", name]
        size = [] if "--size" in arguments else _SMALL
        yield ["render", str(folder), *picture, *arguments, *size, "--device", device, "--report", f"{name}.json"]
    if labels is not None:
        own = ["-o", "labels.png", "--labels", str(labels), *_SMALL]
        yield ["render", str(folder), *own, "--device", device, "--report", "labels.png.json"]


def _distance_of(folders: list[Path], commands: list[list[str]]) -> list[str]:
    """Return the command that measures one mesh of `commands` against another."""
    pair = [
        str(next(folder for folder, command in zip(folders, commands, strict=True) if name in command) / name)
        for name in ("bone.stl", "auto.ply")
    ]
    return ["distance", *pair, "-o", "apart.ply", "--picture", "apart.png", "--report", "apart.json"]


def _run(command: list[str], folder: Path) -> tuple[int, str, str]:
    """Run a command in `folder`; returns its exit code, stdout and stderr without times and progress.

    Each side keeps its own kernels: PoCL builds those of another environment anew, which reports would tell.
    """
    folder.mkdir()
    cache = str(folder.with_name(f"{folder.name.partition('-')[0]}-cache"))
    kept = {**os.environ, "XDG_CACHE_HOME": cache, "POCL_CACHE_DIR": os.path.join(cache, "pocl")}
    done = subprocess.run(command, cwd=folder, env=kept, capture_output=True, text=True, errors="replace")
    return done.returncode, _still(done.stdout), _still(done.stderr)


def _still(text: str) -> str:
    """Return `text` without the line of times, the times of a frame and of a step, and the lines of progress."""
    text = re.sub(r"(?m)^time +\d.*\n", "", re.sub(r"[^\n]*\r", "", text))
    return re.sub(r"\b[\d.]+ s each\b", "N s each", re.sub(r"(?m), [\d.]+ s$", ", N s", text))


def _differing_lines(old: tuple[int, str, str], new: tuple[int, str, str]) -> Iterator[str]:
    """Return what differs of exit code, stdout and stderr: lines that went with a minus, others with a plus."""
    if old[0] != new[0]:
        yield f"exit code {old[0]} became {new[0]}"
    for a, b in zip(old[1:], new[1:], strict=True):
        compared = difflib.unified_diff(a.splitlines(), b.splitlines(), n=0, lineterm="")
        yield from (line for line in list(compared)[2:] if not line.startswith("@@"))


def _compare_folders(old: Path, new: Path) -> list[str]:
    """Return a line for each file that differs between the two folders."""
    names = [{path.relative_to(top).as_posix() for path in top.rglob("*") if path.is_file()} for top in (old, new)]
    found = [f"{name} is written by one side only" for name in sorted(names[0] ^ names[1])]
    for name in sorted(names[0] & names[1]):
        before, after = (old / name).read_bytes(), (new / name).read_bytes()
        if before == after:
            continue
        if name.endswith(".json"):
            found += [f"{name}: {line}" for line in differing_names(json.loads(before), json.loads(after))]
        else:
            first = next((i for i, (a, b) in enumerate(zip(before, after, strict=False)) if a != b), None)
            found.append(f"{name}: {len(before)} and {len(after)} bytes, first difference at {first}")
    return found


def differing_names(old: Any, new: Any, name: str = "") -> Iterator[str]:
    """Return the names of a report whose values differ, with both values, except those in VOLATILE."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            if key not in VOLATILE:
                yield from differing_names(old.get(key, "absent"), new.get(key, "absent"), f"{name}.{key}".lstrip("."))
        if list(old) != list(new) and set(old) == set(new):
            yield f"{name or 'report'}: another order of names"
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for number, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from differing_names(a, b, f"{name}[{number}]")
    elif old != new:
        yield f"{name}: {old!r} became {new!r}"


if __name__ == "__main__":
    sys.exit(main())
