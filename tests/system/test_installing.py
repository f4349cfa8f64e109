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


def test_the_command_is_of_this_python(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/opt/a user/.venv/bin/python")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name)
    assert install_command("nibabel", "pynrrd") == "'/opt/a user/.venv/bin/python' -m pip install nibabel pynrrd"


def test_an_environment_without_pip_gets_the_command_of_uv(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/venv/bin/python")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr("shutil.which", lambda name: f"/bin/{name}")
    assert install_command("laspy") == "uv pip install -p /venv/bin/python laspy"
    monkeypatch.setattr("shutil.which", lambda name: None)
    assert install_command("laspy") == "/venv/bin/python -m pip install laspy"  # pip says that it is missing


def test_the_command_is_understood() -> None:
    """Without the index it finds the package that is there already, in this environment."""
    if importlib.util.find_spec("pip") is None:
        pytest.skip("no pip in this environment")
    words = shlex.split(install_command("numpy"))
    done = subprocess.run([*words, "--no-index", "--dry-run"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "already satisfied: numpy" in done.stdout


def test_no_message_names_an_extra_of_clrecon() -> None:
    """An extra is found only where an index has clrecon, which a clone has not."""
    named = [path.name for path in PACKAGE.rglob("*.py") if "clrecon[" in path.read_text(encoding="utf-8")]
    assert named == []


def test_small_readers_come_with_clrecon() -> None:
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg", encoding="utf-8")
    needed = {line.split()[0] for line in setup["options"]["install_requires"].splitlines() if line.strip()}
    assert {"nibabel", "pynrrd", "laspy"} <= needed
    assert not {"SimpleITK", "imageio-ffmpeg"} & needed  # hundreds of megabytes
