"""The choice of labels that become meshes, and the kind of their surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.system.arguments import name_parameter

if TYPE_CHECKING:
    from clrecon.labels import LabelMap


@dataclass(frozen=True)
class LabelChoice:
    """The labels of a map that become meshes, and the kind of their surfaces.

    path: NIfTI, NRRD, DICOM SEG or RTSTRUCT.
    wanted: Numbers or names; empty means all that have a surface.
    grow_mm: See `clrecon.operators.surface.labels.extract_labels`.
    solid: Fill less dense parts within a label.
    surface: {"hu", "mask"}. HU place the vertices (`clrecon.operators.surface.labels.extract_labels`), or each label
        has its own surface (`clrecon.operators.surface.label_masks.extract_label_masks`).
    hidden: Labels that become no mesh.
    colors: tuple of (str or int, str). Labels and their colours, for PLY, GLB and 3MF.
    """

    path: str | Path
    wanted: tuple[str | int, ...] = ()
    grow_mm: float | None = None
    solid: bool = False
    surface: str = "hu"
    hidden: tuple[str | int, ...] = ()
    colors: tuple[tuple[str | int, str], ...] = ()

    def __post_init__(self) -> None:
        from clrecon.rendering.looks.colors import find_color  # numpy: not loaded before a job starts

        for _, color in self.colors:
            find_color(color)
        if self.surface not in ("hu", "mask"):
            raise UsageError(f"labels have no surface {self.surface!r}: it is hu or mask")
        if self.surface == "mask" and (self.solid or self.grow_mm is not None):
            raise UsageError(
                f"the surface of a mask is solid and does not grow: leave out {name_parameter('solid')} and"
                f" {name_parameter('grow_mm')}"
            )

    def numbers_of(self, labels: LabelMap) -> list[int]:
        """Return the numbers of the labels that become meshes."""
        hidden = {labels.find(label) for label in self.hidden}
        wanted = [labels.find(label) for label in self.wanted] or list(labels.numbers)
        left = [number for number in wanted if number not in hidden]
        if not left:
            raise UsageError("all labels are hidden: there is no mesh to make")
        return left

    def colors_of(
        self, labels: LabelMap, numbers: Sequence[int], distinct: bool
    ) -> dict[int, tuple[float, float, float]]:
        """Return the colours of labels: those given, and where wanted distinct ones for all others."""
        from clrecon.rendering.looks.colors import find_color
        from clrecon.rendering.looks.label_style import distinct_colors

        given = {}
        for label, color in self.colors:
            number = labels.find(label)
            if number in given:
                raise UsageError(f"label {number} {labels.name(number)} has two colours")
            given[number] = _as_tuple(find_color(color))
        if not distinct:
            return given
        own = distinct_colors(len(numbers))
        return {number: _as_tuple(color) for number, color in zip(numbers, own, strict=True)} | given


def _as_tuple(color: Any) -> tuple[float, float, float]:
    red, green, blue = (float(value) for value in color)
    return red, green, blue
