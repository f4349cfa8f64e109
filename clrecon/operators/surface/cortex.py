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
from numpy.typing import NDArray

from clrecon.anatomy.noise import measure_noise
from clrecon.errors import DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.geometry import METAL_HU, Volume, slice_normal
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
from clrecon.system.records import Record

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

SAMPLES = kernel_constant("surface/cortex.cl", "SAMPLES")
CENTRE = kernel_constant("surface/cortex.cl", "CENTRE")
ROWS = kernel_constant("surface/cortex.cl", "ROWS")
RESULTS = kernel_constant("surface/cortex.cl", "RESULTS")

PROFILES = "profiles across walls"
"""Purpose by which slabs are planned."""

PIECE, SMALLEST_PIECE = 1 << 18, 1 << 8
"""Places of a launch, and the fewest where memory is short."""

STEP_MM = 0.5
"""Step of a profile where voxels have 1 mm3; half of it gave the same places to 0.003 mm."""

SMALLEST_SCALE, LARGEST_SCALE = 0.15, 1.4
"""Bounds of the edge of a voxel's cube, mm, by which profiles are scaled."""

WEIGHT_MM = 2.2
"""Width of the Gaussian of the samples' weights, at a scale of 1 mm."""

INNER_SHARE, INNER_SPREAD, CORTEX_SPREAD, OUTER_SPREAD_HU = 0.25, 0.6, 0.15, 1000.0
"""What is expected before the fit: marrow has a quarter of the HU of cortex, within 0.6 of them; the cortex of a place
lies within 15 % of that of the scan; tissue may be anything from air on."""

MODEL_ERROR = 0.025
"""What three plateaus leave of a profile without noise, as a share of the cortex' HU."""

CORRELATED_MM = 1.0
"""Samples nearer than this, at a scale of 1 mm, do not count as several."""

RISE_HU, RISE_SIGMAS = 100.0, 3.0
"""HU that rise by so much outwards belong to another wall."""

SILENT_HU = 10.0
"""Noise that is taken where a scan shows no soft tissue to measure it in."""

STATES = ("fitted", "not bone", "metal", "badly fitted", "no room")
"""What is across a vertex: a wall; no wall of bone; metal; a profile unlike a wall; another wall or the end of the
volume just outside of it."""

FITTED, NOT_BONE, METAL, BADLY_FITTED, NO_ROOM = range(len(STATES))


@dataclass(frozen=True)
class ProfileScale:
    """The samples of a profile: at ``first_mm + n * step_mm``, outwards, with their weights."""

    first_mm: float
    step_mm: float
    weights: Float32Array

    @classmethod
    def of(cls, volume: Volume) -> ProfileScale:
        """Return the scale for a volume: by the edge of a cube as large as a voxel."""
        scale = float(np.clip(np.cbrt(np.prod(volume.spacing)), SMALLEST_SCALE, LARGEST_SCALE))
        step = STEP_MM * scale
        places = step * (np.arange(SAMPLES) - CENTRE)
        return cls(-step * CENTRE, step, np.exp(-0.5 * (places / (WEIGHT_MM * scale)) ** 2).astype(np.float32))

    @property
    def independent(self) -> float:
        """Share of the samples that count as independent of each other."""
        return STEP_MM / CORRELATED_MM


class StackFrame:
    """Where points lie between the slices of a volume, even or not: in steps of slice 0, and in mm of height.

    slices: ndarray, shape (nk, 4), float32. As the kernel takes them.
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
        self.slices = np.zeros((len(origins), 4), np.float32)
        self.slices[:, :3] = (origins - self._origin) @ self._matrix.T
        self.slices[:-1, 3] = 1.0 / self.gaps

    def places(self, points: NDArray[np.floating]) -> Float32Array:
        """Return the kernel's places (n, 4) of points (n, 3) in LPS mm; the last column is the slice at or below."""
        found = np.empty((len(points), 4), np.float32)
        found[:, :3] = (points - self._origin) @ self._matrix.T
        layers = np.searchsorted(self._heights, found[:, 2], side="right") - 1
        found[:, 3] = np.clip(layers, 0, max(len(self._heights) - 2, 0))
        return found

    def directions(self, normals: NDArray[np.floating]) -> Float32Array:
        """Return the kernel's directions (n, 4) of unit vectors (n, 3) in LPS."""
        found = np.zeros((len(normals), 4), np.float32)
        found[:, :3] = normals @ self._matrix.T
        return found


@dataclass(frozen=True, eq=False)
class CortexConstants(Record):
    """Constants of a scan, measured in profiles across its walls; each with the half width of what fits as well.

    blur_mm, blur_across_mm: Width of the Gaussian within slices and across them.
    cortex_hu: HU of compact bone.
    blur_error_mm, blur_across_error_mm, cortex_error_hu: How far from these the profiles are described nearly as well.
    noise_hu: Standard deviation of the HU in soft tissue; None where there is none to measure it in.
    residual_hu: Root mean square of what the fit leaves of these profiles.
    places, thick: Profiles that were used, and those among them of walls that are thick enough to show their HU.
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

    @property
    def cortex_spread(self) -> float:
        """Share by which the cortex of a place may differ."""
        return max(CORTEX_SPREAD, self.cortex_error_hu / self.cortex_hu)

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
    shift_variance, thickness_variance: mm2 for samples with a variance of 1 HU2 each.
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
    thickness_variance: Float32Array
    peak_hu: Float32Array
    room_mm: Float32Array

    def rows(self) -> tuple[Float32Array, ...]:
        """Return all of them, in the order of the kernel."""
        return tuple(vars(self).values())


def prepare_cortex(device: Device, dtype: np.dtype[Any]) -> Program:
    """Build the kernels for volumes of `dtype`."""
    return load_program(
        device, "surface/cortex.cl", {**voxel_variants(dtype), "LANES": device.kernel_variants["LANES"]}
    )


def blurs_of(values: Float32Array, blur_mm: float, across_mm: float) -> Float32Array:
    """Return the width of the blur along each of the profiles (ROWS, n), mm: it grows with the gap between slices."""
    steep, gap = values[SAMPLES], values[SAMPLES + 1]
    across = np.maximum(blur_mm**2 + (across_mm**2 - blur_mm**2) * gap, 0.1 * blur_mm**2)
    return np.asarray(np.sqrt(blur_mm**2 * (1.0 - steep) + across * steep), np.float32)


def unexplained_hu(cortex_hu: float, noise_hu: float) -> float:
    """Return the standard deviation of samples around the model: noise, and what three plateaus do not describe."""
    return float(np.hypot(MODEL_ERROR * cortex_hu, noise_hu))


class WallProfiles:
    """Profiles of places on the device, which can be fitted again and again with other constants.

    values_d: buffer, (ROWS, stride) float32, see cl/surface/cortex.cl
    """

    def __init__(self, sampler: ProfileSampler, values_d: Any, count: int):
        self._device, self._program, self._scale = sampler.device, sampler.program, sampler.scale
        self._values_d, self._count, self._stride = values_d, count, stride_of(count)
        self._weights_d = upload(self._device, self._scale.weights)

    def fit(
        self,
        blur_mm: float,
        across_mm: float,
        cortex_hu: float,
        noise_hu: float,
        *,
        cortex_spread: float = CORTEX_SPREAD,
    ) -> WallFits:
        """Fit a wall to each profile."""
        device, lanes = self._device, int(self._device.kernel_variants["LANES"])
        fits, fits_d = empty_output(device, (RESULTS, self._stride), np.float32)
        outer, cortex, inner = expected_precisions(cortex_hu, noise_hu, cortex_spread, self._scale.independent)
        launch(
            device, self._program["fit_profiles"], -(-self._count // lanes),
            profiles=self._values_d, weights=self._weights_d, fits=fits_d,
            first_mm=self._scale.first_mm, step_mm=self._scale.step_mm, blur=blur_mm, across=across_mm,
            cortex=cortex_hu, inner=INNER_SHARE * cortex_hu, keep_outer=outer, keep_cortex=cortex, keep_inner=inner,
            rise=max(RISE_HU, RISE_SIGMAS * noise_hu), stride=self._stride, count=self._count,
        )  # fmt: skip
        return WallFits(*download(device, fits, fits_d)[:, : self._count])

    def fit_with(self, constants: CortexConstants) -> WallFits:
        """Fit a wall to each profile with the constants of a scan."""
        return self.fit(
            constants.blur_mm, constants.blur_across_mm, constants.cortex_hu, constants.known_noise,
            cortex_spread=constants.cortex_spread,
        )  # fmt: skip


def stride_of(count: int) -> int:
    """Return the places of a row on the device: whole vectors of eight."""
    return 8 * -(-count // 8)


def expected_precisions(
    cortex_hu: float, noise_hu: float, cortex_spread: float, independent: float
) -> tuple[float, float, float]:
    """Return the weights of what is expected of outer, cortex and inner HU, in units of a sample's weight."""
    variance = unexplained_hu(cortex_hu, noise_hu) ** 2 / independent
    spreads = (OUTER_SPREAD_HU, cortex_spread * cortex_hu, INNER_SPREAD * cortex_hu)
    outer, cortex, inner = (variance / spread**2 for spread in spreads)
    return outer, cortex, inner


class ProfileSampler:
    """Samples profiles of a volume on a device, slab by slab where it does not fit as a whole; the same bits then."""

    def __init__(self, resident: DeviceVolume, stopwatch: Stopwatch):
        self._resident, self._stopwatch, self.device = resident, stopwatch, resident.device
        self.scale, self.frame = ProfileScale.of(resident.volume), StackFrame(resident.volume)
        with stopwatch.timed("build"):
            self.program = prepare_cortex(resident.device, resident.dtype)

    def pieces(
        self, points: NDArray[np.floating], normals: NDArray[np.floating]
    ) -> Iterator[tuple[NDArray[np.intp], Any]]:
        """Yield the rows of each piece, and its values on the device, (ROWS, stride)."""
        resident, nk = self._resident, self._resident.volume.shape_ijk[2]
        places, directions = self.frame.places(points), self.frame.directions(normals)
        least_gap = float(self.frame.gaps.min()) if nk > 1 else 1.0
        reach = int(np.ceil(-self.scale.first_mm / least_gap)) + 1
        piece = min(PIECE, len(points))

        def needs(slices: int) -> dict[str, int]:
            held = min(slices + 2 * reach + 1, nk) * resident.slice_bytes
            own = (4 * (ROWS + RESULTS) + 32) * stride_of(piece)
            return {"volume": held, "profiles": own, "slices": self.frame.slices.nbytes}

        while (planned := resident.plan(PROFILES, nk, needs)) < 1 and piece > SMALLEST_PIECE:
            piece //= 2
        if planned < 1:
            raise DeviceMemoryError(f"no profiles can be sampled: {describe_shortage(resident.limits, needs(1))}")
        if planned >= nk:
            voxels_d = resident.whole(self._stopwatch)
            for begin in range(0, len(points), piece):
                rows = np.arange(begin, min(begin + piece, len(points)))
                yield rows, self._sample(voxels_d, 0, places[rows], directions[rows])
            return
        for first in range(0, nk, planned):
            low, high = max(first - reach, 0), min(first + planned + reach + 1, nk)
            rows_of_slab = np.flatnonzero((places[:, 3] >= first) & (places[:, 3] < first + planned))
            if not len(rows_of_slab):
                continue
            voxels_d = resident.part(low, high, self._stopwatch)
            for begin in range(0, len(rows_of_slab), piece):
                rows = rows_of_slab[begin : begin + piece]
                yield rows, self._sample(voxels_d, low, places[rows], directions[rows])
            resident.volume.release_slices(low, high)

    def _sample(self, voxels_d: Any, first_k: int, places: Float32Array, directions: Float32Array) -> Any:
        device, (ni, nj, nk) = self.device, self._resident.volume.shape_ijk
        stride = stride_of(len(places))
        values_d = allocate(device, 4 * ROWS * stride)
        launch(
            device, self.program["sample_profiles"], len(places), voxels=voxels_d,
            slices=upload(device, self.frame.slices), places=upload(device, places),
            directions=upload(device, directions), profiles=values_d, ni=ni, nj=nj, nk=nk, first_k=first_k,
            first_mm=self.scale.first_mm, step_mm=self.scale.step_mm, usual_gap=self.frame.usual_gap,
            stride=stride, count=len(places),
        )  # fmt: skip
        return values_d

    def values(self, points: NDArray[np.floating], normals: NDArray[np.floating]) -> Float32Array:
        """Return the profiles, shape (ROWS, n): HU, NaN beyond the volume, and what blurs them."""
        found = np.empty((ROWS, len(points)), np.float32)
        for rows, values_d in self.pieces(points, normals):
            stride = stride_of(len(rows))
            piece = download(self.device, np.empty((ROWS, stride), np.float32), values_d)
            found[:, rows] = piece[:, : len(rows)]
        return found

    def take(self, values: Float32Array) -> WallProfiles:
        """Return profiles (ROWS, n) as they are fitted on the device."""
        count = values.shape[1]
        padded = np.zeros((ROWS, stride_of(count)), np.float32)
        padded[:, :count] = values
        return WallProfiles(self, upload(self.device, padded), count)


FEWEST_WALLS = 60
"""Profiles across walls below which nothing is known of a scan's cortex."""

MOST_WALLS, LOOKED_AT = 500, 4000
"""Profiles that the constants are measured in, and vertices among which they are searched."""

LEAST_CONTRAST, LEAST_CORTEX_HU = 0.4, 350.0
"""A wall rises at its highest by this share of the 90th percentile of all; a scan whose highest walls stay lower than
the second shows no bone."""

TRIMMED = 0.8
"""Share of the profiles, those fitted best, by which blurs are compared: others touch a second bone or a vessel."""

SEARCH_STEPS = (1.3, 1.12, 1.05)
"""Factors by which a blur is changed as long as that helps, one after the other."""

THICK_BLURS, SHARP, WIDE_SPREAD, DENSE_PERCENTILE, FEWEST_THICK = 2.0, 1.25, 0.3, 75.0, 12
"""Walls thicker than so many blurs show their HU where the blur is at most the second times that within the slices, if
the fit leaves the cortex free within the third; of these the percentile, since walls differ and blur only ever lowers
them."""

LEAST_BLUR_ERROR, LEAST_CORTEX_ERROR, THIN_CORTEX_ERROR = 0.02, 0.05, 0.3
"""Shares below which constants are not known: phantoms differ from their own by as much.  The third holds where all
walls are so thin that blur and density are one."""


@dataclass
class _Trial:
    """Constants as far as they are found."""

    blur_mm: float
    across_mm: float
    cortex_hu: float

    def changed(self, place: int, factor: float) -> _Trial:
        blurs = [self.blur_mm, self.across_mm]
        blurs[place] *= factor
        return _Trial(blurs[0], blurs[1], self.cortex_hu)


def measure_constants(
    sampler: ProfileSampler, volume: Volume, points: NDArray[np.floating], normals: NDArray[np.floating]
) -> CortexConstants:
    """Measure blur and cortex of a scan in profiles at some of the points.

    The blur is that which leaves the least of the profiles, the cortex what thick walls show.  Their uncertainties are
    half the spread over four parts of the profiles, and not less than `LEAST_BLUR_ERROR` and `LEAST_CORTEX_ERROR`.
    """
    rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), LOOKED_AT)).astype(np.int64))
    values = sampler.values(points[rows], normals[rows])
    walls, peaks = _find_walls(values)
    if len(walls) < FEWEST_WALLS:
        raise NoSurfaceError(
            f"the surface has no walls of bone that the cortex could be measured in: {len(walls)} of"
            f" {len(rows):,} profiles across it, at least {FEWEST_WALLS} are needed"
        )
    values, peaks = values[:, walls], peaks[walls]
    try:
        noise = measure_noise(volume).hu
    except UsageError:  # a specimen in air
        noise = None
    step = volume.spacing
    dense = float(np.percentile(peaks, 95.0))
    usual = 1.2 * float(np.percentile(peaks, DENSE_PERCENTILE))
    start = _Trial(
        0.7 * float(np.sqrt(step[0] * step[1])) ** 0.5, max(0.7 * step[2] ** 0.5, 0.45 * step[2]),
        min(1.03 * dense, usual),
    )  # fmt: skip
    known = noise if noise is not None else SILENT_HU
    found = start
    for first in range(len(SEARCH_STEPS)):
        found = _search_blurs(sampler.take(values), found, known, SEARCH_STEPS[first:])
        found.cortex_hu, thick = _measure_cortex(sampler.take(values), values, found, known)
    parts = []
    for part in range(4):
        profiles = sampler.take(values[:, part::4])
        one = _search_blurs(profiles, found, known, SEARCH_STEPS[1:])
        parts.append((one.blur_mm, one.across_mm, _measure_cortex(profiles, values[:, part::4], found, known)[0]))
    of_cortex = LEAST_CORTEX_ERROR if thick >= FEWEST_THICK else THIN_CORTEX_ERROR
    least = np.array([LEAST_BLUR_ERROR, LEAST_BLUR_ERROR, of_cortex])
    spread = np.maximum(np.std(parts, axis=0) / 2.0, least * np.mean(parts, axis=0))
    residual = sampler.take(values).fit(found.blur_mm, found.across_mm, found.cortex_hu, known).residual_hu
    errors = [float(value) for value in spread]
    return CortexConstants(
        blur_mm=found.blur_mm,
        blur_across_mm=found.across_mm,
        cortex_hu=found.cortex_hu,
        blur_error_mm=errors[0],
        blur_across_error_mm=errors[1],
        cortex_error_hu=errors[2],
        noise_hu=noise,
        residual_hu=float(np.sqrt(np.mean(np.square(residual)))),
        places=values.shape[1],
        thick=thick,
    )


def _find_walls(values: Float32Array) -> tuple[NDArray[np.intp], Float32Array]:
    """Return up to `MOST_WALLS` profiles that rise like walls of bone, and the highest value of each profile."""
    whole = np.isfinite(values[:SAMPLES]).all(axis=0)
    peaks = np.where(
        whole, values[: CENTRE + 2].max(axis=0, initial=-np.inf, where=np.isfinite(values[: CENTRE + 2])), 0
    )
    rise = peaks - values[CENTRE:SAMPLES].min(axis=0, initial=np.inf, where=np.isfinite(values[CENTRE:SAMPLES]))
    usable = whole & (peaks < METAL_HU)
    if not usable.any():
        return np.zeros(0, np.intp), peaks
    high = float(np.percentile(peaks[usable], 90.0))
    walls = np.flatnonzero(usable & (rise > LEAST_CONTRAST * high)) if high >= LEAST_CORTEX_HU else np.zeros(0, np.intp)
    return walls[np.unique(np.linspace(0, len(walls) - 1, min(len(walls), MOST_WALLS)).astype(np.intp))], peaks


def _search_blurs(profiles: WallProfiles, found: _Trial, noise_hu: float, factors: tuple[float, ...]) -> _Trial:
    """Return the blurs that leave least of the profiles, from those of a trial on."""

    def left(trial: _Trial) -> float:
        fits = profiles.fit(trial.blur_mm, trial.across_mm, trial.cortex_hu, noise_hu, cortex_spread=0.02)
        squares = np.sort(np.square(fits.residual_hu, dtype=np.float64))
        return float(np.mean(squares[: max(1, int(TRIMMED * len(squares)))]))

    least = left(found)
    for factor in factors:
        for place in (0, 1):
            for change in (factor, 1.0 / factor):
                while (value := left(trial := found.changed(place, change))) < 0.9999 * least:
                    found, least = trial, value
                    if not 0.05 < trial.blur_mm < 4.0 or not 0.05 < trial.across_mm < 8.0:
                        return found
    return found


def _measure_cortex(profiles: WallProfiles, values: Float32Array, found: _Trial, noise_hu: float) -> tuple[float, int]:
    """Return the HU of compact bone, and how many walls are thick enough to show it."""
    fits = profiles.fit(found.blur_mm, found.across_mm, found.cortex_hu, noise_hu, cortex_spread=WIDE_SPREAD)
    blurs = blurs_of(values, found.blur_mm, found.across_mm)
    thick = (fits.thickness_mm > THICK_BLURS * blurs) & (blurs < SHARP * found.blur_mm)
    if np.count_nonzero(thick) < FEWEST_THICK:
        return found.cortex_hu, int(np.count_nonzero(thick))
    shown = float(np.percentile(fits.cortex_hu[thick], DENSE_PERCENTILE))
    return float(np.clip(shown, found.cortex_hu / 1.25, found.cortex_hu * 1.25)), int(np.count_nonzero(thick))


THINNEST_BLURS, EDGE_SHARE = 0.2, 0.6
"""A wall thinner than so many blurs, before something of less than this share of the cortex' HU, is an edge without a
wall: a vessel, an organ, marrow.  Of true walls 1 to 3 % are as thin."""

MOST_RESIDUAL = 3.0
"""Residual, in what noise and model explain, from which on a profile is not that of a wall."""

LEAST_ROOM = 2
"""Samples outside of a vertex that belong to its wall, at least."""

MOST_SHIFT_MM = 2.5

ERROR_FACTOR, LEAST_ERROR = 1.25, 0.06
"""By what the fit's own error is multiplied, and what is added in squares, in blurs: with both, 94 % of the vertices of
20 phantoms lie within 1.96 errors, and 74 % within one; without them 88 and 62 %."""


@dataclass(frozen=True)
class CortexFit:
    """Where the outer surface of bone lies across the vertices of a mesh, shape (n,) each.

    states: uint8. Places in `STATES`; all values below are those of the fit, whatever the state.
    shift_mm: From the vertex along its normal, outwards positive.
    thickness_mm: Of the wall; at most the length of a profile, which stands for solid bone.
    error_mm, thickness_error_mm: Standard errors.
    room_mm: From the vertex outwards to the next wall, or to the end of the profile.
    """

    constants: CortexConstants
    states: NDArray[np.uint8]
    shift_mm: Float32Array
    thickness_mm: Float32Array
    error_mm: Float32Array
    thickness_error_mm: Float32Array
    room_mm: Float32Array

    def counts(self) -> dict[str, int]:
        """Return the number of vertices in each state."""
        return {name: int(np.count_nonzero(self.states == state)) for state, name in enumerate(STATES)}


def fit_walls(
    resident: DeviceVolume,
    points: NDArray[np.floating],
    normals: NDArray[np.floating],
    *,
    stopwatch: Stopwatch,
    constants: CortexConstants | None = None,
) -> CortexFit:
    """Find the outer surface of bone across points of a surface at a low level.

    points, normals: ndarray, shape (n, 3). LPS mm, and unit vectors outwards.
    constants: Those of the scan; None: measured.
    """
    sampler = ProfileSampler(resident, stopwatch)
    if constants is None:
        constants = measure_constants(sampler, resident.volume, points, normals)
    count = len(points)
    fit = CortexFit(constants, np.empty(count, np.uint8), *(np.empty(count, np.float32) for _ in range(5)))
    for rows, values_d in sampler.pieces(points, normals):
        with stopwatch.running(resident.device):
            walls = WallProfiles(sampler, values_d, len(rows)).fit_with(constants)
        fit.states[rows] = judge_walls(walls, constants, sampler.scale)
        fit.shift_mm[rows], fit.thickness_mm[rows] = walls.shift_mm, walls.thickness_mm
        fit.room_mm[rows] = walls.room_mm
        fit.error_mm[rows], fit.thickness_error_mm[rows] = standard_errors(walls, constants, sampler.scale)
    return fit


def judge_walls(walls: WallFits, constants: CortexConstants, scale: ProfileScale) -> NDArray[np.uint8]:
    """Return the state of each place."""
    states = np.zeros(len(walls.shift_mm), np.uint8)
    cortex, explained = constants.cortex_hu, unexplained_hu(constants.cortex_hu, constants.known_noise)
    thin = walls.thickness_mm < THINNEST_BLURS * constants.blur_mm
    states[walls.residual_hu > MOST_RESIDUAL * explained] = BADLY_FITTED
    states[np.abs(walls.shift_mm) > MOST_SHIFT_MM] = BADLY_FITTED
    states[thin & (walls.inner_hu < EDGE_SHARE * cortex)] = NOT_BONE
    states[walls.peak_hu >= METAL_HU] = METAL
    states[~(walls.room_mm > (LEAST_ROOM - 0.5) * scale.step_mm) | np.isnan(walls.peak_hu)] = NO_ROOM
    return states


def standard_errors(
    walls: WallFits, constants: CortexConstants, scale: ProfileScale
) -> tuple[Float32Array, Float32Array]:
    """Return the standard errors of shift and thickness, mm: noise, what the model leaves, and the constants'."""
    explained = unexplained_hu(constants.cortex_hu, constants.known_noise)
    left = np.maximum(walls.residual_hu, np.float32(explained)) / np.float32(np.sqrt(scale.independent))
    least = np.float32(LEAST_ERROR * constants.blur_mm)
    own = np.float32(ERROR_FACTOR) * np.sqrt(walls.shift_variance) * left
    return np.hypot(own, least), np.float32(ERROR_FACTOR) * np.sqrt(walls.thickness_variance) * left
