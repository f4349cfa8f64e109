"""`read_points`: a cloud from a file, our own or that of another program."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from clrecon.errors import RefusedInputError
from clrecon.exchange.formats import read_raw_cloud
from clrecon.exchange.raw_content import frame_of_file, turn_to_lps
from clrecon.geometry import frame_from_lps
from clrecon.points.cloud import MOST_POINTS, PointCloud
from clrecon.system.arguments import Space, explains_arguments
from clrecon.system.log import get_logger, log_warnings
from clrecon.system.text import escape_text

log = get_logger(__name__)

_FEWEST_OF_A_BODY = 100
"""Points from which on the size of a cloud is looked at."""

_SMALLEST_MM, LARGEST_MM = 3.0, 5000.0
"""Sides of the box of what a CT shows; 2 m in metres, and 5 mm in micrometres, lie beyond."""


@explains_arguments
def read_points(path: str | os.PathLike[str], *, space: Space | None = None) -> PointCloud:
    """Read a cloud from a file.

    Parameters
    ----------
    path : str or path
        PLY (ASCII or binary), VTP, NPZ, LAS or a table of numbers (XYZ), told by its first bytes.  Units are mm.
    space : {"lps", "ras"}, optional
        Patient frame of coordinates that do not name theirs; None: LPS, which the report then calls assumed.

    Returns
    -------
    PointCloud
        In LPS mm, with the normals, HU, labels and ``values`` in mm that the file has.  Entries of ``report["file"]``:
        ``kind``, ``space``, ``space_from`` ("file", "argument" or "assumed"), ``points`` and ``warnings``, which name
        columns and elements that were left out.  ``iso_value_hu``, ``affine_ijk_to_lps_mm`` and ``certificate_lines``
        are there where the file has them.

    Raises
    ------
    UsageError
        ``space`` is unknown, or is not the frame that the file names; or the file is LAS and laspy is not installed.
    RefusedInputError
        The file cannot be read, is cut or corrupt, has no points or points that are not finite.
    """
    if space is not None:
        frame_from_lps(space)
    raw = read_raw_cloud(path)
    name = escape_text(Path(path).name)
    warnings = raw.warnings
    frame, source = frame_of_file(raw, space, name)
    _check_points(raw.points, name)
    points, normals = turn_to_lps(frame, raw.points, raw.normals())
    warnings += _doubt_unit(points)
    arrays = {"normals": normals, "hu": raw.hu(), "labels": raw.labels(), "ijk": raw.ijk()}
    values = raw.values()
    warnings += raw.unused()
    facts: dict[str, Any] = {
        "kind": raw.kind,
        "space": frame,
        "space_from": source,
        "points": len(points),
        "warnings": warnings,
    }
    report: dict[str, Any] = {"file": facts}
    if raw.iso_value_hu is not None and np.isfinite(raw.iso_value_hu):
        report["iso_value_hu"] = raw.iso_value_hu
    if raw.affine is not None and np.isfinite(raw.affine).all():
        report["affine_ijk_to_lps_mm"] = np.asarray(raw.affine, dtype=np.float64).tolist()
    if raw.certificate:
        report["certificate_lines"] = list(raw.certificate)
    log.info("%s file read: %d points", raw.kind, len(points))
    log_warnings(log, warnings)
    cloud = PointCloud(points, report=report, **arrays)
    cloud.values = dict(values)
    return cloud


def _check_points(points: np.ndarray, name: str) -> None:
    if not 0 < len(points) <= MOST_POINTS:
        raise RefusedInputError(f"{name} has {len(points):,} points: 1 to {MOST_POINTS:,} are read")
    wrong = ~np.isfinite(points).all(axis=1)
    if wrong.any():
        raise RefusedInputError(
            f"{int(wrong.sum()):,} of the {len(points):,} points of {name} are not finite, the first is number"
            f" {int(np.flatnonzero(wrong)[0]):,}: remove them first"
        )


def _doubt_unit(points: np.ndarray) -> list[str]:
    """Return a warning where a cloud is as small as a patient in metres, or larger than one in mm."""
    size = points.max(axis=0).astype(np.float64) - points.min(axis=0)
    if len(points) < _FEWEST_OF_A_BODY or _SMALLEST_MM <= size.max() <= LARGEST_MM or not size.max() > 0.0:
        return []
    box = " x ".join(f"{side:.3g}" for side in size)
    unit = (
        "metres: then multiply them by 1000" if size.max() < _SMALLEST_MM else "micrometres: then divide them by 1000"
    )
    return [f"the points lie in a box of {box}, which is read as mm; perhaps they are in {unit}"]
