"""The certificate of a volume that is not from DICOM: those entries of `clrecon.dicom.series.certificate` that are
known.
"""

from __future__ import annotations

from collections.abc import Sequence

from clrecon.formats.grid_file import GridFile
from clrecon.formats.values import GridValues
from clrecon.geometry.affine import column_spacing, signed_tilt, slice_normal
from clrecon.geometry.certificate import Certificate
from clrecon.geometry.orientation import describe_orientation
from clrecon.sources.gates import PADDING_SHARE, judge_figures, judge_steps, list_odd_values
from clrecon.sources.plausibility import VoxelFindings, leave_unexamined
from clrecon.system.records import Gate, at_most, none_of, unmeasured

MODALITY = "unknown"
NOT_DICOM = "not DICOM: position, spacing and the meaning of the values are as the file says, nothing vouches for them"


def collect_header_warnings(grid: GridFile) -> list[str]:
    """Return warnings about a grid file that are known before its voxels are read."""
    spacing = judge_spacing(grid)
    unusual = [f"{spacing['text']}: maybe the file has other units than it says"] if spacing["ok"] is False else []
    given = [] if grid.rescale is None else [str(grid.rescale)]
    return [NOT_DICOM, *grid.warnings, *unusual, *given]


def collect_value_warnings(values: GridValues) -> list[str]:
    """Return warnings about the values that were read, in addition to those for the voxels of any volume."""
    warnings = [*values.warnings, *values.doubts]
    if values.likeness is not None and values.likeness.is_mixed:
        warnings.append(str(values.likeness))
    if not values.doubts and (odd := list_odd_values(values.facts)):
        warnings.append(judge_figures(odd)["text"])
    return warnings


def judge_spacing(grid: GridFile) -> Gate:
    """Judge the gate ``plausible_spacing``.  Axes may be in any order; the longest step is that of the slices."""
    *pixels, gap = sorted(column_spacing(grid.affine))
    return judge_steps(pixels, gap)


def certify_grid(
    grid: GridFile, values: GridValues | None, warnings: Sequence[str], findings: VoxelFindings | None = None
) -> Certificate:
    """Build the report of a volume.

    values: None: the voxels were not read, and entries that depend on them are None.
    findings: What the voxels say of their values; None: they were not read.
    """
    facts = None if values is None else values.facts
    spacing = column_spacing(grid.affine)
    gap = abs(float(slice_normal(grid.affine) @ grid.affine[:3, 2]))
    ni, nj, nk = grid.shape_ijk
    return Certificate(
        format=grid.kind,
        series={"number": 1, "uid_hash": None, "modality": MODALITY},
        slices=nk,
        shape_ijk=[ni, nj, nk],
        spacing_mm=list(spacing),
        extent_mm=[ni * spacing[0], nj * spacing[1], nk * gap],
        affine_ijk_to_lps_mm=grid.affine.tolist(),
        orientation=describe_orientation(grid.affine),
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

    No file of this kind says that its values are HU. So the gate ``hu_known`` fails where they surely are not, and else
    counts as not measured.
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
        gates.append(unmeasured("plausible_hu", 0, None, "figures of HU that no CT has: not read, or hardly HU"))
    else:
        gates.append(judge_figures(list_odd_values(values.facts)))
    gates += leave_unexamined() if value_gates is None else value_gates
    if values is None:
        gates.append(unmeasured("padding_share", PADDING_SHARE, None, f"{share}: the voxels were not read"))
    else:
        gates.append(at_most("padding_share", values.facts.padding_share, PADDING_SHARE, None, share))
    return gates
