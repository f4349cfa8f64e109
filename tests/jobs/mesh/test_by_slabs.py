"""Surfaces written slab by slab: the bytes of those in one piece, with memory for a slab, or nothing at all."""

from __future__ import annotations

import json
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from refusals import refused

from clrecon import SurfaceExtractor, Volume, extract_isosurface
from clrecon.cli.main import main
from clrecon.errors import DeviceError, NoSurfaceError, OutputError, UsageError
from clrecon.exchange.formats import FORMATS, check_triangles
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.mesh.workers import ClusterSpans
from clrecon.opencl import Device
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.surface.spans import PassingSurface
from clrecon.proof.phantom import PhantomSettings, write_phantom

SLICES = 40
MEMORY = "400kB"
"""An eighth of it holds 15 slices of 40 x 40 int16, or their triangles: the surface goes by in several slabs."""


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball with so much noise that all slices, and all seams of slabs, have surface."""
    folder = tmp_path_factory.mktemp("by_slabs") / "ct"
    write_phantom(folder, PhantomSettings(kind="sphere", size=(40, 40), slices=SLICES, noise=300.0))
    return folder


def run_both(ct: Path, folder: Path, output: str, *options: str) -> dict[str, Any]:
    """Run the command in one piece and by slabs; return the report of the latter."""
    for name, more in {"whole": (), "slabs": ("--by-slabs", "--memory", MEMORY)}.items():
        (folder / name).mkdir()
        report = str(folder / f"{name}.json")
        assert (
            main(["mesh", str(ct), "-o", str(folder / name / output), "-q", "--report", report, *options, *more]) == 0
        )
    report_of_slabs: dict[str, Any] = json.loads((folder / "slabs.json").read_text())
    return report_of_slabs


OPTIONS = {
    "a level": ["m.stl", "--hu", "0"],
    "PLY in the frame RAS": ["m.ply", "--hu", "0", "--space", "ras"],
    "a range": ["m.ply", "--hu", "-200:100"],
    "below a level": ["m.stl", "--below", "0", "--keep-outside"],
    "open at the border": ["m.ply", "--hu", "0", "--open"],
    "trilinear": ["m.stl", "--hu", "0", "--topology", "trilinear"],
    "solid": ["m.stl", "--hu", "0", "--solid"],
    "all devices": ["m.ply", "--hu", "0", "--device", "all"],
    "two levels": ["m.stl", "--hu", "0,100"],
}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_files_written_by_slabs_are_those_written_in_one_piece(ct: Path, tmp_path: Path, options: list[str]) -> None:
    report = run_both(ct, tmp_path, *options)
    assert report["slabs"] >= 3  # one in the middle has two seams
    whole = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()}
    assert {path.name: path.read_bytes() for path in (tmp_path / "slabs").iterdir()} == whole


def test_report_of_slabs_has_the_counts_and_the_box_of_one_piece_and_no_measures(ct: Path, tmp_path: Path) -> None:
    by_slabs = run_both(ct, tmp_path, "m.stl", "--hu", "0", "--space", "ras")
    whole = json.loads((tmp_path / "whole.json").read_text())

    names = ("vertices", "triangles", "bounds_mm", "iso_level_hu", "output", "affine_ijk_to_lps_mm", "volume")
    assert {name: by_slabs[name] for name in names} == {name: whole[name] for name in names}
    assert [by_slabs[name] for name in ("closed", "components", "area_mm2", "quality")] == [None] * 4


@pytest.mark.parametrize("share", [0.3, 0.9], ids=["among the vertices", "among the faces"])
def test_disk_that_is_full_in_the_middle_leaves_the_older_file_and_no_other(
    ct: Path, tmp_path: Path, share: float
) -> None:
    resource = pytest.importorskip("resource")  # not on Windows
    settings, output = MeshSettings(iso_value=0.0, by_slabs=True, memory=400_000), tmp_path / "m.ply"
    whole_bytes = make_mesh(ct, output, settings).output["bytes"]
    output.write_bytes(b"older")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(share * whole_bytes), limits[1]))
    try:
        code = main(["mesh", str(ct), "-o", str(output), "--hu", "0", "--by-slabs", "--memory", MEMORY])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)

    output_failed = 6
    assert code == output_failed
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("m.ply", b"older")]


def make_noise(offset_mm: float = 0.0) -> Volume:
    affine = np.eye(4)
    affine[0, 3] = offset_mm
    return Volume(np.random.default_rng(4).normal(0, 100, (SLICES, 40, 40)).astype(np.int16), affine)


def pass_by(volume: Volume, device: Device, level: float = 0.0, memory: int = 800_000) -> PassingSurface:
    return PassingSurface(DeviceVolume(volume, device=device, memory=memory), level, closed=True, below=False)


def test_no_more_than_two_parts_of_a_surface_that_passes_are_in_memory(device: Device) -> None:
    seen = []
    for positions, _, _ in pass_by(make_noise(), device).parts():
        seen.append(weakref.ref(positions))
        alive = sum(reference() is not None for reference in seen)
        assert alive <= 2  # this one, and where the loop still names it, the one before
    assert len(seen) > 5


class LateCluster:
    """A cluster of one worker whose tasks end in the opposite order."""

    def __init__(self) -> None:
        self.tasks: list[int] = []

    def count_workers(self) -> int:
        return 1

    def run_tasks(self, function: Any, items: Iterable[Any], *shared: Any) -> Iterator[tuple[Any, Any]]:
        sent = list(items)
        self.tasks.append(len(sent))
        yield from ((item, function(item, *shared)) for item in reversed(sent))


def test_parts_of_workers_come_in_their_order_and_four_for_each_at_a_time(device: Device) -> None:
    volume, cluster = make_noise(), LateCluster()
    spans = ClusterSpans(cast("Any", cluster), memory=None)
    resident = DeviceVolume(volume, device=device, memory=800_000)
    by_workers = PassingSurface(resident, 0.0, spans.make_in_order, closed=True, below=False)
    for part, expected in zip(by_workers.parts(), pass_by(volume, device).parts(), strict=True):
        assert all(map(np.array_equal, part, expected))
    assert max(cluster.tasks) == 4 and len(cluster.tasks) > 1


def test_device_that_makes_other_numbers_than_it_has_counted_is_refused(device: Device) -> None:
    passing = pass_by(make_noise(), device)
    counted = passing.vertices
    passing.vertices += 1
    with refused(DeviceError, counted, counted + 1):
        list(passing.parts())


def test_level_that_no_slab_has_is_refused_before_anything_is_written(device: Device) -> None:
    with refused(NoSurfaceError, 5000):
        pass_by(make_noise(), device, level=5000.0)


def test_volume_far_from_the_origin_is_made_whole(device: Device) -> None:
    with refused(UsageError, "float64"):
        pass_by(make_noise(offset_mm=5000.0), device)


@pytest.mark.parametrize(
    ("given", "name"),
    [({"smooth": 5}, "smooth"), ({"keep_largest": 1}, "keep_largest"), ({"strict": True}, "strict")],
    ids=["smoothing", "components", "gates"],
)
def test_step_that_takes_the_mesh_as_a_whole_is_refused(given: dict[str, Any], name: str) -> None:
    with refused(UsageError, "by_slabs", name):
        MeshSettings(by_slabs=True, **given)


def test_format_that_needs_the_whole_mesh_is_refused_before_the_scan_is_read(tmp_path: Path) -> None:
    with refused(UsageError, ".glb", ".stl", ".ply"):
        make_mesh(tmp_path / "no_scan", tmp_path / "m.glb", MeshSettings(by_slabs=True))


@pytest.mark.parametrize("output", ["m.stl", "m.ply"])
def test_extractor_saves_the_file_of_the_mesh_that_it_extracts(tmp_path: Path, device: Device, output: str) -> None:
    whole, volume = tmp_path / f"whole_{output}", make_noise()
    extract_isosurface(volume, 50, device=device).save(whole, "ras")
    with SurfaceExtractor(volume, device=device, memory=800_000) as extractor:
        report = extractor.save(tmp_path / output, 50, "ras")
    assert report["slabs"] >= 3
    assert report["bytes"] == whole.stat().st_size
    assert (tmp_path / output).read_bytes() == whole.read_bytes()


def test_extractor_keeps_a_file_that_exists_where_it_is_told_to(tmp_path: Path, device: Device) -> None:
    older = tmp_path / "m.stl"
    older.write_bytes(b"older")
    with SurfaceExtractor(make_noise(), device=device) as extractor, refused(OutputError, "no_clobber"):
        extractor.save(older, 50, no_clobber=True)


def test_mesh_too_large_for_its_format_is_refused_before_it_is_measured(
    ct: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(FORMATS, ".stl", replace(FORMATS[".stl"], most_bytes=100_000))
    stages: list[str] = []
    with refused(OutputError, "STL", "PLY"):
        make_mesh(
            ct, tmp_path / "m.stl", MeshSettings(iso_value=0.0), measure=True,
            progress=lambda stage, *_: stages.append(stage),
        )  # fmt: skip
    assert "build" in stages  # the surface was made
    assert "measure" not in stages
    assert "write" not in stages
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("extension", "most"), [(".stl", 85_899_345), (".glb", 357_913_941)], ids=["STL, 50 bytes each", "GLB, 12 each"]
)
def test_triangles_alone_tell_that_a_file_has_more_than_four_gib(extension: str, most: int) -> None:
    check_triangles(most, f"m{extension}")
    with refused(OutputError, most + 1, "PLY"):
        check_triangles(most + 1, f"m{extension}")
