"""Iso surfaces of labels: the label selects the cells, HU place the vertices; the host of cl/surface/labels.cl."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from clrecon import opencl as ocl
from clrecon.anatomy.head import SKIN_HU, warn_of_skin
from clrecon.anatomy.iso_choice import settle_level
from clrecon.errors import DeviceMemoryError, NoSurfaceError
from clrecon.geometry import Volume, slice_voxel_ml
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule
from clrecon.geometry.vertices import warnings_of_far
from clrecon.labels import LabelMap, ResampledLabels
from clrecon.labels.label_levels import Box, Growth, count_ml, fill_solid, find_boxes, label_ml
from clrecon.mesh import Mesh
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.operators.resident.tables import label_variants, voxel_variants
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.extraction import Part, voxel_level
from clrecon.operators.surface.marching_cubes import Classified, Counted, Placement, count_output
from clrecon.operators.surface.slabs import SampleGrid, Slab
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress

Held = TypeVar("Held")
Made = TypeVar("Made")


@dataclass(frozen=True)
class Window(Slab):
    """The slices of the sample grid that hold one label and a layer around it, among those on the device."""

    held: tuple[int, int] = (0, 0)

    @property
    def voxel_slices(self) -> tuple[int, int]:
        """First and end of the slices of the volume on the device."""
        return self.held


def each_label(
    groups: list[dict[int, Box]],
    hold: Callable[[dict[int, Box]], Held],
    extract: Callable[[Held, int, Box], Made],
    warnings: list[str],
) -> Iterator[tuple[int, Made]]:
    """Yield labels with what `extract` makes of one; `hold` uploads for a group, or for one where room is short."""
    waiting, retried = list(groups), set[int]()
    while waiting:
        left = dict(waiting.pop(0))
        try:
            slab = hold(left)
            for number, box in list(left.items()):
                surface = extract(slab, number, box)
                del left[number]
                yield number, surface
        except DeviceMemoryError as error:
            if len(left) == 1:
                if not retried.isdisjoint(left):
                    raise
                retried.update(left)
            waiting[:0] = [{number: box} for number, box in left.items()]
            warnings.append(f"{error}: continued with one label at a time")


SPARE_SLICES = 3
"""Slices needed beyond a label's box: the far end of a crossed edge, its gradient, and the last slices of the mask."""


class ExtractionByLabel(Generic[Held, Made]):
    """What extractions of labels one by one share: the grid, the device and its memory, and the labels that fit it."""

    def __init__(self, device: Device, memory: int | None, grid: SampleGrid, placement: Placement, warnings: list[str]):
        self.device = device
        self.memory = memory
        self.grid = grid
        self.placement = placement
        self.warnings = warnings
        self.stopwatch = Stopwatch()
        self.groups = 1
        self.device_bytes: dict[str, int] = {}

    def slices_for(self, boxes: dict[int, Box]) -> tuple[int, int]:
        """Return first and end of the slices that these labels need."""
        raise NotImplementedError

    def needs(self, first: int, end: int) -> dict[str, int]:
        raise NotImplementedError

    def hold(self, boxes: dict[int, Box]) -> Held:
        """Upload the slices that the labels need, and compute what they share."""
        raise NotImplementedError

    def extract_one(self, slab: Held, number: int, box: Box) -> Made:
        raise NotImplementedError

    def group(self, boxes: dict[int, Box]) -> list[dict[int, Box]]:
        """Group all labels together if their slices fit the device, else one by one: the meshes are the same."""
        scratch = max(sum(self.window(box, (0, 0)).scratch().values()) for box in boxes.values())
        room, needs = ocl.memory_limits(self.device, self.memory), self.needs(*self.slices_for(boxes))
        if not ocl.describe_shortage(room, {**needs, "scratch": min(scratch, room.buffer_bytes)}):
            return [boxes]
        return [{number: box} for number, box in boxes.items()]

    def window(self, box: Box, ends: tuple[int, int]) -> Window:
        """Return the slices of the sample grid around a label's box."""
        return Window(self.grid, box[0].start, box[0].stop + 2 * self.grid.rule.border, ends)

    def extract_each(self, boxes: dict[int, Box], progress: Progress) -> Iterator[tuple[int, Made]]:
        """Yield labels with their surfaces, as many at once as fit the device."""
        groups = self.group(boxes) if boxes else []
        self.groups = len(groups)
        done = 0

        def extract_label(slab: Held, number: int, box: Box) -> Made:
            progress("labels", done, len(boxes))
            return self.extract_one(slab, number, box)

        for number, surface in each_label(groups, self.hold, extract_label, self.warnings):
            done += surface is not None
            yield number, surface

    def empty_mask(self, window: Window) -> Classified:
        """Make the mask of a label on the device, if it has room for what finds the surface."""
        ocl.check_budget(self.device, self._needs(window), self.memory, less_may_fit=True)
        mask_d = ocl.allocate(self.device, 4 * window.mask_rows * self.grid.words)
        return Classified(mask_d, ocl.allocate(self.device, 4 * window.mask_rows))

    def check_output(self, window: Window, counted: Counted) -> None:
        """Refuse a mesh that does not fit beside the other buffers; record the memory of the label."""
        scratch = {**window.scratch(), **counted.scratch(self.device)}
        needs, output = {**self._needs(window), **scratch}, counted.output()
        ocl.check_budget(self.device, {**needs, **output}, self.memory, less_may_fit=True)
        self.device_bytes = {
            "volume": sum(needs.values()) - sum(scratch.values()),
            "scratch": sum(scratch.values()),
            "output": sum(output.values()),
        }

    def _needs(self, window: Window) -> dict[str, int]:
        return {**self.needs(*window.held), **window.scratch()}

    def facts(self, settings: dict[str, Any], warnings: Sequence[str]) -> dict[str, Any]:
        """Return the report entries of the work, which all labels share, with `settings` among them."""
        return {
            "device": self.device.label,
            "driver": self.device.driver,
            "slabs": self.groups,
            "device_bytes": self.device_bytes,
            **settings,
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
            "warnings": [*self.device.warnings, *warnings, *self.warnings],
        }


@dataclass(frozen=True)
class HeldSlices:
    """The slices of a volume on the device, with the label that each sample is inside of."""

    first: int
    end: int
    voxels_d: Any
    inside_d: Any


class LabelExtraction(ExtractionByLabel[HeldSlices, "Part | None"]):
    def __init__(
        self,
        resident: DeviceVolume,
        placed: ResampledLabels,
        rule: IsoRule,
        growth: Growth,
        solid: bool,
        warnings: list[str],
    ):
        volume, device = resident.volume, resident.device
        self.level = voxel_level(device, volume, rule)
        placement = Placement.of(volume, rule.border)
        super().__init__(device, resident.memory, SampleGrid(volume, rule), placement, warnings)
        self.resident = resident
        self.volume = volume
        self.labels = placed.voxels
        self.rule = rule
        self.growth = growth
        self.solid = solid
        self.share_by_hu = 1.0  # of the vertices of the label that was extracted last

    def programs(self) -> tuple[Program, Program]:
        with self.stopwatch.timed("build"):
            dtype, variants = self.resident.dtype, label_variants(self.labels.dtype)
            program = ocl.load_program(self.device, "surface/labels.cl", {**voxel_variants(dtype), **variants})
            return program, marching_cubes.prepare_marching_cubes(
                self.device, dtype, {"LABELS": "1", **variants}, uneven=self.volume.uneven
            )

    def slices_for(self, boxes: dict[int, Box]) -> tuple[int, int]:
        """Return first and end of the slices of the volume that these labels need; all if they are on the device."""
        if self.resident.is_held and self._fits_whole():
            return 0, self.volume.shape_ijk[2]
        spare = SPARE_SLICES + self.growth.reach[2]  # labels that were not asked for grow too
        first = max(0, min(box[0].start for box in boxes.values()) - spare)
        return first, min(self.volume.shape_ijk[2], max(box[0].stop for box in boxes.values()) + spare)

    def needs(self, first: int, end: int) -> dict[str, int]:
        """Return the bytes on the device while inside samples are found in these slices."""
        samples = self.volume.voxels[first:end].size
        size = samples * self.labels.itemsize
        return {"volume": samples * self.volume.voxels.itemsize, "labels": size, "inside": size}

    def _fits_whole(self) -> bool:
        needs = self.needs(0, self.volume.shape_ijk[2])
        return not ocl.describe_shortage(self.resident.limits, needs | {"mesh": sum(needs.values()) // 2})

    def hold(self, boxes: dict[int, Box]) -> HeldSlices:
        """Upload the slices that the labels need, and find which samples are inside of which label."""
        device, stopwatch = self.device, self.stopwatch
        resident = self.resident
        first, end = self.slices_for(boxes)
        ocl.check_budget(device, self.needs(first, end), resident.memory)
        label_program, _ = self.programs()
        is_whole = end - first == self.volume.shape_ijk[2] and resident.is_held
        voxels_d = resident.whole(stopwatch) if is_whole else resident.part(first, end, stopwatch)
        labels = self.labels[first:end]
        near = self.growth.table
        with stopwatch.timed("upload"):
            labels_d = ocl.upload(device, labels)
            near_d = ocl.upload(device, near if len(near) else np.zeros((1, 4), np.int32))
        inside_d = ocl.allocate(device, labels.nbytes)
        with stopwatch.running(device):
            ocl.launch(
                device, label_program["own_samples"], labels.size, voxels=voxels_d, labels=labels_d, near=near_d,
                inside=inside_d, level=self.level, nk=labels.shape[0], nj=labels.shape[1], ni=labels.shape[2],
                offsets=len(near),
            )  # fmt: skip
        if self.solid:
            inside_d = self._fill(boxes, first, end, inside_d)
        return HeldSlices(first, end, voxels_d, inside_d)

    def _fill(self, boxes: dict[int, Box], first: int, end: int, inside_d: Any) -> Any:
        """Return the inside samples with the labels made solid, on the device again."""
        inside = np.zeros(self.labels.shape, dtype=self.labels.dtype)
        part = inside[first:end]
        with self.stopwatch.timed("download"):
            ocl.download(self.device, part, inside_d)
        for number, box in boxes.items():
            fill_solid(inside, self.labels, number, box, self.rule.closed)
        with self.stopwatch.timed("upload"):
            return ocl.upload(self.device, part)

    def extract_one(self, slab: HeldSlices, number: int, box: Box) -> Part | None:
        """Return positions, normals and triangles of one label, None if no sample is inside of it."""
        device, stopwatch = self.device, self.stopwatch
        label_program, surface = self.programs()
        window = self.window(box, (slab.first, slab.end))
        classified = self.empty_mask(window)
        half_way_d = ocl.allocate(device, 4)
        with stopwatch.running(device):
            ocl.launch(
                device, label_program["classify_label"], window.mask_rows, inside=slab.inside_d, mask=classified.mask_d,
                row_extents=classified.row_extents_d, half_way_count=half_way_d, label=number, **window.arguments,
            )  # fmt: skip
            counted = count_output(device, window, classified)
        if counted.triangles == 0:
            return None
        self.check_output(window, counted)
        emission = marching_cubes.Emission(device, surface, slab.voxels_d, counted, self.placement, stopwatch)
        part = emission.run(inside=slab.inside_d, label=number, half_way_count=half_way_d)
        half_way = int(ocl.download(device, np.empty(1, np.uint32), half_way_d)[0])
        self.share_by_hu = 1.0 - half_way / counted.vertices
        return part

    def describe(self) -> dict[str, Any]:
        rule = self.rule
        return {
            **rule.as_report(),
            "surface": "hu",
            "mask_level": None,
            "closed_at_border": rule.closed,
            "outside_hu": rule.outside if rule.closed else None,
            "affine_ijk_to_lps_mm": self.volume.affine.tolist(),
            "certificate": self.volume.report,
            **self.facts(
                {"grow_mm": self.growth.grow_mm, "solid": self.solid},
                [*warnings_of_far(self.volume), *_warn_of_uneven_growth(self.volume, self.growth)],
            ),
        }


def _warn_of_uneven_growth(volume: Volume, growth: Growth) -> list[str]:
    """Warn of growth in uneven slices: the offsets to neighbours are one table, made for evenly spaced slices."""
    if not volume.uneven or not len(growth.offsets):
        return []
    steps = np.linalg.norm(np.diff(volume.slice_origins(), axis=0), axis=1)
    return [
        f"the slices are unevenly spaced ({steps.min():.3f} to {steps.max():.3f} mm): the growth of the labels takes"
        f" {volume.spacing[2]:.3f} mm from one to the next everywhere"
    ]


_FILLS = "the whole CT is inside of it, and a surface that ends open has nowhere to lie; close it"


def _refuse_label(
    volume: Volume, placed: ResampledLabels, labels: LabelMap, rule: IsoRule, number: int
) -> NoSurfaceError:
    label = f"{number} {labels.name(number)}"
    mask = placed.voxels == number
    if not mask.any():
        return NoSurfaceError(f"label {label} has no voxel in the CT: it lies outside")
    hu = volume.voxels[mask]
    if not rule.closed and hu.max() >= rule.lowest_inside:
        return NoSurfaceError(f"no surface of label {label} at {rule.iso_value:g} HU: {_FILLS}")
    return NoSurfaceError(
        f"no surface of label {label} at {rule.iso_value:g} HU: its voxels run from {float(hu.min()):g} to"
        f" {float(hu.max()):g} HU"
    )


@explains_arguments
def extract_labels(
    volume: Volume | DeviceVolume,
    labels: LabelMap,
    iso_value: float | Literal["auto"],
    *,
    device: Device | str | int | None = None,
    label: Sequence[int | str] | int | str | None = None,
    grow_mm: float | None = None,
    closed: bool = True,
    solid: bool = False,
    memory: int | None = None,
    progress: Progress | None = None,
) -> dict[int, Mesh]:
    """Extract the iso surface of a volume label by label: the label selects the cells, HU place the vertices.

    A voxel is inside of a label when it is dense (``iso_value`` or more) and belongs to the label: by the map, or, if
    it has no label, because the label is the nearest one within the growth.  Between a dense voxel of the label and one
    that is neither dense nor labelled, the vertex is that of `extract_isosurface`, bit for bit.  Elsewhere (the border
    of two labels, dense voxels beyond the growth) it lies half way.  Every mesh is closed and manifold; two labels
    share the vertices of their border, bit for bit.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        A `DeviceVolume` is used directly, with its own device and memory.
    labels : LabelMap
        On any grid, see `resample_labels`.
    iso_value : float or "auto"
        HU; "auto" is that of `choose_iso_value`, and the reports say why.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    label : int, str or sequence of them, optional
        Labels to extract, as `LabelMap.find` takes them; each must have a surface.  None: all that have one.
    grow_mm : float, optional
        Distance of growth; None is one voxel each way, the 26 neighbours.
    closed : bool
        As `extract_isosurface`.
    solid : bool
        True: fill less dense parts within a label, see ``clrecon.labels.label_levels``.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.  If the slices of all labels do not fit
        together, the labels are processed one by one; the meshes are the same.
    progress : callable, optional
        Called as ``progress("labels", done, total)``.

    Returns
    -------
    dict of int to Mesh
        In the order asked for, else ascending.  ``Mesh.report`` has, beside what `extract_isosurface` says, ``label``,
        ``label_name``, ``label_inside_share`` (of the labelled voxels, in the volume), ``label_ml`` (volume of its
        voxels, on the map's own grid), ``label_taken_ml`` (the same on the grid of the volume),
        ``vertices_by_hu_share``, ``grow_mm`` and ``solid``.

    Raises
    ------
    NoSurfaceError
        A label that was asked for, or every label, has no dense voxel; the message gives the range of its HU.
    UsageError
        The arguments are not a Volume and a LabelMap, a label is unknown, or as `extract_isosurface`.
    RefusedInputError
        The labels do not lie on the volume.
    DeviceError
        As `extract_isosurface`.
    """
    with open_volume(volume, device, memory, "a surface of a label") as resident:
        placed = resident.bring(labels)
        level, chosen = settle_level(resident.volume, iso_value)
        rule = choose_iso_rule(resident.volume, level, closed=closed, values=resident.values)
        marching_cubes.check_row(resident.volume.shape_ijk[0])
        growth = Growth.of(resident.volume, grow_mm)
        for attempt in resident.with_fallback():
            with attempt as (_, warnings):
                run = LabelExtraction(resident, placed, rule, growth, solid, warnings)
                meshes = _make_meshes(run, labels, placed, label, progress or ignore_progress)
    if not meshes:
        raise _refuse_all(resident.volume, placed, labels, rule)
    for mesh in meshes.values():
        mesh.report.update(chosen)
    return meshes


def _refuse_all(volume: Volume, placed: ResampledLabels, labels: LabelMap, rule: IsoRule) -> NoSurfaceError:
    """The error where no label has a surface: none has a dense voxel, or one is all of an open volume."""
    for values, numbers in zip(volume.voxels, placed.voxels, strict=True):
        dense = numbers[(numbers > 0) & rule.mark_inside(values)]
        if dense.size:
            return _refuse_label(volume, placed, labels, rule, int(dense[0]))
    return NoSurfaceError(f"no label has a voxel of {rule.iso_value:g} HU or more in the CT")


def _make_meshes(
    run: LabelExtraction,
    labels: LabelMap,
    placed: ResampledLabels,
    label: Sequence[int | str] | int | str | None,
    progress: Progress,
) -> dict[int, Mesh]:
    chosen = labels.choose(label)
    boxes = find_boxes(placed.voxels, chosen, run.growth.reach)
    refuse = None if label is None else partial(_refuse_label, run.volume, placed, labels, run.rule)
    missing = [number for number in chosen if number not in boxes]
    if missing and refuse is not None:
        raise refuse(missing[0])
    meshes: dict[int, Mesh] = {}
    for number, part in run.extract_each(boxes, progress):
        if part is None:
            if refuse is not None:
                raise refuse(number)
            continue
        report = {**run.describe(), **_describe_label(run.volume, labels, placed, number, boxes[number])}
        meshes[number] = _as_mesh(run, placed, report, part)
    return meshes


def _as_mesh(run: LabelExtraction, placed: ResampledLabels, report: dict[str, Any], part: Part) -> Mesh:
    report["vertices_by_hu_share"] = run.share_by_hu
    warnings = list(placed.warnings)
    if report["label_inside_share"] < 1.0:
        share = 100.0 * (1.0 - report["label_inside_share"])
        warnings.append(
            f"{share:.3g} % of label {report['label']} lie outside the CT: its surface ends where the CT does"
        )
    report["warnings"] += warnings
    positions, normals, triangles = part
    mesh = Mesh(run.placement.to_lps(positions), triangles, normals, report, trusted=True)
    if SKIN_HU[0] <= run.rule.iso_value <= SKIN_HU[1]:
        report["warnings"] += warn_of_skin(run.volume, mesh.vertices, mesh.triangles)
    run.stopwatch = Stopwatch()  # the time of common work counts for the first label
    return mesh


def _describe_label(volume: Volume, labels: LabelMap, placed: ResampledLabels, number: int, box: Box) -> dict[str, Any]:
    return {
        "label": number,
        "label_name": labels.name(number),
        "label_inside_share": placed.inside[number],
        "label_ml": label_ml(labels, number),
        "label_taken_ml": count_ml(placed.voxels, number, box, slice_voxel_ml(volume)),
    }
