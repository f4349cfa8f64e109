#!/usr/bin/env python3
"""Build the source distribution and the wheel, use the wheel in environments of its own, and test from the sources.

    python scripts/proof/check_package.py [FOLDER] [--tests PATH ...]

Needs `build` and `twine` of the extra release, and the package index.  A copy of the project is built as a stranger
would build it: the wheel comes from the source distribution.  That must hold every file of the project; the wheel must
run on every Python 3 and system; twine must find nothing in the metadata; and the installed command must write a
phantom and its mesh.  The small installation of docs/install.md must stay below its size and run its commands; it needs
an OpenCL driver of the system.  Tests must pass from the unpacked source distribution: those of PATH, by default guards
and quick ones.  Both files go to FOLDER (default: dist).  The exit status is 1 if something is missing.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tempfile
import time
import venv
from collections.abc import Iterable, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SMALL = ROOT / "scripts" / "package" / "small.txt"
SMALL_MB = 250
PURE = "-py3-none-any.whl"
"""The end of the name of a wheel without compiled code."""
COMMANDS = ("phantom scan --levels L2-L4 --size 96 --spacing 1.8 1.8 1.8", "mesh scan -o bone.stl")
SMALL_COMMANDS = (
    *COMMANDS,
    "info scan --pixels",
    "mesh scan -o cortex.vtp --surface cortex --smooth --decimate 0.5",
    "mesh scan -o print.3mf --for print",
    "mesh scan -o l3.stl --labels scan/levels.nrrd --label L3",
    "render scan -o bone.png --preset bone --letters --scale-bar",
    "cloud scan -o bone.npz --hu 200,3000 --cluster eps=2,min=6",
    "stats scan --labels scan/levels.nrrd --csv spine.csv",
    "distance bone.stl cortex.vtp --picture distance.png",
    "inside scan --labels scan/levels.nrrd --label L3 -o inside.ply",
    "corridor scan --labels scan/levels.nrrd --label L3",
    "vertebrae scan -o spine.nii.gz",
    "export scan -o scan.nii.gz",
    "view scan --html page.html",
    "batch scan -o many",
    "bench scan --runs 2",
    "compare scan -o report --hu 226 --repeat 1",
)
"""What an installation without VTK, pyvista, matplotlib and scikit-image runs."""
TESTS = ("tests/guards", "tests/geometry", "tests/exchange")


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


def size_mb(folder: Path) -> float:
    """Return the size of the files in a folder, in MB of 10^6 bytes."""
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir()) / 1e6


def use(installations: Iterable[Sequence[str]], commands: Iterable[str], folder: Path) -> tuple[float, float]:
    """Install by arguments of ``pip install`` into an environment in `folder`, and run commands of clrecon there.

    Returns its size in MB, without pip, before and after the commands: Python keeps modules that it has compiled.
    """
    venv.create(folder / "environment", with_pip=False)
    programs = folder / "environment" / ("Scripts" if os.name == "nt" else "bin")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def run(*command: str | Path) -> None:
        subprocess.run(command, cwd=folder, env=environment, check=True, stdout=2)

    for arguments in installations:
        run(sys.executable, "-m", "pip", "--python", programs / "python", "install", "-q", *arguments)
    before = size_mb(folder / "environment")
    for command in commands:
        run(programs / "clrecon", *command.split(), "-q")
    return before, size_mb(folder / "environment")


def pass_tests(archive: Path, paths: Sequence[str]) -> bool:
    """Tell whether tests pass from unpacked sources that are installed beside the packages of this environment."""
    with tempfile.TemporaryDirectory() as temporary:
        with tarfile.open(archive) as opened:
            opened.extractall(temporary)
        (folder,) = Path(temporary).iterdir()
        venv.create(Path(temporary, "environment"), with_pip=False)
        python = Path(temporary, "environment", "Scripts" if os.name == "nt" else "bin", "python")
        ask: list[str | Path] = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
        site = Path(subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip())
        # A folder named in a .pth file is searched, but the .pth files in it (an editable clrecon) are not read.
        (site / "packages.pth").write_text("\n".join({sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}))
        install: list[str | Path] = [sys.executable, "-m", "pip", "--python", python, "install", "-q", "--no-deps"]
        subprocess.run([*install, "--no-build-isolation", "--editable", folder], check=True, stdout=2)
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        environment["CLRECON_FAST_TESTS"] = "1"
        tests: list[str | Path] = [python, "-m", "pytest", "-q", "--assert=plain", "-p", "no:cacheprovider", *paths]
        return subprocess.run(tests, cwd=folder, env=environment).returncode == 0


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "dist")
    parser.add_argument("--tests", nargs="+", metavar="PATH", default=TESTS, help="tests to run from the sources")
    options = parser.parse_args(argv)
    started = time.monotonic()
    source, wheel = build(options.folder.resolve())
    print(f"built in {time.monotonic() - started:.0f} s")
    for path in (source, wheel):
        print(f"{path.name}: {path.stat().st_size:,} bytes")
    faults = [f"{source.name} lacks {name}" for name in missing_files(listed_files(), source)]
    if not wheel.name.endswith(PURE):
        faults.append(f"{wheel.name} does not end with {PURE}")
    if subprocess.run([sys.executable, "-m", "twine", "check", "--strict", str(source), str(wheel)]).returncode:
        faults.append("twine finds faults in the metadata")
    small = [["--no-compile", "-r", str(SMALL)], ["--no-compile", "--no-deps", str(wheel)]]
    for name, installations, commands in (("default", [[str(wheel)]], COMMANDS), ("small", small, SMALL_COMMANDS)):
        started = time.monotonic()
        with tempfile.TemporaryDirectory() as temporary:
            before, after = use(installations, commands, Path(temporary))
        seconds = time.monotonic() - started
        print(f"{name} installation: {before:.0f} MB, {after:.0f} MB after its commands; {seconds:.0f} s")
        if name == "small" and before > SMALL_MB:
            faults.append(f"the small installation has {before:.0f} MB, more than {SMALL_MB}")
    if not pass_tests(source, options.tests):
        faults.append("tests fail in the unpacked source distribution")
    for fault in faults:
        print(fault, file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
