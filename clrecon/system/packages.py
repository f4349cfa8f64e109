"""Packages that not every use of clrecon needs, imported where one is."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from clrecon.errors import UsageError
from clrecon.system.installing import install_command


def import_package(module: str, what: str, package: str | None = None) -> Any:
    """Import `module`.

    module: As Python imports it.
    what: What needs it, for the message.
    package: As it is installed, where that is another name.
    """
    try:
        return import_module(module)
    except ImportError as error:
        named = package or module
        raise UsageError(f"{what} needs the package {named}: {install_command(named)}") from error
