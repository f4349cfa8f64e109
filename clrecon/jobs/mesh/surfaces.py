"""The surfaces of a mesh job, the parts of them that become one file each, and the choice of an iso value."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from clrecon.errors import RefusedInputError
from clrecon.jobs.mesh.settings import MeshSettings, name_level
from clrecon.jobs.presets import find_iso_preset
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_hu

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from clrecon.anatomy.iso_choice import IsoChoice
    from clrecon.geometry import Volume
    from clrecon.mesh import Mesh
    from clrecon.mesh.compare.walls import WallLook
    from clrecon.mesh.connectivity import Topology
    from clrecon.mesh.quality import MeshQuality


@dataclass(frozen=True)
class Surface:
    """A surface to extract; `name` is for its file; the level of a range is a pair, of a label's own surface None."""

    name: str
    iso_value: float | tuple[float, ...] | None
    label: str | int | None = None
    below: bool = False

    def describe(self) -> str:
        """Describe the enclosed values: ``200 HU``, ``100:300 HU``, ``below -400 HU``."""
        if self.iso_value is None:
            return "the mask"
        return f"{'below ' if self.below else ''}{name_level(self.iso_value)} HU"

    @property
    def phrase(self) -> str:
        """Describe the same for use after the word "surface": ``at 200 HU``, ``of what lies below -400 HU``."""
        return f"of what lies {self.describe()}" if self.below else f"at {self.describe()}"


class Bones(NamedTuple):
    """Components of a surface: all, bones, and rails; the largest `other`'s judgement and share of the vertices."""

    components: int
    bone: int
    rails: int
    other: WallLook | None = None
    other_share: float = 0.0


@dataclass
class Part:
    """A mesh that becomes a file: a surface, or a component of one.

    name: Text between the stem of the output and its extension, for example ``"200hu_001"``; empty if it is alone.
    facts: Further entries of its object in the report.
    pieces: Enclosed volumes of the components of its surface, as extracted and as kept, if the purpose needs them.
    bones: Counted if some of it does not look like bone.
    topology: Of the mesh as it is, where it was found before it is measured.
    component_ml: Enclosed volume of each component as written, without sign, where it was measured and has many.
    """

    surface: Surface
    name: str
    mesh: Mesh
    quality: MeshQuality | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    pieces: tuple[dict[str, float], dict[str, float]] | None = None
    bones: Bones | None = None
    topology: Topology | None = None
    component_ml: NDArray[np.float64] | None = None


def plan_surfaces(levels: Sequence[float | tuple[float, ...]], *, below: bool = False) -> list[Surface]:
    """Plan one surface for each iso value or range (HU), in order; without any, the surface of a mask."""
    if len(levels) < 2:
        return [Surface("", levels[0] if levels else None, below=below)]
    return [Surface(_name_surface(level, below), level, below=below) for level in levels]


def _name_surface(level: float | tuple[float, ...], below: bool) -> str:
    """Name a surface for its files: ``200hu``, ``100to300hu``, ``below-400hu``."""
    numbers = level if isinstance(level, tuple) else (level,)
    # All digits, so that different numbers never look the same; + 0.0 turns -0 into 0.
    digits = (repr(float(number) + 0.0).removesuffix(".0") for number in numbers)
    return f"{'below' if below else ''}{'to'.join(digits)}hu"


_HIGHEST_DRY_HU, _DRY_HU = -100, -200
"""Thin walls of a dry specimen, in air, stay below the first; the second finds those of the phantoms."""

_THICK_SLICES_MM = 2.5
"""Spacing from which on the half-way level can be too high: at 3 mm it loses blurred thin walls (docs/iso_value.md)."""


VALUE_GATES = ("hu_known", "plausible_hu", "hu_scale", "stored_sign")
"""Gates of a volume that fail where its values are not HU."""


def list_failed_values(volume: Volume) -> list[dict[str, Any]]:
    return [gate for gate in volume.report.get("gates", ()) if gate["name"] in VALUE_GATES and gate["ok"] is False]


def names_level(settings: MeshSettings) -> bool:
    """Tell whether a level, or the two materials beside it, are given as numbers, in whatever units the values have."""
    return settings.iso_value is not None or settings.half_way not in (None, "auto")


def check_known_values(volume: Volume, settings: MeshSettings) -> None:
    """Refuse to choose the level of a print where the values are not HU; one in the values' own units is taken."""
    if not settings.is_for_print or names_level(settings) or not settings.follows_hu:
        return
    failed = list_failed_values(volume)
    if failed:
        auto = (
            ""
            if settings.half_way is None
            else f"; without a print {name_parameter('half_way', 'auto')} says which it finds"
        )
        raise RefusedInputError(
            f"a print needs a level of bone, and the values of this scan are not known to be HU"
            f" ({failed[-1]['name']}: {failed[-1]['text']}). Give the level in the scan's own values"
            f" ({name_parameter('iso_value', 'N')}{auto}), or say how HU follow from the stored values"
            f" ({name_parameter('rescale', 'SLOPE,INTERCEPT')})"
        )


def choose_level(volume: Volume, settings: MeshSettings, progress: Progress = ignore_progress) -> IsoChoice | None:
    """Return the iso value half way between two materials, measured or given; None if the settings name levels."""
    from clrecon.anatomy.iso_choice import choose_iso_value, half_iso_value

    if settings.half_way is None:
        return None
    if isinstance(settings.half_way, str):
        return choose_iso_value(volume, progress=progress)
    return half_iso_value(*settings.half_way)


def describe_level(
    volume: Volume, settings: MeshSettings, choice: IsoChoice | None
) -> tuple[dict[str, Any], list[str]]:
    if not settings.follows_hu:
        return {"iso_value_reason": "none: the masks of the labels", "iso_value_choice": None}, []
    if choice is None:
        preset = settings.preset_used
        reason = "as given" if preset is None else f"preset {preset}: {find_iso_preset(preset).source}"
        return {"iso_value_reason": reason, "iso_value_choice": None}, _warn_of_specimen(volume, settings)
    warnings = []
    low, high = volume.hu_range or (math.nan, math.nan)
    for material, hu in (("bone", choice.bone_hu), ("tissue", choice.tissue_hu)):
        if choice.method == "half" and not low <= hu <= high:
            warnings.append(
                f"{material} was given as {hu:g} HU, but the volume runs from {format_hu(low)} to {format_hu(high)} HU:"
                " the level half way may not be that of this scan"
            )
    if choice.method == "auto" and volume.spacing[2] > _THICK_SLICES_MM:
        warnings.append(
            f"slices are {volume.spacing[2]:.3g} mm apart: walls thinner than that may be lost at"
            f" {choice.iso_value:g} HU; compare with a lower iso value, such as {name_parameter('preset', 'bone')}"
        )
    return {"iso_value_reason": choice.reason, "iso_value_choice": choice.measurements()}, warnings


def _warn_of_specimen(volume: Volume, settings: MeshSettings) -> list[str]:
    """Warn of thin walls of a dry specimen, which are fitted only where the level shows them."""
    from clrecon.anatomy.materials import lies_in_air

    level = max((hu for hu in settings.levels if not isinstance(hu, tuple)), default=-math.inf)
    if settings.surface != "cortex" or level <= _HIGHEST_DRY_HU or not lies_in_air(volume):
        return []
    return [
        f"the scan shows no soft tissue but air, as that of a dry specimen does: walls that stay below {level:g} HU are"
        f" not in the surface and cannot be fitted; {name_parameter('iso_value', _DRY_HU)} finds them"
    ]


def warn_of_contrast(choice: IsoChoice) -> list[str]:
    """Warn of contrast medium at the edges by which the iso value was chosen."""
    from clrecon.anatomy.iso_choice import CONTRAST_SAID

    if choice.flat_share is None or choice.flat_share < CONTRAST_SAID:
        return []
    share = f"{100.0 * choice.flat_share:.0f} % of the contrast at the edges ends in flat plateaus below 600 HU"
    if not choice.contrast_medium_share:
        return [
            f"{share}: too much to be left out of the choice of {choice.iso_value:g} HU. Where that is contrast medium"
            f" and not a body of one material, the level is not that of bone: give it"
            f" ({name_parameter('iso_value', 'N')})"
        ]
    return [
        f"{share}, as heart, vessels and organs with contrast medium do. They were left out of the choice of"
        f" {choice.iso_value:g} HU; what of them is brighter is in the surface:"
        f" {name_parameter('keep', 'bone')} keeps what looks like bone"
    ]
