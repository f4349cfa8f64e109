"""From a scan to the meshes of a job, before they are refined, measured and written."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clrecon.errors import DeviceError, DeviceFailedError, NoSurfaceError, UsageError
from clrecon.geometry import Volume, frame_from_lps
from clrecon.geometry.certificate import amend
from clrecon.geometry.iso_rule import describe_range
from clrecon.jobs.inputs import read_with_labels
from clrecon.jobs.mesh.bone import find_bone
from clrecon.jobs.mesh.labels import extract_label_surfaces, open_labels
from clrecon.jobs.mesh.purposes import measure_pieces
from clrecon.jobs.mesh.seeds import find_seeds
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.mesh.surfaces import Part, Surface, check_known_values, choose_level, plan_surfaces
from clrecon.jobs.outputs import MOST_FILES
from clrecon.jobs.preprocess import Band, mask_volume, preprocess_volume, restrict_volume
from clrecon.jobs.presets import HIGHEST_BONE_HU, LOWEST_BONE_HU
from clrecon.jobs.run import Run, trial_cube
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import local_origin
from clrecon.system.progress import Progress, Steps, ignore_progress
from clrecon.system.text import format_ml

if TYPE_CHECKING:
    from clrecon.anatomy.iso_choice import IsoChoice
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.mesh.components import Labelled
    from clrecon.opencl import Device


@dataclass(frozen=True, eq=False)
class MadeParts:
    """What `make_parts` made.

    volume: The scan, masked and cropped as the settings say, with the report of what was filled.
    solid: Makes the volume of which the surfaces were extracted again, its slices around meshes: the scan, and what was
        filled.
    device: Its `current` is the one that works: a stand-in may have taken over.
    choice: The choice of the iso value, if it was neither given nor a preset.
    origins: The report of each surface as it was extracted.
    """

    volume: Volume
    solid: Callable[[Sequence[Mesh]], Volume]
    parts: list[Part]
    device: Device
    choice: IsoChoice | None
    origins: list[dict[str, Any]]


def make_parts(
    source: str | Path,
    run: Run,
    check_map: Callable[[LabelMap], None] | None = None,
    extract: Callable[[Volume, Sequence[Surface], Device], list[Mesh]] | None = None,
) -> MadeParts:
    """Read a scan, extract its surfaces, by `extract` in place of `extract_surfaces`, and select components.

    `check_map` gets the label map before any work.
    """
    settings: MeshSettings = run.settings
    (volume, labels), device = _read_inputs(source, run, check_map)
    surfaces = plan_surfaces(settings.levels, below=settings.below is not None)
    volume = mask_parts(volume, surfaces, settings, device, run.progress)
    run.lap("mask")
    check_known_values(volume, settings)
    choice = choose_level(volume, settings, run.progress)
    if choice is not None:
        surfaces = plan_surfaces([choice.iso_value])
    run.lap("choose")
    check_levels(volume, surfaces)
    volume = solid = mask_and_preprocess(volume, surfaces, settings, device, run.progress)
    run.lap("mask")
    if settings.solid:
        solid = fill_solid(volume, surfaces, settings, device.current, run.progress)
        run.lap("solid")
    if labels is not None and settings.labels is not None and settings.labels_pick:
        surfaces, extracted = extract_label_surfaces(
            solid, surfaces, labels, settings.labels, device, settings, run.progress
        )
    elif extract is not None:
        extracted = extract(solid, surfaces, device)
    else:
        extracted = extract_surfaces(solid, surfaces, device, settings, run.progress, labels)
    origins = [mesh.report for mesh in extracted]
    make_solid = _remember_filled(volume, solid)
    del solid
    run.lap("surface")
    steps = Steps(run.progress if settings.selects else None, "select", _SELECT_STEPS * len(surfaces))
    parts: list[Part] = []
    for number, (surface, mesh) in enumerate(zip(surfaces, extracted, strict=True), start=1):
        parts += select_parts(surface, mesh, settings, device.current, volume, steps)
        steps.take(_SELECT_STEPS * number - steps.done)
    return MadeParts(volume, make_solid, parts, device, choice, origins)


BESIDE_SLICES = 16
"""Slices on each side of meshes within which their distances from the scan are measured."""


def _remember_filled(volume: Volume, solid: Volume) -> Callable[[Sequence[Mesh]], Volume]:
    """Return what makes slices of a solid volume again: one bit a voxel, while meshes need the memory of a volume."""
    if solid is volume:
        return lambda meshes: volume
    from clrecon.opencl import result_pages

    places = [np.packbits(own != layer) for own, layer in zip(solid.voxels, volume.voxels, strict=True)]
    volume.report, filled_hu = solid.report, solid.report["solid"]["filled_hu"]
    result_pages.clear()  # of the solid volume's mesh

    def make_solid(meshes: Sequence[Mesh]) -> Volume:
        corners = np.concatenate([list(product(*np.transpose(mesh.bounds))) for mesh in meshes])
        heights = volume.lps_to_ijk(corners)[:, 2]
        first = max(int(heights.min()) - BESIDE_SLICES, 0)
        part = volume[first : int(heights.max()) + BESIDE_SLICES]
        voxels = part.voxels.copy()
        for layer, bits in zip(voxels, places[first:], strict=False):
            layer[np.unpackbits(bits, count=layer.size).view(bool).reshape(layer.shape)] = filled_hu
        return part.with_voxels(voxels)

    return make_solid


def _read_inputs(
    source: str | Path, run: Run, check_map: Callable[[LabelMap], None] | None
) -> tuple[tuple[Volume, LabelMap | None], Device]:
    """Read the scan and its labels while the device opens and builds its kernels."""
    settings: MeshSettings = run.settings

    def read_map(volume: Volume | None) -> LabelMap | None:
        labels = open_labels(settings.labels, volume, follow_links=settings.follow_links)
        if labels is not None and settings.labels_pick and check_map is not None:
            check_map(labels)
        return labels

    path = None if settings.labels is None else settings.labels.path
    return run.read_beside(
        partial(_try_steps, settings=settings), lambda: read_with_labels(partial(run.read, source), path, read_map)
    )


def _try_steps(device: Device, settings: MeshSettings) -> None:
    """Build the kernels by making the surface of a small cube, or of a label of it, beside the reading."""
    if settings.labels is not None and settings.labels_pick:
        meshes = _try_labels(device, settings.labels)
    else:
        meshes = _try_levels(device, settings)
    if meshes and settings.selects:
        from clrecon.operators.primitives.union_find import label_components

        with suppress(DeviceFailedError):  # the host does it then
            label_components(device.current, meshes[0].triangles, meshes[0].vertex_count)
    if meshes and settings.surface == "cortex":
        _try_cortex(device, meshes[0])
    if meshes and settings.decimate_used is not None and settings.method != "g-mc":
        from clrecon.operators.surface.decimation import decimate_mesh

        decimate_mesh(meshes[0], settings.decimate_used, device=device)


def _try_cortex(device: Device, mesh: Mesh) -> None:
    from clrecon.opencl import Stopwatch
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.operators.surface.cortex import ProfileSampler
    from clrecon.operators.surface.decimation import CrossingMarks, plan_crossings

    with suppress(DeviceFailedError), DeviceVolume(trial_cube(), device=device.current) as resident:
        sampler = ProfileSampler(resident, Stopwatch())
        sampler.take(sampler.values(mesh.vertices, mesh.vertices)).fit(0.7, 0.7, 1000.0, 20.0)
        CrossingMarks(device.current, plan_crossings(mesh.vertices, mesh.triangles)).look()


def _try_labels(device: Device, choice: LabelChoice) -> list[Mesh]:
    from clrecon.labels import LabelMap

    cube = trial_cube()
    labels = LabelMap((cube.voxels >= 0).astype("uint8"), cube.affine)
    if choice.surface == "mask":
        from clrecon.operators.surface.label_masks import extract_label_masks

        return [*extract_label_masks(labels, device=device).values()]
    from clrecon.operators.surface.labels import extract_labels

    return [*extract_labels(cube, labels, 300.0, device=device, solid=choice.solid).values()]


def _try_levels(device: Device, settings: MeshSettings) -> list[Mesh]:
    """Return the surface of the small cube; none for a method that has no kernels."""
    from clrecon.operators.surface.methods import METHODS

    if not METHODS[settings.method_used].on_device:
        return []
    cube = trial_cube()
    surface = Surface("", (300.0, 2000.0) if settings.inside == "between" else 300.0, below=settings.below is not None)
    small = MeshSettings(
        below=300.0 if surface.below else None, closed=settings.closed, topology=settings.topology,
        method=settings.method, vertex_rule=settings.vertex_rule,
        grow_from=("auto",) if settings.grow_from else (), seal_mm=settings.seal_mm, solid=settings.solid,
    )  # fmt: skip
    _load_together(device, settings)
    if settings.solid:
        fill_solid(cube, [surface], small, device, ignore_progress)
    return extract_surfaces(cube, [surface], device, small, ignore_progress)


def _load_together(device: Device, settings: MeshSettings) -> None:
    """Build the kernels of most meshes as one program: those of the surface, of its components, and of walls.

    The trial run builds others, such as those of trilinear topology, and tells of a device that fails.
    """
    from clrecon.opencl import building_together
    from clrecon.operators.primitives.union_find import prepare_components
    from clrecon.operators.surface.cortex import prepare_profiles
    from clrecon.operators.surface.extraction import prepare_isosurface

    with suppress(DeviceError), building_together(device.current):
        prepare_isosurface(
            device.current, inside=settings.inside, vertex_rule=settings.vertex_rule, grown=bool(settings.grow_from)
        )
        if settings.selects:
            prepare_components(device.current)
        if settings.half_way != "auto":
            prepare_profiles(device.current)


def _bands_of(surfaces: Sequence[Surface]) -> list[Band]:
    """Return the HU that each surface encloses; NaN for a level that is still to be measured."""
    bands: list[Band] = []
    for surface in surfaces:
        level = surface.iso_value
        if isinstance(level, tuple):
            bands.append((level[0], level[1]))
        elif level is not None:
            bands.append((-math.inf, level) if surface.below else (level, math.inf))
    return bands


def mask_parts(
    volume: Volume, surfaces: Sequence[Surface], settings: MeshSettings, device: Device, progress: Progress
) -> Volume:
    """Return the volume with air outside of the body, the field of view and, but below a level, the region."""
    volume = mask_volume(volume, settings, progress)
    if settings.below is not None:
        return volume
    return restrict_volume(volume, settings, device, _bands_of(surfaces), progress)


def mask_and_preprocess(
    volume: Volume, surfaces: Sequence[Surface], settings: MeshSettings, device: Device, progress: Progress
) -> Volume:
    """Return the volume without outside air below a level, and after region and preprocessing."""
    bands = _bands_of(surfaces)
    volume = drop_outside_air(volume, settings, progress)
    if settings.below is not None:
        volume = restrict_volume(volume, settings, device, bands, progress)
    return preprocess_volume(volume, settings, device, bands, progress)


def fill_solid(
    volume: Volume, surfaces: Sequence[Surface], settings: MeshSettings, device: Device, progress: Progress
) -> Volume:
    """Fill what the only surface encloses; at levels of bone, wide spaces and such that hold air stay open."""
    from clrecon.operators.masks.enclosed import LARGEST_MARROW_MM, fill_enclosed

    level = surfaces[0].iso_value
    assert level is not None and not isinstance(level, tuple)  # the settings check it
    of_bone = LOWEST_BONE_HU <= level <= HIGHEST_BONE_HU
    filled: Volume = fill_enclosed(
        volume, level, seal_mm=settings.seal_mm, largest_mm=LARGEST_MARROW_MM if of_bone else None, keep_air=of_bone,
        device=device, memory=settings.memory, progress=progress,
    )  # fmt: skip
    return filled


def drop_outside_air(volume: Volume, settings: MeshSettings, progress: Progress) -> Volume:
    """Return the volume without the air around the patient, if the settings ask for the values below an iso value."""
    if settings.below is None or settings.keep_outside:
        return volume
    from clrecon.anatomy.surroundings import leave_outside_air

    warnings = list(volume.report.get("warnings", ()))
    levels = [level for level in settings.levels if not isinstance(level, tuple)]
    volume = leave_outside_air(volume, levels, progress=progress)
    facts = volume.report["outside_air"]
    warnings.append(
        f"air outside of the body was left out: {format_ml(facts['left_out_ml'])}, {format_ml(facts['kept_ml'])} within"
        f" it are kept ({name_parameter('keep_outside', True)} takes all)"
    )
    if facts["opening_mm2"] > 0.0:
        warnings.append(
            f"cavities are open to the outside and were cut there: {facts['opening_mm2']:,.0f} mm2 of cut, a flat end"
            " of the surface at each opening (nostrils, mouth, ears, holes of a dry bone); look at it there"
        )
    volume.report = amend(volume.report, warnings=warnings)
    return volume


_SELECT_STEPS = 4
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
            runs = describe_range(volume, low, high)
            raise NoSurfaceError(f"no surface {surface.phrase}: every voxel is inside, {runs}")


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
    if settings.is_shared_out:
        from clrecon.jobs.mesh.workers import extract_shared_out

        return extract_shared_out(volume, levels, device, settings, progress)
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
    """Keep the components that are asked for, and measure what the purpose needs; `steps` counts `_SELECT_STEPS`."""
    if not settings.is_for_print:
        return _select_parts(surface, mesh, settings, device, volume, steps)
    total = measure_pieces(mesh.vertices, mesh.triangles)
    steps.take()
    parts = _select_parts(surface, mesh, settings, device, volume, steps)
    sizes = [measure_pieces(part.mesh.vertices, part.mesh.triangles) for part in parts]
    for part in parts:
        part.pieces = total, {name: sum(kept[name] for kept in sizes) for name in total}
    return parts


def _select_parts(
    surface: Surface, mesh: Mesh, settings: MeshSettings, device: Device, volume: Volume, steps: Steps
) -> list[Part]:
    if not settings.selects:
        return [Part(surface, surface.name, mesh)]
    from clrecon.mesh import select_components, split_components

    limits = (settings.keep_largest, settings.min_volume_ml)
    seeds = [(frame_from_lps(settings.space).T @ seed).tolist() for seed in settings.seeds]
    labelled = label_parts(mesh, device, settings)
    steps.take()
    among = None
    if settings.keep == "bone":
        among = find_bone(
            mesh, volume, surface, labelled, without_table=settings.remove_table, advice=_advise_without_bone(settings),
            must=not settings.is_for_print,
        )  # fmt: skip
        if settings.is_for_print and among is not None:
            rejected = mesh.triangles[~among[labelled[1][mesh.triangles[:, 0]]]]
            no_bone = measure_pieces(mesh.vertices, rejected)
            mesh.report.update(not_bone=no_bone["pieces"], not_bone_ml=no_bone["pieces_ml"])
    if settings.all_parts:
        # walls of cavities are no bodies: what they enclose is filled
        from clrecon.mesh.refine.shifts import enclosed_mm3

        is_body = enclosed_mm3(mesh.vertices - local_origin(mesh.vertices), mesh.triangles, *labelled) >= 0.0
        among = is_body if among is None else among & is_body
    steps.take()
    try:
        if not settings.split:
            selected = select_components(mesh, *limits, seeds=seeds, labelled=labelled, among=among)
            return [Part(surface, surface.name, selected)]
        pieces = split_components(mesh, *limits, seeds=seeds, labelled=labelled, among=among, most=MOST_FILES)
    except (NoSurfaceError, UsageError) as error:
        label = "" if surface.label is None else f"{surface.label} "  # one of several is too small, or too far
        raise type(error)(f"{label}{surface.phrase}: {error}") from error
    return [Part(surface, _name_piece(surface, place), piece) for place, piece in enumerate(pieces, start=1)]


def label_parts(mesh: Mesh, device: Device, settings: MeshSettings) -> Labelled:
    """Number the components on the device, or, where it fails, by the host, which says so."""
    from clrecon.mesh.connectivity import label_components as label_on_host
    from clrecon.operators.primitives.union_find import label_components

    try:
        return label_components(device, mesh.triangles, mesh.vertex_count, memory=settings.memory)
    except DeviceFailedError as error:  # the result is the same, it only takes longer
        mesh.report.setdefault("warnings", []).append(f"{error}: they were found without it")
        return label_on_host(mesh.triangles, mesh.vertex_count)


def _advise_without_bone(settings: MeshSettings) -> str:
    if not settings.is_for_print:
        return f"{name_parameter('keep_largest', 'N')} keeps by size"
    purpose, largest = name_parameter("purpose", settings.purpose), name_parameter("keep_largest", 1)
    return f"{purpose} keeps bone: {largest} takes the largest component, whatever it is"


def first_names(surfaces: Sequence[Surface], split: bool) -> list[str]:
    """Return the name of the first part of each surface, as far as outputs are known before extraction."""
    return [_name_piece(surface, 1) if split else surface.name for surface in surfaces]


def _name_piece(surface: Surface, number: int) -> str:
    return f"{surface.name}_{number:03d}" if surface.name else f"{number:03d}"


def extract_one(
    volume: Volume, level: Any, device: Device, settings: MeshSettings, labels: LabelMap | None, progress: Progress
) -> Mesh:
    """Extract one surface by a method other than the plain one; taking triangles away is another step."""
    from clrecon.operators.surface.extract import extract_isosurface
    from clrecon.operators.surface.methods import METHODS, extract_by_method

    if not METHODS[settings.method_used].on_device:
        return extract_by_method(volume, level, settings.method_used, closed=settings.closed)
    seeds = None
    if settings.method_used == "i-mc":
        seeds = find_seeds(settings.grow_from, settings.space, labels)
    return extract_isosurface(
        volume, level, device=device, closed=settings.closed, topology=settings.topology,
        below=settings.below is not None, grow_from=seeds, vertex_rule=settings.vertex_rule,
        memory=settings.memory, progress=progress,
    )  # fmt: skip
