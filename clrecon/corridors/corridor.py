"""The corridors of one labelled vertebra: the widest line of each pedicle with its measures, or why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.corridors.frame import VertebraFrame, find_frame
from clrecon.corridors.measures import Bias, angles, canal_wall, find_exit, margins, measure_bias
from clrecon.corridors.search import SIDES, Line, Span, find_line, line_points
from clrecon.corridors.solid_bone import SolidBone, fill_vertebra
from clrecon.errors import RefusedInputError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.labels.resample import resample_labels
from clrecon.system.arguments import explains_arguments

Float64Array = NDArray[np.float64]

LEAST_RADIUS_MM, LARGEST_RADIUS_MM = 1.0, 9.0
"""Radii of pedicles: below there is no room for any screw, above there is no pedicle."""

RESOLVED_VOXELS = 2.0
"""Least width of a pedicle in voxels, across its nearest wall."""

BESIDE_MM = 1.5
"""Points of the surface that are this much farther from the line than the nearest one are the corridor's walls."""


@dataclass(frozen=True)
class Corridor:
    """The widest line through one pedicle.  Points are LPS mm.

    side: {"left", "right"}. Of the patient.
    refused: Why there is no corridor; everything below is None then.
    radius: Least distance of the line from the surface of the bone, from `back` to `tip`, mm.
    entry: ndarray, shape (3,). Where the line, followed backwards, leaves the bone.
    back: ndarray, shape (3,). Where its distance begins to count: in the coronal plane through the canal's axis.
    pass_point: ndarray, shape (3,). In the narrowest coronal section of the pedicle.
    tip: ndarray, shape (3,). At 80 % of the body's depth.
    length: From entry to tip, mm.
    medial_deg, sagittal_deg: Angles in the vertebra's frame, see `clrecon.corridors.measures.angles`.
    medial_lps_deg, sagittal_lps_deg: The same in the patient's frame.
    medial_range_deg, sagittal_range_deg: Angles, in the vertebra's frame, of lines whose radius is at most 0.1 mm less.
    margins: Least distance from the surface by quarter, mm.
    canal: Least distance from the wall of the vertebral canal, mm.
    bias: How far the level lies from the half maximum of this pedicle's wall.
    by_hu_share: Share of the walls' points that HU place and not the label.
    width_voxels: Width of the corridor in voxels, across its nearest wall.
    tried: Lines whose distance was taken.
    """

    side: str
    refused: str | None = None
    radius: float | None = None
    entry: Float64Array | None = None
    back: Float64Array | None = None
    pass_point: Float64Array | None = None
    tip: Float64Array | None = None
    length: float | None = None
    medial_deg: float | None = None
    sagittal_deg: float | None = None
    medial_lps_deg: float | None = None
    sagittal_lps_deg: float | None = None
    medial_range_deg: tuple[float, float] | None = None
    sagittal_range_deg: tuple[float, float] | None = None
    margins: dict[str, float | None] | None = None
    canal: float | None = None
    bias: Bias | None = None
    by_hu_share: float | None = None
    width_voxels: float | None = None
    tried: int | None = None


@dataclass(frozen=True)
class VertebraCorridors:
    """Both corridors of a vertebra.

    name: Of the label.
    corridors: Left and right.
    """

    name: str
    bone: SolidBone
    frame: VertebraFrame
    corridors: tuple[Corridor, ...]
    warnings: tuple[str, ...]


def screw_diameter(radius: float, margin: float) -> float:
    """Return the largest diameter of a screw that keeps a margin to the surface, mm, down to the last tenth."""
    return max(0.0, math.floor(20.0 * (radius - margin) + 1e-9) / 10.0)


@explains_arguments
def find_corridors(volume: Volume, labels: LabelMap, label: int | str, iso_value: float) -> VertebraCorridors:
    """Find the widest straight corridors through the pedicles of a labelled vertebra.

    It measures one surface at one level of HU and is not for planning an operation; see docs/corridor.md.

    Parameters
    ----------
    volume : Volume
        HU.
    labels : LabelMap
        On any grid; each label is one vertebra.
    label : int or str
        Number or name, as `LabelMap.find` takes it.
    iso_value : float
        HU at which the bone's surface lies.

    Returns
    -------
    VertebraCorridors
        Points in LPS mm.  A side without a corridor says why.

    Raises
    ------
    UsageError
        There is no such label.
    RefusedInputError
        The label is not that of a whole vertebra, or it is cut off at the end of the scan.
    """
    number = labels.find(label)
    taken = resample_labels(labels, volume)
    return measure_corridors(volume, taken.voxels, number, float(iso_value), labels.name(number))


def measure_corridors(volume: Volume, labels: NDArray[Any], number: int, level: float, name: str) -> VertebraCorridors:
    """Find the corridors through the pedicles of a vertebra whose labels lie on the grid of the volume.

    volume: HU.
    labels: ndarray, shape (nk, nj, ni). Labels on the grid of the volume, see `clrecon.labels.resample_labels`.
    number: Label of the vertebra.
    level: HU at which the bone's surface lies.
    name: Name of the label, for messages.
    """
    bone = fill_vertebra(volume, labels, number, level, name)
    try:
        frame = find_frame(bone, name)
    except RefusedInputError as error:
        if not len(bone.cut):
            raise
        raise RefusedInputError(f"{error}; it reaches the end of the scan and may be cut off there") from error
    warnings = _judge_cut(bone, frame, name)
    surface = frame.to_frame(bone.surface)
    wall = surface[canal_wall(bone, frame)]
    found = []
    for side, sign in SIDES.items():
        line, span = find_line(lambda points: bone.quick_depth(frame.to_lps(points)), surface, frame, sign)
        found.append(_measure(bone, frame, surface, wall, side, line, span, name))
    return VertebraCorridors(name, bone, frame, tuple(found), tuple(warnings))


def _judge_cut(bone: SolidBone, frame: VertebraFrame, name: str) -> list[str]:
    """Refuse a vertebra whose body or pedicles go on beyond the scan; warn where only processes do."""
    if not len(bone.cut):
        return []
    local = frame.to_frame(bone.cut)  # joints above and below the body are processes too
    front = (local[:, 1] < frame.canal[1]) & (np.abs(local[:, 2]) <= 0.6 * frame.body_height)
    if front.any():
        raise RefusedInputError(
            f"{name} is cut off: {int(front.sum()):,} voxels of its body and pedicles lie in the outermost layer of the"
            " scan, and it may go on beyond; corridors need the whole body and both pedicles"
        )
    return [f"{name} touches the end of the scan with its processes; body and pedicles are whole"]


def _measure(
    bone: SolidBone,
    frame: VertebraFrame,
    surface: Float64Array,
    wall: Float64Array,
    side: str,
    line: Line | None,
    span: Span,
    name: str,
) -> Corridor:
    """Measure a line, or say why there is no corridor."""
    if line is None:
        return Corridor(
            side,
            f"no line stays in the bone at {bone.level:g} HU from the canal's plane to the front of the body: the"
            " pedicle is not resolved, or the level is too high",
        )
    ends = line_points(np.array([[line.x, line.z, line.medial_deg, line.sagittal_deg]]), span)[0]
    first, last = ends[0], ends[-1]
    way = last - first
    distance, voxels, by_hu = _walls(bone, frame, surface, first, last, line.radius)
    refused = None
    if line.radius > LARGEST_RADIUS_MM:
        refused = f"the widest line has a radius of {line.radius:.1f} mm: that is no pedicle of one vertebra"
    elif voxels < RESOLVED_VOXELS:
        refused = (
            f"the pedicle is not resolved: the widest line is {2.0 * line.radius:.1f} mm wide, {voxels:.1f} voxels, and"
            f" less than {RESOLVED_VOXELS:g} say nothing of its walls"
        )
    elif line.radius < LEAST_RADIUS_MM:
        refused = f"the widest line has a radius of {line.radius:.1f} mm: there is no room in this pedicle"
    if refused is not None:
        return Corridor(side, refused, width_voxels=voxels)
    middle = first + (span.back - frame.body_y[1]) / (span.back - span.tip) * way
    start, *_, tip = frame.to_lps(np.stack((first, last)))
    exit_point = find_exit(bone, start, start - tip)
    lps = tip - start
    pass_point = first + (span.back - span.pass_y) / (span.back - span.tip) * way
    medial, sagittal = angles(way, span.side)
    medial_lps, sagittal_lps = angles(lps, span.side)
    return Corridor(
        side,
        None,
        line.radius,
        exit_point,
        start,
        frame.to_lps(pass_point[None])[0],
        tip,
        float(np.linalg.norm(tip - exit_point)),
        medial,
        sagittal,
        medial_lps,
        sagittal_lps,
        line.medial_range,
        line.sagittal_range,
        margins(surface, first, last, span.side),
        _distance(wall, first, last),
        measure_bias(bone, frame, first, middle),
        by_hu,
        voxels,
        line.tried,
    )


def _distance(points: Float64Array, first: Float64Array, last: Float64Array) -> float | None:
    """Return the least distance of a segment from points, None without any."""
    if not len(points):
        return None
    way = last - first
    share = np.clip((points - first) @ way / (way @ way), 0.0, 1.0)
    return float(np.linalg.norm(points - first - share[:, None] * way, axis=1).min())


def _walls(
    bone: SolidBone,
    frame: VertebraFrame,
    surface: Float64Array,
    first: Float64Array,
    last: Float64Array,
    radius: float,
) -> tuple[float, float, float]:
    """Return the distance of the nearest wall, the corridor's width in voxels across it, and the share of the walls'
    points that HU place.
    """
    way = last - first
    share = np.clip((surface - first) @ way / (way @ way), 0.0, 1.0)
    offsets = surface - first - share[:, None] * way
    distance = np.linalg.norm(offsets, axis=1)
    nearest = int(distance.argmin())
    across = (offsets[nearest] / distance[nearest]) @ frame.axes
    voxel = float(np.abs(bone.steps.T @ across).max())
    beside = distance <= radius + BESIDE_MM
    return float(distance[nearest]), 2.0 * radius / voxel, float(bone.by_hu[beside].mean())
