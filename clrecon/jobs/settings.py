"""Settings of the jobs that are one file each, validated on construction: nothing here loads numpy, as help asks it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from clrecon.errors import UsageError
from clrecon.jobs import options
from clrecon.jobs.presets import DEFAULT_PRESET, find_iso_preset
from clrecon.reading import Selection
from clrecon.system.arguments import Space, SurfaceKind, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.options import numbers_reader, option

FITTED_FROM_HU = find_iso_preset(DEFAULT_PRESET).iso_value
"""Level that shows the walls which are fitted, if no other is given."""


def _check_surface_level(settings: StatsSettings | DistanceSettings) -> None:
    options.check_surface(settings.surface, settings.iso_value)
    if settings.iso_value is not None and settings.surface is None:
        raise UsageError(
            f"a level is that of a surface: ask for one ({name_parameter('surface', 'hu')}), or leave"
            f" {name_parameter('iso_value')} out"
        )


_parts_option = partial(option, group="parts")
_vertebrae_option = partial(option, group="vertebrae")


@dataclass(frozen=True, kw_only=True)
class InfoSettings(Selection):
    """What is judged: a series that is named, or, unless `strict`, any usable one."""

    pixels: bool = option(
        "--pixels",
        "also read the pixels of the series marked *: share of padding, range of HU, saturated metal",
        first=True,
    )
    strict: bool = options.strict_option("4 if the series fails a gate, see docs/certificate.md", first=True)


@dataclass(frozen=True, kw_only=True)
class ExportSettings(options.InputSettings):
    """Settings of the export job; see `clrecon.geometry.resample.resample_volume`."""

    resample: float | None = option(
        "--resample MM",
        "resample (trilinear) to a regular grid with this step along all axes; without it voxels stay as they are",
        first=True,
    )
    space: Space = options.space_option("patient frame of crop and region; that of the file follows from its format")

    def __post_init__(self) -> None:
        super().__post_init__()
        options.check_space(self.space)
        if self.resample is not None:
            from clrecon.geometry.resample import check_step

            check_step(self.resample)

    @property
    def needs_device(self) -> bool:
        """True where the region or a step of preprocessing runs on a device."""
        return bool(self.region) or self.preprocess is not None


@dataclass(frozen=True, kw_only=True)
class StatsSettings(options.ScanSettings, options.DeviceSettings):
    """Settings of the job of statistics; without `label` all labels are measured, without `surface` their voxels."""

    labels: str | Path = options.label_map_option(required=True)
    label: Sequence[str | int] = options.label_option(default=(), first=True)
    percentiles: Sequence[float] | None = option(
        "--percentiles P,P",
        "percentiles of HU, from 0 to 100 (default: 5,25,50,75,95)",
        parse=numbers_reader(None, "are no percentiles: numbers with commas, 5,50,95"),
        first=True,
    )

    surface: SurfaceKind | None = options.surface_option(
        "measure the surface of each label at the level too: area and volume", group="surface", first=True
    )
    iso_value: float | None = options.hu_option(
        f"level of the surface (default: that of bone, {FITTED_FROM_HU:g})", group="surface"
    )

    def __post_init__(self) -> None:
        from clrecon.labels.statistics import check_percentiles  # numpy: not loaded before a job starts

        super().__post_init__()
        if self.percentiles is not None:
            check_percentiles(self.percentiles)
        _check_surface_level(self)


MOST_SAMPLES = 10_000_000


@dataclass(frozen=True, kw_only=True)
class DistanceSettings(options.ScanSettings, options.DeviceSettings):
    """Settings of the job of distances; with `surface` the reference is a scan, of whose bone that surface is made."""

    mesh_space: Space | None = options.mesh_space_option("files that do not name theirs")
    samples: int | None = option("--samples N", "points on each mesh, evenly by area (default: 50000)")
    surface: SurfaceKind | None = options.surface_option(
        "B is a scan: compare with its bone surface at the level", group="scan", first=True
    )
    iso_value: float | None = options.hu_option(
        f"level of that surface (default: that of bone, {FITTED_FROM_HU:g})", group="scan"
    )
    range_mm: float | None = option(
        "--range MM",
        "distance at which the colours end (default: 1, 2 or 5 x 10^n mm that cover 95 %% of the distances)",
        group="picture",
        first=True,
    )
    view: str = options.view_option(
        "V", "view of the picture: anterior (default), left, AZ,EL ...", group="picture", default="anterior"
    )
    space: Space = options.space_option("patient frame of the coloured mesh", group="picture")

    def __post_init__(self) -> None:
        from clrecon.rendering.views.directions import find_view, read_view

        options.check_space(self.space)
        options.check_space(self.mesh_space)
        _check_surface_level(self)
        if self.samples is not None and not 1 <= self.samples <= MOST_SAMPLES:
            raise UsageError(f"distances need 1 to {MOST_SAMPLES:,} samples on each mesh, not {self.samples:,}")
        if self.range_mm is not None and not (math.isfinite(self.range_mm) and self.range_mm > 0.0):
            raise UsageError(f"the colours span a number of mm above 0, not {self.range_mm:g}")
        find_view(read_view(self.view))
        super().__post_init__()


_INSIDE_VIEW = "130,20"
"""From the left, behind and above: body, arch and canal are seen."""


def _parse_band(text: str) -> tuple[float | None, float | None]:
    """Read ``A``, ``A:`` or ``A:B``, numbers of HU; ``:B`` leaves the lower end open."""
    low, _, high = text.partition(":")
    try:
        ends = [float(end) if end else None for end in (low, high)]
    except ValueError:
        ends = [None, None]
    if ends == [None, None] or any(end is not None and not math.isfinite(end) for end in ends):
        raise ValueError(f"{text!r} is no band of HU: write A for A and above, or A:B")
    return ends[0], ends[1]


@dataclass(frozen=True, kw_only=True)
class InsideSettings(options.ScanSettings, options.DeviceSettings):
    """Settings of the job that looks into vertebrae; None in `dense`, (low, high), leaves an end open."""

    labels: str | Path = options.label_map_option(required=True)
    label: Sequence[str | int] = options.label_option(
        "label of a vertebra; may be given again", required=True, first=True
    )
    view: str = options.view_option(
        "V",
        f"anterior, posterior, left, right, superior, inferior, or AZ,EL in degrees (default: {_INSIDE_VIEW})",
        group="pictures",
        default=_INSIDE_VIEW,
        words=("anterior", "posterior", "left", "right", "superior", "inferior"),
    )
    iso_value: float | None = options.hu_option(
        "level of the solid bone, within one voxel of the label (default: the label's own voxels; with --surface"
        f" cortex {FITTED_FROM_HU:g})",
        group="parts",
        first=True,
    )
    surface: SurfaceKind = options.surface_option(
        "the solid bone ends at the label or the level (default)", group="parts", default="hu", first=True
    )
    dense: Sequence[float | None] | None = _parts_option(
        "--dense A[:B]", "HU of dense bone, from A on or from A to B (default: 450)", parse=_parse_band
    )
    close_mm: float | None = _parts_option("--close MM", "close pores by balls of this radius (default: 1.5)")
    grow_mm: float | None = options.grow_option("with --hu: ", group="parts")
    space: Space = options.space_option("patient frame of the meshes", group="parts")

    def __post_init__(self) -> None:
        options.check_space(self.space)
        if not self.label:
            raise UsageError(f"choose the vertebrae by their labels: {name_parameter('label', 'L3')}")
        super().__post_init__()
        options.check_surface(self.surface)
        if self.grow_mm is not None and self.solid_from is None:
            raise UsageError(
                f"the labels' own voxels do not grow: leave {name_parameter('grow_mm')} out, or give an iso value"
                f" ({name_parameter('iso_value', 'N')})"
            )

    @property
    def solid_from(self) -> float | None:
        """Level of the solid bone, HU; None: the label's own voxels."""
        return FITTED_FROM_HU if self.iso_value is None and self.surface == "cortex" else self.iso_value


def _parse_name(text: str) -> tuple[tuple[float, ...], str]:
    point, equals, level = text.rpartition("=")
    if not equals or not level.strip():
        raise ValueError(f"{text!r} is no named point: write it as X,Y,Z=L3")
    return options.parse_point(point), level.strip()


@dataclass(frozen=True, kw_only=True)
class VertebraeSettings(options.ScanSettings):
    """Settings of the search for vertebrae; see `clrecon.split_vertebrae`."""

    level: float | None = options.hu_option(
        "level of bone in HU (default: half way between discs and marrow, 120 to 226)", group="vertebrae", first=True
    )
    seeds: Sequence[Sequence[float]] = options.seeds_option(
        "a point in the body of a vertebra, LPS mm; one for each vertebra, instead of the search for discs",
        group="vertebrae",
        first=True,
    )
    name_at: tuple[Sequence[float], str] | None = _vertebrae_option(
        "--name-at X,Y,Z=L3",
        "name the level of the vertebra at this point (LPS mm), and from it all others",
        parse=_parse_name,
        first=True,
    )
    first: str | None = _vertebrae_option(
        "--first LEVEL",
        "name the level of the uppermost vertebra that is found (T1), and from it all others; without --first and"
        " --name-at they are numbered from the head",
        first=True,
    )
    keep_unsure: bool = _vertebrae_option("--keep-unsure", "write vertebrae of low confidence too")

    def __post_init__(self) -> None:
        from clrecon.spine.split import check_landmark

        if self.level is not None and not math.isfinite(self.level):
            raise UsageError(f"the level of bone is a number of HU, not {self.level!r}")
        points = [*self.seeds, *([] if self.name_at is None else [self.name_at[0]])]
        for point in points:
            if len(point) != 3 or not all(math.isfinite(value) for value in point):
                raise UsageError(f"a point is three numbers in mm, not {list(point)!r}")
        if len(self.seeds) == 1:
            raise UsageError("one seed is too few: give a point in each vertebra, two at least")
        check_landmark(self.name_at, self.first)


_LARGEST_MARGIN_MM = 5.0


def _parse_level(text: str) -> float | None:
    if text == "auto":
        return None
    levels = options.parse_levels(text)
    if len(levels) != 1:
        raise ValueError(f"it is one level or auto, not {text!r:.80}")
    return levels[0]


@dataclass(frozen=True, kw_only=True)
class CorridorSettings(options.ScanSettings, options.DeviceSettings):
    """Settings of the corridor job; without `iso_value` it is half way, measured in the scan."""

    labels: str | Path = options.label_map_option(required=True)
    label: Sequence[str | int] = options.label_option(
        "a vertebra of the map; may be given again", default=(), first=True
    )
    iso_value: float | None = options.hu_option(
        "level of the bone surface in HU (default: auto, half way between bone and the tissue beside it; with"
        f" --surface cortex {FITTED_FROM_HU:g})",
        "auto|N",
        parse=_parse_level,
        first=True,
    )
    surface: SurfaceKind = options.surface_option("the surface lies at the level (default)", default="hu", first=True)
    margin: float = option(
        "--margin MM", "distance between the largest screw and the bone surface (default: 1)", default=1.0, first=True
    )
    screws: tuple[Any, ...] = ()
    space: Space = options.space_option("patient frame of points and meshes", group="space")

    def __post_init__(self) -> None:
        if not self.label:
            raise UsageError(f"name the vertebrae: {name_parameter('label', 'L3')}, once for each")
        if not (math.isfinite(self.margin) and 0.0 <= self.margin <= _LARGEST_MARGIN_MM):
            raise UsageError(f"the margin is a length from 0 to {_LARGEST_MARGIN_MM:g} mm, not {self.margin:g}")
        options.check_surface(self.surface, self.iso_value)
        options.check_space(self.space)
        super().__post_init__()
