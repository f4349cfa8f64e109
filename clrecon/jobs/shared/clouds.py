"""Inputs that are clouds of points, told by the extension of their files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs.shared.settings import InputSettings
from clrecon.system.arguments import name_parameter

if TYPE_CHECKING:
    from clrecon.points import PointCloud

CLOUD_INPUTS = (".ply", ".vtp", ".npz", ".xyz", ".las", ".csv", ".txt")
"""Extensions of files that are read as clouds, see `clrecon.read_points`."""

MESH_INPUTS = (".stl", ".ply", ".obj", ".glb", ".3mf", ".vtp")
"""Extensions of files that are read as meshes, see `clrecon.read_mesh`."""

MESH_ONLY = tuple(extension for extension in MESH_INPUTS if extension not in CLOUD_INPUTS)
"""Those of them that are not read as clouds."""

OTHER_CLOUDS = (".pcd", ".e57", ".laz", ".pts", ".ptx", ".asc")
"""Extensions of clouds that are not read."""

_OF_BOTH = ("keep_ids", "device", "memory")
"""Settings of the input that clouds have too."""


def is_cloud_file(source: str | Path) -> bool:
    """True for a file, or the name of one, whose extension is that of a cloud; folders are scans."""
    return os.path.splitext(os.fspath(source))[1].lower() in CLOUD_INPUTS and not os.path.isdir(source)


def is_mesh_file(source: str | Path) -> bool:
    """True for a file, or the name of one, whose extension only meshes have; that of PLY is one of clouds too."""
    return os.path.splitext(os.fspath(source))[1].lower() in MESH_ONLY and not os.path.isdir(source)


def refuse_other_clouds(source: str | Path) -> None:
    """Refuse a file whose extension is that of a cloud of another kind; it would be looked through for a scan."""
    extension = os.path.splitext(os.fspath(source))[1].lower()
    if extension in OTHER_CLOUDS and os.path.isfile(source):
        raise UsageError(
            f"clouds in files {extension} are not read: convert it to one of {', '.join(CLOUD_INPUTS)} first; text of"
            " X Y Z only needs the extension .xyz"
        )


def refuse_scan_settings(settings: InputSettings, also: Sequence[str] = (), noun: str = "a cloud of points") -> None:
    """Refuse settings that have no meaning where the input is a cloud or a mesh.

    also: Further settings that are about a scan.
    noun: What the input is.
    """
    defaults = {own.name: own.default for own in fields(settings)}
    of_scans = [own.name for own in fields(InputSettings) if own.name not in _OF_BOTH]
    for name in (*of_scans, *also):
        if getattr(settings, name) != defaults[name]:
            raise UsageError(f"the input is {noun}, and {name_parameter(name)} is about a scan: leave it out")


def describe_cloud(cloud: PointCloud) -> dict[str, Any]:
    """Return the report's entry of a cloud: its points, and what is known of them."""
    known = {name: getattr(cloud, name) is not None for name in ("normals", "hu", "labels")}
    return {"points": len(cloud), **known, "file": cloud.report.get("file")}
