"""Packages and kernel files that setup.cfg lists are those that exist, and the wheel works away from its sources."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from collections.abc import Callable
from fnmatch import fnmatch
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


def test_packages_of_setup_cfg_are_the_packages_that_exist() -> None:
    assert listed_packages() == present_packages()


def test_every_folder_of_modules_is_a_package() -> None:
    folders = {path.parent for path in package_modules().values()}
    assert [folder.name for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_patterns_of_package_data_match_all_kernel_files_and_no_others() -> None:
    patterns = [part.strip() for part in read_setup()["options.package_data"]["clrecon.cl"].split(",")]
    folder = ROOT / "cl"
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.suffix in KERNEL_SUFFIXES}
    assert "include/volume.h" in present
    assert matched_files(folder, patterns) == present


def test_folder_of_kernels_has_no_other_files_but_its_init() -> None:
    names = [path.name for path in project_files() if path.is_relative_to(ROOT / "cl")]
    assert [name for name in names if not name.endswith(KERNEL_SUFFIXES)] == ["__init__.py"]


def test_init_of_the_folder_of_kernels_is_a_docstring_of_one_line() -> None:
    [line] = (ROOT / "cl" / "__init__.py").read_text().splitlines()
    assert line.startswith('"""')


@pytest.mark.parametrize(
    ("patterns", "matched"),
    [(["**/*.cl", "**/*.h"], {"top.cl", "theme/a.cl", "theme/b.h"}), (["*.cl"], {"top.cl"})],
    ids=["two suffixes in all folders", "one suffix in the top folder"],
)
def test_files_that_patterns_of_package_data_match_are_found(
    patterns: list[str], matched: set[str], tmp_path: Path
) -> None:
    (tmp_path / "theme").mkdir()
    for name in ("top.cl", "theme/a.cl", "theme/b.h", "theme/c.clh"):
        (tmp_path / name).write_text("")
    assert matched_files(tmp_path, patterns) == matched


def test_source_distribution_takes_every_file_of_the_project() -> None:
    lines = [line.split() for line in (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()]
    folders = {name for word, *names in lines if word == "graft" for name in names} | {"clrecon"}
    patterns = [name for word, *names in lines if word == "include" for name in names]
    by_setuptools = {"LICENSE", "MANIFEST.in", "pyproject.toml", "setup.cfg", "PKG-INFO"}
    left_out = {
        name
        for path in project_files()
        if (name := path.relative_to(ROOT).parts[0]) not in folders | by_setuptools
        and not any(fnmatch(name, pattern) for pattern in patterns)
    }
    assert left_out == set()


def test_pocl_is_required_on_linux_for_x86_64_and_pyopencl_alone_on_every_other_system() -> None:
    lines = read_setup()["options"]["install_requires"].splitlines()
    requirements = [line.partition(";") for line in lines if line.startswith("pyopencl")]
    markers = {requirement.split()[0]: marker.strip() for requirement, _, marker in requirements}
    assert markers["pyopencl[pocl]"] == 'platform_system == "Linux" and platform_machine == "x86_64"'
    assert markers["pyopencl"] == 'platform_system != "Linux" or platform_machine != "x86_64"'


PACKAGES = ROOT / "scripts" / "package"


def test_container_copies_only_files_and_folders_that_exist() -> None:
    lines = [line.split() for line in (PACKAGES / "Containerfile").read_text(encoding="utf-8").splitlines()]
    copied = [name for line in lines if line[:1] == ["COPY"] and "--from=build" not in line for name in line[1:-1]]
    assert "clrecon" in copied
    assert [name for name in copied if not (ROOT / name).exists()] == []


def test_conda_recipe_requires_what_setup_cfg_does_and_a_driver() -> None:
    lines = read_setup()["options"]["install_requires"].splitlines()
    stated = [line.partition(";")[0].replace("[pocl]", "").split() for line in lines if ">=" in line]
    recipe = (PACKAGES / "recipe.yaml").read_text(encoding="utf-8").partition("  run:\n")[2].partition("\n\n")[0]
    required = re.findall(r"^    - (.+)$", recipe, re.MULTILINE)
    named = {"isal": "python-isal"}  # that of conda-forge
    expected = {f"{named.get(name, name)} >={version}" for name, _, version in stated}
    assert set(required) == expected | {"python >=3.10", "pocl"}


def test_list_without_vtk_is_what_setup_cfg_requires_but_for_vtk_pyvista_and_matplotlib() -> None:
    required = read_setup()["options"]["install_requires"].splitlines()
    left_out = ("vtk ", "pyvista ", "matplotlib ")
    expected = [line for line in required if line and not line.startswith(("#", *left_out))]
    assert len(expected) == len([line for line in required if line and line[0] != "#"]) - len(left_out)
    listed = (PACKAGES / "without-vtk.txt").read_text(encoding="utf-8").splitlines()
    assert [line for line in listed if line[0] != "#"] == expected


def test_list_of_the_small_installation_is_that_without_vtk_but_for_its_driver_two_codecs_and_scikit_image() -> None:
    def stated(name: str) -> list[str]:
        return [line for line in (PACKAGES / name).read_text(encoding="utf-8").splitlines() if line[0] != "#"]

    left_out = ("imagecodecs ", "pyjpegls ", "scikit-image ", "pyopencl")
    kept = [line for line in stated("without-vtk.txt") if not line.startswith(left_out)]
    assert [*kept, "pyopencl >= 2024.2"] == stated("small.txt")


def test_version_of_the_conda_recipe_is_that_of_setup_cfg() -> None:
    recipe = (PACKAGES / "recipe.yaml").read_text(encoding="utf-8")
    assert f'version: "{read_setup()["metadata"]["version"]}"' in recipe


CITATION = (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize(
    ("entry", "key"), [("version", "version"), ("license", "license"), ("abstract", "description")]
)
def test_entry_of_the_citation_is_that_of_setup_cfg(entry: str, key: str) -> None:
    cited = dict(line.split(": ", 1) for line in CITATION if ": " in line and not line.startswith(" "))
    assert cited[entry].rstrip(".") == read_setup()["metadata"][key]


def test_keywords_of_the_citation_are_those_of_setup_cfg() -> None:
    cited = [line.removeprefix("  - ") for line in CITATION if line.startswith("  - ") and "name" not in line]
    assert cited == [word.strip() for word in read_setup()["metadata"]["keywords"].split(",")]


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


# Every day packages and kernel files are listed, and public names are found.
for_a_release = pytest.mark.release


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this project."""
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def scripts(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of an environment into which the wheel is installed."""
    return install_alone(wheel, tmp_path_factory.mktemp("installed") / "environment")


@pytest.fixture
def run_installed(scripts: Path, tmp_path: Path) -> Callable[..., str]:
    """Runs a program of that environment in an empty folder, and returns what it prints."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def run(program: str, *arguments: str) -> str:
        command = [str(scripts / program), *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return run


KERNELS = {path.relative_to(ROOT).as_posix() for path in project_files(*KERNEL_SUFFIXES)}
"""cl/surface/triangles.h, for example."""


@for_a_release
def test_wheel_has_all_kernels_and_types_and_no_tests_or_scripts(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert KERNELS
    assert {f"clrecon/{name}" for name in KERNELS} <= names
    assert {"clrecon/py.typed", "clrecon/__init__.pyi"} <= names
    assert not any(name.startswith(("tests/", "scripts/", "cl/")) for name in names)


@for_a_release
def test_installed_wheel_is_imported_from_its_environment(run_installed: Callable[..., str], scripts: Path) -> None:
    files = run_installed("python", "-c", "import clrecon, clrecon.cl; print(clrecon.__file__, clrecon.cl.__file__)")
    environment = scripts.parent
    assert [Path(file).is_relative_to(environment) for file in files.split()] == [True, True]


@for_a_release
def test_installed_wheel_finds_its_kernel_files(run_installed: Callable[..., str]) -> None:
    code = "from clrecon.opencl.sources import kernel_files; print(*kernel_files())"
    expected = sorted(name.removeprefix("cl/") for name in KERNELS if name.endswith(".cl"))
    assert run_installed("python", "-c", code).split() == expected


@for_a_release
def test_installed_command_has_the_version_of_setup_cfg(run_installed: Callable[..., str]) -> None:
    assert run_installed("clrecon", "--version").split()[-1] == read_setup()["metadata"]["version"]


@for_a_release
def test_installed_wheel_passes_the_first_checks_of_its_selftest(run_installed: Callable[..., str]) -> None:
    if run_installed("python", "-c", "import clrecon; print(len(clrecon.devices()))").strip() == "0":
        pytest.skip("no OpenCL device found")
    assert run_installed("python", "-c", SELFTEST)
