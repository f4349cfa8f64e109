"""Parameters of tests that are variants of a kernel: which are built on every device, and which on the first alone."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def all_but(names: Iterable[str], *on_first: str) -> list[Any]:
    """The names as parameters; those of `on_first` are for the first device alone."""
    return [pytest.param(name, marks=pytest.mark.first_device) if name in on_first else name for name in names]


VOXEL_TYPES = all_but(("int8", "uint8", "int16", "uint16", "int32", "float32"), "int8", "uint8", "uint16", "int32")
"""Those of scans and of computed volumes are built on every device: each is a build of seconds."""
