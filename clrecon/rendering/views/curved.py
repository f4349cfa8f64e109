"""The sheets of curved planar reformations: stretched and straightened, after Kanitsar et al. 2002.

A *stretched* picture unrolls a cylinder: the surface that a straight line of one direction sweeps when it moves along
the centre line.  It distorts nothing: every length within that surface is kept, along the centre line, across it and in
between.  The centre line itself appears as a curve on the unrolled surface.

A *straightened* picture shows the centre line as a straight vertical line: each row is a line across it, in a frame
that does not twist along the line.  Lengths are kept along the centre line and in every row.  At a distance d from a
line that bends with radius r, lengths along the line towards the centre of the bend are stretched by 1 / (1 - d / r).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.rendering.views.centre_line import Curve, rotation_minimising_normals
from clrecon.rendering.views.plane import Sheet

FRAME_STEP_MM = 0.25
"""Largest distance between places at which frames and projected lengths are computed; less for small pixels."""


@dataclass(frozen=True)
class CurvedSheet:
    """The sheet of a picture along a curve.

    arc: ndarray, shape (h,), float64. Arc length of the curve in mm at each row; NaN for rows beyond its ends.
    columns: ndarray, shape (h,), float64. Column in which each row shows the curve, pixel centres at whole numbers.
    """

    sheet: Sheet
    arc: Float64Array
    columns: Float64Array


def _row_places(length: float, height: int, pixel: float) -> Float64Array:
    """Return the positions of the row centres along a curve that is in the middle of the picture."""
    return np.asarray(0.5 * length + (np.arange(height) + 0.5 - 0.5 * height) * pixel, dtype=np.float64)


def _fine_arcs(length: float, pixel: float) -> Float64Array:
    count = max(int(np.ceil(length / min(pixel, FRAME_STEP_MM))), 8)
    return np.linspace(0.0, length, count + 1, dtype=np.float64)


def _interpolate(at: Float64Array, places: Float64Array, values: Float64Array) -> Float64Array:
    return np.stack([np.interp(at, places, column) for column in values.T], axis=1)


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def straightened_sheet(
    curve: Curve, across: Float64Array, size: tuple[int, int], pixel: float, angle: float = 0.0
) -> CurvedSheet:
    """Make a sheet whose rows cross a curve, which becomes a straight line down the middle of the picture.

    curve: The curve from the top of the picture to its bottom.
    across: ndarray, shape (3,). Direction in LPS that the rows follow as well as a frame without twist allows: the mean
        of their rotation from it, along the curve, is zero.
    size: (w, h)
    pixel: mm.
    angle: Degrees by which all rows are turned about the curve: into the picture at the right.
    """
    width, height = size
    arcs = _fine_arcs(curve.length, pixel)
    places, tangents = curve.at(arcs), curve.tangents(arcs)
    helper = np.eye(3)[np.abs(tangents[0]).argmin()]
    normals = rotation_minimising_normals(places, tangents, helper)
    binormals = np.cross(tangents, normals)
    along_normal, along_binormal = float((normals @ across).sum()), float((binormals @ across).sum())
    if np.hypot(along_normal, along_binormal) < 1e-3 * len(arcs):
        raise UsageError("the centre line runs along the direction that should run across it: take another view")
    turn = np.arctan2(along_binormal, along_normal)
    rights = np.cos(turn) * normals + np.sin(turn) * binormals
    depths = np.cross(rights, tangents)  # into the picture
    turned = np.radians(angle)
    rights, depths = (
        np.cos(turned) * rights + np.sin(turned) * depths,
        np.cos(turned) * depths - np.sin(turned) * rights,
    )
    arc = _row_places(curve.length, height, pixel)
    within = (arc >= 0.0) & (arc <= curve.length)
    tangent = curve.tangents(arc)
    right = _interpolate(arc, arcs, rights)
    right = _unit(right - (right * tangent).sum(axis=1, keepdims=True) * tangent)
    middle = 0.5 * (width - 1)
    sheet = Sheet(curve.at(arc) - middle * pixel * right, pixel * right, np.cross(right, tangent), width)
    return CurvedSheet(sheet, np.where(within, arc, np.nan), np.where(within, middle, np.nan))


def stretched_sheet(curve: Curve, across: Float64Array, size: tuple[int, int], pixel: float) -> CurvedSheet:
    """Make a sheet of parallel rows through a curve, at equal distances on the surface that the rows form.

    curve: The curve from the top of the picture to its bottom.
    across: ndarray, shape (3,). Direction of all rows, LPS.
    size: (w, h)
    pixel: mm.
    """
    width, height = size
    direction = _unit(np.asarray(across, dtype=np.float64))
    arcs = _fine_arcs(curve.length, pixel)
    flow = curve.tangents(arcs)
    flat = flow - (flow @ direction)[:, None] * direction
    speed = np.linalg.norm(flat, axis=1)
    if speed.min() < 0.05:
        at = float(arcs[int(speed.argmin())])
        raise UsageError(
            f"the centre line runs along the rows of the stretched picture {at:.1f} mm after its begin: take another"
            " view, or straighten it"
        )
    # Simpson's rule on each step, with the speed in the middle of the step too.
    between = curve.tangents(0.5 * (arcs[1:] + arcs[:-1]))
    middle_speed = np.linalg.norm(between - (between @ direction)[:, None] * direction, axis=1)
    way = np.concatenate([[0.0], np.cumsum(np.diff(arcs) * (speed[:-1] + 4.0 * middle_speed + speed[1:]) / 6.0)])
    rows = _row_places(float(way[-1]), height, pixel)
    within = (rows >= 0.0) & (rows <= way[-1])
    arc = np.interp(rows, way, arcs)
    places, tangent = curve.at(arc), curve.tangents(arc)
    aside = places @ direction
    extent = curve.at(arcs) @ direction
    centre = 0.5 * (extent.min() + extent.max())
    origins = places + (centre - aside - 0.5 * (width - 1) * pixel)[:, None] * direction
    down = _unit(tangent - (tangent @ direction)[:, None] * direction)
    sheet = Sheet(origins, np.tile(pixel * direction, (height, 1)), np.cross(direction, down), width)
    columns = (aside - centre) / pixel + 0.5 * (width - 1)
    return CurvedSheet(sheet, np.where(within, arc, np.nan), np.where(within, columns, np.nan))


def stretched_length(curve: Curve, across: Float64Array) -> float:
    """Return the height in mm of a stretched picture of the whole curve."""
    arcs = _fine_arcs(curve.length, FRAME_STEP_MM)
    flow = curve.tangents(0.5 * (arcs[1:] + arcs[:-1]))
    direction = _unit(np.asarray(across, dtype=np.float64))
    return float((np.linalg.norm(flow - (flow @ direction)[:, None] * direction, axis=1) * np.diff(arcs)).sum())
