"""Settings that every job shares: which scan, which parts of it become air, and which device."""

from __future__ import annotations

import math
from dataclasses import dataclass

from clrecon.errors import UsageError
from clrecon.reading import Selection

__all__ = ["InputSettings"]


@dataclass(frozen=True, kw_only=True)
class InputSettings(Selection):
    """Settings of the input: what is read, which parts become air, and the device for the computation.

    Parameters
    ----------
    series, phase, allow_gaps, force
        See `clrecon.reading.Selection`.
    remove_table : bool
        First turn everything except the patient's body into air, see `clrecon.anatomy.body.remove_table`.
    allow_bone_loss : bool
        Continue even if this removes more than 2 % of the bone.
    field_of_view : float or "auto", optional
        First turn everything farther from the centre of the slices (mm) into air; "auto": the circle that fits them.
    keep_ids : bool
        Write the hashes of the UIDs of series and frame of reference into reports and mesh files.
    device : str, optional
        Name or index of an OpenCL device; None leaves the choice to `choose_device`.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.  A volume that does not fit is processed in
        slabs.

    Raises
    ------
    UsageError
        A value is impossible.
    """

    remove_table: bool = False
    allow_bone_loss: bool = False
    field_of_view: float | str | None = None
    keep_ids: bool = False
    device: str | None = None
    memory: int | None = None

    def __post_init__(self) -> None:
        if self.memory is not None and self.memory < 1:
            raise UsageError(f"the memory that may be taken must be above 0 bytes, not {self.memory}")
        if isinstance(self.field_of_view, str):
            if self.field_of_view != "auto":
                raise UsageError(f"the field of view is a radius in mm or auto, not {self.field_of_view!r}")
        elif self.field_of_view is not None and not (math.isfinite(self.field_of_view) and self.field_of_view > 0.0):
            raise UsageError(f"the radius of the field of view is a length in mm above 0, not {self.field_of_view:g}")
        if self.allow_bone_loss and not self.remove_table:
            raise UsageError("a loss of bone is allowed, but nothing takes any: ask for the removal of the table too")
