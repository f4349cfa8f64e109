"""Settings that follow from the purpose of a mesh, in addition to those that are given."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from clrecon.errors import UsageError
from clrecon.jobs.mesh.presets import HIGHEST_BONE_HU, LOWEST_BONE_HU
from clrecon.jobs.mesh.purposes import find_purpose
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.system.arguments import name_parameter


def settings_for(name: str | None, given: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of `MeshSettings` that a purpose sets, with the given fields, which win.

    given: Fields; None, False and empty values count as not given.

    Returns: The given fields, and ``purpose``.  If components are chosen in another way, the purpose leaves none out.
        Bone is distinguished from other material only if all iso values are those of bone, from 100 to 1500 HU or
        ``"auto"``; it is made solid if there is one of them, and ``solid`` is not given as False.  Labels whose surface
        HU place are made solid one by one.
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
    taken = {field: value for field, value in fields.items() if not given.get(field)}
    return {**given, **taken, "purpose": name}


def _without_parts(given: dict[str, Any]) -> MeshSettings:
    """Return the settings of these fields without those that a purpose alone makes valid."""
    return MeshSettings(**{name: value for name, value in given.items() if name not in ("all_parts", "seal_mm")})


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
