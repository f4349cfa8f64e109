"""Inputs of jobs: clouds, meshes, scans with label maps, and the crop.  Help texts import this: numpy comes later."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.exchange.formats import CLOUD_INPUTS, FORMATS, MESH_INPUTS
from clrecon.jobs.options import InputSettings, changed_fields
from clrecon.reading.urls import refuse_url
from clrecon.system.arguments import name_parameter
from clrecon.system.paths import extension_of

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.geometry.blocks import Box
    from clrecon.labels import LabelMap
    from clrecon.points.cloud import PointCloud


_OTHER_CLOUDS = (".pcd", ".e57", ".laz", ".pts", ".ptx")
"""Extensions of clouds that are not read."""

_OF_BOTH = ("keep_ids", "device", "memory")
"""Settings of the input that clouds have too."""


def is_cloud_file(source: str | Path) -> bool:
    """True for a file, or the name of one, whose extension is that of a cloud; folders are scans."""
    return extension_of(source) in CLOUD_INPUTS and not os.path.isdir(source)


def holds_triangles(source: str | Path) -> bool:
    """True for a mesh by its extension; for a PLY or VTP file, which may be a cloud, by the faces that it counts."""
    extension = extension_of(source)
    if extension not in MESH_INPUTS or os.path.isdir(source):
        return False
    return extension not in CLOUD_INPUTS or (os.path.isfile(source) and FORMATS[extension].code.has_faces(Path(source)))


def may_be_mesh(source: str | Path) -> bool:
    """True for a file that can be read as a mesh, by its extension, where clouds are no input."""
    return extension_of(source) in MESH_INPUTS


def refuse_other_clouds(source: str | Path) -> None:
    """Refuse a file whose extension is that of a cloud of another kind; it would be looked through for a scan."""
    extension = extension_of(source)
    if extension in (*CLOUD_INPUTS, *MESH_INPUTS, *_OTHER_CLOUDS):
        refuse_url(source, f"cloud or mesh {extension}")
    if extension in _OTHER_CLOUDS and os.path.isfile(source):
        raise UsageError(
            f"clouds in files {extension} are not read: convert it to one of {', '.join(CLOUD_INPUTS)} first; text of"
            " X Y Z only needs the extension .xyz"
        )


def refuse_scan_settings(settings: InputSettings, also: Sequence[str] = (), noun: str = "a cloud of points") -> None:
    """Refuse settings about a scan, with those named in `also`, where the input is a cloud or a mesh (the `noun`)."""
    of_scans = {own.name for own in fields(InputSettings)} - {*_OF_BOTH}
    for name in changed_fields(settings):
        if name in of_scans or name in also:
            raise UsageError(f"the input is {noun}, and {name_parameter(name)} is about a scan: leave it out")


def describe_cloud(cloud: PointCloud) -> dict[str, Any]:
    known = {name: getattr(cloud, name) is not None for name in ("normals", "hu", "labels")}
    return {"points": len(cloud), **known, "file": cloud.report.get("file")}


def read_with_labels(
    read_scan: Callable[[], Volume], path: str | Path | None, read_map: Callable[[Volume | None], LabelMap | None]
) -> tuple[Volume, LabelMap | None]:
    """Read the labels, then the scan; but labels that take long to unpack after it, to be held against its grid."""
    if path is None:
        return read_scan(), None
    from clrecon.labels.reader import is_large_map

    if is_large_map(path):
        volume = read_scan()
        return volume, read_map(volume)
    labels = read_map(None)
    return read_scan(), labels


def crop_scan(volume: Volume, box: Box | None, space: str, *, margin: int = 0) -> Volume:
    """Return the part of a scan in a box, in mm of the frame `space`; all of it without a box."""
    if box is None:
        return volume
    from clrecon.geometry.blocks import crop_volume

    return crop_volume(volume, *box, margin=margin, space=space)


def crop_labels(labels: LabelMap, box: Box | None, space: str) -> LabelMap:
    """Return the part of a label map in a box, as `crop_scan` does a scan."""
    if box is None:
        return labels
    import numpy as np

    from clrecon.geometry import frame_from_lps
    from clrecon.geometry.blocks import find_block, place_block

    turned = np.sort(np.array(box) * np.diag(frame_from_lps(space)), axis=0)
    origins = labels.affine[:3, 3] + np.arange(labels.shape_ijk[2])[:, None] * labels.affine[:3, 2]
    block = find_block(labels, origins, turned[0], turned[1])
    cut = None
    if block is not None:
        (i0, j0, k0), (i1, j1, k1) = block
        cut = labels.voxels[k0:k1, j0:j1, i0:i1]
    if block is None or cut is None or not cut.any():
        raise UsageError("nothing is left: no labelled voxel lies in the box of the crop")
    affine, _ = place_block(labels.affine, origins, False, block)
    names = {number: labels.name(number) for number in labels.numbers}
    return labels.changed(cut, names, affine=affine)
