"""A surface by spans of slices, made beside each other on several devices or on workers: the mesh of one, bit for bit.

Each vertex and each cell belongs to the span of its slice.  A span counts the slice behind it, and numbers its vertices
after its own, as the next span does from 0: an index of the whole is that of the span plus the vertices before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import DeviceError, UsageError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule
from clrecon.geometry.vertices import warnings_of_far
from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.extraction import Extraction, Part, SpanPart, choose_grid
from clrecon.operators.surface.marching_cubes import too_many
from clrecon.operators.surface.slabs import SampleGrid, Slab
from clrecon.system.memory import unreserved_zeros
from clrecon.system.pieces import deal_in_order, find_bounds
from clrecon.system.progress import Progress, ignore_progress

Span = tuple[int, int]
"""First and end of slices of the sample grid."""

MakeSpans = Callable[[SampleGrid, Sequence[Span]], Iterable[tuple[Span, SpanPart]]]
"""Yields each span with its part of the surface, in any order."""

_SPANS_A_DEVICE = 4
"""Devices are not equally fast: each begins with one, and takes another when it is ready."""

_FEWEST_SLICES = 8
"""Three more slices are uploaded for each span."""


def extract_by_spans(
    resident: DeviceVolume,
    level: Any,
    make_spans: MakeSpans,
    count: int,
    *,
    progress: Progress = ignore_progress,
    **how: Any,
) -> Mesh:
    """Extract a surface from about `count` spans; level and `how` as for `SurfaceExtractor.extract`."""
    grid = choose_grid(resident, level, **how)
    slices = grid.shape[2]
    length = max(_FEWEST_SLICES, -(-slices // count))
    spans = [(first, min(first + length, slices)) for first in range(0, slices, length)]
    run = Extraction(resident, grid, [])
    parts: dict[Span, SpanPart] = {}
    ready = 0
    progress("slabs", 0, slices)
    for span, part in make_spans(grid, spans):
        parts[span] = part
        ready += span[1] - span[0]
        progress("slabs", ready, slices)
    positions, normals, triangles = run.take_spans(parts.pop(span) for span in spans)
    report = run.describe(len(positions), len(triangles))
    return Mesh(run.placement.to_lps(positions), triangles, normals, report, trusted=True)


_VOXEL_BYTES, _MESH_BYTES = 2**25, 2**26
"""Most bytes of a span of a surface that is not kept, and at most this share of the memory on the device:"""
_MEMORY_SHARE = 8


class PassingSurface:
    """A surface that is made a span at a time and never whole: counted first, so that its size is known.

    level, how: As for `extract_by_spans`.  The volume is read twice.
    make_spans: Yields the spans in their order; None: the device of the volume makes them.
    vertices, triangles: Their numbers in all spans.
    bounds: (2, 3). Lowest and highest corner of what was made so far, LPS mm.
    """

    def __init__(
        self,
        resident: DeviceVolume,
        level: Any,
        make_spans: MakeSpans | None = None,
        *,
        progress: Progress = ignore_progress,
        **how: Any,
    ):
        self._resident, self._grid = resident, choose_grid(resident, level, **how)
        self._make_spans = make_spans or self._make_in_turn
        self._run = Extraction(resident, self._grid, [])
        if self._run.placement.origin is not None:
            raise UsageError(
                f"{warnings_of_far(resident.volume)[0]}, or float32 where the mesh itself lies near: it is made whole"
            )
        (gi, gj, slices), itemsize = self._grid.shape, resident.volume.voxels.dtype.itemsize
        share = resident.limits.total_bytes // _MEMORY_SHARE
        length = max(_FEWEST_SLICES, min(share, _VOXEL_BYTES) // (gi * gj * itemsize))
        self._spans: list[Span] = []
        self.vertices = self.triangles = 0
        self.bounds = np.array([[np.inf] * 3, [-np.inf] * 3])
        for first in range(0, slices, length):
            span = first, min(first + length, slices)
            vertices, triangles = self._count(span)
            self.vertices, self.triangles = self.vertices + vertices, self.triangles + triangles
            self._spans += _cut_span(span, -(-(24 * vertices + 12 * triangles) // min(share, _MESH_BYTES)))
            progress("count", span[1], slices)
        if max(self.vertices, self.triangles) >= 2**32:
            raise too_many(self.vertices, self.triangles)
        if self.vertices == 0:
            raise self._run.refuse_level()

    def _count(self, span: Span) -> tuple[int, int]:
        for attempt in self._resident.with_fallback():
            with attempt as (_, warnings):
                run = Extraction(self._resident, self._grid, warnings, span=span)
                counts = run.count(ignore_progress)
                self._run.take_facts(run.facts()._replace(slabs=0))
        return counts

    def _make_in_turn(self, grid: SampleGrid, spans: Sequence[Span]) -> Iterator[tuple[Span, SpanPart]]:
        for span in spans:
            for attempt in self._resident.with_fallback():
                with attempt as (_, warnings):
                    span_part = make_span(self._resident, grid, span, warnings)
            yield span, span_part
            del span_part

    def parts(self, progress: Progress = ignore_progress) -> Iterator[Part]:
        """Yield positions, normals and triangles of each span, whose indices are those of the whole; once."""
        progress("slabs", 0, self._grid.shape[2])
        for span, span_part in self._make_spans(self._grid, self._spans):
            part = self._run.take_span(span_part)
            del span_part
            self._widen(part[0])
            yield part
            del part
            progress("slabs", span[1], self._grid.shape[2])
        if (self._run.vertices, self._run.triangles) != (self.vertices, self.triangles):
            raise DeviceError(
                f"{self._resident.device.label} counted {self.vertices:,} vertices and {self.triangles:,} triangles and"
                f" made {self._run.vertices:,} and {self._run.triangles:,}: it computes wrongly, see `clrecon selftest`"
            )

    def _widen(self, positions: NDArray[np.float32]) -> None:
        if len(positions):
            low, high = find_bounds(positions)
            self.bounds = np.array([np.minimum(low, self.bounds[0]), np.maximum(high, self.bounds[1])])

    def describe(self) -> dict[str, Any]:
        """Return the report of a mesh: how it was made so far."""
        return self._run.describe(self.vertices, self.triangles)


def _cut_span(span: Span, count: int) -> list[Span]:
    """Cut a span into `count` parts of about as many slices, at most one a slice."""
    first, end = span
    length = -(-(end - first) // max(count, 1))
    return [(start, min(start + length, end)) for start in range(first, end, length)]


def make_span(resident: DeviceVolume, grid: SampleGrid, span: Span, warnings: list[str] | None = None) -> SpanPart:
    """Make the part of a surface that belongs to a span; the slices of its voxels alone are read."""
    run = Extraction(resident, grid, [] if warnings is None else warnings, span=span)
    positions, normals, triangles = run.run(ignore_progress)
    return positions, normals, triangles, run.facts()


class DeviceSpans:
    """Spans on devices of this machine, each with a thread that takes one span after another."""

    def __init__(self, devices: Sequence[Device], memory: int | None):
        self._devices, self._memory = devices, memory

    @property
    def count(self) -> int:
        """Spans to cut."""
        return _SPANS_A_DEVICE * len(self._devices)

    def __call__(self, grid: SampleGrid, spans: Sequence[Span]) -> Iterator[tuple[Span, SpanPart]]:
        """Yield the spans in their order."""
        with ExitStack() as stack:
            residents = [
                stack.enter_context(DeviceVolume(grid.volume, device=device, memory=self._memory))
                for device in self._devices
            ]
            makers = [partial(make_span, resident, grid) for resident in residents]
            with closing(deal_in_order(makers, spans)) as parts:
                yield from zip(spans, parts, strict=True)


class SentSpan(NamedTuple):
    """A span, and the slices of voxels that it needs, the first of which has the number `first_slice`."""

    span: Span
    first_slice: int
    voxels: NDArray[Any]


class GridFacts(NamedTuple):
    """All of a volume but its voxels, and the rule of the surface: what makes the grid again in another process."""

    shape: tuple[int, ...]
    affine: NDArray[np.float64]
    slice_positions: NDArray[np.float64] | None
    rule: IsoRule


def cut_voxels(grid: SampleGrid, span: Span) -> SentSpan:
    """Read the voxels of a span, for a worker that has no other part of the volume."""
    first, end = Slab(grid, *span).voxel_slices
    return SentSpan(span, first, np.ascontiguousarray(grid.volume.voxels[first:end]))


def make_sent_span(sent: SentSpan, facts: GridFacts, device: Device, memory: int | None) -> SpanPart:
    """Make a part of a surface from the voxels that were sent; of the others no page is touched."""
    voxels = unreserved_zeros(facts.shape, sent.voxels.dtype)
    voxels[sent.first_slice : sent.first_slice + len(sent.voxels)] = sent.voxels
    volume = Volume(voxels, facts.affine, slice_positions=facts.slice_positions)
    with DeviceVolume(volume, device=device, memory=memory) as resident:
        return make_span(resident, SampleGrid(volume, facts.rule), sent.span)
