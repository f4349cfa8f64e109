"""Extract iso surfaces: one volume, any size, any number of iso values."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.errors import ClreconError, DeviceError, DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, Level, ValueRange, check_topology, choose_iso_rule, data_range
from clrecon.geometry.precision import describe_far
from clrecon.mesh import Mesh
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    check_memory,
    choose_device,
    describe_shortage,
    memory_limits,
    result_pages,
    upload,
)
from clrecon.opencl.quirks import cache_warnings
from clrecon.operators.resident.bricks import BrickRanges, BrickStates, compare_bricks, measure_bricks
from clrecon.operators.resident.slabs import SampleGrid, Slab, plan_slabs
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.marching_cubes import Counted, Placement
from clrecon.operators.surface.trilinear import check_row, prepare_trilinear
from clrecon.system.progress import Progress

__all__ = [
    "Part",
    "SurfaceExtractor",
    "extract_isosurface",
    "extract_isosurfaces",
    "prepare_isosurface",
    "voxel_level",
]


Part = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]
"""Positions, normals and triangles of one slab."""


def _refuse_level(device: Device, volume: Volume, rule: IsoRule) -> ClreconError:
    low, high = data_range(volume)
    runs = f"the volume runs from {low:g} to {high:g} HU"
    if rule.inside == "between":
        marked = sum(int(np.count_nonzero(rule.mark_inside(voxels))) for voxels in volume.voxels)
        if 0 < marked < volume.voxels.size or (marked and rule.closed):
            return _refuse_device(device, rule, runs)
        how_many = "every" if marked else "no"
        return NoSurfaceError(f"no surface of {rule.describe()}: {how_many} voxel lies within, {runs}")
    if low < rule.lowest_inside <= high:
        return _refuse_device(device, rule, runs)
    where = "above" if rule.lowest_inside > high else "at or below the lowest of"
    return NoSurfaceError(f"no surface {rule.describe_place()}: {runs}, the iso value lies {where} that range")


def _refuse_device(device: Device, rule: IsoRule, runs: str) -> DeviceError:
    return DeviceError(
        f"{device.label} found no surface {rule.describe_place()} although {runs}: it computes wrongly,"
        " see `clrecon selftest` and try another device"
    )


def voxel_level(device: Device, volume: Volume, rule: IsoRule) -> Any:
    """The lowest inside value as a scalar of the voxels' own type."""
    dtype = volume.voxels.dtype
    if dtype.kind == "f":
        return np.float32(rule.lowest_inside)
    limits = np.iinfo(dtype)
    if rule.lowest_inside > limits.max:
        raise _refuse_level(device, volume, rule)
    return dtype.type(max(rule.lowest_inside, limits.min))


def _voxel_levels(device: Device, volume: Volume, rule: IsoRule) -> tuple[Any, ...]:
    """The same and, of a range, the highest inside value."""
    level, highest, dtype = voxel_level(device, volume, rule), rule.highest_inside, volume.voxels.dtype
    if highest is None:
        return (level,)
    if dtype.kind == "f":
        return level, np.float32(highest)
    limits = np.iinfo(dtype)
    if highest < max(rule.lowest_inside, limits.min):
        raise _refuse_level(device, volume, rule)
    return level, dtype.type(min(highest, limits.max))


def _join(parts: list[Part]) -> Part:
    """The parts of all slabs behind each other; each is freed as soon as it is copied."""
    if len(parts) == 1:
        return parts[0]
    joined: list[NDArray[Any]] = []
    for which in range(3):
        rows = sum(len(part[which]) for part in parts)
        joined.append(result_pages.empty((rows, 3), parts[0][which].dtype))
    filled = [0, 0, 0]
    while parts:
        for which, array in enumerate(parts.pop(0)):
            joined[which][filled[which] : filled[which] + len(array)] = array
            filled[which] += len(array)
    return joined[0], joined[1], joined[2]


class SurfaceExtractor:
    """A volume on a device, from which surfaces are extracted at one iso value after the other.

    The volume is uploaded once, where it fits the device as a whole; a larger one goes through slab by slab each time,
    and gives the same mesh bit for bit.  Use it as a context manager, or `close` it.

    Parameters
    ----------
    volume : Volume
        Its voxels must not change as long as the extractor is open.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Bytes that may be taken on the device for the volume, what is computed from it, and the mesh; None is all that
        the device has.  The finished mesh lies in the computer's memory and does not count.

    Raises
    ------
    UsageError
        `volume` is no Volume, `memory` no number of bytes, or a row of the volume is too long.
    DeviceError
        There is no such device.
    """

    def __init__(self, volume: Volume, device: Device | str | int | None = None, *, memory: int | None = None):
        if not isinstance(volume, Volume):
            raise UsageError(f"a surface needs a Volume, not {type(volume).__name__}: clrecon.Volume(voxels, affine)")
        check_memory(memory)
        marching_cubes.check_row(volume.shape_ijk[0])
        self.volume = volume
        self.device = choose_device(device)
        self.memory = memory
        self._values = ValueRange(volume)
        self._resident_d: Any = None
        self._bricks: BrickRanges | None = None
        self._extractions = 0
        self._slices: dict[tuple[int, str], int] = {}
        self._placements: dict[int, Placement] = {}

    def __enter__(self) -> SurfaceExtractor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the volume on the device."""
        self._resident_d = self._bricks = None

    def forecast(self, *, closed: bool = True, topology: str = "separated") -> dict[str, int]:
        """What an extraction will take, before anything is computed.

        Returns
        -------
        dict
            ``slabs``, ``slices_a_slab``; ``volume_bytes`` and ``scratch_bytes`` of the largest slab on the device, the
            latter at most: it grows with the surface.  The mesh comes on top: 24 bytes a vertex, 12 a triangle.

        Raises
        ------
        DeviceError
            Not even a slab of one slice fits.
        """
        check_topology(topology)
        grid = SampleGrid(self.volume, IsoRule(0.0, 0, 0.0, 0.0, closed, topology=topology))
        slices = self._plan(grid)
        slab = Slab(grid, 0, slices)
        return {
            "slabs": -(-grid.shape[2] // slices),
            "slices_a_slab": slices,
            "volume_bytes": slab.volume_bytes(),
            "scratch_bytes": sum(slab.scratch().values()),
        }

    def extract(
        self,
        iso_value: Level,
        *,
        closed: bool = True,
        topology: str = "separated",
        below: bool = False,
        progress: Progress | None = None,
    ) -> Mesh:
        """Extract the surface at one iso value, or of one range, see `extract_isosurface`."""
        stopwatch = Stopwatch()
        rule = choose_iso_rule(self.volume, iso_value, closed, topology, below=below, values=self._values)
        grid = SampleGrid(self.volume, rule)
        if topology == "trilinear":
            check_row(self.volume)
        if min(grid.shape) < 2:
            raise NoSurfaceError(f"an open volume of {grid.shape} voxels has no cells: leave it closed")
        run = _Run(self, grid, stopwatch, _voxel_levels(self.device, self.volume, rule), self._placement(grid))
        if progress is not None:
            progress("build", 0, 1)
        with stopwatch.timed("build"):
            prepare_isosurface(self.device, self.volume.voxels.dtype, topology, self.volume.uneven, rule.inside)
        if progress is not None:
            progress("build", 1, 1)
        self._extractions += 1
        positions, normals, triangles = run.all_slabs(self._plan(grid), progress)
        report = run.describe(len(positions), len(triangles))
        return Mesh(run.placement.to_lps(positions), triangles, normals, report)

    def _plan(self, grid: SampleGrid) -> int:
        key = grid.rule.border, grid.rule.topology
        if key not in self._slices:
            self._slices[key] = plan_slabs(grid, self.device, self.memory)
        return self._slices[key]

    def _placement(self, grid: SampleGrid) -> Placement:
        border = grid.rule.border
        if border not in self._placements:
            self._placements[border] = Placement.of(self.volume, border)
        return self._placements[border]

    def _upload(self, slab: Slab) -> Any:
        """The slices of the volume that the slab reads; all of them stay on the device once they are there."""
        if not slab.is_whole:
            self._resident_d = self._bricks = None
            first, end = slab.voxel_slices
            return upload(self.device, self.volume.voxels[first:end])
        if self._resident_d is None:
            self._resident_d = upload(self.device, self.volume.voxels)
        return self._resident_d

    def _compare_bricks(self, slab: Slab, levels: tuple[Any, ...], stopwatch: Stopwatch) -> BrickStates | None:
        """How the bricks of a resident volume compare with the only level; None before it pays to measure them.

        Measuring takes as long as the first pass over the volume, so a single extraction does without.  So do ranges
        and what lies below a level: all voxels are read for them.
        """
        if not slab.is_whole or self._extractions < 2 or slab.grid.rule.inside != "above":
            return None
        if self._bricks is None:
            volume = self.volume
            self._bricks = measure_bricks(
                self.device, self._resident_d, volume.shape_ijk, volume.voxels.dtype, stopwatch=stopwatch
            )
        ni, border = self.volume.shape_ijk[0], slab.grid.rule.border
        return compare_bricks(self.device, self._bricks, levels[0], ni, border, stopwatch=stopwatch)

    def _use_smaller_slabs(self, rule: IsoRule, slices: int) -> None:
        """Remember that slabs of more slices do not go through."""
        self._resident_d = self._bricks = None
        self._slices[rule.border, rule.topology] = slices


class _Run:
    """One extraction: from slab to slab, with fewer slices a slab when the device has no room for more."""

    def __init__(
        self,
        extractor: SurfaceExtractor,
        grid: SampleGrid,
        stopwatch: Stopwatch,
        levels: tuple[Any, ...],
        placement: Placement,
    ):
        self.extractor = extractor
        self.device = extractor.device
        self.grid = grid
        self.stopwatch = stopwatch
        self.levels = levels
        self.placement = placement
        self.slabs = 0
        self.largest = {"volume": 0, "scratch": 0, "output": 0}
        self.warnings: list[str] = []

    def all_slabs(self, slices: int, progress: Progress | None) -> Part:
        """Go through the grid, `slices` at a time."""
        gk = self.grid.shape[2]
        parts: list[Part] = []
        first = vertices = triangles = 0
        while first < gk:
            slab = Slab(self.grid, first, min(first + slices, gk))
            try:
                part = self._one_slab(slab, vertices)
            except DeviceMemoryError as error:
                if slab.slices == 1:
                    raise
                slices = -(-slab.slices // 2)
                self.extractor._use_smaller_slabs(self.grid.rule, slices)
                self.warnings.append(f"{error}: continued with slabs of {slices} slices")
                continue
            parts.append(part)
            vertices, triangles = vertices + len(part[0]), triangles + len(part[2])
            if max(vertices, triangles) >= 2**32:
                raise marching_cubes.too_many(vertices, triangles)
            self.slabs += 1
            first = slab.end
            if progress is not None and (first < gk or self.slabs > 1):
                progress("slabs", first, gk)
        if triangles == 0:
            raise _refuse_level(self.device, self.grid.volume, self.grid.rule)
        try:
            return _join(parts)
        except MemoryError as error:
            raise DeviceError(f"the mesh does not fit the memory of this computer: {error}") from error

    def _one_slab(self, slab: Slab, first_vertex: int) -> Part:
        device, stopwatch = self.device, self.stopwatch
        volume, inside = self.grid.volume, self.grid.rule.inside
        program = prepare_isosurface(device, volume.voxels.dtype, uneven=volume.uneven, inside=inside)
        with stopwatch.timed("upload"):
            voxels_d = self.extractor._upload(slab)
        with stopwatch.running(device):
            bricks = self.extractor._compare_bricks(slab, self.levels, stopwatch)
            classified = marching_cubes.classify(device, slab, voxels_d, self.levels, stopwatch, bricks)
            counted = marching_cubes.count(device, slab, program, classified, stopwatch, voxels_d)
        self._check_output(slab, counted)
        part = marching_cubes.emit(
            device, slab, program, voxels_d, classified, counted, self.placement, first_vertex, stopwatch
        )
        self.grid.volume.release_slices(*slab.voxel_slices)
        return part

    def _check_output(self, slab: Slab, counted: Counted) -> None:
        """Refuse a slab whose mesh does not fit beside the rest; note what the slab takes."""
        needs = slab.needs(counted.output())
        needs["active words"] = 4 * counted.active_words
        if slab.is_whole and self.extractor._bricks is not None:
            needs["brick ranges"] = self.extractor._bricks.nbytes
        shortage = describe_shortage(memory_limits(self.device, self.extractor.memory), needs)
        if shortage:
            raise DeviceMemoryError(shortage)
        output, volume = sum(counted.output().values()), needs["volume"]
        for what, size in (("volume", volume), ("output", output), ("scratch", sum(needs.values()) - volume - output)):
            self.largest[what] = max(self.largest[what], size)

    def describe(self, vertices: int, triangles: int) -> dict[str, Any]:
        """The report of a mesh: how it was made, free of patient data."""
        rule = self.grid.rule
        return {
            **rule.as_report(),
            "closed_at_border": rule.closed,
            "topology": rule.topology,
            "outside_hu": rule.outside if rule.closed else None,
            "affine_ijk_to_lps_mm": self.grid.volume.affine.tolist(),
            "certificate": self.grid.volume.report,
            "device": self.device.label,
            "driver": self.device.driver,
            "slabs": self.slabs,
            "device_bytes": dict(self.largest),
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
            "warnings": [*cache_warnings(), *describe_far(self.grid.volume), *self.warnings],
        }


def prepare_isosurface(
    device: Device,
    dtype: DTypeLike = np.int16,
    topology: str = "separated",
    uneven: bool = False,
    inside: str = "above",
) -> Program:
    """Build the kernels for volumes of `dtype`, so that a later `extract_isosurface` with `topology` need not wait.

    With `uneven` those for volumes whose slices no affine places; `inside` as `IsoRule.inside`.

    Raises
    ------
    DeviceError
        The driver's compiler refuses.
    """
    if topology == "trilinear":
        prepare_trilinear(device, dtype)
    return marching_cubes.prepare_marching_cubes(device, dtype, uneven=uneven, inside=inside)


def extract_isosurface(
    volume: Volume,
    iso_value: Level,
    device: Device | str | int | None = None,
    *,
    closed: bool = True,
    topology: str = "separated",
    below: bool = False,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Extract the iso surface of a volume, as a closed manifold mesh in LPS mm.

    Marching cubes with a derived, face-consistent case table and vertices shared between cells.  A voxel is
    inside when its value is >= `iso_value`.  For integer voxels and an integer `iso_value` k the surface lies at
    k - 0.5, between the integers, so no face is degenerate.  Vertices are mapped through the volume's affine,
    shear included, once; they are right to one unit in the last place that float32 has for the volume's largest
    coordinate (6e-5 mm at 1 m), but kept four such units off voxel centres.  From 4096 mm on they are computed
    relative to the volume's centre and given as float64.

    A volume of any size goes through: what does not fit the device is worked on slab by slab.  The mesh is the same
    bit for bit.

    Parameters
    ----------
    volume : Volume
        Its voxels may be a memory-mapped file larger than the memory of the computer.
    iso_value : float or (float, float)
        HU; or the two ends of a range.  Inside of a range are the voxels from its lower to its upper end, both
        included; the surface lies where the values cross the end that they cross: at 100 to 300 and integer voxels
        at 99.5 and at 300.5, as those at the iso values 100 and 301 do.  What lies between two neighbouring voxels
        below and above the range is no voxel of it, and has no surface.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    closed : bool
        True: the volume is surrounded by air, and the surface is closed where an object leaves the volume.
        Beyond the border the field has the volume's lowest value, but not less than -1024 HU.
        False: the surface ends open at the outermost voxel centres.
    topology : {"separated", "trilinear"}
        Where the corners of a cell do not say which of them are joined: "separated" keeps inside voxels apart that
        only meet across a face; "trilinear" joins what the trilinear interpolation of the voxels joins, on faces
        and inside cells, so that the surface has the components and tunnels of that field.  Few cells differ.
        "trilinear" knows no range.
    below : bool
        Enclose what lies below the iso value: the same vertices and triangles, turned round.  Beyond the border the
        field then lies as far above the level as it would lie below it otherwise, so that the surface is closed.
    memory : int, optional
        Bytes that may be taken on the device, see `SurfaceExtractor`; None is all that it has.
    progress : callable, optional
        Called as ``progress("build", done, total)`` around the building of the kernels, and as
        ``progress("slabs", slices done, all slices)`` where there are several.

    Returns
    -------
    Mesh
        Triangles are counter-clockwise and normals point as seen from outside: from lower values, with `below` from
        higher ones; `Mesh.report` holds the iso value or the range, the affine, the certificate (``volume.report``),
        the device, the number of slabs, ``device_bytes`` {volume, scratch, output} of the largest, and the seconds
        {upload, build, kernels, download}.

    Raises
    ------
    NoSurfaceError
        The iso value crosses nothing; the message gives the range of the data.
    UsageError
        `volume`, `iso_value` or `topology` is not what it should be, values or the volume are too large for
        float32, or a row of the volume is too long.
    DeviceError
        No device, not even one slice fits its memory, 2^32 vertices or triangles or more, or the device fails or
        computes wrongly.

    References
    ----------
    Lorensen and Cline 1987; Schroeder, Maynard and Geveci 2015; for "trilinear" Nielson and Hamann 1991, Chernyaev
    1995 and Grosso 2016.
    """
    with SurfaceExtractor(volume, device, memory=memory) as extractor:
        return extractor.extract(iso_value, closed=closed, topology=topology, below=below, progress=progress)


def extract_isosurfaces(
    volume: Volume,
    iso_values: Sequence[Level],
    device: Device | str | int | None = None,
    *,
    closed: bool = True,
    topology: str = "separated",
    below: bool = False,
    memory: int | None = None,
    progress: Progress | None = None,
) -> list[Mesh]:
    """Extract the surfaces of a volume at several iso values or of several ranges; the volume is uploaded once.

    Parameters
    ----------
    iso_values : sequence of float or (float, float)
        HU, at least one.

    Returns
    -------
    list of Mesh
        In the order of `iso_values`; for all else see `extract_isosurface`.
    """
    if len(iso_values) == 0:
        raise UsageError("no iso value is given")
    with SurfaceExtractor(volume, device, memory=memory) as extractor:
        return [
            extractor.extract(iso_value, closed=closed, topology=topology, below=below, progress=progress)
            for iso_value in iso_values
        ]
