"""One extraction of an iso surface, slab by slab of a volume on a device."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon.anatomy.head import warn_of_face
from clrecon.errors import ClreconError, DeviceError, DeviceMemoryError, NoSurfaceError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule, Level, choose_iso_rule, data_range, describe_range
from clrecon.geometry.vertices import warnings_of_far, warnings_of_rule
from clrecon.opencl import Device, Program, Stopwatch, result_pages
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import BrickRanges, BrickStates, brick_bytes, compare_bricks, measure_bricks
from clrecon.operators.surface import marching_cubes
from clrecon.operators.surface.growing import Grown, grow_runs, growing_needs, join_slabs, prepare_growing
from clrecon.operators.surface.marching_cubes import Classified, Counted, Placement, count_output
from clrecon.operators.surface.seeds import Seeds
from clrecon.operators.surface.slabs import BRICKS, SampleGrid, Slab, plan_slabs
from clrecon.operators.surface.trilinear import check_row, prepare_trilinear
from clrecon.system.progress import Progress

Part = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32]]
"""Positions, normals and triangles of one slab."""


class SpanFacts(NamedTuple):
    """How the part of a surface was made, for the report of the whole."""

    label: str
    driver: str
    slabs: int
    device_bytes: dict[str, int]
    seconds: dict[str, float]
    kernel_seconds: dict[str, float]
    warnings: list[str]


SpanPart = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint32], SpanFacts]
"""Positions, normals and triangles of one span of slices, whose indices begin with 0, and how they were made."""


def _refuse_level(device: Device, volume: Volume, rule: IsoRule) -> ClreconError:
    low, high = data_range(volume)
    runs = describe_range(volume, low, high)
    if rule.inside == "between":
        marked = sum(int(np.count_nonzero(rule.mark_inside(voxels))) for voxels in volume.voxels)
        if 0 < marked < volume.voxels.size or (marked and rule.closed):
            return _refuse_device(device, rule, runs)
        how_many = "every" if marked else "no"
        return NoSurfaceError(f"no surface of {rule.describe()}: {how_many} voxel lies within, {runs}")
    if low < rule.lowest_inside <= high:
        return _refuse_device(device, rule, runs)
    relation = "above" if rule.lowest_inside > high else "at or below the lowest of"
    return NoSurfaceError(f"no surface {rule.phrase()}: {runs}, the iso value lies {relation} that range")


def _refuse_device(device: Device, rule: IsoRule, runs: str) -> DeviceError:
    return DeviceError(
        f"{device.label} found no surface {rule.phrase()} although {runs}: it computes wrongly,"
        " see `clrecon selftest` and try another device"
    )


def voxel_level(device: Device, volume: Volume, rule: IsoRule) -> Any:
    """Return the lowest inside value as a scalar of the voxels' type."""
    dtype = volume.voxels.dtype
    if dtype.kind == "f":
        return np.float32(rule.lowest_inside)
    limits = np.iinfo(dtype)
    if rule.lowest_inside > limits.max:
        raise _refuse_level(device, volume, rule)
    return dtype.type(max(rule.lowest_inside, limits.min))


def _voxel_levels(device: Device, volume: Volume, rule: IsoRule) -> tuple[Any, ...]:
    """Return the same and, for a range, the highest inside value."""
    level = voxel_level(device, volume, rule)
    highest, dtype = rule.highest_inside, volume.voxels.dtype
    if highest is None:
        return (level,)
    if dtype.kind == "f":
        return level, np.float32(highest)
    limits = np.iinfo(dtype)
    if highest < max(rule.lowest_inside, limits.min):
        raise _refuse_level(device, volume, rule)
    return level, dtype.type(min(highest, limits.max))


def _join_parts(parts: list[Part]) -> Part:
    """Join the parts of all slabs; each part is freed as soon as it is copied."""
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


_MEASURED_FROM = 2
"""Surface of a volume before which a GPU measures its bricks; a CPU gains less from 40 surfaces of a scan."""


def keep_bricks(resident: DeviceVolume, voxels_d: Any) -> BrickRanges:
    """Return the ranges of the bricks of a whole volume, measured where they are not kept."""
    shape, dtype = resident.volume.shape_ijk, resident.volume.voxels.dtype
    measure = partial(measure_bricks, resident.device, voxels_d, shape, dtype)
    return resident.keep(BRICKS, None, brick_bytes(shape, dtype), measure)


def choose_grid(
    resident: DeviceVolume,
    iso_value: Level,
    *,
    closed: bool,
    topology: str = "separated",
    below: bool,
    vertex_rule: str = "linear",
) -> SampleGrid:
    volume = resident.volume
    rule = choose_iso_rule(
        volume,
        iso_value,
        closed=closed,
        topology=topology,
        below=below,
        vertex_rule=vertex_rule,
        values=resident.values,
    )
    grid = SampleGrid(volume, rule)
    if topology == "trilinear":
        check_row(volume)
    if min(grid.shape) < 2:
        raise NoSurfaceError(f"an open volume of {grid.shape} voxels has no cells: leave it closed")
    return grid


class Extraction:
    """One extraction, slab by slab, as the device has room; with `vertices_only` without triangles.

    span: First and end of the slices of the grid whose part of the surface is made; None: all of them.  Its vertices
        are numbered from 0, and may be none.
    """

    def __init__(
        self,
        resident: DeviceVolume,
        grid: SampleGrid,
        warnings: list[str],
        *,
        vertices_only: bool = False,
        seeds: Seeds | None = None,
        span: tuple[int, int] | None = None,
    ):
        self.resident = resident
        self.device = resident.device
        self.grid = grid
        border = grid.rule.border
        self.placement = resident.keep("places of the samples", border, 0, lambda: Placement.of(grid.volume, border))
        self._vertices_only = vertices_only
        self._seeds = seeds
        self._grown: Grown | None = None
        resident.surfaces += 1
        self.levels = _voxel_levels(resident.device, resident.volume, grid.rule)
        self.stopwatch = Stopwatch()
        self.slabs = self.vertices = self.triangles = 0
        self.first, self._end = span or (0, grid.shape[2])
        self._is_part = span is not None
        self.parts: list[Part] = []
        self.largest = {"volume": 0, "scratch": 0, "output": 0}
        self.warnings = warnings
        self._made_on: dict[tuple[str, str], None] = {}

    def run(self, progress: Progress) -> Part:
        """Build the kernels, and process the grid, as many slices at a time as fit the device."""
        self._run_slabs(self._add_slab, progress)
        if self.vertices == 0 and not self._is_part:
            raise self.refuse_level()
        return self._join()

    def count(self, progress: Progress) -> tuple[int, int]:
        """Count vertices and triangles, as `run` does before it makes them."""
        self._run_slabs(self._count_slab, progress)
        return self.vertices, self.triangles

    def refuse_level(self) -> ClreconError:
        """Return the error for a surface that is nowhere, in words of all values of the volume."""
        return _refuse_level(self.device, self.grid.volume, self.grid.rule)

    def _run_slabs(self, take_slab: Callable[[Slab], None], progress: Progress) -> None:
        rule, volume = self.grid.rule, self.grid.volume
        gk = self.grid.shape[2]
        progress("build", 0, 1)
        with self.stopwatch.timed("build"):
            prepare_isosurface(
                self.device, volume.voxels.dtype, rule.topology, uneven=volume.uneven, inside=rule.inside,
                vertex_rule=rule.vertex_rule, grown=self.grid.grows,
            )  # fmt: skip
            if self.grid.grows:
                prepare_growing(self.device)
        progress("build", 1, 1)
        planned = plan_slabs(self.grid, self.resident)
        for attempt in self.resident.attempts(self.grid.kind, planned, self.warnings):
            with attempt as slices:  # what is done already stays
                if self._seeds is not None and self._grown is None and slices < gk:
                    self._grow(self._seeds, slices)
                while self.first < self._end:
                    take_slab(Slab(self.grid, self.first, min(self.first + slices, self._end)))
                    if self.slabs > 1 or self.first < gk:
                        progress("slabs", self.first, gk)

    def _join(self) -> Part:
        try:
            return _join_parts(self.parts)
        except MemoryError as error:
            raise DeviceError(
                f"the mesh does not fit the memory of this computer ({error}): crop the volume, or write the mesh slab"
                " by slab (docs/mesh.md, meshes larger than the memory)"
            ) from error

    def facts(self) -> SpanFacts:
        """Return what `take_spans` adds to the report of the whole."""
        seconds = dict(self.stopwatch.seconds), dict(self.stopwatch.by_kernel)
        return SpanFacts(self.device.label, self.device.driver, self.slabs, self.largest, *seconds, self.warnings)

    def take_spans(self, spans: Iterable[SpanPart]) -> Part:
        """Join the parts of all spans, in their order, in place of `run`; their indices begin anew, and rise here.

        Of parts that the caller does not keep, nothing is there twice.
        """
        self.parts += map(self.take_span, spans)
        if self.vertices == 0:
            raise self.refuse_level()
        return self._join()

    def take_span(self, span: SpanPart) -> Part:
        """Number the vertices of the next span after those of all before; return its part, which is not kept."""
        positions, normals, triangles, facts = span
        part = positions, normals, triangles + np.uint32(self.vertices)
        self._number(len(positions), len(triangles))
        self.take_facts(facts)
        return part

    def _number(self, vertices: int, triangles: int) -> None:
        self.vertices, self.triangles = self.vertices + vertices, self.triangles + triangles
        if max(self.vertices, self.triangles) >= 2**32:
            raise marching_cubes.too_many(self.vertices, self.triangles)

    def take_facts(self, facts: SpanFacts) -> None:
        """Add how a span was made to the report of the whole."""
        self.slabs += facts.slabs
        self._made_on[facts.label, facts.driver] = None
        for kind, size in facts.device_bytes.items():
            self.largest[kind] = max(self.largest[kind], size)
        for mine, more in ((self.stopwatch.seconds, facts.seconds), (self.stopwatch.by_kernel, facts.kernel_seconds)):
            for name, seconds in more.items():
                mine[name] = mine.get(name, 0.0) + seconds
        self.warnings += [warning for warning in facts.warnings if warning not in self.warnings]

    def _grow(self, seeds: Seeds, slices: int) -> None:
        """Find the cells of the part of the surface that is made, from the bits of the whole grid, slab by slab."""
        gk = self.grid.shape[2]
        needs = {**growing_needs(self.grid), "volume": Slab(self.grid, 0, slices).volume_bytes()}
        shortage = self.resident.shortage(needs)
        if shortage:
            raise DeviceMemoryError(f"a surface cannot be grown: {shortage}")
        slabs = (Slab(self.grid, first, min(first + slices, gk)) for first in range(0, gk, slices))
        with self.stopwatch.running(self.device):
            classified = join_slabs(
                self.resident, self.grid, ((slab, self._classify(slab, *self._bring(slab))) for slab in slabs)
            )
            self._grown = grow_runs(self.resident, self.grid, classified, seeds)

    def _bring(self, slab: Slab) -> tuple[Any, marching_cubes.Classifier]:
        """Return the slab's voxels on the device, and its samples, which a card has marked as their voxels came."""
        classifier = marching_cubes.Classifier(self.device, slab, self.levels)
        if slab.is_whole:
            return self.resident.whole(self.stopwatch, classifier.mark_landed), classifier
        return self.resident.part(*slab.voxel_slices, self.stopwatch, classifier.mark_landed), classifier

    def _classify(self, slab: Slab, voxels_d: Any, classifier: marching_cubes.Classifier) -> Classified:
        return classifier.mark_rest(voxels_d, self._compare_bricks(slab, voxels_d))

    def _add_slab(self, slab: Slab) -> None:
        """Make the part of the surface that belongs to a slab."""
        device, volume = self.device, self.grid.volume
        program = prepare_isosurface(
            device, volume.voxels.dtype, uneven=volume.uneven, inside=self.grid.rule.inside,
            vertex_rule=self.grid.rule.vertex_rule, grown=self._seeds is not None,
        )  # fmt: skip
        counted, voxels_d = self._find_part(slab)
        self._check_output(slab, counted)
        emission = marching_cubes.Emission(device, program, voxels_d, counted, self.placement, self.stopwatch)
        part = emission.run(self.vertices)
        self.parts.append(part)
        self._end_slab(slab, len(part[0]), len(part[2]))

    def _count_slab(self, slab: Slab) -> None:
        counted, _ = self._find_part(slab)
        self._end_slab(slab, counted.vertices, counted.triangles)

    def _end_slab(self, slab: Slab, vertices: int, triangles: int) -> None:
        self.grid.volume.release_slices(*slab.voxel_slices)
        self._number(vertices, triangles)
        self.slabs += 1
        self.first = slab.end

    def _find_part(self, slab: Slab) -> tuple[Counted, Any]:
        """Find and count the part of the surface that belongs to a slab; return the slab's voxels too."""
        device, stopwatch = self.device, self.stopwatch
        voxels_d, classifier = self._bring(slab)
        with stopwatch.running(device):
            if self._grown is not None and slab.is_whole:
                classified = self._grown.classified
            else:
                classified = self._classify(slab, voxels_d, classifier)
            if self._seeds is not None:
                if self._grown is None:
                    self._grown = grow_runs(self.resident, self.grid, classified, self._seeds)
                classified = self._grown.part(classified, slab.first)
            counted = count_output(device, slab, classified, voxels_d)
        return replace(counted, triangles=0) if self._vertices_only else counted, voxels_d

    def _compare_bricks(self, slab: Slab, voxels_d: Any) -> BrickStates | None:
        """Compare the bricks of a whole volume with the only level; None if measuring them is not worth it yet.

        Measuring takes as long as the first pass over the volume, so the first surface of a volume is made without.  So
        are surfaces of ranges and of values below a level: all voxels are read for them.
        """
        waits = self.resident.surfaces < _MEASURED_FROM or self.device.kernel_variants["LANES"] != "1"
        if not slab.is_whole or slab.grid.rule.inside != "above" or (waits and not self.resident.kept_bytes(BRICKS)):
            return None
        ranges = keep_bricks(self.resident, voxels_d)
        return compare_bricks(self.device, ranges, self.levels[0], self.grid.volume.shape_ijk[0], slab.grid.rule.border)

    def _check_output(self, slab: Slab, counted: Counted) -> None:
        """Refuse a slab whose mesh does not fit beside the other buffers; record the memory of the slab."""
        needs = {**slab.needs(counted.output()), **counted.scratch(self.device)}
        bricks_size = self.resident.kept_bytes(BRICKS)
        if slab.is_whole and bricks_size:
            needs[BRICKS] = bricks_size
        shortage = self.resident.shortage(needs, (BRICKS,))
        if shortage:
            raise DeviceMemoryError(shortage)
        output, volume = sum(counted.output().values()), needs["volume"]
        for kind, size in (("volume", volume), ("output", output), ("scratch", sum(needs.values()) - volume - output)):
            self.largest[kind] = max(self.largest[kind], size)

    def _describe_cells(self) -> tuple[dict[str, int], dict[str, Any] | None]:
        """Cells that are visited, of all; of a surface that is grown also the active and the grown ones, and what was
        grown.
        """
        if self._grown is not None:
            return self._grown.report(self.device, self.grid)
        every = math.prod(n - 1 for n in self.grid.shape)
        return {"visited": every, "all": every}, None

    def describe(self, vertices: int, triangles: int) -> dict[str, Any]:
        """Return the report of a mesh: how it was made, without patient data."""
        rule = self.grid.rule
        rule_facts = rule.as_report()
        cells, growing = self._describe_cells()
        return {
            **rule_facts,
            "closed_at_border": rule.closed,
            "topology": rule.topology,
            "outside_hu": rule.outside if rule.closed else None,
            "affine_ijk_to_lps_mm": self.grid.volume.affine.tolist(),
            "cells": cells,
            "growing": growing,
            "certificate": self.grid.volume.report,
            "device": " and ".join(label for label, _ in self._made_on) or self.device.label,
            "driver": " and ".join(driver for _, driver in self._made_on) or self.device.driver,
            "slabs": self.slabs,
            "device_bytes": dict(self.largest),
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
            "warnings": [
                *self.device.warnings,
                *warnings_of_far(self.grid.volume),
                *warn_of_face(self.grid.volume, rule_facts["inside_hu"], "surface"),
                *warnings_of_rule(rule.vertex_rule),
                *self.warnings,
            ],
        }


def prepare_isosurface(
    device: Device,
    dtype: DTypeLike = np.int16,
    topology: str = "separated",
    *,
    uneven: bool = False,
    inside: str = "above",
    vertex_rule: str = "linear",
    grown: bool = False,
) -> Program:
    """Build the kernels of `extract_isosurface` for volumes of `dtype`; `grown`: for parts of a surface."""
    if topology == "trilinear":
        prepare_trilinear(device, dtype)
    return marching_cubes.prepare_marching_cubes(
        device, dtype, uneven=uneven, inside=inside, vertex_rule=vertex_rule, grown=grown
    )
