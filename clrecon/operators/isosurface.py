"""Extract iso surfaces: the host side of cl/isosurface/marching_cubes.cl."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import ClreconError, DeviceError, NoSurfaceError, UsageError
from clrecon.geometry import Volume, is_left_handed
from clrecon.geometry.field import IsoRule, choose_iso_rule, data_range, slice_normal_matrices, vertex_margin
from clrecon.kernels import Program, Stopwatch, allocate, download, empty_output, launch, load_program, upload
from clrecon.mesh import Mesh
from clrecon.opencl import Device, check_budget, choose_device
from clrecon.opencl.quirks import cache_warnings
from clrecon.operators.compaction import Compacted, compact, exclusive_scan, prepare_compaction

__all__ = ["extract_isosurface", "prepare_isosurface"]

Progress = Callable[[str, int, int], None]

VOXEL_TYPES = {
    "int8": "char", "uint8": "uchar", "int16": "short", "uint16": "ushort", "int32": "int", "float32": "float",
}  # fmt: skip

LONGEST_ROW = 13_000
"""Samples a row: places in a row are 16-bit numbers, and a cell has at most 5 triangles."""


@dataclass(frozen=True)
class _SampleGrid:
    """The samples of a volume with its border, and how the inside mask packs them."""

    volume: Volume
    rule: IsoRule

    @property
    def shape(self) -> tuple[int, int, int]:
        """(gi, gj, gk) samples."""
        gi, gj, gk = (n + 2 * self.rule.border for n in self.volume.shape_ijk)
        return gi, gj, gk

    @property
    def rows(self) -> int:
        """Rows along i."""
        return self.shape[1] * self.shape[2]

    @property
    def words(self) -> int:
        """32-bit words of the mask a row."""
        return -(-self.shape[0] // 32)

    @property
    def flag_words(self) -> int:
        """32-bit words a row of one flag a word."""
        return -(-self.words // 32)

    def scratch(self) -> dict[str, int]:
        """Bytes of every buffer between the volume and the mesh, by what it is."""
        return {
            "inside mask": 4 * self.rows * self.words,
            "word counts": 4 * self.rows * self.words,
            "row counts": 16 * self.rows,
            "word flags": 4 * self.rows * self.flag_words,
            "active words": 4 * self.rows * self.words,
        }


@dataclass(frozen=True)
class _Counts:
    """What `_count` leaves on the device, and the totals."""

    words: Compacted
    vertex_offsets_d: Any
    triangle_offsets_d: Any
    word_vertices_d: Any
    word_triangles_d: Any
    vertices: int
    triangles: int


def _check_grid(grid: _SampleGrid) -> None:
    gi, gj, gk = grid.shape
    if gi > LONGEST_ROW:
        raise UsageError(f"the volume has {gi - 2 * grid.rule.border:,} columns, {LONGEST_ROW - 2:,} are supported")
    if grid.rows * grid.flag_words * 32 >= 2**32:
        raise UsageError(f"the volume has {grid.rows:,} rows: more than 2^32 words of its mask are not supported")


def _refuse_level(device: Device, volume: Volume, rule: IsoRule) -> ClreconError:
    low, high = data_range(volume)
    if low < rule.lowest_inside <= high:
        return DeviceError(
            f"{device.label} found no surface at {rule.iso_value:g} HU although the volume runs from {low:g} to"
            f" {high:g} HU: it computes wrongly, see `clrecon selftest` and try another device"
        )
    where = "above" if rule.lowest_inside > high else "at or below the lowest of"
    return NoSurfaceError(
        f"no surface at {rule.iso_value:g} HU: the volume runs from {low:g} to {high:g} HU,"
        f" the iso value lies {where} that range"
    )


def _voxel_level(device: Device, volume: Volume, rule: IsoRule) -> Any:
    """The lowest inside value as a scalar of the voxels' own type."""
    dtype = volume.voxels.dtype
    if dtype.kind == "f":
        return np.float32(rule.lowest_inside)
    limits = np.iinfo(dtype)
    if rule.lowest_inside > limits.max:
        raise _refuse_level(device, volume, rule)
    return dtype.type(max(rule.lowest_inside, limits.min))


def _pad4(rows: NDArray[np.float64]) -> NDArray[np.float32]:
    """Rows of three as rows of four float32, for float4."""
    padded = np.zeros((*rows.shape[:-1], 4), dtype=np.float32)
    padded[..., :3] = rows
    return padded


def _split(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Split into a part of 12 significant bits and the rest: 12-bit parts times whole numbers < 4096 are exact."""
    mantissa, exponent = np.frexp(values)
    head = np.ldexp(np.round(np.ldexp(mantissa, 12)), exponent - 12)
    return head, values - head


def _slice_frames(volume: Volume, border: int) -> NDArray[np.float32]:
    """Table of emit_vertices: six float4 for each slice of the sample grid."""
    origins = volume.slice_origins(border + 1)[1:]
    head, rest = origins[:-1].astype(np.float32), origins[:-1] - origins[:-1].astype(np.float32)
    parts = [head.astype(np.float64)[:, None], rest[:, None], np.diff(origins, axis=0)[:, None]]
    return _pad4(np.concatenate([*parts, slice_normal_matrices(volume, border)], axis=1))


def _classify(
    device: Device, grid: _SampleGrid, program: Program, voxels_d: Any, level: Any, stopwatch: Stopwatch
) -> Any:
    ni, nj, nk = grid.volume.shape_ijk
    mask_d = allocate(device, 4 * grid.rows * grid.words)
    launch(
        device, program["classify_samples"], grid.rows,
        voxels_d, mask_d, level,
        np.int32(ni), np.int32(nj), np.int32(nk), np.int32(grid.rule.border), np.int32(grid.words),
        stopwatch=stopwatch,
    )  # fmt: skip
    return mask_d


def _count(device: Device, grid: _SampleGrid, program: Program, mask_d: Any, stopwatch: Stopwatch) -> _Counts:
    rows, words = grid.rows, grid.words
    row_vertices_d, row_triangles_d = allocate(device, 4 * rows), allocate(device, 4 * rows)
    word_vertices_d, word_triangles_d = allocate(device, 2 * rows * words), allocate(device, 2 * rows * words)
    flags_d = allocate(device, 4 * rows * grid.flag_words)
    launch(
        device, program["count_rows"], rows,
        mask_d, row_vertices_d, row_triangles_d, flags_d, word_vertices_d, word_triangles_d,
        *(np.uint32(n) for n in grid.shape), np.uint32(words), np.uint32(grid.flag_words),
        stopwatch=stopwatch,
    )  # fmt: skip
    vertices = exclusive_scan(device, row_vertices_d, rows, stopwatch=stopwatch)
    triangles = exclusive_scan(device, row_triangles_d, rows, stopwatch=stopwatch)
    if vertices.total >= 2**32 or triangles.total >= 2**32:
        raise DeviceError(
            f"the surface has {vertices.total:,} vertices and {triangles.total:,} triangles:"
            " more than 32 bits can number; choose another iso value or a part of the volume"
        )
    return _Counts(
        words=compact(device, flags_d, rows * grid.flag_words, stopwatch=stopwatch),
        vertex_offsets_d=vertices.offsets_d,
        triangle_offsets_d=triangles.offsets_d,
        word_vertices_d=word_vertices_d,
        word_triangles_d=word_triangles_d,
        vertices=vertices.total,
        triangles=triangles.total,
    )


def _emit(
    device: Device,
    grid: _SampleGrid,
    program: Program,
    voxels_d: Any,
    mask_d: Any,
    counts: _Counts,
    margin: NDArray[np.float32],
    stopwatch: Stopwatch,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]:
    volume, rule = grid.volume, grid.rule
    frames_d = upload(device, _slice_frames(volume, rule.border))
    steps_d = upload(device, _pad4(np.stack([part for step in (0, 1) for part in _split(volume.affine[:3, step])])))
    positions, positions_d = empty_output(device, (counts.vertices, 3), np.float32)
    normals, normals_d = empty_output(device, (counts.vertices, 3), np.float32)
    triangles, triangles_d = empty_output(device, (counts.triangles, 3), np.uint32)
    active = np.uint32(counts.words.count)
    packing = (np.uint32(grid.words), np.uint32(grid.flag_words), active)
    with stopwatch.running(device):
        launch(
            device, program["emit_vertices"], counts.words.count,
            voxels_d, mask_d, counts.words.positions_d, counts.vertex_offsets_d, counts.word_vertices_d,
            frames_d, steps_d, positions_d, normals_d,
            np.float32(rule.iso_level), np.float32(rule.outside), np.float32(rule.value_scale), margin,
            *(np.int32(n) for n in volume.shape_ijk), np.int32(rule.border), *packing,
            stopwatch=stopwatch,
        )  # fmt: skip
        launch(
            device, program["emit_triangles"], counts.words.count,
            mask_d, counts.words.positions_d, counts.vertex_offsets_d, counts.triangle_offsets_d,
            counts.word_vertices_d, counts.word_triangles_d, triangles_d,
            *(np.uint32(n) for n in grid.shape), *packing, np.int32(is_left_handed(volume.affine)),
            stopwatch=stopwatch,
        )  # fmt: skip
    with stopwatch.timed("download"):
        download(device, positions, positions_d)
        download(device, normals, normals_d)
        download(device, triangles, triangles_d)
    return positions, normals, triangles


def prepare_isosurface(device: Device, dtype: DTypeLike = np.int16) -> Program:
    """Build the kernels for volumes of `dtype`, so that a later `extract_isosurface` need not wait for them.

    Raises
    ------
    DeviceError
        The driver's compiler refuses.
    """
    prepare_compaction(device)
    return load_program(device, "isosurface/marching_cubes.cl", {"VOXEL": VOXEL_TYPES[np.dtype(dtype).name]})


def _describe(device: Device, grid: _SampleGrid, stopwatch: Stopwatch) -> dict[str, Any]:
    """The report of a mesh: how it was made, free of patient data."""
    rule = grid.rule
    return {
        "iso_value_hu": rule.iso_value,
        "iso_level_hu": rule.iso_level,
        "closed_at_border": rule.closed,
        "outside_hu": rule.outside if rule.closed else None,
        "affine_ijk_to_lps_mm": grid.volume.affine.tolist(),
        "device": device.label,
        "driver": device.driver,
        "seconds": dict(stopwatch.seconds),
        "kernel_seconds": dict(stopwatch.by_kernel),
        "warnings": list(cache_warnings()),
    }


def extract_isosurface(
    volume: Volume,
    iso_value: float,
    device: Device | str | int | None = None,
    *,
    closed: bool = True,
    progress: Progress | None = None,
) -> Mesh:
    """Extract the iso surface of a volume, as a closed manifold mesh in LPS mm.

    Marching cubes with a derived, face-consistent case table and vertices shared between cells.  A voxel is
    inside when its value is >= `iso_value`.  For integer voxels and an integer `iso_value` k the surface lies at
    k - 0.5, between the integers, so no face is degenerate.  Vertices are mapped through the volume's affine,
    shear included, once; they are right to one unit in the last place that float32 has for the volume's largest
    coordinate (6e-5 mm at 1 m), but kept four such units off voxel centres.

    Parameters
    ----------
    volume : Volume
    iso_value : float
        HU.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    closed : bool
        True: the volume is surrounded by air, and the surface is closed where an object leaves the volume.
        Beyond the border the field has the volume's lowest value, but not less than -1024 HU.
        False: the surface ends open at the outermost voxel centres.
    progress : callable, optional
        Called as ``progress("build", done, total)`` around the building of the kernels.

    Returns
    -------
    Mesh
        Triangles are counter-clockwise and normals point as seen from lower values; `Mesh.report` holds the iso
        value, the affine, the device and the seconds {upload, build, kernels, download}.

    Raises
    ------
    NoSurfaceError
        The iso value crosses nothing; the message gives the range of the data.
    UsageError
        `volume` or `iso_value` is not what it should be, values or coordinates are too large for float32, or a row
        of the volume is too long.
    DeviceError
        No device, not enough memory, more than 2^32 vertices or triangles, or the device fails or computes wrongly.

    References
    ----------
    Lorensen and Cline 1987; Schroeder, Maynard and Geveci 2015.
    """
    if not isinstance(volume, Volume):
        raise UsageError(f"a surface needs a Volume, not {type(volume).__name__}: clrecon.Volume(voxels, affine)")
    device = choose_device(device)
    stopwatch = Stopwatch()
    grid = _SampleGrid(volume, choose_iso_rule(volume, iso_value, closed))
    _check_grid(grid)
    margin = _pad4(vertex_margin(volume, grid.rule.border))
    level = _voxel_level(device, volume, grid.rule)
    if min(grid.shape) < 2:
        raise NoSurfaceError(f"an open volume of {grid.shape} voxels has no cells: leave it closed")
    check_budget(device, {"volume": volume.voxels.nbytes, **grid.scratch()})

    if progress is not None:
        progress("build", 0, 1)
    with stopwatch.timed("build"):
        program = prepare_isosurface(device, volume.voxels.dtype)
    with stopwatch.timed("upload"):
        voxels_d = upload(device, volume.voxels)
    with stopwatch.running(device):
        mask_d = _classify(device, grid, program, voxels_d, level, stopwatch)
        counts = _count(device, grid, program, mask_d, stopwatch)
    if counts.triangles == 0:
        raise _refuse_level(device, volume, grid.rule)
    output = {"vertices": 24 * counts.vertices, "triangles": 12 * counts.triangles}
    check_budget(device, {"volume": volume.voxels.nbytes, **grid.scratch(), **output})
    positions, normals, triangles = _emit(device, grid, program, voxels_d, mask_d, counts, margin, stopwatch)
    if progress is not None:
        progress("build", 1, 1)
    return Mesh(positions, triangles, normals, _describe(device, grid, stopwatch))
