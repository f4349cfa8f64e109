"""Patient frames. Inside clrecon everything is LPS mm; RAS exists only at the border, under its own name.

LPS: x to the patient's left, y to the posterior, z to the superior (DICOM).  RAS: x right, y anterior (NIfTI).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.errors import UsageError

SPACES = ("lps", "ras")


def frame_from_lps(space: str) -> NDArray[np.float64]:
    """Return the 3x3 rotation from LPS mm to `space`.

    space: {"lps", "ras"}. Upper or lower case.
    """
    name = str(space).lower()
    if name == "lps":
        return np.eye(3)
    if name == "ras":
        return np.diag((-1.0, -1.0, 1.0))
    raise UsageError(f"unknown space {space!r}: use one of {', '.join(SPACES)}")


def lps_affine_from_ras(affine: ArrayLike) -> NDArray[np.float64]:
    """Turn an affine to RAS mm (NIfTI, FreeSurfer) into one to LPS mm; its own inverse.

    affine: array_like, shape (4, 4). Index (i, j, k) to RAS mm.

    Returns: ndarray, shape (4, 4), float64
    """
    return np.asarray(np.diag((-1.0, -1.0, 1.0, 1.0)) @ np.asarray(affine, dtype=np.float64), dtype=np.float64)


def choose_space(asked: str | None, named: object, what: str) -> str:
    """Return ``LPS`` or ``RAS``: the patient frame of what another library holds.

    asked: That of the caller; None: that which `named` says, else LPS.
    named: What the data themselves say, None where they say nothing.
    what: The data, for messages.
    """
    if asked is not None:
        frame_from_lps(asked)
    if named is None:
        return "LPS" if asked is None else asked.upper()
    told = str(named).upper()
    if told.lower() not in SPACES:
        raise UsageError(f"{what} names the frame {str(named)[:40]!r}: {' or '.join(SPACES)} are known")
    if asked is not None and asked.upper() != told:
        raise UsageError(f"{what} says that its coordinates are {told}, {asked.upper()} was asked for: leave space out")
    return told
