"""The libraries that read NIfTI, NRRD and MetaImage, imported when a file needs them."""

from __future__ import annotations

from typing import Any

from clrecon.formats.grid_file import Purpose
from clrecon.system.packages import import_package

_PACKAGES = {"nrrd": "pynrrd"}


def import_extra(module: str, purpose: Purpose) -> Any:
    """Import `module`."""
    return import_package(module, f"this {purpose.noun}", _PACKAGES.get(module))
