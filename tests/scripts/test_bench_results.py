"""What is done with bench results: kept, compared, tabulated, drawn."""

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


def keep(folder: Path, *made: dict) -> Path:
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
def test_devices_have_names_for_files(described: dict, name: str) -> None:
    assert results.device_name(described) == name


def test_results_come_back_by_key_and_others_are_named(tmp_path: Path, printed: Printer) -> None:
    folder = keep(tmp_path / "a", make_result())
    (folder / "old.json").write_text('{"case": "isosurface"}')
    (folder / "half.json").write_text('{"case": ')
    assert list(results.load_results(folder)) == [("isosurface-cold", "spine149", "pocl-3.1-debian")]
    said = printed()
    assert said.error_lines == 2
    said.assert_error("half.json", "old.json")


@pytest.mark.parametrize(
    ("now", "half", "fell"),
    [
        (2.0, 0.1, False),
        (1.72, 0.02, False),  # within 10 % below the lower quartile of 1.9
        (1.70, 0.02, True),
        (1.70, 0.4, False),  # as low, but its spread reaches the baseline
        (2.5, 0.1, False),
    ],
)
def test_a_ratio_falls_when_no_spread_explains_it(now: float, half: float, fell: bool) -> None:
    assert compare.has_fallen(spread_of(2.0), spread_of(now, half), percent=10.0) is fell


@pytest.fixture
def result_folders(tmp_path: Path) -> dict[str, str]:
    """Results of two cases with the ratio 2, of one with 2.4, of one with 1.2 beside a new case, and of that alone."""
    kept = {
        "base": keep(tmp_path / "base", make_result(), make_result(given="spine559")),
        "better": keep(tmp_path / "better", make_result(ratio=2.4)),
        "worse": keep(tmp_path / "worse", make_result(ratio=1.2), make_result(given="cube64")),
        "other": keep(tmp_path / "other", make_result(given="cube64")),
    }
    return {name: str(folder) for name, folder in kept.items()} | {"nowhere": str(tmp_path / "nowhere")}


@pytest.mark.parametrize(
    ("new", "options", "code"),
    [("better", [], 0), ("worse", [], 1), ("worse", ["--percent", "60"], 0), ("other", [], 2), ("nowhere", [], 3)],
    ids=["better", "fell", "fell less than allowed", "nothing in common", "no folder"],
)
def test_compare_exits_by_what_it_finds(
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


def test_a_lost_ratio_is_said(tmp_path: Path) -> None:
    before, now = make_result(), make_result()
    now["ratios"] = {}
    changes, left_out = compare.compare_results({("a", "b", "c"): before}, {("a", "b", "c"): now}, 10.0)
    assert (changes, left_out) == ([], ["a b c: the ratio all_threads is missing in the new results"])


def test_the_table_has_one_row_a_ratio(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = keep(tmp_path / "a", make_result(), make_result(given="lumbar", ratio=1.5))
    assert bench.main(["table", str(folder)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    cells = [cell.strip() for cell in lines[3].strip("|").split("|")]
    assert cells == ["isosurface-cold", "all_threads", "spine149", "pocl-3.1-debian", "1.23 M", "30 ms", "60 ms",
                     "2.00", "1.90 to 2.10"]  # fmt: skip
    assert len({len(line) for line in lines}) == 1


def test_the_table_shows_memory_and_lines_in_their_units() -> None:
    scaling, memory = make_scaling_result(), make_result("memory")
    scaling["ratios"] = {"over_sizes": spread_of(3.0)}
    memory.update(ratios={"scratch": spread_of(3.0)}, sides={})
    memory["resident_scratch_bytes_a_voxel"] = {"clrecon": spread_of(0.3), "peer": spread_of(0.9)}
    made = {results.result_key(result): result for result in (scaling, memory)}
    rows = tables.format_results(made).splitlines()
    assert "| 0.30 B/voxel | 0.90 B/voxel | 3.00 " in rows[2]
    assert "| R2 1.000     | R2 1.000     | 3.00 " in rows[3]


def test_cases_and_ratios_can_be_picked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cold, job = make_result(), make_result("main-job")
    cold["ratios"]["sequential"] = spread_of(4.0)
    folder = keep(tmp_path / "a", cold, job)
    assert bench.main(["table", str(folder), "--case", "isosurface-cold", "--ratio", "sequential"]) == 0
    (row,) = capsys.readouterr().out.splitlines()[2:]
    assert "sequential" in row and "4.00" in row
    assert len(results.pick(results.load_results(folder))) == 2
    assert results.pick(results.load_results(folder), None, ["nothing"]) == {}


def test_seconds_are_printed_short() -> None:
    assert [tables.seconds(value) for value in (2.345, 0.0345, 0.00034)] == ["2.35 s", "34.5 ms", "0.34 ms"]


@pytest.mark.release
def test_plots_are_drawn(tmp_path: Path, printed: Printer) -> None:
    matplotlib_image = pytest.importorskip("matplotlib.image")
    folder = keep(tmp_path / "a", make_result(), make_result(given="b", ratio=0.5), make_scaling_result())
    assert bench.main(["plot", str(folder), "-o", str(tmp_path / "r.png")]) == 0
    printed().assert_output("r.png", 3)
    drawn = sorted(path.name for path in tmp_path.glob("*.png"))
    assert drawn == ["r-scaling-spine149-pocl-3.1-debian.png", "r.png"]
    for name in drawn:
        pixels = matplotlib_image.imread(tmp_path / name)[..., :3]
        assert min(pixels.shape[:2]) > 200
        blue = (pixels[..., 2] > 0.5) & (pixels[..., 0] < 0.4)
        red = (pixels[..., 0] > 0.6) & (pixels[..., 2] < 0.4)
        assert blue.sum() > 500 and red.sum() > 500  # clrecon and peer, or ratios on both sides of 1
        if "scaling" in name:
            assert 0.7 < blue.sum() / red.sum() < 1.4  # as many points and lines of both


def test_nothing_to_plot_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    assert bench.main(["plot", str(keep(tmp_path / "a")), "-o", str(tmp_path / "r.png")]) == 3
    assert "no ratios to draw" in capsys.readouterr().err
