"""Cloud files: the writers, chosen by the extension of the file.

PLY and VTP are written as those of meshes are, XYZ, NPZ and LAS by the modules beside this one.  The same cloud gives
the same bytes every time, and no file holds patient data, a date or a path.
"""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from typing import Protocol

from clrecon.errors import NoSurfaceError
from clrecon.exchange import ply, vtp
from clrecon.exchange.clouds import las, npz, xyz
from clrecon.exchange.content import PointContent
from clrecon.exchange.file_format import NO_LIMIT, FileFormat, find_extension, stage_content
from clrecon.system.files import StagedFile

CLOUD_FORMATS: dict[str, FileFormat[PointContent]] = {
    ".ply": FileFormat(ply.estimate, ply.write, ply.verify, NO_LIMIT),
    ".vtp": FileFormat(vtp.estimate, vtp.write, vtp.verify, NO_LIMIT),
    ".npz": FileFormat(npz.estimate, npz.write, npz.verify, NO_LIMIT),
    ".xyz": FileFormat(xyz.estimate, xyz.write, xyz.verify, NO_LIMIT),
    ".las": FileFormat(las.estimate, las.write, las.verify, NO_LIMIT),
}

_KEPT = {".xyz": ("hu",), ".npz": ("normals", "hu", "labels", "ijk")}
_KEPT_BY_OTHERS = ("normals", "hu", "labels")


class WritableCloud(Protocol):
    """Protocol of an object that can be written: a `PointCloud`."""

    def __len__(self) -> int: ...
    def describe(self, space: str, *, keep_ids: bool = False, with_ijk: bool = True) -> PointContent: ...


def check_cloud_format(path: str | os.PathLike[str]) -> str:
    """Return the extension of a cloud file in lower case, such as ``.ply``."""
    extension = find_extension(path, CLOUD_FORMATS, "cloud")
    if extension == ".las":
        las.import_laspy()
    return extension


def describe_cloud_losses(content: PointContent, extension: str) -> list[str]:
    """Return a line for what the cloud knows of its points and a file with this extension has no place for."""
    names = {"normals": "normals", "hu": "HU", "labels": "labels"}  # voxel indices are for the steps of this program
    lost = [
        word
        for name, word in names.items()
        if getattr(content, name) is not None and name not in _KEPT.get(extension, _KEPT_BY_OTHERS)
    ]
    if not lost:
        return []
    return [f"{extension[1:].upper()} has no place for {' and '.join(lost)}: PLY, VTP, NPZ and LAS have"]


def write_cloud(
    cloud: WritableCloud, path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False
) -> int:
    """Write a cloud to a file; what `PointCloud.save` does.

    Returns: Size of the file in bytes.
    """
    with stage_cloud(cloud, path, space, keep_ids=keep_ids) as staged:
        staged.commit()
    return staged.size


def stage_cloud(
    cloud: WritableCloud, path: str | os.PathLike[str], space: str = "lps", *, keep_ids: bool = False
) -> AbstractContextManager[StagedFile]:
    """Write a cloud under a temporary name, to be committed with other files; see `clrecon.system.files.stage_file`."""
    extension = check_cloud_format(path)
    has_place = "ijk" in _KEPT.get(extension, _KEPT_BY_OTHERS)
    content = cloud.describe(space, keep_ids=keep_ids, with_ijk=has_place)
    if len(cloud) == 0:
        raise NoSurfaceError(f"the cloud is empty: no {extension[1:].upper()} file is written")
    return stage_content(content, path, CLOUD_FORMATS[extension], f"{len(cloud):,} points", "PLY or VTP")
