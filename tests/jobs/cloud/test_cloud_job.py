"""`clrecon cloud`: every option end to end on a small volume, what is refused, and what is left when a step fails."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_files import write_nrrd
from printed_text import Printer
from refusals import refused

import clrecon
from clrecon.cli.main import main
from clrecon.errors import RefusedInputError, UsageError
from clrecon.jobs.cloud.job import CloudFiles, make_cloud
from clrecon.jobs.cloud.settings import STEPS, CloudSettings, Clustering
from clrecon.jobs.presets import DEFAULT_PRESET, PRESETS

pytestmark = pytest.mark.first_device

AFFINE = np.array([[0.8, 0.1, 0.0, -20.0], [-0.1, 0.8, 0.0, 30.0], [0.0, 0.0, 1.0, 100.0], [0.0, 0.0, 0.0, 1.0]])
BAND = "200,3000"


def make_voxels() -> np.ndarray:
    """Two balls of 9 and 5 voxels, a plate without thickness below them, and lone voxels around."""
    k, j, i = np.indices((40, 44, 48))
    balls = [9.3 - np.sqrt((k - 14) ** 2 + (j - 16) ** 2 + (i - 15) ** 2)]
    balls.append(5.2 - np.sqrt((k - 26) ** 2 + (j - 16) ** 2 + (i - 34) ** 2))
    voxels = np.clip(np.rint(100.0 * np.max(balls, axis=0) + 200.0), -1000, 900).astype(np.int16)
    voxels[4:36, 38, 4:44] = 600
    for place in ((36, 5, 5), (2, 30, 44), (37, 30, 40)):
        voxels[place] = 700
    return voxels


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("cloud") / "scan.nrrd"
    write_nrrd(path, make_voxels(), AFFINE)
    return path


@pytest.fixture
def cloud_command(device: Any, tmp_path: Path) -> Any:
    """Run the command in an empty folder; returns the exit code."""

    def run(source: Path, *options: str, output: str = "out.ply") -> int:
        return main(["cloud", str(source), "-o", str(tmp_path / output), "--device", str(device.index), *options])

    return run


def run_with_report(folder: Path, device: Any, source: Path, *options: str) -> dict[str, Any]:
    """Write out.npz and r.json into an empty folder; return the report."""
    files = ["-o", str(folder / "out.npz"), "--report", str(folder / "r.json")]
    assert main(["cloud", str(source), *files, "--device", str(device.index), *options]) == 0
    return dict(json.loads((folder / "r.json").read_text()))


@pytest.fixture(scope="module")
def surface_folder(device: Any, scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """out.npz and r.json of a run without options."""
    folder = tmp_path_factory.mktemp("surface")
    run_with_report(folder, device, scan)
    return folder


def test_points_of_the_surface_are_those_of_the_function(device: Any, scan: Path, surface_folder: Path) -> None:
    level = PRESETS[DEFAULT_PRESET].iso_value
    expected = clrecon.extract_points(clrecon.read_volume(scan), level, kind="surface", device=device)
    written = clrecon.read_points(surface_folder / "out.npz")
    assert np.array_equal(written.points, expected.points)
    assert np.array_equal(written.normals, expected.normals)
    assert (written.hu == level).all()


def test_report_of_a_surface_cloud_describes_the_points_in_its_file(surface_folder: Path) -> None:
    written = clrecon.read_points(surface_folder / "out.npz")
    report = json.loads((surface_folder / "r.json").read_text())
    expected = {
        "kind": "surface", "iso_value_hu": PRESETS[DEFAULT_PRESET].iso_value,
        "points": len(written), "points_first": len(written), "removed": {},
        "normals": True, "has_hu": True, "labels": 0,
    }  # fmt: skip
    assert {name: report[name] for name in expected} == expected
    assert np.allclose(report["bounds_mm"], [written.points.min(axis=0), written.points.max(axis=0)])
    assert [step["step"] for step in report["steps"]] == ["points"]


def test_report_of_a_cloud_names_its_only_output(surface_folder: Path) -> None:
    (output,) = json.loads((surface_folder / "r.json").read_text())["outputs"]
    assert output["bytes"] == (surface_folder / "out.npz").stat().st_size
    assert {path.name for path in surface_folder.iterdir()} == {"out.npz", "r.json"}


def test_json_of_a_cloud_is_its_report(scan: Path, tmp_path: Path, cloud_command: Any, printed: Printer) -> None:
    assert cloud_command(scan, "--report", str(tmp_path / "r.json"), "--json") == 0
    report = printed().report()
    assert report == json.loads((tmp_path / "r.json").read_text())


CLUSTERED = ("--keep", "no-sheets", "--hu", BAND, "--cluster", "eps=1.2,min=4", "--keep", "largest:1")
"""Of the scan the large ball: label 1 is the small ball, 2 the plate (a sheet), the three lone voxels are noise."""


@pytest.fixture(scope="module")
def clustered_folder(device: Any, scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """out.npz, went.npz and r.json of a run with the options `CLUSTERED`."""
    folder = tmp_path_factory.mktemp("clustered")
    run_with_report(folder, device, scan, *CLUSTERED, "--removed", str(folder / "went.npz"))
    return folder


def test_clustered_cloud_and_removed_points_are_those_of_the_functions(
    device: Any, scan: Path, clustered_folder: Path
) -> None:
    volume = clrecon.read_volume(scan)
    first = clrecon.extract_points(volume, hu=(200, 3000), device=device)
    clusters = clrecon.cluster_points(first, 1.2, 4, volume=volume, device=device)
    expected = clrecon.keep_clusters(clusters.cloud, ["no-sheets", "largest:1"], cores=clusters.cores)
    written, went = (clrecon.read_points(clustered_folder / name) for name in ("out.npz", "went.npz"))
    assert np.array_equal(written.points, expected.cloud.points)
    assert np.array_equal(written.labels, expected.cloud.labels)
    assert np.array_equal(went.points, first.points)
    assert np.array_equal(went.labels == 0, expected.removed == 0)


def test_the_kept_cluster_is_the_large_ball(clustered_folder: Path) -> None:
    z = clrecon.read_points(clustered_folder / "out.npz").points[:, 2]
    assert (np.abs(z - 114.0) < 10.0).all()  # radius 9.3 mm around slice 14, slice 0 at 100 mm


def test_report_of_clusters_counts_what_was_removed_and_why(clustered_folder: Path) -> None:
    report = json.loads((clustered_folder / "r.json").read_text())
    first = clrecon.read_points(clustered_folder / "went.npz")
    assert report["removed"]["noise"] == 3
    assert report["removed"]["sheet"] == 32 * 40  # every voxel of the plate
    assert report["removed_labels"][2] == {"label": 2, "reason": "sheet"}
    assert report["points_first"] == len(first) == sum(report["removed"].values()) + report["points"]
    assert report["gates"][0]["ok"]


def test_clusters_are_made_before_points_are_kept(clustered_folder: Path) -> None:
    report = json.loads((clustered_folder / "r.json").read_text())
    assert [step["step"] for step in report["steps"]] == ["points", "clusters", "keep"]
    assert list(STEPS).index("clusters") < list(STEPS).index("keep")
    assert [output["what"] for output in report["outputs"]] == ["cloud", "removed"]


def test_a_clustered_cloud_is_printed_with_its_counts(scan: Path, cloud_command: Any, printed: Printer) -> None:
    assert cloud_command(scan, *CLUSTERED) == 0
    printed().assert_output(3, 32 * 40)  # lone voxels, and those of the plate


@pytest.fixture(scope="module")
def foreign_slice(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scan with a pattern of another one in slice 14, which lies at 114 mm."""
    voxels = make_voxels()
    voxels[14, 4:40, :40] = np.where(np.indices((36, 40)).sum(axis=0) % 7 < 2, 900, -1000)
    path = tmp_path_factory.mktemp("foreign") / "scan.nrrd"
    write_nrrd(path, voxels, AFFINE)
    return path


KINDS_OF_POINTS = pytest.mark.parametrize(
    "options", [["--hu", BAND], ["--fov", "20"], ["--hu", BAND, "--points", "shell"]], ids=["band", "fov", "shell"]
)


@KINDS_OF_POINTS
def test_points_of_foreign_slices_stay_and_are_warned_of(
    options: list[str], foreign_slice: Path, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(foreign_slice, *options, output="kept.npz") == 0
    printed().assert_error("--ghost-slices", "slice", 14, 40)
    z = clrecon.read_points(tmp_path / "kept.npz").points[:, 2]
    assert (np.abs(z - 114.0) < 0.5).sum() > 300


@KINDS_OF_POINTS
def test_points_of_foreign_slices_are_dropped_on_request(
    options: list[str], foreign_slice: Path, device: Any, tmp_path: Path, printed: Printer
) -> None:
    report = run_with_report(tmp_path, device, foreign_slice, *options, "--ghost-slices", "drop")
    z = clrecon.read_points(tmp_path / "out.npz").points[:, 2]
    assert not (np.abs(z - 114.0) < 0.5).any()
    assert len(z) > 1000
    step = next(step for step in report["steps"] if step["step"] == "ghost slices")
    assert [entry["slice"] for entry in step["ghost_slices"]] == [14]
    assert step["slices"] == 40
    assert "unlike both" not in printed().everything


def test_report_counts_the_points_of_dropped_slices(foreign_slice: Path, device: Any, tmp_path: Path) -> None:
    report = run_with_report(tmp_path, device, foreign_slice, "--hu", BAND, "--ghost-slices", "drop")
    assert report["removed"] == {"ghost slice": report["points_first"] - report["points"]}
    assert report["removed"]["ghost slice"] > 300


def test_a_scan_without_foreign_slices_loses_nothing(scan: Path, tmp_path: Path, cloud_command: Any) -> None:
    assert cloud_command(scan, "--hu", BAND, output="a.npz") == 0
    assert cloud_command(scan, "--hu", BAND, "--ghost-slices", "drop", output="b.npz") == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_seeds_are_read_in_the_frame_of_the_output(scan: Path, tmp_path: Path, cloud_command: Any) -> None:
    centre = AFFINE[:3] @ (34, 16, 26, 1)
    for space, sign in (("lps", 1.0), ("ras", -1.0)):
        seed = ",".join(str(number) for number in centre * (sign, sign, 1.0))
        given = ["--hu", BAND, "--keep", f"seed:{seed}", "--space", space]
        assert cloud_command(scan, *given, output=f"{space}.ply") == 0
    lps, ras = (clrecon.read_points(tmp_path / f"{space}.ply") for space in ("lps", "ras"))
    assert np.allclose(lps.points, ras.points, atol=1e-4) and len(lps) < 1000
    assert np.linalg.norm(lps.points - centre, axis=1).max() < 5.5
    assert b"SPACE=RAS" in (tmp_path / "ras.ply").read_bytes()[:2000]


@pytest.mark.parametrize("kind", ["surface", "shell", "voxels"])
@pytest.mark.parametrize("extension", ["ply", "vtp", "npz", "xyz"])
def test_every_kind_of_points_is_written_to_every_format(
    kind: str, extension: str, scan: Path, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(scan, "--points", kind, "--hu", "250", output=f"a.{extension}") == 0
    said = capsys.readouterr()
    cloud = clrecon.read_points(tmp_path / f"a.{extension}")
    taken = "surface of 250 HU" if kind == "surface" else f"{kind} of 250 HU and more"
    assert len(cloud) > 200 and f"{len(cloud):,} points ({taken})" in said.out
    assert (cloud.normals is not None) == (kind == "surface" and extension != "xyz")
    assert ("XYZ has no place for normals" in said.err) == (kind == "surface" and extension == "xyz")


def test_labels_choose_points(scan: Path, tmp_path: Path, cloud_command: Any) -> None:
    labels = np.zeros(make_voxels().shape, np.uint8)
    labels[4:34, :30, :26], labels[4:34, :30, 26:] = 1, 2
    header = {f"Segment{n}_{what}": value for n, name in ((0, "left"), (1, "right")) for what, value in (
        ("LabelValue", str(n + 1)), ("Layer", "0"), ("Name", name))}  # fmt: skip
    write_nrrd(tmp_path / "labels.seg.nrrd", labels, AFFINE, **header)
    given = ["--labels", str(tmp_path / "labels.seg.nrrd")]
    assert cloud_command(scan, *given, "--label", "right", "--hu", BAND, output="r.ply") == 0
    assert cloud_command(scan, *given, "--label", "1", output="l.ply") == 0
    right, left = (clrecon.read_points(tmp_path / name) for name in ("r.ply", "l.ply"))
    assert np.linalg.norm(right.points - AFFINE[:3] @ (34, 16, 26, 1), axis=1).max() < 6.0
    assert np.linalg.norm(left.points - AFFINE[:3] @ (15, 16, 14, 1), axis=1).max() < 10.0


def test_the_placing_of_the_paper_says_how_wrong_it_is(
    scan: Path, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(scan, "--hu", BAND, "--paper", "--json") == 0
    report = printed().report()
    paper = report["steps"][0]["paper"]
    assert report["paper"] and paper["error_max_mm"] > 30.0
    assert np.ptp(clrecon.read_points(tmp_path / "out.ply").points[:, 2]) < 1e-3


def test_a_step_that_takes_more_than_noise_is_refused(
    device: Any, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    voxels = np.zeros((24, 24, 24), np.int16)
    voxels[::3, ::3, ::3] = 500  # lone voxels
    voxels[5:9, 5:9, 5:9] = 500
    write_nrrd(tmp_path / "scan.nrrd", voxels, np.eye(4))
    given = ["--hu", BAND, "--cluster", "eps=1.5,min=5"]
    assert cloud_command(tmp_path / "scan.nrrd", *given) == 4
    error = capsys.readouterr().err
    assert "points gone (" in error and "more than half is no noise" in error and "--allow-point-loss" in error
    assert {path.name for path in tmp_path.iterdir()} == {"scan.nrrd"}
    assert cloud_command(tmp_path / "scan.nrrd", *given, "--allow-point-loss") == 0
    assert "and was allowed" in capsys.readouterr().err
    settings = CloudSettings(hu=(200, 3000), clusters=Clustering(1.5, 5), device=str(device.index))
    with refused(RefusedInputError, "allow_point_loss=True"):
        make_cloud(tmp_path / "scan.nrrd", CloudFiles(tmp_path / "b.ply"), settings)


def test_a_rule_may_take_what_it_likes(scan: Path, tmp_path: Path, cloud_command: Any) -> None:
    """The smaller ball alone: most points go, because they were asked to."""
    centre = ",".join(str(number) for number in AFFINE[:3] @ (34, 16, 26, 1))
    assert cloud_command(scan, "--hu", BAND, "--keep", f"seed:{centre}", "--report", str(tmp_path / "r.json")) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["removed"]["other cluster"] > 0.5 * report["points_first"]


WRONG = (
    (["--points", "vertices"], "points are one of surface, cortex, shell, voxels"),
    (["--hu", "bone"], "no iso value N and no band LO,HI"),
    (["--hu", "1,2,3"], "no iso value N and no band LO,HI"),
    (["--hu", "300,200"], "holds nothing: give its lower end first"),
    (["--hu", "nan"], "HU are finite numbers"),
    (["--hu", BAND, "--points", "surface"], "a surface has one iso value, not a band"),
    (["--label", "L1"], "give its file too"),
    (["--cluster", "eps=0"], "eps of clusters is a length in mm"),
    (["--cluster", "eps"], "is not eps=MM,min=N"),
    (["--cluster", "min=x"], "min is no number: 'x'"),
    (["--cluster", "min=0"], "between 1 and 255"),
    (["--ghost-slices", "hide"], "ghost slices are kept or dropped: one of keep, drop, not 'hide'"),
    (["--viewpoint", "1,2,3"], "a viewpoint turns normals: ask for them too (--normals)"),
    (["--viewpoint", "1,2,3", "--normals"], "leave out --viewpoint, which is for clouds of points"),
    (["--viewpoint", "1,2", "--normals"], "no point: three numbers in mm"),
    (["--keep", "smallest"], "the rules are largest"),
    (["--hu", BAND, "--paper", "--cluster"], "where clusters mean nothing"),
    (["--denoise", "median"], "denoised by one of grid, bilateral, not 'median'"),
    (["--spacing", "1mm"], "'1mm' is no number: write the length in mm, without a unit"),
    (["--outliers", "few"], "argument --outliers: 'few' is no number (see"),
    (["--spacing", "0"], "the spacing of points is a length in mm"),
    (["--hu", BAND, "--surface", "out.stl"], "ask for them (--normals)"),
    (["--surface", "out.xyz"], ".stl"),
    (["--outliers", "-1"], "standard deviations above 0"),
    (["--paper"], "not for points of a surface"),
    (["--input-space", "ras"], "a scan says its own frame: leave out --input-space"),
    (["--space", "xyz"], "xyz"),
    (["--memory", "0"], "memory"),
    (["--removed", "out.stl"], "use one of .ply"),
    (["--nonsense"], "unrecognized arguments"),
)


@pytest.mark.parametrize(("options", "says"), WRONG, ids=[" ".join(options) for options, _ in WRONG])
def test_wrong_options_are_one_line(
    options: list[str], says: str, scan: Path, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(scan, *options) == 3
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "output", "code"),
    [
        ([], "out.stl", 3),
        ([], "nowhere/out.ply", 6),
        (["--report", "{folder}/out.ply"], "out.ply", 3),
        (["--no-clobber"], "out.ply", 6),
        (["--hu", "5000"], "out.ply", 2),
        (["--hu", "5000,6000"], "out.ply", 2),
        (["--device", "99"], "out.ply", 5),
    ],
    ids=["a mesh", "no folder", "one file twice", "a file that exists", "no point", "no point in a band", "no device"],
)
def test_cloud_that_cannot_be_made_has_its_exit_code_and_leaves_the_older_file(
    scan: Path, tmp_path: Path, cloud_command: Any, options: list[str], output: str, code: int
) -> None:
    (tmp_path / "out.ply").write_text("mine")
    assert cloud_command(scan, *(word.format(folder=tmp_path) for word in options), output=output) == code
    assert (tmp_path / "out.ply").read_text() == "mine"
    assert {path.name for path in tmp_path.iterdir()} == {"out.ply"}


@pytest.mark.parametrize("is_there", [False, True], ids=["missing", "empty"])
def test_cloud_of_a_missing_or_empty_folder_exits_with_2(tmp_path: Path, cloud_command: Any, is_there: bool) -> None:
    folder = tmp_path / "ct"
    if is_there:
        folder.mkdir()
    assert cloud_command(folder) == 2
    assert not (tmp_path / "out.ply").exists()


@pytest.fixture
def first(scan: Path, tmp_path: Path, cloud_command: Any, printed: Printer) -> Path:
    """A cloud of the scan in a file."""
    assert cloud_command(scan, "--hu", BAND, output="first.npz") == 0
    printed()
    return tmp_path / "first.npz"


def test_a_cloud_is_read_and_cleaned(first: Path, tmp_path: Path, cloud_command: Any, printed: Printer) -> None:
    assert cloud_command(first, "--keep", "largest", "--json", output="second.ply") == 0
    report = printed().report()
    assert report["cloud_read"]["points"] == report["points_first"] and report["volume"] == {}
    assert report["kind"] is None and np.allclose(report["affine_ijk_to_lps_mm"], AFFINE)
    before, after = (clrecon.read_points(path) for path in (first, tmp_path / "second.ply"))
    assert 0 < len(after) < len(before)


@pytest.mark.parametrize("option", ["--remove-table", "--hu=200", "--points=shell", "--series=1"])
def test_options_about_scans_are_refused_for_a_cloud(
    first: Path, cloud_command: Any, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(first, option, output="third.ply") == 3
    assert "is about a scan: leave it out" in capsys.readouterr().err


def test_cloud_that_is_read_is_not_replaced(first: Path, cloud_command: Any) -> None:
    before = first.read_bytes()
    assert cloud_command(first, output="first.npz") == 3
    assert first.read_bytes() == before


def test_cloud_with_a_point_that_is_not_finite_is_refused(tmp_path: Path, cloud_command: Any, printed: Printer) -> None:
    (tmp_path / "bad.xyz").write_text("1 2 3\n4 nan 6\n")
    assert cloud_command(tmp_path / "bad.xyz", output="third.ply") == 4
    printed().assert_error("bad.xyz", "finite")


def test_cloud_without_a_frame_is_turned_by_input_space(tmp_path: Path, cloud_command: Any) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\n4 5 6\n7 8 9\n")
    assert cloud_command(tmp_path / "a.xyz", "--input-space", "ras") == 0
    assert np.array_equal(clrecon.read_points(tmp_path / "out.ply").points[0], (-1.0, -2.0, 3.0))


FILTERED = ("--normals", "--denoise", "bilateral", "--outliers", "3", "--points", "shell", "--hu", "250")


def test_outliers_filter_and_normals_give_what_the_functions_give(device: Any, scan: Path, tmp_path: Path) -> None:
    run_with_report(tmp_path, device, scan, *FILTERED)
    volume = clrecon.read_volume(scan)
    cloud = clrecon.extract_points(volume, 250, kind="shell", device=device)
    cloud = clrecon.remove_outliers(cloud, deviations=3.0, device=device).cloud
    cloud = clrecon.denoise_points(cloud, device=device).cloud
    cloud = clrecon.estimate_normals(cloud, volume=volume, device=device).cloud
    written = clrecon.read_points(tmp_path / "out.npz")
    assert np.array_equal(written.points, cloud.points)
    assert np.array_equal(written.normals, cloud.normals)


def test_steps_of_a_filtered_cloud_are_reported_in_their_order(
    scan: Path, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(scan, *FILTERED, "--report", str(tmp_path / "r.json"), output="out.npz") == 0
    report = json.loads((tmp_path / "r.json").read_text())
    steps = [step["step"] for step in report["steps"]]
    assert steps == ["points", "outliers", "bilateral", "normals"] == sorted(steps, key=list(STEPS).index)
    assert report["removed"]["outlier"] > 0
    assert [gate["name"] for gate in report["gates"]] == ["points_kept_outliers"]
    said = capsys.readouterr().out
    assert "mm rms, at most" in said and "oriented by gradient" in said


def test_doubtful_normals_of_far_slices_are_warned_of(
    tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    write_nrrd(tmp_path / "far.nrrd", make_voxels()[::6], AFFINE @ np.diag([1.0, 1.0, 6.0, 1.0]))
    options = ["--points", "shell", "--hu", "250", "--normals", "--report", str(tmp_path / "r.json")]
    assert cloud_command(tmp_path / "far.nrrd", *options) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    share = report["steps"][-1]["doubtful"] / report["points"]
    said = f"normals ({100.0 * share:.0f} %) are doubtful and follow the HU alone"
    assert share > 0.1 and said in capsys.readouterr().err
    assert any(said in warning and "(--points surface)" in warning for warning in report["warnings"])


def test_points_of_a_surface_keep_the_normals_of_its_field(scan: Path, tmp_path: Path, cloud_command: Any) -> None:
    assert cloud_command(scan, output="a.ply") == 0
    assert cloud_command(scan, "--normals", output="b.ply") == 0
    assert cloud_command(scan, "--denoise", "bilateral", output="c.ply") == 0
    one, two, moved = (clrecon.read_points(tmp_path / f"{name}.ply") for name in "abc")
    assert np.array_equal(one.normals, two.normals) and moved.normals is None


THINNED = ("--spacing", "1.2", "--denoise", "grid")


def test_thinned_cloud_and_its_surface_are_those_of_the_functions(device: Any, scan: Path, tmp_path: Path) -> None:
    report = run_with_report(tmp_path, device, scan, *THINNED, "--surface", str(tmp_path / "out.stl"))
    cloud = clrecon.extract_points(clrecon.read_volume(scan), PRESETS[DEFAULT_PRESET].iso_value, device=device)
    cloud = clrecon.remove_sparse_cells(cloud, device=device).cloud
    cloud = clrecon.thin_points(cloud, 1.2, device=device).cloud
    assert np.array_equal(clrecon.read_points(tmp_path / "out.npz").points, cloud.points)
    mesh = clrecon.reconstruct_surface(cloud, device=device)
    triangles_in_file = ((tmp_path / "out.stl").stat().st_size - 84) // 50  # binary STL: header of 84 bytes, 50 each
    assert report["surface"]["triangles"] == mesh.triangle_count == triangles_in_file


def test_report_of_a_thinned_cloud_with_surface_has_steps_and_outputs(device: Any, scan: Path, tmp_path: Path) -> None:
    report = run_with_report(tmp_path, device, scan, *THINNED, "--surface", str(tmp_path / "out.stl"))
    assert [step["step"] for step in report["steps"]] == ["points", "sparse cells", "spacing"]
    assert [output["what"] for output in report["outputs"]] == ["cloud", "surface"]


def test_steps_of_a_thinned_cloud_with_surface_are_printed(
    scan: Path, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(scan, *THINNED, "--surface", str(tmp_path / "out.stl")) == 0
    said = capsys.readouterr().out
    assert "closed, " in said and "sparse cells: " in said and "spacing: " in said


def test_free_points_are_clustered(scan: Path, tmp_path: Path, cloud_command: Any) -> None:
    centre = ",".join(str(number) for number in AFFINE[:3] @ (15, 16, 14, 1))
    assert cloud_command(scan, "--cluster", "eps=1.5,min=5", "--keep", f"seed:{centre}", output="a.ply") == 0
    ball = clrecon.read_points(tmp_path / "a.ply")
    assert np.linalg.norm(ball.points - AFFINE[:3] @ (15, 16, 14, 1), axis=1).max() < 10.0
    assert len(np.unique(ball.labels)) == 1


def test_a_cancelled_job_leaves_nothing(device: Any, scan: Path, tmp_path: Path) -> None:
    settings = CloudSettings(hu=(200, 3000), keep=("largest",), device=str(device.index))
    files = CloudFiles(tmp_path / "a.ply", tmp_path / "b.ply", report=tmp_path / "r.json")
    calls: list[tuple[str, int, int]] = []
    make_cloud(scan, files, settings, progress=lambda *call: calls.append(call))
    assert {"device", "write"} <= {stage for stage, _, _ in calls}
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for moment in dict.fromkeys(calls):

        def cancel(*call: Any, moment: Any = moment) -> None:
            if call == moment:
                raise clrecon.Cancelled

        with pytest.raises(clrecon.Cancelled):
            make_cloud(scan, files, settings, progress=cancel)
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    with pytest.raises(clrecon.OutputError):
        make_cloud(scan, files, settings, no_clobber=True)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_cloud_settings_refuse_half_a_band_and_a_step_twice() -> None:
    with refused(UsageError, "band", 1):
        CloudSettings(hu=(1.0,))
    with refused(UsageError, "bilateral"):
        CloudSettings(denoise=("bilateral", "bilateral"))
