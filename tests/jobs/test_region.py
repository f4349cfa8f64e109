"""Region of interest and preprocessing in the jobs: meshes, clouds and pictures of a part of a scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
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
"""Centres (i, j, k) of a hollow ball of 9 voxels and of a full one of 5; a rod of 2 voxels joins them."""


def make_voxels() -> np.ndarray:
    k, j, i = np.indices(SHAPE).astype(np.float64)

    def away(centre: np.ndarray) -> np.ndarray:
        return np.sqrt((i - centre[0]) ** 2 + (j - centre[1]) ** 2 + (k - centre[2]) ** 2)

    large = np.minimum(9.3 - away(LARGE), away(LARGE) - 3.7)
    small = 5.2 - away(SMALL)
    rod = np.minimum(1.2 - np.sqrt((j - 16) ** 2 + (k - 14) ** 2), np.minimum(i - 15, 37 - i))
    rod = np.where(away(LARGE) < 5, -10.0, rod)
    voxels = np.clip(np.rint(150.0 * np.maximum(np.maximum(large, small), rod) + 200.0), -100, 700)
    voxels[32:35, 35:38, 40:43] = 600
    return voxels.astype(np.int16)


def to_lps(ijk: Any) -> np.ndarray:
    return np.asarray(ijk) @ AFFINE[:3, :3].T + AFFINE[:3, 3]


def box_around(centre: np.ndarray, mm: float, space: str = "lps") -> str:
    low, high = to_lps(centre) - mm, to_lps(centre) + mm
    if space == "ras":
        low[:2], high[:2] = -high[:2], -low[:2]
    return "box:" + ",".join(f"{value:.3f}" for pair in zip(low, high, strict=True) for value in pair)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("region") / "scan.nrrd"
    write_nrrd(path, make_voxels(), AFFINE)
    return path


@pytest.fixture(scope="module")
def map_file(scan: Path) -> Path:
    labels = np.zeros(SHAPE, np.uint8)
    labels[5:24, 5:26, 30:46] = 2
    labels[30:37, 33:40, 38:45] = 3
    write_nrrd(scan.parent / "map.nrrd", labels, AFFINE)
    return scan.parent / "map.nrrd"


@pytest.fixture
def report_of(device: Any, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run ``clrecon mesh`` and return its report, and the vertices of its mesh."""

    def run(*options: str) -> tuple[dict[str, Any], np.ndarray]:
        output = str(tmp_path / "out.ply")
        code = main(["mesh", str(scan), "-o", output, "--json", "--device", str(device.index), *options])
        report = json.loads(capsys.readouterr().out)
        assert code == 0, report
        return report, np.asarray(read_points(output).points)

    return run


def test_a_box_keeps_what_lies_in_it(report_of: Any) -> None:
    whole, _ = report_of()
    assert (whole["components"], whole["volume"].get("region")) == (3, None)
    report, vertices = report_of("--region", box_around(SMALL, 6.43))
    assert (report["components"], report["closed"]) == (1, True)
    assert np.abs(vertices - to_lps(SMALL)).max() < 6.43 + 0.8
    facts = report["volume"]["region"]
    i, j, k = np.indices(SHAPE[::-1]).reshape(3, -1)
    inside = (np.abs(to_lps(np.stack([i, j, k], axis=1)) - to_lps(SMALL)) <= 6.43).all(axis=1)
    marked = inside.reshape(SHAPE[::-1])
    cells = np.lib.stride_tricks.sliding_window_view(marked, (2, 2, 2)).all(axis=(3, 4, 5))
    assert facts["voxels"] == np.count_nonzero(marked)
    assert facts["cells"] == np.count_nonzero(cells)
    assert facts["voxels_all"] == marked.size
    assert facts["cells_all"] == cells.size
    assert any(f"{facts['voxels']:,} of {marked.size:,} voxels stay" in warning for warning in report["warnings"])


def test_a_box_follows_the_frame_of_the_output(report_of: Any) -> None:
    _, in_lps = report_of("--region", box_around(SMALL, 6.43))
    _, in_ras = report_of("--region", box_around(SMALL, 6.43, "ras"), "--space", "ras")
    np.testing.assert_allclose(in_ras, in_lps, atol=1e-4)  # the file says its frame


@pytest.mark.parametrize(
    ("rules", "components", "near"),
    [
        (["hu:100,3000", "seed:{large}"], 2, LARGE),
        (["label:{map}:3"], 1, np.array([41.0, 36.0, 33.0])),
        (["label:{map}:2"], 1, SMALL),
        (["mask:{map}"], 2, None),
        (["mask:{map}", "hu:300,3000", "seed:{small}"], 1, SMALL),
        (["label:{map}:3", "label:{map}:2"], 2, None),
        (["tube:8:{line}"], 1, SMALL),
    ],
)
def test_rules_choose_their_parts(
    report_of: Any, map_file: Path, tmp_path: Path, rules: list[str], components: int, near: np.ndarray | None
) -> None:
    line = tmp_path / "line.csv"
    ends = to_lps([SMALL - (0, 0, 9), SMALL + (0, 0, 9)])
    line.write_text("x,y,z\n" + "\n".join(",".join(f"{v:.3f}" for v in point) for point in ends) + "\n")
    places = {name: ",".join(f"{v:.3f}" for v in to_lps(at)) for name, at in
              (("large", LARGE + (6, 0, 0)), ("small", SMALL))}  # fmt: skip
    given = [part for rule in rules for part in ("--region", rule.format(map=map_file, line=line, **places))]
    report, vertices = report_of(*given)
    assert (report["components"], report["closed"]) == (components, True)
    if near is not None:
        assert np.linalg.norm(vertices - to_lps(near), axis=1).min() < 10.0
    assert str(map_file.parent) not in json.dumps(report["volume"])


def test_opening_parts_what_a_rod_joins(report_of: Any) -> None:
    report, _ = report_of("--preprocess", "open:2")
    # the hollow ball has two surfaces; the small block of 2.4 x 2.4 x 3 mm goes with the rod
    assert (report["components"], report["closed"]) == (3, True)
    (step,) = report["volume"]["preprocess"]
    assert step["step"] == "open:2"
    assert step["band_hu"] == [200.0, None]
    assert step["voxels"] == np.count_nonzero(make_voxels() >= 200)
    assert 0 < step["taken"] < 0.1 * step["voxels"]
    assert step["added"] == 0
    assert step["outside_hu"] < 200 < step["inside_hu"]
    assert any(f"open:2 took {step['taken']:,} of" in warning for warning in report["warnings"])


def test_filling_closes_a_hollow_ball(report_of: Any) -> None:
    report, _ = report_of("--preprocess", "fill", "--region", box_around(LARGE, 8.4))
    (step,) = report["volume"]["preprocess"]
    k, j, i = np.indices(SHAPE)
    in_the_hollow = np.sqrt((i - LARGE[0]) ** 2 + (j - LARGE[1]) ** 2 + (k - LARGE[2]) ** 2) < 5.0
    assert (step["step"], step["added"]) == ("fill", np.count_nonzero(in_the_hollow & (make_voxels() < 200)))
    assert report["components"] == 1


def test_steps_run_in_their_order_and_a_region_has_its_place(report_of: Any) -> None:
    box = box_around(LARGE, 8.4)
    report, _ = report_of("--preprocess", "bilateral:0.8:30,region,level:250,fill", "--region", box)
    steps = report["volume"]["preprocess"]
    assert [step["step"] for step in steps] == ["bilateral:0.8:30", "region", "level:250", "fill"]
    assert steps[3]["band_hu"] == [250.0, None]
    assert all(step["seconds"] >= 0.0 for step in steps)
    assert report["volume"]["region"]["rules"] == [str(parse_region_rules(box)[0])]


@pytest.mark.parametrize(
    ("step", "given"),
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
def test_every_filter_takes_its_numbers(report_of: Any, step: str, given: dict[str, Any]) -> None:
    if step.startswith(("median", "curvature-flow")):
        pytest.importorskip("SimpleITK")
    report, _ = report_of("--preprocess", step)
    (told,) = report["volume"]["preprocess"]
    assert {"step": step, **given}.items() <= told.items()


def test_the_range_of_hu_is_that_of_what_stays(report_of: Any) -> None:
    whole, _ = report_of()
    assert whole["volume"]["hu_range"] == [-100.0, 700.0]
    report, _ = report_of("--region", box_around(SMALL, 6.43))
    assert report["volume"]["hu_range"] == [-1024.0, 700.0]
    report, _ = report_of("--preprocess", "open:2")
    assert report["volume"]["hu_range"][0] == min(-100.0, report["volume"]["preprocess"][0]["outside_hu"])


def test_a_cloud_and_a_picture_are_of_the_region(device: Any, scan: Path, tmp_path: Path, printed: Printer) -> None:
    box = box_around(SMALL, 6.43)
    given = ["--device", str(device.index), "--region", box, "--json"]
    assert main(["cloud", str(scan), "-o", str(tmp_path / "c.ply"), *given]) == 0
    assert printed().report()["volume"]["region"]["rules"] == [str(parse_region_rules(box)[0])]
    points = np.asarray(read_points(str(tmp_path / "c.ply")).points)
    assert len(points) > 100
    assert np.abs(points - to_lps(SMALL)).max() < 6.43 + 0.8
    picture = ["--mode", "surface", "--size", "64", "--depth", str(tmp_path / "d.npy")]
    shares = []
    for more in ([], ["--region", box], ["--region", box, "--preprocess", "erode:1"]):
        arguments = ["render", str(scan), "-o", str(tmp_path / "p.png"), *given[:2], *more, "--json", *picture]
        assert main(arguments) == 0
        step = printed().report()["pictures"][0]["pixel_mm"]  # pictures fit what is left
        shares.append(np.isfinite(np.load(tmp_path / "d.npy")).sum() * step**2)
    assert shares[0] > 2 * shares[1] > 2.2 * shares[2] > 0


def test_surface_below_a_level_is_cut_by_a_region_too(report_of: Any) -> None:
    report, vertices = report_of("--below", "0", "--keep-outside", "--region", box_around(SMALL, 9.0))
    assert report["closed"]
    assert np.abs(vertices - to_lps(SMALL)).max() < 9.0 + 0.8
    assert report["volume"]["region"]["outside_hu"] > 0


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--region", "box:900,910,900,910,900,910"], 3, "no voxel lies in the box"),
        (["--region", "hu:100,300", "--region", "box:,,,,138.5,"], 3, "region is empty"),
        (["--region", "hu:5000,"], 3, "holds no voxel"),
        (["--region", "hu:200,", "--region", "seed:900,0,0"], 3, "900"),
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
def test_bad_input_is_one_line_and_writes_nothing(
    device: Any, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], code: int,
    words: str,
) -> None:  # fmt: skip
    output = tmp_path / "out.stl"
    assert main(["mesh", str(scan), "-o", str(output), "--device", str(device.index), *options]) == code
    (message,) = (line for line in capsys.readouterr().err.splitlines() if "error:" in line)
    assert words in message
    assert not list(tmp_path.iterdir())


def test_the_value_outside_is_outside() -> None:
    inf = float("inf")
    assert value_outside([(200.0, inf)], np.dtype(np.int16)) == -1024.0
    assert value_outside([], np.dtype(np.float32)) == -1024.0
    assert value_outside([(-inf, -400.0)], np.dtype(np.int16)) == 224.0
    assert value_outside([(-2000.0, 100.0)], np.dtype(np.int16)) == 1224.0
    assert value_outside([(200.0, inf)], np.dtype(np.uint8)) == 0.0


def test_warnings_of_a_label_file_are_those_of_its_region(tmp_path):
    scan = write_nrrd(tmp_path / "ct.nrrd", make_voxels(), AFFINE)
    fields = {"Segment0_LabelValue": "1", "Segment0_Name": "bone", "Segment1_Name": "no value"}
    labels = write_nrrd(tmp_path / "map.nrrd", (make_voxels() > 200).astype(np.uint8), AFFINE, **fields)
    words = [
        "mesh",
        str(scan),
        "-o",
        str(tmp_path / "a.stl"),
        "--hu",
        "200",
        "-q",
        "--report",
        str(tmp_path / "r.json"),
    ]
    assert main([*words, "--region", f"label:{labels}:bone"]) == 0
    said = "1 of 2 segments have no LabelValue: their names are not known"
    assert said in json.loads((tmp_path / "r.json").read_text())["warnings"]
