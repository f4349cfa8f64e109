"""The iso rule: which samples of a volume are inside, where the surface lies, and what the border is closed with."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Any, get_args

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import vertices
from clrecon.geometry.affine import normal_matrix
from clrecon.geometry.grid import AIR_HU
from clrecon.geometry.volume import Volume
from clrecon.system.arguments import Topology
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.text import format_digits, format_hu

LARGEST_INTEGER = 2**23
"""Integer voxels are interpolated in float32, which holds multiples of 0.5 exactly up to here."""

_LOWEST_OUTSIDE = -(2**30)
"""Lowest value beyond the border: differences from integer voxels stay within 32 bits."""

LARGEST_FLOAT = 1e30
"""Largest float voxel: differences, and their squares after scaling, stay within float32."""

_TOPOLOGIES: tuple[str, ...] = get_args(Topology)
"""How inside samples are joined where the corners of a cell leave it open; see `IsoRule.topology`."""

Level = float | Sequence[float | None]
"""An iso value, or the two ends of a range, HU; one of them may be None, for no end."""


@dataclass(frozen=True)
class IsoRule:
    """How one iso value, or a range of HU, divides one volume; for the device operators and their numpy twins.

    iso_value: As asked for, HU; for a range its lower end.
    lowest_inside: A sample is inside when its value is >= this.  For integer voxels the lowest integer >= the iso
        value.
    iso_level: Where the surface lies between two samples.  For integer voxels and an integer iso value k it is k - 0.5:
        between the integers k - 1 and k, so that no vertex ever falls on a sample.
    outside: The value beyond the border of a closed volume: the lowest value of the volume, but not below `AIR_HU`.
    closed: True: the volume is surrounded by `outside`.  False: the surface ends open at the border.
    value_scale: Power of two by which float voxels are multiplied, so that none exceeds 1; 1 for integer voxels.
    topology: {"separated", "trilinear"}. Inside samples that only meet across a face or through a cell are kept apart,
        or joined where the trilinear interpolation of the samples joins them.
    inside: {"above", "below", "between"}. The samples that the surface encloses.  "above": those >= `lowest_inside`.
        "below": the others; the surface is that of "above" turned round, and `outside` lies above the level.
    upper_value: Upper end of a range as asked for, HU, which belongs to the range.
    highest_inside: A sample is inside a range when its value is also <= this; for integer voxels the highest integer.
    upper_level: Where the surface lies between a sample inside and one above a range; k + 0.5 for integers.
    vertex_rule: {"linear", "golden", "golden-search"}
    """

    iso_value: float
    lowest_inside: int | float
    iso_level: float
    outside: float
    closed: bool
    value_scale: float = 1.0
    topology: str = "separated"
    inside: str = "above"
    upper_value: float | None = None
    highest_inside: int | float | None = None
    upper_level: float | None = None
    vertex_rule: str = "linear"

    @property
    def border(self) -> int:
        """Layers of samples with the value `outside` around the volume: 1 when closed, else 0."""
        return int(self.closed)

    @property
    def levels(self) -> tuple[float, ...]:
        """Every level at which the surface may lie: one, or two for a range."""
        return (self.iso_level,) if self.upper_level is None else (self.iso_level, self.upper_level)

    def mark_inside(self, values: NDArray[Any]) -> NDArray[np.bool_]:
        if self.inside == "below":
            return values < self.lowest_inside
        marked = values >= self.lowest_inside
        return marked if self.highest_inside is None else marked & (values <= self.highest_inside)

    def describe(self) -> str:
        """Describe what is asked for: ``200 HU``, ``below -400 HU``, ``100 to 300 HU``."""
        if self.upper_value is not None:
            return f"{self.iso_value:g} to {self.upper_value:g} HU"
        return f"{'below ' if self.inside == 'below' else ''}{self.iso_value:g} HU"

    def phrase(self) -> str:
        """Describe the same for use after the word "surface": ``at 200 HU``, ``of what lies below -400 HU``."""
        return f"of what lies {self.describe()}" if self.inside == "below" else f"at {self.describe()}"

    def as_report(self) -> dict[str, Any]:
        """Return the entries of a mesh's report: what is inside, and where the surface lies, HU; None: an open end."""
        value, level = self.iso_value, self.iso_level
        ends: dict[str, tuple[list[float | None], list[float | None]]] = {
            "above": ([value, None], [level, None]),
            "below": ([None, value], [None, level]),
            "between": ([value, self.upper_value], [level, self.upper_level]),
        }
        ranged = self.inside == "between"
        return {
            "iso_value_hu": None if ranged else value,
            "iso_level_hu": None if ranged else level,
            "inside": self.inside,
            "vertex_rule": self.vertex_rule,
            "inside_hu": ends[self.inside][0],
            "inside_levels_hu": ends[self.inside][1],
        }


def data_range(volume: Volume) -> tuple[float, float]:
    low, high = math.inf, -math.inf
    for k, voxels in enumerate(volume.voxels):
        lowest, highest = float(voxels.min()), float(voxels.max())
        if math.isnan(lowest):  # numpy's min and max are NaN if any value is NaN.
            raise NoSurfaceError(f"slice {k} of the volume holds NaN: it has no iso surface")
        low, high = min(low, lowest), max(high, highest)
        volume.release_slices(k, k + 1)
    return low, high


def describe_range(volume: Volume, low: float, high: float) -> str:
    """Say which HU the volume has, and what has left no more than that of the scan, such as a crop in another frame."""
    crop, region = volume.report.get("crop"), volume.report.get("region")
    causes = [] if crop is None else [f"the crop ({crop['space'].upper()})"]
    causes += [] if region is None else [f"the region {' '.join(region['rules'])}"]
    rest = f"what {' and '.join(causes)} leave{'s' * (len(causes) == 1)}" if causes else "the volume"
    return f"{rest} runs from {format_hu(low)} to {format_hu(high)} HU"


def _lowest_value(volume: Volume) -> float:
    """Return the lowest value of the volume, or `AIR_HU` as soon as a slice reaches it: lower values do not matter."""
    low = math.inf
    for k, voxels in enumerate(volume.voxels):
        low = min(low, float(voxels.min()))
        if low <= AIR_HU:
            return float(AIR_HU)
        volume.release_slices(k, k + 1)
    return low


class ValueRange:
    """The range of a volume's values, for an iso rule; each figure is kept, so the voxels must not change any more."""

    def __init__(self, volume: Volume):
        self._volume = volume

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Lowest and highest value, see `data_range`."""
        return data_range(self._volume)

    @cached_property
    def lowest(self) -> float:
        """Lowest value, but not below `AIR_HU`."""
        return _lowest_value(self._volume)


def choose_iso_rule(
    volume: Volume,
    iso_value: Level,
    *,
    closed: bool = True,
    topology: str = "separated",
    below: bool = False,
    vertex_rule: str = "linear",
    values: ValueRange | None = None,
) -> IsoRule:
    """Decide what is inside and where the surface lies.

    iso_value: HU.  A sample is inside when its value is >= this; of a range, when it lies within, both ends included;
        an end of None is open.
    below: A sample is inside when its value is < `iso_value`: the same surface, turned round.
    values: Those of this volume; given where several rules for one volume are chosen.
    """
    iso_value, upper_value, below = _checked_level(iso_value, below, volume.voxels.dtype)
    check_topology(topology, ranged=upper_value is not None)
    vertices.check_vertex_rule(vertex_rule, topology)
    dtype = volume.voxels.dtype
    value_scale = 1.0
    values = values or ValueRange(volume)
    if dtype.kind == "f":
        low, high = values.ends
        if not (math.isfinite(low) and math.isfinite(high)):
            raise NoSurfaceError(f"the voxels run from {low} to {high}: infinite values have no iso surface")
        if max(-low, high) > LARGEST_FLOAT:
            raise UsageError(f"the voxels run from {low:g} to {high:g}: beyond {LARGEST_FLOAT:g} is not supported")
        value_scale = vertices.power_of_two_over(max(-low, high, abs(iso_value), abs(upper_value or 0.0)))
        iso_level = float(np.float32(iso_value))
        lowest_inside: int | float = iso_level
    else:
        low = values.lowest if closed else float(AIR_HU)
        if dtype == np.int32:
            low, high = values.ends
            if max(-low, high) >= LARGEST_INTEGER:
                raise UsageError(
                    f"the voxels run from {low:.0f} to {high:.0f}: integers from {LARGEST_INTEGER} on cannot be"
                    " interpolated exactly, rescale them or convert them to float32"
                )
        lowest_inside = math.ceil(iso_value)
        iso_level = iso_value - 0.5 if lowest_inside == iso_value else iso_value
    inside = "below" if below else "above"
    rule = IsoRule(
        iso_value, lowest_inside, iso_level, 0.0, closed, value_scale, topology, inside, vertex_rule=vertex_rule
    )
    if upper_value is not None:
        rule = _end_range(rule, upper_value, dtype)
    return replace(rule, outside=_choose_outside(rule, max(low, float(AIR_HU)), dtype))


def _end_range(rule: IsoRule, upper_value: float, dtype: DTypeLike) -> IsoRule:
    """Turn a rule into that of a range: samples above its upper end are no longer inside, the end itself is."""
    if np.dtype(dtype).kind == "f":
        upper_level = float(np.float32(upper_value))
        highest_inside: int | float = upper_level
        if upper_level <= rule.iso_level:
            raise UsageError(f"the ends of the range {rule.iso_value:g} to {upper_value:g} HU are one float32 number")
    else:
        highest_inside = math.floor(upper_value)
        upper_level = upper_value + 0.5 if highest_inside == upper_value else upper_value
    return replace(
        rule, inside="between", upper_value=upper_value, highest_inside=highest_inside, upper_level=upper_level
    )


def _choose_outside(rule: IsoRule, low: float, dtype: DTypeLike) -> float:
    """Return the value beyond the border: `low` (the lowest value of the volume, or air), or a value in its place.

    It must not be inside.  Where `low` is inside (everything is, or the level lies below air), it is a value beyond the
    level.  For surfaces of what lies below an iso value it lies as far above the level as `low` lies below, so that the
    surface of air ends half way to the border.  It can be written in the type of the voxels.
    """
    level, is_float = rule.iso_level, np.dtype(dtype).kind == "f"
    least = max(0.5, abs(level) * 2.0**-20)
    if rule.inside == "below":
        if is_float:
            return level + max(level - low, least)
        mirrored = min(math.ceil(2.0 * level - low), LARGEST_INTEGER)
        return float(min(max(rule.lowest_inside, mirrored), -_LOWEST_OUTSIDE))
    if low < level:
        return low
    return level - least if is_float else float(max(rule.lowest_inside - 1, _LOWEST_OUTSIDE))


def check_topology(topology: str, *, ranged: bool = False) -> None:
    if topology not in _TOPOLOGIES:
        raise UsageError(f"there is no topology {topology!r}: it is one of {', '.join(_TOPOLOGIES)}")
    if ranged and topology == "trilinear":
        raise UsageError(
            "the topology trilinear follows one level, a range has two: leave it out, or give one iso value"
        )


def _checked_level(level: Level, below: bool, dtype: np.dtype[Any]) -> tuple[float, float | None, bool]:
    """Return the iso value, or the two ends of a range, and whether what lies below it is inside."""
    if not isinstance(level, list | tuple | np.ndarray) or np.ndim(level) == 0:
        return checked_iso_value(level), None, below  # type: ignore[arg-type]
    if len(level) != 2 or not any(end is not None for end in level):
        raise UsageError(f"a range of HU has two ends, not {tuple(level)}: None leaves one of them open")
    low, high = (None if end is None else checked_iso_value(end) for end in level)
    if below:
        raise UsageError(f"below takes one iso value, not the range {level[0]} to {level[1]} HU")
    if low is None:  # all up to this end is all below the next value
        assert high is not None
        beyond = np.nextafter(np.float32(high), np.float32(np.inf)) if dtype.kind == "f" else math.floor(high) + 1
        return float(beyond), None, True
    if high is not None and low >= high:
        raise UsageError(f"the range {low:g} to {high:g} HU holds nothing: give its lower end first")
    return low, high, False


def checked_iso_value(iso_value: float) -> float:
    """An iso value as float; a `UsageError` where it is no finite number that float32 holds."""
    try:
        number = float(iso_value)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"the iso value is {iso_value!r}: give a number of HU") from error
    if not math.isfinite(number):
        raise UsageError(f"the iso value is {number}: give a finite number of HU")
    if abs(number) > LARGEST_FLOAT:
        raise UsageError(f"the iso value is {number:g}: beyond {LARGEST_FLOAT:g} is not supported")
    return number


_LARGEST_MARGIN = 0.25
"""Largest margin, in index steps; beyond it a vertex no longer tells where on its edge it lies."""


def vertex_margin(volume: Volume, border: int) -> NDArray[np.float64]:
    """Smallest distance of a vertex from a sample along i, j, k, in index steps; along k that of the thinnest layer.

    Vertices are float32 millimetres from `find_vertex_origin`.  Two vertices near one sample could be rounded to the
    same point, and a triangle between them would have no area.  So each stays at least four units in the last place of
    the volume's largest coordinate away from the sample; a vertex that belongs closer is moved by less than that.
    Typically it is 2e-4 of a step, eight times the rounding error of the coordinates.
    """
    largest, unit = _largest_and_unit(volume, border)
    steps = np.array(volume.spacing)
    steps[2] = np.linalg.norm(np.diff(volume.slice_origins(border=1), axis=0), axis=1).min()
    margin = 4.0 * unit / steps
    if margin.max() > _LARGEST_MARGIN:
        raise UsageError(
            f"the volume reaches {format_digits(largest)} mm from its centre with steps of {format_digits(steps.min())}"
            f" mm: float32 vertices come in steps of {format_digits(unit, 2)} mm there; take a part of it"
        )
    return margin


def layer_margins(volume: Volume, border: int) -> NDArray[np.float64]:
    """Smallest distance of a vertex from a sample along k, (nk + 2 * border,) layers from ``-border`` on, in their
    steps.

    The margin of a layer a few micrometres thick would be tenths of a millimetre in a thick one.
    """
    if not volume.uneven:
        return np.full(volume.shape_ijk[2] + 2 * border, vertex_margin(volume, border)[2])
    steps = np.linalg.norm(np.diff(volume.slice_origins(border + 1), axis=0)[1:], axis=1)
    return 4.0 * _largest_and_unit(volume, border)[1] / steps


def _largest_and_unit(volume: Volume, border: int) -> tuple[float, float]:
    """Return the largest coordinate of a vertex, mm from the vertex origin, and the float32 step at that coordinate."""
    largest = vertices.largest_coordinate(volume, vertices.find_vertex_origin(volume), border)
    return largest, vertices.float32_step(largest)


def slice_normal_matrices(volume: Volume, border: int) -> NDArray[np.float64]:
    """Return for slices from ``-border`` on the matrix from gradients per step, central, to those per mm."""
    origins = volume.slice_origins(border + 1)
    return _normal_matrices(volume, border, 0.5 * (origins[2:] - origins[:-2]))


def layer_normal_matrices(volume: Volume, border: int) -> NDArray[np.float64]:
    """Return the same for layers of cells, from slice k to k + 1, k from ``-border``, by the trilinear field there."""
    return _normal_matrices(volume, border, np.diff(volume.slice_origins(border + 1), axis=0)[1:])


def takes_parts(volume: Volume, ray_step: float) -> bool:
    """True where ray steps of `ray_step` mm pass through every cell: no index changes by more than 1."""
    steps_per_mm = np.linalg.norm(layer_normal_matrices(volume, border=0), axis=1)
    return bool(ray_step * steps_per_mm.max() <= 1.0)


def _normal_matrices(volume: Volume, border: int, k_steps: NDArray[np.float64]) -> NDArray[np.float64]:
    count = volume.shape_ijk[2] + 2 * border
    if not volume.uneven:
        return np.broadcast_to(normal_matrix(volume.affine), (count, 3, 3))
    steps = np.empty((count, 3, 3))
    steps[:, :, :2] = volume.affine[:3, :2]
    steps[:, :, 2] = k_steps
    return np.asarray(np.linalg.inv(steps).transpose(0, 2, 1), dtype=np.float64)
