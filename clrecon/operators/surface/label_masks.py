"""Surfaces of label masks: smoothed occupancy places the vertices, at the level that keeps the volume."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceMemoryError, RefusedInputError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule
from clrecon.geometry.vertices import warnings_of_far
from clrecon.labels import LabelMap
from clrecon.labels.label_levels import (
    FACES_PER_AREA,
    FULL,
    KEEP,
    REACH,
    STEEPNESS,
    Borders,
    Box,
    choose_levels,
    count_faces,
    find_boxes,
    find_enclosed,
    label_ml,
    level_biases,
    next_level,
)
from clrecon.mesh import Mesh
from clrecon.mesh.compare.mesh_gates import judge_label_volume
from clrecon.mesh.triangles import enclosed_ml
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.resident.tables import label_variants
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.extraction import Part
from clrecon.operators.surface.labels import ExtractionByLabel
from clrecon.operators.surface.marching_cubes import Counted, Placement, count_output
from clrecon.operators.surface.slabs import SampleGrid
from clrecon.system.arguments import explains_arguments
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.progress import Progress, ignore_progress


def survey_labels(
    labels: LabelMap, device: Device, memory: int | None, stopwatch: Stopwatch
) -> tuple[dict[int, Box], NDArray[np.integer[Any]]]:
    """Return the box (k, j, i) of each label, one at least, with samples around it, and counted faces."""
    try:
        surveyed = _survey(labels, device, memory, stopwatch)
    except DeviceMemoryError:
        surveyed = None  # without room on the device, numpy computes it
    if surveyed is not None:
        return surveyed
    voxels, size = labels.voxels, labels.numbers[-1] + 1
    none = np.zeros((size, 2), np.uint32)
    faces = count_faces(voxels) if len(labels.numbers) > 1 else none
    return find_boxes(voxels, labels.numbers, (0, 0, 0)), faces


def _survey(
    labels: LabelMap, device: Device, memory: int | None, stopwatch: Stopwatch
) -> tuple[dict[int, Box], NDArray[np.integer[Any]]] | None:
    """Compute the same on the device; None if it has no room."""
    voxels, size = labels.voxels, labels.numbers[-1] + 1
    boxes, faces = np.empty((size, 6), np.int32), np.zeros((size, 2), np.uint32)
    touch = len(labels.numbers) > 1
    needs = {"labels": voxels.nbytes, "boxes": boxes.nbytes, "faces": faces.nbytes}
    if ocl.describe_shortage(ocl.memory_limits(device, memory), needs):
        return None
    with stopwatch.timed("build"):
        program = ocl.load_program(device, "surface/label_survey.cl", label_variants(voxels.dtype))
    with stopwatch.timed("upload"):
        map_d = ocl.upload(device, voxels)
    boxes_d, faces_d = ocl.allocate(device, boxes.nbytes), ocl.allocate(device, faces.nbytes)
    ni, nj, nk = labels.shape_ijk
    grid: dict[str, Any] = {"map": map_d, "ni": ni, "nj": nj, "nk": nk}
    with stopwatch.running(device):
        ocl.launch(device, program["clear_survey"], size, boxes=boxes_d, faces=faces_d, labels=size)
        ocl.launch(device, program["find_boxes"], nj * nk, boxes=boxes_d, **grid)
        if touch:
            ocl.launch(device, program["count_faces"], nj * nk, faces=faces_d, **grid)
    return _widen(ocl.download(device, boxes, boxes_d), labels.numbers, (ni, nj, nk)), ocl.download(
        device, faces, faces_d
    )


def _widen(table: NDArray[np.int32], numbers: Sequence[int], shape_ijk: tuple[int, int, int]) -> dict[int, Box]:
    """Widen the boxes of a table of lowest and highest i, j, k by one sample each way, within the map."""
    boxes: dict[int, Box] = {}
    for number in numbers:
        low, high = np.maximum(table[number, :3] - 1, 0), np.minimum(table[number, 3:] + 2, shape_ijk)
        i, j, k = (slice(int(begin), int(end)) for begin, end in zip(low, high, strict=True))
        boxes[number] = (k, j, i)
    return boxes


SPARE_SLICES = 3 + REACH
"""Slices needed beyond a label's box: slices of the mask, gradients, and their occupancy."""

_TRIANGLES_PER_SUM = 256
_SAMPLES_PER_FLAGS = 32 * ocl.kernel_constant("surface/label_masks.cl", "STRIP")
"""Samples of a row that one word of flags tells of: 32 strips."""


def prepare_label_masks(device: Device, label_dtype: DTypeLike = np.uint8) -> tuple[Program, Program]:
    """Build the kernels for labels of this type: those of the occupancy and those of the surface."""
    variants = label_variants(label_dtype)
    program = ocl.load_program(device, "surface/label_masks.cl", {"VOXEL": "short", "VALUE": "int", **variants})
    return program, marching_cubes.prepare_marching_cubes(device, np.int16, {"MASKS": "1", **variants})


@dataclass(frozen=True)
class HeldMap:
    """Slices of a map on the device, and room for the results computed from them."""

    first: int
    end: int
    map_d: Any
    rows_d: Any
    strips_d: Any
    occupancy_d: Any
    occupied_d: Any


class MaskExtraction(ExtractionByLabel[HeldMap, tuple[Part, int]]):
    """One extraction: the data that its labels share."""

    def __init__(self, labels: LabelMap, device: Device, memory: int | None, closed: bool, warnings: list[str]):
        grid = SampleGrid(Volume(labels.voxels, labels.affine), IsoRule(0.5, FULL // 2, FULL / 2, 0.0, closed))
        placement = Placement.of(grid.volume, grid.rule.border)
        frames = placement.slice_frames.copy()
        frames[:, 2, 3] = np.maximum(frames[:, 2, 3], KEEP)
        placement = replace(placement, slice_frames=frames, margin=np.maximum(placement.margin, np.float32(KEEP)))
        super().__init__(device, memory, grid, placement, warnings)
        self.labels = labels
        self.levels: dict[int, int] = {}

    def programs(self) -> tuple[Program, Program]:
        with self.stopwatch.timed("build"):
            return prepare_label_masks(self.device, self.labels.voxels.dtype)

    @property
    def has_neighbours(self) -> bool:
        """True where there is more than one label, so that two may touch."""
        return len(self.labels.numbers) > 1

    def slices_for(self, boxes: dict[int, Box]) -> tuple[int, int]:
        """Return first and end of the slices of the map that these labels need."""
        first = max(0, min(box[0].start for box in boxes.values()) - SPARE_SLICES)
        return first, min(self.labels.shape_ijk[2], max(box[0].stop for box in boxes.values()) + SPARE_SLICES)

    def needs(self, first: int, end: int) -> dict[str, int]:
        samples = self.labels.voxels[first:end].size
        return {
            "labels": samples * self.labels.voxels.itemsize,
            "row sums": 2 * samples,
            "strips": self.strip_bytes(end - first),
            "occupancy": 2 * samples,
            "occupancy of all labels": 2 * samples * self.has_neighbours,
        }

    def strip_bytes(self, slices: int) -> int:
        """Return the bytes of two flags for each 16 samples of a row."""
        ni, nj, _ = self.labels.shape_ijk
        return 8 * -(-ni // _SAMPLES_PER_FLAGS) * nj * slices

    def hold(self, boxes: dict[int, Box]) -> HeldMap:
        """Upload the slices that the labels need, and find the occupancy of all labels."""
        device = self.device
        first, end = self.slices_for(boxes)
        ocl.check_budget(device, self.needs(first, end), self.memory)
        with self.stopwatch.timed("upload"):
            map_d = ocl.upload(device, self.labels.voxels[first:end])
        samples = self.labels.voxels[first:end].size
        rows_d, occupancy_d = ocl.allocate(device, 2 * samples), ocl.allocate(device, 2 * samples)
        occupied_d = ocl.allocate(device, 2 * samples) if self.has_neighbours else occupancy_d
        strips_d = ocl.allocate(device, self.strip_bytes(end - first))
        held_map = HeldMap(first, end, map_d, rows_d, strips_d, occupancy_d, occupied_d)
        if self.has_neighbours:
            around = tuple(
                slice(min(box[axis].start for box in boxes.values()), max(box[axis].stop for box in boxes.values()))
                for axis in range(3)
            )
            with self.stopwatch.running(device):
                self._smooth(held_map, 0, around, occupied_d)  # type: ignore[arg-type]
        return held_map

    def _smooth(self, slab: HeldMap, number: int, box: Box, occupancy_d: Any) -> None:
        """Smooth a label (0: all) to its occupancy in a box and REACH samples around it, which gradients need."""
        ni, nj, nk = self.labels.shape_ijk
        inner = [
            (max(0, part.start - REACH), min(n, part.stop + REACH)) for part, n in zip(box, (nk, nj, ni), strict=True)
        ]
        (begin_k, end_k), (begin_j, end_j), (begin_i, end_i) = inner
        row_j = max(0, begin_j - REACH), min(nj, end_j + REACH)
        row_k = max(slab.first, begin_k - REACH), min(slab.end, end_k + REACH)
        slices = row_k[1] - row_k[0]
        ocl.launch(
            self.device, self.programs()[0]["smooth_rows"], slices * (row_j[1] - row_j[0]), map=slab.map_d,
            rows=slab.rows_d, strips=slab.strips_d, label=number, ni=ni, nj=nj, begin_i=begin_i, end_i=end_i,
            begin_j=row_j[0], end_j=row_j[1], begin_slice=row_k[0] - slab.first, slices=slices,
        )  # fmt: skip
        ocl.launch(
            self.device, self.programs()[0]["smooth_across"], (end_k - begin_k) * (end_j - begin_j), rows=slab.rows_d,
            strips=slab.strips_d, occupancy=occupancy_d, ni=ni, nj=nj, nk=nk, begin_i=begin_i, end_i=end_i,
            begin_j=begin_j, end_j=end_j, first_row_slice=slab.first, first_slice=begin_k, slices=end_k - begin_k,
        )  # fmt: skip

    def keep_enclosed(self, numbers: Sequence[int], boxes: dict[int, Box]) -> None:
        """Find the levels of enclosed labels, which do not depend on the labels that are asked for."""
        chosen_boxes = {number: boxes[number] for number in numbers}
        try:
            self._measure_enclosed(self.group(chosen_boxes), chosen_boxes)
        except DeviceMemoryError as error:
            self.warnings.append(f"{error}: continued with one label at a time")
            self._measure_enclosed([{number: box} for number, box in chosen_boxes.items()], chosen_boxes)

    def _measure_enclosed(self, groups: list[dict[int, Box]], boxes: dict[int, Box]) -> None:
        slab = [self.hold(groups[0])] if len(groups) == 1 else []
        voxel_mm3 = abs(np.linalg.det(self.labels.affine[:3, :3]))

        def measure_levels(levels: dict[int, int]) -> dict[int, float]:
            self.levels = levels
            volumes = {}
            for group in groups:
                there = slab[0] if slab else self.hold(group)
                for number, box in group.items():
                    started = self._start_one(there, number, box)
                    volumes[number] = started.enclosed_mm3(levels[number]) / voxel_mm3
            return volumes

        self.levels = choose_levels(Borders.of(self.labels.voxels, list(boxes), boxes), measure_levels)

    def _start_one(self, slab: HeldMap, number: int, box: Box) -> StartedMesh:
        """Make all of a label's mesh except its vertices, which depend on levels."""
        device, stopwatch = self.device, self.stopwatch
        mask_program, surface = self.programs()
        window = self.window(box, (slab.first, slab.end))
        classified = self.empty_mask(window)
        with stopwatch.running(device):
            self._smooth(slab, number, box, slab.occupancy_d)
            ocl.launch(
                device, mask_program["classify_mask"], window.mask_rows,
                map=slab.map_d, mask=classified.mask_d, row_extents=classified.row_extents_d, label=number,
                begin_j=box[1].start, end_j=box[1].stop, **window.arguments,
            )  # fmt: skip
            counted = count_output(device, window, classified)
        self.check_output(window, counted)
        emission = marching_cubes.Emission(device, surface, slab.occupancy_d, counted, self.placement, stopwatch)
        with stopwatch.running(device):
            emission.triangles()
        return StartedMesh(self, slab, number, box, counted, emission)

    def extract_one(self, slab: HeldMap, number: int, box: Box) -> tuple[Part, int]:
        """Return positions, normals and triangles of one label, and the level that places them."""
        started = self._start_one(slab, number, box)
        level = self.levels.get(number)
        if level is None:
            return started.keep_volume(1000.0 * label_ml(self.labels, number), self.grid.rule.closed)
        started.place(level)
        return started.emission.download(), level

    def describe(self) -> dict[str, Any]:
        return {
            "surface": "mask",
            "closed_at_border": self.grid.rule.closed,
            "affine_ijk_to_lps_mm": self.labels.affine.tolist(),
            **self.facts({}, [*warnings_of_far(self.grid.volume), *self.labels.warnings]),
        }


@dataclass(frozen=True)
class StartedMesh:
    """A label's mesh on the device, whose vertices can be placed at several levels in turn."""

    run: MaskExtraction
    held: HeldMap
    number: int
    box: Box
    counted: Counted
    emission: marching_cubes.Emission

    def place(self, level: int) -> None:
        slab = self.held
        biases_d = ocl.upload(self.run.device, level_biases(self.run.levels, self.run.labels.numbers[-1] + 1))
        with self.run.stopwatch.running(self.run.device):
            self.emission.vertices(level, map=slab.map_d, label=self.number, occupied=slab.occupied_d, biases=biases_d)

    def enclosed_mm3(self, level: int) -> float:
        """Return the volume that the mesh encloses at a level: the device sums pieces, the host the rest."""
        self.place(level)
        device, stopwatch = self.run.device, self.run.stopwatch
        placement = self.run.placement
        middle = [[(part.start + part.stop - 1) / 2 for part in self.box[::-1]]]
        centre = np.zeros(4, np.float32)
        centre[:3] = self.run.labels.ijk_to_lps(middle)[0]
        if placement.origin is not None:
            centre[:3] = self.run.labels.ijk_to_lps(middle)[0] - placement.origin
        triangles = self.counted.triangles
        sums = np.empty(-(-triangles // _TRIANGLES_PER_SUM), np.float32)
        sums_d = ocl.allocate(device, sums.nbytes)
        with stopwatch.running(device):
            ocl.launch(
                device, self.run.programs()[0]["sum_volumes"], len(sums),
                positions=self.emission.positions_d, triangles=self.emission.triangles_d, sums=sums_d, centre=centre,
                triangle_count=triangles, triangles_per_sum=_TRIANGLES_PER_SUM,
            )  # fmt: skip
        return float(ocl.download(device, sums, sums_d).sum(dtype=np.float64)) / 6.0

    def keep_volume(self, wanted: float, closed: bool) -> tuple[Part, int]:
        """Try levels until the mesh has, as nearly as possible, the volume of the label's voxels, mm3."""
        # Every crossed edge belongs to a voxel's face; over all directions there are about 1.5 faces for one face's
        # area.
        area_voxels = self.counted.vertices / FACES_PER_AREA
        mm3_per_level = -area_voxels * abs(np.linalg.det(self.run.labels.affine[:3, :3])) / (STEEPNESS * FULL)
        tried: list[tuple[int, float]] = []
        level = next_level(tried, wanted, mm3_per_level)
        while closed and all(level != earlier for earlier, _ in tried):
            tried.append((level, self.enclosed_mm3(level)))
            following = next_level(tried, wanted, mm3_per_level)
            if following == level:
                return self.emission.download(), level
            level = following
        self.place(level)
        return self.emission.download(), level


@explains_arguments
def extract_label_masks(
    labels: LabelMap,
    *,
    device: Device | str | int | None = None,
    label: Sequence[int | str] | int | str | None = None,
    closed: bool = True,
    memory: int | None = None,
    progress: Progress | None = None,
) -> dict[int, Mesh]:
    """Extract each label's own surface: that of its mask without the steps, with the volume of its voxels.

    Every voxel of the label is inside of its mesh, and no other voxel is, so nothing is lost and nothing joined.
    Vertices lie on the edges between the centres of differing neighbours, within half a voxel of their common face.
    Their place on an edge comes from the occupancy: the mask smoothed by two rounds of [1 2 1] / 4 along each axis.  It
    is where the occupancy crosses the level that gives the mesh the volume of the label's voxels; between two labels it
    is where the leads of both are equal, and both meshes have the same vertices, bit for bit.  At the ends of the map
    the mesh ends flat, at the faces of the voxels.  HU are not used, so bones, organs and air are all possible.

    Parameters
    ----------
    labels : LabelMap
        The surfaces lie on its own grid: nothing is resampled.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    label : int, str or sequence of them, optional
        Labels to extract, as `LabelMap.find` takes them.  None: all that occur.
    closed : bool
        Close the surface where it meets the border of the map.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.  If the slices of all labels do not fit
        together, the labels are processed one by one; the meshes are the same.
    progress : callable, optional
        Called as ``progress("labels", done, total)``.

    Returns
    -------
    dict of int to Mesh
        In the order asked for, else ascending.  Each mesh is closed and manifold.  ``Mesh.report`` has ``surface``
        ("mask"), ``label``, ``label_name``, ``label_ml`` (the volume of its voxels), ``label_mesh_ml`` (what the mesh
        encloses, None where it is open), ``mask_level`` (the share of occupancy at which it lies),
        ``closed_at_border``, the affine, the device, the seconds, and ``warnings``, among them one where the mesh is
        more than 1 % larger or smaller than its label: labels that fill the map, or touch at its ends, cannot all keep
        their volume.

    Raises
    ------
    UsageError
        ``labels`` is not a LabelMap, a label is unknown, or rows of the map are too long.
    RefusedInputError
        The label map is empty.
    DeviceError
        No device, not even one label fits its memory, 2^32 vertices or triangles or more, or the device fails.

    References
    ----------
    Gibson 1998, Constrained elastic surface nets (a surface that is smoothed within the voxels of its mask); Lorensen
    and Cline 1987.
    """
    if not labels.numbers:
        raise RefusedInputError("the label map is empty: no voxel has a label")
    marching_cubes.check_row(labels.shape_ijk[0])
    chosen = labels.choose(label)
    for attempt in ocl.with_fallback(ocl.take_device(device)):
        with attempt as (current, warnings):
            run = MaskExtraction(labels, current, memory, closed, warnings)
            meshes = _make_meshes(run, chosen, progress or ignore_progress)
    return meshes


def warn_of_volume(report: Mapping[str, Any]) -> list[str]:
    """Return a warning where the mesh of a label has not its volume, from the mesh's own report."""
    gate = judge_label_volume(report["label_mesh_ml"], report["label_ml"], by_hu=False)
    if gate.ok is not False:
        return []
    return [f"label {report['label']}: {gate['text']}; labels that fill the map or touch at its ends lose volume there"]


def _make_meshes(run: MaskExtraction, chosen: Sequence[int], progress: Progress) -> dict[int, Mesh]:
    labels = run.labels
    everywhere, faces = survey_labels(labels, run.device, run.memory, run.stopwatch)
    if run.grid.rule.closed and faces[:, 1].any() and (enclosed := find_enclosed(labels.voxels, faces, everywhere)):
        run.keep_enclosed(enclosed, everywhere)
    boxes = {number: everywhere[number] for number in chosen}
    meshes: dict[int, Mesh] = {}
    for number, ((positions, normals, triangles), level) in run.extract_each(boxes, progress):
        of_label = {"label": number, "label_name": labels.name(number), "label_ml": label_ml(labels, number)}
        mesh = Mesh(run.placement.to_lps(positions), triangles, normals, {**run.describe(), **of_label}, trusted=True)
        mesh_ml = enclosed_ml(mesh.vertices, triangles) if run.grid.rule.closed else None
        mesh.report |= {"mask_level": level / FULL, "label_mesh_ml": mesh_ml}
        mesh.report["warnings"] += warn_of_volume(mesh.report)
        meshes[number] = mesh
        run.stopwatch = Stopwatch()  # the time of common work counts for the first label
    return meshes
