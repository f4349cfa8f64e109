"""The words that settings of jobs know, from the tables in which the jobs look them up."""

from __future__ import annotations

from collections.abc import Iterable


def list_words(command: str, setting: str) -> list[str]:
    """Return the words that a setting can be; an empty list where it takes numbers, files or free text.

    command: Name of a command: a preset of pictures is not one of meshes.
    setting: Name of the option's value, such as ``preset``.
    """
    from clrecon.jobs.mesh.presets import PRESETS as LEVELS
    from clrecon.jobs.mesh.purposes import PURPOSES
    from clrecon.phantom.settings import KINDS, TABLE_NAMES
    from clrecon.rendering.looks.colors import COLORS
    from clrecon.rendering.looks.presets import PRESETS as LOOKS
    from clrecon.rendering.pictures.modes import MODES
    from clrecon.rendering.pictures.styles import CURVED_KINDS
    from clrecon.rendering.views.directions import DIRECTIONS
    from clrecon.rendering.views.plane import PLANES

    tables: dict[tuple[str, str], Iterable[str]] = {
        ("render", "preset"): LOOKS,
        ("render", "mode"): MODES,
        ("render", "view"): [*DIRECTIONS, *PLANES],
        ("render", "color"): COLORS,
        ("render", "background"): COLORS,
        ("render", "cpr"): CURVED_KINDS,
        ("render", "combine"): ("mean", "max", "min"),
        ("inside", "view"): DIRECTIONS,
        ("mesh", "preset"): LEVELS,
        ("compare", "preset"): LEVELS,
        ("mesh", "purpose"): PURPOSES,
        ("mesh", "topology"): ("separated", "trilinear"),
        ("phantom", "kind"): KINDS,
        ("phantom", "table"): TABLE_NAMES,
    }
    if setting == "device":
        return ["cpu", "gpu"]
    return list(tables.get((command, setting), ()))
