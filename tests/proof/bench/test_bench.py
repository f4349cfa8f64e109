"""`run_bench`: what it measures, and what it does when something is missing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from failing_devices import BurntDevice
from refusals import refused

from clrecon.errors import DeviceError, NoSurfaceError, OutputError, UsageError
from clrecon.opencl import choose_device
from clrecon.proof import bench
from clrecon.proof.phantom import PhantomSettings, make_phantom, write_phantom


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench") / "ct"
    write_phantom(folder, PhantomSettings(kind="sphere", size=(48, 40), slices=24, noise=0.0))
    return folder


def test_every_stage_of_a_series_is_timed(device: Any, ct: Path, tmp_path: Path) -> None:
    stages: list[str] = []
    result = bench.run_bench(
        ct, iso_value=0.0, device=str(device.index), runs=3, report_path=tmp_path / "b.json",
        progress=lambda stage, done, total: stages.append(stage),
    )  # fmt: skip
    assert json.loads((tmp_path / "b.json").read_text())["runs"] == 3
    assert (result["input"]["kind"], result["input"]["voxels"]) == ("series", 48 * 40 * 24)
    assert (result["iso_value_hu"], result["iso_level_hu"]) == (0.0, -0.5)
    assert set(result["seconds"]) == {"read", "bench", "total"}
    (entry,) = result["devices"]
    assert entry["device"]["name"] == device.name and entry["error"] is None
    peer_entry = entry["peer"]
    assert (entry["vertices"], entry["triangles"]) == (peer_entry["vertices"], peer_entry["triangles"])
    warm, ratio = entry["warm_seconds"], entry["ratio"]
    assert 0 < warm["min"] <= warm["q1"] <= warm["median"] <= warm["q3"] <= warm["max"]
    lowest, highest = peer_entry["seconds"]["min"] / warm["max"], peer_entry["seconds"]["max"] / warm["min"]
    assert lowest <= ratio["min"] <= ratio["max"] <= highest
    assert entry["mvoxels_per_s"] == pytest.approx(1e-6 * 48 * 40 * 24 / warm["median"])
    assert {"upload", "build", "kernels", "download"} <= set(entry["part_seconds"])
    assert 0 < entry["resident_seconds"]["min"] <= entry["resident_seconds"]["median"]
    assert bool(entry["kernel_seconds"]) == device.has_event_times
    assert sum(entry["kernel_seconds"].values()) <= 1.5 * entry["part_seconds"]["kernels"]
    assert entry["first_seconds"]["total"] >= entry["first_seconds"]["open"] > 0
    assert stages[0] == "device" and stages[-1] == "bench" and "read" in stages


def test_without_an_input_a_spine_is_made(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def make_small(settings: PhantomSettings, progress: Any) -> Any:
        asked.append((settings.size, settings.slices, settings.spacing))
        return make_phantom(replace(settings, size=(64, 64), slices=24, spacing=(3.0, 3.0, 5.0)), progress)

    monkeypatch.setattr("clrecon.proof.phantom.make_phantom", make_small)
    result = bench.run_bench(device=str(device.index), runs=1)
    assert asked == [((512, 512), 149, (0.7, 0.7, 1.0))]
    assert result["input"]["kind"] == "phantom"
    assert (result["iso_value_hu"], result["iso_level_hu"]) == (226.0, 225.5)
    assert result["devices"][0]["triangles"] > 500
    assert "make" in result["seconds"]


def test_without_vtk_there_is_no_ratio(device: Any, ct: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise ImportError("no VTK")

    monkeypatch.setattr(bench, "FlyingEdges", refuse)
    result = bench.run_bench(ct, device=str(device.index), runs=2)
    (entry,) = result["devices"]
    assert (entry["peer"], entry["ratio"]) == (None, None)
    assert entry["warm_seconds"]["median"] > 0
    assert "VTK is not installed: there is nothing to compare with" in result["warnings"]


def test_a_device_that_fails_is_told_and_the_others_go_on(
    device: Any, ct: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clrecon.opencl.list_devices", lambda: [BurntDevice(device), device])
    result = bench.run_bench(ct, device="all", runs=1)
    assert [entry["error"] for entry in result["devices"]] == ["it caught fire", None]
    assert f"{device.name} failed: it caught fire" in result["warnings"]


def test_where_all_devices_fail_the_first_error_is_raised(
    device: Any, ct: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clrecon.opencl.list_devices", lambda: [BurntDevice(device)])
    with refused(DeviceError, "fire"):
        bench.run_bench(ct, device="all", runs=1)


def test_unequal_surfaces_are_told(device: Any, ct: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = bench.FlyingEdges.run
    monkeypatch.setattr(bench.FlyingEdges, "run", lambda self, level: real(self, level)._replace(triangles=7))
    result = bench.run_bench(ct, device=str(device.index), runs=1)
    assert any("flying edges 7: the times are not of the same work" in text for text in result["warnings"])


class FakeExtractor:
    """Has surfaces below 3 HU only."""

    asked: list[float] = []

    def __init__(self, volume: Any, device: Any):
        self.asked.clear()

    def __enter__(self) -> FakeExtractor:
        return self

    def __exit__(self, *_: Any) -> None:
        pass

    def extract(self, iso_value: float, *, closed: bool) -> None:
        assert not closed
        if iso_value >= 3:
            raise NoSurfaceError("too high")
        self.asked.append(iso_value)


def test_no_iso_value_of_a_resident_volume_comes_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    from clrecon.operators.surface import extract as isosurface

    monkeypatch.setattr(isosurface, "SurfaceExtractor", FakeExtractor)
    nothing: Any = None
    found = bench._time_resident(nothing, nothing, 0.0, 7)
    assert FakeExtractor.asked == [0.0, 1.0, -1.0, 2.0, -2.0, -3.0]  # 3 and 4 are beyond the scan
    assert found is not None and found["min"] > 0
    assert bench._time_resident(nothing, nothing, 0.0, 0) is None


def test_all_devices_leave_simulators_and_unusable_ones(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from clrecon import opencl

    simulator = SimpleNamespace(is_simulator=True, shortcoming="")
    broken = SimpleNamespace(is_simulator=False, shortcoming="it has no compiler")
    good = SimpleNamespace(is_simulator=False, shortcoming="")
    monkeypatch.setattr(opencl, "list_devices", lambda: [simulator, broken, good])
    assert bench._choose_devices("all") == [good]


def test_all_devices_are_those_that_can_be_used(device: Any) -> None:
    chosen = bench._choose_devices(" ALL ")
    assert device in chosen or device.is_simulator
    assert not any(one.is_simulator or one.shortcoming for one in chosen)
    assert bench._choose_devices(str(device.index)) == [choose_device(str(device.index))]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"runs": 0}, "1 to 1000, not 0"),
        ({"runs": 1001}, "not 1001"),
        ({"iso_value": float("nan")}, "finite"),
        ({"series": "2"}, "name a DICOM folder"),
    ],
)
def test_wrong_arguments_are_refused_first(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        bench.run_bench(None, device="abacus", **arguments)


def test_bench_refuses_outputs_then_device_before_the_input(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    with refused(OutputError, "nowhere"):
        bench.run_bench(nowhere, device="abacus", report_path=nowhere / "b.json")
    with refused(DeviceError, "abacus"):
        bench.run_bench(nowhere, device="abacus")


def test_no_surface_leaves_no_report(device: Any, ct: Path, tmp_path: Path) -> None:
    with refused(NoSurfaceError, 5000):
        bench.run_bench(ct, iso_value=5000.0, device=str(device.index), runs=1, report_path=tmp_path / "b.json")
    assert list(tmp_path.iterdir()) == []
