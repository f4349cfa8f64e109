"""The geometry of a stack: one affine with its residual, or the reasons why the slices have none.

The position of a slice is its ImagePositionPatient alone.  Slices are sorted by the projection of the position on the
normal n = X x Y (row direction x column direction), so index space is always right-handed.  The affine is the
least-squares line through all positions: its slice step is a full vector, a tilted gantry is an exact shear, and the
rounding of positions averages out.  Where positions deviate from that line by more than rounding does, each slice keeps
its own position.

Steps of 0.0105 mm written with two digits are 0.01 mm, and every twentieth 0.02 mm.  A slice that is missing leaves the
same gap.  The two are told apart by the digits and by a distance that the headers state beside the positions: where all
positions are even steps of that distance, each rounded to its last digit, none is missing.

Source: DICOM PS3.3 C.7.6.2.1.1.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import compose_affine, signed_tilt
from clrecon.geometry.affine import TILT_REPORT_DEG, Float64Array
from clrecon.geometry.grid import fit_line, position_tolerance
from clrecon.reading.dicom.headers.slice_header import SliceHeader
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.text import join_names


def median(values: Sequence[float] | NDArray[Any]) -> float:
    """Return what `numpy.median` does, which is slow for few values and loads masked arrays, 10 ms at every start."""
    ordered = np.sort(values)
    middle = len(ordered) // 2
    return float(ordered[middle] if len(ordered) % 2 else (ordered[middle - 1] + ordered[middle]) / 2)


_MISSING_RATIO = 1.5
RUN_LENGTH = 3
_RUN_TOLERANCE = 0.05
"""A gap over 1.5 times the usual gap means missing slices, unless it belongs to a run: at least 3 consecutive gaps that
are equal within 5 %. A run is a change of feed, a hole is not.  The usual gap is the median, with an even count the
smaller of the two in the middle, so that equally many holes and whole gaps do not make the holes usual.  Beside a run
it is that of the run (of two, the coarser): a hole where the feed is fine is found however coarse it is elsewhere."""
PLACES_SHOWN = 4


@dataclass(frozen=True)
class Holes:
    """Gaps k, from slice k to k + 1, that are too wide (`_MISSING_RATIO`), positions of their ends, usual gap, mm."""

    places: tuple[int, ...] = ()
    gaps_mm: tuple[float, ...] = ()
    ends_mm: tuple[tuple[float, float], ...] = ()
    usual_mm: tuple[float, ...] = ()

    @property
    def missing(self) -> int:
        """Number of slices that would fill the gaps at the usual distance."""
        return sum(self._counts())

    def _counts(self) -> list[int]:
        return [max(round(gap / usual) - 1, 1) for gap, usual in zip(self.gaps_mm, self.usual_mm, strict=True)]

    def describe(self, names: Sequence[str] = ()) -> str:
        """Describe where the holes are; given the names of all slices, also between which slices."""
        texts = []
        columns = (self.places, self.gaps_mm, self.ends_mm, self.usual_mm, self._counts())
        for k, gap, (low, high), usual, count in zip(*columns, strict=True):
            between = f": {names[k]}, {names[k + 1]}" if names else ""
            texts.append(
                f"{count} slice{'s' * (count > 1)} missing between {low:.2f} and {high:.2f} mm "
                f"(gap {gap:.3f} mm, usual {usual:.3f} mm){between}"
            )
        shown = "; ".join(texts[:PLACES_SHOWN])
        return shown if len(texts) <= PLACES_SHOWN else f"{shown}; and {len(texts) - PLACES_SHOWN} more"


def find_holes(distances: Float64Array) -> Holes:
    """Find missing slices among sorted positions (n,) along the normal; with only two slices there are none."""
    gaps = np.diff(distances)
    if len(gaps) < 2:
        return Holes()
    if gaps.max() <= _MISSING_RATIO * gaps.min():
        return Holes()  # the usual case
    usual = float(np.sort(gaps)[(len(gaps) - 1) // 2])
    if usual <= 0.0:
        return Holes()  # only where the directions are wrong
    in_run = _find_runs(gaps)
    runs = np.flatnonzero(in_run)
    wide, usuals = [], []
    for k in np.flatnonzero(~in_run).tolist():
        after = int(np.searchsorted(runs, k))
        beside = max(gaps[runs[max(after - 1, 0) : after + 1]].tolist(), default=usual)
        if gaps[k] > _MISSING_RATIO * min(usual, beside):
            wide.append(k)
            usuals.append(beside if gaps[k] > _MISSING_RATIO * beside else usual)
    ends = tuple((float(distances[k]), float(distances[k + 1])) for k in wide)
    return Holes(tuple(wide), tuple(float(gaps[k]) for k in wide), ends, tuple(usuals))


def _find_runs(gaps: Float64Array) -> NDArray[np.bool_]:
    """Mark gaps in runs: at least `RUN_LENGTH` consecutive gaps that are equal within `_RUN_TOLERANCE`."""
    in_run = np.zeros(len(gaps), dtype=bool)
    for index, gap in enumerate(gaps.tolist()):
        low, high = max(index - RUN_LENGTH + 1, 0), min(index + RUN_LENGTH, len(gaps))
        like = (np.abs(gaps[low:high] - gap) <= _RUN_TOLERANCE * gap).tolist()
        first = last = index - low
        while first > 0 and like[first - 1]:
            first -= 1
        while last < len(like) - 1 and like[last + 1]:
            last += 1
        in_run[index] = last - first + 1 >= RUN_LENGTH
    return in_run


SLACK = 1e-6
"""Relative excess over the unit of the last digit that is due to float64."""
WHOLE = 1e-3
"""A distance that is a multiple of the unit, within this part of it, is not changed by rounding."""


@dataclass(frozen=True)
class Rounding:
    """Even steps of `stated_mm` by `keyword` that explain positions rounded to `unit_mm`, the last of their digits."""

    unit_mm: float
    digits: int
    keyword: str
    stated_mm: float

    def __str__(self) -> str:
        plural = "s" * (self.digits != 1)
        return (
            f"positions are written with {self.digits} decimal{plural}, too few for slices that are "
            f"{self.stated_mm:g} mm apart by {self.keyword}: all of them are even steps, rounded"
        )


def measure_unit(headers: Sequence[SliceHeader], normal: Float64Array) -> tuple[float, int]:
    """Return the last digit of positions along the normal in mm, by the slice with most digits, and its decimals."""
    digits = np.max([header.position_digits for header in headers], axis=0)
    return float(np.abs(normal) @ 10.0 ** -digits.astype(np.float64)), int(digits[np.argmax(np.abs(normal))])


def find_rounding(
    headers: Sequence[SliceHeader], distances: Float64Array, normal: Float64Array, tolerance: float
) -> Rounding | None:
    """Explain uneven positions along the normal (3,), at sorted distances (n,), mm, n >= 2, by their digits.

    Returns None where positions have digits enough, no distance is stated, or a stated one does not explain them, if
    they are further off than `tolerance`, mm.
    """
    unit, digits = measure_unit(headers, normal)
    if len(headers) < 3 or unit / 2.0 <= SLACK or np.ptp(np.diff(distances)) < min(unit / 2.0, tolerance):
        return None
    k = np.arange(len(distances), dtype=np.float64)
    fitted = float((k - k.mean()) @ distances / np.sum((k - k.mean()) ** 2))
    for keyword, stated in (
        ("SpacingBetweenSlices", _stated(headers, "stated_gap_mm")),
        ("SliceThickness", _stated(headers, "slice_thickness_mm")),
    ):
        if stated is None or stated <= unit or abs(stated / unit - round(stated / unit)) < WHOLE:
            continue
        # A missing slice would move the ends by a whole step against even steps of the stated distance.
        steps = [stated, fitted] if abs(fitted - stated) * (len(distances) - 1) < stated / 2.0 else [stated]
        if any(float(np.ptp(distances - k * step)) <= unit * (1.0 + SLACK) for step in steps):
            return Rounding(unit, digits, keyword, stated)
    return None


def _stated(headers: Sequence[SliceHeader], field: str) -> float | None:
    """Return the distance that the headers state, if all of them state it and about the same one."""
    values = [getattr(header, field) for header in headers]
    if any(value is None or value <= 0.0 for value in values):
        return None
    middle = median(values)
    return middle if max(values) - min(values) <= WHOLE * middle else None


ORIENTATION_EXACT = 1e-4
"""Deviation from unit length and right angle that is accepted without a warning (rounding of stored numbers)."""
ORIENTATION_LIMIT = 1e-3
"""Deviation up to which the directions are made orthonormal, with a warning; larger ones are refused."""
ORIENTATION_SPREAD_RAD = 1e-4
"""Largest angle between the directions of a slice and the mean: 0.03 mm over 300 mm."""


@dataclass(frozen=True)
class Directions:
    """Mean directions of a stack, (3,) LPS, `deviations` (n,) of the stored ones, and `angles_rad` (n,) to the mean."""

    row: Float64Array
    column: Float64Array
    deviations: Float64Array
    angles_rad: Float64Array

    @property
    def deviation(self) -> float:
        return float(self.deviations.max())

    @property
    def spread_rad(self) -> float:
        """The largest angle."""
        return float(self.angles_rad.max())

    @property
    def spread_allowed_rad(self) -> float:
        """Skew is removed from every slice alike, so it does not count as a difference between slices."""
        return ORIENTATION_SPREAD_RAD + self.deviation


def measure_directions(headers: Sequence[SliceHeader]) -> Directions:
    """Measure ImageOrientationPatient (0020,0037) of one or more slices."""
    stored = np.array([(*h.row_cosines, *h.column_cosines) for h in headers], dtype=np.float64).reshape(-1, 2, 3)
    lengths = np.linalg.norm(stored, axis=2)
    skew = np.abs(np.sum(stored[:, 0] * stored[:, 1], axis=1))
    deviations = np.maximum(np.abs(lengths - 1.0).max(axis=1), skew)
    if deviations.max() > ORIENTATION_LIMIT:
        row, column, _ = np.eye(3)
        return Directions(row, column, deviations, np.full(len(stored), np.nan))
    row, column = _orthonormalise(*stored.mean(axis=0))
    chords = np.linalg.norm(stored / lengths[:, :, None] - (row, column), axis=2).max(axis=1)
    return Directions(row, column, deviations, 2.0 * np.arcsin(np.clip(chords / 2.0, 0.0, 1.0)))


def _orthonormalise(row: Float64Array, column: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return the nearest orthonormal pair, both directions turned by the same angle; an exact pair stays as it is."""
    row, column = row / np.linalg.norm(row), column / np.linalg.norm(column)
    if abs(row @ column) > 1e-9:
        bisector, across = row + column, row - column
        bisector, across = bisector / np.linalg.norm(bisector), across / np.linalg.norm(across)
        row, column = (bisector + across) / np.sqrt(2.0), (bisector - across) / np.sqrt(2.0)
    return row, column


_DUPLICATE_MM = 1e-3
STATED_GAP_TOLERANCE = 0.01
_PIXEL_SPACING_TOLERANCE = 1e-5


@dataclass(frozen=True)
class Line:
    """Evenly spaced places fitted to the slices, and the distances of the slices from them; None for one slice.

    step, origin: (3,), LPS mm, by least squares.
    gap_min_mm, gap_max_mm, gap_median_mm: Distances of neighbours along the normal.
    residual_max_mm, residual_rms_mm: Distance of the positions from their places.
    tolerance_mm: Largest residual that counts as rounding; the unit of the last digit where few digits were written.
    worst_slice: Index of the slice with the largest residual.
    uneven: The residual exceeds the tolerance, so slices keep their own positions and the line is only nominal.
    """

    step: Float64Array | None = None
    origin: Float64Array | None = None
    gap_min_mm: float | None = None
    gap_max_mm: float | None = None
    gap_median_mm: float | None = None
    residual_max_mm: float | None = None
    residual_rms_mm: float | None = None
    tolerance_mm: float | None = None
    worst_slice: int = 0
    uneven: bool | None = None


@dataclass(frozen=True)
class Stack:
    """The measured geometry of one stack of slices; it is refused where it has problems.

    slices: Sorted by ascending position along the normal.
    positions_mm, distances_mm: (n, 3) LPS, and along the normal (n,).
    affine, tilt_deg: Index (i, j, k) to LPS mm, and its `signed_tilt`; None for a stack with problems.
    missing: Number of missing slices, computed from the usual gap; they are either allowed or one of the problems.
    """

    slices: tuple[SliceHeader, ...]
    positions_mm: Float64Array
    distances_mm: Float64Array
    affine: Float64Array | None
    line: Line
    tilt_deg: float | None
    problems: tuple[str, ...]
    warnings: tuple[str, ...]
    missing: int

    @property
    def slice_positions(self) -> Float64Array | None:
        """Positions of the slices where they deviate from the affine, else None."""
        return self.positions_mm if self.line.uneven else None


def measure_stack(headers: Sequence[SliceHeader], *, allow_gaps: bool = False) -> Stack:
    """Sort slices, one at a place, find problems, which raise no error (gaps may be allowed), and fit the affine."""
    problems = find_mixed_values(headers)
    warnings: list[str] = []
    row, column = _mean_directions(headers, problems, warnings)
    normal = _cross(row, column)
    slices, positions, distances = sort_slices(headers, normal)
    affine: Float64Array | None = None
    line, holes = Line(), Holes()
    if len(slices) == 1:
        problems.append("a single slice cannot make a volume: it has no distance to a next one")
    else:
        line, holes = measure_line(positions, distances), find_holes(distances)
        rounding = find_rounding(slices, distances, normal, line.tolerance_mm or 0.0)
        off = line.residual_max_mm or 0.0
        if rounding is not None and off <= rounding.unit_mm and (holes.places or line.uneven):
            # the step of the even places that were rounded, not that of the written numbers
            k = np.arange(len(distances)) - (len(distances) - 1) / 2.0
            step = float(k @ distances / np.sum(k**2))
            line, holes = replace(line, gap_median_mm=step, tolerance_mm=rounding.unit_mm, uneven=False), Holes()
            warnings.append(f"{rounding}; placed by even steps of {line.gap_median_mm:.6g} mm")
        if holes.places and allow_gaps:
            warnings.append(f"{holes.describe()}: what is there is placed exactly, surfaces bridge the gap")
        elif holes.places:
            missing = holes.describe([header.name for header in slices])
            problems.append(f"{missing}; find them, or take what is there with {name_parameter('allow_gaps', True)}")
        if line.uneven and not problems:
            warnings.append(_describe_unevenness(distances, line))
        if not problems:
            assert line.step is not None and line.origin is not None
            affine = compose_affine(row * slices[0].di_mm, column * slices[0].dj_mm, line.step, line.origin)
        stated = measure_stated_gap(slices, positions, line.gap_median_mm)
        if stated is not None and stated[2] > STATED_GAP_TOLERANCE:
            says, measured, _ = stated
            warnings.append(
                f"SpacingBetweenSlices says {says:g} mm, the positions say {measured:.4g} mm: the positions are used"
            )
    tilt = None if affine is None else signed_tilt(affine)
    aside = _measure_sideways(positions, distances) if line.uneven else 0.0
    if affine is not None and aside > (line.tolerance_mm or 0.0):
        warnings.append(f"slices are shifted sideways, up to {aside:.3f} mm off a straight line: placed as they say")
    elif tilt is not None and abs(tilt) > TILT_REPORT_DEG:
        warnings.append(f"gantry tilt {tilt:+.2f} degrees: kept exactly, as a shear")
    return Stack(slices, positions, distances, affine, line, tilt, tuple(problems), tuple(warnings), holes.missing)


def measure_line(positions: Float64Array, distances: Float64Array) -> Line:
    """Fit evenly spaced places to sorted positions (n, 3), n >= 2, and measure gaps and residuals."""
    gaps = np.diff(distances)
    usual = median(gaps)
    step, origin = fit_line(positions)
    residuals = np.linalg.norm(positions - (origin + np.arange(len(positions))[:, None] * step), axis=1)
    tolerance = position_tolerance(usual)
    return Line(
        step=step,
        origin=origin,
        gap_min_mm=float(gaps.min()),
        gap_max_mm=float(gaps.max()),
        gap_median_mm=usual,
        residual_max_mm=float(residuals.max()),
        residual_rms_mm=float(np.sqrt(np.mean(residuals**2))),
        tolerance_mm=tolerance,
        worst_slice=int(residuals.argmax()),
        uneven=bool(residuals.max() > tolerance),
    )


def _measure_sideways(positions: Float64Array, distances: Float64Array) -> float:
    """Largest distance in mm of positions (n, 3) from a straight line that advances with the sorted distances."""
    along = distances - distances.mean()
    moved = positions - positions.mean(axis=0)
    slope = along @ moved / np.sum(along**2)
    return float(np.linalg.norm(moved - along[:, None] * slope, axis=1).max())


def _describe_unevenness(distances: Float64Array, line: Line) -> str:
    return (
        f"slices are unevenly spaced: gaps {line.gap_min_mm:.3f} to {line.gap_max_mm:.3f} mm (usual "
        f"{line.gap_median_mm:.3f} mm), up to {line.residual_max_mm:.3f} mm from even positions (taken as even up to "
        f"{line.tolerance_mm:.3f} mm), worst at {distances[line.worst_slice]:.2f} mm: each slice is placed at its own "
        "position, the affine is only nominal"
    )


def sort_slices(
    headers: Sequence[SliceHeader], normal: Float64Array
) -> tuple[tuple[SliceHeader, ...], Float64Array, Float64Array]:
    """Sort by projection on the normal; return the slices, their positions (n, 3) and projections (n,) in mm."""
    positions = np.array([header.position_mm for header in headers], dtype=np.float64)
    distances = positions @ normal
    order = sorted(range(len(headers)), key=lambda index: (distances[index], str(headers[index].file)))
    return tuple(headers[index] for index in order), positions[order], distances[order]


def find_mixed_values(headers: Sequence[SliceHeader]) -> list[str]:
    """Describe values that must be equal over a stack but are not, naming the differing slices."""
    checks: tuple[tuple[str, Callable[[SliceHeader], object], Callable[[SliceHeader], str]], ...] = (
        ("Columns x Rows", lambda h: (h.columns, h.rows), lambda h: f"{h.columns} x {h.rows}"),
        ("FrameOfReferenceUID", lambda h: h.frame_of_reference, lambda h: "another" if h.frame_of_reference else "no"),
        ("StudyInstanceUID", lambda h: h.series.study, lambda h: "another" if h.series.study else "no"),
    )
    differences = []
    for title, key, show in checks:
        counts = Counter(key(header) for header in headers)
        if len(counts) > 1:
            usual = counts.most_common(1)[0][0]
            odd = [header for header in headers if key(header) != usual]
            differences.append(f"{title} differ within the series: {show(odd[0])} in {join_names(h.name for h in odd)}")
    patients = Counter(header.patient_hash for header in headers if header.patient_hash is not None)
    if len(patients) > 1:
        usual = patients.most_common(1)[0][0]
        odd = [header for header in headers if header.patient_hash not in (usual, None)]
        differences.append(f"PatientID differs within the series: another in {join_names(h.name for h in odd)}")
    di, dj = median([header.di_mm for header in headers]), median([header.dj_mm for header in headers])
    allowed = _PIXEL_SPACING_TOLERANCE * min(di, dj)
    odd = [header for header in headers if max(abs(header.di_mm - di), abs(header.dj_mm - dj)) > allowed]
    if odd:
        differences.append(
            f"PixelSpacing differs within the series: {odd[0].dj_mm:g}\\{odd[0].di_mm:g} mm against "
            f"{dj:g}\\{di:g} mm in {join_names(h.name for h in odd)}"
        )
    return differences


def _mean_directions(
    headers: Sequence[SliceHeader], problems: list[str], warnings: list[str]
) -> tuple[Float64Array, Float64Array]:
    """Return mean row and column directions, orthonormal; append problems of the directions."""
    directions = measure_directions(headers)
    off = directions.deviation
    if off > ORIENTATION_LIMIT:
        problems.append(
            f"{headers[int(directions.deviations.argmax())].name}: ImageOrientationPatient (0020,0037) is off unit "
            f"length or right angle by {off:.2g} (allowed {ORIENTATION_LIMIT:g})"
        )
    elif off > ORIENTATION_EXACT:
        warnings.append(f"ImageOrientationPatient is off unit length or right angle by {off:.2g}: made orthonormal")
    if directions.spread_rad > directions.spread_allowed_rad:
        problems.append(
            f"ImageOrientationPatient differs within the series by {np.degrees(directions.spread_rad):.3f} degrees: "
            f"{headers[int(directions.angles_rad.argmax())].name}"
        )
    return directions.row, directions.column


def group_places(headers: Sequence[SliceHeader]) -> list[list[SliceHeader]]:
    """Group slices by place (`_DUPLICATE_MM`), in order; where directions are wrong, each slice has its own."""
    problems: list[str] = []
    row, column = _mean_directions(headers, problems, [])
    if problems:
        return [[header] for header in headers]
    slices, _, distances = sort_slices(headers, _cross(row, column))
    places: list[list[SliceHeader]] = []
    last = -np.inf
    for header, distance in zip(slices, distances.tolist(), strict=True):
        if distance - last >= _DUPLICATE_MM:
            places.append([])
            last = distance
        places[-1].append(header)
    return places


def measure_gap(headers: Sequence[SliceHeader]) -> float:
    """Return the median distance in mm of neighbouring slices along their normal; two slices or more."""
    row, column = _mean_directions(headers, [], [])
    return median(np.diff(sort_slices(headers, _cross(row, column))[2]))


def _cross(row: Float64Array, column: Float64Array) -> Float64Array:
    """Return the cross product of two vectors (3,), in a tenth of numpy's time."""
    (a, b, c), (x, y, z) = row.tolist(), column.tolist()
    return np.array((b * z - c * y, c * x - a * z, a * y - b * x))


def measure_stated_gap(
    slices: Sequence[SliceHeader], positions: Float64Array, usual: float | None
) -> tuple[float, float, float] | None:
    """Return SpacingBetweenSlices, the usual distance of the positions (n, 3), and the relative difference of the two.

    Scanners state the distance along the normal or, with a tilted gantry, along the table: the nearer one is compared.
    None where no spacing is stated or no distance exists.
    """
    stated = next((h.stated_gap_mm for h in slices if h.stated_gap_mm is not None), None)
    if stated is None or not usual:
        return None
    along_table = median(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    measured = min((usual, along_table), key=lambda length: abs(stated - length))
    return stated, measured, abs(stated - measured) / measured


def measure_extent(stack: Stack) -> list[float] | None:
    """Return the size in mm of the box of whole voxels along rows, columns and normal; None for an unknown gap."""
    first, usual = stack.slices[0], stack.line.gap_median_mm
    if usual is None:
        return None
    along_normal = float(stack.distances_mm[-1] - stack.distances_mm[0]) + usual
    return [first.columns * first.di_mm, first.rows * first.dj_mm, along_normal]


def summarise_gaps(distances: Float64Array) -> list[dict[str, Any]]:
    """Return runs of equal gaps of sorted positions (mm along the normal): ``count``, mean ``gap_mm``."""
    runs: list[list[float]] = []
    for gap in np.diff(distances).tolist():
        if runs and abs(gap - runs[-1][0]) <= position_tolerance(runs[-1][0]):
            runs[-1].append(gap)
        else:
            runs.append([gap])
    return [{"count": len(run), "gap_mm": sum(run) / len(run)} for run in runs]


def median_thickness(headers: Sequence[SliceHeader]) -> float | None:
    """Return the median of the SliceThickness values above zero, mm; None if there are none."""
    known = sorted(_thicknesses(headers))
    return known[len(known) // 2] if known else None


def _thicknesses(headers: Sequence[SliceHeader]) -> list[float]:
    return [h.slice_thickness_mm for h in headers if h.slice_thickness_mm is not None and h.slice_thickness_mm > 0.0]


def facts_of_thickness(headers: Sequence[SliceHeader], distances: Float64Array) -> dict[str, Any] | None:
    """Compare SliceThickness with the distances of the slices; None unless there are two and each states a thickness.

    ``overlap_mm`` is what neighbouring slices share, (t_k + t_k+1) / 2 less their distance, below zero where tissue
    between them was not measured; ``overlap_percent`` its median in percent of the median distance.
    """
    thickness = np.array(_thicknesses(headers))
    if len(thickness) != len(headers) or len(headers) < 2:
        return None
    gaps = np.diff(distances)
    overlap = (thickness[1:] + thickness[:-1]) / 2.0 - gaps
    middle, usual = median(overlap), median(gaps)
    return {
        "min_mm": float(thickness.min()),
        "max_mm": float(thickness.max()),
        "median_mm": median(thickness),
        "overlap_mm": {"min": float(overlap.min()), "max": float(overlap.max()), "median": middle},
        "overlap_percent": 100.0 * middle / usual if usual > 0.0 else None,
    }
