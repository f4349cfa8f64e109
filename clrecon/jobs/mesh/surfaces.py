"""The surfaces that a mesh job is to extract, and the parts of them that become one file each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from clrecon.jobs.mesh.settings import name_level

if TYPE_CHECKING:
    from clrecon.mesh import Mesh
    from clrecon.mesh.quality import MeshQuality

__all__ = ["Bones", "Part", "Surface", "plan_surfaces"]


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
    quality : MeshQuality, optional
        Where it was measured.
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
    quality: MeshQuality | None = None
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
