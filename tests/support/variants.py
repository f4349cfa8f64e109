"""Parameters of tests that are variants of a kernel: which are built on every device, and which on the first alone."""

from __future__ import annotations

import pytest

VOXEL_TYPES = [
    "int16",
    "float32",
    *(pytest.param(name, marks=pytest.mark.first_device) for name in ("int8", "uint8", "uint16", "int32")),
]
"""In a test for every device, those of scans and of computed volumes are built on each: a build takes seconds."""
