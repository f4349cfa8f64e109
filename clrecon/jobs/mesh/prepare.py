"""Preparation of a mesh job: its kernels, and a volume without the air around the patient."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.system.progress import Progress
from clrecon.system.wording import name_parameter

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.opencl import Device

__all__ = ["leave_outside", "prepare_surfaces"]


def prepare_surfaces(
    device: Device,
    components: bool,
    topology: str,
    inside: str = "above",
    vertex_rule: str = "linear",
    grows: bool = False,
) -> None:
    """Build the kernels for surfaces of this topology and, if wanted, for components and for growing."""
    from clrecon.operators.primitives.union_find import prepare_components
    from clrecon.operators.surface.extract import prepare_isosurface

    prepare_isosurface(device, topology=topology, inside=inside, vertex_rule=vertex_rule)
    if grows:
        from clrecon.operators.surface.growing import prepare_growing

        prepare_growing(device)
    if components:
        prepare_components(device)


def leave_outside(volume: Volume, settings: MeshSettings, progress: Progress) -> Volume:
    """Return the volume without the air around the patient, if the settings ask for the values below an iso value.

    Raises
    ------
    RefusedInputError
        No body was found.
    NoSurfaceError
        All voxels below the iso value are outside of the body.
    """
    if settings.below is None or settings.keep_outside:
        return volume
    from clrecon.anatomy.outside_air import leave_outside_air
    from clrecon.geometry.certificate import amend

    progress("mask", 0, 0)
    warnings = list(volume.report.get("warnings", ()))
    volume = leave_outside_air(volume, [level for level in settings.levels if not isinstance(level, tuple)])
    facts = volume.report["outside_air"]
    warnings.append(
        f"air outside of the body was left out: {facts['left_out_ml']:,.0f} ml, {facts['kept_ml']:,.1f} ml within it"
        f" are kept ({name_parameter('keep_outside', True)} takes all)"
    )
    if facts["opening_mm2"] > 0.0:
        warnings.append(
            f"cavities are open to the outside and were cut there: {facts['opening_mm2']:,.0f} mm2 of cut, a flat end"
            " of the surface at each opening (nostrils, mouth, ears, holes of a dry bone); look at it there"
        )
    volume.report = amend(volume.report, warnings=warnings)
    return volume
