"""The reader of a cloud file, found from its first bytes; its name is not trusted."""

from __future__ import annotations

import os
from pathlib import Path

from clrecon.errors import RefusedInputError, UsageError
from clrecon.exchange.clouds import las, npz, read_ply, read_vtp, xyz
from clrecon.exchange.clouds.raw_cloud import RawCloud
from clrecon.system.paths import open_regular
from clrecon.system.text import escape_text

_START_BYTES = 512


def read_raw_cloud(path: str | os.PathLike[str]) -> RawCloud:
    """Read a cloud file: PLY, VTP, NPZ, LAS, or a table of numbers."""
    file = Path(path)
    name = escape_text(file.name)
    try:
        with open_regular(file) as stream:
            start = stream.read(_START_BYTES)
    except FileNotFoundError as error:
        raise UsageError(f"there is no cloud {escape_text(str(path), 200)}") from error
    except OSError as error:
        raise RefusedInputError(f"{name} cannot be read: {error.strerror or error}") from error
    if start[:3] == b"ply" and start[3:4] in (b"\n", b"\r", b" "):
        return read_ply.read(file)
    if start[:4] in (b"PK\3\4", b"PK\5\6"):
        return npz.read(file)
    if start[:4] == b"LASF":
        return las.read(file)
    if b"<VTKFile" in start:
        return read_vtp.read(file)
    if b"\0" in start or not start.strip():
        raise RefusedInputError(f"{name} is no cloud that is read: PLY, VTP, NPZ, LAS or a table of numbers (XYZ)")
    return xyz.read(file)
