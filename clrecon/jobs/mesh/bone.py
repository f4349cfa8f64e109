"""Bone in surfaces: which components are bone, and the warnings for surfaces that are not."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from clrecon.errors import NoSurfaceError, RefusedInputError, UsageError
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.surfaces import Bones, Part, Surface, list_failed_values, warn_of_contrast
from clrecon.jobs.presets import LOWEST_BONE_HU
from clrecon.system.arguments import name_parameter
from clrecon.system.text import count_of, join_names

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from clrecon.anatomy.iso_choice import IsoChoice
    from clrecon.geometry import Volume
    from clrecon.geometry.iso_rule import IsoRule
    from clrecon.mesh import Mesh
    from clrecon.mesh.compare.walls import WallLook
    from clrecon.mesh.components import Labelled

_CONTRAST_SHARE = 0.04
"""Share of a bone surface that looks like contrast medium and is reported from here on; spongy bone gives 0.03."""
OTHER_SHARE = 0.05
"""Share of a surface in one component that is no bone, and is warned of from here on."""
SPINE_MM = 20.0
"""Largest distance of the wall of the spinal canal from its middle."""


def find_bone(
    mesh: Mesh, volume: Volume, surface: Surface, labelled: Labelled, *, without_table: bool = False, advice: str,
    must: bool = True,
) -> NDArray[np.bool_] | None:  # fmt: skip
    """Return which components (count,) look like bone, else the canal's; None if not `must` and values may be no HU."""
    from clrecon.mesh.compare.iso_distance import rule_of_report

    rule = rule_of_report(mesh.report)
    if rule is None:
        raise UsageError("bone is told from an iso surface of HU only")
    count, labels = labelled
    judged, bone, rails = _tell_bone(mesh, volume, rule, labelled)

    def add_warning(text: str) -> None:
        mesh.report.setdefault("warnings", []).append(f"at {surface.describe()}{text}")

    if bone.any():
        if failed := list_failed_values(volume):
            add_warning(
                f" bone was told by walls of 600 HU, and these values are not known to be HU ({failed[-1]['name']}):"
                " look at what was kept"
            )
        if rails.any():
            away = name_parameter("remove_table", True)
            touching = f"; table that touches bone is one component with it, {away} takes it away first"
            add_warning(f" {_describe_rails(int(rails.sum()))}: left out{'' if without_table else touching}")
        return bone
    bone = _holds_spine(mesh, volume, count, labels)
    if not bone.any():
        others = [one for one, is_rail in zip(judged, rails, strict=True) if one is not None and not is_rail]
        why = f"{_describe_none(others, count, int(rails.sum()))}{_describe_other_values(volume)}"
        if not must and list_failed_values(volume):
            add_warning(f": {why}; nothing was left out for that")
            return None
        raise NoSurfaceError(f"at {surface.describe()}: {why} ({advice})")
    add_warning(" no component has walls like bone: the one round the spinal canal was kept")
    return bone


def _tell_bone(
    mesh: Mesh, volume: Volume, rule: IsoRule, labelled: Labelled, fewest: int = 0
) -> tuple[list[WallLook | None], NDArray[np.bool_], NDArray[np.bool_]]:
    """Say which components, of `fewest` vertices or more, are bone, and which would be, but are rails of a table."""
    import numpy as np

    from clrecon.mesh.compare.walls import FEWEST_VERTICES, find_rails, judge_components, looks_like_bone

    judged = judge_components(mesh, volume, rule, *labelled, max(fewest, FEWEST_VERTICES))
    like_bone = np.array([looks_like_bone(one) for one in judged], dtype=bool)
    rails = find_rails(mesh, volume, labelled[1], like_bone)
    return judged, like_bone & ~rails, rails


def _describe_none(judged: Sequence[dict[str, Any]], count: int, rails: int) -> str:
    but = f"; {_describe_rails(rails)}" if rails else ""
    if not judged:
        others = "all others" if rails else "all of them"
        return f"nothing that could be bone: {count_of(count, 'component')}, {others} crumbs{but}"
    largest = max(judged, key=lambda one: int(one["samples"]))
    return (
        f"nothing here looks like bone: of {count_of(count, 'component')} the largest {_looks(largest)};"
        f" those of bone reach 600 at 5 % and more of it{but}"
    )


def _describe_other_values(volume: Volume) -> str:
    """Say that values on another scale than HU show no bone; empty where they are HU."""
    from clrecon.mesh.compare.walls import COMPACT_HU

    failed = list_failed_values(volume)
    low, high = volume.hu_range or (float(volume.voxels.min()), float(volume.voxels.max()))
    if not failed and (low < 0.0 or high >= COMPACT_HU):  # HU of a scan with air, or with something dense
        return ""
    values = f"are not known to be HU ({failed[-1]['name']})" if failed else f"run from {low:g} to {high:g}"
    return (
        f"; bone is told by walls of {COMPACT_HU:g} HU, and the values of this scan {values}: say how HU follow from"
        f" them ({name_parameter('rescale', 'SLOPE,INTERCEPT')})"
    )


def _describe_rails(rails: int) -> str:
    """Describe components that are dense as bone, and straight as the rails of a table."""
    many = "s are" if rails != 1 else " is"
    return f"{rails:,} component{many} as dense as bone but the same in all slices, as the rails of a table"


def _looks(judged: dict[str, Any]) -> str:
    like = {"contrast medium": "contrast medium or another even body"}
    return f"looks like {like.get(judged['looks_like'], judged['looks_like'])}: its walls {_figures(judged)}"


def _figures(judged: dict[str, Any]) -> str:
    wall = judged["wall_hu"]
    return (
        f"have {wall['median']:.0f} HU, {wall['p99']:.0f} at the densest 1 %, and reach 600 at"
        f" {100.0 * judged['compact_share']:.1f} %"
    )


def _holds_spine(mesh: Mesh, volume: Volume, count: int, labels: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the component with the most vertices around the spinal canal, if the canal is found."""
    import numpy as np

    from clrecon.anatomy.spine_line import find_spine_line
    from clrecon.mesh.compare.walls import lie_near_line

    is_spine = np.zeros(count, dtype=bool)
    try:
        line = find_spine_line(volume, sure_only=True).points
    except RefusedInputError:
        return is_spine
    used = np.flatnonzero(labels >= 0)
    used = used[:: -(-len(used) // 100_000) or 1]
    near = lie_near_line(mesh.vertices[used], line, SPINE_MM)
    if near.any():
        is_spine[np.bincount(labels[used][near], minlength=count).argmax()] = True
    return is_spine


def judge_surfaces(
    parts: Sequence[Part], volume: Volume, settings: MeshSettings, label: Callable[[Part], Labelled]
) -> None:
    """Store in the `facts` of each part ``walls``, judged by HU; `label` numbers components judged alone."""
    import numpy as np

    from clrecon.mesh.compare.iso_distance import rule_of_report
    from clrecon.mesh.compare.walls import MOST_SAMPLES, is_straight, judge_walls, normals_of, sample_walls

    for part in parts:
        part.facts["walls"] = None
    lowest = -math.inf if settings.half_way == "auto" else LOWEST_BONE_HU
    known = [] if list_failed_values(volume) else parts
    chosen = [part for part in known if _is_of_bone(part.surface, lowest) and part.mesh.vertex_count]
    for surface in dict.fromkeys(part.surface for part in chosen):
        members = [part for part in chosen if part.surface == surface]
        rule = rule_of_report(members[0].mesh.report)
        if rule is None:
            continue
        step = -(-sum(part.mesh.vertex_count for part in members) // MOST_SAMPLES)
        vertices = [part.mesh.vertices[::step] for part in members]
        normals = [normals_of(part.mesh)[::step] for part in members]
        walls = sample_walls(np.concatenate(vertices), np.concatenate(normals), volume, rule)
        ends = np.cumsum([0, *map(len, vertices)])
        for part, first, end in zip(members, ends[:-1], ends[1:], strict=True):
            own_walls = walls.where(slice(first, end))
            judged = part.facts["walls"] = judge_walls(own_walls)
            if not _means_bone(settings) or settings.selects:
                continue
            faint = judged["looks_like"] != "bone" or judged["compact_share"] <= 1.0 - OTHER_SHARE
            if faint or is_straight(own_walls.points, volume):
                part.bones = _count_bones(part.mesh, volume, rule, label(part))


def _count_bones(mesh: Mesh, volume: Volume, rule: IsoRule, labelled: Labelled) -> Bones:
    """Count the components that look like bone, among the large ones if one does, and judge the largest other one."""
    import numpy as np

    for fewest in (int(OTHER_SHARE * mesh.vertex_count), 0):
        judged, bone, rails = _tell_bone(mesh, volume, rule, labelled, fewest)
        if bone.any():
            break
    sizes = np.bincount(labelled[1][labelled[1] >= 0], minlength=labelled[0])
    sizes[bone | rails | np.array([one is None for one in judged])] = 0
    largest = int(sizes.argmax())
    share = float(sizes[largest] / mesh.vertex_count)
    return Bones(labelled[0], int(bone.sum()), int(rails.sum()), judged[largest] if share else None, share)


def _is_of_bone(surface: Surface, lowest: float) -> bool:
    level = surface.iso_value
    if surface.label is not None or surface.below or level is None or isinstance(level, tuple):
        return False
    return level >= lowest


def warn_of_walls(parts: Sequence[Part], settings: MeshSettings, choice: IsoChoice | None = None) -> list[str]:
    """Return warnings for judged parts that should be bone but are contrast medium, joined to it, or something else."""
    contrast = [] if choice is None else warn_of_contrast(choice)
    warnings = []
    for surface in dict.fromkeys(part.surface for part in parts):
        members = [part for part in parts if part.surface == surface and part.facts.get("walls")]
        if settings.split:
            warnings += _warn_of_pieces(members)
        elif members:
            boneless = _warn_of_no_bone(members[0])
            if boneless and choice is not None and choice.contrast_medium_share:
                contrast = []  # the same figures, with advice that helps only if there is bone
            warnings += boneless or _warn_of_whole(members[0], settings)
    return contrast + warnings


def _warn_of_no_bone(part: Part) -> list[str]:
    """Return the warning for a surface at a level of bone without any bone component."""
    from clrecon.mesh.compare.walls import looks_like_bone

    if part.bones is None or part.bones.bone:
        return []
    judged = part.facts["walls"]
    rails = f"; {_describe_rails(part.bones.rails)}" if part.bones.rails else ""
    # thin bone has no clear walls: rails among thinner shells look like it
    surface = f"its walls {_figures(judged)}" if looks_like_bone(judged) else f"the surface {_looks(judged)}"
    many = f"{part.bones.components:,} component{'s' * (part.bones.components != 1)}"
    return [f"at {part.surface.describe()} nothing here looks like bone, none of {many}: {surface}{rails}"]


def _means_bone(settings: MeshSettings) -> bool:
    return settings.half_way == "auto" or settings.preset_used == "bone"


def _warn_of_pieces(parts: Sequence[Part]) -> list[str]:
    names = [part.name for part in parts if part.facts["walls"]["looks_like"] == "contrast medium"]
    if not names:
        return []
    return [
        f"not bone but contrast medium or another even body by their walls: {join_names(names)}"
        f" ({name_parameter('keep', 'bone')} leaves it out)"
    ]


def _warn_of_whole(part: Part, settings: MeshSettings) -> list[str]:
    from clrecon.mesh.compare.walls import looks_like_bone

    judged = part.facts["walls"]
    subject = f"at {part.surface.describe()} {'what is kept' if settings.selects else 'the surface'}"
    if not looks_like_bone(judged):
        if settings.seeds or not (settings.keep_largest is not None or _means_bone(settings)):
            return []
        return [f"{subject} {_looks(judged)}; {name_parameter('keep', 'bone')} keeps what looks like bone"]
    second = None if part.bones is None or part.bones.other_share < OTHER_SHARE else part.bones.other
    even = judged["contrast_share"] >= _CONTRAST_SHARE
    if part.bones is not None and second is not None and not (even and second["looks_like"] == "contrast medium"):
        return [
            f"{subject} is in part no bone: one of {count_of(part.bones.components, 'component')},"
            f" {100.0 * part.bones.other_share:.0f} % of the surface, {_looks(second)}."
            f" {name_parameter('remove_table', True)} takes a table away, {name_parameter('keep', 'bone')} leaves out"
            " what touches no bone"
        ]
    if not even:
        return []
    apart = "a higher iso value parts them"
    if not settings.remove_table:
        apart += (
            f"; where it is a table that touches bone, {name_parameter('remove_table', True)} takes that away first"
        )
    advice = apart if settings.keep == "bone" else f"{name_parameter('keep', 'bone')} leaves out what touches no bone"
    return [
        f"{subject} is in part like heart, vessels or organs with contrast medium (about"
        f" {100.0 * judged['contrast_share']:.0f} % is even beneath and far from compact bone): {advice}"
    ]
