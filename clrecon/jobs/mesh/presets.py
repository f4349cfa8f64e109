"""Presets: iso values of tissues."""

from __future__ import annotations

from dataclasses import dataclass

from clrecon.errors import UsageError
from clrecon.system.text import unknown_name


@dataclass(frozen=True)
class Preset:
    """An iso value with its name and its reason.

    iso_value: HU.
    description: One line about the surface.
    source: Origin of the value.
    """

    name: str
    iso_value: float
    description: str
    source: str


DEFAULT_PRESET = "bone"

LOWEST_BONE_HU, HIGHEST_BONE_HU = 100.0, 1500.0
"""Iso values of bone: muscle and organs without contrast medium are below, enamel and metal above."""

_INVESALIUS = "InVesalius 3, lower bound of its preset"

PRESETS: dict[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset(
            "bone",
            200.0,
            "all bone: high enough to leave muscle and organs out, low enough to keep thin cortex whole",
            "dicom2stl, tissue 'bone'; thin vertebral cortex in slices of 4 mm needs 150 to 200 HU",
        ),
        Preset("spongy-bone", 148.0, "cortical and spongy bone, with some contrast-filled vessels",
               f"{_INVESALIUS} 'Spongial Bone (Adult)'"),
        Preset("cortical-bone", 662.0, "dense bone only", f"{_INVESALIUS} 'Compact Bone (Adult)'"),
        Preset("enamel", 1553.0, "teeth", f"{_INVESALIUS} 'Enamel (Adult)'"),
        Preset("metal", 2500.0, "screws, rods and implants",
               "above cortical bone (about 2000 HU), below the end of the 12-bit scale at 3071 HU"),
        Preset("soft-tissue", -25.0, "muscle and organs without fat",
               "half way between fat (about -100 HU) and muscle (about 50 HU)"),
        Preset("skin", -500.0, "the outside of the body (and of the air inside of it)",
               "half way between air (-1000 HU) and soft tissue (about 0 HU), where a blurred edge keeps its place"),
    )
}  # fmt: skip


def find_preset(name: str) -> Preset:
    """Return the preset called `name`, in upper or lower case."""
    try:
        return PRESETS[name.lower()]
    except (KeyError, AttributeError):
        raise UsageError(f"{unknown_name('preset', name, PRESETS)}, or give the iso value in HU") from None
