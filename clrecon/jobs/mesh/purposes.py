"""The purposes of meshes: the settings that follow from one, and facts for people who print a mesh."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs.mesh.seeds import is_label_seed
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.mesh.surfaces import Part
from clrecon.jobs.presets import HIGHEST_BONE_HU, LOWEST_BONE_HU, find_purpose
from clrecon.system.arguments import name_parameter
from clrecon.system.options import make_part, pick_fields
from clrecon.system.text import count_of, format_ml

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from clrecon.geometry import Volume
    from clrecon.opencl import Device
    from clrecon.operators.resident.device_volume import DeviceVolume


def settings_for(name: str | None, given: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of `MeshSettings` that a purpose sets, with the given ones, which win.

    None, False and empty values count as not given.  If components are chosen in another way, the purpose leaves none
    out.  Bone is told from other material only if all iso values are those of bone, from 100 to 1500 HU or ``"auto"``;
    it is made solid if there is one of them, and ``solid`` is not given as False.  Labels whose surface HU place are
    made solid one by one.
    """
    if name is None:
        return dict(given)
    purpose = find_purpose(name)
    fields = dict(purpose.settings)
    if purpose.is_for_print:
        if not given.get("closed", True):
            raise UsageError(f"a surface for {name} is closed: leave {name_parameter('closed', False)} out")
        if any(given.get(other) for other in ("seeds", "min_volume_ml", "split", "labels", "all_parts")):
            del fields["keep_largest"]
        chosen = any(given.get(other) for other in ("keep_largest", "seeds", "min_volume_ml"))
        levels = _levels_of_bone(given)
        if (chosen and not given.get("all_parts")) or not levels:
            del fields["keep"]
        if levels != 1 or given.get("solid") is False:
            del fields["solid"]
        if given.get("solid") is not False and _are_hollow(given):
            given = {**given, "labels": replace(given["labels"], solid=True)}
    elif given.get("region"):
        fields["preprocess"] += ",region"  # the paper's order
    defaults = {field: value for field, value in fields.items() if not given.get(field)}
    return {**given, **defaults, "purpose": name}


def mesh_fields(options: Mapping[str, Any], labels_by: str = "") -> dict[str, Any]:
    """Return the fields of `MeshSettings` that options give; a message says `labels_by` what a label map comes."""
    given = pick_fields(MeshSettings, options)
    given |= given.pop("iso_value", {})  # one of two fields
    needs = f"says how labels become meshes: give their file {labels_by or 'with ' + name_parameter('labels', 'FILE')}"
    if given.get("surface") == "cortex":  # labels pick the cells, as with hu
        options = {**options, "surface": "hu"}
    labels = make_part(LabelChoice, options, options.get("path"), needs)
    if labels is not None:
        given["labels"] = labels
        if given.get("solid") and not any(map(is_label_seed, given.get("grow_from", ()))):
            del given["solid"]  # it says how each label becomes a mesh
    return given


def settings_from(options: Mapping[str, Any], labels_by: str = "") -> MeshSettings:
    """Make the settings of options, with those of their purpose; see `mesh_fields` and `settings_for`."""
    given = mesh_fields(options, labels_by)
    return MeshSettings(**settings_for(given.pop("purpose", None), given))


def _without_parts(given: dict[str, Any]) -> MeshSettings:
    """Return the settings of these fields without those that a purpose alone makes valid."""
    others = ("all_parts", "seal_mm", "max_deviation_mm")
    return MeshSettings(**{name: value for name, value in given.items() if name not in others})


def _are_hollow(given: dict[str, Any]) -> bool:
    """True where these fields of `MeshSettings` ask for surfaces of labels in which marrow leaves walls inside."""
    settings = _without_parts(given)
    return settings.labels_pick and settings.labels is not None and settings.labels.surface == "hu"


def _levels_of_bone(given: dict[str, Any]) -> int:
    """Return the number of iso surfaces that these fields of `MeshSettings` ask for, 0 if one is not of bone."""
    settings = _without_parts(given)
    if settings.labels is not None or settings.inside != "above":
        return 0
    levels = [float(level) for level in settings.levels if not isinstance(level, tuple)]
    of_bone = all(math.isnan(level) or LOWEST_BONE_HU <= level <= HIGHEST_BONE_HU for level in levels)
    return len(levels) if of_bone else 0


THIN_MM = 1.0
"""Thinner walls break or are not printed at all by common printers (layers of 0.1 to 0.3 mm, nozzles of 0.4 mm)."""

LEFT_SHARE = 0.5
"""What was left out in volumes of what was kept, from which on there is a warning: the other leg of a pair."""

OTHER_SHARE = 0.05
"""Share of ml without walls like bone, beside all parts, from which on there is a warning: ribs in coarse voxels."""

_THIN_SHARE = 0.05
"""Share of the surface with thin walls from which on there is a warning."""


def measure_pieces(vertices: NDArray[np.floating], triangles: NDArray[np.uint32]) -> dict[str, float]:
    """Return number and ml of the components that enclose something (pieces), and of the walls of cavities."""
    from clrecon.mesh.connectivity import label_components
    from clrecon.mesh.refine.shifts import enclosed_mm3
    from clrecon.system.pieces import local_origin

    labelled = label_components(triangles, len(vertices))
    volumes = enclosed_mm3(vertices - local_origin(vertices), triangles, *labelled) / 1000.0
    return {
        "pieces": int((volumes > 0.0).sum()),
        "pieces_ml": float(volumes[volumes > 0.0].sum()),
        "cavities": int((volumes < 0.0).sum()),
        "cavities_ml": float(-volumes[volumes < 0.0].sum()),
    }


def describe_print(part: Part, resident: DeviceVolume) -> dict[str, Any]:
    """Return ``print`` of the report for a part as it is written, with `pieces` before and after the choice."""
    from clrecon.mesh.compare.distances import WallFigures, cast_walls
    from clrecon.operators.surface.cortex_mesh import measure_bone_walls

    assert part.pieces is not None
    mesh, (all_pieces, pieces) = part.mesh, part.pieces
    rays, constants = cast_walls(mesh.vertices, mesh.triangles), (mesh.report.get("cortex") or {}).get("constants")
    bone_mm = None if constants is None else measure_bone_walls(*rays, resident, constants, THIN_MM)
    size = mesh.vertices.max(axis=0).astype(float) - mesh.vertices.min(axis=0)
    return {
        "size_mm": size.tolist(),
        "wall": WallFigures.of(rays[2], THIN_MM),
        "bone_wall": None if bone_mm is None else WallFigures.of(bone_mm, THIN_MM),
        "left_out": {
            **{name: max(all_pieces[name] - pieces[name], 0) for name in all_pieces},
            **{name: mesh.report.get(name) for name in ("not_bone", "not_bone_ml")},
        },
        **pieces,
    }


def warn_of_print(facts: dict[str, Any]) -> list[str]:
    """Return warnings about the facts of `describe_print`: thin walls, closed cavities, the wrong piece."""
    warnings = []
    wall, left_out = facts["wall"], facts["left_out"]
    thin, thin_bone = (facts[name] and facts[name]["thin_share"] for name in ("wall", "bone_wall"))
    if thin is not None and thin > _THIN_SHARE:
        warnings.append(
            f"{100 * thin:.0f} % of the surface has a wall below {wall['thin_mm']:g} mm, which can break"
            f" or be lost in a print: lower {name_parameter('iso_value')}, or print it larger"
        )
    elif thin_bone is not None and thin_bone > _THIN_SHARE:
        warnings.append(
            f"{100 * thin_bone:.0f} % of the surface is that of bone thinner than {wall['thin_mm']:g} mm, and"
            f" {100 * (thin or 0.0):.0f} % of the print is as thin: its surface lies outside of the bone, so that thin"
            " walls become thicker"
        )
    if facts["cavities"]:
        warnings.append(
            f"{count_of(facts['cavities'], 'closed cavity', 'closed cavities')} of"
            f" {format_ml(facts['cavities_ml'], 2)} together are in it: powder or"
            f" resin stays in them; {name_parameter('keep_largest', 1)} fills them"
        )
    bone_told = left_out.get("not_bone") is not None
    other_ml = left_out["pieces_ml"] - (left_out["not_bone_ml"] if bone_told else 0.0)
    if other_ml > LEFT_SHARE * facts["pieces_ml"]:
        away, seed = name_parameter("remove_table", True), name_parameter("seeds", "X,Y,Z")
        table = "" if bone_told else f" The piece of largest area can be a table ({away});"
        warnings.append(
            f"{'bone that' if bone_told else 'what'} was left out encloses {format_ml(other_ml)}, beside the"
            f" {format_ml(facts['pieces_ml'])} that were kept: is it the right piece?{table}"
            f" {seed} keeps the one at a point, {name_parameter('all_parts', True)} keeps all"
        )
    return warnings


def warn_of_other_pieces(facts: Sequence[dict[str, Any]]) -> list[str]:
    """Return a warning if all parts (of `describe_print`) leave out much that may be thin bone."""
    left_out = facts[0]["left_out"] if facts else {}
    other_ml = left_out.get("not_bone_ml") or 0.0
    if other_ml <= OTHER_SHARE * sum(one["pieces_ml"] for one in facts):
        return []
    all_pieces, all_parts = name_parameter("min_volume_ml", 0.1), name_parameter("all_parts", True)
    return [
        f"{count_of(left_out['not_bone'], 'piece')} of {format_ml(other_ml)} together were left out, crumbs or"
        " with walls that do not reach 600 HU like those of bone: coarse voxels blur thin ribs below that."
        f" {all_pieces} in place of {all_parts} keeps pieces of any material"
    ]


def describe_purposes(parts: Sequence[Part], settings: MeshSettings, volume: Volume, device: Device) -> list[str]:
    """Measure what the purpose of the meshes needs, as ``print`` in the `facts` of each; return warnings."""
    for part in parts:
        part.facts["print"] = None
    if not settings.is_for_print:
        return []
    from clrecon.operators.resident.device_volume import DeviceVolume

    warnings = []
    with DeviceVolume(volume, device=device, memory=settings.memory) as resident:
        for part in parts:
            facts = part.facts["print"] = describe_print(part, resident)
            warnings += [f"{part.name}: {text}" if part.name else text for text in warn_of_print(facts)]
    if settings.all_parts:
        warnings += warn_of_other_pieces([part.facts["print"] for part in parts])
    return warnings
