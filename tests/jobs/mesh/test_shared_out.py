"""Surfaces by spans of slices: the arrays of one device, from sent voxels, all devices, and workers that are killed."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_files import write_nifti
from refusals import refused
from volume_files import write_ome_zarr

from clrecon import Mesh, Volume, extract_isosurface
from clrecon.cli.main import main
from clrecon.errors import NoSurfaceError, UsageError
from clrecon.jobs.cluster import LOCAL, open_cluster
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.workers import ClusterSpans
from clrecon.opencl import Device, list_devices
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.extraction import choose_grid
from clrecon.operators.surface.slabs import SampleGrid
from clrecon.operators.surface.spans import (
    DeviceSpans,
    GridFacts,
    Span,
    SpanPart,
    cut_voxels,
    extract_by_spans,
    make_sent_span,
    make_span,
)
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.system.memory import physical_memory_bytes

SLICES = 40
AFFINE = np.array([[0.7, 0, 0.1, -90], [0, 0.7, 0.2, 30], [0, 0, 1.5, 700], [0, 0, 0, 1]], float)
FAR = AFFINE + [[0, 0, 0, 5000.0], [0] * 4, [0] * 4, [0] * 4]
"""Beyond 4096 mm vertices are float64."""


def make_noise(dtype: Any = np.int16, **place: Any) -> Volume:
    """Smooth structures over all slices with noise, so that each span has vertices and ambiguous cells."""
    k, j, i = np.meshgrid(*map(np.arange, (SLICES, 22, 26)), indexing="ij")
    waves = 300 * np.sin(k / 3) * np.cos(j / 4) * np.sin(i / 5)
    noise = np.random.default_rng(48).normal(0, 60, waves.shape)
    return Volume((waves + noise).astype(dtype), AFFINE, **place)


SPANS = 5
"""Of the 40 slices: 8 each, the fewest that a span gets."""


def uneven_places() -> dict[str, Any]:
    """Keywords of a volume whose slices lie up to 0.3 of a step off even ones."""
    steps = np.arange(SLICES) + 0.3 * np.sin(np.arange(SLICES))
    return {"slice_positions": AFFINE[:3, 3] + steps[:, None] * AFFINE[:3, 2]}


CASES: dict[str, tuple[Volume, Any, dict[str, Any]]] = {
    "integers": (make_noise(), 100, {}),
    "floats": (make_noise(np.float32), 100.25, {}),
    "uneven slices": (make_noise(**uneven_places()), 100, {}),
    "open at the border": (make_noise(), 100, {"closed": False}),
    "trilinear": (make_noise(), 100, {"topology": "trilinear"}),
    "a range": (make_noise(), (50, 200), {}),
    "below a level": (make_noise(), 100, {"below": True}),
    "far from the origin": (Volume(make_noise().voxels, FAR), 100, {}),
}


def by_sent_spans(volume: Volume, level: Any, device: Device, **how: Any) -> Mesh:
    """Extract the surface from voxels as workers get them, the last span first."""

    def make_spans(grid: SampleGrid, spans: Sequence[Span]) -> Iterator[tuple[Span, SpanPart]]:
        positions = volume.slice_origins() if volume.uneven else None
        facts = GridFacts(volume.voxels.shape, volume.affine, positions, grid.rule)
        assert len(spans) == SPANS
        for span in reversed(spans):
            yield span, make_sent_span(cut_voxels(grid, span), facts, device, memory=None)

    with DeviceVolume(volume, device=device) as resident:
        return extract_by_spans(resident, level, make_spans, SPANS, **{"closed": True, "below": False} | how)


def assert_same_arrays(mesh: Mesh, expected: Mesh) -> None:
    for name in ("vertices", "normals", "triangles"):
        assert getattr(mesh, name).dtype == getattr(expected, name).dtype
        assert np.array_equal(getattr(mesh, name), getattr(expected, name)), name


@pytest.mark.parametrize("case", CASES)
def test_surface_from_sent_spans_has_the_arrays_of_one_extraction(case: str, device: Device) -> None:
    volume, level, how = CASES[case]
    assert_same_arrays(
        by_sent_spans(volume, level, device, **how), extract_isosurface(volume, level, device=device, **how)
    )


@pytest.mark.skipif(sys.platform != "linux", reason="pages that take no memory until they are written")
def test_span_of_a_volume_larger_than_memory_is_made_of_its_slices_alone(device: Device) -> None:
    voxels = np.random.default_rng(1).integers(-1000, 1000, (11, 512, 512)).astype(np.int16)
    volume = Volume(voxels, AFFINE)
    span, shape = (3, 9), (500_000, 512, 512)  # 262 GB
    assert shape[0] * voxels[0].nbytes > physical_memory_bytes()
    with DeviceVolume(volume, device=device) as resident:
        grid = choose_grid(resident, 990, closed=True, below=False)
        expected = make_span(resident, grid, span)
    facts = GridFacts(shape, volume.affine, None, grid.rule)
    _, _, triangles, _ = make_sent_span(cut_voxels(grid, span), facts, device, memory=None)
    assert len(triangles)
    assert np.array_equal(triangles, expected[2])


def test_surface_that_no_span_has_is_refused_like_that_of_one_extraction(device: Device) -> None:
    above_all_values = 5000

    with refused(NoSurfaceError, above_all_values):
        by_sent_spans(make_noise(), above_all_values, device)


def test_surface_on_all_devices_has_the_arrays_of_one(device: Device) -> None:
    volume = make_noise()
    devices = [own for own in list_devices() if not (own.is_simulator or own.shortcoming)]
    with DeviceVolume(volume, device=device) as resident:
        mesh = extract_by_spans(resident, 100, DeviceSpans(devices, memory=None), SPANS, closed=True, below=False)
    assert_same_arrays(mesh, extract_isosurface(volume, 100, device=device))
    assert all(own.driver in mesh.report["driver"] for own in devices)  # each has begun with a span


def test_mesh_on_all_devices_is_the_file_of_one(tmp_path: Path) -> None:
    write_phantom(tmp_path / "ct", PhantomSettings(kind="sphere", size=(24, 24), slices=20, noise=0.0))
    for name, options in {"one": [], "all": ["--device", "all"]}.items():
        assert (
            main(["mesh", str(tmp_path / "ct"), "-o", str(tmp_path / f"{name}.stl"), "--hu", "0", "-q", *options]) == 0
        )
    assert (tmp_path / "all.stl").read_bytes() == (tmp_path / "one.stl").read_bytes()


@pytest.mark.parametrize("how", [{"device": "all"}, {"scheduler": LOCAL}], ids=["devices", "workers"])
def test_surface_that_grows_is_not_shared_out(how: dict[str, str]) -> None:
    with refused(UsageError, "all" if "device" in how else LOCAL, "grow_from"):
        MeshSettings(grow_from=("auto",), **how)


@pytest.mark.seconds
@pytest.mark.skipif(sys.platform != "linux", reason="SIGKILL")
def test_surface_of_workers_has_the_arrays_of_one_extraction_when_a_worker_is_killed(device: Device) -> None:
    volume = make_noise()
    killed: list[int] = []
    with open_cluster(LOCAL, [None, None]) as cluster, DeviceVolume(volume, device=device) as resident:

        def make_spans(grid: SampleGrid, spans: Sequence[Span]) -> Iterator[tuple[Span, SpanPart]]:
            for number, made in enumerate(ClusterSpans(cluster, memory=None)(grid, spans)):
                if number == 1:
                    killed.extend(cluster.call_all(os.getpid))
                    os.kill(killed[0], signal.SIGKILL)
                yield made

        mesh = extract_by_spans(resident, 100, make_spans, SPANS, closed=True, below=False)
        assert killed[0] not in cluster.call_all(os.getpid)
    assert_same_arrays(mesh, extract_isosurface(volume, 100, device=device))


@pytest.mark.seconds
@pytest.mark.skipif(sys.platform != "linux", reason="SIGKILL")
def test_mesh_of_ome_zarr_by_workers_is_the_file_of_one_process_and_nifti_when_a_worker_is_killed(
    tmp_path: Path,
) -> None:
    pytest.importorskip("zarr")
    voxels = make_noise().voxels
    scan = write_ome_zarr(tmp_path / "a.zarr", voxels)  # steps of 2.5, 0.75 and 0.5 mm along its axes
    nifti = write_nifti(tmp_path / "a.nii", voxels, np.diag((0.5, 0.75, 2.5, 1.0)))
    killed: list[int] = []

    def kill_worker(stage: str, done: int, total: int) -> None:
        if stage == "slabs" and done and not killed:
            [worker] = multiprocessing.active_children()
            assert worker.pid is not None
            killed.append(worker.pid)
            os.kill(killed[0], signal.SIGKILL)

    make_mesh(nifti, tmp_path / "one.stl", MeshSettings(iso_value=100))
    settings = MeshSettings(iso_value=100, scheduler=LOCAL)
    make_mesh(scan, tmp_path / "shared.stl", settings, progress=kill_worker)
    assert killed
    assert (tmp_path / "shared.stl").read_bytes() == (tmp_path / "one.stl").read_bytes()
