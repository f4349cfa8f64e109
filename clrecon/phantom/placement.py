"""Where the slices of a phantom lie in the patient.

Positions are rounded to the decimal strings that a DICOM header can hold *before* the affine is taken from them,
so that voxels, written files and truth all belong to exactly the same affine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import compose_affine
from clrecon.phantom.frames import slice_directions
from clrecon.phantom.settings import CENTRE_LPS_MM, PhantomSettings

Float64Array = NDArray[np.float64]


def format_decimal(value: float) -> str:
    """Write a number as a DICOM decimal string: at most 16 characters, as many digits as fit."""
    if not math.isfinite(value):
        raise UsageError(f"{value} cannot be written as a decimal string")
    value = float(value) + 0.0  # no minus zero
    text = repr(value)
    if text.endswith(".0"):
        text = text[:-2]
    digits = 16
    while len(text) > 16:
        digits -= 1
        text = f"{value:.{digits}g}"
    return "0" if float(text) == 0.0 else text


@dataclass(frozen=True)
class Placement:
    """Where the slices lie: the decimal strings of the files, and the affine that these strings give.

    orientation: Row cosines, then column cosines.
    pixel_spacing: dj, di in mm.
    positions: Centre of pixel (0, 0) of every slice, LPS mm.
    slice_thickness, tilt: dk in mm and the gantry tilt in degrees.
    affine: ndarray, shape (4, 4). Index (i, j, k) to LPS mm; in an uneven stack that of even slices between the first
        and the last.
    places: ndarray, shape (slices,). k of each slice in the affine: 0, 1, 2 and so on, but for an uneven stack.
    """

    orientation: list[str]
    pixel_spacing: list[str]
    positions: list[list[str]]
    slice_thickness: str
    tilt: str
    affine: Float64Array
    places: Float64Array


def _slice_places(settings: PhantomSettings) -> Float64Array:
    """Return where the slices lie along k: the first and the last of an uneven stack lie as in an even one."""
    places = np.arange(settings.slices, dtype=np.float64)
    if settings.uneven_mm > 0.0:
        share = settings.uneven_mm / settings.spacing[2]
        places[1:-1] += np.random.default_rng((settings.seed, 23)).uniform(-0.5, 0.5, len(places[1:-1])) * share
    return places


def place_slices(settings: PhantomSettings) -> Placement:
    """Compute orientation and positions of all slices, centred on `CENTRE_LPS_MM`."""
    dj, di, dk = settings.spacing
    row, column, step = slice_directions(settings.tilt, settings.oblique, settings.prone, dk)

    orientation = [format_decimal(value) for value in (*row, *column)]
    pixel_spacing = [format_decimal(dj), format_decimal(di)]
    cosines = np.array([float(text) for text in orientation])
    i_step, j_step = cosines[:3] * float(pixel_spacing[1]), cosines[3:] * float(pixel_spacing[0])
    middle = np.array((*settings.size, settings.slices), dtype=np.float64) / 2.0 - 0.5
    first = np.array(CENTRE_LPS_MM) - middle @ np.array((i_step, j_step, step))
    places = _slice_places(settings)
    positions = [[format_decimal(value) for value in first + k * step] for k in places]
    written = np.array(positions, dtype=np.float64)
    k_step = (written[-1] - written[0]) / (settings.slices - 1) if settings.slices > 1 else step
    return Placement(
        orientation=orientation,
        pixel_spacing=pixel_spacing,
        positions=positions,
        slice_thickness=format_decimal(dk),
        tilt=format_decimal(settings.tilt),
        affine=compose_affine(i_step, j_step, k_step, written[0]),
        places=places,
    )
