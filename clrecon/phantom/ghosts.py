"""Ghosts of a phantom: foreign slices in its stack and a localizer in its folder, as they come from real archives."""

from __future__ import annotations

from copy import deepcopy
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import column_spacing, slice_normal
from clrecon.geometry.affine import Float64Array

if TYPE_CHECKING:
    from pydicom.dataset import FileDataset

FEWEST_SLICES = 12
"""Fewest slices of a phantom with ghosts: two foreign ones with real ones between, before and behind them."""

PLACES = (0.35, 0.65)
"""Foreign slices as shares of the stack."""

BACKGROUND_HU, TEXT_HU = -1000, 2000


def ghost_places(slices: int) -> tuple[int, int]:
    """Return the numbers of the two foreign slices of a stack."""
    if slices < FEWEST_SLICES:
        raise UsageError(f"{slices} slices have no room for ghosts: at least {FEWEST_SLICES} are needed")
    first, second = (round(share * slices) for share in PLACES)
    return first, second


def draw_ghosts(voxels: NDArray[np.int16], seed: int) -> dict[str, Any]:
    """Replace two slices of a stack: by a screen capture, and by a sagittal view of the stack itself.

    voxels: ndarray, shape (nk, nj, ni), int16. HU, changed in place.

    Returns: What the truth says of them.
    """
    capture, sagittal = ghost_places(len(voxels))
    view = _sagittal(voxels)
    rows = np.arange(voxels.shape[1]) * view.shape[0] // voxels.shape[1]
    columns = np.arange(voxels.shape[2]) * view.shape[1] // voxels.shape[2]
    voxels[sagittal] = view[rows][:, columns]
    voxels[capture] = _screen_capture(voxels.shape[1:], seed)
    return {
        "slices": [
            {"slice": capture, "shows": "a screen capture"},
            {"slice": sagittal, "shows": "a sagittal view of the stack"},
        ]
    }


def _sagittal(voxels: NDArray[np.int16]) -> NDArray[np.int16]:
    """Return the highest value along each row of the volume: columns run along j, rows from the last slice down."""
    return voxels.max(axis=2)[::-1]


def _screen_capture(shape: tuple[int, ...], seed: int) -> NDArray[np.int16]:
    """Draw a frame, and lines of letters that are filled rectangles."""
    rows, columns = shape
    page = np.full(shape, BACKGROUND_HU, np.int16)
    edge = max(1, min(rows, columns) // 64)
    page[edge : 2 * edge] = page[-2 * edge : -edge] = TEXT_HU
    page[:, edge : 2 * edge] = page[:, -2 * edge : -edge] = TEXT_HU
    rng = np.random.default_rng([seed, 7])
    height = max(2, rows // 24)
    for top in range(3 * height, rows - 2 * height, 2 * height):
        left = 4 * edge
        while left < columns - 8 * edge:
            width = int(rng.integers(1, 4)) * edge
            if rng.random() < 0.7:
                page[top : top + height, left : left + width] = TEXT_HU
            left += width + edge
    return page


def make_localizer(
    slice_header: FileDataset, voxels: NDArray[np.int16], affine: Float64Array, number: int, instance: str
) -> tuple[FileDataset, NDArray[np.int16]]:
    """Return header and HU of a sagittal localizer of the stack, in the series of its slices.

    voxels: ndarray, shape (nk, nj, ni), int16
    affine: ndarray, shape (4, 4)
    number: InstanceNumber.
    instance: SOPInstanceUID.
    """
    from pydicom.uid import UID

    header = deepcopy(slice_header)
    view = np.ascontiguousarray(_sagittal(voxels))
    _, dj, dk = column_spacing(affine)
    along = affine[:3, 1] / np.linalg.norm(affine[:3, 1])
    down = slice_normal(affine)
    if down @ affine[:3, 2] > 0.0:
        down = -down
    middle = ((voxels.shape[2] - 1) / 2.0, 0.0, len(voxels) - 1.0)
    header.file_meta.MediaStorageSOPInstanceUID = header.SOPInstanceUID = UID(instance)
    header.ImageType = ["ORIGINAL", "PRIMARY", "LOCALIZER"]
    header.InstanceNumber = str(number)
    header.ImagePositionPatient = [f"{value:.8g}" for value in affine[:3, :3] @ middle + affine[:3, 3]]
    header.ImageOrientationPatient = [f"{value + 0.0:.8g}" for value in (*along, *down)]
    header.Rows, header.Columns = view.shape
    header.PixelSpacing = [f"{dk:.8g}", f"{dj:.8g}"]
    return header, view
