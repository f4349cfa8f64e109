"""The libraries that read NIfTI, NRRD and MetaImage, imported when a file needs them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from clrecon.errors import UsageError
from clrecon.formats.grid_file import Purpose
from clrecon.system.installing import install_command

__all__ = ["import_extra"]

_PACKAGES = {"nrrd": "pynrrd"}


def import_extra(module: str, purpose: Purpose) -> Any:
    """Import `module`.

    Raises
    ------
    UsageError
        It is not installed; the message says how to install it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = _PACKAGES.get(module, module)
        raise UsageError(f"this {purpose.noun} needs the package {package}: {install_command(package)}") from error
