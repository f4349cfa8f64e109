"""Region of interest and preprocessing in the jobs: meshes, clouds and pictures of a part of a scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from label_files import write_nrrd
from printed_text import Printer
from variants import daily_rows

from clrecon import read_points
from clrecon.cli.main import main
from clrecon.jobs.options import parse_region_rules
from clrecon.jobs.preprocess import value_outside

pytestmark = pytest.mark.first_device

AFFINE = np.array([[0.8, 0.1, 0.0, -20.0], [-0.1, 0.8, 0.0, 30.0], [0.0, 0.0, 1.0, 100.0], [0.0, 0.0, 0.0, 1.0]])
SHAPE = (40, 44, 48)
LARGE, SMALL = np.array([15.0, 16.0, 14.0]), np.array([37.0, 16.0, 14.0])
"""Centres (i, j, k) of a hollow ball of 9 voxels and of a full one of 5; a rod of 2 voxels joins them.  A block of
3 x 3 x 3 voxels lies apart: the scan has three surfaces, that of the hollow counted."""
BONE_HU = 200
"""The iso value of `clrecon mesh` where none is given; the surfaces of balls and rod are where the scan has it."""


def make_voxels() -> np.ndarray:
    """HU of the scan, int16 [k, j, i]."""
    k, j, i = np.indices(SHAPE).astype(np.float64)

    def away(centre: np.ndarray) -> np.ndarray:
        return np.sqrt((i - centre[0]) ** 2 + (j - centre[1]) ** 2 + (k - centre[2]) ** 2)

    large = np.minimum(9.3 - away(LARGE), away(LARGE) - 3.7)
    small = 5.2 - away(SMALL)
    rod = np.minimum(1.2 - np.sqrt((j - 16) ** 2 + (k - 14) ** 2), np.minimum(i - 15, 37 - i))
    rod = np.where(away(LARGE) < 5, -10.0, rod)
    voxels = np.clip(np.rint(150.0 * np.maximum(np.maximum(large, small), rod) + BONE_HU), -100, 700)
    voxels[32:35, 35:38, 40:43] = 600
    return voxels.astype(np.int16)


def to_lps(ijk: Any) -> np.ndarray:
    return np.asarray(ijk) @ AFFINE[:3, :3].T + AFFINE[:3, 3]


def box_around(centre: np.ndarray, half_side_mm: float, space: str = "lps") -> str:
    """The rule of a region that is a cube about a place in index coordinates (i, j, k)."""
    low, high = to_lps(centre) - half_side_mm, to_lps(centre) + half_side_mm
    if space == "ras":
        low[:2], high[:2] = -high[:2], -low[:2]
    return "box:" + ",".join(f"{value:.3f}" for pair in zip(low, high, strict=True) for value in pair)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two balls, of which one is hollow, joined by a rod, and a block; see `make_voxels`."""
    path = tmp_path_factory.mktemp("region") / "scan.nrrd"
    write_nrrd(path, make_voxels(), AFFINE)
    return path


@pytest.fixture(scope="module")
def map_file(scan: Path) -> Path:
    """A label map of the scan: 2 about the small ball, 3 about the block."""
    labels = np.zeros(SHAPE, np.uint8)
    labels[5:24, 5:26, 30:46] = 2
    labels[30:37, 33:40, 38:45] = 3
    write_nrrd(scan.parent / "map.nrrd", labels, AFFINE)
    return scan.parent / "map.nrrd"


@pytest.fixture
def mesh_with(device: Any, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """A function that runs ``clrecon mesh`` with options and returns its report, and the vertices of its mesh."""

    def run(*options: str) -> tuple[dict[str, Any], np.ndarray]:
        output = str(tmp_path / "out.ply")
        code = main(["mesh", str(scan), "-o", output, "--json", "--device", str(device.index), *options])
        report = json.loads(capsys.readouterr().out)
        assert code == 0, report
        return report, np.asarray(read_points(output).points)

    return run


HALF_SIDE_MM, LARGE_HALF_SIDE_MM, VOXEL_MM = 6.43, 8.4, 0.8
"""Of boxes that hold the small ball and no other bone, and the large one, of 9.3 voxels."""


def test_scan_without_a_region_is_meshed_whole(mesh_with: Any) -> None:
    report, _ = mesh_with()
    assert (report["components"], report["volume"].get("region")) == (3, None)


def test_region_of_a_box_keeps_the_surface_in_it_and_closes_it(mesh_with: Any) -> None:
    report, vertices = mesh_with("--region", box_around(SMALL, HALF_SIDE_MM))

    assert (report["components"], report["closed"]) == (1, True)
    assert np.abs(vertices - to_lps(SMALL)).max() < HALF_SIDE_MM + VOXEL_MM


def test_report_of_a_region_counts_its_voxels_and_cells(mesh_with: Any) -> None:
    report, _ = mesh_with("--region", box_around(SMALL, HALF_SIDE_MM))

    ijk = np.stack(np.indices(SHAPE[::-1]).reshape(3, -1), axis=1)
    inside = (np.abs(to_lps(ijk) - to_lps(SMALL)) <= HALF_SIDE_MM).all(axis=1).reshape(SHAPE[::-1])
    cells = np.lib.stride_tricks.sliding_window_view(inside, (2, 2, 2)).all(axis=(3, 4, 5))  # with all eight corners
    facts = report["volume"]["region"]
    assert (facts["voxels"], facts["voxels_all"]) == (np.count_nonzero(inside), inside.size)
    assert (facts["cells"], facts["cells_all"]) == (np.count_nonzero(cells), cells.size)
    assert any(f"{facts['voxels']:,} of {inside.size:,} voxels stay" in warning for warning in report["warnings"])


def test_region_of_a_box_in_ras_is_that_in_lps_with_x_and_y_turned(mesh_with: Any) -> None:
    _, in_lps = mesh_with("--region", box_around(SMALL, HALF_SIDE_MM))
    _, in_ras = mesh_with("--region", box_around(SMALL, HALF_SIDE_MM, "ras"), "--space", "ras")

    np.testing.assert_allclose(in_ras, in_lps, atol=tolerances.FRAME_MM)  # points of a file that says RAS are turned


@pytest.mark.parametrize(
    ("rules", "components", "near"),
    [
        pytest.param(["hu:100,3000", "seed:{large}"], 2, LARGE, id="grown from a seed: ball and its hollow"),
        pytest.param(["label:{map}:3"], 1, np.array([41.0, 36.0, 33.0]), id="label of the block"),
        pytest.param(["label:{map}:2"], 1, SMALL, id="label of the small ball"),
        pytest.param(["mask:{map}"], 2, None, id="all labels"),
        pytest.param(["mask:{map}", "hu:300,3000", "seed:{small}"], 1, SMALL, id="grown within all labels"),
        pytest.param(["label:{map}:3", "label:{map}:2"], 2, None, id="two labels"),
        pytest.param(["tube:8:{line}"], 1, SMALL, id="tube about a line"),
    ],
)
def test_rules_of_a_region_keep_the_components_that_they_choose(
    mesh_with: Any, map_file: Path, tmp_path: Path, rules: list[str], components: int, near: np.ndarray | None
) -> None:
    line_file = tmp_path / "line.csv"
    ends = to_lps([SMALL - (0, 0, 9), SMALL + (0, 0, 9)])
    line_file.write_text("x,y,z\n" + "\n".join(",".join(f"{v:.3f}" for v in point) for point in ends) + "\n")
    in_the_wall_of_large = ",".join(f"{v:.3f}" for v in to_lps(LARGE + (6, 0, 0)))
    middle_of_small = ",".join(f"{v:.3f}" for v in to_lps(SMALL))
    names = {"map": map_file, "line": line_file, "large": in_the_wall_of_large, "small": middle_of_small}

    report, vertices = mesh_with(*(part for rule in rules for part in ("--region", rule.format(**names))))

    assert (report["components"], report["closed"]) == (components, True)
    if near is not None:
        assert np.linalg.norm(vertices - to_lps(near), axis=1).min() < 10.0  # mm, the radius of the large ball and more


def test_report_of_a_region_of_labels_does_not_name_the_folder_of_their_file(mesh_with: Any, map_file: Path) -> None:
    report, _ = mesh_with("--region", f"label:{map_file}:3")
    assert str(map_file.parent) not in json.dumps(report["volume"])


def test_opening_removes_the_rod_between_two_balls(mesh_with: Any) -> None:
    report, _ = mesh_with("--preprocess", "open:2")

    # Two balls, and the hollow of one; the block of 2.4 x 2.4 x 3 mm goes with the rod.
    assert (report["components"], report["closed"]) == (3, True)


def test_report_of_opening_counts_the_bone_that_it_took_and_warns_of_it(mesh_with: Any) -> None:
    report, _ = mesh_with("--preprocess", "open:2")

    (step,) = report["volume"]["preprocess"]
    assert (step["step"], step["band_hu"]) == ("open:2", [BONE_HU, None])
    assert step["voxels"] == np.count_nonzero(make_voxels() >= BONE_HU)
    assert 0 < step["taken"] < 0.1 * step["voxels"]  # rod and block
    assert step["added"] == 0
    assert step["outside_hu"] < BONE_HU < step["inside_hu"]
    assert any(f"open:2 took {step['taken']:,} of" in warning for warning in report["warnings"])


def test_filling_adds_the_voxels_of_the_hollow_of_a_ball(mesh_with: Any) -> None:
    report, _ = mesh_with("--preprocess", "fill", "--region", box_around(LARGE, LARGE_HALF_SIDE_MM))

    k, j, i = np.indices(SHAPE)
    in_the_hollow = np.sqrt((i - LARGE[0]) ** 2 + (j - LARGE[1]) ** 2 + (k - LARGE[2]) ** 2) < 5.0
    (step,) = report["volume"]["preprocess"]
    assert (step["step"], step["added"]) == ("fill", np.count_nonzero(in_the_hollow & (make_voxels() < BONE_HU)))
    assert report["components"] == 1


def test_steps_and_the_region_among_them_are_reported_in_their_order(mesh_with: Any) -> None:
    box = box_around(LARGE, LARGE_HALF_SIDE_MM)

    report, _ = mesh_with("--preprocess", "bilateral:0.8:30,region,level:250,fill", "--region", box)

    *_, fill = steps = report["volume"]["preprocess"]
    assert [step["step"] for step in steps] == ["bilateral:0.8:30", "region", "level:250", "fill"]
    assert fill["band_hu"] == [250.0, None]  # of the level set before
    assert all("seconds" in step for step in steps)
    assert report["volume"]["region"]["rules"] == [str(rule) for rule in parse_region_rules(box)]


@pytest.mark.parametrize(
    ("step", "numbers"),
    daily_rows(
        3,
        [
            ("bilateral-2d:0.8:30", {"dimensions": 2, "sigma_mm": 0.8, "sigma_hu": 30.0}),
            ("bilateral-near:0.8:30", {"near_hu": 200.0, "rings": 2}),
            ("median:1", {"radius_mm": 1.0}),
            ("gaussian:0.5", {"sigma_mm": 0.5}),
            ("curvature-flow:3", {"iterations": 3}),
            ("non-local-means:20", {"sigma_hu": 20.0}),
        ],
    ),
)
def test_filter_step_is_reported_with_the_numbers_that_it_was_given(
    mesh_with: Any, step: str, numbers: dict[str, Any]
) -> None:
    if step.startswith(("median", "curvature-flow")):
        pytest.importorskip("SimpleITK")

    report, _ = mesh_with("--preprocess", step)

    (reported,) = report["volume"]["preprocess"]
    assert {"step": step, **numbers}.items() <= reported.items()


def test_range_of_hu_of_the_whole_scan_is_that_of_its_voxels(mesh_with: Any) -> None:
    report, _ = mesh_with()
    assert report["volume"]["hu_range"] == [make_voxels().min(), make_voxels().max()]


def test_range_of_hu_with_a_region_begins_at_the_value_outside_of_it(mesh_with: Any) -> None:
    report, _ = mesh_with("--region", box_around(SMALL, HALF_SIDE_MM))
    outside_hu = -1024.0
    assert report["volume"]["hu_range"] == [outside_hu, make_voxels().max()]


def test_range_of_hu_after_opening_holds_the_value_of_what_was_taken(mesh_with: Any) -> None:
    report, _ = mesh_with("--preprocess", "open:2")
    (step,) = report["volume"]["preprocess"]
    assert report["volume"]["hu_range"][0] == min(make_voxels().min(), step["outside_hu"])


def test_cloud_has_the_points_in_the_region(device: Any, scan: Path, tmp_path: Path, printed: Printer) -> None:
    box = box_around(SMALL, HALF_SIDE_MM)
    command = ["cloud", str(scan), "-o", str(tmp_path / "c.ply"), "--device", str(device.index), "--json"]

    assert main([*command, "--region", box]) == 0

    assert printed().report()["volume"]["region"]["rules"] == [str(rule) for rule in parse_region_rules(box)]
    points = np.asarray(read_points(str(tmp_path / "c.ply")).points)
    assert len(points) > 100  # 568 were measured; the ball has 4/3 pi 5.2^3 = 589 voxels
    assert np.abs(points - to_lps(SMALL)).max() < HALF_SIDE_MM + VOXEL_MM


def test_picture_shows_the_region_alone_and_less_of_it_after_erosion(
    device: Any, scan: Path, tmp_path: Path, printed: Printer
) -> None:
    depth = str(tmp_path / "d.npy")
    command = ["render", str(scan), "-o", str(tmp_path / "p.png"), "--mode", "surface", "--size", "64"]
    command += ["--depth", depth, "--device", str(device.index), "--json"]

    def area_with(*options: str) -> float:
        assert main([*command, *options]) == 0
        pixel_mm = printed().report()["pictures"][0]["pixel_mm"]  # pictures fit what is left
        return float(np.isfinite(np.load(depth)).sum() * pixel_mm**2)

    box = ["--region", box_around(SMALL, HALF_SIDE_MM)]
    whole_mm2, region_mm2, eroded_mm2 = area_with(), area_with(*box), area_with(*box, "--preprocess", "erode:1")

    assert whole_mm2 > 2 * region_mm2  # balls of 9 and 5 voxels, a rod and a block against the ball of 5
    assert region_mm2 > 1.1 * eroded_mm2 > 0  # a ball of 4.2 mm loses 1 mm of its radius


def test_surface_below_a_level_is_closed_at_its_region_by_a_value_above(mesh_with: Any) -> None:
    half_side_mm = 9.0
    box = box_around(SMALL, half_side_mm)
    report, vertices = mesh_with("--below", "0", "--keep-outside", "--region", box)

    assert report["closed"]
    assert np.abs(vertices - to_lps(SMALL)).max() < half_side_mm + VOXEL_MM
    assert report["volume"]["region"]["outside_hu"] > 0


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--region", "box:900,910,900,910,900,910"], 3, "no voxel lies in the box"),
        (["--region", "hu:100,300", "--region", "box:,,,,138.5,"], 3, "region is empty"),
        (["--region", "hu:5000,"], 3, "holds no voxel"),
        (["--region", "hu:200,", "--region", "seed:900,0,0"], 3, "lies outside of the volume"),
        (["--region", "mask:missing.nrrd"], 3, "no label map"),
        (["--region", "tube:30"], 4, "spinal canal"),
        (["--region", "tube:30:missing.csv"], 3, "missing.csv"),
        (["--region", "ball:3"], 3, "the rules are"),
        (["--preprocess", "erode:3"], 4, "--allow-bone-loss"),
        (["--preprocess", "erode:50", "--allow-bone-loss"], 2, "takes all"),
        (["--preprocess", "open:1,5"], 3, "'5'"),
        (["--preprocess", "level:9000,open:2"], 2, "nothing to work on"),
        (["--preprocess", "open:2", "--hu", "200,300"], 3, "level:200"),
        (["--preprocess", "region"], 3, "there is none"),
    ],
)
def test_region_or_steps_without_sense_are_refused_in_one_line_and_write_nothing(
    device: Any, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], code: int,
    words: str,
) -> None:  # fmt: skip
    output = tmp_path / "out.stl"

    assert main(["mesh", str(scan), "-o", str(output), "--device", str(device.index), *options]) == code

    (message,) = (line for line in capsys.readouterr().err.splitlines() if "error:" in line)
    assert words in message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("bands", "voxel_type", "expected"),
    [
        pytest.param([(200.0, np.inf)], np.int16, -1024.0, id="above 200 HU"),
        pytest.param([], np.float32, -1024.0, id="no band"),
        pytest.param([(-np.inf, -400.0)], np.int16, -400.0 + (-400.0 + 1024.0), id="below -400 HU"),
        pytest.param([(-2000.0, 100.0)], np.int16, 100.0 + (100.0 + 1024.0), id="a band from below air"),
        pytest.param([(200.0, np.inf)], np.uint8, 0.0, id="no negative values"),
    ],
)
def test_value_outside_of_a_region_is_air_or_where_air_is_inside_as_far_above_the_band_as_that_is_above_air(
    bands: list[tuple[float, float]], voxel_type: type, expected: float
) -> None:
    assert value_outside(bands, np.dtype(voxel_type)) == expected


def test_warning_of_a_label_file_is_reported_where_a_region_reads_it(tmp_path: Path) -> None:
    scan = write_nrrd(tmp_path / "ct.nrrd", make_voxels(), AFFINE)
    without_a_value = {"Segment0_LabelValue": "1", "Segment0_Name": "bone", "Segment1_Name": "no value"}
    labels = write_nrrd(tmp_path / "map.nrrd", (make_voxels() > 200).astype(np.uint8), AFFINE, **without_a_value)
    output, report = str(tmp_path / "a.stl"), tmp_path / "r.json"
    command = ["mesh", str(scan), "-o", output, "--hu", "200", "-q", "--report", str(report)]

    assert main([*command, "--region", f"label:{labels}:bone"]) == 0

    warning = "1 of 2 segments have no LabelValue: their names are not known"
    assert warning in json.loads(report.read_text())["warnings"]
