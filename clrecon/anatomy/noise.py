"""The noise of a scan, measured in soft tissue."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import list_distinct

SOFT_TISSUE_HU = (-150.0, 250.0)
"""Blocks for measuring noise lie in this range: fat, muscle, organs with up to 60 HU of noise; no air or dense bone."""

BLOCK = 6
"""Voxels along each side of a block within a slice."""

MOST_SLICES = 24
"""Slices that are looked at, evenly over the volume."""

_FEWEST_BLOCKS = 50

_QUARTILE_OF_NOISE = 0.9149
"""First quartile of the standard deviation of 36 normal numbers without their plane (33 degrees of freedom), over the
standard deviation of the numbers: sqrt(27.62 / 33), with 27.62 the first quartile of chi squared."""


@dataclass(frozen=True)
class Noise:
    """What `measure_noise` found.

    Attributes
    ----------
    hu : float
        Standard deviation.
    blocks : int
        Blocks of soft tissue that it was measured in.
    slices : int
        Slices that were looked at.
    """

    hu: float
    blocks: int
    slices: int


@explains_arguments
def measure_noise(volume: Volume) -> Noise:
    """Measure the noise of a scan: the standard deviation of HU within soft tissue.

    Blocks of 6 x 6 voxels in a slice, all within -150 to 250 HU, lose their mean and their slopes; what is left has a
    standard deviation each.  Edges and textures make it larger, so that the first quartile over all blocks stands for
    those without, divided by what the first quartile is for noise alone.  It holds where a quarter of the blocks and
    more are even, as in muscle and fat.

    Parameters
    ----------
    volume : Volume

    Raises
    ------
    UsageError
        There are fewer than 50 blocks of soft tissue.
    """
    nk = volume.shape_ijk[2]
    ks = list_distinct(np.linspace(0, nk - 1, min(nk, MOST_SLICES)).round().astype(int)).tolist()
    deviations = np.concatenate([_block_deviations(volume.voxels[k]) for k in ks])
    if len(deviations) < _FEWEST_BLOCKS:
        low, high = SOFT_TISSUE_HU
        raise UsageError(
            f"the noise cannot be measured: {len(deviations)} blocks of {BLOCK} x {BLOCK} voxels in {len(ks)} slices"
            f" lie from {low:g} to {high:g} HU as soft tissue does, at least {_FEWEST_BLOCKS} are needed"
        )
    return Noise(float(np.percentile(deviations, 25.0)) / _QUARTILE_OF_NOISE, len(deviations), len(ks))


_NOISE_OF_GRADIENTS = 3.0
"""HU per mm that noise may leave in the gradients of a smoothed volume; edges of bone have some hundred.  With it the
smoothing is where pictures are most like those with true normals, `python scripts/proof/measure_grain.py`."""

_GAUSSIAN_GAIN = 2.0**0.5 * (4.0 * np.pi) ** 0.75
"""White noise of n HU in voxels of v cubic mm leaves n sqrt(v) / (this sigma ^ 2.5) HU per mm in gradients of a volume
that is smoothed by a Gaussian of sigma mm."""

_MOST_VOXELS = 3.0
"""Longest standard deviation as a multiple of the voxel."""

_REACH = 2.5
"""Standard deviations up to which a Gaussian is taken."""


def choose_smoothing(volume: Volume) -> float:
    """Return the standard deviation in mm of the Gaussian that takes the grain from gradients: a voxel (the cube root
    of its volume), or as much more as the measured noise needs.
    """
    cubic_mm = float(np.prod(volume.spacing))
    try:
        noise = measure_noise(volume).hu
    except UsageError:  # too little soft tissue
        noise = 0.0
    voxel = cubic_mm ** (1.0 / 3.0)
    wanted = (noise * cubic_mm**0.5 / (_GAUSSIAN_GAIN * _NOISE_OF_GRADIENTS)) ** 0.4
    return min(max(voxel, wanted), _MOST_VOXELS * voxel)


def gaussian_weights(sigma: float) -> NDArray[np.float32]:
    """Return the weights of a sample and of those at each distance on either side, `sigma` in samples; 1 below 0.25."""
    reach = math.ceil(_REACH * sigma) if sigma >= 0.25 else 0
    weights = np.exp(-0.5 * (np.arange(reach + 1) / max(sigma, 0.25)) ** 2)
    return (weights / (2.0 * weights.sum() - weights[0])).astype(np.float32)


def _block_deviations(layer: NDArray[Any]) -> NDArray[np.float64]:
    """Return the standard deviations of the blocks of soft tissue of a slice, without their planes."""
    nj, ni = (BLOCK * (n // BLOCK) for n in layer.shape)
    low, high = SOFT_TISSUE_HU
    is_soft = (layer >= low) & (layer <= high)
    is_soft = np.logical_and.reduce([is_soft[j:nj:BLOCK] for j in range(BLOCK)])
    is_soft = np.logical_and.reduce([is_soft[:, i:ni:BLOCK] for i in range(BLOCK)])
    tiles = layer[:nj, :ni].reshape(nj // BLOCK, BLOCK, ni // BLOCK, BLOCK).swapaxes(1, 2)
    soft = tiles[is_soft].astype(np.float64)
    soft -= soft.mean(axis=(1, 2), keepdims=True)
    steps = np.arange(BLOCK) - (BLOCK - 1) / 2.0
    square = BLOCK * float(steps @ steps)
    along_i, along_j = np.einsum("nji,i->n", soft, steps) / square, np.einsum("nji,j->n", soft, steps) / square
    left = np.einsum("nji,nji->n", soft, soft) - square * (along_i**2 + along_j**2)
    deviations: NDArray[np.float64] = np.sqrt(np.maximum(left, 0.0) / (BLOCK * BLOCK - 3))
    return deviations
