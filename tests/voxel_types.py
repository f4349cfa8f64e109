"""Element types of voxels as parameters of tests."""

from __future__ import annotations

import pytest

VOXEL_TYPES = [
    "int16",
    "float32",
    *(pytest.param(name, marks=pytest.mark.first_device) for name in ("int8", "uint8", "uint16", "int32")),
]
"""Those of scans and of computed volumes on every device, the others on one: each is a build of seconds."""
