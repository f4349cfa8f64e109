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
from clrecon.opencl import choose_device, list_devices
from clrecon.proof import bench
from clrecon.proof.phantom import PhantomSettings, make_phantom, write_phantom


@pytest.fixture(scope="module")
def sphere_ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A DICOM series of a sphere of the phantom."""
    folder = tmp_path_factory.mktemp("bench") / "ct"
    write_phantom(folder, PhantomSettings(kind="sphere", size=(48, 40), slices=24, noise=0.0))
    return folder


VOXELS = 48 * 40 * 24
"""Of the series."""


class RunOfBench:
    """A bench of three runs on the series: its result, its written report and the stages that it reported."""

    def __init__(self, sphere_ct: Path, device: Any, report_path: Path):
        self.stages: list[str] = []
        self.result: Any = bench.run_bench(
            sphere_ct, iso_value=0.0, device=str(device.index), runs=3, report_path=report_path,
            progress=lambda stage, done, total: self.stages.append(stage),
        )  # fmt: skip
        self.report: Any = json.loads(report_path.read_text())
        [self.entry] = self.result["devices"]


@pytest.fixture(scope="module")
def run(device: Any, sphere_ct: Path, tmp_path_factory: pytest.TempPathFactory) -> RunOfBench:
    return RunOfBench(sphere_ct, device, tmp_path_factory.mktemp("run") / "b.json")


def test_bench_of_a_series_has_its_input_times_and_stages(run: RunOfBench) -> None:
    assert (run.result["input"]["kind"], run.result["input"]["voxels"]) == ("series", VOXELS)
    assert (run.result["iso_value_hu"], run.result["iso_level_hu"]) == (0.0, -0.5)  # of whole HU: half a step below
    assert set(run.result["seconds"]) == {"read", "bench", "total"}
    assert (run.stages[0], run.stages[-1]) == ("device", "bench")
    assert "read" in run.stages


def test_report_of_the_bench_is_written_with_the_number_of_runs(run: RunOfBench) -> None:
    assert run.report["runs"] == 3


def test_surface_of_the_timed_device_has_as_many_vertices_and_triangles_as_that_of_the_peer(
    run: RunOfBench, device: Any
) -> None:
    peer = run.entry["peer"]
    assert (run.entry["device"]["name"], run.entry["error"]) == (device.name, None)
    assert (run.entry["vertices"], run.entry["triangles"]) == (peer["vertices"], peer["triangles"])


def test_warm_times_of_a_device_are_positive_and_in_order_and_give_its_voxels_a_second(run: RunOfBench) -> None:
    warm = run.entry["warm_seconds"]
    assert 0 < warm["min"] <= warm["q1"] <= warm["median"] <= warm["q3"] <= warm["max"]
    assert run.entry["mvoxels_per_s"] == pytest.approx(1e-6 * VOXELS / warm["median"])


def test_ratio_of_the_bench_lies_between_those_of_the_extreme_times(run: RunOfBench) -> None:
    warm, peer, ratio = run.entry["warm_seconds"], run.entry["peer"]["seconds"], run.entry["ratio"]
    assert peer["min"] / warm["max"] <= ratio["min"] <= ratio["max"] <= peer["max"] / warm["min"]


def test_first_call_and_calls_on_a_resident_volume_are_timed(run: RunOfBench) -> None:
    first, resident = run.entry["first_seconds"], run.entry["resident_seconds"]
    assert 0 < first["open"] <= first["total"]
    assert 0 < resident["min"] <= resident["median"]


def test_parts_of_the_time_of_a_device_and_its_kernels_are_measured(run: RunOfBench, device: Any) -> None:
    parts, kernels = run.entry["part_seconds"], run.entry["kernel_seconds"]
    assert {"upload", "build", "kernels", "download"} <= set(parts)
    assert bool(kernels) == device.has_event_times
    assert sum(kernels.values()) <= 1.5 * parts["kernels"]  # medians of different runs


def test_bench_without_an_input_makes_a_synthetic_spine_of_512_x_512_x_149_voxels(
    device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def make_small(settings: PhantomSettings, progress: Any) -> Any:
        asked.append((settings.size, settings.slices, settings.spacing))
        return make_phantom(replace(settings, size=(64, 64), slices=24, spacing=(3.0, 3.0, 5.0)), progress)

    monkeypatch.setattr("clrecon.proof.phantom.make_phantom", make_small)
    result = bench.run_bench(device=str(device.index), runs=1)
    assert asked == [((512, 512), 149, (0.7, 0.7, 1.0))]
    assert result["input"]["kind"] == "phantom"
    assert (result["iso_value_hu"], result["iso_level_hu"]) == (226.0, 225.5)
    assert result["devices"][0]["triangles"] > 500  # of a small spine; measured 17,732
    assert "make" in result["seconds"]


def test_bench_without_vtk_has_times_and_a_warning_but_no_ratio(
    device: Any, sphere_ct: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise ImportError("no VTK")

    monkeypatch.setattr(bench, "FlyingEdges", refuse)
    result = bench.run_bench(sphere_ct, device=str(device.index), runs=2)
    (entry,) = result["devices"]
    assert (entry["peer"], entry["ratio"]) == (None, None)
    assert entry["warm_seconds"]["median"] > 0
    assert "VTK is not installed: there is nothing to compare with" in result["warnings"]


def test_bench_of_all_devices_goes_on_after_one_that_fails_with_a_warning(
    device: Any, sphere_ct: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clrecon.opencl.list_devices", lambda: [BurntDevice(device), device])
    result = bench.run_bench(sphere_ct, device="all", runs=1)
    assert [entry["error"] for entry in result["devices"]] == ["it caught fire", None]
    assert f"{device.name} failed: it caught fire" in result["warnings"]


def test_error_of_the_first_device_is_raised_where_all_devices_fail(
    device: Any, sphere_ct: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "clrecon.opencl.list_devices", lambda: [BurntDevice(device), BurntDevice(device, "it fell into water")]
    )
    with refused(DeviceError, "fire"):
        bench.run_bench(sphere_ct, device="all", runs=1)


def test_peer_with_another_number_of_triangles_is_warned_of(
    device: Any, sphere_ct: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = bench.FlyingEdges.run
    monkeypatch.setattr(bench.FlyingEdges, "run", lambda self, level: real(self, level)._replace(triangles=7))
    result = bench.run_bench(sphere_ct, device=str(device.index), runs=1)
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


def test_iso_values_of_a_resident_volume_go_outwards_and_none_comes_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    from clrecon.operators.surface import extract as isosurface

    monkeypatch.setattr(isosurface, "SurfaceExtractor", FakeExtractor)
    nothing: Any = None
    bench._time_resident(nothing, nothing, hu=0.0, runs=7)
    assert FakeExtractor.asked == [0.0, 1.0, -1.0, 2.0, -2.0, -3.0]  # 3 and 4 are beyond the scan


def test_no_runs_on_a_resident_volume_have_no_times(monkeypatch: pytest.MonkeyPatch) -> None:
    from clrecon.operators.surface import extract as isosurface

    monkeypatch.setattr(isosurface, "SurfaceExtractor", FakeExtractor)
    nothing: Any = None
    assert bench._time_resident(nothing, nothing, hu=0.0, runs=0) is None


def test_devices_named_all_are_those_without_simulators_and_unusable_ones(
    device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from types import SimpleNamespace

    from clrecon import opencl

    simulator = SimpleNamespace(is_simulator=True, shortcoming="")
    broken = SimpleNamespace(is_simulator=False, shortcoming="it has no compiler")
    good = SimpleNamespace(is_simulator=False, shortcoming="")
    monkeypatch.setattr(opencl, "list_devices", lambda: [simulator, broken, good])
    assert bench._choose_devices("all") == [good]


def test_all_devices_of_this_machine_that_can_be_used_are_chosen_by_all_in_capitals(device: Any) -> None:
    usable = [one for one in list_devices() if not (one.is_simulator or one.shortcoming)]
    assert bench._choose_devices(" ALL ") == usable
    assert device in usable or device.is_simulator


def test_one_device_of_the_bench_is_chosen_by_its_index(device: Any) -> None:
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
def test_wrong_argument_of_the_bench_is_refused_before_an_unknown_device(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        bench.run_bench(None, device="abacus", **arguments)


def test_report_that_cannot_be_written_is_refused_before_an_unknown_device_and_a_missing_input(tmp_path: Path) -> None:
    nowhere = tmp_path / "nowhere"
    with refused(OutputError, "nowhere"):
        bench.run_bench(nowhere, device="abacus", report_path=nowhere / "b.json")


def test_unknown_device_of_the_bench_is_refused_before_a_missing_input(tmp_path: Path) -> None:
    with refused(DeviceError, "abacus"):
        bench.run_bench(tmp_path / "nowhere", device="abacus")


def test_bench_without_a_surface_is_refused_and_writes_no_report(device: Any, sphere_ct: Path, tmp_path: Path) -> None:
    with refused(NoSurfaceError, 5000):
        bench.run_bench(sphere_ct, iso_value=5000.0, device=str(device.index), runs=1, report_path=tmp_path / "b.json")
    assert list(tmp_path.iterdir()) == []
