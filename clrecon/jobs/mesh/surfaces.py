"""The surfaces of a mesh job, and the parts of them that become one file each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from clrecon.jobs.mesh.settings import name_level

if TYPE_CHECKING:
    from clrecon.mesh import Mesh
    from clrecon.mesh.quality import MeshQuality


@dataclass(frozen=True)
class Surface:
    """A surface to extract.

    name: Part of its file names that distinguishes it from other surfaces, for example ``"200hu"``; empty if it is the
        only one.
    iso_value: float or (float, float) or None. HU; or the two ends of a range; None: it is a label's own.
    below: It encloses the values below the iso value.
    label: Label that selects its cells, if there is a label map.
    """

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
    """The components of a surface: all, those that look like bone, and rails of a table, which would."""

    components: int
    bone: int
    rails: int


@dataclass
class Part:
    """A mesh that becomes a file: a surface, or a component of one.

    name: Text between the stem of the output and its extension, for example ``"200hu_001"``; empty if the part is the
        only one.
    quality: Its quality, if measured.
    facts: Further entries of its object in the report.
    pieces: (dict, dict). Enclosed volumes of the components of its surface, as extracted and as kept, if the purpose
        needs them.
    bones: Number of its components that are bone, if it does not look like bone as a whole.
    """

    surface: Surface
    name: str
    mesh: Mesh
    quality: MeshQuality | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    pieces: tuple[dict[str, float], dict[str, float]] | None = None
    bones: Bones | None = None


def plan_surfaces(levels: Sequence[float | tuple[float, ...]], below: bool = False) -> list[Surface]:
    """Plan one surface for each iso value or range (HU), in order; without any, the surface of a mask."""
    if len(levels) < 2:
        return [Surface("", levels[0] if levels else None, below=below)]
    return [Surface(_name_surface(level, below), level, below=below) for level in levels]


def _name_surface(level: float | tuple[float, ...], below: bool) -> str:
    """Name a surface for its files: ``200hu``, ``100to300hu``, ``below-400hu``."""
    numbers = level if isinstance(level, tuple) else (level,)
    return f"{'below' if below else ''}{'to'.join(map(_digits, numbers))}hu"


def _digits(value: float) -> str:
    """Write a number for a file name with all its digits, so that different numbers never look the same."""
    text = repr(float(value) + 0.0)  # + 0.0 turns -0 into 0
    return text.removesuffix(".0")
