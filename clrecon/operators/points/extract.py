"""`extract_points`: a volume as a cloud, on its surface or voxel by voxel."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.head import warn_of_face
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import data_range
from clrecon.geometry.precision import describe_far
from clrecon.opencl import Device
from clrecon.operators.masks.band_mask import band_bounds, checked_band
from clrecon.operators.points.emit import Selection, VoxelEmission
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.points import PointCloud
from clrecon.points.kinds import KINDS
from clrecon.points.voxel_numbers import VoxelNumbers
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress
from clrecon.system.text import format_hu
from clrecon.system.wording import name_parameter

if TYPE_CHECKING:  # label maps load pydicom, which other clouds need not wait for
    from clrecon.labels import LabelMap

Band = tuple[float, float]


@explains_arguments
def extract_points(
    volume: Volume | DeviceVolume,
    iso_value: float | None = None,
    *,
    kind: str | None = None,
    hu: Sequence[float | None] | None = None,
    labels: LabelMap | None = None,
    label: int | str | None = None,
    paper: bool = False,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> PointCloud:
    """Extract a cloud of points in LPS mm from a volume.

    ``surface`` are the vertices of `extract_isosurface`, with normals and without triangles: they lie between voxels,
    where the values cross the iso value.  ``voxels`` are the centres of all voxels in a band of HU, each its own
    product of index and affine, tilt and uneven slices included.  ``shell`` are those of them with one of six
    neighbours outside; beyond the volume all is outside.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        A `DeviceVolume` is used directly, with its own device and memory.  Remove a table before, see
        `clrecon.remove_table`.
    iso_value : float, optional
        HU; for voxels the lower end of a band without an upper one.  None: that of `clrecon.choose_iso_value`, unless
        ``hu`` is given.
    kind : {"surface", "shell", "voxels"}, optional
        None: "voxels" where ``hu`` is given, else "surface".
    hu : (float or None, float or None), optional
        Lowest and highest value of a band, both included; None: no such end.  For "surface" both ends are levels.
    labels : LabelMap, optional
        Only points of a label, on any grid; see `resample_labels`.  For voxels the label is what the map
        says; for a surface what `clrecon.extract_labels` makes of it, which grows it by a voxel.
    label : int or str, optional
        Number or name, as `LabelMap.find` takes it; None: all labels.  ``labels`` of the cloud tells which.
    paper : bool
        True: voxels are placed with the position of the first image in all slices, as eq. 1 of Karakullukcu and others
        prints it.  All slices then fall into one plane; the report gives the error.
    device, memory, progress
        As in `extract_isosurface`.  With less memory a volume is processed slab by slab, with the same points.

    Returns
    -------
    PointCloud
        Voxels in the order k, j, i, with ``hu`` and ``ijk``; surfaces in the order of the mesh, with ``normals`` and,
        at one iso value, ``hu``.  Places are exact to the rounding of float32, 1.5e-5 mm within 512 mm of the origin;
        from 4096 mm on they are float64.  Entries of ``PointCloud.report``: ``kind``, ``iso_value_hu`` or ``band_hu``,
        ``voxels`` (of the volume), ``points``, and of voxels ``voxels_in_band`` and ``share`` (points of all voxels);
        ``label``; the affine, the certificate, device, ``slabs``, ``device_bytes``, seconds and warnings as in
        ``Mesh.report``; with ``paper`` ``paper``: ``nonzero_voxels``, ``error_max_mm`` and ``error_rms_mm``.

    Raises
    ------
    NoSurfaceError
        No voxel lies in the band, or nothing crosses the iso value.
    UsageError
        An argument is wrong, or arguments contradict each other.
    RefusedInputError
        The labels do not lie on the volume.
    DeviceError
        As `extract_isosurface`.
    """
    kind = _check(iso_value, kind, hu, labels, label, paper)
    with open_volume(volume, device, memory, "a cloud of points") as resident:
        if iso_value is None and hu is None:
            from clrecon.anatomy.iso_choice import choose_iso_value

            iso_value = choose_iso_value(resident.volume).iso_value
        if kind == "surface":
            level = iso_value if hu is None else hu
            cloud = _surface(resident, level, labels, label, progress)
        else:
            band = checked_band((iso_value, None) if hu is None else hu)
            cloud = _voxels(resident, band, kind == "shell", labels, label, paper, progress)
    cloud.report.update(kind=kind, voxels=resident.volume.voxels.size, points=len(cloud))
    return cloud


def _check(iso_value: object, kind: str | None, hu: object, labels: object, label: object, paper: bool) -> str:
    if iso_value is not None and hu is not None:
        raise UsageError(f"give an iso value or {name_parameter('hu', '(LOW, HIGH)')}, not both")
    kind = kind or ("surface" if hu is None else "voxels")
    if kind not in KINDS:
        raise UsageError(f"there are no points of the kind {kind!r}: use one of {', '.join(KINDS)}")
    if label is not None and labels is None:
        raise UsageError(f"{name_parameter('label')} needs {name_parameter('labels')}: the map that has it")
    if paper and kind == "surface":
        raise UsageError(f"{name_parameter('paper', True)} places voxels: ask for voxels or shell")
    return kind


def _describe(band: Band) -> str:
    low, high = band
    if math.isinf(high):
        return f"{low:g} HU or more"
    return f"{high:g} HU or less" if math.isinf(low) else f"{low:g} to {high:g} HU"


def _refuse_band(volume: Volume, band: Band, where: str) -> NoSurfaceError:
    low, high = data_range(volume)
    return NoSurfaceError(
        f"no voxel {where}of {_describe(band)}: the volume runs from {format_hu(low)} to {format_hu(high)} HU"
    )


def _voxels(
    resident: DeviceVolume, band: Band, shell: bool, labels: LabelMap | None, label: int | str | None, paper: bool,
    progress: Progress | None,
) -> PointCloud:  # fmt: skip
    volume = resident.volume
    ends = band_bounds(volume, band)
    taken = None if labels is None else resident.bring(labels)
    number = 0 if labels is None or label is None else labels.find(label)
    chosen = Selection(*ends, shell, None if taken is None else taken.voxels, number, paper)

    def make(told: list[str]) -> PointCloud:
        run = VoxelEmission(resident, chosen)
        run.warnings += told
        positions, hu, numbers = run.run(progress)
        if not len(hu):
            where = "" if labels is None else f"of label {number} {labels.name(number)} " if number else "of a label "
            raise _refuse_band(volume, band, where)
        points = positions if run.origin is None else positions + run.origin
        of_label = None if chosen.labels is None else chosen.labels.reshape(-1)[numbers].astype(np.int32)
        report = {
            "iso_value_hu": band[0] if math.isinf(band[1]) and not math.isinf(band[0]) else None,
            "band_hu": [None if math.isinf(end) else end for end in band],
            "voxels_in_band": run.marked,
            "share": len(hu) / volume.voxels.size,
            **({"label": number or None} if labels is not None else {}),
            "affine_ijk_to_lps_mm": volume.affine.tolist(),
            "certificate": volume.report,
            **run.describe(),
            **({"paper": _measure_paper(volume, numbers)} if paper else {}),
            "warnings": [
                *resident.device.warnings,
                *describe_far(volume),
                *warn_of_face(volume, band[:1] if math.isfinite(band[0]) else (), "cloud"),
                *(() if taken is None else taken.warnings),
                *run.warnings,
            ],
        }
        return PointCloud.of_known(points, None, hu, of_label, VoxelNumbers(numbers, volume.shape_ijk), report)

    return resident.attempt(make)


def _measure_paper(volume: Volume, numbers: NDArray[Any]) -> dict[str, float]:
    """Return how far the points of voxels lie from their places when all slices lie where the first does."""
    origins = volume.slice_origins()
    away = np.linalg.norm(origins - origins[0], axis=1)
    ni, nj, nk = volume.shape_ijk
    counts = np.diff(np.searchsorted(numbers, np.arange(nk + 1, dtype=np.uint64) * (ni * nj)))
    return {
        "nonzero_voxels": int(np.count_nonzero(volume.voxels)),
        "error_max_mm": float(away[counts > 0].max()),
        "error_rms_mm": float(np.sqrt((counts @ (away * away)) / counts.sum())),
    }


def _surface(
    resident: DeviceVolume, level: Any, labels: LabelMap | None, label: int | str | None, progress: Progress | None
) -> PointCloud:
    if labels is None:
        from clrecon.operators.surface.extract import SurfaceExtractor  # which voxels need not wait for

        with SurfaceExtractor(resident) as extractor:
            return extractor.extract_vertices(level, progress=progress)
    from clrecon.operators.surface.labels import extract_labels

    if np.ndim(level) != 0:
        raise UsageError("the surface of a label has one iso value, no band: ask for voxels, or leave the labels out")
    numbers = None if label is None else [label]
    meshes = extract_labels(resident, labels, level, numbers=numbers, progress=progress)
    report: Mapping[str, Any] = next(iter(meshes.values())).report
    points = np.concatenate([mesh.vertices for mesh in meshes.values()])
    normals = np.concatenate([mesh.normals for mesh in meshes.values() if mesh.normals is not None])
    of_label = np.concatenate([np.full(mesh.vertex_count, number, np.int32) for number, mesh in meshes.items()])
    hu = np.full(len(points), report["iso_value_hu"], np.float32)
    facts = dict(report) if label is not None else {k: v for k, v in report.items() if not k.startswith("label")}
    return PointCloud.of_known(
        points, normals, hu, of_label, None, {**facts, "label": report["label"] if label else None}
    )
