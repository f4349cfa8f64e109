"""Volumes from files that are not DICOM: kind, voxels, certificate; `read_grid` and `list_grid`.

The kind of a file is found from its first bytes; its name is not trusted.

One rule holds for every stored type: int16 where all values are whole and fit, else int32 if they are whole, otherwise
float32.  So a CT gives the same volume and the same mesh from DICOM and from a file in which it was saved as float64.
The type is found in the one pass that reads the values: a slice that needs a wider one converts the volume.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import RefusedInputError
from clrecon.geometry import AIR_HU, Volume
from clrecon.geometry.affine import column_spacing, facts_of_orientation, signed_tilt, slice_normal, tilt_degrees
from clrecon.geometry.certificate import Certificate
from clrecon.reading.common import plausibility
from clrecon.reading.common.likeness import Likeness, judge_slices
from clrecon.reading.common.padding import fill_disc_padding
from clrecon.reading.common.selection import Rescale
from clrecon.reading.common.source_facts import PixelFacts, SeriesEntry, SeriesListing, StoredRange
from clrecon.reading.grids.grid_file import VOLUME, GridFile
from clrecon.reading.grids.metaimage import is_metaimage, open_metaimage
from clrecon.reading.grids.nifti import is_nifti, open_nifti
from clrecon.reading.grids.nrrd import is_nrrd, open_nrrd
from clrecon.reading.grids.zarr_store import open_zarr
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.memory import allocate_voxels, find_mapping
from clrecon.system.paths import open_regular
from clrecon.system.progress import Progress
from clrecon.system.records import Gate, at_most, none_of, unmeasured
from clrecon.system.text import escape_text, format_share

_START_BYTES = 512


def tell_kind(path: Path) -> str | None:
    """Return the kind of a file: "DICOM", "NIfTI", "NRRD", "MetaImage", or None."""
    with open_regular(path) as file:
        start = file.read(_START_BYTES)
    if start[128:132] == b"DICM":  # the 128 bytes before it may look like any format
        return "DICOM"
    if is_nifti(_inflate(start)):
        return "NIfTI"
    if is_nrrd(start):
        return "NRRD"
    return "MetaImage" if is_metaimage(start) else None


def _inflate(start: bytes) -> bytes:
    if start[:2] != b"\x1f\x8b":
        return start
    try:
        return zlib.decompressobj(wbits=31).decompress(start, 64)
    except zlib.error:
        return b""


def name_of_grid(path: Path) -> str:
    """Return the name of a grid file without its file extension, with which structures are named."""
    return re.sub(r"(\.seg)?\.(nii|hdr|nrrd|nhdr|mha|mhd)(\.gz)?$", "", path.name, flags=re.IGNORECASE) or path.name


_OPENERS: dict[str, Callable[[Path, str], GridFile]] = {
    "NIfTI": open_nifti,
    "NRRD": open_nrrd,
    "MetaImage": open_metaimage,
    "OME-Zarr": open_zarr,
}


def open_grid(path: Path, kind: str, purpose: str) -> GridFile:
    """Read the header of a file of one of the kinds of `tell_kind`, or of a folder of OME-Zarr."""
    return _OPENERS[kind](path, purpose)


_LADDER = (np.dtype(np.int16), np.dtype(np.int32), np.dtype(np.float32))
"""Types of a volume, from the narrowest to the widest."""

_MOST_LABELS = 256
"""Most different whole numbers of what is no CT: label maps have up to about 120, 8-bit images 256, a CT some
thousand."""
_LARGEST_LABEL = 65_535

_LEAST_SPAN = 100.0
"""Least range of HU in a CT: air and soft tissue differ by 1000, normalised values span 1, standardised ones about
10."""


@dataclass(frozen=True)
class GridValues:
    """Voxels (nk, nj, ni) int16, int32 or float32, facts, `doubts` of HU, `likeness` along the longest step."""

    voxels: NDArray[Any]
    facts: PixelFacts
    warnings: list[str]
    doubts: list[str]
    likeness: Likeness | None


def read_values(grid: GridFile, progress: Progress | None = None) -> GridValues:
    """Read the voxels of a grid file, scaled as its header says; NaN, where there was no image, becomes `AIR_HU`."""
    filling = _Filling(grid)
    for k, stored in enumerate(grid.iterate_slices()):
        filling.add(k, stored)
        if progress is not None:
            progress("read", k + 1, grid.shape_ijk[2])
    return filling.finish()


class _Filling:
    def __init__(self, grid: GridFile):
        self._grid = grid
        self._step = 0  # index into _LADDER
        self._voxels = self._allocate()
        self._holes = 0
        self._low = np.inf
        self._high = -np.inf

    def _allocate(self) -> NDArray[Any]:
        grid = self._grid
        voxels = allocate_voxels(grid.shape_ijk[::-1], _LADDER[self._step], grid.name, may_map=grid.may_be_mapped)
        self._mapping = find_mapping(voxels)
        return voxels

    def add(self, k: int, stored: NDArray[Any]) -> None:
        values = _scale(stored, self._grid)
        holes = np.isnan(values) if values.dtype.kind == "f" else None
        if holes is not None and holes.any():
            measured = values[~holes]
            self._holes += values.size - measured.size
            values = np.where(holes, values.dtype.type(AIR_HU), values)
        else:
            measured = values
        if measured.size:
            low, high = measured.min().item(), measured.max().item()
            self._low, self._high = min(self._low, low), max(self._high, high)
            step = self._step_for(k, measured, low, high)
            if step > self._step:
                narrow, self._step = self._voxels, step
                self._voxels = self._allocate()
                self._voxels[:k] = narrow[:k]
        np.copyto(self._voxels[k], values, casting="unsafe")  # the type holds all these values
        if self._mapping is not None:
            self._mapping.release(self._voxels[k])

    def _step_for(self, k: int, measured: NDArray[Any], low: float, high: float) -> int:
        """Return the index of the first type that holds these values, not below the current one."""
        grid = self._grid
        if not abs(low) + abs(high) < np.inf:
            raise RefusedInputError(f"{grid.name} is corrupt: {grid.place(k)} holds infinity, which is no CT number")
        whole = measured.dtype.kind != "f"
        if not whole and max(abs(low), abs(high)) > float(np.finfo(np.float32).max):
            raise RefusedInputError(f"{grid.name}: {grid.place(k)} goes from {low:g} to {high:g}, beyond float32")
        if not whole and (self._step == 2 or not np.array_equal(measured, np.rint(measured))):
            return 2
        for step in range(self._step, 2):
            half = 1 << (8 * _LADDER[step].itemsize - 1)
            if -half <= low and high < half:
                return step
        if whole:
            raise RefusedInputError(
                f"{grid.name}: {grid.place(k)} goes from {low:,} to {high:,}: whole numbers beyond 32 bits are no CT"
                " numbers"
            )
        return 2

    def finish(self) -> GridValues:
        voxels, low = self._voxels, self._low
        high = self._high
        if self._holes == voxels.size:
            raise RefusedInputError(f"{self._grid.name} holds no values: all of its voxels are NaN")
        doubts = _doubts(voxels, low, high)
        warnings: list[str] = []
        share, filled = self._holes / voxels.size, None
        disc = None if self._holes else fill_disc_padding(voxels)
        if self._holes:
            filled = float(AIR_HU)
            warnings.append(
                f"{self._holes:,} voxels ({format_share(share, 2)}) are NaN: {AIR_HU} HU, air, is taken for them"
            )
        elif disc is not None:
            share, filled = disc.voxels / voxels.size, disc.filled
        if filled is not None:
            low, high = min(low, filled), max(high, filled)
        facts = PixelFacts(share, float(low), float(high), filled)
        if disc is not None:
            facts = replace(facts, padding_text=disc.describe(voxels.size), disc=disc.value)
        if self._mapping is not None:
            voxels.flags.writeable = False  # its range need not be looked for anew
        return GridValues(voxels, facts, warnings, doubts, _judge_likeness(voxels, self._grid))


def _judge_likeness(voxels: NDArray[Any], grid: GridFile) -> Likeness | None:
    """Judge the likeness of neighbours along the axis of the longest step, which most likely was that of the scan."""
    spacing = column_spacing(grid.affine)
    axis = max((2, 1, 0), key=lambda place: round(spacing[place], 4))  # equal steps: the last axis
    return judge_slices(np.moveaxis(voxels, 2 - axis, 0), tilt_degrees(grid.affine))


def _scale(stored: NDArray[Any], grid: GridFile) -> NDArray[Any]:
    """Compute ``stored * slope + intercept``: exactly for whole numbers, else in float64."""
    if not grid.scaled:
        return stored
    slope, intercept = grid.slope, grid.intercept
    whole = slope.is_integer() and intercept.is_integer() and max(abs(slope), abs(intercept)) < 2**30
    if whole and stored.dtype.kind in "iu" and stored.dtype.itemsize <= 4:
        return stored.astype(np.int64) * int(slope) + int(intercept)
    with np.errstate(over="ignore", invalid="ignore"):
        return stored.astype(np.float64) * slope + intercept


def _doubts(voxels: NDArray[Any], low: float, high: float) -> list[str]:
    """Return reasons why the values may not be HU; `low` and `high` are the extremes of the measured values."""
    span = f"the values run from {low:.5g} to {high:.5g}"
    if low >= 0 and voxels.dtype.kind == "i" and high <= _LARGEST_LABEL:
        seen = np.zeros(int(high) + 1, dtype=bool)
        for plane in voxels:
            seen[plane[plane >= 0]] = True
        if np.count_nonzero(seen) <= _MOST_LABELS:
            return [
                f"{span} in {np.count_nonzero(seen)} different whole numbers: this looks like a label map (those go"
                f" with {name_parameter('labels')}) or an 8-bit image, not like HU"
            ]
    if high - low < _LEAST_SPAN:
        return [f"{span}: normalised, not HU"]
    if low >= 0:
        return [f"{span}, none is below 0: not HU, or HU with an offset (often 1024), which iso values then need too"]
    return []


_MODALITY = "unknown"
_NOT_DICOM = "not DICOM: position, spacing and the meaning of the values are as the file says and are not verified"


def judge_spacing(grid: GridFile) -> Gate:
    """Judge the gate ``plausible_spacing``.  Axes may be in any order; the longest step is that of the slices."""
    *pixels, gap = sorted(column_spacing(grid.affine))
    return plausibility.judge_steps(pixels, gap)


def certify_grid(
    grid: GridFile,
    values: GridValues | None,
    warnings: Sequence[str],
    findings: plausibility.VoxelFindings | None = None,
) -> Certificate:
    """Build the report of a volume; entries that depend on its voxels are None where they were not read."""
    facts = None if values is None else values.facts
    spacing = column_spacing(grid.affine)
    gap = abs(float(slice_normal(grid.affine) @ grid.affine[:3, 2]))
    ni, nj, nk = grid.shape_ijk
    return Certificate(
        format=grid.kind,
        series={"number": 1, "uid_hash": None, "modality": _MODALITY},
        slices=nk,
        shape_ijk=[ni, nj, nk],
        spacing_mm=list(spacing),
        extent_mm=[ni * spacing[0], nj * spacing[1], nk * gap],
        affine_ijk_to_lps_mm=grid.affine.tolist(),
        orientation=facts_of_orientation(grid.affine),
        tilt_deg=signed_tilt(grid.affine),
        gap_mm={"min": gap, "max": gap, "median": gap},
        transfer_syntax_names=[f"{grid.kind}, {grid.dtype.name}"],
        rescale={
            "slope": [grid.slope] * 2,
            "intercept": [grid.intercept] * 2,
            "type": None,
            **({} if grid.rescale is None else {"given": True}),
            **({} if findings is None else findings.materials),
        },
        padding_share=None if facts is None else facts.padding_share,
        padding_hu=None if facts is None else facts.padding_hu,
        hu_range=None if facts is None else [facts.hu_min, facts.hu_max],
        files={"found": 1, "used": 1, "skipped": {}},
        gates=judge_grid(grid, values, None if findings is None else findings.gates),
        warnings=list(warnings),
    )


def judge_grid(grid: GridFile, values: GridValues | None, value_gates: Sequence[Gate] | None) -> list[Gate]:
    """Judge a grid by the gates of a DICOM volume that apply to it, and by its own header.

    No such file says that its values are HU: the gate ``hu_known`` fails if they are not, else it is unmeasured.
    """
    doubtful = "values that cannot be HU, or hardly"
    share = "share of voxels without a measurement (padding)"
    mixed = "signs of several volumes between each other: neighbouring slices less alike than others"
    gates = [
        none_of("usable", 0, "reasons to refuse the volume"),
        none_of("header_clear", len(grid.warnings), "contradictions and gaps in the header"),
        judge_spacing(grid),
    ]
    if values is None or values.likeness is None:
        gates.append(unmeasured("one_volume", 0, None, f"{mixed}: the voxels were not read, or too few"))
    else:
        gates.append(none_of("one_volume", int(values.likeness.is_mixed), mixed))
    if values is not None and values.doubts:
        gates.append(none_of("hu_known", len(values.doubts), doubtful))
    elif grid.rescale is not None:
        gates.append(none_of("hu_known", 0, doubtful))
    else:
        gates.append(unmeasured("hu_known", 0, None, f"{doubtful}: the file does not say what they are"))
    if values is None or values.doubts:
        gates.append(unmeasured("plausible_hu", 0, None, "implausible HU values: not read, or hardly HU"))
    else:
        gates.append(plausibility.judge_figures(plausibility.list_odd_values(values.facts)))
    gates += plausibility.leave_unexamined() if value_gates is None else value_gates
    if values is None:
        gates.append(
            unmeasured("padding_share", plausibility.PADDING_SHARE, None, f"{share}: the voxels were not read")
        )
    else:
        gates.append(at_most("padding_share", values.facts.padding_share, plausibility.PADDING_SHARE, None, share))
    return gates


log = get_logger(__name__)


def read_grid(path: Path, kind: str, *, progress: Progress | None = None, **given: Any) -> Volume:
    """Read a volume of one of the kinds of `tell_kind`; `given` are a rescale in place of that of the header, and a
    voxel size where it has none, see `_open_by_kind`."""
    grid = _open_by_kind(path, kind, **given)
    values = read_values(grid, progress)
    findings = _examine(grid, values)
    report = certify_grid(grid, values, _collect_warnings(grid, values, findings), findings)
    log.info("%s file read: %s voxels %s", grid.kind, grid.shape_ijk, values.voxels.dtype)
    log_warnings(log, report.warnings)
    return Volume(values.voxels, grid.affine, report, hu_range=(values.facts.hu_min, values.facts.hu_max))


def _examine(grid: GridFile, values: GridValues) -> plausibility.VoxelFindings:
    stored: list[StoredRange] = []
    if grid.dtype.kind in "iu":
        stored_range = StoredRange(8 * grid.dtype.itemsize, grid.dtype.kind == "i", grid.slope, grid.intercept)
        stored = [stored_range] * len(values.voxels)
    return plausibility.examine_voxels(values.voxels, values.facts, (), known=not values.doubts, stored=stored)


def _collect_warnings(
    grid: GridFile, values: GridValues | None, findings: plausibility.VoxelFindings | None
) -> list[str]:
    """Return warnings about the header, then about the values where they were read."""
    warnings = [_NOT_DICOM, *grid.warnings]
    spacing = judge_spacing(grid)
    if spacing.ok is False:
        warnings.append(f"{spacing.text}: maybe the file has other units than it says")
    if grid.rescale is not None:
        warnings.append(str(grid.rescale))
    if values is None or findings is None:
        return warnings
    warnings += [*values.warnings, *values.doubts]
    if values.likeness is not None and values.likeness.is_mixed:
        warnings.append(str(values.likeness))
    if not values.doubts and (odd := plausibility.list_odd_values(values.facts)):
        warnings.append(plausibility.judge_figures(odd).text)
    return [*warnings, *findings.warnings, *(gate.text for gate in findings.gates if gate.ok is False)]


def list_grid(
    path: Path, kind: str, *, pixels: bool = False, progress: Progress | None = None, **given: Any
) -> SeriesListing:
    """List the one volume of a file, with its certificate, for `pixels` also by its voxels; see `read_grid`."""
    grid = _open_by_kind(path, kind, **given)
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
        modality=_MODALITY,
        warnings=list(warnings),
        problems=[],
        **{name: certificate[name] for name in copied},
    )
    return SeriesListing([entry], 1, {}, [], certificate)


def _open_by_kind(
    path: Path, kind: str, *, rescale: Rescale | None = None, voxel_size: Sequence[float] | None = None
) -> GridFile:
    try:
        grid = open_grid(path, kind, VOLUME) if voxel_size is None else open_zarr(path, VOLUME, voxel_size)
    except OSError as error:
        raise RefusedInputError(f"{escape_text(path.name)} cannot be read: {error.strerror or error}") from error
    if min(grid.shape_ijk) < 2:
        shown = " x ".join(map(str, grid.shape_ijk))
        raise RefusedInputError(f"{grid.name} has {shown} voxels: a volume has two at least along each axis")
    if rescale is None:
        return grid
    return replace(grid, slope=rescale.slope, intercept=rescale.intercept, rescale=rescale)
