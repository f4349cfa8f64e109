"""Preparation of a mesh job: its kernels, and the parts of the volume that its surfaces are made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from clrecon.jobs.mesh.presets import HIGHEST_BONE_HU, LOWEST_BONE_HU
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Surface
from clrecon.jobs.shared.laps import Laps
from clrecon.jobs.shared.masking import mask_volume
from clrecon.jobs.shared.preprocess import preprocess_volume
from clrecon.jobs.shared.region import Band, restrict_volume
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress
from clrecon.system.text import format_ml

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.opencl import Device


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
    from clrecon.operators.surface.extract import prepare_isosurface

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


def narrow_volume(
    volume: Volume, surfaces: Sequence[Surface], settings: MeshSettings, device: Device, progress: Progress
) -> Volume:
    """Return the volume without what the surfaces shall not hold: outside air, where they lie below a level, what is
    outside of the region, and what preprocessing takes.
    """
    bands = _bands_of(surfaces)
    volume = leave_outside(volume, settings, progress)
    if settings.below is not None:
        volume = restrict_volume(volume, settings, device, bands, progress)
    return preprocess_volume(volume, settings, device, bands, progress)


def fill_solid(
    volume: Volume,
    surfaces: Sequence[Surface],
    settings: MeshSettings,
    device: Device,
    progress: Progress,
    watch: Laps,
) -> Volume:
    """Return the volume with what the only surface encloses filled, if the settings ask for that.

    At levels of bone, spaces that are too wide for marrow stay open, and such that hold air; at others, as that of
    skin, all is filled.
    """
    if not settings.solid:
        return volume
    from clrecon.operators.masks.enclosed import LARGEST_MARROW_MM, fill_enclosed

    level = surfaces[0].iso_value
    assert level is not None and not isinstance(level, tuple)  # the settings check it
    of_bone = LOWEST_BONE_HU <= level <= HIGHEST_BONE_HU
    filled: Volume = fill_enclosed(
        volume, level, seal_mm=settings.seal_mm, largest_mm=LARGEST_MARROW_MM if of_bone else None, keep_air=of_bone,
        device=device, memory=settings.memory, progress=progress,
    )  # fmt: skip
    watch.lap("solid")
    return filled


def leave_outside(volume: Volume, settings: MeshSettings, progress: Progress) -> Volume:
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
