"""One extraction of surfaces of labels: which samples are inside of which label, and the mesh of each label.

The host side of cl/surface/labels.cl; counting and writing are those of cl/surface/marching_cubes.cl.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule
from clrecon.geometry.precision import describe_far
from clrecon.labels import ResampledLabels
from clrecon.labels.growth import Growth
from clrecon.labels.solid import Box, fill_solid
from clrecon.opencl import (
    Device,
    Program,
    Stopwatch,
    allocate,
    check_budget,
    describe_shortage,
    download,
    launch,
    load_program,
    upload,
)
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.voxel_types import label_variants, voxel_variants
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.cells import Classified, count
from clrecon.operators.surface.extraction import Part, voxel_level
from clrecon.operators.surface.label_groups import Window, group_boxes
from clrecon.operators.surface.marching_cubes import Placement
from clrecon.operators.surface.slabs import SampleGrid

SPARE_SLICES = 3
"""Slices needed beyond a label's box: the far end of a crossed edge, its gradient, and the last slices of the mask."""


@dataclass(frozen=True)
class HeldSlices:
    """The slices of a volume on the device, with the label that each sample is inside of."""

    first: int
    end: int
    voxels_d: Any
    inside_d: Any


def prepare_labels(
    device: Device, dtype: DTypeLike = np.int16, label_dtype: DTypeLike = np.uint8, uneven: bool = False
) -> tuple[Program, Program]:
    """Build the kernels for volumes and labels of these types: those that find what is inside, those of the surface."""
    variants = {**voxel_variants(dtype), **label_variants(label_dtype)}
    own = load_program(device, "surface/labels.cl", variants)
    return own, marching_cubes.prepare_marching_cubes(device, dtype, label_dtype, uneven)


class LabelExtraction:
    """One extraction: the data that its labels share."""

    def __init__(self, resident: DeviceVolume, taken: ResampledLabels, rule: IsoRule, growth: Growth, solid: bool):
        volume, device = resident.volume, resident.device
        self.resident = resident
        self.volume = volume
        self.labels = taken.voxels
        self.rule = rule
        self.growth = growth
        self.device = device
        self.solid = solid
        self.stopwatch = Stopwatch()
        self.groups = 1
        self.share_by_hu = 1.0  # of the vertices of the label that was extracted last
        self.device_bytes: dict[str, int] = {}
        self.grid = SampleGrid(volume, rule)
        self.level = voxel_level(device, volume, rule)
        self.placement = Placement.of(volume, rule.border)
        self.warnings: list[str] = []

    def programs(self) -> tuple[Program, Program]:
        """The kernels, see `prepare_labels`."""
        with self.stopwatch.timed("build"):
            return prepare_labels(self.device, self.resident.dtype, self.labels.dtype, self.volume.uneven)

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
        return not describe_shortage(self.resident.limits, needs | {"mesh": sum(needs.values()) // 2})

    def group(self, boxes: dict[int, Box]) -> list[dict[int, Box]]:
        """Group all labels together if their slices fit the device, else one by one: the meshes are the same."""
        scratch = max(sum(self.window(box, (0, 0)).scratch().values()) for box in boxes.values())
        return group_boxes(boxes, self.needs(*self.slices_for(boxes)), scratch, self.resident.limits)

    def find_inside(self, boxes: dict[int, Box]) -> HeldSlices:
        """Upload the slices that the labels need, and find which samples are inside of which label."""
        device, stopwatch, resident = self.device, self.stopwatch, self.resident
        first, end = self.slices_for(boxes)
        check_budget(device, self.needs(first, end), resident.memory)
        own, _ = self.programs()
        is_whole = end - first == self.volume.shape_ijk[2] and resident.is_held
        voxels_d = resident.whole(stopwatch) if is_whole else resident.part(first, end, stopwatch)
        labels = self.labels[first:end]
        near = self.growth.table
        with stopwatch.timed("upload"):
            labels_d = upload(device, labels)
            near_d = upload(device, near if len(near) else np.zeros((1, 4), np.int32))
        inside_d = allocate(device, labels.nbytes)
        with stopwatch.running(device):
            launch(
                device, own["own_samples"], labels.size, stopwatch=stopwatch,
                voxels=voxels_d, labels=labels_d, near=near_d, inside=inside_d, level=self.level,
                nk=labels.shape[0], nj=labels.shape[1], ni=labels.shape[2], offsets=len(near),
            )  # fmt: skip
        if self.solid:
            inside_d = self._fill(boxes, first, end, inside_d)
        return HeldSlices(first, end, voxels_d, inside_d)

    def _fill(self, boxes: dict[int, Box], first: int, end: int, inside_d: Any) -> Any:
        """Return the inside samples with the labels made solid, on the device again."""
        inside = np.zeros(self.labels.shape, dtype=self.labels.dtype)
        part = inside[first:end]
        with self.stopwatch.timed("download"):
            download(self.device, part, inside_d)
        for number, box in boxes.items():
            fill_solid(inside, self.labels, number, box, self.rule.closed)
        with self.stopwatch.timed("upload"):
            return upload(self.device, part)

    def window(self, box: Box, held: tuple[int, int]) -> Window:
        """Return the slices of the sample grid around a label's box."""
        return Window(self.grid, box[0].start, box[0].stop + 2 * self.rule.border, held)

    def extract_one(self, held: HeldSlices, number: int, box: Box) -> Part | None:
        """Return positions, normals and triangles of one label, None if no sample is inside of it."""
        device, stopwatch, memory = self.device, self.stopwatch, self.resident.memory
        own, surface = self.programs()
        window = self.window(box, (held.first, held.end))
        needs = {**self.needs(held.first, held.end), **window.scratch()}
        check_budget(device, needs, memory, less_may_fit=True)
        mask_d = allocate(device, 4 * window.mask_rows * self.grid.words)
        half_way_d = allocate(device, 4)
        classified = Classified(mask_d, allocate(device, 4 * window.mask_rows))
        with stopwatch.running(device):
            launch(
                device, own["classify_label"], window.mask_rows, stopwatch=stopwatch,
                inside=held.inside_d, mask=mask_d, row_extents=classified.row_extents_d, half_way_count=half_way_d,
                label=number, **window.arguments,
            )  # fmt: skip
            counted = count(device, window, classified, stopwatch)
        if counted.triangles == 0:
            return None
        output = counted.output()
        check_budget(device, {**needs, **output}, memory, less_may_fit=True)
        scratch = window.scratch()
        self.device_bytes = {
            "volume": sum(needs.values()) - sum(scratch.values()),
            "scratch": sum(scratch.values()),
            "output": sum(output.values()),
        }
        part = marching_cubes.emit(
            device, window, surface, held.voxels_d, classified, counted, self.placement, 0, stopwatch,
            {"inside": held.inside_d, "label": number, "half_way_count": half_way_d},
        )  # fmt: skip
        half_way = int(download(device, np.empty(1, np.uint32), half_way_d)[0])
        self.share_by_hu = 1.0 - half_way / counted.vertices
        return part

    def describe(self) -> dict[str, Any]:
        """Return the report entries that all labels share."""
        rule = self.rule
        return {
            **rule.as_report(),
            "surface": "hu",
            "mask_level": None,
            "closed_at_border": rule.closed,
            "outside_hu": rule.outside if rule.closed else None,
            "affine_ijk_to_lps_mm": self.volume.affine.tolist(),
            "certificate": self.volume.report,
            "device": self.device.label,
            "driver": self.device.driver,
            "slabs": self.groups,
            "device_bytes": self.device_bytes,
            "grow_mm": self.growth.grow_mm,
            "solid": self.solid,
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
            "warnings": [
                *self.device.warnings,
                *describe_far(self.volume),
                *_warn_of_uneven_growth(self.volume, self.growth),
                *self.warnings,
            ],
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
