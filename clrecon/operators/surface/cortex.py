"""The outer surface of bone, read at each vertex of a level's surface from the whole profile of HU across its wall.

A blurred wall has no level that marks its place: thin walls stay low.  Three blurred plateaus (tissue, cortex, marrow)
are fitted to the profile along the vertex's normal.  Blur and density of the cortex are constants of a scan, measured
in some hundred of its profiles.

References
----------
Treece et al. 2010, "High resolution cortical bone thickness measurement from clinical CT data", Med. Image Anal. 14.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import DeviceMemoryError
from clrecon.geometry import Volume, slice_normal
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    describe_shortage,
    download,
    empty_output,
    kernel_constant,
    launch,
    load_program,
    upload,
)
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import voxel_variants
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import chunks
from clrecon.system.records import Record

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

SAMPLES = kernel_constant("surface/cortex.cl", "SAMPLES")
CENTRE = kernel_constant("surface/cortex.cl", "CENTRE")
FRAME = kernel_constant("surface/cortex.cl", "FRAME")
ROWS = kernel_constant("surface/cortex.cl", "ROWS")
RESULTS = kernel_constant("surface/cortex.cl", "RESULTS")

_PROFILES = "profiles across walls"
"""Purpose by which slabs are planned."""

PIECE, SMALLEST_PIECE = 1 << 16, 1 << 8
"""Places of a launch, whose profiles take 14 MB (pages of 56 MB were cleared anew by the system, 0.1 s of a thorax),
and the fewest where memory is short."""

STEP_MM = 0.5
"""Step of a profile at voxels of 1 mm3; half this step gave the same positions to within 0.003 mm."""

_COARSE = 2.0
"""Where slices are thicker than so many pixels, what interpolation between them adds to the blur is its mean over all
places: a series of three terms does not describe it there."""

_SMALLEST_SCALE, _LARGEST_SCALE = 0.001, 1.4
"""Bounds of the edge of a voxel's cube, mm, by which profiles are scaled."""

WEIGHT_MM, OUTWARD_MM = 2.2, 0.9
"""Standard deviations of the Gaussians that weight samples, and those outside where walls are placed, at voxels of 1
mm3: tissue outside is no plateau (a trunk lay 0.096 mm off with 1.2 outside, 0.092 with 0.9).  Constants are searched
with the first (else 1,314 HU for 1,000 in balls with walls of 2 mm), and thick slices, which blur beyond the second,
keep it (balls with walls of 1.5 mm lay 0.02 to 0.07 mm farther off)."""

INNER_SHARE, INNER_SPREAD, CORTEX_SPREAD, OUTER_SPREAD_HU = 0.25, 0.6, 0.15, 1000.0
"""Expected before the fit: marrow has 0.25 of the HU of cortex, with a spread of 0.6 of these HU; the cortex at one
position differs by 15 % from the cortex of the scan; tissue outside may have any HU from air on."""

_MODEL_ERROR = 0.025
"""What three plateaus leave of a profile without noise, as a share of the cortex' HU."""

CORRELATED_MM = 1.0
"""Samples nearer to each other than this, at voxels of 1 mm3, do not count as independent."""

RISE_HU, RISE_SIGMAS = 100.0, 3.0
"""A rise outwards by the larger of `RISE_HU` and `RISE_SIGMAS` times the noise belongs to another wall."""

_RISE_SHARE = 0.5
"""Of the cortex' HU, where walls are placed: the dark line that an edge-enhancing kernel draws beside bone ends none (a
phantom lay 0.10 mm off for 0.14).  Constants are searched without it (else a pelvis lay 0.115 mm off for 0.095)."""

SILENT_HU = 10.0
"""Noise that is assumed if a scan shows no soft tissue in which noise can be measured."""


@dataclass(frozen=True)
class ProfileScale:
    """The samples of a profile: at ``first_mm + n * step_mm``, outwards, with their weights, and those of places."""

    first_mm: float
    step_mm: float
    weights: Float32Array
    place_weights: Float32Array

    @classmethod
    def of(cls, volume: Volume, *, is_coarse: bool = False) -> ProfileScale:
        """Return the scale for a volume: by the edge of a cube as large as a voxel."""
        scale = float(np.clip(np.cbrt(np.prod(volume.spacing)), _SMALLEST_SCALE, _LARGEST_SCALE))
        step = STEP_MM * scale
        places = STEP_MM * (np.arange(SAMPLES) - CENTRE)
        outside_mm = WEIGHT_MM if is_coarse else OUTWARD_MM
        both = (np.where(places < 0.0, WEIGHT_MM, width) for width in (WEIGHT_MM, outside_mm))
        return cls(-step * CENTRE, step, *(np.exp(-0.5 * (places / widths) ** 2).astype(np.float32) for widths in both))


class StackFrame:
    """Where points lie between the slices of a volume, even or not: in steps of slice 0, and in mm of height.

    slices: ndarray, shape (nk, 4), float32. As the kernel takes them.
    steps: ndarray, shape (3, 3). From voxel to voxel along i, j and, at the usual gap, k, LPS mm.
    squares: Of the first two steps, mm2.
    """

    def __init__(self, volume: Volume):
        normal = slice_normal(volume.affine)
        if normal @ volume.affine[:3, 2] < 0.0:
            normal = -normal
        origins = volume.slice_origins()
        self._origin = origins[0]
        self._matrix = np.vstack([np.linalg.pinv(volume.affine[:3, :2]), normal])
        self._heights = (origins - self._origin) @ normal
        self.normal = normal
        self.gaps = np.diff(self._heights)
        self.usual_gap = float(np.median(self.gaps)) if len(self.gaps) else 1.0
        along_k = volume.affine[:3, 2]
        self.steps = np.stack([*volume.affine[:3, :2].T, along_k * (self.usual_gap / abs(along_k @ normal))])
        self.squares = np.square(self.steps[:2]).sum(axis=1).tolist()
        self.slices = np.zeros((len(origins), 4), np.float32)
        self.slices[:, :3] = (origins - self._origin) @ self._matrix.T
        self.slices[:-1, 3] = 1.0 / self.gaps

    def places(self, points: NDArray[np.floating]) -> Float32Array:
        """Return the kernel's places (4, n) of points (n, 3) in LPS mm; the last row is the slice at or below."""
        in_stack = self._turn(points, self._origin)
        layers = np.searchsorted(self._heights, in_stack[2], side="right") - 1
        return np.concatenate([in_stack, layers.clip(0, max(len(self._heights) - 2, 0))[None]], dtype=np.float32)

    def directions(self, normals: NDArray[np.floating]) -> Float32Array:
        """Return the kernel's directions (3, n) of unit vectors (n, 3) in LPS."""
        return self._turn(normals, np.zeros(3))

    def steps_along(self, normals: NDArray[np.floating], gap: Float32Array) -> Float32Array:
        """Return how far apart voxels lie along unit vectors (n, 3), mm.

        That is the fourth root of the sum of the fourth powers of what each axis has of it.

        gap: ndarray, shape (n,). Square of the gap between slices, in units of the usual one.
        """
        along = normals @ self.steps.T.astype(np.float32)
        along *= along
        along[:, 2] *= gap
        return np.asarray(np.sqrt(np.sqrt(np.einsum("na,na->n", along, along))), np.float32)

    def _turn(self, vectors: NDArray[np.floating], origin: Float64Array) -> Float32Array:
        turned = np.empty((3, len(vectors)), np.float32)
        x, y, z = np.ascontiguousarray(vectors.T) - origin[:, None]
        for row, (a, b, c) in zip(turned, self._matrix, strict=True):  # a product of matrices takes eight times as long
            row[:] = a * x + b * y + c * z
        return turned


@dataclass(frozen=True, eq=False)
class CortexConstants(Record):
    """Constants of a scan, measured in profiles across its walls, as docs/contract.md explains them.

    denser: The two widths and the HU at the dense end of those that describe the profiles as well, where all walls are
        thin and alike: there only the three together are known.
    """

    blur_mm: float
    blur_across_mm: float
    cortex_hu: float
    blur_error_mm: float
    blur_across_error_mm: float
    cortex_error_hu: float
    noise_hu: float | None
    residual_hu: float
    places: int
    thick: int
    denser: list[float] | None = None

    @property
    def cortex_spread(self) -> float:
        """Share by which the cortex of a place may differ."""
        return max(CORTEX_SPREAD, self.cortex_error_hu / self.cortex_hu)

    def at_dense_end(self) -> CortexConstants:
        """Return the constants with those of `denser`, which must be there, in place of its own."""
        assert self.denser is not None
        blur_mm, across_mm, cortex_hu = self.denser
        return self.changed(blur_mm=blur_mm, blur_across_mm=across_mm, cortex_hu=cortex_hu)

    @property
    def known_noise(self) -> float:
        """Noise that fits reckon with."""
        return SILENT_HU if self.noise_hu is None else self.noise_hu


@dataclass(frozen=True)
class WallFits:
    """Fits at places, shape (n,) each, float32.

    shift_mm: From the vertex to the outer surface of the wall, outwards positive.
    thickness_mm: At most the length of a profile, which stands for solid bone.
    outer_hu, cortex_hu, inner_hu: The plateaus.
    residual_hu: Root mean square of what the fit leaves.
    shift_variance: mm2 for samples with a variance of 1 HU2 each.
    peak_hu: Highest value; NaN where the vertex lies beyond the volume.
    room_mm: From the vertex outwards to the next wall, or to the end of the profile.
    """

    shift_mm: Float32Array
    thickness_mm: Float32Array
    outer_hu: Float32Array
    cortex_hu: Float32Array
    inner_hu: Float32Array
    residual_hu: Float32Array
    shift_variance: Float32Array
    peak_hu: Float32Array
    room_mm: Float32Array

    def rows(self) -> tuple[Float32Array, ...]:
        """Return all of them, in the order of the kernel."""
        return tuple(vars(self).values())


def blurs_of(frames: Float32Array, blur_mm: float, across_mm: float) -> Float32Array:
    """Return the width of the blur along profiles, mm, from their frames (2, n): it grows with the slices' gap."""
    steep, gap = frames
    across = np.maximum(blur_mm**2 + (across_mm**2 - blur_mm**2) * gap, 0.1 * blur_mm**2)
    return np.asarray(np.sqrt(blur_mm**2 * (1.0 - steep) + across * steep), np.float32)


def unexplained_hu(cortex_hu: float, noise_hu: float) -> float:
    """Return the standard deviation of samples around the model: noise, and what three plateaus do not describe."""
    return float(np.hypot(_MODEL_ERROR * cortex_hu, noise_hu))


class WallProfiles:
    """Profiles of places on the device, which can be fitted again and again with other constants.

    values_d: buffer, (ROWS, stride) float32, see cl/surface/cortex.cl
    """

    def __init__(self, sampler: ProfileSampler, values_d: Any, count: int):
        self._device, self._program = sampler.device, sampler.program
        self._scale = sampler.scale
        self._values_d, self._count = values_d, count
        self._stride = stride_of(count)
        self._weights_d = upload(self._device, self._scale.weights)
        self._place_weights_d = upload(self._device, self._scale.place_weights)

    def fit(
        self, blur_mm: float, across_mm: float, cortex_hu: float, noise_hu: float, *,
        cortex_spread: float = CORTEX_SPREAD, finds_place: bool = False,
    ) -> WallFits:  # fmt: skip
        """Fit a wall to each profile; to find its place, what is farther outside counts less, as do low rises."""
        device, lanes = self._device, int(self._device.kernel_variants["LANES"])
        fits, fits_d = empty_output(device, (RESULTS, self._stride), np.float32)
        outer, cortex, inner = expected_precisions(cortex_hu, noise_hu, cortex_spread)
        rise = max(RISE_HU, RISE_SIGMAS * noise_hu, _RISE_SHARE * cortex_hu if finds_place else 0.0)
        launch(
            device, self._program["fit_profiles"], -(-self._count // lanes),
            profiles=self._values_d, weights=self._place_weights_d if finds_place else self._weights_d, fits=fits_d,
            first_mm=self._scale.first_mm, step_mm=self._scale.step_mm, blur=blur_mm, across=across_mm,
            cortex=cortex_hu, inner=INNER_SHARE * cortex_hu, keep_outer=outer, keep_cortex=cortex, keep_inner=inner,
            rise=rise, stride=self._stride, count=self._count,
        )  # fmt: skip
        return WallFits(*download(device, fits, fits_d)[:, : self._count])

    def frames(self) -> Float32Array:
        """Return the frames of the profiles, shape (FRAME, n): how each lies across the slices, and their gap there."""
        rows = np.empty((FRAME, self._stride), np.float32)
        return download(self._device, rows, self._values_d, 4 * SAMPLES * self._stride)[:, : self._count]

    def fit_with(self, constants: CortexConstants) -> WallFits:
        """Fit a wall to each profile with the constants of a scan."""
        return self.fit(
            constants.blur_mm, constants.blur_across_mm, constants.cortex_hu, constants.known_noise,
            cortex_spread=constants.cortex_spread, finds_place=True,
        )  # fmt: skip


def stride_of(count: int) -> int:
    """Return the places of a row on the device: whole vectors of sixteen."""
    return 16 * -(-count // 16)


def expected_precisions(cortex_hu: float, noise_hu: float, cortex_spread: float) -> tuple[float, float, float]:
    """Return the weights of what is expected of outer, cortex and inner HU, in units of a sample's weight."""
    variance = unexplained_hu(cortex_hu, noise_hu) ** 2 * CORRELATED_MM / STEP_MM
    spreads = (OUTER_SPREAD_HU, cortex_spread * cortex_hu, INNER_SPREAD * cortex_hu)
    outer, cortex, inner = (variance / spread**2 for spread in spreads)
    return outer, cortex, inner


def prepare_profiles(device: Device, dtype: DTypeLike = np.int16, *, cubic: bool = False) -> Program:
    lanes = {name: value for name, value in device.kernel_variants.items() if "LANES" in name}
    return load_program(
        device, "surface/cortex.cl", {**voxel_variants(dtype), **lanes, **({"CUBIC": "1"} if cubic else {})}
    )


class ProfileSampler:
    """Samples profiles of a volume on a device, slab by slab where it does not fit as a whole; the same bits then.

    cubic: Values between slices are those of a cubic convolution of four, not linear ones of two.
    """

    def __init__(self, resident: DeviceVolume, stopwatch: Stopwatch, *, cubic: bool = False):
        self._resident, self._stopwatch = resident, stopwatch
        self._cubic = cubic
        self.device = resident.device
        self.frame = StackFrame(resident.volume)
        is_coarse = self.frame.usual_gap > _COARSE * float(np.sqrt(np.mean(self.frame.squares)))
        self.scale = ProfileScale.of(resident.volume, is_coarse=is_coarse)
        self._known_k = 0.0 if cubic or is_coarse else 1.0
        with stopwatch.timed("build"):
            self.program = prepare_profiles(self.device, resident.dtype, cubic=cubic)

    def pieces(
        self, points: NDArray[np.floating], normals: NDArray[np.floating], rows: NDArray[np.intp]
    ) -> Iterator[tuple[NDArray[np.intp], Any]]:
        """Yield some rows of points piece by piece, and the values of each on the device, (ROWS, stride)."""
        if not len(rows):
            return
        resident, nk = self._resident, self._resident.volume.shape_ijk[2]
        least_gap = float(self.frame.gaps.min()) if nk > 1 else 1.0
        reach = int(np.ceil(-self.scale.first_mm / least_gap)) + 1 + self._cubic
        piece = min(PIECE, len(rows))

        def needs(slices: int) -> dict[str, int]:
            held_bytes = min(slices + 2 * reach + 1, nk) * resident.slice_bytes
            profile_bytes = (4 * (ROWS + RESULTS) + 32) * stride_of(piece)
            return {"volume": held_bytes, "profiles": profile_bytes, "slices": self.frame.slices.nbytes}

        while (planned := resident.plan(_PROFILES, nk, needs)) < 1 and piece > SMALLEST_PIECE:
            piece //= 2
        if planned < 1:
            raise DeviceMemoryError(f"no profiles can be sampled: {describe_shortage(resident.limits, needs(1))}")
        if planned >= nk:
            voxels_d = resident.whole(self._stopwatch)
            for span in chunks(len(rows), piece):
                yield rows[span], self._sample(voxels_d, 0, points[rows[span]], normals[rows[span]])
            return
        layers = self.frame.places(points[rows])[3]
        for first in range(0, nk, planned):
            low, high = max(first - reach, 0), min(first + planned + reach + 1, nk)
            of_slab = rows[(layers >= first) & (layers < first + planned)]
            if not len(of_slab):
                continue
            voxels_d = resident.part(low, high, self._stopwatch)
            for span in chunks(len(of_slab), piece):
                yield of_slab[span], self._sample(voxels_d, low, points[of_slab[span]], normals[of_slab[span]])
            resident.volume.release_slices(low, high)

    def _sample(self, voxels_d: Any, first_k: int, points: NDArray[np.floating], normals: NDArray[np.floating]) -> Any:
        device, (ni, nj, nk) = self.device, self._resident.volume.shape_ijk
        count, lanes = len(points), int(device.kernel_variants["LANES"])
        stride = stride_of(count)
        in_stack = (self.frame.places(points), self.frame.directions(normals))
        places, directions = (np.pad(rows, ((0, 0), (0, stride - count)), mode="edge") for rows in in_stack)
        values_d = allocate(device, 4 * ROWS * stride)
        launch(
            device, self.program["sample_profiles"], -(-count // lanes), voxels=voxels_d,
            slices=upload(device, self.frame.slices), places=upload(device, places),
            directions=upload(device, directions), profiles=values_d,
            ni=ni, nj=nj, nk=nk, first_k=first_k, first_mm=self.scale.first_mm, step_mm=self.scale.step_mm,
            usual_gap=self.frame.usual_gap, i_square=self.frame.squares[0], j_square=self.frame.squares[1],
            known_k=self._known_k, stride=stride, count=count,
        )  # fmt: skip
        return values_d

    def values(self, points: NDArray[np.floating], normals: NDArray[np.floating]) -> Float32Array:
        """Return the profiles, shape (ROWS, n): HU, NaN beyond the volume, and what blurs them."""
        profile_values = np.empty((ROWS, len(points)), np.float32)
        for rows, values_d in self.pieces(points, normals, np.arange(len(points))):
            stride = stride_of(len(rows))
            piece = download(self.device, np.empty((ROWS, stride), np.float32), values_d)
            profile_values[:, rows] = piece[:, : len(rows)]
        return profile_values

    def take(self, values: Float32Array) -> WallProfiles:
        """Return profiles (ROWS, n) as they are fitted on the device."""
        count = values.shape[1]
        padded = np.zeros((ROWS, stride_of(count)), np.float32)
        padded[:, :count] = values
        return WallProfiles(self, upload(self.device, padded), count)
