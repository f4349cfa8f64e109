"""The report of a comparison: the numbers of the page, and nothing of the page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from clrecon.jobs.run import RunReport
from clrecon.system.records import Record


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodRecord(Record):
    """A row of the comparison.

    name, title, what: See `clrecon.jobs.compare.methods.Compared`.
    makes: {"mesh", "cloud", "picture"}
    peer: Library of somebody else; empty for clrecon's own.
    state: {"done", "failed", "declined", "missing"}
    first_s, warm_s: From voxels in memory to the result in memory, in a new process and again (median); no reading, no
        drawing.
    first_parts_s, warm_parts_s: By part: ``read``, ``build``, ``upload``, ``kernels``, ``host``, ``download``,
        ``draw``.
    kernels_ms: Of the warm run, as the device tells it; None without kernels.
    memory_bytes: Most memory of its process, the interpreter and the scan included.
    memory_own_bytes: The same beyond what the process had before it began.
    growing: What was left out, see `clrecon.extract_isosurface`.
    quality, cells, slices, surfaces, truth, points_mm, pictures: Measures, see docs/compare.md.
    reasons: Why a measure is missing.
    small: Of ray casting: ``size``, ``first_s``, ``warm_s`` of a small picture, and ``scaled_s``, those of the full one
        reckoned from it where it was not made.
    picture, difference: Files.
    """

    name: str
    title: str
    what: str
    makes: str
    peer: str
    state: str
    error: str | None
    triangles: int | None
    vertices: int | None
    points: int | None
    first_s: float | None
    warm_s: float | None
    warm_runs: int
    first_parts_s: Mapping[str, float]
    warm_parts_s: Mapping[str, float]
    kernels_ms: float | None
    memory_bytes: int | None
    memory_own_bytes: int | None
    cells_visited: int | None
    cells_all: int | None
    growing: Mapping[str, Any] | None
    quality: Mapping[str, Any] | None = None
    cells: Mapping[str, Any] | None = None
    slices: Mapping[str, Any] | None = None
    surfaces: Mapping[str, Any] | None = None
    truth: Mapping[str, Any] | None = None
    points_mm: Mapping[str, Any] | None = None
    pictures: Mapping[str, Any] | None = None
    reasons: Mapping[str, str]
    small: Mapping[str, Any] | None
    picture: str | None = None
    difference: str | None = None

    @property
    def is_done(self) -> bool:
        """True where the method made something."""
        return self.state == "done"


@dataclass(frozen=True, eq=False, kw_only=True)
class CompareReport(RunReport):
    """The report of a comparison: a `RunReport` with further entries, which docs/compare.md explains.

    date: Day, ISO 8601.
    iso_value_hu, iso_level_hu: The level, and where the surface lies between integers.
    versions: Of Python and of each library that works.
    read_s: ``first`` and ``warm`` seconds of reading the input.
    size: [int, int]. Width and height of the pictures.
    slices: Pictures of slices with contours: ``axis``, ``index``, ``file``, ``detail``.
    paper: The table against the middle slice.
    """

    affine_ijk_to_lps_mm: list[list[float]]
    date: str
    shape_ijk: list[int]
    spacing_mm: list[float]
    iso_value_hu: float
    iso_level_hu: float
    iso_value_reason: str
    closed_at_border: bool
    reference: str
    repeat: int
    with_truth: bool
    processor: str
    cores: int
    free_cores: float
    versions: Mapping[str, str]
    read_s: Mapping[str, float]
    findings: list[str]
    methods: list[MethodRecord]
    view: str
    size: list[int]
    slices: list[dict[str, Any]]
    paper: Mapping[str, Any] | None
    device: str
    driver: str
    memory_allowed_bytes: int | None
    version: str
    platform: str
    warnings: list[str]
    volume: Mapping[str, Any]
    seconds: Mapping[str, float]
    peak_memory_bytes: int | None
