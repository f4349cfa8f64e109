"""Settings of the cloud job, validated on construction, and the order of its steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from clrecon.errors import UsageError
from clrecon.jobs import options
from clrecon.points import POINT_KINDS, SURFACE_KINDS
from clrecon.system.arguments import PointKind, Space, name_parameter
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.options import option, parse_numbers

DENOISERS = ("grid", "bilateral")

_GHOSTS = ("keep", "drop")


STEPS = {
    "read": "the scan, or a cloud from a file",
    "ghost slices": "slices inside the stack that are unlike both neighbours are found; drop removes their points",
    "masks": "the field of view, the body and the region: everything outside is set to air; a crop removes it",
    "preprocessing": "filters of HU, and morphology of the voxels in the band",
    "points": "the surface, the shell or the voxels of the HU band or the label",
    "clusters": "density clusters (DBSCAN); each point gets the number of its cluster",
    "keep": "noise and the clusters that no rule keeps are removed",
    "sparse cells": "points alone in a cell of a grid are removed, and cells that denser cells do not reach by growth",
    "outliers": "points far from their neighbours are removed",
    "bilateral": "points move along their normals to the weighted mean height of their neighbours; edges are preserved",
    "normals": "unit vectors that point out of bone",
    "spacing": "one point is kept for each cell of that size",
    "surface": "a closed mesh around the points, in a separate file",
}
"""The steps in the order in which they run, whatever the order of the options."""

OF_SCANS = ("points", "hu", "labels", "ghost_slices")
"""Settings beside those of the input that have no meaning where the input is a cloud."""

LARGEST_MM = 1e4


@dataclass(frozen=True)
class Clustering:
    """Parameters of DBSCAN (`eps` in mm), see `clrecon.cluster_points`; `min_samples` can be "plane+1"."""

    eps: float | None = None
    min_samples: int | str = 6

    def __post_init__(self) -> None:
        if self.eps is not None:
            _check_mm("eps of clusters", self.eps)
        if isinstance(self.min_samples, str) and self.min_samples != "plane+1":
            raise UsageError(f"the fewest points of a neighbourhood are a number or plane+1, not {self.min_samples!r}")
        if not isinstance(self.min_samples, str) and not 1 <= self.min_samples <= 255:
            raise UsageError(f"the fewest points of a neighbourhood lie between 1 and 255, not at {self.min_samples}")


def _parse_level(text: str) -> float | tuple[float, ...]:
    """Read ``N`` as an iso value, and ``LO,HI`` or ``LO:HI`` as a band of HU."""
    values = parse_numbers(text.replace(":", ","))
    if values is None or len(values) > 2:
        raise ValueError(f"{text!r} is no iso value N and no band LO,HI of HU")
    return values[0] if len(values) == 1 else values


def _parse_clusters(text: str) -> dict[str, Any]:
    """Read ``eps=MM,min=N`` (either may be missing) as fields of `Clustering`, which is checked with the others."""
    known = {"eps": "eps", "min": "min_samples"}
    given: dict[str, Any] = {}
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals or name not in known or known[name] in given:
            raise ValueError(f"{text!r} is not eps=MM,min=N, such as eps=1.2,min=6")
        try:
            given[known[name]] = (
                value if value == "plane+1" and name == "min" else (float if name == "eps" else int)(value)
            )
        except ValueError:
            raise ValueError(f"{text!r}: {name} is no number: {value!r}") from None
    return given


def _parse_denoisers(text: str) -> tuple[str, ...]:
    """Read names with commas between them; what is not known is refused with the settings."""
    return tuple(part.strip().lower() for part in text.split(","))


_points_option = partial(option, group="points")
_steps_option = partial(option, group="steps")


@dataclass(frozen=True)
class CloudSettings(options.InputSettings):
    """Settings of the cloud job; options say in their help what they do.  `keep` alone has the default clusters."""

    space: Space = options.space_option("patient frame of the written files and of seeds")
    input_space: Space | None = option(
        "--input-space lps|ras",
        "patient frame of a cloud file that does not say its own (default: lps)",
        parse=str.lower,
    )
    points: PointKind | None = _points_option(
        f"--points {'|'.join(POINT_KINDS)}",
        "surface: where the HU cross the iso value, between the voxels; cortex: these, moved onto the bone surface"
        " (docs/iso_value.md); voxels: the centres of the voxels inside; shell: only the outer ones of these"
        " (default: surface; with a band: voxels)",
        parse=str.lower,
        first=True,
    )
    hu: float | Sequence[float] | None = options.hu_option(
        "iso value, inside is N and above; or a band, both ends included (default: the preset bone)",
        "N|LO,HI",
        group="points",
        parse=_parse_level,
        first=True,
    )
    labels: str | Path | None = options.label_map_option(group="points")
    label: str | None = options.label_option(
        "use only the points of this label (default: all)", group="points", action=None
    )
    paper: bool = _points_option(
        "--paper", "place and filter voxels as the papers print it, and report the resulting error"
    )
    ghost_slices: str = _steps_option(
        f"--ghost-slices {'|'.join(_GHOSTS)}",
        "what to do with slices that are unlike both neighbours, such as screen captures and localizers: drop removes"
        f" their points, keep only warns (default: {_GHOSTS[0]})",
        default=_GHOSTS[0],
        parse=str.lower,
    )
    clusters: Clustering | None = _steps_option(
        "--cluster eps=MM,min=N",
        "find density clusters (DBSCAN) and remove noise: neighbours are within eps, a core point has min of them,"
        " itself included; min=plane+1 treats lone slices as noise (default: 1.5 times the largest voxel step, 6)",
        parse=_parse_clusters,
        nargs="?",
        const={},
        first=True,
    )
    keep: Sequence[str] = _steps_option(
        "--keep RULE",
        "keep these clusters: largest, largest:N, min:POINTS, seed:X,Y,Z (the nearest), no-sheets (no tables and image"
        " planes); may be given again",
        default=(),
        action="append",
        first=True,
    )
    outliers: float | None = _steps_option(
        "--outliers SD",
        "remove points whose mean distance to the 15 nearest is SD standard deviations above the mean (no number: 2)",
        nargs="?",
        const=2.0,
    )
    denoise: Sequence[str] = _steps_option(
        f"--denoise {','.join(DENOISERS)}",
        "grid: remove points that are alone in a cell of a grid; bilateral: move points along their normals to the"
        " weighted mean height of their neighbours; edges are preserved",
        default=(),
        parse=_parse_denoisers,
        first=True,
    )
    normals: bool = _steps_option(
        "--normals",
        "add unit normals that point out of bone; points of a surface have those of the scan until they are moved",
        first=True,
    )
    viewpoint: Sequence[float] | None = _steps_option(
        "--viewpoint X,Y,Z",
        "a point inside the object, mm in the frame of --space: normals of a cloud file point away from it (those of a"
        " scan follow the HU)",
        parse=options.parse_point,
    )
    spacing: float | None = _steps_option("--spacing MM", "keep one point for each cell of that size")
    allow_point_loss: bool = option(
        "--allow-point-loss",
        "continue if a step that removes noise removes more than half of the points; otherwise this is refused",
        group="checks",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        options.check_space(self.space)
        _check_choice("points are", self.points, POINT_KINDS)
        _check_choice("points of ghost slices are kept or dropped:", self.ghost_slices, _GHOSTS)
        for name in self.denoise:
            _check_choice("clouds are denoised by", name, DENOISERS)
        if len(set(self.denoise)) < len(self.denoise):
            raise UsageError(f"a way to denoise is named twice: {', '.join(self.denoise)}")
        if self.outliers is not None and not (math.isfinite(self.outliers) and self.outliers > 0.0):
            raise UsageError(f"outliers are told by standard deviations above 0, not {self.outliers:g}")
        if self.spacing is not None:
            _check_mm("the spacing of points", self.spacing)
        self._check_hu()
        if self.label is not None and self.labels is None:
            raise UsageError("a label is one of a label map: give its file too")
        self._check_viewpoint()
        if self.keep:
            from clrecon.points.keep import parse_keep_rules

            parse_keep_rules(tuple(self.keep))
        if self.paper and self.clustering is not None:
            raise UsageError("as printed all slices fall into one plane, where clusters mean nothing: leave them out")

    def _check_hu(self) -> None:
        for value in self.hu if isinstance(self.hu, Sequence) else (self.hu,):
            if value is not None and not math.isfinite(value):
                raise UsageError(f"HU are finite numbers, not {value}")
        if isinstance(self.hu, Sequence):
            if len(self.hu) != 2:
                raise UsageError(f"a band of HU has two ends, not {len(self.hu)}")
            if self.hu[0] > self.hu[1]:
                raise UsageError(f"the band {self.hu[0]:g},{self.hu[1]:g} HU holds nothing: give its lower end first")
            if self.points in SURFACE_KINDS:
                raise UsageError("a surface has one iso value, not a band: give one number of HU, or other points")

    def _check_viewpoint(self) -> None:
        if self.viewpoint is None:
            return
        if len(self.viewpoint) != 3 or not all(map(math.isfinite, self.viewpoint)):
            raise UsageError(f"a viewpoint is a point of three numbers in mm, not {tuple(self.viewpoint)}")
        if not self.normals:
            raise UsageError(f"a viewpoint turns normals: ask for them too ({name_parameter('normals', True)})")

    @property
    def kind(self) -> PointKind:
        return self.points or ("voxels" if self.is_band else "surface")

    @property
    def masks(self) -> bool:
        """True where something of the scan is turned into air, or preprocessed."""
        given = (self.field_of_view, self.region, self.preprocess, self.crop)
        return self.remove_table or any(each is not None for each in given)

    @property
    def is_band(self) -> bool:
        """True where two ends of a band were given, and not one iso value."""
        return isinstance(self.hu, Sequence)

    def for_trial(self) -> CloudSettings:
        """Settings of the trial run that builds the kernels: the same steps on a cube of 12 voxels a side."""
        hu = (300.0, 3000.0) if self.is_band else 300.0  # below, a cube of 12 mm is searched for a face
        rules = [rule for rule in self.keep if not rule.lower().startswith(("min", "seed"))]
        return replace(
            self,
            hu=hu,
            labels=None,
            label=None,
            keep=tuple(rules),
            spacing=None if self.spacing is None else 2.0,
            device=None,
        )

    @property
    def clustering(self) -> Clustering | None:
        """Parameters of the clusters; those by default where only rules are given."""
        return self.clusters or (Clustering() if self.keep else None)


def _check_choice(subject: str, value: str | None, known: Sequence[str]) -> None:
    if value is not None and value not in known:
        raise UsageError(f"{subject} one of {', '.join(known)}, not {value!r:.60}")


def _check_mm(subject: str, value: float) -> None:
    if not 0.0 < value <= LARGEST_MM:
        raise UsageError(f"{subject} is a length in mm above 0 and up to {LARGEST_MM:g}, not {value:g}")
