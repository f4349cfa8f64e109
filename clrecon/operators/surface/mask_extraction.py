"""One extraction of surfaces of label masks: the occupancy of each label, its mesh, and the level that keeps its
volume.

The host side of cl/surface/label_masks.cl; counting and writing are those of cl/surface/marching_cubes.cl.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from clrecon.errors import DeviceMemoryError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule
from clrecon.geometry.precision import describe_far
from clrecon.labels import LabelMap
from clrecon.labels.enclosed import FACES_PER_AREA, Borders, choose_levels, level_biases
from clrecon.labels.occupancy import FULL, KEEP, REACH, STEEPNESS, next_level
from clrecon.labels.solid import Box
from clrecon.labels.volumes import label_ml
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    check_budget,
    download,
    kernel_constant,
    launch,
    load_program,
    memory_limits,
    upload,
)
from clrecon.operators.resident.voxel_types import label_variants
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.cells import Classified, Counted, count
from clrecon.operators.surface.extraction import Part
from clrecon.operators.surface.label_groups import Window, group_boxes
from clrecon.operators.surface.marching_cubes import Placement
from clrecon.operators.surface.slabs import SampleGrid

SPARE_SLICES = 3 + REACH
"""Slices needed beyond a label's box: slices of the mask, gradients, and their occupancy."""

TRIANGLES_PER_SUM = 256
SAMPLES_PER_FLAGS = 32 * kernel_constant("surface/label_masks.cl", "STRIP")
"""Samples of a row that one word of flags tells of: 32 strips."""


def prepare_label_masks(device: Device, label_dtype: DTypeLike = np.uint8) -> tuple[Program, Program]:
    """Build the kernels for labels of this type: those of the occupancy and those of the surface."""
    own = load_program(
        device, "surface/label_masks.cl", {"VOXEL": "short", "VALUE": "int", **label_variants(label_dtype)}
    )
    return own, marching_cubes.prepare_marching_cubes(device, np.int16, label_dtype, masks=True)


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


class MaskExtraction:
    """One extraction: the data that its labels share."""

    def __init__(self, labels: LabelMap, device: Device, memory: int | None, closed: bool):
        self.labels = labels
        self.device = device
        self.memory = memory
        self.stopwatch = Stopwatch()
        self.groups = 1
        self.device_bytes: dict[str, int] = {}
        self.grid = SampleGrid(Volume(labels.voxels, labels.affine), IsoRule(0.5, FULL // 2, FULL / 2, 0.0, closed))
        placement = Placement.of(self.grid.volume, self.grid.rule.border)
        frames = placement.slice_frames.copy()
        frames[:, 2, 3] = np.maximum(frames[:, 2, 3], KEEP)
        self.placement = replace(placement, slice_frames=frames, margin=np.maximum(placement.margin, np.float32(KEEP)))
        self.levels: dict[int, int] = {}
        self.warnings: list[str] = []

    def programs(self) -> tuple[Program, Program]:
        """The kernels, see `prepare_label_masks`."""
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
        """Return the bytes on the device for these slices."""
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
        return 8 * -(-ni // SAMPLES_PER_FLAGS) * nj * slices

    def group(self, boxes: dict[int, Box]) -> list[dict[int, Box]]:
        """Group all labels together if their slices fit the device, else one by one: the meshes are the same."""
        scratch = max(sum(self.window(box, (0, 0)).scratch().values()) for box in boxes.values())
        return group_boxes(boxes, self.needs(*self.slices_for(boxes)), scratch, memory_limits(self.device, self.memory))

    def hold(self, boxes: dict[int, Box]) -> HeldMap:
        """Upload the slices that the labels need, and find the occupancy of all labels."""
        device = self.device
        first, end = self.slices_for(boxes)
        check_budget(device, self.needs(first, end), self.memory)
        with self.stopwatch.timed("upload"):
            map_d = upload(device, self.labels.voxels[first:end])
        samples = self.labels.voxels[first:end].size
        rows_d, occupancy_d = allocate(device, 2 * samples), allocate(device, 2 * samples)
        occupied_d = allocate(device, 2 * samples) if self.has_neighbours else occupancy_d
        strips_d = allocate(device, self.strip_bytes(end - first))
        held = HeldMap(first, end, map_d, rows_d, strips_d, occupancy_d, occupied_d)
        if self.has_neighbours:
            around = tuple(
                slice(min(box[axis].start for box in boxes.values()), max(box[axis].stop for box in boxes.values()))
                for axis in range(3)
            )
            with self.stopwatch.running(device):
                self._smooth(held, 0, around, occupied_d)  # type: ignore[arg-type]
        return held

    def _smooth(self, held: HeldMap, number: int, box: Box, occupancy_d: Any) -> None:
        """Smooth a label (0: all) to its occupancy in a box and REACH samples around it, which gradients need."""
        ni, nj, nk = self.labels.shape_ijk
        inner = [
            (max(0, part.start - REACH), min(n, part.stop + REACH)) for part, n in zip(box, (nk, nj, ni), strict=True)
        ]
        (begin_k, end_k), (begin_j, end_j), (begin_i, end_i) = inner
        row_j = max(0, begin_j - REACH), min(nj, end_j + REACH)
        row_k = max(held.first, begin_k - REACH), min(held.end, end_k + REACH)
        slices = row_k[1] - row_k[0]
        launch(
            self.device, self.programs()[0]["smooth_rows"], slices * (row_j[1] - row_j[0]), stopwatch=self.stopwatch,
            map=held.map_d, rows=held.rows_d, strips=held.strips_d, label=number, ni=ni, nj=nj,
            begin_i=begin_i, end_i=end_i, begin_j=row_j[0], end_j=row_j[1], begin_slice=row_k[0] - held.first,
            slices=slices,
        )  # fmt: skip
        launch(
            self.device, self.programs()[0]["smooth_across"], (end_k - begin_k) * (end_j - begin_j),
            stopwatch=self.stopwatch,
            rows=held.rows_d, strips=held.strips_d, occupancy=occupancy_d, ni=ni, nj=nj, nk=nk,
            begin_i=begin_i, end_i=end_i, begin_j=begin_j, end_j=end_j, first_row_slice=held.first,
            first_slice=begin_k, slices=end_k - begin_k,
        )  # fmt: skip

    def window(self, box: Box, held: tuple[int, int]) -> Window:
        """Return the slices of the sample grid around a label's box."""
        return Window(self.grid, box[0].start, box[0].stop + 2 * self.grid.rule.border, held)

    def keep_enclosed(self, numbers: Sequence[int], boxes: dict[int, Box]) -> None:
        """Find the levels of enclosed labels, which do not depend on the labels that are asked for."""
        own = {number: boxes[number] for number in numbers}
        try:
            self._measure_enclosed(self.group(own), own)
        except DeviceMemoryError as error:
            self.warnings.append(f"{error}: continued with one label at a time")
            self._measure_enclosed([{number: box} for number, box in own.items()], own)

    def _measure_enclosed(self, groups: list[dict[int, Box]], boxes: dict[int, Box]) -> None:
        held = [self.hold(groups[0])] if len(groups) == 1 else []
        voxel_mm3 = abs(np.linalg.det(self.labels.affine[:3, :3]))

        def measure(levels: dict[int, int]) -> dict[int, float]:
            self.levels = levels
            found = {}
            for group in groups:
                there = held[0] if held else self.hold(group)
                for number, box in group.items():
                    started = self._start_one(there, number, box)
                    found[number] = started.enclosed_mm3(levels[number]) / voxel_mm3
            return found

        self.levels = choose_levels(Borders.of(self.labels.voxels, list(boxes), boxes), measure)

    def _start_one(self, held: HeldMap, number: int, box: Box) -> StartedMesh:
        """Make all of a label's mesh except its vertices, which depend on levels."""
        device, stopwatch = self.device, self.stopwatch
        own, surface = self.programs()
        window = self.window(box, (held.first, held.end))
        needs = {**self.needs(held.first, held.end), **window.scratch()}
        check_budget(device, needs, self.memory, less_may_fit=True)
        mask_d = allocate(device, 4 * window.mask_rows * self.grid.words)
        classified = Classified(mask_d, allocate(device, 4 * window.mask_rows))
        with stopwatch.running(device):
            self._smooth(held, number, box, held.occupancy_d)
            launch(
                device, own["classify_mask"], window.mask_rows, stopwatch=stopwatch,
                map=held.map_d, mask=mask_d, row_extents=classified.row_extents_d, label=number,
                begin_j=box[1].start, end_j=box[1].stop, **window.arguments,
            )  # fmt: skip
            counted = count(device, window, classified, stopwatch)
        output = counted.output()
        check_budget(device, {**needs, **output}, self.memory, less_may_fit=True)
        scratch = window.scratch()
        self.device_bytes = {
            "volume": sum(needs.values()) - sum(scratch.values()),
            "scratch": sum(scratch.values()),
            "output": sum(output.values()),
        }
        emission = marching_cubes.Emission(
            device, window, surface, held.occupancy_d, classified, counted, self.placement, stopwatch
        )
        with stopwatch.running(device):
            emission.triangles()
        return StartedMesh(self, held, number, box, counted, emission)

    def extract_one(self, held: HeldMap, number: int, box: Box) -> tuple[Part, int]:
        """Return positions, normals and triangles of one label, and the level that places them."""
        started = self._start_one(held, number, box)
        level = self.levels.get(number)
        if level is None:
            return started.keep_volume(1000.0 * label_ml(self.labels, number), self.grid.rule.closed)
        started.place(level)
        return started.emission.download(), level

    def describe(self) -> dict[str, Any]:
        """Return the report entries that all labels share."""
        return {
            "surface": "mask",
            "closed_at_border": self.grid.rule.closed,
            "affine_ijk_to_lps_mm": self.labels.affine.tolist(),
            "device": self.device.label,
            "driver": self.device.driver,
            "slabs": self.groups,
            "device_bytes": self.device_bytes,
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
            "warnings": [*self.device.warnings, *describe_far(self.grid.volume), *self.labels.warnings, *self.warnings],
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
        """Write the vertices at this level."""
        held = self.held
        biases_d = upload(self.run.device, level_biases(self.run.levels, self.run.labels.numbers[-1] + 1))
        with self.run.stopwatch.running(self.run.device):
            self.emission.vertices(level, map=held.map_d, label=self.number, occupied=held.occupied_d, biases=biases_d)

    def enclosed_mm3(self, level: int) -> float:
        """Return the volume that the mesh encloses at a level: the device sums some hundred triangles at a time, the
        host the rest.
        """
        self.place(level)
        device, stopwatch, placement = self.run.device, self.run.stopwatch, self.run.placement
        middle = [[(part.start + part.stop - 1) / 2 for part in self.box[::-1]]]
        centre = np.zeros(4, np.float32)
        centre[:3] = self.run.labels.ijk_to_lps(middle)[0]
        if placement.origin is not None:
            centre[:3] = self.run.labels.ijk_to_lps(middle)[0] - placement.origin
        triangles = self.counted.triangles
        sums = np.empty(-(-triangles // TRIANGLES_PER_SUM), np.float32)
        sums_d = allocate(device, sums.nbytes)
        with stopwatch.running(device):
            launch(
                device, self.run.programs()[0]["sum_volumes"], len(sums), stopwatch=stopwatch,
                positions=self.emission.positions_d, triangles=self.emission.triangles_d, sums=sums_d, centre=centre,
                triangle_count=triangles, triangles_per_sum=TRIANGLES_PER_SUM,
            )  # fmt: skip
        return float(download(device, sums, sums_d).sum(dtype=np.float64)) / 6.0

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
