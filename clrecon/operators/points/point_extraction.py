"""`extract_points`: a volume as a cloud, on its surface, or the voxels of a band of HU, slab by slab."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon import opencl as ocl
from clrecon.anatomy.head import warn_of_face
from clrecon.anatomy.iso_choice import settle_level
from clrecon.errors import DeviceError, DeviceMemoryError, NoSurfaceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import data_range, describe_range
from clrecon.geometry.vertices import find_vertex_origin, warnings_of_far
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.masks.voxel_mask import band_bounds, checked_band, prepare_classify
from clrecon.operators.primitives.scan import exclusive_scan, prepare_scan
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.operators.resident.tables import label_variants, voxel_variants
from clrecon.operators.surface.marching_cubes import pad4, split_steps
from clrecon.operators.surface.slabs import OUTPUT_SHARE
from clrecon.points import POINT_KINDS, SURFACE_KINDS
from clrecon.points.cloud import MOST_POINTS, PointCloud, VoxelNumbers
from clrecon.system.arguments import PointKind, explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from clrecon.labels import LabelMap


_POINT_BYTES = 20
"""Bytes of a point: place, HU, number of the voxel."""

_MOST_NUMBERS = 2**32
"""Voxels of a slab have numbers of 32 bits."""

Points = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[Any]]
"""Positions (n, 3), HU (n,) and voxel numbers (n,), uint32 or int64, of the points of some slices."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The voxels that become points, from `low` to `high`, both included.

    shell: Only those with one of six neighbours outside; beyond the volume all is outside.
    labels: ndarray, shape (nk, nj, ni), uint8 or uint16, or None. On the volume's grid: only voxels with `label`, or
        with any number but 0 where it is 0.
    paper: Every slice is put where the first one lies.
    """

    low: Any
    high: Any
    shell: bool = False
    labels: NDArray[Any] | None = None
    label: int = 0
    paper: bool = False


def prepare_voxels(device: Device, dtype: DTypeLike, labels: DTypeLike | None = None) -> Program:
    prepare_scan(device)
    prepare_classify(device, dtype, "between")
    variants = {} if labels is None else label_variants(labels)
    return ocl.load_program(device, "points/emit.cl", {**voxel_variants(dtype), **device.kernel_variants, **variants})


@dataclass
class VoxelEmission:
    """The points of a volume, slab by slab; `marked` voxels are in the band; positions count from `origin`."""

    resident: DeviceVolume
    selection: Selection
    origin: NDArray[np.float64] | None = None
    marked: int = 0
    slabs: int = 0
    stopwatch: Stopwatch = field(default_factory=Stopwatch)
    largest: dict[str, int] = field(default_factory=lambda: {"volume": 0, "scratch": 0, "output": 0})
    warnings: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        volume = self.volume
        self.origin = find_vertex_origin(volume)
        places = volume.slice_origins()
        if self.selection.paper:
            places = np.broadcast_to(places[0], places.shape)
        values = places if self.origin is None else places - self.origin
        nearest = values.astype(np.float32).astype(np.float64)
        self._origins = pad4(np.stack([nearest, values - nearest], axis=-2))
        self._steps = pad4(np.concatenate([split_steps(volume.affine[:3, step]) for step in (0, 1)]))
        self._next = 0
        self._parts: list[Points] = []

    @property
    def volume(self) -> Volume:
        return self.resident.volume

    @property
    def kind(self) -> str:
        """Purpose of the slabs, see `DeviceVolume.plan`."""
        return "shell of voxels" if self.selection.shell else "voxels"

    def run(self, progress: Progress = ignore_progress) -> Points:
        labels = self.selection.labels
        with self.stopwatch.timed("build"):
            prepare_voxels(self.resident.device, self.volume.voxels.dtype, None if labels is None else labels.dtype)
        for attempt in self.resident.attempts(self.kind, self._plan(), self.warnings):
            with attempt as slices:
                self._go_on(slices, progress)
        try:
            return _join_points(self._parts)
        except MemoryError as error:
            raise DeviceError(f"the cloud does not fit the memory of this computer: {error}") from error

    def needs(self, slices: int, points: int = 0) -> dict[str, int]:
        """Return the bytes of every buffer of a slab in the middle of the volume, by description."""
        (ni, nj, nk), labels = self.volume.shape_ijk, self.selection.labels
        read = min(slices + 2 * self.selection.shell, nk)
        words = -(-ni // 32)
        return {
            "volume": read * self.resident.slice_bytes,
            "masks": 4 * read * nj * words * (1 + self.selection.shell),
            "rows": 4 * read * nj + 9 * slices * nj,
            **({} if labels is None else {"labels": read * nj * ni * labels.dtype.itemsize}),
            **({"points": _POINT_BYTES * points} if points else {}),
        }

    def _plan(self) -> int:
        nk, limits = self.volume.shape_ijk[2], self.resident.limits
        room = min(limits.total_bytes // OUTPUT_SHARE, limits.buffer_bytes)

        def needs(slices: int) -> dict[str, int]:
            return {**self.needs(slices), **({} if slices == nk else {"points": room})}

        ni, nj, _ = self.volume.shape_ijk
        slices = self.resident.plan(self.kind, nk, needs, most=max(_MOST_NUMBERS // (ni * nj), 1))
        if slices == 0:
            raise limits.refusal(f"one slice needs {sum(self.needs(1).values()):,} bytes, and room for its points")
        return slices

    def _go_on(self, slices: int, progress: Progress) -> None:
        nk = self.volume.shape_ijk[2]
        while self._next < nk:
            end = min(self._next + slices, nk)
            part, marked = self._one_slab(self._next, end)
            self._parts.append(part)
            self.marked += marked
            self.slabs += 1
            self._next = end
            if sum(len(part[1]) for part in self._parts) > MOST_POINTS:
                raise DeviceError(f"the cloud has more than {MOST_POINTS:,} points: choose a narrower band of HU")
            if end < nk or self.slabs > 1:
                progress("slabs", end, nk)

    def _one_slab(self, first: int, end: int) -> tuple[Points, int]:
        device, stopwatch = self.resident.device, self.stopwatch
        ni, nj, nk = self.volume.shape_ijk
        # slices of a shell need their neighbours
        border = int(self.selection.shell)
        begin, stop = max(first - border, 0), min(end + border, self.volume.shape_ijk[2])
        is_whole = (begin, stop) == (0, nk)
        voxels_d = self.resident.whole(stopwatch) if is_whole else self.resident.part(begin, stop, stopwatch)
        words, rows = -(-ni // 32), (end - first) * nj
        with stopwatch.running(device):
            layout = {"words": words, "first_row": (first - begin) * nj, "rows": rows}
            mask_d, extents_d, marked = self._mark(voxels_d, begin, stop, layout)
            counts_d, total = self._count(mask_d, extents_d, layout)
        self._check_output(end - first, total)
        positions, positions_d = ocl.empty_output(device, (total, 3), np.float32)
        hu, hu_d = ocl.empty_output(device, (total,), np.float32)
        numbers, numbers_d = ocl.empty_output(device, (total,), np.uint32)
        is_small = self.volume.voxels.size <= _MOST_NUMBERS
        if total:
            program = prepare_voxels(device, self.volume.voxels.dtype)
            words_per_item = words if device.kernel_variants["LANES"] == "8" else 1
            with stopwatch.running(device):
                ocl.launch(
                    device, program["emit_points"], rows * -(-words // words_per_item), mask=mask_d,
                    row_extents=extents_d, offsets=counts_d, voxels=voxels_d,
                    origins=ocl.upload(device, self._origins[first:end]), steps=ocl.upload(device, self._steps),
                    positions=positions_d, hu=hu_d, numbers=numbers_d, first_number=first * nj * ni if is_small else 0,
                    ni=ni, nj=nj, words_per_item=words_per_item, **layout,
                )  # fmt: skip
            with stopwatch.timed("download"):
                ocl.download_all(device, (positions, positions_d, 0), (hu, hu_d, 0), (numbers, numbers_d, 0))
        self.volume.release_slices(begin, stop)
        return (positions, hu, numbers if is_small else numbers + np.int64(first * nj * ni)), marked or total

    def _mark(self, voxels_d: Any, begin: int, stop: int, layout: dict[str, int]) -> tuple[Any, Any, int | None]:
        """Mark the voxels of the band, of the label; with a label or a shell also count those of the band."""
        device = self.resident.device
        ni, nj, nk = self.volume.shape_ijk
        chosen, words = self.selection, layout["words"]
        rows = (stop - begin) * nj
        mask_d, extents_d = ocl.allocate(device, 4 * rows * words), ocl.allocate(device, 4 * rows)
        ocl.launch(
            device, prepare_classify(device, self.volume.voxels.dtype, "between")["classify_samples"], rows,
            voxels=voxels_d, mask=mask_d, row_extents=extents_d, level=chosen.low, highest=chosen.high, ni=ni, nj=nj,
            nk=nk, border=0, first_slice=begin, first_sample_slice=begin, gk=stop - begin, words=words,
        )  # fmt: skip
        if chosen.labels is None and not chosen.shell:
            return mask_d, extents_d, None
        _, marked = self._count(mask_d, extents_d, layout)
        program = prepare_voxels(
            device, self.volume.voxels.dtype, None if chosen.labels is None else chosen.labels.dtype
        )
        if chosen.labels is not None:
            ocl.launch(
                device, program["restrict_mask"], rows, mask=mask_d, row_extents=extents_d,
                labels=ocl.upload(device, chosen.labels[begin:stop]), label=chosen.label, ni=ni, words=words, rows=rows,
            )  # fmt: skip
        if chosen.shell:
            shell_d = ocl.allocate(device, 4 * rows * words)
            ocl.launch(
                device, program["find_shell"], rows,
                mask=mask_d, row_extents=extents_d, shell=shell_d, nj=nj, words=words, slices=stop - begin,
            )  # fmt: skip
            mask_d = shell_d
        return mask_d, extents_d, marked

    def _count(self, mask_d: Any, extents_d: Any, layout: dict[str, int]) -> tuple[Any, int]:
        """Count the voxels of a mask in the slab's own rows; return the number before each row, and all."""
        device = self.resident.device
        program = prepare_voxels(device, self.volume.voxels.dtype)
        rows = layout["rows"]
        counts_d = ocl.allocate(device, 4 * rows)
        ocl.launch(device, program["count_points"], rows, mask=mask_d, row_extents=extents_d, counts=counts_d, **layout)
        scanned = exclusive_scan(device, counts_d, rows, in_place=True)
        if scanned.total > MOST_POINTS:
            raise DeviceMemoryError(f"a slab has {scanned.total:,} points: more than {MOST_POINTS:,}")
        return scanned.offsets_d, scanned.total

    def _check_output(self, slices: int, points: int) -> None:
        """Refuse a slab whose points do not fit beside the other buffers; record the memory of the slab."""
        needs = self.needs(slices, points)
        shortage = self.resident.shortage(needs)
        if shortage:
            raise DeviceMemoryError(shortage)
        volume, output = needs["volume"], needs.get("points", 0)
        for kind, size in (("volume", volume), ("output", output), ("scratch", sum(needs.values()) - volume - output)):
            self.largest[kind] = max(self.largest[kind], size)

    def describe(self) -> dict[str, Any]:
        device = self.resident.device
        return {
            "device": device.label,
            "driver": device.driver,
            "slabs": self.slabs,
            "device_bytes": dict(self.largest),
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
        }


def _join_points(parts: list[Points]) -> Points:
    """Join the points of all slabs; those of a slab are freed as soon as they are copied."""
    if len(parts) == 1:
        return parts[0]
    rows = sum(len(part[1]) for part in parts)
    joined = tuple(ocl.result_pages.empty((rows, *array.shape[1:]), array.dtype) for array in parts[0])
    filled = 0
    while parts:
        part = parts.pop(0)
        for whole, array in zip(joined, part, strict=True):
            whole[filled : filled + len(array)] = array
        filled += len(part[1])
    return joined  # type: ignore[return-value]


Band = tuple[float, float]


@explains_arguments
def extract_points(
    volume: Volume | DeviceVolume,
    iso_value: float | Literal["auto"] | None = None,
    *,
    kind: PointKind | None = None,
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
    where the values cross the iso value.  ``cortex`` are the same moved onto the bone by `fit_cortex`.  ``voxels`` are
    the centres of all voxels in a band of HU, each its own product of index and affine, tilt and uneven slices
    included.  ``shell`` are those of them with one of six neighbours outside; beyond the volume all is outside.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        A `DeviceVolume` is used directly, with its own device and memory.  Remove a table before, see
        `clrecon.remove_table`.
    iso_value : float or "auto", optional
        HU; for voxels the lower end of a band without an upper one.  "auto", and None unless ``hu`` is given: that of
        `clrecon.choose_iso_value`; the report says why.  The cortex needs a low one, such as 200, which shows its
        walls.
    kind : {"surface", "cortex", "shell", "voxels"}, optional
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
        at one iso value, ``hu``; those of the cortex have ``values`` and ``report["cortex"]`` as `fit_cortex` gives.
        Places are exact to the rounding of float32, 1.5e-5 mm within 512 mm of the origin; from 4096 mm on they are
        float64.
        Entries of ``PointCloud.report``: ``kind``, ``iso_value_hu`` or ``band_hu``, ``voxels`` (of the volume),
        ``points``, and of voxels ``voxels_in_band`` and ``share`` (points of all voxels); ``label``; the affine, the
        certificate, device, ``slabs``, ``device_bytes``, seconds and warnings as in ``Mesh.report``; with ``paper``
        ``paper``: ``nonzero_voxels``, ``error_max_mm`` and ``error_rms_mm``.

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
    progress = progress or ignore_progress
    kind = _check_choices(iso_value, kind, hu, labels, label, paper)
    with open_volume(volume, device, memory, "a cloud of points") as resident:
        level, chosen = settle_level(resident.volume, "auto" if iso_value is None and hu is None else iso_value)
        if kind in SURFACE_KINDS:
            cloud = _surface(resident, level if hu is None else hu, labels, label, kind == "cortex", progress)
        else:
            band = checked_band((level, None) if hu is None else hu)
            cloud = _voxels(resident, band, kind == "shell", labels, label, paper, progress)
    cloud.report.update(chosen, kind=kind, voxels=resident.volume.voxels.size, points=len(cloud))
    return cloud


def _check_choices(
    iso_value: object, kind: PointKind | None, hu: object, labels: object, label: object, paper: bool
) -> PointKind:
    if iso_value is not None and hu is not None:
        raise UsageError(f"give an iso value or {name_parameter('hu', '(LOW, HIGH)')}, not both")
    kind = kind or ("surface" if hu is None else "voxels")
    if kind not in POINT_KINDS:
        raise UsageError(f"there are no points of the kind {kind!r}: use one of {', '.join(POINT_KINDS)}")
    if label is not None and labels is None:
        raise UsageError(f"{name_parameter('label')} needs {name_parameter('labels')}: the map that has it")
    if kind == "cortex" and iso_value in (None, "auto"):
        raise UsageError("the cortex is looked for from a low level on, which shows its walls: give it, such as 200 HU")
    if paper and kind in SURFACE_KINDS:
        raise UsageError(f"{name_parameter('paper', True)} places voxels: ask for voxels or shell")
    return kind


def _describe_band(band: Band) -> str:
    low, high = band
    if math.isinf(high):
        return f"{low:g} HU or more"
    return f"{high:g} HU or less" if math.isinf(low) else f"{low:g} to {high:g} HU"


def _voxels(
    resident: DeviceVolume, band: Band, shell: bool, labels: LabelMap | None, label: int | str | None, paper: bool,
    progress: Progress,
) -> PointCloud:  # fmt: skip
    volume = resident.volume
    ends = band_bounds(volume, band)
    placed = None if labels is None else resident.bring(labels)
    number = 0 if labels is None or label is None else labels.find(label)
    chosen = Selection(*ends, shell, None if placed is None else placed.voxels, number, paper)
    for attempt in resident.with_fallback():
        with attempt as (current, warnings):
            run = VoxelEmission(resident, chosen, warnings=warnings)
            positions, hu, numbers = run.run(progress)
            if not len(hu):
                which = "" if labels is None else "of a label "
                if labels is not None and number:
                    which = f"of label {number} {labels.name(number)} "
                runs = describe_range(volume, *data_range(volume))
                raise NoSurfaceError(f"no voxel {which}of {_describe_band(band)}: {runs}")
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
                    *current.warnings,
                    *warnings_of_far(volume),
                    *warn_of_face(volume, band[:1] if math.isfinite(band[0]) else (), "cloud"),
                    *(() if placed is None else placed.warnings),
                    *run.warnings,
                ],
            }
            cloud = PointCloud.of_known(points, None, hu, of_label, VoxelNumbers(numbers, volume.shape_ijk), report)
    return cloud


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
    resident: DeviceVolume, level: Any, labels: LabelMap | None, label: int | str | None, fitted: bool,
    progress: Progress,
) -> PointCloud:  # fmt: skip
    from clrecon.operators.surface.extract import SurfaceExtractor  # which voxels need not wait for
    from clrecon.operators.surface.labels import extract_labels

    if labels is not None and np.ndim(level) != 0:
        raise UsageError("the surface of a label has one iso value, no band: ask for voxels, or leave the labels out")
    if labels is not None:
        numbers = None if label is None else [label]
        meshes = extract_labels(resident, labels, level, label=numbers, progress=progress)
    else:
        with SurfaceExtractor(resident) as extractor:
            if not fitted:
                return extractor.extract_vertices(level, progress=progress)
            meshes = {0: extractor.extract(level, progress=progress)}
    if fitted:
        from clrecon.operators.surface.cortex_mesh import fit_meshes

        meshes = dict(zip(meshes, fit_meshes([*meshes.values()], resident, progress=progress), strict=True))
    facts: dict[str, Any] = dict(next(iter(meshes.values())).report)
    of_label = None
    if labels is not None:
        facts = {name: value for name, value in facts.items() if label is not None or not name.startswith("label")}
        facts["label"] = facts.get("label")
        of_label = np.concatenate([np.full(mesh.vertex_count, number, np.int32) for number, mesh in meshes.items()])
    first, *others = meshes.values()
    whole = first.merge(*others)
    hu = None if fitted else np.full(whole.vertex_count, facts["iso_value_hu"], np.float32)
    cloud = PointCloud.of_known(whole.vertices, whole.normals, hu, of_label, None, facts)
    cloud.values = whole.values
    return cloud
