"""Words that stand for settings: presets of iso values, and purposes of meshes."""

from __future__ import annotations

from typing import Any

from clrecon.errors import UsageError
from clrecon.system.light_dataclass import dataclass
from clrecon.system.text import guess_word, unknown_name


@dataclass(frozen=True)
class IsoPreset:
    """An iso value in HU with its name, a line about the surface, and the origin of the value."""

    name: str
    iso_value: float
    description: str
    source: str


DEFAULT_PRESET = "bone"

LOWEST_BONE_HU, HIGHEST_BONE_HU = 100.0, 1500.0
"""Iso values of bone: muscle and organs without contrast medium are below, enamel and metal above."""

_INVESALIUS = "InVesalius 3, lower bound of its preset"

PRESETS: dict[str, IsoPreset] = {
    preset.name: preset
    for preset in (
        IsoPreset(
            "bone",
            200.0,
            "all bone: high enough to leave muscle and organs out, low enough to keep thin cortex whole",
            "dicom2stl, tissue 'bone'; thin vertebral cortex in slices of 4 mm needs 150 to 200 HU",
        ),
        IsoPreset("spongy-bone", 148.0, "cortical and trabecular bone, with some contrast-filled vessels",
                  f"{_INVESALIUS} 'Spongial Bone (Adult)'"),
        IsoPreset("cortical-bone", 662.0, "dense bone only", f"{_INVESALIUS} 'Compact Bone (Adult)'"),
        IsoPreset("enamel", 1553.0, "teeth", f"{_INVESALIUS} 'Enamel (Adult)'"),
        IsoPreset("metal", 2500.0, "screws, rods and implants",
                  "above cortical bone (about 2000 HU), below the end of the 12-bit scale at 3071 HU"),
        IsoPreset("soft-tissue", -25.0, "muscle and organs without fat",
                  "half way between fat (about -100 HU) and muscle (about 50 HU)"),
        IsoPreset("skin", -500.0, "the outside of the body (and of the air inside of it)",
                  "half way between air (-1000 HU) and soft tissue (about 0 HU), where a blurred edge keeps its place"),
    )
}  # fmt: skip


def find_iso_preset(name: str) -> IsoPreset:
    try:
        return PRESETS[name.lower()]
    except (KeyError, AttributeError):
        raise UsageError(f"{unknown_name('preset', name, PRESETS)}, or give the iso value in HU") from None


@dataclass(frozen=True)
class Purpose:
    """A name for settings of meshes that it sets if they are not given; print needs a closed surface of bone."""

    name: str
    settings: dict[str, Any]
    description: str
    is_for_print: bool = False


PURPOSES: dict[str, Purpose] = {
    purpose.name: purpose
    for purpose in (
        Purpose(
            "print",
            {"keep": "bone", "keep_largest": 1, "solid": True, "smooth": 20, "decimate": 0.9, "strict": True},
            "one closed piece, of solid bone at iso values of bone; size and wall thickness are reported",
            is_for_print=True,
        ),
        Purpose(
            "paper-b",
            {"preprocess": "bilateral-2d,open:1", "method": "i-mc", "vertex_rule": "golden"},
            "improved marching cubes as in Liu et al. 2019; the vertex rule linear is more accurate",
        ),
    )
}


def find_purpose(name: str) -> Purpose:
    if name not in PURPOSES:
        raise UsageError(f"a mesh can be for {', '.join(PURPOSES)}, not for {name!r}{guess_word(name, PURPOSES)}")
    return PURPOSES[name]
