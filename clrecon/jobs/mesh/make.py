"""From a scan to the meshes of a job, before they are refined, measured and written.

Kernels are built, and the volume is narrowed to the parts that its surfaces are made of.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.jobs.inputs import read_with_labels
from clrecon.jobs.mesh.labels import extract_label_surfaces, open_labels
from clrecon.jobs.mesh.mesh_parts import SELECT_STEPS, check_levels, extract_surfaces, select_parts
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Part, Surface, check_known_values, choose_level, plan_surfaces
from clrecon.jobs.preprocess import Band, mask_volume, preprocess_volume, restrict_volume
from clrecon.jobs.presets import HIGHEST_BONE_HU, LOWEST_BONE_HU
from clrecon.jobs.run import Run
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress, Steps
from clrecon.system.text import format_ml

if TYPE_CHECKING:
    from clrecon.anatomy.iso_choice import IsoChoice
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.opencl import Device


@dataclass(frozen=True, eq=False)
class MadeParts:
    """What `make_parts` made.

    volume: The scan, masked and cropped as the settings say.
    solid: The same with what is filled, of which the surfaces were extracted.
    device: Its `current` is the one that works: a stand-in may have taken over.
    choice: The choice of the iso value, if it was neither given nor a preset.
    origins: The report of each surface as it was extracted.
    """

    volume: Volume
    solid: Volume
    parts: list[Part]
    device: Device
    choice: IsoChoice | None
    origins: list[dict[str, Any]]


def make_parts(source: str | Path, run: Run, check_map: Callable[[LabelMap], None] | None = None) -> MadeParts:
    """Read a scan, extract its surfaces and select components.

    run: Its settings are those of the mesh job; it gets the times of the parts.
    check_map: Called with the label map whose labels become meshes, before the device works.
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
    else:
        extracted = extract_surfaces(solid, surfaces, device, settings, run.progress, labels)
    origins = [mesh.report for mesh in extracted]
    run.lap("surface")
    steps = Steps(run.progress if settings.selects else None, "select", SELECT_STEPS * len(surfaces))
    parts: list[Part] = []
    for place, (surface, mesh) in enumerate(zip(surfaces, extracted, strict=True), start=1):
        parts += select_parts(surface, mesh, settings, device.current, volume, steps)
        steps.take(SELECT_STEPS * place - steps.done)
    return MadeParts(volume, solid, parts, device, choice, origins)


def _read_inputs(
    source: str | Path, run: Run, check_map: Callable[[LabelMap], None] | None
) -> tuple[tuple[Volume, LabelMap | None], Device]:
    """Read the scan and its labels while the device opens and builds its kernels."""
    settings: MeshSettings = run.settings

    def read_map(volume: Volume | None) -> LabelMap | None:
        labels = open_labels(settings.labels, volume)
        if labels is not None and settings.labels_pick and check_map is not None:
            check_map(labels)
        return labels

    prepare = partial(
        prepare_surfaces, components=settings.selects, topology=settings.topology, inside=settings.inside,
        vertex_rule=settings.vertex_rule, grows=settings.method_used == "i-mc",
        decimates=settings.decimate_used is not None and settings.method != "g-mc" and settings.memory is None,
        solid=settings.solid,
    )  # fmt: skip
    path = None if settings.labels is None else settings.labels.path
    return run.read_beside(prepare, lambda: read_with_labels(partial(run.read, source), path, read_map))


def prepare_surfaces(
    device: Device,
    components: bool,
    topology: str,
    inside: str = "above",
    vertex_rule: str = "linear",
    grows: bool = False,
    decimates: bool = False,
    solid: bool = False,
) -> None:
    """Build the kernels for surfaces of this topology and, if wanted, for components, growing and so on."""
    from clrecon.operators.primitives.union_find import prepare_components
    from clrecon.operators.surface.extraction import prepare_isosurface

    prepare_isosurface(device, topology=topology, inside=inside, vertex_rule=vertex_rule, grown=grows)
    if grows:
        from clrecon.operators.surface.growing import prepare_growing

        prepare_growing(device)
    if decimates:
        from clrecon.operators.surface.decimation import prepare_near_faces

        prepare_near_faces(device)
    if solid:
        from clrecon.operators.masks.runs import prepare_runs
        from clrecon.operators.masks.shapes import prepare_balls

        prepare_balls(device)
        prepare_runs(device)
    if components:
        prepare_components(device)


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
    """Return the volume with air outside of the body, the field of view and the region, as the settings ask for it.

    Where the surfaces lie below a level, the region comes later: the air around the patient has to go before.
    """
    volume = mask_volume(volume, settings, progress)
    if settings.below is not None:
        return volume
    return restrict_volume(volume, settings, device, _bands_of(surfaces), progress)


def mask_and_preprocess(
    volume: Volume, surfaces: Sequence[Surface], settings: MeshSettings, device: Device, progress: Progress
) -> Volume:
    """Return the volume without what the surfaces shall not hold: outside air, where they lie below a level, what is
    outside of the region, and what preprocessing takes.
    """
    bands = _bands_of(surfaces)
    volume = drop_outside_air(volume, settings, progress)
    if settings.below is not None:
        volume = restrict_volume(volume, settings, device, bands, progress)
    return preprocess_volume(volume, settings, device, bands, progress)


def fill_solid(
    volume: Volume, surfaces: Sequence[Surface], settings: MeshSettings, device: Device, progress: Progress
) -> Volume:
    """Return the volume with what the only surface encloses filled.

    At levels of bone, spaces that are too wide for marrow stay open, and such that hold air; at others, as that of
    skin, all is filled.
    """
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
    from clrecon.geometry.certificate import amend

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
