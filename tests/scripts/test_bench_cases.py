"""The cases of the bench: registry, inputs, floors and fits, and a short run of each on small volumes."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from bench_harness import FOLDER
from printed_text import Printer
from refusals import refused

from clrecon.errors import UsageError

import bench  # isort: skip
import floors  # isort: skip
import inputs  # isort: skip
import isosurface  # isort: skip
import measure  # isort: skip
import raycast  # isort: skip
import registry  # isort: skip
import scaling  # isort: skip

EXPECTED = {"isosurface-cold", "isosurface-resident", "isosurface-first-call", "scaling", "memory", "main-job",
            "raycast-warm", "raycast-first", "raycast-gpu-mapper"}  # fmt: skip


def test_every_case_is_listed(printed: Printer) -> None:
    cases = registry.load_cases()
    assert set(cases) >= EXPECTED
    assert all(len(case.description) > 20 for case in cases.values())
    assert bench.main(["list"]) == 0
    printed().assert_output(*EXPECTED)


def test_a_case_joins_in_one_line_and_its_name_is_its_own() -> None:
    @registry.case("own", "what it is")
    def measure_own(job: registry.Job) -> dict[str, Any]:
        return {"ratios": {}}

    try:
        assert registry.CASES["own"].measure is measure_own
        measure_own.__module__ = "other"
        with refused(ValueError, "own"):
            registry.case("own", "again")(lambda job: {})
    finally:
        del registry.CASES["own"]


def test_wrong_arguments_are_one_line(tmp_path: Path, printed: Printer) -> None:
    for arguments, fact in (
        (["run", "isosurface-warm"], "isosurface-warm"),
        (["run", "memory", "--input", str(tmp_path / "gone")], "gone"),
        (["run", "memory", "--pairs", "0"], 1),
        (["run", "memory", "--input", "cube8", "--device", "abacus"], "abacus"),
    ):
        assert bench.main([*arguments, "--work", str(tmp_path)]) in (3, 5)
        printed().assert_error(fact)


def test_made_up_inputs_are_made_once(tmp_path: Path) -> None:
    given = inputs.parse_input("cube24", tmp_path / "work")
    voxels, affine = given.arrays()
    stamp = voxels.stat().st_mtime_ns
    assert given.arrays()[0].stat().st_mtime_ns == stamp
    volume = given.volume()
    assert (volume.shape_ijk, volume.voxels.dtype) == ((24, 24, 24), np.int16)
    assert sorted(path.name for path in (tmp_path / "work").iterdir()) == sorted([voxels.name, affine.name])
    with refused(UsageError, "CT", "series"):
        given.ct_folder()


def test_inputs_have_names_without_folders(tmp_path: Path) -> None:
    (tmp_path / "Jane Doe").mkdir()
    assert inputs.parse_input(f"a={tmp_path / 'Jane Doe'}", tmp_path).name == "a"
    assert inputs.parse_input(str(tmp_path / "Jane Doe"), tmp_path).name == "Jane_Doe"


def test_the_floor_is_that_of_the_formula() -> None:
    voxels = 512 * 512 * 149
    assert floors.floor_bytes(voxels, 2, 614_000, 1_230_000, is_cpu=True) == pytest.approx(162e6, rel=0.01)
    assert floors.floor_bytes(voxels, 2, 614_000, 1_230_000, is_cpu=False) == pytest.approx(122e6, rel=0.01)
    assert floors.share_of_floor(50, 100.0, 1.0) == 50.0
    assert floors.share_of_floor(50, 100.0, 0.0) is None


def test_a_device_with_memory_of_its_own_is_held_against_its_own_copies() -> None:
    from types import SimpleNamespace

    bandwidth = {"numpy_1_thread": 30.0, "opencl": 20.0}
    assert floors.usable_bandwidth(bandwidth, SimpleNamespace(type="cpu")) == 30.0
    assert floors.usable_bandwidth(bandwidth, SimpleNamespace(type="gpu")) == 20.0


@pytest.mark.parametrize("step", [3, 8, 9, 20])
def test_active_bricks_are_those_that_the_plane_crosses(step: int) -> None:
    voxels = np.zeros((25, 17, 33), np.int16)
    voxels[step:] = 10
    expected = len({start for start in (0, 8, 16) if start < step <= start + 8}) / 3
    assert floors.active_brick_share(voxels, 5) == expected
    assert floors.active_brick_share(voxels, 50) == 0.0


def test_lines_are_fitted() -> None:
    fit = scaling.fit_line([1, 2, 3, 4], [3, 5, 7, 9])
    assert (fit["slope"], fit["intercept"], fit["r2"]) == pytest.approx((2.0, 1.0, 1.0))
    assert scaling.fit_line([1, 2, 3, 4], [0, 1, 0, 1])["r2"] == pytest.approx(0.2)
    assert scaling.choose_slices(559)[0] == 64 and scaling.choose_slices(559)[-1] == 559
    assert scaling.choose_slices(8) == [2, 3, 4, 5, 6, 7, 8]


def test_levels_go_from_sparse_to_dense_under_the_limit() -> None:
    # A ramp of bones over tissue with noise: the densest level lies in the noise.
    random = np.random.default_rng(3)
    voxels = random.normal(50, 10, (20, 40, 40)).astype(np.int16)
    voxels[:, 10:20, 10:20] += (np.arange(10) * 100).astype(np.int16)
    free = scaling.choose_levels(voxels, points=5, most=1e9)
    counts = scaling.estimate_triangles(voxels, free)
    assert len(free) == 5 and free[0] > 500 and 45 <= free[-1] <= 55
    assert counts == sorted(counts)
    limited = scaling.choose_levels(voxels, points=5, most=counts[-1] / 2)
    assert max(scaling.estimate_triangles(voxels, limited)) < 0.6 * counts[-1]


def test_no_iso_value_comes_twice() -> None:
    levels = list(islice(isosurface.walk_levels(226.0), 20 * len(isosurface.LEVEL_STEPS)))
    assert len(set(levels)) == len(levels)
    assert levels[:2] == [226.0, 376.0] and levels[7] == 227.0


def test_costs_see_pages_and_cores() -> None:
    costs = measure.Costs()
    for _ in range(3):
        assert costs.measure(lambda: np.ones(1 << 25).sum()) == 1 << 25
    assert 0.1 < costs.describe()["cores_used"] < 64
    assert costs.describe()["page_faults"] > 10


def test_a_program_that_fails_or_hangs_is_an_error() -> None:
    import sys

    with refused(RuntimeError, 3):
        measure.run_program([sys.executable, "-c", "import sys; sys.stderr.write('oh no'); sys.exit(3)"])
    with refused(RuntimeError, 0.2):
        measure.run_program([sys.executable, "-c", "import time; time.sleep(60)"], timeout_s=0.2)


def run_cases(names: list[str], given: str, device: Any, tmp_path: Path, *more: str) -> dict[str, dict[str, Any]]:
    places = ["--work", str(tmp_path / "work"), "--json", str(tmp_path / "new"), *more]
    arguments = ["run", *names, "--input", given, "--device", str(device.index), "--pairs", "3", *places]
    assert bench.main(arguments) == 0
    kept = [json.loads(path.read_text()) for path in (tmp_path / "new").iterdir()]
    return {result["case"]: result for result in kept}


def test_surfaces_in_one_process_are_measured(device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(floors, "_COPY_BYTES", 1 << 20)
    kept = run_cases(["isosurface-cold", "isosurface-resident", "scaling"], "cube32", device, tmp_path)
    assert set(kept) == {"isosurface-cold", "isosurface-resident", "scaling"}
    for name in ("isosurface-cold", "isosurface-resident"):
        result = kept[name]
        side = result["sides"]["all_threads"]
        assert side["equal_counts"] and len(side["counts"]) == 4
        if side["peer"]["threads"] > 1:
            assert result["sides"]["sequential"]["peer"]["threads"] == 1
        assert ("fresh_pages" in result["ratios"]) == (name == "isosurface-cold")
        assert side["pairs"] == len(side["ours"]) == 3
        first = side["theirs"][0] / side["ours"][0]
        assert side["ratio"]["min"] <= first <= side["ratio"]["max"]
        assert result["ratios"]["all_threads"] == side["ratio"]
        assert result["triangles"] > 1000
        assert bool(result["kernel_seconds"]) == device.has_event_times
        assert set(result["kernel_percent_of_copy"]) <= set(result["kernel_seconds"])
        assert result["floor_bytes"] > 0 and result["percent_of_floor"] > 0
        assert result["machine"]["processor"] and result["device"]["driver"] == device.driver
    assert len(set(kept["isosurface-resident"]["levels_hu"])) == 4
    assert len(kept["scaling"]["sizes"]) >= 5
    assert kept["scaling"]["sizes"][0]["voxels"] < kept["scaling"]["sizes"][-1]["voxels"] == 32**3
    assert {"voxels", "triangles"} == set(kept["scaling"]["fits"])


@pytest.mark.release
def test_pictures_are_measured(device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from PIL import Image

    monkeypatch.setattr(raycast, "SIZE", (60, 50))
    kept = run_cases(
        ["raycast-warm", "raycast-first"], "cube32", device, tmp_path, "--pictures", str(tmp_path / "seen")
    )
    for result in kept.values():
        assert set(result["ratios"]) == {"parallel", "perspective"}
        assert result["size"] == [60, 50] and result["ray_step_mm"] == 0.25
        for side in result["sides"].values():
            assert side["pairs"] == len(side["ours"]) == len(side["theirs"]) == 3
            assert side["peer"]["name"] == "vtkFixedPointVolumeRayCastMapper"
    warm = kept["raycast-warm"]
    assert all(found["same_box"] > tolerances.BENCH_LIKENESS for found in warm["ssim"].values())
    assert warm["transfer_change"]["same_s"]["median"] > 0
    seen = sorted(path.name for path in (tmp_path / "seen").iterdir())
    assert seen == [
        f"raycast-cube32-{shot}-{side}.png"
        for shot in ("parallel", "perspective")
        for side in ("clrecon", "fixed_point")
    ]
    assert np.asarray(Image.open(tmp_path / "seen" / seen[1])).mean() > 1.0


@pytest.mark.release
def test_the_mapper_on_opengl_is_measured(device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from peers.vtk_gpu import GpuPeer

    monkeypatch.setattr(raycast, "SIZE", (60, 50))
    volume = inputs.parse_input("cube32", tmp_path / "work").volume()
    try:
        with GpuPeer(volume.voxels, raycast.make_shots(volume)[0].scene(volume)) as peer:
            renderer = peer.renderer
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")
    result = run_cases(["raycast-gpu-mapper"], "cube32", device, tmp_path)["raycast-gpu-mapper"]
    for side in result["sides"].values():
        assert side["peer"]["renderer"] == renderer and side["peer_first_s"] > 0.0
    assert all(found["same_box"] > tolerances.BENCH_LIKENESS for found in result["ssim"].values())


@pytest.mark.opencl
@pytest.mark.release
def test_steps_of_a_view_are_measured(device: Any, tmp_path: Path) -> None:
    kept = run_cases(["view", "view-picks"], "cube32", device, tmp_path)
    steps = kept["view"]["steps"]
    assert {"slider", "release", "sharp surface", "sharp dvr", "parts", "moving with a part hidden"} <= set(steps)
    assert all(step["cpu_ms"]["median"] > 0.0 for step in steps.values())
    assert kept["view-picks"]["distance_mm"]["most"] < 0.3 and kept["view-picks"]["picks"] > 1000


def test_a_peer_that_dies_is_an_error(tmp_path: Path) -> None:
    from peers.vtk_gpu import GpuPeer

    volume = inputs.parse_input("cube8", tmp_path).volume()
    with refused(RuntimeError, "allow_pickle"):
        GpuPeer(np.array([None]), raycast.make_shots(volume)[0].scene(volume))


@pytest.mark.release
def test_surfaces_of_fresh_processes_are_measured(device: Any, tmp_path: Path) -> None:
    kept = run_cases(["isosurface-first-call", "memory"], "cube32", device, tmp_path)
    first = kept["isosurface-first-call"]
    assert set(first["ratios"]) == {"first_call", "without_opening", "whole_process"}
    own = first["sides"]["first_call"]["clrecon_s"]["median"]
    assert 0 < own < first["sides"]["whole_process"]["clrecon_s"]["median"]
    assert first["equal_counts"] and first["triangles"] > 1000
    runs = kept["memory"]["runs"]["clrecon"]
    assert len(runs) == 3 and all(run["output"] > 30_000 for run in runs)


def test_a_big_array_shows_in_the_peak(tmp_path: Path) -> None:
    import subprocess
    import sys

    code = """
import child, numpy as np
kept = [np.ones(1 << 24).sum()]  # freed: an earlier peak that must not count
found = child.measure_peak(lambda: kept.append(np.ones(1 << 22).sum()) or 0)
print((found["peak"] or 0) - (found["before"] or 0))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=FOLDER, capture_output=True, text=True, check=True)
    if done.stdout.strip() == "0":
        pytest.skip("this system does not tell resident memory")
    assert int(done.stdout) == pytest.approx(8 << 22, rel=0.2)
