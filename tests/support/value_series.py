"""CT series of known values, written as a header wants, and then told to be something else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from dicom_series import Plan, set_values, write_series
from pydicom.dataset import Dataset
from pydicom.sequence import Sequence

SHAPE = (8, 96, 96)
CENTRE = 47.5


def radius_from(x: float = CENTRE, y: float = CENTRE) -> np.ndarray:
    """Distance of each pixel from a place, in pixels."""
    j, i = np.mgrid[: SHAPE[1], : SHAPE[2]]
    return np.hypot(i - x, j - y)


def make_layers(background: float, *layers: tuple[float, float], noise: float = 12.0, blur: float = 0.8) -> np.ndarray:
    """HU of layers (radius in voxels, HU) around the centre, from outside to inside, blurred and with noise."""
    from scipy.ndimage import gaussian_filter

    picture = np.full(SHAPE[1:], background)
    for limit, value in layers:
        picture[radius_from() < limit] = value
    hu = np.broadcast_to(gaussian_filter(picture, blur), SHAPE)
    return np.rint(hu + np.random.default_rng(5).normal(0.0, noise, SHAPE))


def make_body(*, noise: float = 12.0) -> np.ndarray:
    """Fat, muscle, spongy and dense bone in air; the dense bone is above 1024 HU, beyond the sign of 12 bits."""
    return np.maximum(make_layers(-1000, (40, -100), (35, 50), (12, 1500), (10, 250), noise=noise), -1024)


def make_jaw(
    *, slope: float = 1.0, offset: float = 400.0, padding: float | None = 0.0, noise: float = 40.0
) -> np.ndarray:
    """A jaw in a cone beam: values ``slope * HU + offset``, and one value outside of a round field of view."""
    hu = make_layers(-1000, (38, -90), (35, 50), noise=noise)
    i = np.arange(SHAPE[2]) - CENTRE
    bow = np.abs(radius_from(CENTRE, CENTRE - 6) - 24) < 3.5
    hu = np.where(bow & (i > -8)[:, None], hu + 1300, hu)
    values = np.rint(slope * hu + offset)
    return values if padding is None else np.where(radius_from() > 46, padding, values)


def make_table(*, undefined: bool = True) -> Sequence:
    """A Modality LUT of 4,096 entries, which is an inverted ramp, as a sequence of undefined or defined length."""
    table = Dataset()
    table.LUTDescriptor, table.ModalityLUTType = [4096, 0, 16], "US"
    table.add_new("LUTData", "OW", np.arange(4096)[::-1].astype("<u2").tobytes())
    table.is_undefined_length_sequence_item = undefined
    sequence = Sequence([table])
    sequence.is_undefined_length = undefined
    return sequence


def write_values(folder: Path, hu: np.ndarray, plan: Plan | None = None, **values: Any) -> Path:
    """Write HU by the slope and intercept of the plan; `values` then say otherwise."""
    plan = plan or Plan(shape=hu.shape)
    mask = (1 << plan.bits_stored) - 1

    def change(ds: Any, k: int) -> None:
        stored = np.rint((hu[k] - plan.intercept) / plan.slope).astype(np.int64)
        ds.PixelData = (stored & (mask if not plan.signed else 0xFFFF)).astype("<u2").tobytes()
        set_values(**values)(ds, k)

    write_series(folder, plan, change)
    return folder


def write_signed_as_unsigned(bits: int) -> Callable[[Path, np.ndarray], Path]:
    """Signed HU with intercept 0, in the stored bits, whose header says that they have no sign."""

    def write(folder: Path, hu: np.ndarray) -> Path:
        return write_values(folder, hu, Plan(shape=hu.shape, intercept=0, bits_stored=bits, signed=False))

    return write


def write_unsigned_as_signed(folder: Path, hu: np.ndarray) -> Path:
    """HU + 1024 in 12 bits without a sign, whose header says that the highest of them is one."""
    plan = Plan(shape=hu.shape, bits_stored=12, signed=False)
    return write_values(folder, hu, plan, PixelRepresentation=1)


def write_signed_codestream(folder: Path, hu: np.ndarray) -> Path:
    """JPEG 2000 whose codestream has a sign and whose header says that there is none."""
    import pytest

    imagecodecs = pytest.importorskip("imagecodecs")
    from pydicom.encaps import encapsulate
    from pydicom.uid import JPEG2000Lossless

    def change(ds: Any, k: int) -> None:
        frame = imagecodecs.jpeg2k_encode(hu[k].astype(np.int16), level=0, reversible=True, codecformat="j2k")
        ds.PixelData = encapsulate([bytes(frame)])
        ds["PixelData"].VR = "OB"
        ds["PixelData"].is_undefined_length = True

    plan = Plan(shape=hu.shape, intercept=0, signed=False, syntax=JPEG2000Lossless)
    write_series(folder, plan, change)
    return folder
