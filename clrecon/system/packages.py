"""What is imported by name when it is needed: packages that not every use needs, and public functions further right.

`Volume.save` is `clrecon.write_volume`, and the writers of files know volumes: an import in the class would lead round
a corner.  The list of the public names, `clrecon/__init__.pyi`, knows where both are.  The guard of the layers lists
the modules that call this one."""

from __future__ import annotations

import importlib.util
import os
import sys
from importlib import import_module
from typing import Any

from clrecon.errors import UsageError

_UNUSED = ("requests", "PIL", "attrs")
"""What pydicom and pytools import where it is installed, and reading and devices do not need."""


def hide_unused() -> None:
    """Hide modules by None in `sys.modules`, in a process of our own, until `show_unused`."""
    for name in _UNUSED:
        sys.modules.setdefault(name, None)  # type: ignore[arg-type]


def show_unused() -> None:
    """Let the modules be imported that `hide_unused` hides: other packages than pydicom need them."""
    for name in _UNUSED:
        if sys.modules.get(name, name) is None:
            del sys.modules[name]


_INSTALLED_AS = {"nrrd": "pynrrd", "skimage": "scikit-image", "vtkmodules": "vtk"}
"""Packages by their modules, where the names differ."""


def package_of(module: str) -> str:
    """Return the name by which the package of a module is installed."""
    top = module.partition(".")[0]
    return _INSTALLED_AS.get(top, top)


def is_installed(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def import_package(module: str, subject: str) -> Any:
    """Import a module that `subject` needs; without its package the message says how to install that."""
    show_unused()
    try:
        return import_module(module)
    except ImportError as error:
        raise missing_package(module, subject) from error


def missing_package(module: str, subject: str) -> UsageError:
    """Return the error of what needs a module that is not installed."""
    package = package_of(module)
    return UsageError(f"{subject} needs the package {package}: {install_command(package)}")


def install_command(*packages: str) -> str:
    """Return a line for the shell that installs packages, by their names in indexes, for this Python.

    A bare ``pip`` may belong to another Python, and an extra of clrecon can be named only where an index has clrecon.
    Environments without pip, as uv makes them, get uv's own command.
    """
    import shlex
    import shutil
    import subprocess

    python = [sys.executable or "python3"]
    if importlib.util.find_spec("pip") is None and shutil.which("uv") is not None:
        words = ["uv", "pip", "install", "-p", *python, *packages]
    else:
        words = [*python, "-m", "pip", "install", *packages]
    return subprocess.list2cmdline(words) if os.name == "nt" else shlex.join(words)


def public_function(name: str) -> Any:
    """Return a public function, ``clrecon.NAME``; its module is imported when it is first asked for."""
    return getattr(sys.modules["clrecon"], name)


class ShownAsHtml:
    """Base of classes that a notebook shows as HTML, where ``clrecon.to_html`` makes some of the object."""

    def _repr_html_(self) -> str | None:
        html: str | None = public_function("to_html")(self)
        return html
