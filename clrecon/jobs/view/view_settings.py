"""Which settings mean something where nothing is made, but looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, fields

from clrecon.errors import UsageError
from clrecon.jobs.shared.settings import InputSettings
from clrecon.jobs.view.settings import ViewSettings
from clrecon.system.arguments import name_parameter

_OF_A_VIEW = {"iso_value", "preset", "half_way", "space", "labels", "one_file"}
"""Settings of meshes that a view has a meaning for; a label map sets the last one by itself."""


def check_view_settings(settings: ViewSettings) -> None:
    """Refuse settings that a view has no meaning for, before anything is read."""
    scan = settings.scan
    ignored = {own.name for own in fields(InputSettings)} | _OF_A_VIEW
    for own in fields(scan):
        default = own.default if own.default_factory is MISSING else own.default_factory()
        value = getattr(scan, own.name)
        if own.name not in ignored and value != default and not (isinstance(value, Sequence) and not value):
            raise UsageError(
                f"{name_parameter(own.name)} says how a mesh is made, and a view makes none: leave it out, or write a"
                " page instead"
            )
    if isinstance(scan.iso_value, Sequence) and (len(scan.levels) != 1 or isinstance(scan.levels[0], tuple)):
        raise UsageError("a view begins with one iso value: give one, and move the slider")
