"""The surfaces of a mesh job shared out: to all devices of this machine, or to the workers of a Dask scheduler."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from clrecon.errors import DeviceError
from clrecon.geometry import Volume
from clrecon.jobs.cluster import Cluster, Died, open_cluster
from clrecon.jobs.devices import list_usable
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.operators import choose_device
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.slabs import SampleGrid
from clrecon.operators.surface.spans import (
    DeviceSpans,
    GridFacts,
    MakeSpans,
    SentSpan,
    Span,
    SpanPart,
    cut_voxels,
    extract_by_spans,
    make_sent_span,
)
from clrecon.system.progress import Progress

_SPANS_A_WORKER = 4
_MOST_SENT_BYTES = 64e6
"""Voxels that are sent at a time; two of such spans wait for each worker."""


def extract_shared_out(
    volume: Volume, levels: Sequence[Any], device: Device, settings: MeshSettings, progress: Progress
) -> list[Mesh]:
    """Extract the surface of each level by spans of slices; the meshes are those of one device, bit for bit."""
    how = {"closed": settings.closed, "topology": settings.topology, "below": settings.below is not None}
    with (
        DeviceVolume(volume, device=device, memory=settings.memory) as resident,
        _open_makers(volume, settings, progress) as (make_spans, count),
    ):
        return [extract_by_spans(resident, level, make_spans, count, progress=progress, **how) for level in levels]


@contextmanager
def open_spans_in_order(volume: Volume, settings: MeshSettings, progress: Progress) -> Iterator[MakeSpans | None]:
    """Yield what makes spans in their order; None where the device of the volume does."""
    if not settings.is_shared_out:
        yield None
        return
    with _open_makers(volume, settings, progress) as (make_spans, _):
        yield make_spans.make_in_order if isinstance(make_spans, ClusterSpans) else make_spans


@contextmanager
def _open_makers(volume: Volume, settings: MeshSettings, progress: Progress) -> Iterator[tuple[Any, int]]:
    """Yield what makes spans, and how many of them to cut."""
    devices = list_usable() if settings.uses_all_devices else None
    if settings.scheduler is None:
        assert devices is not None
        spans = DeviceSpans(devices, settings.memory)
        yield spans, spans.count
        return
    names = [settings.device] if devices is None else [str(device.index) for device in devices]
    with open_cluster(settings.scheduler, names, lambda text: progress(text, 0, 0)) as cluster:
        fewest = int(volume.voxels.nbytes / _MOST_SENT_BYTES) + 1
        yield ClusterSpans(cluster, settings.memory), max(fewest, _SPANS_A_WORKER * cluster.count_workers())


class ClusterSpans:
    """Spans on the workers of a cluster, which get their voxels with the task and need no files."""

    def __init__(self, cluster: Cluster, memory: int | None):
        self._cluster, self._memory = cluster, memory

    def __call__(self, grid: SampleGrid, spans: Sequence[Span]) -> Iterator[tuple[Span, SpanPart]]:
        volume = grid.volume
        positions = volume.slice_origins() if volume.uneven else None
        facts = GridFacts(volume.voxels.shape, volume.affine, positions, grid.rule)
        sent = (cut_voxels(grid, span) for span in spans)
        for item, part in self._cluster.run_tasks(make_on_worker, sent, facts, self._memory):
            if isinstance(part, Died):
                raise DeviceError(f"slices {item.span[0]} to {item.span[1] - 1} cannot be done: {part.message}")
            volume.release_slices(item.first_slice, item.first_slice + len(item.voxels))
            yield item.span, part

    def make_in_order(self, grid: SampleGrid, spans: Sequence[Span]) -> Iterator[tuple[Span, SpanPart]]:
        """Make a few spans for each worker at a time, and yield them in order: no others wait in memory."""
        count = _SPANS_A_WORKER * max(self._cluster.count_workers(), 1)
        for first in range(0, len(spans), count):
            parts = dict(self(grid, spans[first : first + count]))
            yield from ((span, parts.pop(span)) for span in sorted(parts))


def make_on_worker(sent: SentSpan, facts: GridFacts, memory: int | None) -> SpanPart:
    """Make the part of a span on the device of this worker."""
    return make_sent_span(sent, facts, choose_device(), memory)
