"""The libraries of the extra `labels`, imported when a file needs them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from clrecon.errors import UsageError

__all__ = ["import_extra"]


def import_extra(module: str) -> Any:
    """Import `module`.

    Raises
    ------
    UsageError
        It is not installed; the message says how to get it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise UsageError(
            f"this label map needs the package {'pynrrd' if module == 'nrrd' else module}:"
            " pip install 'clrecon[labels]'"
        ) from error
