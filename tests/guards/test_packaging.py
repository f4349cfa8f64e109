"""What setup.cfg lists is what is there: packages, kernel files, and a wheel that works away from its sources."""

from __future__ import annotations

import configparser
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
from house import ROOT, package_modules, project_files

KERNEL_SUFFIXES = (".cl", ".h")


def read_setup() -> configparser.ConfigParser:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    return setup


def listed_packages() -> set[str]:
    lines = read_setup()["options"]["packages"].split("\n")
    return {line.strip() for line in lines if line.strip() and not line.startswith("#")}


def present_packages() -> set[str]:
    packages = {name for name, path in package_modules().items() if path.name == "__init__.py"}
    return packages | {"clrecon.cl"}


def matched_files(folder: Path, patterns: list[str]) -> set[str]:
    return {path.relative_to(folder).as_posix() for pattern in patterns for path in folder.glob(pattern)}


def test_listed_packages_are_the_packages_present() -> None:
    assert listed_packages() == present_packages()


def test_every_folder_of_modules_is_a_package() -> None:
    folders = {path.parent for path in package_modules().values()}
    assert [folder.name for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_kernel_files_are_matched_by_package_data() -> None:
    patterns = [part.strip() for part in read_setup()["options.package_data"]["clrecon.cl"].split(",")]
    folder = ROOT / "cl"
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.suffix in KERNEL_SUFFIXES}
    assert "include/volume.h" in present
    assert matched_files(folder, patterns) == present


def test_cl_holds_kernels_and_nothing_else() -> None:
    others = [path.name for path in project_files() if path.is_relative_to(ROOT / "cl")]
    assert [name for name in others if not name.endswith(KERNEL_SUFFIXES)] == ["__init__.py"]
    statements = [line for line in (ROOT / "cl" / "__init__.py").read_text().splitlines() if line.strip()]
    assert len(statements) == 1 and statements[0].startswith('"""')


def test_a_file_that_no_pattern_matches_is_found(tmp_path: Path) -> None:
    (tmp_path / "theme").mkdir()
    for name in ("top.cl", "theme/a.cl", "theme/b.h", "theme/c.clh"):
        (tmp_path / name).write_text("")
    assert matched_files(tmp_path, ["**/*.cl", "**/*.h"]) == {"top.cl", "theme/a.cl", "theme/b.h"}
    assert matched_files(tmp_path, ["*.cl"]) == {"top.cl"}


def test_dependencies_resolve_on_every_system() -> None:
    lines = read_setup()["options"]["install_requires"].splitlines()
    markers = {
        line.partition(";")[0].split()[0]: line.partition(";")[2].strip() for line in lines if line[:8] == "pyopencl"
    }
    linux = 'platform_system == "Linux" and platform_machine == "x86_64"'
    assert markers["pyopencl[pocl]"] == linux
    assert markers["pyopencl"] == linux.replace("==", "!=").replace(" and ", " or ")


def test_the_citation_is_of_this_version() -> None:
    setup = read_setup()["metadata"]
    lines = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()
    cited = dict(line.split(": ", 1) for line in lines if ": " in line and not line.startswith(" "))
    names = ("version", "license", "abstract")
    assert [cited[name].rstrip(".") for name in names] == [setup[name] for name in (*names[:2], "description")]
    assert [line[4:] for line in lines if line.startswith("  - ") and "name" not in line] == [
        word.strip() for word in setup["keywords"].split(",")
    ]


def build_wheel(tmp_path: Path) -> Path:
    """Build the wheel from a copy of the sources, without network."""
    source = tmp_path / "source"
    for path in project_files():
        target = source / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, target)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--wheel-dir", str(tmp_path / "wheels"), str(source)], check=True)
    (wheel,) = (tmp_path / "wheels").glob("clrecon-*.whl")
    return wheel


def install_alone(wheel: Path, folder: Path) -> Path:
    """Install `wheel` into an environment that has the dependencies of this one, but not this clrecon."""
    venv.create(folder, with_pip=False)
    scripts = folder / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / ("python.exe" if os.name == "nt" else "python")
    ask = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(subprocess.run([python, "-c", ask], check=True, capture_output=True, text=True).stdout.strip())
    # A folder named in a .pth file is searched, but the .pth files in it (an editable clrecon) are not read.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n" + sysconfig.get_path("platlib") + "\n")
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "-q", "--no-deps", "--no-index"]
    subprocess.run([*pip, "--force-reinstall", "--no-warn-script-location", str(wheel)], check=True)
    return scripts


SELFTEST = """
import sys
from clrecon.cli.main import main
from clrecon.proof import run
run.CHECKS = run.CHECKS[:5]  # a program is found, or it is not
sys.exit(main(["selftest"]))
"""


@pytest.mark.release  # every day: packages and kernel files are listed, and public names are found
def test_the_wheel_works_from_another_folder(tmp_path: Path) -> None:
    wheel = build_wheel(tmp_path)
    names = set(zipfile.ZipFile(wheel).namelist())
    kernels = {f"clrecon/{path.relative_to(ROOT).as_posix()}" for path in project_files(".cl", ".h")}
    assert kernels and kernels <= names
    assert {"clrecon/py.typed", "clrecon/__init__.pyi"} <= set(names)
    assert not any(name.startswith(("tests/", "scripts/", "cl/")) for name in names)

    scripts = install_alone(wheel, tmp_path / "environment")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def run(*command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(scripts / command[0]), *command[1:]], cwd=elsewhere, env=environment, capture_output=True, text=True
        )

    where = run("python", "-c", "import clrecon, clrecon.cl; print(clrecon.__file__); print(clrecon.cl.__file__)")
    assert where.returncode == 0, where.stderr
    assert all(Path(line).is_relative_to(tmp_path) for line in where.stdout.split("\n") if line)
    sources = run("python", "-c", "from clrecon.opencl.sources import kernel_files; print(*kernel_files())")
    assert sources.stdout.split() == sorted(name[len("clrecon/cl/") :] for name in kernels if name.endswith(".cl"))
    assert run("clrecon", "--version").stdout.split()[-1] == read_setup()["metadata"]["version"]

    selftest = run("python", "-c", SELFTEST)
    no_device = run("python", "-c", "import clrecon; print(len(clrecon.devices()))").stdout.strip() == "0"
    assert selftest.returncode == (5 if no_device else 0), selftest.stdout + selftest.stderr
