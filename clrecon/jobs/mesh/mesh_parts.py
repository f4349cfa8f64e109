"""The meshes of a job, made from a volume: surfaces, and the parts of them that become one file each.

Surfaces by methods other than the plain one are made here too, with the seeds that they grow from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from clrecon.errors import DeviceFailedError, NoSurfaceError, UsageError
from clrecon.jobs.mesh.bone import find_bone
from clrecon.jobs.mesh.settings import LABEL_SEED, MeshSettings, is_label_seed
from clrecon.jobs.mesh.surfaces import Part, Surface
from clrecon.jobs.outputs import MOST_FILES
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress, Steps
from clrecon.system.text import format_hu, format_ml

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.mesh.components import Labelled
    from clrecon.opencl import Device


CRUMB_ML, MANY_COMPONENTS = 0.1, 100
"""A mesh of more components than this below this volume gets a warning."""

SELECT_STEPS = 4
"""Steps of the selection from a surface, as progress counts them: pieces, components, bone, and what is kept."""


def check_levels(volume: Volume, surfaces: Sequence[Surface]) -> None:
    """Refuse levels at which every voxel is inside."""
    low, high = volume.hu_range or (math.nan, math.nan)
    for surface in surfaces:
        level = surface.iso_value
        if level is None:
            continue
        if isinstance(level, tuple):
            all_inside = level[0] <= low and level[1] >= high
        else:
            all_inside = level > high if surface.below else level <= low
        if all_inside:  # the surface would be the box of the scan
            raise NoSurfaceError(
                f"no surface {surface.phrase}: every voxel is inside, the volume runs from"
                f" {format_hu(low)} to {format_hu(high)} HU"
            )


def extract_surfaces(
    volume: Volume,
    surfaces: Sequence[Surface],
    device: Device,
    settings: MeshSettings,
    progress: Progress,
    labels: LabelMap | None = None,
) -> list[Mesh]:
    """Extract all surfaces with one mesh each; `labels` are those that they may grow from."""
    from clrecon.operators.surface.extract import SurfaceExtractor

    levels = [surface.iso_value for surface in surfaces if surface.iso_value is not None]
    if settings.method_used in ("i-mc", "t-mc-soup", "skimage") or settings.vertex_rule != "linear":
        return [extract_one(volume, level, device, settings, labels, progress) for level in levels]
    meshes: list[Mesh] = []
    with SurfaceExtractor(volume, device=device, memory=settings.memory) as extractor:
        for level in levels:
            mesh = extractor.extract(
                level, closed=settings.closed, topology=settings.topology, below=settings.below is not None,
                progress=progress,
            )  # fmt: skip
            meshes.append(mesh)
    return meshes


def select_parts(
    surface: Surface, mesh: Mesh, settings: MeshSettings, device: Device, volume: Volume, steps: Steps
) -> list[Part]:
    """Keep the components that the settings ask for, and measure what the purpose of the mesh needs.

    `steps` counts `SELECT_STEPS`, or fewer.
    """
    if not settings.is_for_print:
        return _select_parts(surface, mesh, settings, device, volume, steps)
    from clrecon.jobs.mesh.refinement import measure_pieces

    found = measure_pieces(mesh.vertices, mesh.triangles)
    steps.take()
    parts = _select_parts(surface, mesh, settings, device, volume, steps)
    each = [measure_pieces(part.mesh.vertices, part.mesh.triangles) for part in parts]
    for part in parts:
        part.pieces = found, {name: sum(kept[name] for kept in each) for name in found}
    return parts


def _select_parts(
    surface: Surface, mesh: Mesh, settings: MeshSettings, device: Device, volume: Volume, steps: Steps
) -> list[Part]:
    """Keep the components that the settings ask for, together or one by one."""
    if not settings.selects:
        return [Part(surface, surface.name, mesh)]
    from clrecon.geometry import frame_from_lps
    from clrecon.mesh import select_components, split_components
    from clrecon.mesh.connectivity import label_components as find_labels
    from clrecon.operators.primitives.union_find import label_components

    limits = (settings.keep_largest, settings.min_volume_ml)
    seeds = [(frame_from_lps(settings.space).T @ seed).tolist() for seed in settings.seeds]
    labelled = None
    try:
        labelled = label_components(device, mesh.triangles, mesh.vertex_count, memory=settings.memory)
    except DeviceFailedError as error:  # the result is the same, it only takes longer
        mesh.report.setdefault("warnings", []).append(f"{error}: they were found without it")
    steps.take()
    among = None
    if settings.keep == "bone":
        labelled = labelled or find_labels(mesh.triangles, mesh.vertex_count)
        among = find_bone(
            mesh, volume, surface, labelled, without_table=settings.remove_table, advice=_advise_without_bone(settings)
        )
        if settings.is_for_print:
            from clrecon.jobs.mesh.refinement import measure_pieces

            other = mesh.triangles[~among[labelled[1][mesh.triangles[:, 0]]]]
            no_bone = measure_pieces(mesh.vertices, other)
            mesh.report.update(not_bone=no_bone["pieces"], not_bone_ml=no_bone["pieces_ml"])
    if settings.all_parts:
        labelled = labelled or find_labels(mesh.triangles, mesh.vertex_count)
        among = _without_cavities(mesh, labelled, among)
    steps.take()
    try:
        if not settings.split:
            kept = select_components(mesh, *limits, seeds=seeds, labelled=labelled, among=among)
            return [Part(surface, surface.name, kept)]
        pieces = split_components(mesh, *limits, seeds=seeds, labelled=labelled, among=among, most=MOST_FILES)
    except (NoSurfaceError, UsageError) as error:
        label = "" if surface.label is None else f"{surface.label} "  # one of several is too small, or too far
        raise type(error)(f"{label}{surface.phrase}: {error}") from error
    return [Part(surface, _name_piece(surface, place), piece) for place, piece in enumerate(pieces, start=1)]


def _without_cavities(mesh: Mesh, labelled: Labelled, among: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return the components, of `among` if given, that are no walls of cavities; what is left is filled there."""
    import numpy as np

    from clrecon.mesh.refine.shifts import measure_volumes
    from clrecon.system.pieces import local_origin

    found = measure_volumes(mesh.vertices - local_origin(mesh.vertices), mesh.triangles)
    is_wall = np.zeros(labelled[0], dtype=bool)
    used = labelled[1] >= 0
    is_wall[labelled[1][used]] = found.mm3[found.labels[used]] < 0.0
    return ~is_wall if among is None else among & ~is_wall


def warn_of_crumbs(parts: Sequence[Part], settings: MeshSettings) -> list[str]:
    """Return a warning for each measured mesh of many small components, which names the option that drops them."""
    import numpy as np

    from clrecon.mesh.refine.shifts import measure_volumes
    from clrecon.system.pieces import local_origin

    warnings = []
    for part in parts:
        if part.quality is None or part.quality.components <= MANY_COMPONENTS or settings.min_volume_ml is not None:
            continue
        mesh = part.mesh
        ml = np.abs(measure_volumes(mesh.vertices - local_origin(mesh.vertices), mesh.triangles).mm3) / 1000.0
        small = ml[ml < CRUMB_ML]
        if len(small) > MANY_COMPONENTS:
            warnings.append(
                f"{f'{part.name}: ' if part.name else ''}{len(small):,} of {len(ml):,} components enclose less than"
                f" {CRUMB_ML:g} ml each, {format_ml(float(small.sum()))} together:"
                f" {name_parameter('min_volume_ml', CRUMB_ML)} drops them"
            )
    return warnings


def _advise_without_bone(settings: MeshSettings) -> str:
    """Return advice for a surface without bone."""
    if not settings.is_for_print:
        return f"{name_parameter('keep_largest', 'N')} keeps by size"
    purpose, largest = name_parameter("purpose", settings.purpose), name_parameter("keep_largest", 1)
    return f"{purpose} keeps bone: {largest} takes the largest component, whatever it is"


def first_names(surfaces: Sequence[Surface], split: bool) -> list[str]:
    """Return the name of the first part of each surface, as far as outputs are known before extraction."""
    return [_name_piece(surface, 1) if split else surface.name for surface in surfaces]


def _name_piece(surface: Surface, place: int) -> str:
    return f"{surface.name}_{place:03d}" if surface.name else f"{place:03d}"


def find_seeds(settings: MeshSettings, labels: LabelMap | None) -> list[Any] | None:
    """Return what the surfaces grow from, as `extract_isosurface` takes it; None where they are whole."""
    if settings.method_used != "i-mc":
        return None
    from clrecon.geometry import frame_from_lps

    seeds: list[Any] = []
    for seed in settings.grow_from or ("auto",):
        if isinstance(seed, str):
            seeds.append((labels, _label_of_seed(seed)) if is_label_seed(seed) else seed)
        else:
            seeds.append((frame_from_lps(settings.space).T @ seed).tolist())
    return seeds


def _label_of_seed(seed: str) -> str | int:
    """Return the name or the number of a label seed."""
    name = seed[len(LABEL_SEED) :].strip()
    return int(name) if name.isascii() and name.isdigit() else name


def extract_one(
    volume: Volume, level: Any, device: Device, settings: MeshSettings, labels: LabelMap | None, progress: Progress
) -> Mesh:
    """Extract one surface by a method other than the plain one; taking triangles away is another step."""
    from clrecon.operators.surface.extract import extract_isosurface
    from clrecon.operators.surface.methods import METHODS, extract_by_method

    if not METHODS[settings.method_used].on_device:
        return extract_by_method(volume, level, settings.method_used, closed=settings.closed)
    return extract_isosurface(
        volume, level, device=device, closed=settings.closed, topology=settings.topology,
        below=settings.below is not None, grow_from=find_seeds(settings, labels), vertex_rule=settings.vertex_rule,
        memory=settings.memory, progress=progress,
    )  # fmt: skip
