"""Surfaces of labels in a mesh job: their choice, their file names, and their entries in the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs.inputs import crop_labels
from clrecon.system.arguments import name_parameter
from clrecon.system.progress import Progress
from clrecon.system.text import join_names

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
    from clrecon.jobs.mesh.surfaces import Part, Surface
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device

_FACTS = (
    "surface", "label_inside_share", "label_ml", "label_taken_ml", "vertices_by_hu_share", "mask_level", "grow_mm",
    "solid",
)  # fmt: skip


def open_labels(
    choice: LabelChoice | None, volume: Volume | None = None, *, follow_links: bool = False
) -> LabelMap | None:
    """Read the label map, None if the job has none; with the scan, a large one is held against its grid first."""
    if choice is None:
        return None
    from clrecon.labels.reader import read_all_labels

    return read_all_labels(choice.path, choice.label or None, volume=volume, follow_links=follow_links)


def name_label_files(labels: LabelMap, choice: LabelChoice, surfaces: Sequence[Surface]) -> list[str]:
    """Name the files of all wanted labels, each of which may turn out to have no surface; empty for one file."""
    from clrecon.labels import file_suffixes

    numbers = choice.numbers_of(labels)
    suffixes = file_suffixes({number: labels.name(number) for number in numbers})
    names = ["_".join(filter(None, (suffix, each.name))) for suffix in suffixes.values() for each in surfaces]
    return names if len(names) > 1 else []


def extract_label_surfaces(
    volume: Volume,
    surfaces: Sequence[Surface],
    labels: LabelMap,
    choice: LabelChoice,
    device: Device,
    settings: MeshSettings,
    progress: Progress,
) -> tuple[list[Surface], list[Mesh]]:
    """Extract each label at each iso value, or only once if its own surface is asked for; name the surfaces by both."""
    from clrecon.labels import file_suffixes
    from clrecon.operators.surface.labels import extract_labels

    label_surfaces: list[tuple[Surface, int, Mesh]] = []
    numbers = choice.numbers_of(labels)
    colors = choice.colors_of(labels, numbers, settings.one_file)
    asked = numbers if choice.label or choice.hidden else None
    suffixes = file_suffixes({number: labels.name(number) for number in numbers})  # reports contain no other names
    for surface in surfaces:
        if surface.iso_value is None:
            masks = _extract_masks(volume, labels, asked, device, settings, progress)
            label_surfaces += [(surface, number, mesh) for number, mesh in masks.items()]
            continue
        if isinstance(surface.iso_value, tuple):  # refused with the settings
            raise UsageError(f"labels take one iso value, not {surface.describe()}")
        meshes = extract_labels(
            volume, labels, surface.iso_value, device=device, label=asked, grow_mm=choice.grow_mm,
            closed=settings.closed, solid=choice.solid, memory=settings.memory, progress=progress,
        )  # fmt: skip
        label_surfaces += [(surface, number, mesh) for number, mesh in meshes.items()]
        left_out = [f"{number} {suffixes[number]}" for number in numbers if number not in meshes]
        if left_out:
            next(iter(meshes.values())).report["warnings"].append(
                f"{len(left_out)} label{'s have' if len(left_out) > 1 else ' has'} no voxel of {surface.iso_value:g} HU"
                f" or more in the CT and no mesh: {join_names(left_out)}"
            )
    named = []
    for surface, number, mesh in label_surfaces:
        if number in colors:
            mesh.report |= {"part_name": suffixes[number], "color": colors[number]}
        name = "_".join(part for part in (suffixes[number], surface.name) if part) if len(label_surfaces) > 1 else ""
        named.append(replace(surface, name=name, label=suffixes[number]))
    return named, [mesh for _, _, mesh in label_surfaces]


def _extract_masks(
    volume: Volume,
    labels: LabelMap,
    numbers: Sequence[int] | None,
    device: Device,
    settings: MeshSettings,
    progress: Progress,
) -> dict[int, Mesh]:
    """Extract each label's own surface, on the map's own grid; the map must still lie on the scan."""
    from clrecon.anatomy.head import warn_of_skin
    from clrecon.labels.resample import check_together, warn_of_place
    from clrecon.operators.surface.label_masks import extract_label_masks, warn_of_volume

    shares, misplaced = check_together(labels, volume), warn_of_place(labels, volume)
    if settings.crop is not None:
        labels = crop_labels(labels, settings.crop, settings.space)
        numbers = None if numbers is None else [number for number in numbers if number in labels.counts]
    meshes = extract_label_masks(
        labels, device=device, label=numbers, closed=settings.closed, memory=settings.memory, progress=progress
    )
    for number, mesh in meshes.items():
        mesh.report |= {
            "certificate": volume.report,
            "label_inside_share": shares[number],
            "label_taken_ml": None,
            "vertices_by_hu_share": None,
            "grow_mm": None,
            "solid": False,
        }
        for warning in warn_of_volume(mesh.report):  # the gate says so
            mesh.report["warnings"].remove(warning)
        mesh.report["warnings"] += [*misplaced, *warn_of_skin(volume, mesh.vertices, mesh.triangles)]
        if shares[number] < 1.0:
            share = f"{100 * (1 - shares[number]):.3g} %"
            mesh.report["warnings"].append(f"{share} of label {number} lie outside the CT: its surface goes on there")
    return meshes


def describe_label(origin: dict[str, Any]) -> dict[str, Any]:
    """Return the report entries of a label's mesh, taken from the mesh's own report."""
    return {"label_number": origin["label"], **{name: origin[name] for name in _FACTS}}


def judge_label_volumes(parts: Sequence[Part], closed: bool) -> list[dict[str, Any]]:
    """Compare each label's meshes with its voxels in the CT: ``label_mesh_ml`` and ``label_compared_ml``."""
    from clrecon.mesh.compare.mesh_gates import judge_label_volume
    from clrecon.mesh.triangles import enclosed_ml

    by_surface: dict[Surface, list[Part]] = {}
    for part in parts:
        if part.surface.label is not None:
            by_surface.setdefault(part.surface, []).append(part)
    gates = []
    for surface, members in by_surface.items():
        origin = members[0].mesh.report
        by_hu = origin["surface"] == "hu"
        label_ml = float(origin["label_ml"])
        if by_hu:  # of the voxels that lie in the CT; if no centre does, of the resampled voxels
            label_ml = float(label_ml * origin["label_inside_share"] or origin["label_taken_ml"])
        mesh_ml = sum(enclosed_ml(part.mesh.vertices, part.mesh.triangles) for part in members) if closed else None
        advice = "" if mesh_ml is None else _advise(mesh_ml < label_ml, origin)
        gate = judge_label_volume(mesh_ml, label_ml, advice, by_hu=by_hu)
        gates.append({"mesh": surface.name or None, **gate})
        for part in members:
            part.facts |= {"label_mesh_ml": mesh_ml, "label_compared_ml": label_ml}
    return gates


def _advise(too_small: bool, origin: dict[str, Any]) -> str:
    """Return advice about a mesh that is much smaller, or larger, than its label."""
    left, total = origin.get("components_kept"), origin.get("components_found")
    if too_small and left is not None and left < total:
        return f"{left} of its {total} components were kept"
    if origin["surface"] == "mask":
        return "no level makes up for borders with other labels or what was done after it; the mask itself is kept"
    level, mask = name_parameter("iso_value"), name_parameter("surface", "mask")
    if not too_small:
        return (
            f"dense voxels around the label were taken in; a higher {level} or a smaller {name_parameter('grow_mm')}"
            f" takes fewer, {mask} takes the label as it is"
        )
    below = f"below {origin['iso_value_hu']:g} HU"
    if origin["solid"]:
        return f"much of the label lies {below} up to its border; a lower {level} or {mask} takes it in"
    solid = name_parameter("solid", True)
    return f"what lies {below} is left out; {solid} fills the marrow of bones, {mask} suits organs and everything else"
