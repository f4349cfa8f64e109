"""A surface by spans of slices, made beside each other on several devices or on workers: the mesh of one, bit for bit.

Each vertex and each cell belongs to the span of its slice.  A span counts the slice behind it, and numbers its vertices
after its own, as the next span does from 0: an index of the whole is that of the span plus the vertices before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import suppress
from contextvars import copy_context
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import IsoRule
from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.extract import choose_grid
from clrecon.operators.surface.extraction import Extraction, SpanPart
from clrecon.operators.surface.slabs import SampleGrid, Slab
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
    positions, normals, triangles = run.take_spans([parts.pop(span) for span in spans])
    report = run.describe(len(positions), len(triangles))
    return Mesh(run.placement.to_lps(positions), triangles, normals, report, trusted=True)


def make_span(resident: DeviceVolume, grid: SampleGrid, span: Span) -> SpanPart:
    """Make the part of a surface that belongs to a span; the slices of its voxels alone are read."""
    run = Extraction(resident, grid, [], span=span)
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
        waiting: SimpleQueue[Span] = SimpleQueue()
        for span in spans[len(self._devices) :]:
            waiting.put(span)
        ready: SimpleQueue[tuple[Span, SpanPart]] = SimpleQueue()

        def make_waiting(device: Device, span: Span) -> None:
            with DeviceVolume(grid.volume, device=device, memory=self._memory) as resident, suppress(Empty):
                while True:
                    ready.put((span, make_span(resident, grid, span)))
                    span = waiting.get_nowait()

        with ThreadPoolExecutor(len(self._devices), thread_name_prefix="spans") as pool:
            threads: set[Future[None]] = {
                pool.submit(copy_context().run, make_waiting, device, span)
                for device, span in zip(self._devices, spans, strict=False)
            }
            try:
                while threads:
                    ended, threads = wait(threads, timeout=0.05, return_when=FIRST_COMPLETED)
                    for thread in ended:
                        thread.result()
                    while not ready.empty():
                        yield ready.get()
                while not ready.empty():
                    yield ready.get()
            finally:
                with suppress(Empty):
                    while True:
                        waiting.get_nowait()


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
    voxels = np.empty(facts.shape, sent.voxels.dtype)
    voxels[sent.first_slice : sent.first_slice + len(sent.voxels)] = sent.voxels
    volume = Volume(voxels, facts.affine, slice_positions=facts.slice_positions)
    with DeviceVolume(volume, device=device, memory=memory) as resident:
        return make_span(resident, SampleGrid(volume, facts.rule), sent.span)
