"""The libraries of the extras `labels` and `volumes`, imported when a file needs them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from clrecon.errors import UsageError
from clrecon.formats.grid_file import Purpose

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
        extra = "volumes" if module == "SimpleITK" else purpose.extra
        raise UsageError(
            f"this {purpose.noun} needs the package {_PACKAGES.get(module, module)}: pip install 'clrecon[{extra}]'"
        ) from error
