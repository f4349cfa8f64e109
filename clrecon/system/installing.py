"""The command that installs a package into the environment that runs."""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys


def install_command(*packages: str) -> str:
    """Return a line for the shell that installs packages for this Python, wherever clrecon was installed from.

    A bare ``pip`` may belong to another Python, and an extra of clrecon can be named only where an index has clrecon.
    Environments without pip, as uv makes them, get uv's own command.

    *packages: Names as package indexes have them.
    """
    python = [sys.executable or "python3"]
    if importlib.util.find_spec("pip") is None and shutil.which("uv") is not None:
        words = ["uv", "pip", "install", "-p", *python, *packages]
    else:
        words = [*python, "-m", "pip", "install", *packages]
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)
