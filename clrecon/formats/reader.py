"""`read_grid` reads a volume from one file that is not DICOM; `list_grid` lists it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from clrecon.errors import RefusedInputError
from clrecon.formats.certificate import MODALITY, certify_grid, collect_header_warnings, collect_value_warnings
from clrecon.formats.grid_file import VOLUME, GridFile
from clrecon.formats.kinds import open_grid
from clrecon.formats.values import GridValues, read_values
from clrecon.geometry import Volume
from clrecon.sources.listing import SeriesEntry, SeriesListing
from clrecon.sources.plausibility import VoxelFindings, examine_voxels
from clrecon.sources.rescale import Rescale
from clrecon.sources.stored_values import StoredRange
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.progress import Progress
from clrecon.system.text import escape_text

log = get_logger(__name__)


def read_grid(path: Path, kind: str, *, rescale: Rescale | None = None, progress: Progress | None = None) -> Volume:
    """Read a volume.

    kind: {"NIfTI", "NRRD", "MetaImage"}. As `clrecon.formats.kinds.tell_kind` returns it.
    rescale: In place of the slope and intercept of the header.
    progress: Called as ``progress("read", done, total)``.
    """
    grid = _open(path, kind, rescale)
    values = read_values(grid, progress)
    findings = _examine(grid, values)
    report = certify_grid(grid, values, _collect_warnings(grid, values, findings), findings)
    log.info("%s file read: %s voxels %s", grid.kind, grid.shape_ijk, values.voxels.dtype)
    log_warnings(log, report.warnings)
    return Volume(values.voxels, grid.affine, report, hu_range=(values.facts.hu_min, values.facts.hu_max))


def _examine(grid: GridFile, values: GridValues) -> VoxelFindings:
    stored: list[StoredRange] = []
    if grid.dtype.kind in "iu":
        one = StoredRange(8 * grid.dtype.itemsize, grid.dtype.kind == "i", grid.slope, grid.intercept)
        stored = [one] * len(values.voxels)
    return examine_voxels(values.voxels, values.facts, (), known=not values.doubts, stored=stored)


def _collect_warnings(grid: GridFile, values: GridValues | None, findings: VoxelFindings | None) -> list[str]:
    warnings = collect_header_warnings(grid)
    if values is not None and findings is not None:
        failed = [gate.text for gate in findings.gates if gate.ok is False]
        warnings += [*collect_value_warnings(values), *findings.warnings, *failed]
    return warnings


def list_grid(
    path: Path, kind: str, *, rescale: Rescale | None = None, pixels: bool = False, progress: Progress | None = None
) -> SeriesListing:
    """List the one volume of a file, with its certificate.

    path, kind, rescale, progress: As in `read_grid`.
    pixels: True: read the voxels too, for the entries that depend on them.  False: read only the header.
    """
    grid = _open(path, kind, rescale)
    values = read_values(grid, progress) if pixels else None
    findings = None if values is None else _examine(grid, values)
    warnings = _collect_warnings(grid, values, findings)
    certificate = certify_grid(grid, values, warnings, findings)
    copied = ("slices", "shape_ijk", "spacing_mm", "affine_ijk_to_lps_mm", "tilt_deg", "grid_residual_max_mm", "gap_mm",
              "uneven", "extent_mm", "slice_thickness_mm")  # fmt: skip
    entry = SeriesEntry(
        number=1,
        uid_hash=None,
        description=f"{grid.kind} file, voxels {grid.dtype.name}",
        modality=MODALITY,
        warnings=list(warnings),
        problems=[],
        **{name: certificate[name] for name in copied},
    )
    return SeriesListing([entry], 1, {}, [], certificate)


def _open(path: Path, kind: str, rescale: Rescale | None) -> GridFile:
    try:
        grid = open_grid(path, kind, VOLUME)
    except OSError as error:
        raise RefusedInputError(f"{escape_text(path.name)} cannot be read: {error.strerror or error}") from error
    if min(grid.shape_ijk) < 2:
        shown = " x ".join(map(str, grid.shape_ijk))
        raise RefusedInputError(f"{grid.name} has {shown} voxels: a volume has two at least along each axis")
    if rescale is None:
        return grid
    return replace(grid, slope=rescale.slope, intercept=rescale.intercept, rescale=rescale)
