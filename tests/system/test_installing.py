"""The command that messages name for a package that is missing."""

from __future__ import annotations

import configparser
import importlib.util
import shlex
import subprocess
import sys

import pytest
from house import PACKAGE, ROOT

from clrecon.system.packages import install_command


def test_command_of_installation_uses_the_pip_of_this_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/opt/a user/.venv/bin/python")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    assert install_command("nibabel", "pynrrd") == "'/opt/a user/.venv/bin/python' -m pip install nibabel pynrrd"


@pytest.mark.parametrize(
    ("uv", "command"),
    [
        pytest.param("/bin/uv", "uv pip install -p /venv/bin/python laspy", id="with uv"),
        pytest.param(None, "/venv/bin/python -m pip install laspy", id="without uv, pip says that it is missing"),
    ],
)
def test_command_of_installation_without_pip_is_that_of_uv_where_it_is_installed(
    uv: str | None, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/venv/bin/python")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("shutil.which", lambda name: uv)
    assert install_command("laspy") == command


def test_command_of_installation_is_understood_by_pip() -> None:
    """Without the index pip finds the package that is there already, in this environment."""
    if importlib.util.find_spec("pip") is None:
        pytest.skip("no pip in this environment")
    words = shlex.split(install_command("numpy"))
    done = subprocess.run([*words, "--no-index", "--dry-run"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "already satisfied: numpy" in done.stdout


def test_no_message_names_an_extra_of_clrecon() -> None:
    """An extra, as in clrecon[all], is found only where an index has clrecon, which a clone has not."""
    sources = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    assert PACKAGE / "system" / "packages.py" in sources
    assert [path for path, text in sources.items() if "clrecon[" in text] == []


@pytest.fixture(scope="module")
def requirements() -> set[str]:
    """The packages that are installed with clrecon."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    return {line.split()[0] for line in setup["options"]["install_requires"].splitlines() if line.strip()}


@pytest.mark.parametrize("package", ["nibabel", "pynrrd", "laspy"])
def test_small_reader_of_a_file_format_is_installed_with_clrecon(package: str, requirements: set[str]) -> None:
    assert package in requirements


@pytest.mark.parametrize("package", ["SimpleITK", "imageio-ffmpeg"])
def test_package_of_hundreds_of_megabytes_is_not_installed_with_clrecon(package: str, requirements: set[str]) -> None:
    assert package not in requirements
