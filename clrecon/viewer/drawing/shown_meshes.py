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
from clrecon.mesh.triangles import vertex_normals
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.cortex_mesh import fit_cortex
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.label_masks import extract_label_masks
from clrecon.rendering.looks.colors import ColorScale
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.rendering.views.clip import Clip
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_hu
from clrecon.viewer.drawing.looks import LabelledLook
from clrecon.viewer.drawing.stage import FittedScan, Stage
from clrecon.viewer.model.objects import ShownLabels, ShownMesh, ShownScan, find_modes
from clrecon.viewer.model.state import FIT_COLORS, Color, ShownPart, ViewState

_TRIANGLES_A_CELL = 2.0
"""Triangles that a surface leaves in each cell that it passes through."""


def coarsen_mesh(mesh: Mesh, triangles: int) -> tuple[Mesh, NDArray[np.int64]]:
    """Return a coarse mesh for pictures: vertices that share a cell become one (Rossignac and Borrel 1993).

    With the row of the first of them for each vertex, whose values it has.
    """
    vertices = mesh.vertices.astype(np.float64)
    cell = float(np.sqrt(_TRIANGLES_A_CELL * mesh.area / triangles))
    low = vertices.min(axis=0)
    counts = np.floor(np.ptp(vertices, axis=0) / max(cell, 1e-9)).astype(np.int64) + 1
    i, j, k = np.floor((vertices - low) / max(cell, 1e-9)).astype(np.int64).T
    _, first, group = np.unique((k * counts[1] + j) * counts[0] + i, return_index=True, return_inverse=True)
    group = group.ravel()
    sizes = np.bincount(group)
    places = np.stack([np.bincount(group, vertices[:, axis]) / sizes for axis in range(3)], axis=1)
    joined = group[mesh.triangles]
    a, b, c = joined.T
    triangles_left = joined[(a != b) & (b != c) & (c != a)]
    points = places.astype(mesh.vertices.dtype)
    used = triangles_left.astype(np.uint32)
    coarse = Mesh(points, used, vertex_normals(points, used), dict(mesh.report), trusted=True)
    coarse.values = {name: values[first] for name, values in mesh.values.items()}
    return coarse, first


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
                meshes.append(_named(cut, whole.name, whole.color))
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
        fit_scans(stage, state, progress)
        shown = divide_fit(stage, scan, state, whole)
        cut = [(mesh if clip is None else cut_mesh(mesh, clip), part) for mesh, part in shown]
        return [_named(mesh, part.name, part.color) for mesh, part in cut if mesh.triangle_count]
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
    labelled = stage.labelled(scan.number, state)
    if labelled is None or labelled.is_plain:
        return [_named(mesh, whole.name, whole.color)]
    with stage.lock:
        voxels = stage.labels_on(resident, labelled)
    numbers = number_vertices(find_inner(mesh, volume, state.iso_value), voxels)
    return [_named(piece, part.name, part.color) for piece, part in divide_mesh(mesh, numbers, labelled, whole)]


def divide_mesh(mesh: Mesh, numbers: NDArray, labelled: LabelledLook, whole: ShownPart) -> list[tuple[Mesh, ShownPart]]:
    """Divide a mesh with the number of each vertex: parts with looks of their own, and the rest, which is the whole's.

    What is hidden is left out.
    """
    number_of, hidden = numbers[mesh.triangles[:, 0]], [part.number for part in labelled.parts if not part.visible]
    apart = [part for part in labelled.parts if part.visible and part.number and not part.is_plain]
    rest = ~np.isin(number_of, [*hidden, *(part.number for part in apart)])
    pieces = [*((number_of == part.number, part) for part in apart), (rest, whole)]
    return [(keep_triangles(mesh, is_kept), part) for is_kept, part in pieces if is_kept.any()]


COARSE_TRIANGLES, _MOST_FITS = 200_000, 4
"""Meshes with more triangles are drawn by a coarse one while anything moves; fitted surfaces that are kept."""


def shows_fits(state: ViewState) -> bool:
    return state.fitted and find_modes()[state.mode].kind == "surface"


def fitted_scans(stage: Stage, state: ViewState) -> list[FittedScan | None]:
    """Return the fitted surface of each scan that is shown, None where it is still to be made."""
    return [stage.fits.get(_fit_key(scan, state)) for scan in _visible_scans(stage, state)]


def _visible_scans(stage: Stage, state: ViewState) -> list[ShownScan]:
    scans = [each for each in stage.objects if isinstance(each, ShownScan)]
    return [scan for scan in scans if (whole := state.whole(scan.number)) is not None and whole.visible]


def _fit_key(scan: ShownScan, state: ViewState) -> tuple[int, float, bool]:
    return scan.number, state.iso_value, state.table


def fit_scans(stage: Stage, state: ViewState, progress: Progress | None = None) -> list[str]:
    """Fit the surfaces of the scans that are shown to the bone, where that was not done before; return what to say."""
    lines = []
    for scan in _visible_scans(stage, state):
        key = _fit_key(scan, state)
        if key not in stage.fits:
            fit = _fit_scan(stage, stage.resident(scan.number, state).volume, scan.name, state.iso_value, progress)
            with stage.lock:
                stage.fits[key] = fit
        with stage.lock:
            stage.fits.move_to_end(key)
            cortex = stage.fits[key].mesh.report["cortex"]
            while len(stage.fits) > max(_MOST_FITS, len(stage.objects)):
                stage.fits.popitem(last=False)
        lines.append(
            f"{scan.name}: {100.0 * cortex['fitted'] / cortex['vertices']:.0f} % of the vertices lie on the bone, error"
            f" {cortex['error_mm']['p50']:.2f} mm, walls {cortex['thickness_mm']['p50']:.1f} mm (median)"
        )
    return lines


def _fit_scan(stage: Stage, volume: Volume, name: str, iso_value: float, progress: Progress | None) -> FittedScan:
    """Fit a surface with a copy of the scan on the device: pictures are taken meanwhile."""
    with DeviceVolume(volume, device=stage.device, memory=stage.memory) as resident:
        try:
            level = extract_isosurface(resident, iso_value, progress=progress)
            fitted = fit_cortex(level, resident, progress=progress)
        except NoSurfaceError as error:
            raise NoSurfaceError(f"{name} at {format_hu(iso_value)} HU is not fitted to the bone: {error}") from error
    inner = find_inner(level, volume, iso_value)
    scales: dict[str, ColorScale] = {name: MeshLook(color_by=name).find_scale(fitted.values)[0] for name in FIT_COLORS}
    if fitted.triangle_count <= COARSE_TRIANGLES:
        return FittedScan(fitted, inner, fitted, inner, scales)
    coarse, first = coarsen_mesh(fitted, COARSE_TRIANGLES)
    return FittedScan(fitted, inner, coarse, inner[first], scales)


def divide_fit(
    stage: Stage, scan: ShownScan, state: ViewState, whole: ShownPart, *, coarse: bool = False
) -> list[tuple[Mesh, ShownPart]]:
    """Return the pieces of a fitted surface, see `divide_mesh`."""
    fit, labelled = stage.fits[_fit_key(scan, state)], stage.labelled(scan.number, state)
    mesh, inner = (fit.coarse, fit.coarse_inner) if coarse else (fit.mesh, fit.inner)
    if labelled is None or labelled.is_plain:
        return [(mesh, whole)]
    with stage.lock:
        voxels = stage.labels_on(stage.resident(scan.number, state), labelled)
    return divide_mesh(mesh, number_vertices(inner, voxels), labelled, whole)


def find_fit_scale(stage: Stage, state: ViewState) -> ColorScale | None:
    """Return the scale of the colours of fitted surfaces, the longest of theirs; None without colours."""
    fits = [fit for fit in fitted_scans(stage, state) if fit is not None]
    if state.color_by is None or not fits or not shows_fits(state):
        return None
    return max((fit.scales[state.color_by] for fit in fits), key=lambda scale: scale.limit)


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
            meshes.append(_named(cut, parts[number].name, parts[number].color))
    return meshes


def _named(mesh: Mesh, name: str, color: Color | None) -> Mesh:
    report = {**mesh.report, "part_name": name}
    if color is not None:
        report["color"] = [float(value) for value in color]
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


def number_vertices(inner: NDArray[np.int64], voxels: NDArray) -> NDArray:
    """Return the number of the voxel that `find_inner` found for each vertex, 0 for none."""
    return np.where(inner >= 0, voxels.reshape(-1)[inner], 0)


def find_inner(mesh: Mesh, volume: Volume, iso_value: float) -> NDArray[np.int64]:
    """Return the place in memory of the voxel that is inside at the edge of each vertex of an iso surface, -1: none."""
    level = choose_iso_rule(volume, iso_value).iso_level
    ijk = volume.lps_to_ijk(mesh.vertices)
    near = np.rint(ijk)
    axis = np.argmax(np.abs(ijk - near), axis=1)
    rows = np.arange(len(ijk))
    ends = np.stack([near, near]).astype(np.int64)
    ends[0, rows, axis] = np.floor(ijk[rows, axis])
    ends[1, rows, axis] = ends[0, rows, axis] + 1
    last = np.array(volume.shape_ijk) - 1
    inner = np.full(len(ijk), -1, np.int64)
    for end in ends:
        within = ((end >= 0) & (end <= last)).all(axis=1)
        i, j, k = np.clip(end, 0, last).T
        inside = within & (volume.voxels[k, j, i] > level)
        inner[inside] = np.ravel_multi_index((k, j, i), volume.voxels.shape)[inside]
    return inner
