"""Deflate: by ISA-L where the package isal (extra `packing`) is installed, else by Python's own zlib."""

from __future__ import annotations

import zlib
from importlib import import_module
from typing import Any

_ISAL_LEVEL = 2
"""Level of ISA-L, of 0 to 3: 3MF is 6 % smaller than with level 1 of zlib, pages 4 % larger than with level 4."""

GZIP, RAW = 16 + zlib.MAX_WBITS, -zlib.MAX_WBITS
"""Forms of packed bytes, `wbits`: a file of gzip, and deflate alone."""


def find_deflate() -> Any:
    """Return the module to pack and unpack with: `zlib`, or that of isal, which has the same functions."""
    try:
        return import_module("isal.isal_zlib")
    except ImportError:
        return zlib


def start_packing(zlib_level: int, form: int) -> Any:
    """Return an object with the methods ``compress`` and ``flush``."""
    deflate = find_deflate()
    return deflate.compressobj(zlib_level if deflate is zlib else _ISAL_LEVEL, zlib.DEFLATED, form)
