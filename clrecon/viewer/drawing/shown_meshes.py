"""Meshes of what a view shows: extracted at the iso value, without hidden parts, cut where it is clipped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume
from clrecon.geometry.certificate import amend
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.mesh import Mesh
from clrecon.mesh.base import give_values
from clrecon.mesh.components import keep_triangles
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.label_masks import extract_label_masks
from clrecon.rendering.views.clip import Clip
from clrecon.system.progress import Progress, ignore_progress
from clrecon.viewer.drawing.stage import Stage, shows_fits
from clrecon.viewer.model.objects import ShownLabels, ShownMesh, ShownScan, find_modes
from clrecon.viewer.model.parts import find_inner, number_vertices
from clrecon.viewer.model.state import ShownPart, ViewState


def cut_mesh(mesh: Mesh, clip: Clip) -> Mesh:
    """Return the part of a mesh within a clip; triangles across a plane are cut at it."""
    for plane in clip.planes:
        mesh = _cut_mesh(mesh, plane)
    return mesh


def _cut_mesh(mesh: Mesh, plane: NDArray[np.float64]) -> Mesh:
    """Cut by a plane; a triangle is turned so that the corner that is alone on its side comes first."""
    heights = mesh.vertices @ plane[:3] - plane[3]
    corners = (heights >= 0.0)[mesh.triangles]
    count = corners.sum(axis=1)
    if (count == 3).all():
        return mesh
    across = mesh.triangles[(count == 1) | (count == 2)].astype(np.int64)
    is_kept = corners[(count == 1) | (count == 2)]
    alone = np.argmax(np.where((is_kept.sum(axis=1) == 1)[:, None], is_kept, ~is_kept), axis=1)
    turned = np.take_along_axis(across, (alone[:, None] + np.arange(3)) % 3, axis=1)
    edges = np.sort(turned[:, [0, 1, 0, 2]].reshape(-1, 2), axis=1)
    keys, which = np.unique(edges[:, 0] * mesh.vertex_count + edges[:, 1], return_inverse=True)
    first, second = keys // mesh.vertex_count, keys % mesh.vertex_count
    share = (heights[first] / (heights[first] - heights[second]))[:, None]

    def between(values: NDArray) -> NDArray:
        return np.concatenate([values, (values[first] + share * (values[second] - values[first])).astype(values.dtype)])

    cuts = which.reshape(-1, 2) + mesh.vertex_count
    is_corner = is_kept.sum(axis=1) == 1
    a, b, c = turned.T
    p, q = cuts.T
    pieces = [
        mesh.triangles[count == 3],
        np.stack([a, p, q], axis=1)[is_corner],
        np.stack([p, b, c], axis=1)[~is_corner],
        np.stack([p, c, q], axis=1)[~is_corner],
    ]
    triangles = np.concatenate(pieces).astype(np.uint32)
    normals = None if mesh.normals is None else between(mesh.normals)
    joined = Mesh(between(mesh.vertices), triangles, normals, dict(mesh.report), trusted=True)
    joined.values = {name: between(values[:, None])[:, 0] for name, values in mesh.values.items()}
    return keep_triangles(joined, np.ones(len(triangles), np.bool_))


_CUT_HU_PER_MM = 100.0
"""Slope of the values across a cut: steep enough that whole HU place it to 0.005 mm."""


def make_meshes(stage: Stage, state: ViewState, progress: Progress | None = None) -> list[Mesh]:
    """Make the meshes of what is shown; scans by their surface at the iso value, or fitted as in the mode "surface".

    Parts with looks of their own are meshes of their own, else a scan is one.  What clip planes cut off a scan is
    closed, meshes stay open there, as in the picture.
    """
    tell = progress or ignore_progress
    only_labels = find_modes()[state.mode].kind == "labels"
    meshes: list[Mesh] = []
    for shown in stage.objects:
        tell("surface", len(meshes), 0)
        whole = state.whole(shown.number)
        if whole is None or not whole.visible:
            continue
        if isinstance(shown, ShownScan) and not only_labels:
            meshes += _mesh_scan(stage, shown, whole, state, progress)
        elif isinstance(shown, ShownMesh):
            cut = shown.mesh if state.clip is None else cut_mesh(shown.mesh, state.clip)
            if cut.triangle_count:
                meshes.append(_named(cut, whole))
        elif isinstance(shown, ShownLabels) and (only_labels or shown.within is None):
            meshes += _mesh_labels(stage, shown, state, progress)
    if not meshes:
        raise NoSurfaceError("nothing that has a surface is shown: show a part first")
    return meshes


def _mesh_scan(
    stage: Stage, scan: ShownScan, whole: ShownPart, state: ViewState, progress: Progress | None
) -> list[Mesh]:
    resident = stage.resident(scan.number, state)
    volume, clip = resident.volume, state.clip
    if shows_fits(state):
        stage.fit_scans(state, progress)
        fit = stage.find_fits(state)[scan.number]
        assert fit is not None
        pieces = divide_surface(stage, scan, state, whole, fit.sharp)
        if clip is not None:
            pieces = [(cut_mesh(mesh, clip), part) for mesh, part in pieces]
        return [_named(mesh, part) for mesh, part in pieces if mesh.triangle_count]
    try:
        if clip is None:
            with stage.lock:
                mesh = extract_isosurface(resident, state.iso_value, progress=progress)
        else:
            volume = clip_volume(volume, clip, state.iso_value)
            mesh = extract_isosurface(
                volume, state.iso_value, device=stage.device, memory=stage.memory, progress=progress
            )
    except NoSurfaceError:
        return []
    inner = find_inner(mesh.vertices, volume, state.iso_value)
    return [_named(*each) for each in divide_surface(stage, scan, state, whole, (mesh, inner))]


def divide_surface(
    stage: Stage, scan: ShownScan, state: ViewState, whole: ShownPart, surface: tuple[Mesh, NDArray[np.int64]]
) -> list[tuple[Mesh, ShownPart]]:
    """Divide the surface of a scan, with `find_inner` of it: parts with looks of their own, and the rest of the whole.

    What is hidden is left out.
    """
    (mesh, inner), labelled = surface, stage.labelled(scan.number, state)
    if labelled is None or labelled.is_plain:
        return [(mesh, whole)]
    with stage.lock:
        voxels = stage.labels_on(stage.resident(scan.number, state), labelled)
    numbers = number_vertices(inner, voxels)[mesh.triangles[:, 0]]
    hidden = [part.number for part in labelled.parts if not part.visible]
    apart = [part for part in labelled.parts if part.visible and part.number and not part.is_plain]
    rest = ~np.isin(numbers, [*hidden, *(part.number for part in apart)])
    pieces = [*((numbers == part.number, part) for part in apart), (rest, whole)]
    return [(keep_triangles(mesh, is_kept), part) for is_kept, part in pieces if is_kept.any()]


def _mesh_labels(stage: Stage, shown: ShownLabels, state: ViewState, progress: Progress | None) -> list[Mesh]:
    parts = {part.number: part for part in state.parts_of(shown.number) if part.visible and part.number}
    if not parts:
        return []
    label_masks = extract_label_masks(
        shown.labels, label=sorted(parts), device=stage.device, memory=stage.memory, progress=progress
    )
    meshes = []
    for number, mesh in label_masks.items():
        cut = mesh if state.clip is None else cut_mesh(mesh, state.clip)
        if cut.triangle_count:
            meshes.append(_named(cut, parts[number]))
    return meshes


def _named(mesh: Mesh, part: ShownPart) -> Mesh:
    report = {**mesh.report, "part_name": part.name}
    if part.color is not None:
        report["color"] = [float(value) for value in part.color]
    return give_values(mesh, Mesh(mesh.vertices, mesh.triangles, mesh.normals, report, trusted=True))


def clip_volume(volume: Volume, clip: Clip, iso_value: float) -> Volume:
    """Return a volume whose surface at an iso value is cut by planes, flat and closed.

    Each voxel gets at most the level plus its distance within the planes times a slope: between two voxels the values
    then pass the level where the edge between them passes the plane.
    """
    level = choose_iso_rule(volume, iso_value).iso_level
    voxels = volume.voxels.copy()
    low = float(voxels.min())
    _, nj, ni = voxels.shape
    columns = volume.affine[:3, :2]
    i, j = np.arange(ni, dtype=np.float32), np.arange(nj, dtype=np.float32)
    for layer, origin in zip(voxels, volume.slice_origins(), strict=True):
        for *normal, offset in clip.planes.tolist():
            along_i, along_j = np.array(normal) @ columns
            start = float(np.dot(normal, origin)) - offset
            height = np.float32(start) + np.float32(along_j) * j[:, None] + np.float32(along_i) * i
            most = np.maximum(np.float32(level) + np.float32(_CUT_HU_PER_MM) * height, np.float32(low))
            np.minimum(layer, most, out=most)
            layer[...] = np.rint(most) if voxels.dtype.kind in "iu" else most
    clipped = volume.with_voxels(voxels)
    clipped.report = amend(clipped.report, clipped=clip.planes.tolist())
    return clipped
