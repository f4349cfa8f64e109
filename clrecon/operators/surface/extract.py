"""Extract iso surfaces: one volume, any size, any number of iso values."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from clrecon.anatomy.iso_choice import AutoLevel, settle_level
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, Level, check_topology
from clrecon.mesh import Mesh
from clrecon.mesh.written_parts import PartsFile
from clrecon.opencl import Device
from clrecon.operators.masks.enclosed import fill_enclosed
from clrecon.operators.resident.device_volume import DeviceVolume, VolumeWorker
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.extraction import Extraction, choose_grid
from clrecon.operators.surface.seeds import Seeds
from clrecon.operators.surface.slabs import SampleGrid, Slab, plan_slabs
from clrecon.operators.surface.spans import PassingSurface
from clrecon.points.cloud import PointCloud
from clrecon.system.arguments import Space, Topology, VertexRule, explains_arguments, name_parameter
from clrecon.system.files import check_writable
from clrecon.system.paths import keep_existing
from clrecon.system.progress import Progress, ignore_progress


class SurfaceExtractor(VolumeWorker):
    """A volume on a device, from which surfaces are extracted at one iso value after the other.

    The volume is uploaded once if it fits the device as a whole.  A larger one is processed slab by slab each time,
    with the same mesh bit for bit.  Use it as a context manager, or ``close`` it.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        The voxels must not change as long as the extractor is open.  A `DeviceVolume` is used directly.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.  A `DeviceVolume` has its own.
    memory : int, optional
        Bytes that may be taken on the device for the volume, what is computed from it, and the mesh; None is all that
        the device has.  The finished mesh lies in the computer's memory and does not count.

    Raises
    ------
    UsageError
        ``volume`` is not a Volume, ``memory`` is not a number of bytes, or a row of the volume is too long.
    DeviceError
        The device does not exist.
    """

    def __init__(
        self, volume: Volume | DeviceVolume, *, device: Device | str | int | None = None, memory: int | None = None
    ):
        super().__init__(volume, device, memory, "a surface")
        marching_cubes.check_row(self.volume.shape_ijk[0])

    @explains_arguments
    def forecast(self, *, closed: bool = True, topology: Topology = "separated") -> dict[str, int]:
        """Estimate the memory of an extraction before anything is computed.

        Returns
        -------
        dict
            ``slabs``, ``slices_a_slab``; ``volume_bytes`` and ``scratch_bytes`` of the largest slab on the device, the
            latter is an upper bound, as it grows with the surface.  The mesh is added: 24 bytes for a vertex, 12 for a
            triangle.

        Raises
        ------
        DeviceError
            Not even a slab of one slice fits.
        """
        check_topology(topology)
        grid = SampleGrid(self.volume, IsoRule(0.0, 0, 0.0, 0.0, closed, topology=topology))
        slices = plan_slabs(grid, self._resident)
        slab = Slab(grid, 0, slices)
        return {
            "slabs": -(-grid.shape[2] // slices),
            "slices_a_slab": slices,
            "volume_bytes": slab.volume_bytes(),
            "scratch_bytes": sum(slab.scratch().values()),
        }

    @explains_arguments
    def extract(
        self,
        iso_value: AutoLevel,
        *,
        closed: bool = True,
        topology: Topology = "separated",
        below: bool = False,
        grow_from: Any = None,
        vertex_rule: VertexRule = "linear",
        progress: Progress | None = None,
    ) -> Mesh:
        """Extract the surface at one iso value, or of one range, see `extract_isosurface`."""
        level, chosen = settle_level(self.volume, iso_value, progress)
        grid = choose_grid(
            self._resident, level, closed=closed, topology=topology, below=below, vertex_rule=vertex_rule
        )
        seeds = None
        if grow_from is not None:
            if topology != "separated":
                raise UsageError(
                    f"a surface of {name_parameter('topology')} {topology} cannot be grown: leave"
                    f" {name_parameter('grow_from')} out, or take the topology separated"
                )
            seeds, grid = Seeds.read(grow_from, self._resident), replace(grid, grows=True)
        for attempt in self._resident.with_fallback():
            with attempt as (_, warnings):
                run = Extraction(self._resident, grid, warnings, seeds=seeds)
                positions, normals, triangles = run.run(progress or ignore_progress)
                report = run.describe(len(positions), len(triangles)) | chosen
                mesh = Mesh(run.placement.to_lps(positions), triangles, normals, report, trusted=True)
        return mesh

    @explains_arguments
    def save(
        self,
        path: str | os.PathLike[str],
        iso_value: AutoLevel,
        space: Space = "lps",
        *,
        closed: bool = True,
        topology: Topology = "separated",
        below: bool = False,
        vertex_rule: VertexRule = "linear",
        no_clobber: bool = False,
        keep_ids: bool = False,
        progress: Progress | None = None,
    ) -> dict[str, Any]:
        """Write the surface slab by slab while it is made: the file of ``extract(...).save(path)``, byte for byte.

        A slab is in memory and not the mesh, which may be larger than memory, as may memory-mapped voxels.  They are
        read twice, first to count the triangles, so that a disk without room for them is refused before it is written.

        Parameters
        ----------
        path : path
            ``.stl`` or ``.ply``: complete, or absent.
        iso_value, closed, topology, below, vertex_rule
            See `extract_isosurface`.
        space, no_clobber, keep_ids
            See ``Mesh.save``.

        Returns
        -------
        dict
            ``bytes``, ``vertices``, ``triangles``, and the entries of ``Mesh.report``.

        Raises
        ------
        UsageError
            Another format, or a volume that reaches 4096 mm from the origin.
        OutputError
            The file cannot be written; an older one stays.
        """
        progress, file = progress or ignore_progress, PartsFile(path, space, keep_ids=keep_ids)
        with keep_existing(keep=no_clobber):
            check_writable(path)
            level, chosen = settle_level(self.volume, iso_value, progress)
            passing = PassingSurface(
                self._resident, level, closed=closed, topology=topology, below=below, vertex_rule=vertex_rule,
                progress=progress,
            )  # fmt: skip
            counts = passing.vertices, passing.triangles
            with file.stage(passing.parts(progress), counts, passing.describe() | chosen) as staged:
                staged.commit()
        return {"bytes": staged.size, "vertices": counts[0], "triangles": counts[1], **passing.describe(), **chosen}

    @explains_arguments
    def extract_vertices(
        self, iso_value: AutoLevel, *, closed: bool = True, below: bool = False, progress: Progress | None = None
    ) -> PointCloud:
        """Extract the vertices and normals of the surface that `extract` makes, without its triangles.

        Returns
        -------
        PointCloud
            In the order of the mesh's vertices, the same bit for bit; the HU of each is the iso value, and those of a
            range have none.
        """
        level, chosen = settle_level(self.volume, iso_value, progress)
        grid = choose_grid(self._resident, level, closed=closed, below=below)
        for attempt in self._resident.with_fallback():
            with attempt as (_, warnings):
                run = Extraction(self._resident, grid, warnings, vertices_only=True)
                positions, normals, _ = run.run(progress or ignore_progress)
                report = run.describe(len(positions), 0) | chosen
                level = report["iso_value_hu"]
                hu = None if level is None else np.full(len(positions), level, np.float32)
                cloud = PointCloud.of_known(run.placement.to_lps(positions), normals, hu, report=report)
        return cloud


@explains_arguments
def extract_isosurface(
    volume: Volume | DeviceVolume,
    iso_value: AutoLevel,
    *,
    device: Device | str | int | None = None,
    closed: bool = True,
    topology: Topology = "separated",
    below: bool = False,
    grow_from: Any = None,
    vertex_rule: VertexRule = "linear",
    solid: bool = False,
    memory: int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Extract the iso surface of a volume, as a closed manifold mesh in LPS mm.

    Marching cubes with a derived, face-consistent case table and vertices shared between cells.  A voxel is inside when
    its value is >= ``iso_value``. For integer voxels and an integer ``iso_value`` k the surface lies at k - 0.5,
    between the integers.  Vertices go once through the volume's affine, shear included, exact to one unit in the last
    place of float32 at its largest coordinate (6e-5 mm at 1 m), but stay four of these units away from voxel centres;
    from 4096 mm on they are float64.  A volume that does not fit the device gives the same mesh bit for bit.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        Its voxels may be a memory-mapped file.  A `DeviceVolume` is used directly, with its own device and memory.
    iso_value : float, (float, float) or "auto"
        HU; "auto" is that of `choose_iso_value`, and the report says why.  Or the ends of a range, both included (None:
        no end): at 100 to 300 the surface of integer voxels lies at 99.5 and at 300.5, none between two neighbours.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    closed : bool
        True: the surface is closed where an object leaves the volume: beyond the border the field has the volume's
        lowest value, but not less than -1024 HU.  False: it ends open at the outermost voxel centres.
    topology : {"separated", "trilinear"}
        How corners are joined where the case of a cell leaves it open: "separated" keeps inside voxels apart that only
        meet across a face; "trilinear" joins what the trilinear interpolation of the voxels joins, on faces and inside
        cells, so that the surface has the components and tunnels of that field.  Few cells differ.  "trilinear" cannot
        be used with a range.
    below : bool
        True: enclose the voxels below the iso value: the same vertices and triangles, turned round, and closed too.
    grow_from : "auto", (3,) float, LabelMap, (LabelMap, label), Mask, or a list of these, optional
        Make only parts connected to a seed: a point in LPS mm, voxels of a label or mask, or "auto", the large parts.
    vertex_rule : {"linear", "golden", "golden-search"}
        Where on an edge a vertex lies, see ``docs/methods.md``.  "golden" misses the surface by up to 0.6 voxels.
    solid : bool
        True: what is enclosed is filled, see `clrecon.fill_enclosed`; not with ``below`` and ranges.
    memory, progress
        See `SurfaceExtractor`; ``progress("build", done, total)`` and ``progress("slabs", slices done, all slices)``.

    Returns
    -------
    Mesh
        Triangles are counter-clockwise and normals point as seen from outside: from lower values, with ``below`` from
        higher ones; ``Mesh.report`` holds the iso value or the range, the affine, the certificate (``volume.report``),
        the device, the number of slabs, ``device_bytes`` of the largest, the seconds, ``cells`` {visited, all}, of a
        grown surface {grown, active} too, and ``growing``, what was left out of it.

    Raises
    ------
    NoSurfaceError
        The iso value crosses nothing; the message gives the range of the data.
    UsageError
        An argument is not what it should be, values or the volume are too large for float32, a row of the volume is
        too long, or a seed is outside or not near the surface.
    DeviceError
        No device, not even one slice fits its memory, 2^32 vertices or triangles or more, or it fails or errs.

    References
    ----------
    Lorensen and Cline 1987; Schroeder et al. 2015; "trilinear": Nielson and Hamann 1991, Chernyaev 1995, Grosso 2016.
    """
    level, chosen = settle_level(volume, iso_value, progress)  # before anything is filled
    with _open_extractor(volume, level, solid, below, device=device, memory=memory, progress=progress) as extractor:
        mesh = extractor.extract(
            level, closed=closed, topology=topology, below=below, grow_from=grow_from, vertex_rule=vertex_rule,
            progress=progress,
        )  # fmt: skip
    mesh.report.update(chosen)
    return mesh


@contextmanager
def _open_extractor(
    volume: Volume | DeviceVolume,
    iso_value: Level,
    solid: bool,
    below: bool,
    *,
    progress: Progress | None,
    **options: Any,
) -> Iterator[SurfaceExtractor]:
    """Yield an extractor for a volume, or with `solid` for one in which what the level encloses is filled."""
    with ExitStack() as opened:
        if solid:
            if below or np.ndim(iso_value):  # type: ignore[arg-type]
                raise UsageError(f"{name_parameter('solid', True)} goes with one iso value, not with below or a range")
            volume = fill_enclosed(volume, iso_value, progress=progress, **options)  # type: ignore[arg-type]
            if isinstance(volume, DeviceVolume):
                opened.enter_context(volume)
        yield opened.enter_context(SurfaceExtractor(volume, **options))


@explains_arguments
def extract_isosurfaces(
    volume: Volume | DeviceVolume,
    iso_values: Sequence[AutoLevel],
    *,
    device: Device | str | int | None = None,
    closed: bool = True,
    topology: Topology = "separated",
    below: bool = False,
    memory: int | None = None,
    progress: Progress | None = None,
) -> list[Mesh]:
    """Extract surfaces of a volume at several iso values or of several ranges; the volume is uploaded once.

    Parameters
    ----------
    iso_values : sequence of float, (float, float) or "auto"
        HU, at least one.

    Returns
    -------
    list of Mesh
        In the order of ``iso_values``; for all else see `extract_isosurface`.
    """
    if len(iso_values) == 0:
        raise UsageError("no iso value is given")
    with SurfaceExtractor(volume, device=device, memory=memory) as extractor:
        return [
            extractor.extract(iso_value, closed=closed, topology=topology, below=below, progress=progress)
            for iso_value in iso_values
        ]
