"""The report of a comparison: the numbers of the page, and nothing of the page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from clrecon.jobs.shared.run_report import RunReport
from clrecon.system.records import Record

__all__ = ["CompareReport", "MethodRecord"]


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodRecord(Record):
    """A row of the comparison.

    Attributes
    ----------
    name, title, what : str
        See `clrecon.jobs.compare.methods.Compared`.
    makes : {"mesh", "cloud", "picture"}
    peer : str
        Library of somebody else; empty for clrecon's own.
    state : {"done", "failed", "declined", "missing"}
    error : str or None
    triangles, vertices, points : int or None
    first_s, warm_s : float or None
        From voxels in memory to the result in memory, in a new process and again (median); no reading, no drawing.
    warm_runs : int
    first_parts_s, warm_parts_s : mapping of str to float
        By part: ``read``, ``build``, ``upload``, ``kernels``, ``host``, ``download``, ``draw``.
    kernels_ms : float or None
        Of the warm run, as the device tells it; None without kernels.
    memory_bytes : int or None
        Most memory of its process, the interpreter and the scan included.
    memory_own_bytes : int or None
        The same beyond what the process had before it began.
    cells_visited, cells_all : int or None
    growing : mapping or None
        What was left out, see `clrecon.extract_isosurface`.
    quality, cells, slices, surfaces, truth, points_mm, pictures : mapping or None
        Measures, see docs/compare.md.
    reasons : mapping of str to str
        Why a measure is missing.
    small : mapping or None
        Of ray casting: ``size``, ``first_s``, ``warm_s`` of a small picture, and ``scaled_s``, those of the full one
        reckoned from it where it was not made.
    picture, difference : str or None
        Files.
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

    Attributes
    ----------
    date : str
        Day, ISO 8601.
    shape_ijk, spacing_mm : sequence
    iso_value_hu, iso_level_hu : float
        The level, and where the surface lies between integers.
    iso_value_reason : str
    closed_at_border : bool
    reference : str
    repeat : int
    with_truth : bool
    processor : str
    cores : int
    free_cores : float
    versions : mapping of str to str
        Of Python and of each library that works.
    read_s : mapping
        ``first`` and ``warm`` seconds of reading the input.
    findings : list of str
    methods : list of MethodRecord
    view : str
    size : [int, int]
        Width and height of the pictures.
    slices : list of mapping
        Pictures of slices with contours: ``axis``, ``index``, ``file``, ``detail``.
    paper : mapping or None
        The table against the middle slice.
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
