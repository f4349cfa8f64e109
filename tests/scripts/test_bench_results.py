"""Results of the bench: their files, comparison, table and plots."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bench_harness import POCL, make_result, make_scaling_result, spread_of
from printed_text import Printer

import bench  # isort: skip
import compare  # isort: skip
import results  # isort: skip
import tables  # isort: skip


def write_results(folder: Path, *made: dict) -> Path:
    folder.mkdir()
    for result in made:
        results.result_path(folder, result).write_text(json.dumps(result))
    return folder


@pytest.mark.parametrize(
    ("described", "name"),
    [
        (POCL, "pocl-3.1-debian"),
        ({**POCL, "driver": "3.0-rc2"}, "pocl-3.0-rc2"),
        ({"platform": "rusticl", "name": "llvmpipe (LLVM 15.0.6, 256 bits)", "type": "cpu", "driver": "22.3.6"},
         "rusticl-llvmpipe-22.3.6"),
        ({"platform": "NVIDIA CUDA", "name": "NVIDIA H200", "type": "gpu", "driver": "550.1"},
         "nvidia-nvidia-h200-550.1"),
    ],
)  # fmt: skip
def test_device_of_a_result_has_a_short_name_for_files(described: dict, name: str) -> None:
    assert results.device_name(described) == name


def test_results_of_a_folder_are_loaded_by_case_input_and_device(tmp_path: Path) -> None:
    folder = write_results(tmp_path / "a", make_result("isosurface-cold", given="spine149"))  # on `POCL`
    assert list(results.load_results(folder)) == [("isosurface-cold", "spine149", "pocl-3.1-debian")]


@pytest.mark.parametrize("text", ['{"case": "isosurface"}', '{"case": '], ids=["without its entries", "cut"])
def test_file_that_is_no_result_is_left_out_and_named(text: str, tmp_path: Path, printed: Printer) -> None:
    (tmp_path / "other.json").write_text(text)
    assert list(results.load_results(tmp_path)) == []
    lines = printed()
    assert lines.error_lines == 1
    lines.assert_error("other.json")


@pytest.mark.parametrize(
    ("ratio", "half_spread", "has_fallen"),  # from the lower quartile to the median, and from it to the upper one
    [
        pytest.param(2.0, 0.1, False, id="equal"),
        pytest.param(1.72, 0.02, False, id="within 10 % below the lower quartile of 1.9"),
        pytest.param(1.70, 0.02, True, id="more than 10 % below the lower quartile"),
        pytest.param(1.70, 0.4, False, id="as low, with a spread that reaches the baseline"),
        pytest.param(2.5, 0.1, False, id="better"),
    ],
)
def test_ratio_has_fallen_when_it_is_10_percent_lower_and_no_spread_explains_it(
    ratio: float, half_spread: float, has_fallen: bool
) -> None:
    baseline = spread_of(2.0, half=0.1)
    assert compare.has_fallen(baseline, spread_of(ratio, half=half_spread), percent=10.0) is has_fallen


@pytest.fixture
def result_folders(tmp_path: Path) -> dict[str, str]:
    """Results of two cases with the ratio 2, of one with 2.4, of one with 1.2 beside a new case, and of that alone.

    The quartiles of a ratio lie 0.1 from it.
    """
    kept = {
        "base": write_results(tmp_path / "base", make_result(ratio=2.0), make_result(given="spine559", ratio=2.0)),
        "better": write_results(tmp_path / "better", make_result(ratio=2.4)),
        "worse": write_results(tmp_path / "worse", make_result(ratio=1.2), make_result(given="cube64")),
        "other": write_results(tmp_path / "other", make_result(given="cube64")),
    }
    return {name: str(folder) for name, folder in kept.items()} | {"nowhere": str(tmp_path / "nowhere")}


@pytest.mark.parametrize(
    ("new", "options", "code"),
    [("better", [], 0), ("worse", [], 1), ("worse", ["--percent", "60"], 0), ("other", [], 2), ("nowhere", [], 3)],
    ids=["better", "fell", "fell less than allowed", "nothing in common", "no folder"],
)
def test_compare_exits_with_0_unless_a_ratio_fell_or_nothing_can_be_compared(
    result_folders: dict[str, str], new: str, options: list[str], code: int
) -> None:
    assert bench.main(["compare", result_folders["base"], result_folders[new], *options]) == code


def test_compare_prints_both_ratios_and_their_quotient(result_folders: dict[str, str], printed: Printer) -> None:
    bench.main(["compare", result_folders["base"], result_folders["better"]])
    assert "2.00 (1.90 to 2.10) | 2.40 (2.30 to 2.50) | 1.20" in printed().everything


def test_compare_marks_the_ratio_that_fell(result_folders: dict[str, str], printed: Printer) -> None:
    bench.main(["compare", result_folders["base"], result_folders["worse"]])
    assert printed().everything.count("FELL") == 1


def test_compare_names_cases_of_one_side_alone(result_folders: dict[str, str], printed: Printer) -> None:
    bench.main(["compare", result_folders["base"], result_folders["worse"]])
    said = printed().everything
    assert "spine559 pocl-3.1-debian: only in the baseline" in said
    assert "cube64 pocl-3.1-debian: only in the new results" in said


def test_compare_names_a_folder_that_is_missing(result_folders: dict[str, str], printed: Printer) -> None:
    bench.main(["compare", result_folders["base"], result_folders["nowhere"]])
    printed().assert_error("nowhere", "folder")


def test_compare_names_a_ratio_that_the_new_results_lack() -> None:
    before, after = make_result(), make_result()  # with the ratio all_threads alone
    after["ratios"] = {}
    key = ("case", "input", "device")
    changes, left_out = compare.compare_results({key: before}, {key: after}, percent=10.0)
    assert changes == []
    assert left_out == ["case input device: the ratio all_threads is missing in the new results"]


def test_table_has_a_row_for_each_ratio_with_its_times_and_spread(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Results have 1,234,567 triangles, times of 30 and 60 ms, and quartiles 0.1 from the median of a ratio."""
    folder = write_results(
        tmp_path / "a", make_result(given="spine149", ratio=2.0), make_result(given="lumbar", ratio=1.5)
    )
    assert bench.main(["table", str(folder)]) == 0
    _, _, *rows = capsys.readouterr().out.splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    of_lumbar, of_spine = cells
    assert "lumbar" in of_lumbar
    assert of_spine == ["isosurface-cold", "all_threads", "spine149", "pocl-3.1-debian", "1.23 M", "30 ms", "60 ms",
                        "2.00", "1.90 to 2.10"]  # fmt: skip


def test_lines_of_a_table_are_equally_long(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_results(tmp_path / "a", make_result(), make_result(given="lumbar", ratio=1.5))
    bench.main(["table", str(folder)])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + 2
    assert len({len(line) for line in lines}) == 1


def test_row_of_memory_has_bytes_of_a_voxel() -> None:
    memory = make_result("memory")
    memory.update(ratios={"scratch": spread_of(3.0)}, sides={})
    memory["resident_scratch_bytes_a_voxel"] = {"clrecon": spread_of(0.3), "peer": spread_of(0.9)}
    _, _, row = tables.format_results({results.result_key(memory): memory}).splitlines()
    assert "| 0.30 B/voxel | 0.90 B/voxel | 3.00 " in row


def test_row_of_scaling_has_the_coefficients_of_determination_of_its_lines() -> None:
    scaling = make_scaling_result()
    scaling["ratios"] = {"over_sizes": spread_of(3.0)}
    _, _, row = tables.format_results({results.result_key(scaling): scaling}).splitlines()
    assert "| R2 1.000 | R2 1.000 | 3.00 " in row


@pytest.fixture
def cold_and_job(tmp_path: Path) -> Path:
    """Results of two cases, the first with two ratios."""
    cold, job = make_result("isosurface-cold"), make_result("main-job")
    cold["ratios"]["sequential"] = spread_of(4.0)
    return write_results(tmp_path / "a", cold, job)


def test_table_of_one_case_and_ratio_has_its_row_alone(cold_and_job: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench.main(["table", str(cold_and_job), "--case", "isosurface-cold", "--ratio", "sequential"])
    _, _, row = capsys.readouterr().out.splitlines()
    assert "sequential" in row
    assert "4.00" in row


def test_all_results_are_picked_without_a_case_and_a_ratio(cold_and_job: Path) -> None:
    assert len(results.pick(results.load_results(cold_and_job))) == 2


def test_no_result_is_picked_by_an_unknown_ratio(cold_and_job: Path) -> None:
    assert results.pick(results.load_results(cold_and_job), ratios=["nothing"]) == {}


@pytest.mark.parametrize(("value", "text"), [(2.345, "2.35 s"), (0.0345, "34.5 ms"), (0.00034, "0.34 ms")])
def test_seconds_are_written_with_three_digits_in_s_or_ms(value: float, text: str) -> None:
    assert tables.seconds(value) == text


def count_colours(path: Path) -> tuple[int, int]:
    """Pixels of a plot that are blue, as clrecon and good ratios are, and red, as the peer and bad ratios."""
    pixels = pytest.importorskip("matplotlib.image").imread(path)[..., :3]
    red, _, blue = (pixels[..., channel] for channel in range(3))
    return int(((blue > 0.5) & (red < 0.4)).sum()), int(((red > 0.6) & (blue < 0.4)).sum())


@pytest.mark.release
def test_ratios_on_both_sides_of_1_are_plotted_in_two_colours(tmp_path: Path, printed: Printer) -> None:
    folder = write_results(tmp_path / "a", make_result(), make_result(given="b", ratio=0.5))
    assert bench.main(["plot", str(folder), "-o", str(tmp_path / "r.png")]) == 0
    printed().assert_output("r.png", 2)
    assert min(count_colours(tmp_path / "r.png")) > 500  # a bar has thousands of pixels


@pytest.mark.release
def test_scaling_is_plotted_with_as_many_points_and_lines_of_clrecon_and_the_peer(tmp_path: Path) -> None:
    folder = write_results(tmp_path / "a", make_result(), make_scaling_result())
    bench.main(["plot", str(folder), "-o", str(tmp_path / "r.png")])
    blue, red = count_colours(tmp_path / "r-scaling-spine149-pocl-3.1-debian.png")
    assert min(blue, red) > 500  # pixels: measured 2,348 and 2,552
    assert 0.7 < blue / red < 1.4  # points of one colour cover some of the other


def test_plot_of_a_folder_without_ratios_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    assert bench.main(["plot", str(write_results(tmp_path / "a")), "-o", str(tmp_path / "r.png")]) == 3
    assert "no ratios to draw" in capsys.readouterr().err
