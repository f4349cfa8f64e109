"""Volumes that surfaces are found in, and what a sound surface is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from clrecon.geometry import Volume

OBLIQUE = np.array([[0.7, 0.1, 0.05, -250.0], [-0.1, 0.5, 0.2, -300.0], [0.0, 0.05, 2.5, -846.0], [0, 0, 0, 1.0]])

MIRRORED = OBLIQUE @ np.diag((-1.0, 1.0, 1.0, 1.0))

SHAPES = [(5, 7, 9), (4, 4, 30), (3, 5, 31), (3, 5, 32), (4, 3, 33), (2, 3, 63), (3, 2, 64), (2, 4, 65), (3, 3, 100),
          (2, 3, 1023), (2, 2, 1024), (2, 3, 1030), (3, 2, 2100)]  # fmt: skip
"""(nk, nj, ni) on both sides of a mask word (32 samples) and of a word of flags (1024 samples)."""


def random_volume(
    shape: Sequence[int], *, dtype: DTypeLike = "int16", high: int = 6, affine: np.ndarray = OBLIQUE, seed: int = 0
) -> Volume:
    """Whole numbers from 0 to below `high`, without any order."""
    return Volume(np.random.default_rng(seed).integers(0, high, shape).astype(dtype), affine)


def random_labels(shape: Sequence[int], seed: int = 1, numbers: Sequence[int] = (0, 0, 3, 7, 300)) -> np.ndarray:
    """Blocks of labels, and single voxels of others."""
    random = np.random.default_rng(seed)
    coarse = random.choice(np.array(numbers, np.uint16), [-(-n // 3) for n in shape])
    labels = coarse.repeat(3, 0).repeat(3, 1).repeat(3, 2)[: shape[0], : shape[1], : shape[2]]
    odd = random.random(shape) < 0.1
    return np.where(odd, random.choice(np.array(numbers, np.uint16), shape), labels)


def smooth_volume(shape: Sequence[int] = (23, 27, 45), *, affine: np.ndarray = OBLIQUE, seed: int = 1) -> Volume:
    """Noise blurred by two voxels, int16 with a deviation of 300 HU about 0."""
    from scipy.ndimage import gaussian_filter

    field = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 2.0)
    return Volume((field / field.std() * 300).astype(np.int16), affine)


def assert_sound(mesh: Any) -> None:
    """Closed, manifold, outward, no zero-area face and none twice, every vertex used."""
    quality = mesh.quality()
    assert quality["closed"] and quality["manifold"] and quality["oriented"]
    assert quality["volume_ml"] > 0.0
    assert (quality["zero_area_faces"], quality["duplicate_faces"]) == (0, 0)
    assert quality["unused_vertices"] == 0


MIDDLE = np.array([19.5, 19.0, 18.0])


def hollow_ball(
    *, radius: float = 13.0, thickness: float | np.ndarray = 2.0, blur: float = 0.7, cortex: float = 1000.0,
    inner: float = 200.0, spacing: Sequence[float] = (1.0, 1.0, 1.0),
) -> Volume:  # fmt: skip
    """A blurred shell of bone in tissue of 50 HU, its middle at `MIDDLE` mm; its thickness at each voxel, or at all."""
    from scipy.special import ndtr

    shape = [round(39.0 / step) + 1 for step in spacing]
    i, j, k = (np.arange(n) * step for n, step in zip(shape, spacing, strict=True))
    far = np.sqrt((i - MIDDLE[0]) ** 2 + ((j - MIDDLE[1]) ** 2)[:, None] + ((k - MIDDLE[2]) ** 2)[:, None, None])
    outer, hollow = ndtr((far - radius) / blur), ndtr((radius - thickness - far) / blur)
    values = 50.0 * outer + inner * hollow + cortex * (1.0 - outer - hollow)
    return Volume(np.rint(values).astype(np.int16), np.diag([*spacing, 1.0]))
