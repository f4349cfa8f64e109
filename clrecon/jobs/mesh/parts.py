"""From a volume to the meshes of a job: surfaces, and the parts of them that become one file each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from clrecon.errors import DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.jobs.mesh.settings import MeshSettings, name_level
from clrecon.jobs.shared.outputs import MOST_FILES
from clrecon.system.progress import Progress
from clrecon.system.wording import name_parameter

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device

__all__ = [
    "Bones",
    "Part",
    "Surface",
    "check_levels",
    "extract_surfaces",
    "first_names",
    "plan_surfaces",
    "select_parts",
]


@dataclass(frozen=True)
class Surface:
    """A surface that a job is to extract.

    Attributes
    ----------
    name : str
        What tells its files from those of the other surfaces, such as ``"200hu"``; empty where it is the only one.
    iso_value : float or (float, float) or None
        HU; or the two ends of a range; None: it is a label's own.
    below : bool
        It encloses what lies below the iso value.
    label : str or int or None
        Of the label map that picks its cells, where there is one.
    """

    name: str
    iso_value: float | tuple[float, ...] | None
    label: str | int | None = None
    below: bool = False

    def describe(self) -> str:
        """What it encloses: ``200 HU``, ``100:300 HU``, ``below -400 HU``."""
        if self.iso_value is None:
            return "the mask"
        return f"{'below ' if self.below else ''}{name_level(self.iso_value)} HU"

    @property
    def place(self) -> str:
        """The same behind "surface": ``at 200 HU``, ``of what lies below -400 HU``."""
        return f"of what lies {self.describe()}" if self.below else f"at {self.describe()}"


class Bones(NamedTuple):
    """Of a surface: its components, those that look like bone, and those that would but are rails of a table."""

    components: int
    bone: int
    rails: int


@dataclass
class Part:
    """A mesh that becomes a file of its own: a surface, or a component of one.

    Attributes
    ----------
    surface : Surface
    name : str
        What stands between the stem of the output and its extension, such as ``"200hu_001"``; empty where the part
        is the only one.
    mesh : Mesh
    quality : dict
        What `Mesh.quality` says; empty where it was not measured.
    facts : dict
        More entries of its object in the report.
    pieces : (dict, dict), optional
        What the components of its surface enclose, as extracted and as kept; where the purpose asks for it.
    bones : Bones, optional
        How many of its components are bone, where it as a whole does not look like bone.
    """

    surface: Surface
    name: str
    mesh: Mesh
    quality: dict[str, Any] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    pieces: tuple[dict[str, float], dict[str, float]] | None = None
    bones: Bones | None = None


def plan_surfaces(levels: Sequence[float | tuple[float, ...]], below: bool = False) -> list[Surface]:
    """One surface an iso value or range (HU), in their order; without any the one of a mask."""
    if len(levels) < 2:
        return [Surface("", levels[0] if levels else None, below=below)]
    return [Surface(_name_surface(level, below), level, below=below) for level in levels]


def _name_surface(level: float | tuple[float, ...], below: bool) -> str:
    """``200hu``, ``100to300hu``, ``below-400hu``: what tells the files of surfaces apart."""
    numbers = level if isinstance(level, tuple) else (level,)
    return f"{'below' if below else ''}{'to'.join(map(_digits, numbers))}hu"


def _digits(value: float) -> str:
    """A number as it goes into a file name: all its digits, so that two numbers never look the same."""
    text = repr(float(value) + 0.0)  # + 0.0: no "-0"
    return text.removesuffix(".0")


def check_levels(volume: Volume, surfaces: Sequence[Surface]) -> None:
    """Refuse what has every voxel inside.

    Raises
    ------
    NoSurfaceError
        One of them has.
    """
    low, high = volume.report["hu_range"]
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
                f"no surface {surface.place}: every voxel is inside, the volume runs from {low:g} to {high:g} HU"
            )


def extract_surfaces(
    volume: Volume, surfaces: Sequence[Surface], device: Device, settings: MeshSettings, progress: Progress
) -> list[Mesh]:
    """Extract all surfaces, one mesh each.

    Raises
    ------
    NoSurfaceError
        One of the iso values crosses nothing.
    """
    from clrecon.operators.surface.extract import extract_isosurfaces

    levels = [surface.iso_value for surface in surfaces if surface.iso_value is not None]
    return extract_isosurfaces(
        volume,
        levels,
        device,
        closed=settings.closed,
        topology=settings.topology,
        below=settings.below is not None,
        memory=settings.memory,
        progress=progress,
    )


def select_parts(surface: Surface, mesh: Mesh, settings: MeshSettings, device: Device, volume: Volume) -> list[Part]:
    """Keep the components that the settings ask for, and measure what the purpose of the mesh asks for.

    Raises
    ------
    NoSurfaceError, UsageError
        As `_select_parts`.
    """
    if settings.purpose is None:
        return _select_parts(surface, mesh, settings, device, volume)
    from clrecon.jobs.mesh.purposes import measure_pieces

    found = measure_pieces(mesh.vertices, mesh.triangles)
    parts = _select_parts(surface, mesh, settings, device, volume)
    each = [measure_pieces(part.mesh.vertices, part.mesh.triangles) for part in parts]
    for part in parts:
        part.pieces = found, {name: sum(kept[name] for kept in each) for name in found}
    return parts


def _select_parts(surface: Surface, mesh: Mesh, settings: MeshSettings, device: Device, volume: Volume) -> list[Part]:
    """Keep the components that the settings ask for, together or one by one.

    Raises
    ------
    NoSurfaceError
        No component is large enough, or none is bone.
    UsageError
        A seed is near no component, or more components are to be written one by one than anyone can want.
    """
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
    except DeviceMemoryError as error:  # the outcome is the same, it only takes longer
        mesh.report.setdefault("warnings", []).append(f"{error}: they were found without it")
    among = None
    if settings.keep == "bone":
        from clrecon.jobs.mesh.bone import find_bone

        labelled = labelled or find_labels(mesh.triangles, mesh.vertex_count)
        among = find_bone(
            mesh, volume, surface, labelled, without_table=settings.remove_table, advice=_advice(settings)
        )
        if settings.purpose is not None:
            from clrecon.jobs.mesh.purposes import measure_pieces

            other = mesh.triangles[~among[labelled[1][mesh.triangles[:, 0]]]]
            no_bone = measure_pieces(mesh.vertices, other)
            mesh.report.update(not_bone=no_bone["pieces"], not_bone_ml=no_bone["pieces_ml"])
    try:
        if not settings.split:
            kept = select_components(mesh, *limits, seeds=seeds, labelled=labelled, among=among)
            return [Part(surface, surface.name, kept)]
        pieces = split_components(mesh, *limits, seeds=seeds, labelled=labelled, among=among, most=MOST_FILES)
    except (NoSurfaceError, UsageError) as error:
        label = "" if surface.label is None else f"{surface.label} "  # of several one is too small, or too far
        raise type(error)(f"{label}{surface.place}: {error}") from error
    return [Part(surface, _name_piece(surface, place), piece) for place, piece in enumerate(pieces, start=1)]


def _advice(settings: MeshSettings) -> str:
    """What to do where nothing is bone."""
    if settings.purpose is None:
        return f"{name_parameter('keep_largest', 'N')} keeps by size"
    purpose, largest = name_parameter("purpose", settings.purpose), name_parameter("keep_largest", 1)
    return f"{purpose} keeps bone: {largest} takes the largest component, whatever it is"


def first_names(surfaces: Sequence[Surface], split: bool) -> list[str]:
    """Name of the first part of each surface: what is known of the outputs before anything is extracted."""
    return [_name_piece(surface, 1) if split else surface.name for surface in surfaces]


def _name_piece(surface: Surface, place: int) -> str:
    return f"{surface.name}_{place:03d}" if surface.name else f"{place:03d}"
