"""Surfaces of labels in a mesh job: which labels, what their files are called, what the report says of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.pipeline.progress import Progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.pipeline.parts import Surface
    from clrecon.pipeline.settings import MeshSettings

__all__ = ["LabelChoice", "choose_labels", "describe_label", "extract_label_surfaces", "open_labels"]

NAMES_SHOWN = 5


@dataclass(frozen=True)
class LabelChoice:
    """Which labels of which map become meshes, and how.

    Parameters
    ----------
    path : path
        NIfTI, NRRD or DICOM SEG.
    wanted : tuple of str or int
        Numbers or names; empty means all that have a surface.
    grow_mm : float, optional
        See `clrecon.operators.labels.extract_labels`.
    solid : bool
        Fill what is less dense within a label.
    """

    path: str | Path
    wanted: tuple[str | int, ...] = ()
    grow_mm: float | None = None
    solid: bool = False


def choose_labels(
    path: str | None, wanted: Sequence[str] | None = None, grow_mm: float | None = None, solid: bool = False
) -> LabelChoice | None:
    """What the options of a command ask for, None where there is no label map.

    Raises
    ------
    UsageError
        An option that means something with a label map only.
    """
    if path is not None:
        return LabelChoice(path, tuple(wanted or ()), grow_mm, solid)
    for option, given in (("--label", bool(wanted)), ("--solid", solid), ("--grow", grow_mm is not None)):
        if given:
            raise UsageError(f"{option} says how labels become meshes: give their file with --labels FILE")
    return None


def open_labels(choice: LabelChoice | None) -> LabelMap | None:
    """Read the label map, None where the job has none.

    Raises
    ------
    UsageError, RefusedInputError
        As `clrecon.labels.read_labels`.
    """
    if choice is None:
        return None
    from clrecon.labels import read_labels

    return read_labels(choice.path, choice.wanted or None)


def extract_label_surfaces(
    volume: Volume,
    surfaces: Sequence[Surface],
    labels: LabelMap,
    choice: LabelChoice,
    device: Device,
    settings: MeshSettings,
    progress: Progress,
) -> tuple[list[Surface], list[Mesh]]:
    """Extract each label at each iso value.

    Parameters
    ----------
    surfaces : sequence of Surface
        One an iso value.

    Returns
    -------
    surfaces : list of Surface
        One a label and iso value that has a surface; named by the label and, where there are several, the iso value.
    meshes : list of Mesh

    Raises
    ------
    NoSurfaceError, UsageError, RefusedInputError, DeviceError
        As `clrecon.operators.labels.extract_labels`.
    """
    from clrecon.labels import file_suffixes
    from clrecon.operators.labels import extract_labels

    found: list[tuple[Surface, int, Mesh]] = []
    numbers = [labels.find(label) for label in choice.wanted] or labels.numbers
    suffixes = file_suffixes({number: labels.name(number) for number in numbers})  # reports hold no other names
    for surface in surfaces:
        meshes = extract_labels(
            volume, labels, surface.iso_value, device, numbers=choice.wanted or None, grow_mm=choice.grow_mm,
            closed=settings.closed, solid=choice.solid, memory=settings.memory, progress=progress,
        )  # fmt: skip
        found += [(surface, number, mesh) for number, mesh in meshes.items()]
        left_out = [f"{number} {suffixes[number]}" for number in numbers if number not in meshes]
        if left_out:
            more = f" and {len(left_out) - NAMES_SHOWN} more" if len(left_out) > NAMES_SHOWN else ""
            next(iter(meshes.values())).report["warnings"].append(
                f"{len(left_out)} label{'s have' if len(left_out) > 1 else ' has'} no voxel of {surface.iso_value:g} HU"
                f" or more in the CT and no mesh: {', '.join(left_out[:NAMES_SHOWN])}{more}"
            )
    named = []
    for surface, number, _ in found:
        name = "_".join(part for part in (suffixes[number], surface.name) if part) if len(found) > 1 else ""
        named.append(replace(surface, name=name, label=suffixes[number]))
    return named, [mesh for _, _, mesh in found]


def describe_label(origin: dict[str, Any]) -> dict[str, Any]:
    """Entries of a mesh of a label in the report, from the mesh's own; none for other meshes."""
    if "label" not in origin:
        return {}
    facts = {name: origin[name] for name in ("label_inside_share", "vertices_by_hu_share", "grow_mm", "solid")}
    return {"label_number": origin["label"], **facts}
