"""Pure numpy: affines, patient frames and the `Volume` that carries them."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from clrecon.geometry.affine import (
    apply_affine,
    column_spacing,
    compose_affine,
    is_left_handed,
    normal_matrix,
    slice_normal,
    tilt_degrees,
)
from clrecon.geometry.frames import SPACES, frame_from_lps, lps_affine_from_ras
from clrecon.geometry.grid import Grid
from clrecon.geometry.volume import AIR_HU, Volume

if TYPE_CHECKING:
    from clrecon.geometry.iso_choice import IsoChoice, choose_iso_value, half_iso_value

__all__ = [
    "AIR_HU",
    "Grid",
    "IsoChoice",
    "SPACES",
    "Volume",
    "apply_affine",
    "choose_iso_value",
    "column_spacing",
    "compose_affine",
    "frame_from_lps",
    "half_iso_value",
    "is_left_handed",
    "lps_affine_from_ras",
    "normal_matrix",
    "slice_normal",
    "tilt_degrees",
]


def __getattr__(name: str) -> Any:
    """Load the choice of an iso value when it is asked for: reading a scan does not need it."""
    if name not in ("IsoChoice", "choose_iso_value", "half_iso_value"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("clrecon.geometry.iso_choice"), name)
