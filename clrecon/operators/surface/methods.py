"""Methods of marching cubes by the names that papers give them: one table, and a mesh by any of them.

A row for comparisons is in numpy, layer by layer: every cell is visited and writes triangles of its own, welded
afterwards.  The vertex on an edge is computed up to four times, always from the same end of its edge, so that welding
finds equal numbers.

References: Lorensen and Cline 1987; Liu et al. 2019, "Vertebrae CT Images 3D Reconstruction with Improve Marching Cubes
Algorithm", J. Harbin Inst. Technol. (New Series) 26(6): T-MC, G-MC, S-MC and I-MC.
"""

from __future__ import annotations

import re
import time
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.iso_choice import AutoLevel, settle_level
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume, is_left_handed
from clrecon.geometry.iso_rule import IsoRule, Level, choose_iso_rule, data_range, describe_range
from clrecon.geometry.vertices import linear_fraction
from clrecon.mesh import Mesh
from clrecon.mesh.triangles import vertex_normals
from clrecon.opencl import Device
from clrecon.opencl.sources import read_kernel_source
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.extract import SurfaceExtractor
from clrecon.operators.surface.seeds import AUTO
from clrecon.system.arguments import MethodName, VertexRule, explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.packages import import_package
from clrecon.system.progress import Progress

CORNERS = np.array([(c & 1, c >> 1 & 1, c >> 2) for c in range(8)])
"""(x, y, z) of each corner of a cell."""

MOST_TRIANGLES = 5


@cache
def case_triangles() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the number of triangles of each case, (256,), and their edges, (256, 5, 3), from the kernels' table."""
    words = re.findall(r"0x([0-9a-f]{16})UL", read_kernel_source("surface/mc_tables.h"))
    packed = np.array([int(word, 16) for word in words], np.uint64)
    shifts = np.arange(4, 4 + 12 * MOST_TRIANGLES, 4, dtype=np.uint64)
    edges = (packed[:, None] >> shifts & np.uint64(15)).astype(np.int64)
    return (packed & np.uint64(15)).astype(np.int64), edges.reshape(-1, MOST_TRIANGLES, 3)


def edge_corner(edge: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the lower corner (..., 3) of edges 0 to 11 in their cell, and their axes."""
    axis, side = edge // 4, edge % 4
    corner = np.zeros((*edge.shape, 3), np.int64)
    others = np.array([(1, 2), (0, 2), (0, 1)])[axis]
    np.put_along_axis(corner, others[..., :1], (side & 1)[..., None], -1)
    np.put_along_axis(corner, others[..., 1:], (side >> 1)[..., None], -1)
    return corner, axis


def _pad_layers(volume: Volume, rule: IsoRule, first: int, end: int) -> NDArray[np.float64]:
    """Return slices of the sample grid, with the border's values where it is closed."""
    border, nk = rule.border, volume.shape_ijk[2]
    layers = []
    for k in range(first - border, end - border):
        if 0 <= k < nk:
            layers.append(np.pad(volume.voxels[k].astype(np.float64), border, constant_values=rule.outside))
        else:
            ni, nj, _ = volume.shape_ijk
            layers.append(np.full((nj + 2 * border, ni + 2 * border), rule.outside))
    return np.stack(layers)


def extract_soup(volume: Volume, rule: IsoRule) -> NDArray[np.float64]:
    """Return the corners of all triangles in LPS mm, (m, 3, 3), counter-clockwise as seen from lower values."""
    counts, table = case_triangles()
    gk = volume.shape_ijk[2] + 2 * rule.border
    soup = [np.empty((0, 3, 3))]
    for k in range(gk - 1):
        values = _pad_layers(volume, rule, k, k + 2)
        inside = values >= rule.lowest_inside
        cases = np.zeros((inside.shape[1] - 1, inside.shape[2] - 1), np.int64)
        for bit, (x, y, z) in enumerate(CORNERS):
            cases |= inside[z, y : y + cases.shape[0], x : x + cases.shape[1]].astype(np.int64) << bit
        j, i = np.nonzero(counts[cases])
        case = cases[j, i]
        cell = np.repeat(np.arange(len(case)), counts[case])
        number = np.arange(len(cell)) - np.repeat(np.cumsum(counts[case]) - counts[case], counts[case])
        corner, axis = edge_corner(table[case[cell], number])  # (m, 3, 3) and (m, 3)
        low = np.stack([i[cell], j[cell], np.zeros(len(cell), np.int64)], 1)[:, None, :] + corner
        high = low + np.eye(3, dtype=np.int64)[axis]
        value, next_value = (values[at[..., 2], at[..., 1], at[..., 0]] for at in (low, high))
        placed = low.astype(np.float64)
        t = linear_fraction(value, next_value, rule.iso_level)
        np.put_along_axis(placed, axis[..., None], np.take_along_axis(placed, axis[..., None], -1) + t[..., None], -1)
        placed += np.array([0, 0, k]) - rule.border
        soup.append(volume.ijk_to_lps(placed.reshape(-1, 3)).reshape(-1, 3, 3))
    triangles = np.concatenate(soup)
    return triangles[:, ::-1] if is_left_handed(volume.affine) else triangles


def weld(soup: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.uint32]]:
    """Join corners at the same place: vertices (n, 3) in the order of their first triangle, and triangles (m, 3)."""
    corners = np.ascontiguousarray(soup.reshape(-1, 3)) + 0.0  # + 0.0: no two zeros
    _, first, inverse = np.unique(corners.view("V24"), return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return corners[first[order]], rank[inverse.reshape(-1)].reshape(-1, 3).astype(np.uint32)


DECIMATED_SHARE = 0.9
"""Share of the triangles that G-MC and S-MC take away, if none is given."""


@dataclass(frozen=True)
class Method:
    """A method of marching cubes, by kernels or in numpy; it decimates "", "quadric", "bounded"."""

    name: str
    what: str
    on_device: bool = True
    grows: bool = False
    decimates: str = ""


METHODS = {
    method.name: method
    for method in (
        Method("t-mc", "every cell, shared vertices"),
        Method("i-mc", "only cells that are connected with seeds", grows=True),
        Method("g-mc", "t-mc, then quadric collapse without a bound", decimates="quadric"),
        Method("s-mc", "t-mc, then decimation within a bound, topology kept", decimates="bounded"),
        Method("t-mc-soup", "every cell, triangles of their own, welded afterwards (numpy)", on_device=False),
        Method("skimage", "scikit-image's marching cubes, placed by the scan's geometry", on_device=False),
    )
}


def check_method(
    method: str, *, grows: bool = False, vertex_rule: str = "linear", topology: str = "separated", plain: bool = True
) -> Method:
    """Return a method of the table; `plain`: the surface of what lies above one iso value."""
    if method not in METHODS:
        raise UsageError(f"there is no {name_parameter('method', method)}: it is one of {', '.join(METHODS)}")
    chosen, method_name = METHODS[method], name_parameter("method", method)
    if grows and not chosen.grows:
        raise UsageError(
            f"{method_name} makes the whole surface: leave {name_parameter('grow_from')} out, or take"
            f" {name_parameter('method', 'i-mc')}"
        )
    if (grows or chosen.grows) and topology != "separated":
        raise UsageError(
            f"growing from seeds needs the default topology: leave out {name_parameter('topology', topology)}"
        )
    if chosen.on_device:
        return chosen
    for name, value, usual in (("vertex_rule", vertex_rule, "linear"), ("topology", topology, "separated")):
        if value != usual:
            raise UsageError(f"{method_name} has its own rules: leave {name_parameter(name, value)} out")
    if not plain:
        raise UsageError(
            f"{method_name} takes one iso value, what lies above it is inside: neither ranges nor what lies below"
        )
    return chosen


@explains_arguments
def extract_by_method(
    volume: Volume | DeviceVolume,
    iso_value: AutoLevel,
    method: MethodName,
    *,
    grow_from: Any = None,
    vertex_rule: VertexRule = "linear",
    decimate: float | None = None,
    closed: bool = True,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Extract an iso surface by one of the methods that papers compare.

    Parameters
    ----------
    volume : Volume or DeviceVolume
    iso_value : float, (float, float) or "auto"
        HU, see `extract_isosurface`.
    method : {"t-mc", "i-mc", "g-mc", "s-mc", "t-mc-soup", "skimage"}
        See ``METHODS`` and ``docs/methods.md``.
    grow_from : optional
        Seeds of "i-mc", see `extract_isosurface`; None: "auto".
    vertex_rule : {"linear", "golden", "golden-search"}
    decimate : float, optional
        Share of the triangles that "g-mc" and "s-mc" take away; 0.9 by default.
    closed, device, memory, progress
        As `extract_isosurface`.

    Returns
    -------
    Mesh
        In LPS mm; its report has ``method``, and of "t-mc-soup" and "skimage" ``seconds`` {extract, weld}.

    Raises
    ------
    UsageError
        The method is unknown, or an argument does not go with it.
    NoSurfaceError, DeviceError
        As `extract_isosurface`.
    """
    level, measured = settle_level(volume, iso_value, progress)
    plain = not np.ndim(level)
    chosen = check_method(method, grows=grow_from is not None, vertex_rule=vertex_rule, plain=plain)
    if decimate is not None and not chosen.decimates:
        raise UsageError(f"{name_parameter('method', method)} takes no triangles away: leave the share out")
    if not chosen.on_device:
        mesh = _extract_on_host(volume, level, method, closed)
    else:
        seeds = AUTO if grow_from is None else grow_from
        with SurfaceExtractor(volume, device=device, memory=memory) as extractor:
            mesh = extractor.extract(
                level, closed=closed, vertex_rule=vertex_rule, progress=progress,
                grow_from=seeds if chosen.grows else None,
            )  # fmt: skip
    if chosen.decimates:
        from clrecon.mesh.refine.quadric import collapse_quadric
        from clrecon.operators.surface.decimation import decimate_mesh

        share = DECIMATED_SHARE if decimate is None else decimate
        if chosen.decimates == "quadric":
            mesh = collapse_quadric(mesh, share, progress=progress)
        else:
            mesh = decimate_mesh(mesh, share, device=extractor.device, memory=memory, progress=progress)
    mesh.report.update(measured, method=method)
    return mesh


def _extract_on_host(volume: Volume | DeviceVolume, iso_value: Level, method: str, closed: bool) -> Mesh:
    """Extract without a device: the rows of comparisons."""
    scan = volume.volume if isinstance(volume, DeviceVolume) else volume
    rule = choose_iso_rule(scan, iso_value, closed=closed)
    started = time.perf_counter()
    if method == "skimage":
        vertices, triangles = _extract_by_skimage(scan, rule)
        extracted = time.perf_counter()
    else:
        soup = extract_soup(scan, rule)
        extracted = time.perf_counter()
        vertices, triangles = weld(soup)
    if not len(triangles):
        raise NoSurfaceError(f"no surface {rule.phrase()}: {describe_range(scan, *data_range(scan))}")
    welded = time.perf_counter()
    every = int(np.prod([n + 2 * rule.border - 1 for n in scan.shape_ijk]))
    report = {
        **rule.as_report(),
        "closed_at_border": rule.closed,
        "topology": rule.topology,
        "outside_hu": rule.outside if rule.closed else None,
        "affine_ijk_to_lps_mm": scan.affine.tolist(),
        "cells": {"visited": every, "all": every},
        "growing": None,
        "certificate": scan.report,
        "seconds": {"extract": extracted - started, "weld": welded - extracted},
        "warnings": [],
    }
    places = vertices.astype(np.float32)
    return Mesh(places, triangles, vertex_normals(places, triangles), report)


def _extract_by_skimage(volume: Volume, rule: IsoRule) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Extract by scikit-image in voxels, and place the vertices by the geometry of the scan, uneven slices included."""
    skimage = import_package("skimage.measure", name_parameter("method", "skimage"))
    values = volume.voxels.astype(np.float32)
    if rule.closed:
        values = np.pad(values, 1, constant_values=np.float32(rule.outside))
    try:
        points, faces, _, _ = skimage.marching_cubes(values, rule.iso_level, allow_degenerate=False)
    except (ValueError, RuntimeError) as error:
        runs = describe_range(volume, *data_range(volume))
        raise NoSurfaceError(f"no surface {rule.phrase()}: {runs}") from error
    vertices = volume.ijk_to_lps(points[:, ::-1].astype(np.float64) - rule.border)
    # In (k, j, i) its triangles are counter-clockwise as seen from higher values; reversing the axes mirrors them.
    triangles = faces[:, ::-1] if is_left_handed(volume.affine) else faces
    return vertices, np.ascontiguousarray(triangles, np.uint32)
