"""Checks that the settings of several jobs share."""

from __future__ import annotations

import math

from clrecon.errors import UsageError

__all__ = ["check_bone_loss", "check_field_of_view", "check_memory"]


def check_memory(memory: int | None) -> None:
    """Refuse an amount of memory that is none.

    Raises
    ------
    UsageError
        It is below 1 byte.
    """
    if memory is not None and memory < 1:
        raise UsageError(f"the memory that may be taken must be above 0 bytes, not {memory}")


def check_bone_loss(remove_table: bool, allow_bone_loss: bool) -> None:
    """Refuse a loss that nothing can cause.

    Raises
    ------
    UsageError
        The loss of bone is allowed, and no table is to be removed.
    """
    if allow_bone_loss and not remove_table:
        raise UsageError("a loss of bone is allowed, but nothing takes any: ask for the removal of the table too")


def check_field_of_view(view: float | str | None) -> None:
    """Refuse a field of view that is neither a radius in mm nor "auto".

    Raises
    ------
    UsageError
        It is neither.
    """
    if isinstance(view, str):
        if view != "auto":
            raise UsageError(f"the field of view is a radius in mm or auto, not {view!r}")
    elif view is not None and not (math.isfinite(view) and view > 0.0):
        raise UsageError(f"the radius of the field of view is a length in mm above 0, not {view:g}")
