"""The choice of labels that become meshes, and the kind of their surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from clrecon.errors import UsageError
from clrecon.system.wording import name_parameter

__all__ = ["LabelChoice"]


@dataclass(frozen=True)
class LabelChoice:
    """The labels of a map that become meshes, and the kind of their surfaces.

    Parameters
    ----------
    path : path
        NIfTI, NRRD or DICOM SEG.
    wanted : tuple of str or int
        Numbers or names; empty means all that have a surface.
    grow_mm : float, optional
        See `clrecon.operators.surface.labels.extract_labels`.
    solid : bool
        True: fill less dense parts within a label.
    surface : {"hu", "mask"}
        HU place the vertices (`clrecon.operators.surface.labels.extract_labels`), or each label has its own surface
        (`clrecon.operators.surface.label_masks.extract_label_masks`).

    Raises
    ------
    UsageError
        `surface` is unknown, or growth or filling by HU is asked for although HU are not used.
    """

    path: str | Path
    wanted: tuple[str | int, ...] = ()
    grow_mm: float | None = None
    solid: bool = False
    surface: str = "hu"

    def __post_init__(self) -> None:
        if self.surface not in ("hu", "mask"):
            raise UsageError(f"labels have no surface {self.surface!r}: it is hu or mask")
        if self.surface == "mask" and (self.solid or self.grow_mm is not None):
            raise UsageError(
                f"the surface of a mask is solid and does not grow: leave out {name_parameter('solid')} and"
                f" {name_parameter('grow_mm')}"
            )
