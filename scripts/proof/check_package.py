#!/usr/bin/env python3
"""Build the source distribution and the wheel, and use the wheel in an environment of its own.

    python scripts/proof/check_package.py [FOLDER]

Needs `build` and `twine` of the extra release, and the package index.  A copy of the project is built as a stranger
would build it: the wheel comes from the source distribution.  That must hold every file of the project; the wheel must
run on every Python 3 and system; twine must find nothing in the metadata; and the installed command must write a
phantom and its mesh.  Both files go to FOLDER (default: dist).  The exit status is 1 if something is missing.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import venv
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PURE = "-py3-none-any.whl"
"""The end of the name of a wheel without compiled code."""


def listed_files() -> list[str]:
    """Return the files that git knows or would add."""
    asked = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(asked, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0")
    return [name for name in names if name and (ROOT / name).is_file()]


def missing_files(names: Iterable[str], archive: Path) -> list[str]:
    """Return those of `names` that a source distribution lacks."""
    with tarfile.open(archive) as opened:
        held = {name.partition("/")[2] for name in opened.getnames()}
    return sorted(set(names) - held)


def build(folder: Path) -> tuple[Path, Path]:
    """Build both files into `folder` from a copy of the project, and return them: no older build mixes with them."""
    with tempfile.TemporaryDirectory() as copy:
        for name in listed_files():
            target = Path(copy, name)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, target)
        subprocess.run([sys.executable, "-m", "build", "--outdir", str(folder), copy], check=True, stdout=2)
    newest = [max(folder.glob(f"clrecon-*{end}"), key=os.path.getmtime) for end in (".tar.gz", ".whl")]
    return newest[0], newest[1]


def use(wheel: Path, folder: Path) -> int:
    """Install `wheel` into an environment in `folder`, make a mesh there, and return its size in bytes."""
    venv.create(folder / "environment", with_pip=True)
    programs = folder / "environment" / ("Scripts" if os.name == "nt" else "bin")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for program, *arguments in (
        ["python", "-m", "pip", "install", "-q", str(wheel)],
        ["clrecon", "phantom", "scan"],
        ["clrecon", "mesh", "scan", "-o", "bone.stl"],
    ):
        subprocess.run([str(programs / program), *arguments], cwd=folder, env=environment, check=True)
    return (folder / "bone.stl").stat().st_size


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "dist")
    folder = parser.parse_args(argv).folder
    started = time.monotonic()
    source, wheel = build(folder.resolve())
    built = time.monotonic()
    for path in (source, wheel):
        print(f"{path.name}: {path.stat().st_size:,} bytes")
    faults = [f"{source.name} lacks {name}" for name in missing_files(listed_files(), source)]
    if not wheel.name.endswith(PURE):
        faults.append(f"{wheel.name} does not end with {PURE}")
    if subprocess.run([sys.executable, "-m", "twine", "check", "--strict", str(source), str(wheel)]).returncode:
        faults.append("twine finds faults in the metadata")
    with tempfile.TemporaryDirectory() as temporary:
        size = use(wheel, Path(temporary))
    print(f"the installed command wrote a mesh of {size:,} bytes")
    print(f"built in {built - started:.0f} s, installed and used in {time.monotonic() - built:.0f} s")
    for fault in faults:
        print(fault, file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
