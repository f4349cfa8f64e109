"""From a scan to the meshes of a job, before they are refined, measured and written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.jobs.mesh.labels import extract_label_surfaces, open_labels
from clrecon.jobs.mesh.levels import check_known_values, choose_level
from clrecon.jobs.mesh.parts import SELECT_STEPS, check_levels, extract_surfaces, select_parts
from clrecon.jobs.mesh.prepare import fill_solid, mask_parts, narrow_volume, prepare_surfaces
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Part, Surface, plan_surfaces
from clrecon.jobs.shared.labelled import read_with_labels
from clrecon.jobs.shared.laps import Laps
from clrecon.jobs.shared.opening import DeviceOpening
from clrecon.reading import read_selected
from clrecon.system.progress import Progress, Steps

if TYPE_CHECKING:
    from clrecon.anatomy.iso_choice import IsoChoice
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
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


def make_parts(
    source: str | Path,
    settings: MeshSettings,
    progress: Progress,
    watch: Laps,
    check_map: Callable[[LabelMap], None] | None = None,
) -> MadeParts:
    """Read a scan, extract its surfaces and select components.

    watch: Gets the times of the parts.
    check_map: Called with the label map whose labels become meshes, before the device works.
    """
    surfaces = plan_surfaces(settings.levels, below=settings.below is not None)
    volume, labels, device = _open(source, settings, progress, watch, check_map)
    volume = mask_parts(volume, surfaces, settings, device, progress)
    watch.lap("mask")
    volume, surfaces, choice = _choose(volume, surfaces, settings, device, progress, watch)
    solid = fill_solid(volume, surfaces, settings, device.current, progress, watch)
    surfaces, extracted = _extract(solid, surfaces, labels, device, settings, progress)
    origins = [mesh.report for mesh in extracted]
    watch.lap("surface")
    parts = _select(volume, surfaces, extracted, device.current, settings, progress)
    return MadeParts(volume, solid, parts, device, choice, origins)


def _open(
    source: str | Path,
    settings: MeshSettings,
    progress: Progress,
    watch: Laps,
    check_map: Callable[[LabelMap], None] | None,
) -> tuple[Volume, LabelMap | None, Device]:
    """Read the input while the device opens and builds its kernels."""
    progress("device", 0, 0)

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
    with DeviceOpening(settings.device, prepare) as opening:
        volume, labels = read_with_labels(
            partial(read_selected, source, settings, progress=progress),
            None if settings.labels is None else settings.labels.path,
            read_map,
        )
        watch.lap("read")
        device = opening.wait()
        watch.lap("device")
    return volume, labels, device


def _choose(
    volume: Volume, surfaces: list[Surface], settings: MeshSettings, device: Device, progress: Progress, watch: Laps
) -> tuple[Volume, list[Surface], IsoChoice | None]:
    """Return the volume for extraction, its surfaces, and the choice of the iso value if it was not given."""
    check_known_values(volume, settings)
    choice = choose_level(volume, settings, progress)
    if choice is not None:
        surfaces = plan_surfaces([choice.iso_value])
    watch.lap("choose")
    check_levels(volume, surfaces)
    volume = narrow_volume(volume, surfaces, settings, device, progress)
    watch.lap("mask")
    return volume, surfaces, choice


def _extract(
    volume: Volume,
    surfaces: list[Surface],
    labels: LabelMap | None,
    device: Device,
    settings: MeshSettings,
    progress: Progress,
) -> tuple[list[Surface], list[Mesh]]:
    """Extract the surfaces, those of labels included, with one mesh each."""
    if labels is not None and settings.labels is not None and settings.labels_pick:
        return extract_label_surfaces(volume, surfaces, labels, settings.labels, device, settings, progress)
    return surfaces, extract_surfaces(volume, surfaces, device, settings, progress, labels)


def _select(
    volume: Volume,
    surfaces: Sequence[Surface],
    extracted: Sequence[Mesh],
    device: Device,
    settings: MeshSettings,
    progress: Progress,
) -> list[Part]:
    """Select the components of each surface that are written."""
    steps = Steps(progress if settings.selects else None, "select", SELECT_STEPS * len(surfaces))
    parts: list[Part] = []
    for place, (surface, mesh) in enumerate(zip(surfaces, extracted, strict=True), start=1):
        parts += select_parts(surface, mesh, settings, device, volume, steps)
        steps.take(SELECT_STEPS * place - steps.done)
    return parts
