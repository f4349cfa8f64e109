"""What a view shows, written by the writers of meshes, clouds, volumes and pictures; the extension says as what."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.exchange.formats import ASSEMBLIES, CLOUD_FORMATS, FORMATS, stage_assembly
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.operators.masks.mask import Mask
from clrecon.points.cloud import PointCloud
from clrecon.reading.grids.write_volume import FORMATS as VOLUME_FORMATS
from clrecon.rendering.pictures.object_looks import MESH_COLORS
from clrecon.rendering.pictures.picture import IMAGE_FORMATS
from clrecon.rendering.pictures.sheets import add_scale
from clrecon.system.arguments import Space
from clrecon.system.files import check_writable, replace_file
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress
from clrecon.system.text import count_of, escape_text, format_bytes
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.model.measures import MEASURE_FORMATS, encode_measures
from clrecon.viewer.model.objects import ShownCloud, ShownScan
from clrecon.viewer.model.saved_view import VIEW_FORMAT, encode_view
from clrecon.viewer.model.state import ViewState

KINDS: dict[str, tuple[str, ...]] = {
    "view": (VIEW_FORMAT,),
    "picture": tuple(IMAGE_FORMATS),
    "mesh": tuple(FORMATS),
    "cloud": tuple(CLOUD_FORMATS),
    "volume": tuple(VOLUME_FORMATS),
    "measures": MEASURE_FORMATS,
}
"""What is written, and the extensions of its files, the first that fits: .view.json comes before .json.  Those of
meshes and clouds both are meshes where one is shown.
"""


def check_target(path: str | os.PathLike[str], painter: Painter, state: ViewState) -> str:
    """Return as what a file is written, a key of `KINDS`."""
    name = Path(path).name.lower()
    kinds = [kind for kind, endings in KINDS.items() if any(name.endswith(ending) for ending in endings)]
    if not kinds:
        known = "; ".join(f"{kind}: {', '.join(endings)}" for kind, endings in KINDS.items())
        raise UsageError(f"{escape_text(Path(path).name)}: the extension says as what it is written ({known})")
    shown = [each for each in painter.objects if (whole := state.whole(each.number)) is not None and whole.visible]
    kind = kinds[0]
    if kind == "mesh" and "cloud" in kinds and shown and all(isinstance(each, ShownCloud) for each in shown):
        kind = "cloud"
    if kind == "measures" and not state.measures:
        raise UsageError("nothing was measured: there is no measure to write")
    if kind == "volume" and not any(isinstance(each, ShownScan) for each in painter.objects):
        raise UsageError("there is no scan: a file of a volume needs one")
    if kind == "mesh" and not [each for each in shown if not isinstance(each, ShownCloud)]:
        raise UsageError("nothing that has a surface is shown: show a part first, or write a cloud or a picture")
    return kind


def free_name(wanted: str | Path) -> Path:
    """Return the wanted name, or where it is taken with the first free number: ``bone-2.nii.gz``."""
    path = Path(wanted)
    is_double = path.name.lower().endswith((".nii.gz", ".xyz.gz", ".seg.nrrd", ".mrk.json", VIEW_FORMAT))
    ends = "".join(path.suffixes[-2:]) if is_double else path.suffix
    stem = path.name.removesuffix(ends)
    number, tried = 1, path
    while tried.exists() or tried.is_symlink():
        number += 1
        tried = path.with_name(f"{stem}-{number}{ends}")
    return tried


def check_names(names: Sequence[str]) -> None:
    """Refuse names of files that cannot be written, before anything is read."""
    known = list(chain(*KINDS.values()))
    for name in names:
        if not any(name.lower().endswith(ending) for ending in known):
            raise UsageError(
                f"{escape_text(Path(name).name)}: the extension says as what it is written, one of"
                f" {', '.join(dict.fromkeys(known))}"
            )
        check_writable(free_name(name))


def save_shown(
    path: str | os.PathLike[str],
    painter: Painter,
    state: ViewState,
    *,
    size: Sequence[int] = (1024, 1024),
    space: Space = "lps",
    keep_ids: bool = False,
    no_clobber: bool = False,
    progress: Progress | None = None,
) -> list[str]:
    """Write what is shown; returns lines that say what was written."""
    kind = check_target(path, painter, state)
    name = escape_text(Path(path).name)
    if kind == "picture":
        picture = painter.picture(state, size, sharp=True)
        picture = picture.with_background("black").annotated(letters=True, scale_bar=True)
        scale = painter.find_fit_scale(state)
        if scale is not None and state.color_by is not None:
            picture = add_scale(picture, scale, MESH_COLORS[state.color_by])
        written = picture.save(path, no_clobber=no_clobber)
        return [f"{name}: picture of {picture.size[0]} x {picture.size[1]} pixels, {format_bytes(written)}"]
    if kind in ("measures", "view"):
        content = encode_view(state, painter.objects)
        if kind == "measures":
            content = encode_measures(state.measures, name, space)
        with keep_existing(keep=no_clobber):
            written = replace_file(path, lambda stream: stream.write(content), expected_bytes=len(content))
        words = "what is shown" if kind == "view" else count_of(len(state.measures), "measure")
        return [f"{name}: {words}, {format_bytes(written)}"]
    if kind == "volume":
        volume = shown_volume(painter, state, progress)
        ni, nj, nk = volume.shape_ijk
        written = volume.save(path, keep_ids=keep_ids, no_clobber=no_clobber, progress=progress)
        return [f"{name}: volume of {ni} x {nj} x {nk} voxels, {format_bytes(written)}"]
    if kind == "cloud":
        cloud = shown_cloud(painter, state, progress)
        written = cloud.save(path, space, keep_ids=keep_ids, no_clobber=no_clobber)
        return [f"{name}: {count_of(len(cloud), 'point')}, {format_bytes(written)}"]
    meshes = painter.mesh_of_shown(state, progress)
    triangles = sum(mesh.triangle_count for mesh in meshes)
    if Path(path).suffix.lower() in ASSEMBLIES and len(meshes) > 1:
        with keep_existing(keep=no_clobber), stage_assembly(meshes, path, space, keep_ids=keep_ids) as staged:
            staged.commit()
        written = staged.size
    else:
        written = _join_meshes(meshes).save(path, space, keep_ids=keep_ids, no_clobber=no_clobber)
    return [f"{name}: {count_of(len(meshes), 'mesh', 'meshes')}, {triangles:,} triangles, {format_bytes(written)}"]


def shown_volume(painter: Painter, state: ViewState, progress: Progress | None = None) -> Volume:
    """Return the first scan that is shown, with air where a part is hidden or cut off, cropped to the clip box."""
    scans = [each for each in painter.objects if isinstance(each, ShownScan)]
    shown = [each for each in scans if (whole := state.whole(each.number)) is not None and whole.visible]
    scan = (shown or scans)[0]
    resident = painter.resident(scan.number, state)
    volume = resident.volume
    is_kept = None
    labelled = painter.labelled(scan.number, state)
    if labelled is not None and not all(part.visible for part in labelled.parts):
        with painter.lock:
            voxels = painter.labels_on(resident, labelled)
        wanted = np.ones(int(voxels.max()) + 1, np.bool_)
        wanted[[part.number for part in labelled.parts if not part.visible and part.number <= int(voxels.max())]] = (
            False
        )
        is_kept = wanted[voxels]
    if state.clips:
        within = np.empty(volume.voxels.shape, np.bool_)
        planes = np.array([each.row for each in state.clips])
        _, nj, ni = volume.voxels.shape
        for layer, origin in zip(within, volume.slice_origins(), strict=True):
            layer[...] = True
            for *normal, offset in planes.tolist():
                along_i, along_j = np.array(normal) @ volume.affine[:3, :2]
                start = float(np.dot(normal, origin)) - offset
                layer &= start + along_j * np.arange(nj)[:, None] + along_i * np.arange(ni) >= 0.0
        is_kept = within if is_kept is None else is_kept & within
    if is_kept is not None:
        chosen = Mask.from_array(volume, is_kept, device=painter.device, memory=painter.memory)
        volume = chosen.apply(volume)
    if state.clip_box is not None:
        (x0, y0, z0), (x1, y1, z1) = state.clip_box
        volume = volume.crop(clip_box=(x0, x1, y0, y1, z0, z1))
    return volume


def shown_cloud(painter: Painter, state: ViewState, progress: Progress | None = None) -> PointCloud:
    """Return the points of the clouds that are shown; without one the vertices of what has a surface."""
    clouds = []
    for shown in painter.objects:
        whole = state.whole(shown.number)
        if isinstance(shown, ShownCloud) and whole is not None and whole.visible:
            clip = state.clip
            clouds.append(shown.cloud if clip is None else shown.cloud.select(clip.contains(shown.cloud.points)))
    if not clouds:
        meshes = painter.mesh_of_shown(state, progress)
        clouds = [PointCloud(mesh.vertices, mesh.normals, report=dict(mesh.report)) for mesh in meshes]
    if not sum(map(len, clouds)):
        raise NoSurfaceError("no point is shown: nothing is written")
    if len(clouds) == 1:
        return clouds[0]
    arrays: dict[str, Any] = {}
    for name in ("normals", "hu", "labels"):
        values = [getattr(cloud, name) for cloud in clouds]
        if all(value is not None for value in values):
            arrays[name] = np.concatenate(values)
    return PointCloud(np.concatenate([cloud.points for cloud in clouds]), **arrays)


def _join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    if len(meshes) == 1:
        return meshes[0]
    starts = np.cumsum([0, *(mesh.vertex_count for mesh in meshes[:-1])])
    normals = None
    if all(mesh.normals is not None for mesh in meshes):
        normals = np.concatenate([mesh.normals for mesh in meshes])  # type: ignore[misc]
    triangles = [mesh.triangles.astype(np.int64) + start for mesh, start in zip(meshes, starts, strict=True)]
    report = {key: value for key, value in meshes[0].report.items() if key not in ("part_name", "color")}
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles), normals, report)
