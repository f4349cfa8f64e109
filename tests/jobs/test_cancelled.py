"""A progress function that raises `Cancelled` ends the work at once, with nothing half written and nothing held."""

from __future__ import annotations

import gc
import threading
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused
from variants import daily

import clrecon
from clrecon.geometry import Volume
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import RenderSettings, Turntable
from clrecon.jobs.run import DeviceOpening
from clrecon.labels import LabelMap
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.system.progress import Progress

Calls = list[tuple[str, int, int]]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a CT of a sphere in 16 slices."""
    folder = tmp_path_factory.mktemp("cancelled") / "ct"
    write_phantom(folder, PhantomSettings(kind="sphere", size=(22, 30), slices=16, spacing=(1.0, 1.4, 2.0)))
    return folder


def pick_calls(work: Callable[[Progress], object]) -> Calls:
    """The calls of progress of a whole run: of each stage the last, and of those with parts one in the middle."""
    calls: Calls = []
    work(lambda *call: calls.append(call))
    chosen = [calls[0]]
    for stage in dict.fromkeys(call[0] for call in calls):
        own = [call for call in calls if call[0] == stage]
        chosen += [own[len(own) // 2], own[-1]]
    return list(dict.fromkeys(chosen))


def cancel_at(work: Callable[[Progress], object], moment: tuple[str, int, int]) -> None:
    """Run `work` until `moment`; what arrives must be the error that was raised there, not another in its place."""
    raised = clrecon.Cancelled(f"enough at {moment}")
    caller = threading.get_ident()

    def progress(*call: Any) -> None:
        assert threading.get_ident() == caller
        if call == moment:
            raise raised

    try:
        work(progress)
    except clrecon.Cancelled as error:
        assert error is raised
        assert error.__cause__ is None
        assert error.__context__ is None
        error.__traceback__ = None  # whose frames hold what they worked on
    else:
        pytest.fail(f"went on after {moment}")


class Buffers:
    """The buffers on devices that were made since the patch, and how many of them somebody still holds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch):
        cl = pytest.importorskip("pyopencl")
        made: list[weakref.ref[Any]] = []
        self._made = made

        class Counted(cl.Buffer):  # type: ignore[misc, name-defined]
            def __init__(self, *given: Any, **named: Any):
                super().__init__(*given, **named)
                made.append(weakref.ref(self))

        monkeypatch.setattr(cl, "Buffer", Counted)

    @property
    def made(self) -> int:
        return len(self._made)

    @property
    def held(self) -> int:
        gc.collect()
        return sum(buffer() is not None for buffer in self._made)


def old_files(folder: Path, *names: str) -> dict[str, bytes]:
    for name in names:
        (folder / name).write_bytes(b"old " + name.encode())
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize(
    "read",
    [
        pytest.param(clrecon.read_volume, id="read_volume"),
        pytest.param(
            lambda scan, progress: clrecon.list_series(scan, pixels=True, progress=progress), id="list_series"
        ),
    ],
)
def test_reading_cancelled_in_any_stage_ends_its_threads(read: Callable[..., object], scan: Path) -> None:
    calls = pick_calls(lambda progress: clrecon.read_volume(scan, progress=progress))
    assert {stage for stage, _, _ in calls} == {"scan", "read"}
    before = threading.enumerate()

    for moment in calls:
        cancel_at(lambda progress: read(scan, progress=progress), moment)

    started = [thread for thread in threading.enumerate() if thread not in before]
    for thread in started:
        thread.join(timeout=5.0)  # s; those that read from disk end by themselves
    assert [thread.name for thread in started if thread.is_alive()] == []


@pytest.mark.release
@pytest.mark.slow
def test_mesh_job_cancelled_in_any_stage_leaves_older_files(scan: Path, device: Any, tmp_path: Path) -> None:
    settings = MeshSettings(
        iso_value=(100.0, 200.0), smooth=2, decimate=0.5, split=True, field_of_view=14.0, device=str(device.index)
    )

    def work(progress: Progress) -> object:
        return make_mesh(scan, tmp_path / "a.stl", settings, report_path=tmp_path / "a.json", progress=progress)

    found = pick_calls(work)
    stages = {stage for stage, _, _ in found}
    assert stages == {
        "device", "scan", "read", "mask", "build", "select", "smooth", "decimate", "compare", "measure",
        "write",
    }  # fmt: skip
    assert ("write", 1, 2) in found  # between the files
    before = old_files(tmp_path, "a.stl", "a_100hu_001.stl", "a.json")
    for moment in found:
        cancel_at(work, moment)
        assert files_in(tmp_path) == before


SLABS_BYTES = 120_000
"""A budget of memory for which `block` is worked on in several slabs."""


@pytest.fixture
def block() -> Volume:
    """A block of 1000 HU in a volume of 0 HU."""
    voxels = np.zeros((40, 30, 30), np.int16)
    voxels[5:35, 5:25, 5:25] = 1000
    return Volume(voxels, np.eye(4))


def pick_calls_of_surface(volume: Volume, device: Any) -> Calls:
    """Calls of progress of its surface in slabs."""
    calls = pick_calls(
        lambda progress: clrecon.extract_isosurface(volume, 500, device=device, memory=SLABS_BYTES, progress=progress)
    )
    assert len([call for call in calls if call[0] == "slabs"]) > 1
    return calls


def test_surface_in_slabs_cancelled_in_any_stage_holds_no_buffers(
    block: Volume, device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = pick_calls_of_surface(block, device)
    buffers = Buffers(monkeypatch)

    for moment in calls:
        before = buffers.made
        cancel_at(
            lambda progress: clrecon.extract_isosurface(
                block, 500, device=device, memory=SLABS_BYTES, progress=progress
            ),
            moment,
        )
        stage, _, _ = moment
        assert buffers.made > before or stage == "build"  # which comes before all buffers
        assert buffers.held == 0


def test_surface_extractor_in_slabs_can_be_used_after_it_was_cancelled(block: Volume, device: Any) -> None:
    calls = pick_calls_of_surface(block, device)
    whole = clrecon.extract_isosurface(block, 500, device=device)

    with clrecon.SurfaceExtractor(block, device=device, memory=SLABS_BYTES) as extractor:
        for moment in calls:
            cancel_at(lambda progress: extractor.extract(500, progress=progress), moment)
        assert np.array_equal(extractor.extract(500).vertices, whole.vertices)


def test_surface_extractor_in_slabs_holds_no_buffers_after_it_was_cancelled(
    block: Volume, device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = pick_calls_of_surface(block, device)
    buffers = Buffers(monkeypatch)

    with clrecon.SurfaceExtractor(block, device=device, memory=SLABS_BYTES) as extractor:
        for moment in calls:
            cancel_at(lambda progress: extractor.extract(500, progress=progress), moment)
        assert buffers.held == 0


def test_surface_extractor_holds_its_volume_on_the_device_until_it_is_closed(
    block: Volume, device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    buffers = Buffers(monkeypatch)

    with clrecon.SurfaceExtractor(block, device=device) as extractor:
        extractor.extract(500)
        assert buffers.held > 0
    assert buffers.held == 0


def test_cancelled_slice_made_in_slabs_holds_no_buffers(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    voxels = np.random.default_rng(0).integers(-1000, 1000, (60, 40, 40)).astype(np.int16)
    volume = Volume(voxels, np.eye(4))
    cut = {"size": (64, 64), "memory": 100_000}
    clrecon.cut_slice(volume, "coronal", device=device, **cut)
    buffers = Buffers(monkeypatch)
    found = pick_calls(lambda progress: clrecon.cut_slice(volume, "coronal", device=device, progress=progress, **cut))
    assert len(found) > 1
    for moment in found:
        cancel_at(
            lambda progress: clrecon.cut_slice(volume, "coronal", device=device, progress=progress, **cut), moment
        )
        assert buffers.held == 0


@pytest.mark.parametrize("of_masks", daily(1, [False, True]))
def test_cancelled_surfaces_of_labels_hold_no_buffers(
    of_masks: bool, device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    voxels = np.zeros((24, 24, 24), np.int16)
    marks = np.zeros(voxels.shape, np.uint8)
    for number, first in enumerate((2, 9, 16), start=1):
        marks[first : first + 6, 4:20, 4:20] = number
    voxels[marks > 0] = 1000
    volume, labels = Volume(voxels, np.eye(4)), LabelMap(marks, np.eye(4))

    def work(progress: Progress) -> object:
        if of_masks:
            return clrecon.extract_label_masks(labels, device=device, progress=progress)
        return clrecon.extract_labels(volume, labels, 500, device=device, progress=progress)

    found = pick_calls(work)
    assert found == [("labels", 0, 3), ("labels", 1, 3), ("labels", 2, 3)]
    buffers = Buffers(monkeypatch)
    for moment in found:
        cancel_at(work, moment)
        assert buffers.held == 0
    assert buffers.made > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", daily(1, ["a.apng", "a.gif", "a.mp4", "frames"]))
def test_turntable_cancelled_in_any_stage_leaves_older_files_and_holds_no_buffers(
    name: str, scan: Path, device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = RenderSettings.of(
        "mip", size=(32, 32), turntable=Turntable(frames=4), background="black", device=str(device.index)
    )
    files = PictureFiles(tmp_path / "still.png", turntable=tmp_path / name, report=tmp_path / "a.json")

    def work(progress: Progress) -> object:
        return make_pictures(scan, files, settings, progress=progress)

    found = pick_calls(work)
    assert {stage for stage, _, _ in found} == {"device", "scan", "read", "render", "frames"}
    if name != "a.apng":  # before the frames, all kinds of movies are one job
        found = [moment for moment in found if moment[0] in ("render", "frames")]
    for path in tmp_path.iterdir():  # the first run has shown that all of them are written
        if path.is_file():
            path.write_bytes(b"old")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    buffers = Buffers(monkeypatch)
    for moment in found:
        cancel_at(work, moment)
        assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
        assert buffers.held == 0
    assert buffers.made > 0


def test_cancelled_arrives_though_the_device_is_missing_too() -> None:
    with refused(clrecon.Cancelled, "enough"), DeviceOpening("abacus", lambda device: None):
        raise clrecon.Cancelled("enough")
