"""`clrecon cloud`: every option end to end on a small volume, what is refused, and what is left when a step fails."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cloud_scans import AFFINE, BAND, LARGE_BALL_LPS, SMALL_BALL_LPS, make_voxels, run_with_report
from label_files import write_nrrd
from printed_text import Printer
from refusals import refused

import clrecon
from clrecon.errors import UsageError
from clrecon.jobs.cloud.job import CloudFiles, make_cloud
from clrecon.jobs.cloud.settings import CloudSettings
from clrecon.jobs.presets import DEFAULT_PRESET, PRESETS

pytestmark = pytest.mark.first_device


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two balls, a plate of 32 x 40 voxels, and three lone voxels; see `make_voxels`."""
    path = tmp_path_factory.mktemp("cloud") / "scan.nrrd"
    write_nrrd(path, make_voxels(), AFFINE)
    return path


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
    assert (output["what"], output["format"]) == ("cloud", "npz")
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
    clusters = clrecon.cluster_points(first, eps=1.2, min_samples=4, volume=volume, device=device)
    expected = clrecon.keep_clusters(clusters.cloud, ["no-sheets", "largest:1"], cores=clusters.cores)
    written, went = (clrecon.read_points(clustered_folder / name) for name in ("out.npz", "went.npz"))
    assert np.array_equal(written.points, expected.cloud.points)
    assert np.array_equal(written.labels, expected.cloud.labels)
    assert np.array_equal(went.points, first.points)
    assert np.array_equal(went.labels == 0, expected.removed == 0)


def test_kept_cluster_is_the_large_ball(clustered_folder: Path) -> None:
    z = clrecon.read_points(clustered_folder / "out.npz").points[:, 2]
    assert (np.abs(z - 114.0) < 10.0).all()  # radius 9.3 mm around slice 14, slice 0 at 100 mm


def test_report_of_clusters_counts_what_was_removed_and_why(clustered_folder: Path) -> None:
    report = json.loads((clustered_folder / "r.json").read_text())
    first = clrecon.read_points(clustered_folder / "went.npz")
    assert report["removed"]["noise"] == 3
    assert report["removed"]["sheet"] == 32 * 40  # every voxel of the plate
    assert {"label": 2, "reason": "sheet"} in report["removed_labels"]  # the plate
    assert report["points_first"] == len(first) == sum(report["removed"].values()) + report["points"]
    (points_kept,) = report["gates"]
    assert points_kept["ok"]


def test_clusters_are_reported_before_the_rules_that_keep_them_whatever_their_order(clustered_folder: Path) -> None:
    report = json.loads((clustered_folder / "r.json").read_text())
    first_rule, cluster = CLUSTERED.index("--keep"), CLUSTERED.index("--cluster")
    assert first_rule < cluster  # in the command
    assert [step["step"] for step in report["steps"]] == ["points", "clusters", "keep"]


def test_report_of_clusters_lists_the_cloud_and_the_removed_points(clustered_folder: Path) -> None:
    report = json.loads((clustered_folder / "r.json").read_text())
    assert [output["what"] for output in report["outputs"]] == ["cloud", "removed"]


def test_clustered_cloud_is_printed_with_its_counts(scan: Path, cloud_command: Any, printed: Printer) -> None:
    assert cloud_command(scan, *CLUSTERED) == 0
    printed().assert_output(3, 32 * 40)  # lone voxels, and those of the plate


FOREIGN_STRIPES = np.indices((36, 40)).sum(axis=0) % 7 < 2  # 412 pixels of bone
FOREIGN_SLICE_MM = 114.0  # where slice 14 lies


@pytest.fixture(scope="module")
def foreign_slice(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scan with stripes of another one in slice 14 of 40."""
    voxels = make_voxels()
    voxels[14, 4:40, :40] = np.where(FOREIGN_STRIPES, 900, -1000)
    path = tmp_path_factory.mktemp("foreign") / "scan.nrrd"
    write_nrrd(path, voxels, AFFINE)
    return path


def in_foreign_slice(points: np.ndarray) -> np.ndarray:
    """Which points lie nearer to that slice than to those above and below, 1 mm away."""
    return np.abs(points[:, 2] - FOREIGN_SLICE_MM) < 0.5


KINDS_OF_POINTS = pytest.mark.parametrize(
    "options", [["--hu", BAND], ["--fov", "20"], ["--hu", BAND, "--points", "shell"]], ids=["band", "fov", "shell"]
)


@KINDS_OF_POINTS
def test_points_of_foreign_slices_stay_and_are_warned_of(
    options: list[str], foreign_slice: Path, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(foreign_slice, *options, output="kept.npz") == 0
    printed().assert_error("--ghost-slices", "slice", 14, 40)
    points = clrecon.read_points(tmp_path / "kept.npz").points
    assert in_foreign_slice(points).sum() >= np.count_nonzero(FOREIGN_STRIPES)


@KINDS_OF_POINTS
def test_points_of_foreign_slices_alone_are_dropped_on_request(
    options: list[str], foreign_slice: Path, tmp_path: Path, cloud_command: Any
) -> None:
    assert cloud_command(foreign_slice, *options, output="kept.npz") == 0
    assert cloud_command(foreign_slice, *options, "--ghost-slices", "drop", output="dropped.npz") == 0

    kept, dropped = (clrecon.read_points(tmp_path / name).points for name in ("kept.npz", "dropped.npz"))
    assert not in_foreign_slice(dropped).any()
    # Beyond the slices above and below, which are 1 mm away, no surface changes.
    far_kept, far_dropped = (points[np.abs(points[:, 2] - FOREIGN_SLICE_MM) > 1.5] for points in (kept, dropped))
    assert len(far_kept) > 1000  # measured 2107 to 4358
    assert np.array_equal(far_dropped, far_kept)


@KINDS_OF_POINTS
def test_foreign_slices_whose_points_are_dropped_are_not_warned_of(
    options: list[str], foreign_slice: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(foreign_slice, *options, "--ghost-slices", "drop", output="dropped.npz") == 0
    words = printed().everything
    assert "--ghost-slices" not in words
    assert "unlike both" not in words


@KINDS_OF_POINTS
def test_report_names_the_slice_whose_points_were_dropped(
    options: list[str], foreign_slice: Path, device: Any, tmp_path: Path
) -> None:
    report = run_with_report(tmp_path, device, foreign_slice, *options, "--ghost-slices", "drop")
    (step,) = (step for step in report["steps"] if step["step"] == "ghost slices")
    assert [entry["slice"] for entry in step["ghost_slices"]] == [14]
    assert step["slices"] == 40


def test_report_counts_the_points_of_dropped_slices(foreign_slice: Path, device: Any, tmp_path: Path) -> None:
    report = run_with_report(tmp_path, device, foreign_slice, "--hu", BAND, "--ghost-slices", "drop")
    assert report["removed"] == {"ghost slice": report["points_first"] - report["points"]}
    assert report["removed"]["ghost slice"] >= np.count_nonzero(FOREIGN_STRIPES)


def test_cloud_of_a_scan_without_foreign_slices_is_the_same_where_they_are_dropped(
    scan: Path, tmp_path: Path, cloud_command: Any
) -> None:
    assert cloud_command(scan, "--hu", BAND, output="a.npz") == 0
    assert cloud_command(scan, "--hu", BAND, "--ghost-slices", "drop", output="b.npz") == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


@pytest.mark.parametrize(("space", "sign"), [("lps", 1.0), ("ras", -1.0)])
def test_seed_in_the_frame_of_the_output_keeps_the_cluster_at_it(
    space: str, sign: float, scan: Path, tmp_path: Path, cloud_command: Any
) -> None:
    seed = ",".join(str(number) for number in SMALL_BALL_LPS * (sign, sign, 1.0))

    assert cloud_command(scan, "--hu", BAND, "--keep", f"seed:{seed}", "--space", space) == 0

    points = clrecon.read_points(tmp_path / "out.ply").points  # in LPS, whatever the file says
    assert len(points) == pytest.approx(4 / 3 * np.pi * 5.2**3, rel=0.1)  # voxels of a ball of radius 5.2
    assert np.linalg.norm(points - SMALL_BALL_LPS, axis=1).max() < 5.5  # mm: 5.2 voxels of up to 1 mm
    assert f"SPACE={space.upper()}".encode() in (tmp_path / "out.ply").read_bytes()[:2000]


@pytest.mark.parametrize(
    ("kind", "taken"),
    [("surface", "surface of 250 HU"), ("shell", "shell of 250 HU and more"), ("voxels", "voxels of 250 HU and more")],
    ids=["surface", "shell", "voxels"],
)
@pytest.mark.parametrize("extension", ["ply", "vtp", "npz", "xyz"])
def test_points_of_a_surface_a_shell_and_voxels_are_written_to_ply_vtp_npz_and_xyz(
    kind: str, taken: str, extension: str, scan: Path, tmp_path: Path, cloud_command: Any,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert cloud_command(scan, "--points", kind, "--hu", "250", output=f"a.{extension}") == 0

    cloud = clrecon.read_points(tmp_path / f"a.{extension}")
    assert len(cloud) > 1000  # measured 2263 to 4641
    assert f"{len(cloud):,} points ({taken})" in capsys.readouterr().out


@pytest.mark.parametrize("extension", ["ply", "vtp", "npz"])
def test_points_of_a_surface_are_written_with_their_normals(
    extension: str, scan: Path, tmp_path: Path, cloud_command: Any
) -> None:
    assert cloud_command(scan, "--points", "surface", output=f"a.{extension}") == 0
    assert clrecon.read_points(tmp_path / f"a.{extension}").normals is not None


def test_normals_of_a_surface_are_left_out_of_xyz_with_a_warning(
    scan: Path, tmp_path: Path, cloud_command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(scan, "--points", "surface", output="a.xyz") == 0

    assert clrecon.read_points(tmp_path / "a.xyz").normals is None
    assert "XYZ has no place for normals" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "centre_lps", "radius_mm"),
    [  # a little more than their radii of 5.2 and 9.3 mm at 200 HU
        pytest.param(["--label", "right", "--hu", BAND], SMALL_BALL_LPS, 6.0, id="by name, the small ball"),
        pytest.param(["--label", "1"], LARGE_BALL_LPS, 10.0, id="by number, the large ball"),
    ],
)
def test_cloud_of_a_label_has_the_points_of_the_ball_in_it(
    options: list[str], centre_lps: np.ndarray, radius_mm: float, scan: Path, tmp_path: Path, cloud_command: Any
) -> None:
    labels = np.zeros(make_voxels().shape, np.uint8)
    labels[4:34, :30, :26], labels[4:34, :30, 26:] = 1, 2
    header = {
        "Segment0_LabelValue": "1", "Segment0_Layer": "0", "Segment0_Name": "left",
        "Segment1_LabelValue": "2", "Segment1_Layer": "0", "Segment1_Name": "right",
    }  # fmt: skip
    write_nrrd(tmp_path / "labels.seg.nrrd", labels, AFFINE, **header)

    assert cloud_command(scan, "--labels", str(tmp_path / "labels.seg.nrrd"), *options) == 0

    points = clrecon.read_points(tmp_path / "out.ply").points
    assert len(points) > 100  # measured 619 of the small ball, 1662 of the surface of the large one
    assert np.linalg.norm(points - centre_lps, axis=1).max() < radius_mm


def test_points_placed_as_in_the_paper_lie_in_one_plane_and_their_error_is_reported(
    scan: Path, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(scan, "--hu", BAND, "--paper", "--json") == 0

    z = clrecon.read_points(tmp_path / "out.ply").points[:, 2]
    assert np.ptp(z) < 1e-3  # mm, in float32
    report = printed().report()
    assert report["paper"]
    assert report["steps"][0]["paper"]["error_max_mm"] > 30.0  # 36 slices of 1 mm hold points


def test_rule_that_keeps_the_smaller_ball_may_take_more_than_half_of_the_points(
    scan: Path, tmp_path: Path, cloud_command: Any
) -> None:
    centre = ",".join(str(number) for number in SMALL_BALL_LPS)
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
def test_wrong_option_of_cloud_is_refused_in_one_line_and_writes_nothing(
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
def written_cloud(scan: Path, tmp_path: Path, cloud_command: Any, printed: Printer) -> Path:
    """A cloud of the scan in a file."""
    assert cloud_command(scan, "--hu", BAND, output="first.npz") == 0
    printed()
    return tmp_path / "first.npz"


def test_cloud_of_a_file_keeps_its_largest_cluster_and_its_affine(
    written_cloud: Path, tmp_path: Path, cloud_command: Any, printed: Printer
) -> None:
    assert cloud_command(written_cloud, "--keep", "largest", "--json", output="second.ply") == 0

    before, after = (clrecon.read_points(path) for path in (written_cloud, tmp_path / "second.ply"))
    assert 0 < len(after) < len(before)
    report = printed().report()
    assert report["cloud_read"]["points"] == report["points_first"] == len(before)
    assert np.allclose(report["affine_ijk_to_lps_mm"], AFFINE)
    assert (report["volume"], report["kind"]) == ({}, None)  # entries for scans


@pytest.mark.parametrize("option", ["--remove-table", "--hu=200", "--points=shell", "--series=1"])
def test_option_about_scans_is_refused_for_a_cloud_of_a_file(
    written_cloud: Path, cloud_command: Any, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cloud_command(written_cloud, option, output="third.ply") == 3
    assert "is about a scan: leave it out" in capsys.readouterr().err


def test_cloud_that_is_read_is_not_replaced(written_cloud: Path, cloud_command: Any) -> None:
    before = written_cloud.read_bytes()
    assert cloud_command(written_cloud, output="first.npz") == 3
    assert written_cloud.read_bytes() == before


def test_cloud_with_a_point_that_is_not_finite_is_refused(tmp_path: Path, cloud_command: Any, printed: Printer) -> None:
    (tmp_path / "bad.xyz").write_text("1 2 3\n4 nan 6\n")
    assert cloud_command(tmp_path / "bad.xyz", output="third.ply") == 4
    printed().assert_error("bad.xyz", "finite")


def test_cloud_without_a_frame_is_turned_by_input_space(tmp_path: Path, cloud_command: Any) -> None:
    (tmp_path / "a.xyz").write_text("1 2 3\n4 5 6\n7 8 9\n")
    assert cloud_command(tmp_path / "a.xyz", "--input-space", "ras") == 0
    in_lps = [(-1, -2, 3), (-4, -5, 6), (-7, -8, 9)]
    assert np.array_equal(clrecon.read_points(tmp_path / "out.ply").points, in_lps)


def test_points_of_a_surface_are_clustered_and_chosen_by_a_seed(scan: Path, tmp_path: Path, cloud_command: Any) -> None:
    seed = ",".join(str(number) for number in LARGE_BALL_LPS)

    assert cloud_command(scan, "--cluster", "eps=1.5,min=5", "--keep", f"seed:{seed}", output="a.ply") == 0

    cloud = clrecon.read_points(tmp_path / "a.ply")
    assert len(np.unique(cloud.labels)) == 1
    assert np.linalg.norm(cloud.points - LARGE_BALL_LPS, axis=1).max() < 10.0  # mm: its radius is 9.3 voxels


@pytest.fixture
def made_cloud(device: Any, scan: Path, tmp_path: Path) -> tuple[Any, list[tuple[str, int, int]]]:
    """A function that makes the files of a cloud again, and the calls of progress when they were first made."""
    settings = CloudSettings(hu=(200, 3000), keep=("largest",), device=str(device.index))
    files = CloudFiles(tmp_path / "a.ply", tmp_path / "b.ply", report=tmp_path / "r.json")
    calls: list[tuple[str, int, int]] = []
    make_cloud(scan, files, settings, progress=lambda *call: calls.append(call))
    return lambda **own: make_cloud(scan, files, settings, **own), list(dict.fromkeys(calls))


def test_cloud_job_cancelled_at_any_progress_leaves_older_files(made_cloud: Any, tmp_path: Path) -> None:
    make_again, calls = made_cloud
    assert {"device", "write"} <= {stage for stage, _, _ in calls}
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    for moment in calls:

        def cancel(*call: Any, moment: Any = moment) -> None:
            if call == moment:
                raise clrecon.Cancelled

        with pytest.raises(clrecon.Cancelled):
            make_again(progress=cancel)
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_cloud_job_over_older_files_is_refused_with_no_clobber(made_cloud: Any, tmp_path: Path) -> None:
    make_again, _ = made_cloud
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    with pytest.raises(clrecon.OutputError):
        make_again(no_clobber=True)

    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_band_of_hu_with_one_end_is_refused() -> None:
    with refused(UsageError, "band", 1):
        CloudSettings(hu=(1.0,))


def test_filter_of_points_named_twice_is_refused() -> None:
    with refused(UsageError, "bilateral"):
        CloudSettings(denoise=("bilateral", "bilateral"))
