"""Settings of the cloud job, validated on construction, and the order of its steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from clrecon.errors import UsageError
from clrecon.jobs.options import InputSettings
from clrecon.points import POINT_KINDS
from clrecon.system.arguments import name_parameter

DENOISERS = ("grid", "bilateral")

GHOSTS = ("keep", "drop")
"""What becomes of the points of ghost slices."""


STEPS = {
    "read": "the scan, or a cloud from a file",
    "ghost slices": "foreign slices inside the stack are told by their neighbours; with drop the points in them go",
    "masks": "the field of view, the body and the region: what is outside becomes air; a crop takes it away",
    "preprocessing": "filters of HU, and morphology of what is in the band",
    "points": "the surface, the shell or the voxels of the HU band or the label",
    "clusters": "density clusters (DBSCAN), each point with the number of its own",
    "keep": "noise and the clusters that the rules do not keep go",
    "sparse cells": "points alone in a cell of a grid go, and what growth from denser cells does not reach",
    "outliers": "points whose neighbours are far go",
    "bilateral": "points move along their normals to the weighted mean height of their neighbours, edges stay",
    "normals": "unit vectors that point out of bone",
    "spacing": "one point for each cell of that size stays",
    "surface": "a closed mesh around the points, in a file of its own",
}
"""The steps in the order in which they run, whatever the order of the options."""

OF_SCANS = ("points", "hu", "labels", "ghost_slices")
"""Settings beside those of the input that have no meaning where the input is a cloud."""

LARGEST_MM = 1e4


@dataclass(frozen=True)
class Clustering:
    """Parameters of DBSCAN, see `clrecon.cluster_points`.

    eps: Mm.
    min_samples: int or "plane+1"
    """

    eps: float | None = None
    min_samples: int | str = 6

    def __post_init__(self) -> None:
        if self.eps is not None:
            _check_mm("eps of clusters", self.eps)
        if isinstance(self.min_samples, str) and self.min_samples != "plane+1":
            raise UsageError(f"the fewest points of a neighbourhood are a number or plane+1, not {self.min_samples!r}")
        if not isinstance(self.min_samples, str) and not 1 <= self.min_samples <= 255:
            raise UsageError(f"the fewest points of a neighbourhood lie between 1 and 255, not at {self.min_samples}")


@dataclass(frozen=True)
class CloudSettings(InputSettings):
    """Settings of the cloud job.

    points: {"surface", "shell", "voxels"}. Default: "voxels" where a band is given, else "surface".
    hu: float or (low, high). One number is an iso value, inside is that and above; two are a band, both ends included.
        Default: the iso value of the mesh job.
    labels: Label map; only points of one label are taken.
    label: Number or name of that label.
    ghost_slices: {"keep", "drop"}. What becomes of the points of slices that are unlike both neighbours, see
        `clrecon.find_ghost_slices`.  With "keep" there is a warning that names them.
    keep: Keep rules, see `clrecon.keep_clusters`; they need clusters, which then have the default parameters.
    outliers: Standard deviations of the mean distance to the neighbours beyond which a point goes.
    denoise: sequence of {"grid", "bilateral"}
    viewpoint: (x, y, z). A point inside of the object, mm in the frame of the output: normals of a cloud from a file
        point away from it.
    normals: Points without normals get them, and points that were moved new ones.
    spacing: Mm; one point for each cell of that size stays.
    paper: The formulas as the papers print them, with what that does.
    allow_point_loss: Go on where a step that should take noise only takes more than half of its points.
    space: {"lps", "ras"}. Patient frame of the written files, and of the seeds.
    input_space: {"lps", "ras"}. Patient frame of a cloud file that does not say its own.
    **shared: See `clrecon.jobs.options.InputSettings`.
    """

    points: str | None = None
    hu: float | Sequence[float] | None = None
    labels: str | Path | None = None
    label: str | None = None
    ghost_slices: str = "keep"
    clusters: Clustering | None = None
    keep: Sequence[str] = ()
    outliers: float | None = None
    denoise: Sequence[str] = ()
    normals: bool = False
    viewpoint: Sequence[float] | None = None
    spacing: float | None = None
    paper: bool = False
    allow_point_loss: bool = False
    space: str = "lps"
    input_space: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        from clrecon.geometry import frame_from_lps  # numpy: not loaded before a job starts

        frame_from_lps(self.space)
        _check_choice("points are", self.points, POINT_KINDS)
        _check_choice("points of ghost slices are kept or dropped:", self.ghost_slices, GHOSTS)
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
        ends = self.hu if isinstance(self.hu, Sequence) else () if self.hu is None else (self.hu,)
        for value in ends:
            if not math.isfinite(value):
                raise UsageError(f"HU are finite numbers, not {value}")
        if isinstance(self.hu, Sequence):
            if len(self.hu) != 2:
                raise UsageError(f"a band of HU has two ends, not {len(self.hu)}")
            if self.hu[0] > self.hu[1]:
                raise UsageError(f"the band {self.hu[0]:g},{self.hu[1]:g} HU holds nothing: give its lower end first")
            if self.points == "surface":
                raise UsageError("a surface has one iso value, not a band: give one number of HU, or other points")

    def _check_viewpoint(self) -> None:
        if self.viewpoint is None:
            return
        if len(self.viewpoint) != 3 or not all(map(math.isfinite, self.viewpoint)):
            raise UsageError(f"a viewpoint is a point of three numbers in mm, not {tuple(self.viewpoint)}")
        if not self.normals:
            raise UsageError(f"a viewpoint turns normals: ask for them too ({name_parameter('normals', True)})")

    @property
    def kind(self) -> str:
        """The kind of points that is taken from a scan."""
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


def _check_choice(what: str, value: str | None, known: Sequence[str]) -> None:
    if value is not None and value not in known:
        raise UsageError(f"{what} one of {', '.join(known)}, not {value!r:.60}")


def _check_mm(what: str, value: float) -> None:
    if not 0.0 < value <= LARGEST_MM:
        raise UsageError(f"{what} is a length in mm above 0 and up to {LARGEST_MM:g}, not {value:g}")
