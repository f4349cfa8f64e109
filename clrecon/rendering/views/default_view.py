"""The side from which a picture is taken where none is named."""

from __future__ import annotations

import numpy as np

from clrecon.geometry.grid import Grid
from clrecon.rendering.views.directions import find_view

ANTERIOR = "anterior"

SLICES_VIEWS = ("30,30", "-60,30", "75,-30")
"""Views of slices in space, the first of which shows slices across any axis of the patient.  No plane holds all three
directions, so slices that are edge-on in one of them show in another."""

LEAST_COSINE = 0.25
"""Slices are shown by a view where its cosine to their normal is at least this: a quarter of their height is seen."""


def default_view(mode: str, grid: Grid) -> str:
    """Return the view of a mode in `render`: anterior, and for slices in space one from which they show.

    That is the first of `SLICES_VIEWS` that shows the slices of the volume well, else the one that shows them best.
    """
    if mode != "slices":
        return ANTERIOR
    normal = np.cross(grid.affine[:3, 0], grid.affine[:3, 1])
    normal = normal / np.linalg.norm(normal)
    cosines = [abs(float(find_view(view)[0] @ normal)) for view in SLICES_VIEWS]
    shown = [n for n, cosine in enumerate(cosines) if cosine >= LEAST_COSINE]
    return SLICES_VIEWS[shown[0] if shown else int(np.argmax(cosines))]
