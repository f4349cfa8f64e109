"""The cases of the bench: registry, inputs, floors and fits, and a short run of each on small volumes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tolerances
from bench_harness import FOLDER
from printed_text import Printer
from refusals import refused

from clrecon.errors import DeviceError, UsageError

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


def test_cases_of_the_bench_are_registered_with_a_description() -> None:
    cases = registry.load_cases()
    assert set(cases) >= EXPECTED
    assert [name for name, case in cases.items() if " " not in case.description] == []


def test_command_list_prints_the_names_of_the_cases(printed: Printer) -> None:
    assert bench.main(["list"]) == 0
    printed().assert_output(*EXPECTED)


@pytest.fixture
def own_case() -> Iterator[Any]:
    """The measuring function of a case that is registered under the name "own" while the test runs."""

    @registry.case("own", "what it is")
    def measure_own(job: registry.Job) -> dict[str, Any]:
        return {"ratios": {}}

    yield measure_own
    del registry.CASES["own"]


def test_decorated_function_is_registered_as_a_case(own_case: Any) -> None:
    assert registry.CASES["own"].measure is own_case


def test_case_with_the_name_of_one_from_another_module_is_refused(own_case: Any) -> None:
    own_case.__module__ = "other"
    with refused(ValueError, "own"):
        registry.case("own", "again")(lambda job: {})


@pytest.mark.parametrize(
    ("arguments", "fact", "code"),
    [
        (["isosurface-warm"], "isosurface-warm", UsageError.exit_code),
        (["memory", "--input", "gone"], "gone", UsageError.exit_code),
        (["memory", "--pairs", "0"], 1, UsageError.exit_code),
        (["memory", "--input", "cube8", "--device", "abacus"], "abacus", DeviceError.exit_code),
    ],
    ids=["unknown case", "missing input", "no pairs", "unknown device"],
)
def test_wrong_argument_of_the_bench_is_refused_by_name_with_the_exit_code_of_its_error(
    arguments: list[str], fact: str | int, code: int, tmp_path: Path, printed: Printer
) -> None:
    assert bench.main(["run", *arguments, "--work", str(tmp_path)]) == code
    printed().assert_error(fact)


def test_synthetic_input_is_a_volume_of_the_side_in_its_name(tmp_path: Path) -> None:
    volume = inputs.parse_input("cube24", tmp_path).volume()
    assert (volume.shape_ijk, volume.voxels.dtype) == ((24, 24, 24), np.int16)


def test_arrays_of_a_synthetic_input_are_written_once(tmp_path: Path) -> None:
    cube = inputs.parse_input("cube24", tmp_path / "work")
    voxels, affine = cube.arrays()
    written_at = voxels.stat().st_mtime_ns
    assert cube.arrays()[0].stat().st_mtime_ns == written_at
    assert {path.name for path in (tmp_path / "work").iterdir()} == {voxels.name, affine.name}


def test_synthetic_input_is_refused_where_a_ct_series_is_needed(tmp_path: Path) -> None:
    with refused(UsageError, "CT", "series"):
        inputs.parse_input("cube24", tmp_path).ct_folder()


@pytest.mark.parametrize(("prefix", "name"), [("a=", "a"), ("", "Jane_Doe")], ids=["given", "of the last folder"])
def test_name_of_an_input_is_the_given_one_or_that_of_its_last_folder(prefix: str, name: str, tmp_path: Path) -> None:
    (tmp_path / "Jane Doe").mkdir()
    assert inputs.parse_input(f"{prefix}{tmp_path / 'Jane Doe'}", tmp_path).name == name


@pytest.mark.parametrize(
    ("is_cpu", "moves_of_mask", "writes_of_mesh"), [(True, 5, 2), (False, 3, 1)], ids=["CPU", "graphics card"]
)
def test_least_bytes_of_a_surface_are_those_of_its_voxels_its_mask_of_one_bit_and_its_mesh(
    is_cpu: bool, moves_of_mask: int, writes_of_mesh: int
) -> None:
    voxels, bytes_of_voxel = 512 * 512 * 149, 2
    vertices, bytes_of_vertex = 614_000, 2 * 3 * 4  # a place and a normal of three float32
    triangles, bytes_of_triangle = 1_230_000, 3 * 4
    mesh_bytes = vertices * bytes_of_vertex + triangles * bytes_of_triangle
    expected = voxels * bytes_of_voxel + moves_of_mask * voxels // 8 + writes_of_mesh * mesh_bytes
    assert floors.floor_bytes(voxels, bytes_of_voxel, vertices, triangles, is_cpu=is_cpu) == expected


@pytest.mark.parametrize(("seconds", "percent"), [(1.0, 50.0), (0.0, None)], ids=["measured time", "no measured time"])
def test_percent_of_the_floor_is_its_time_at_the_bandwidth_over_the_measured_time(
    seconds: float, percent: float | None
) -> None:
    assert floors.share_of_floor(moved=50, bandwidth=100.0, seconds=seconds) == percent


@pytest.mark.parametrize(("device_type", "bandwidth"), [("cpu", 30.0), ("gpu", 20.0)])
def test_bandwidth_is_the_best_of_a_cpu_and_that_of_opencl_on_a_graphics_card(
    device_type: str, bandwidth: float
) -> None:
    measured = {"numpy_1_thread": 30.0, "opencl": 20.0}
    assert floors.usable_bandwidth(measured, SimpleNamespace(type=device_type)) == bandwidth


@pytest.mark.parametrize(
    ("first_dense_slice", "active_layers"), [(3, 1), (8, 1), (9, 1), (20, 1), (25, 0)], ids=lambda value: str(value)
)
def test_share_of_active_bricks_is_that_of_the_layers_that_a_plane_crosses(
    first_dense_slice: int, active_layers: int
) -> None:
    voxels = np.zeros((25, 17, 33), np.int16)  # three layers of bricks of 8 cells
    voxels[first_dense_slice:] = 10
    assert floors.active_brick_share(voxels, lowest_inside=5) == active_layers / 3


def test_no_brick_is_active_at_an_iso_value_above_all_voxels() -> None:
    voxels = np.zeros((25, 17, 33), np.int16)
    voxels[9:] = 10
    assert floors.active_brick_share(voxels, lowest_inside=50) == 0.0


@pytest.mark.parametrize(
    ("y", "slope", "intercept", "r2"),
    [([3, 5, 7, 9], 2.0, 1.0, 1.0), ([0, 1, 0, 1], 0.2, 0.0, 0.2)],
    ids=["points on a line", "points beside a line"],
)
def test_line_is_fitted_by_least_squares(y: list[float], slope: float, intercept: float, r2: float) -> None:
    fit = scaling.fit_line([1, 2, 3, 4], y)
    assert (fit["slope"], fit["intercept"], fit["r2"]) == pytest.approx((slope, intercept, r2))


def test_counts_of_slices_for_scaling_go_from_64_to_all() -> None:
    counts = scaling.choose_slices(559)
    assert (counts[0], counts[-1]) == (64, 559)


def test_counts_of_slices_of_a_small_volume_are_all_from_2() -> None:
    assert scaling.choose_slices(8) == [2, 3, 4, 5, 6, 7, 8]


TISSUE_HU, NOISE_HU = 50, 10


@pytest.fixture(scope="module")
def ramp_in_tissue() -> Any:
    """Voxels of a ramp of bone up to 900 HU in noisy tissue, which has most of the triangles."""
    voxels = np.random.default_rng(3).normal(TISSUE_HU, NOISE_HU, (20, 40, 40)).astype(np.int16)
    voxels[:, 10:20, 10:20] += (np.arange(10) * 100).astype(np.int16)
    return voxels


def test_iso_values_for_scaling_go_from_few_triangles_in_bone_to_most_in_tissue(ramp_in_tissue: Any) -> None:
    levels = scaling.choose_levels(ramp_in_tissue, points=5, most=1e9)
    counts = scaling.estimate_triangles(ramp_in_tissue, levels)
    assert len(levels) == 5
    assert levels[0] > 500  # in the upper half of the ramp from 50 to 950 HU; 663 was measured
    assert abs(levels[-1] - TISSUE_HU) < NOISE_HU / 2
    assert counts == sorted(counts)


def test_iso_values_for_scaling_keep_the_triangles_about_below_the_limit(ramp_in_tissue: Any) -> None:
    densest = scaling.estimate_triangles(ramp_in_tissue, [TISSUE_HU])[0]
    limit = densest / 2
    levels = scaling.choose_levels(ramp_in_tissue, points=5, most=limit)
    assert max(scaling.estimate_triangles(ramp_in_tissue, levels)) < 1.2 * limit  # the next level is that much denser


def test_iso_values_of_timed_calls_are_all_different() -> None:
    levels = list(islice(isosurface.walk_levels(226.0), 20 * len(isosurface.LEVEL_STEPS)))
    assert len(set(levels)) == len(levels)
    assert levels[:2] == [226.0, 226.0 + isosurface.LEVEL_STEPS[1]]
    assert levels[len(isosurface.LEVEL_STEPS)] == 226.0 + 1.0  # the steps begin again


def test_costs_of_a_call_are_its_cores_and_page_faults() -> None:
    costs = measure.Costs()
    count = 1 << 25  # 256 MiB of float64
    for _ in range(3):
        assert costs.measure(lambda: np.ones(count).sum()) == count
    assert 0.1 < costs.describe()["cores_used"] < 64  # one, if nothing else runs
    assert costs.describe()["page_faults"] > 10  # one for each huge page at least


@pytest.mark.parametrize(
    ("code", "timeout_s", "fact"),
    [("import sys; sys.exit(1 + 2)", 60.0, 3), ("import time; time.sleep(60)", 0.2, 0.2)],  # facts not in the code
    ids=["exit code 3", "over 0.2 s"],
)
def test_program_of_the_bench_that_fails_or_hangs_is_an_error(code: str, timeout_s: float, fact: float) -> None:
    with refused(RuntimeError, fact):
        measure.run_program([sys.executable, "-c", code], timeout_s=timeout_s)


def run_cases(names: list[str], given: str, device: Any, folder: Path, *more: str) -> dict[str, dict[str, Any]]:
    """Run cases with three pairs of times each; returns their results by their names."""
    folders = ["--work", str(folder / "work"), "--json", str(folder / "new"), *more]
    arguments = ["run", *names, "--input", given, "--device", str(device.index), "--pairs", "3", *folders]
    assert bench.main(arguments) == 0
    written = [json.loads(path.read_text()) for path in (folder / "new").iterdir()]
    return {result["case"]: result for result in written}


@pytest.fixture(scope="module")
def surface_results(device: Any, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Results of the cases of surfaces in one process, of a cube of 32 voxels a side."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(floors, "_COPY_BYTES", 1 << 20)
        names = ["isosurface-cold", "isosurface-resident", "scaling"]
        return run_cases(names, "cube32", device, tmp_path_factory.mktemp("surfaces"))


@pytest.fixture(params=["isosurface-cold", "isosurface-resident"])
def surface_result(request: pytest.FixtureRequest, surface_results: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The result of one of the cases of surfaces, of a cube of 32 voxels a side and three pairs of times."""
    return surface_results[request.param]


def test_surface_of_the_bench_has_as_many_vertices_and_triangles_as_that_of_the_peer(
    surface_result: dict[str, Any],
) -> None:
    side = surface_result["sides"]["all_threads"]
    assert side["equal_counts"]
    assert len(side["counts"]) == 1 + 3  # of a first call and three pairs
    assert surface_result["triangles"] > 1000  # the surface of the cube has thousands


def test_ratio_of_a_surface_is_that_of_the_times_of_its_pairs(surface_result: dict[str, Any]) -> None:
    side = surface_result["sides"]["all_threads"]
    ratios = [theirs / ours for theirs, ours in zip(side["theirs"], side["ours"], strict=True)]
    assert side["pairs"] == len(ratios) == 3
    assert side["ratio"]["min"] == pytest.approx(min(ratios))
    assert side["ratio"]["max"] == pytest.approx(max(ratios))
    assert surface_result["ratios"]["all_threads"] == side["ratio"]


def test_peer_of_several_threads_is_measured_with_one_thread_too(surface_result: dict[str, Any]) -> None:
    sides = surface_result["sides"]
    if sides["all_threads"]["peer"]["threads"] == 1:
        pytest.skip("the peer has one thread here")
    assert sides["sequential"]["peer"]["threads"] == 1


def test_kernels_of_a_surface_have_times_where_the_driver_gives_them(
    surface_result: dict[str, Any], device: Any
) -> None:
    assert bool(surface_result["kernel_seconds"]) == device.has_event_times
    assert set(surface_result["kernel_percent_of_copy"]) <= set(surface_result["kernel_seconds"])


def test_result_of_a_surface_has_its_least_bytes_and_the_machine(surface_result: dict[str, Any], device: Any) -> None:
    assert surface_result["floor_bytes"] > 0
    assert surface_result["percent_of_floor"] > 0
    assert surface_result["machine"]["processor"]
    assert surface_result["device"]["driver"] == device.driver


@pytest.mark.parametrize(("name", "has_fresh_pages"), [("isosurface-cold", True), ("isosurface-resident", False)])
def test_only_the_cold_case_of_surfaces_is_measured_on_fresh_pages(
    name: str, has_fresh_pages: bool, surface_results: dict[str, dict[str, Any]]
) -> None:
    assert ("fresh_pages" in surface_results[name]["ratios"]) == has_fresh_pages


def test_timed_surfaces_of_a_resident_volume_have_different_iso_values(
    surface_results: dict[str, dict[str, Any]],
) -> None:
    levels = surface_results["isosurface-resident"]["levels_hu"]
    assert len(set(levels)) == len(levels) == 4  # a first call and three pairs


def test_scaling_is_measured_from_a_part_to_the_whole_volume_with_lines_over_voxels_and_triangles(
    surface_results: dict[str, dict[str, Any]],
) -> None:
    scaled = surface_results["scaling"]
    sizes = [size["voxels"] for size in scaled["sizes"]]
    assert len(sizes) == scaling.POINTS
    assert (sizes[0], sizes[-1]) == (32**3 // 4, 32**3)  # fewer than 128 slices: from a quarter of them
    assert set(scaled["fits"]) == {"voxels", "triangles"}


@pytest.fixture(scope="module")
def picture_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `picture_results` writes."""
    return tmp_path_factory.mktemp("pictures")


@pytest.fixture(scope="module")
def picture_results(device: Any, picture_folder: Path) -> dict[str, dict[str, Any]]:
    """Results of the cases of ray casting, with pictures of 60 x 50 pixels in the folder "seen"."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(raycast, "SIZE", (60, 50))
        more = ["--pictures", str(picture_folder / "seen")]
        return run_cases(["raycast-warm", "raycast-first"], "cube32", device, picture_folder, *more)


@pytest.mark.release
@pytest.mark.parametrize("name", ["raycast-warm", "raycast-first"])
def test_ray_casting_is_timed_against_vtk_in_both_projections(
    name: str, picture_results: dict[str, dict[str, Any]]
) -> None:
    result = picture_results[name]
    assert (result["size"], result["ray_step_mm"]) == ([60, 50], 0.25)  # a quarter of a voxel of the cube
    assert set(result["ratios"]) == set(result["sides"]) == {"parallel", "perspective"}
    for side in result["sides"].values():
        assert side["pairs"] == len(side["ours"]) == len(side["theirs"]) == 3
        assert side["peer"]["name"] == "vtkFixedPointVolumeRayCastMapper"


@pytest.mark.release
def test_timed_pictures_of_ray_casting_look_like_those_of_vtk(picture_results: dict[str, dict[str, Any]]) -> None:
    likeness = [found["same_box"] for found in picture_results["raycast-warm"]["ssim"].values()]
    assert min(likeness) > tolerances.BENCH_LIKENESS


@pytest.mark.release
def test_change_of_the_transfer_function_is_timed(picture_results: dict[str, dict[str, Any]]) -> None:
    assert picture_results["raycast-warm"]["transfer_change"]["same_s"]["median"] > 0


@pytest.mark.release
@pytest.mark.parametrize("shot", ["parallel", "perspective"])
@pytest.mark.parametrize("side", ["clrecon", "fixed_point"])
@pytest.mark.usefixtures("picture_results")
def test_timed_picture_of_each_projection_and_side_is_written(shot: str, side: str, picture_folder: Path) -> None:
    from PIL import Image

    picture = np.asarray(Image.open(picture_folder / "seen" / f"raycast-cube32-{shot}-{side}.png"))
    assert len(np.unique(picture)) > 10  # of one grey level, if nothing was drawn


@pytest.mark.release
def test_ray_casting_is_timed_against_the_opengl_mapper_of_vtk_with_a_like_picture(
    device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from peers.vtk_gpu import GpuPeer

    monkeypatch.setattr(raycast, "SIZE", (60, 50))
    volume = inputs.parse_input("cube32", tmp_path / "work").volume()
    try:
        with GpuPeer(volume.voxels, raycast.make_shots(volume)[0].scene(volume)) as peer:
            renderer = peer.renderer
    except RuntimeError as error:
        pytest.skip(f"no OpenGL here: {error}")

    result = run_cases(["raycast-gpu-mapper"], "cube32", device, tmp_path)["raycast-gpu-mapper"]

    assert {side["peer"]["renderer"] for side in result["sides"].values()} == {renderer}
    assert min(side["peer_first_s"] for side in result["sides"].values()) > 0.0
    assert min(found["same_box"] for found in result["ssim"].values()) > tolerances.BENCH_LIKENESS


@pytest.mark.opencl
@pytest.mark.release
def test_each_step_of_a_view_is_timed(device: Any, tmp_path: Path) -> None:
    steps = run_cases(["view"], "cube32", device, tmp_path)["view"]["steps"]
    assert {"slider", "release", "sharp surface", "sharp dvr", "parts", "moving with a part hidden"} <= set(steps)
    assert min(step["cpu_ms"]["median"] for step in steps.values()) > 0.0


@pytest.mark.opencl
@pytest.mark.release
def test_points_picked_in_a_view_lie_on_the_surface(device: Any, tmp_path: Path) -> None:
    picks = run_cases(["view-picks"], "cube32", device, tmp_path)["view-picks"]
    assert picks["picks"] > 1000  # of 2,000; the others are beside the surface
    assert picks["distance_mm"]["most"] < 0.3  # a third of a voxel of 1 mm


def test_error_in_the_process_of_a_peer_is_raised_with_its_last_words(tmp_path: Path) -> None:
    from peers.vtk_gpu import GpuPeer

    volume = inputs.parse_input("cube8", tmp_path).volume()
    not_voxels = np.array([None])
    with refused(RuntimeError, "allow_pickle"):
        GpuPeer(not_voxels, raycast.make_shots(volume)[0].scene(volume))


@pytest.mark.release
def test_first_surface_of_a_process_is_timed_alone_and_with_its_process(device: Any, tmp_path: Path) -> None:
    first = run_cases(["isosurface-first-call"], "cube32", device, tmp_path)["isosurface-first-call"]
    assert first["equal_counts"]
    assert set(first["ratios"]) == {"first_call", "without_opening", "whole_process"}
    call, process = (first["sides"][side]["clrecon_s"]["median"] for side in ("first_call", "whole_process"))
    assert 0 < call < process


@pytest.mark.release
def test_memory_of_three_processes_is_measured_with_the_bytes_of_their_meshes(device: Any, tmp_path: Path) -> None:
    runs = run_cases(["memory"], "cube32", device, tmp_path)["memory"]["runs"]["clrecon"]
    vertex_bytes, least_vertices = 2 * 3 * 4, 1000
    assert len(runs) == 3
    assert min(run["output"] for run in runs) > vertex_bytes * least_vertices


PEAK_OF_32_MIB = """
import child, numpy as np
sums = [np.ones(1 << 24).sum()]  # freed: an earlier peak of 128 MiB that must not count
found = child.measure_peak(lambda: sums.append(np.ones(1 << 22).sum()) or 0)
print((found["peak"] or 0) - (found["before"] or 0))
"""


def test_peak_of_memory_is_that_of_the_measured_call_alone() -> None:
    command = [sys.executable, "-c", PEAK_OF_32_MIB]
    done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=True)
    if done.stdout.strip() == "0":
        pytest.skip("this system does not tell resident memory")
    assert int(done.stdout) == pytest.approx(32 << 20, rel=0.1)  # a huge page is 6 %; measured 0.6 % less
