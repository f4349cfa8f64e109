"""A crop in the jobs: meshes, clouds and pictures of a part of a scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from label_files import write_nrrd
from refusals import refused

from clrecon import PointLook, read_mesh, read_points
from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.geometry.blocks import crop_box
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.render.settings import RenderSettings

pytestmark = pytest.mark.first_device

AFFINE = np.diag((0.8, 0.8, 1.0, 1.0))
AFFINE[:3, 3] = (-16.0, 30.0, 100.0)
SHAPE = (40, 40, 40)
CENTRE_MM, RADIUS_MM = np.array([0.0, 46.0, 120.0]), 12.0
"""A ball, LPS mm."""


def distance_from_centre() -> np.ndarray:
    """Of each voxel of the scan, in mm."""
    k, j, i = np.indices(SHAPE).reshape(3, -1).astype(float)
    places = np.column_stack([i, j, k]) * AFFINE.diagonal()[:3] + AFFINE[:3, 3]
    return np.linalg.norm(places - CENTRE_MM, axis=1).reshape(SHAPE)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of 40 x 40 x 40 voxels whose surface at 300 HU is the ball."""
    voxels = np.clip(100.0 * (RADIUS_MM - distance_from_centre()) + 300.0, -1000, 1000).astype(np.int16)
    return write_nrrd(tmp_path_factory.mktemp("ball") / "ct.nrrd", voxels, AFFINE)


def run(*words: object) -> int:
    return main([str(word) for word in words])


def mesh_at_300_hu(scan: Path, folder: Path, *words: str) -> tuple[Any, dict[str, Any]]:
    """The mesh and its report."""
    assert run("mesh", scan, "-o", folder / "a.stl", "--report", folder / "a.json", "--hu", "300", "-q", *words) == 0
    return read_mesh(folder / "a.stl"), json.loads((folder / "a.json").read_text())


UPPER_HALF = ("--between", f"{CENTRE_MM[2]:g},")


def test_mesh_of_a_cropped_ball_is_closed_at_the_crop(scan: Path, tmp_path: Path) -> None:
    _, report = mesh_at_300_hu(scan, tmp_path, *UPPER_HALF)

    assert report["closed"] and report["manifold"]
    half_ml = 2.0 / 3.0 * np.pi * RADIUS_MM**3 / 1000.0
    # Up to one slice goes on beyond the lowest centre, where it meets the air outside.
    slice_ml = np.pi * RADIUS_MM**2 * 1.0 / 1000.0
    assert half_ml < report["volume_ml"] < half_ml + slice_ml


def test_mesh_of_a_cropped_ball_is_open_at_the_crop_on_request(scan: Path, tmp_path: Path) -> None:
    half, report = mesh_at_300_hu(scan, tmp_path, *UPPER_HALF, "--open")

    assert not report["closed"]
    assert half.vertices[:, 2].min() >= CENTRE_MM[2]


def test_vertices_of_a_cropped_mesh_away_from_the_crop_are_those_of_the_whole(scan: Path, tmp_path: Path) -> None:
    whole, _ = mesh_at_300_hu(scan, tmp_path)
    half, _ = mesh_at_300_hu(scan, tmp_path, *UPPER_HALF)

    half_a_slice_above = CENTRE_MM[2] + 0.5
    of_whole, of_half = (
        np.unique(mesh.vertices[mesh.vertices[:, 2] > half_a_slice_above], axis=0) for mesh in (whole, half)
    )
    assert len(of_half) > 100  # measured 1753; two of none would be equal
    assert np.array_equal(of_half, of_whole)


def test_report_of_a_crop_has_the_voxels_that_stay_and_a_warning(scan: Path, tmp_path: Path) -> None:
    _, report = mesh_at_300_hu(scan, tmp_path, *UPPER_HALF)

    slices_from_120_mm = 20  # of 40 from 100 mm on, 1 mm apart
    assert report["volume"]["shape_ijk"] == [40, 40, slices_from_120_mm]
    assert report["volume"]["crop"]["voxels"] == 40 * 40 * slices_from_120_mm
    assert any("cropped to z from 120 mm (LPS): 32,000 of 64,000 voxels stay (50 %)" in w for w in report["warnings"])


def test_crop_in_ras_is_that_in_lps_with_x_and_y_turned(scan: Path, tmp_path: Path) -> None:
    lps, _ = mesh_at_300_hu(scan, tmp_path, "--around", "8,52,126,9")
    ras, _ = mesh_at_300_hu(scan, tmp_path, "--around", "-8,-52,126,9", "--space", "ras")

    in_lps = ras.vertices  # read_mesh turns a file that says RAS
    assert np.allclose(np.sort(in_lps, axis=0), np.sort(lps.vertices, axis=0), atol=tolerances.FRAME_MM)
    side_mm, voxel_mm = 2 * 9.0, 1.0
    assert np.ptp(lps.vertices, axis=0).max() <= side_mm + 2 * voxel_mm


@pytest.mark.parametrize(
    "words", ["mesh", "mesh --solid", "mesh --method i-mc", "mesh --method skimage", "cloud", "cloud --points voxels"]
)
def test_message_about_missing_bone_names_the_crop_and_its_frame(
    words: str, scan: Path, tmp_path: Path, printed: Any
) -> None:
    command, *options = words.split()
    corner = ("--around", "13,-35,102,2", "--space", "ras")  # of air alone
    assert run(command, scan, "-o", tmp_path / "a.ply", "--hu", "300", "-q", *corner, *options) == 2
    printed().assert_error("crop", "RAS")


def test_slab_and_box_are_intersected(scan: Path, tmp_path: Path) -> None:
    _, report = mesh_at_300_hu(scan, tmp_path, "--between", "110,130", "--clip-box", ",0,,,115,")

    assert report["volume"]["crop"]["box_mm"] == [[None, None, 115.0], [0.0, None, 130.0]]
    # x from -16 mm every 0.8 mm to 0, y whole, z from 115 to 130 mm
    assert report["volume"]["shape_ijk"] == [21, 40, 16]


@pytest.fixture
def label_map(tmp_path: Path) -> Path:
    """Label 1: the ball."""
    return write_nrrd(tmp_path / "l.nrrd", (distance_from_centre() < RADIUS_MM).astype(np.uint8), AFFINE)


@pytest.mark.parametrize("surface", ["hu", "mask"])
def test_mesh_of_a_label_ends_within_a_slice_below_the_crop(
    surface: str, scan: Path, label_map: Path, tmp_path: Path
) -> None:
    words = ["--labels", label_map, "--surface", surface, "-q"]

    assert run("mesh", scan, "-o", tmp_path / "b.stl", *words, *UPPER_HALF) == 0

    crop_mm, slice_mm = CENTRE_MM[2], 1.0
    assert crop_mm - slice_mm <= read_mesh(tmp_path / "b.stl").vertices[:, 2].min() < crop_mm


@pytest.mark.parametrize("surface", ["hu", "mask"])
def test_crop_that_leaves_no_voxel_of_a_label_ends_with_4(
    surface: str, scan: Path, label_map: Path, tmp_path: Path
) -> None:
    above_the_ball = "134,"
    words = ["--labels", label_map, "--surface", surface, "-q"]
    assert run("mesh", scan, "-o", tmp_path / "b.stl", *words, "--between", above_the_ball) == 4


def test_cloud_of_a_crop_has_the_points_within_it(scan: Path, tmp_path: Path) -> None:
    words = ["cloud", scan, "-o", tmp_path / "c.npz", "--hu", "300", "-q"]
    assert run(*words) == 0
    whole = read_points(tmp_path / "c.npz").points

    top_of_the_ball, half_side_mm = CENTRE_MM + (0.0, 0.0, RADIUS_MM), 8.0
    around = ",".join(f"{value:g}" for value in (*top_of_the_ball, half_side_mm))
    assert run(*words, "--around", around) == 0

    part = read_points(tmp_path / "c.npz").points
    assert 0 < len(part) < len(whole)
    voxel_mm = 1.0  # its longest side: the surface closes beyond the last voxels; measured 0.41 mm
    assert (np.abs(part - top_of_the_ball) <= half_side_mm + voxel_mm).all()


def test_picture_of_a_crop_shows_it_larger_and_is_cut_at_its_six_sides(scan: Path, tmp_path: Path) -> None:
    command = ["render", scan, "-o", tmp_path / "p.png", "--iso", "300", "--size", "64", "-q", "--report"]

    assert run(*command, tmp_path / "whole.json") == 0
    assert run(*command, tmp_path / "part.json", "--around", "0,46,120,8") == 0

    whole, part = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("whole", "part"))
    assert part["pictures"][0]["pixel_mm"] < whole["pictures"][0]["pixel_mm"]
    assert len(part["clip_planes_lps_mm"]) == 6
    # 21 x 21 x 17 voxels of 0.8, 0.8 and 1 mm lie within 8 mm, and one more on each side
    assert part["volume"]["shape_ijk"] == [23, 23, 19]


def test_slice_of_a_crop_is_drawn(scan: Path, tmp_path: Path) -> None:
    command = ["render", scan, "-o", tmp_path / "p.png", "--mode", "slice", "--report", tmp_path / "r.json", "-q"]

    assert run(*command, "--between", "110,130") == 0

    assert json.loads((tmp_path / "r.json").read_text())["volume"]["shape_ijk"] == [40, 40, 130 - 110 + 1]
    assert (tmp_path / "p.png").exists()


def test_iso_value_of_a_cropped_slice_is_refused_as_that_of_a_whole_one(
    scan: Path, tmp_path: Path, printed: Any
) -> None:
    words = ["render", scan, "-o", tmp_path / "p.png", "--mode", "slice", "--iso", "300", "-q"]
    for crop in ([], ["--between", "110,130"]):
        assert run(*words, *crop) == 3
        printed().assert_error("--iso", "slice")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--between", "5,1"), "--between runs from 5 to 1 mm along z: it holds nothing; give the lower end first"),
        (("--between", "nan,1"), "--between takes numbers, and one of them is NaN"),
        (("--between", "1"), "are no two heights"),
        (("--around", "1,2,3"), "is no point and length"),
        (("--around", "1,2,3,0"), "a length above 0 in mm, not 1,2,3,0"),
        (("--around", "1,2,inf,4"), "a length above 0 in mm"),
        (("--clip-box", "1,2,3"), "X0,X1,Y0,Y1,Z0,Z1"),
        (("--clip-box", ",,9,3,,"), "--clip-box runs from 9 to 3 mm along y"),
        (("--between", "0,50"), "nothing is left: no voxel lies in the box z 0 to 50 mm (LPS); the scan runs from"),
        (("--between", "100,110", "--around", "0,46,130,5"), "the boxes have nothing in common: along z"),
    ],
)
@pytest.mark.parametrize(("command", "output"), [("mesh", "a.stl"), ("export", "a.nrrd")])
def test_wrong_crop_is_refused_in_one_line_and_writes_nothing(
    command: str, output: str, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...],
    line: str,
) -> None:  # fmt: skip
    assert run(command, scan, "-o", tmp_path / output, *words) == 3

    (said,) = capsys.readouterr().err.splitlines()
    assert line in said
    assert not list(tmp_path.iterdir())


@pytest.mark.unit
def test_crop_box_is_the_common_part_of_box_slab_and_cube() -> None:
    box, slab, cube = (0, 9, 0, 9, 0, 9), (3, 20), (1, 5, 5, 4)  # X0,X1,Y0,Y1,Z0,Z1; Z0,Z1; centre and half a side

    low, high = crop_box(box, between=slab, around=cube)

    assert low == (0, max(0, 5 - 4), max(0, 3, 5 - 4))
    assert high == (min(9, 1 + 4), min(9, 5 + 4), min(9, 20, 5 + 4))


@pytest.mark.unit
def test_crop_box_of_a_slab_has_no_end_across_it() -> None:
    everywhere = float("inf")
    assert crop_box(None, between=(1, 2), around=None) == ((-everywhere, -everywhere, 1), (everywhere, everywhere, 2))


@pytest.mark.unit
def test_crop_box_without_limits_is_none() -> None:
    assert crop_box(None, None, None) is None


@pytest.mark.unit
def test_crop_box_of_a_long_text_is_refused_with_its_beginning() -> None:
    with refused(UsageError, "clip_box", "x" * 60):
        crop_box("x" * 99, None, None)


@pytest.mark.unit
def test_crop_box_of_two_numbers_is_refused() -> None:
    with refused(UsageError, "clip_box", 2):
        MeshSettings(clip_box=(1, 2))


@pytest.mark.unit
@pytest.mark.parametrize(("mode", "margin"), [("dvr", 1), ("slice", 0)])
def test_rays_read_a_voxel_beyond_the_crop_and_slices_none(mode: str, margin: int) -> None:
    assert RenderSettings.of(mode, clip_box=(0, 1, 0, 1, 0, 1)).crop_margin == margin


@pytest.mark.unit
def test_crop_of_points_clips_them_by_planes_and_no_volume() -> None:
    points = RenderSettings.of("points", between=(0, 1))

    assert points.crop is None
    assert isinstance(points.style, PointLook)
    assert len(points.style.clip.planes) == 2
