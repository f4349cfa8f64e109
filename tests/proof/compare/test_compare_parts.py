"""Parts of a comparison with known answers: contours, peers, cameras, measures, sentences, plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_check import find_faults
from variants import daily

import clrecon
from clrecon.geometry import Volume
from clrecon.jobs.run import peak_memory_bytes
from clrecon.mesh import Mesh
from clrecon.proof.compare.figures import (
    COLORS,
    Plane,
    along_slices,
    cut_mesh,
    difference_of,
    find_planes,
    middle_slice,
    read_plane,
)
from clrecon.proof.compare.findings import (
    MethodRecord,
    count,
    find_findings,
    find_worse,
    join,
    megabytes,
    milliseconds,
    ratio,
    seconds,
    share,
    signed,
)
from clrecon.proof.compare.judge import Judge
from clrecon.proof.compare.makers import extract_by_vtk
from clrecon.proof.compare.methods import COMPARED, choose_methods
from clrecon.proof.compare.processes import Request, load_mesh, load_volume, save_mesh, save_volume
from clrecon.proof.compare.records import make_record

pytestmark = pytest.mark.first_device

OBLIQUE = np.array([[0.8, 0.1, 0.2, -20.0], [-0.1, 0.7, 0.0, 30.0], [0.05, 0.0, -1.2, 100.0], [0, 0, 0, 1.0]])


def make_ball(affine: Any = OBLIQUE, radius: float = 9.3) -> Volume:
    k, j, i = np.indices((28, 30, 32))
    away = np.sqrt((k - 14.2) ** 2 + (j - 15.1) ** 2 + (i - 15.7) ** 2)
    return Volume(np.clip(np.rint(100.0 * (radius - away) + 200.0), -1000, 900).astype(np.int16), affine)


def surface_of(volume: Volume, device: Any = None) -> Mesh:
    return clrecon.extract_isosurface(volume, 200, device=device)


def test_a_ball_is_cut_in_a_circle(device: Any) -> None:
    volume = make_ball()
    plane = Plane("", 2, 14.2 + 4.0, 0, 1, False)
    lines = cut_mesh(surface_of(volume, device), volume, plane)
    radius = np.hypot(*(lines.reshape(-1, 2) - [15.7, 15.1]).T)
    np.testing.assert_allclose(radius, np.sqrt(9.3**2 - 4.0**2), atol=0.05)
    ends, many = np.unique(np.round(lines.reshape(-1, 2), 3), axis=0, return_counts=True)
    assert (many == 2).all() and len(ends) == len(lines) > 50  # one closed line


def test_planes_go_through_the_middle_and_show_the_voxels() -> None:
    volume = make_ball(np.diag([1.0, 1.0, 1.0, 1.0]))
    planes, box = find_planes(volume, 200)
    np.testing.assert_array_equal(box, [[7, 6, 5], [25, 24, 23]])
    assert [(plane.axis, int(plane.at), plane.flip) for plane in planes] == [(2, 14, False), (0, 16, True)]
    grey = read_plane(volume, planes[1])
    assert grey.shape == (28, 30)  # down along k, across along j
    expected = 255 * ((1 - 0.487) * volume.voxels[:, :, 16] + 0.487 * volume.voxels[:, :, 17] + 200.0) / 1000.0
    np.testing.assert_allclose(grey, np.clip(expected, 0, 255), atol=0.51)


@pytest.mark.parametrize("affine", daily(1, [OBLIQUE, np.diag([-1.0, 1.0, 1.0, 1.0]) @ OBLIQUE]))
@pytest.mark.parametrize("name", ["vtk-mc", "vtk-fe"])
def test_peers_lie_where_the_scan_is_and_face_outward(name: str, affine: Any, device: Any) -> None:
    volume = make_ball(affine)
    peer, own = extract_by_vtk(volume, 200, name, True), surface_of(volume, device)
    assert peer.triangle_count == own.triangle_count
    quality = peer.quality()
    assert quality.closed and quality.outward
    assert quality.volume_ml == pytest.approx(own.quality().volume_ml, rel=2e-4)
    assert clrecon.compare_meshes(peer, own).hd95_mm < 0.05
    assert peer.report["cells"] == {"visited": 33 * 31 * 29, "all": 33 * 31 * 29}


def test_a_peer_is_closed_where_the_object_leaves_the_volume(device: Any) -> None:
    volume = make_ball(radius=20.0)
    assert extract_by_vtk(volume, 200, "vtk-fe", True).quality().closed
    assert not extract_by_vtk(volume, 200, "vtk-fe", False).quality().closed


def test_the_camera_along_the_slices_sees_the_slice_pixel_for_pixel(device: Any) -> None:
    from clrecon.proof.compare.makers import draw_mesh
    from clrecon.rendering.views.camera import Camera

    volume = make_ball(np.diag([0.8, 0.8, 1.0, 1.0]))
    along = along_slices(volume)
    size = tuple(along["size"])
    assert size == (32, 30)
    picture = draw_mesh(surface_of(volume, device), Camera(**along["camera"]), size, device=device)
    drawn, inside = picture.max(axis=2) > 0, volume.voxels.max(axis=0) >= 200
    assert (drawn != inside).mean() < 0.02
    lopsided = volume.voxels.copy()
    lopsided[:, :, 16:] = -1000
    half = surface_of(Volume(lopsided, volume.affine), device)
    drawn = draw_mesh(half, Camera(**along["camera"]), size, device=device).max(axis=2)
    assert drawn[:, :14].any() and not drawn[:, 18:].any()
    assert middle_slice(volume, size).shape == (30, 32)


def test_a_volume_and_a_mesh_arrive_as_they_were(tmp_path: Path, device: Any) -> None:
    positions = np.cumsum(np.r_[[[0, 0, 0.0]], np.tile([[0, 0, 1.0], [0, 0, 1.5]], (14, 1))[:27]], axis=0)
    volume = Volume(make_ball().voxels, np.diag([1, 1, 1.25, 1]), {"secret": "name"}, positions)
    save_volume(tmp_path, volume)
    again = load_volume(tmp_path)
    np.testing.assert_array_equal(again.voxels, volume.voxels)
    np.testing.assert_allclose(again.slice_origins(), volume.slice_origins(), atol=1e-12)
    assert "secret" not in again.report
    mesh = surface_of(volume, device)
    save_mesh(tmp_path, "t-mc", mesh)
    back = load_mesh(tmp_path, "t-mc")
    assert back is not None and load_mesh(tmp_path, "s-mc") is None
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.triangles, mesh.triangles)


@pytest.fixture
def judge(tmp_path: Path, device: Any) -> Judge:
    """Of the surface of a ball: t-mc is all of it, vtk-mc half of its triangles, cloud its vertices 50 mm above."""
    volume = make_ball()
    save_volume(tmp_path, volume)
    mesh = surface_of(volume, device)
    save_mesh(tmp_path, "t-mc", mesh)
    save_mesh(tmp_path, "vtk-mc", Mesh(mesh.vertices, mesh.triangles[: mesh.triangle_count // 2]))
    np.save(tmp_path / "cloud-points.npy", mesh.vertices + np.float32([0.0, 0.0, 50.0]))
    return Judge({"folder": tmp_path, "reference": "t-mc", "iso_value": 200, "closed": True, "truth": None})


def test_the_judge_measures_the_reference_as_equal_to_itself(judge: Judge) -> None:
    reference = judge.measure("t-mc")
    assert (reference["reasons"], reference["truth"], reference["points"]) == ({}, None, None)
    assert reference["cells"]["dice"] == 1.0 and reference["surfaces"]["max_mm"] < 1e-4
    assert reference["slices"]["dice"] > 0.98 and reference["slices"]["voxel_dice"] == 1.0


def test_the_judge_measures_half_of_a_mesh_as_open_and_incomplete(judge: Judge) -> None:
    half = judge.measure("vtk-mc")
    assert half["slices"] is None and "open" in half["reasons"]["slices"] and not half["quality"]["closed"]
    assert half["cells"]["recall"] < 0.7 < 0.9 < half["cells"]["precision"]


def test_the_judge_measures_how_far_a_cloud_lies_from_the_reference(judge: Judge) -> None:
    cloud = judge.measure("cloud")
    assert cloud["points"]["to_reference_mm"]["max"] == pytest.approx(50.0, abs=1.0)
    assert (cloud["points"]["bias_mm"], cloud["slices"]) == (None, None)


PARTS = {"build": 0.5, "upload": 0.1, "kernels": 0.02, "host": 0.3, "download": 0.08, "draw": 4.0}


def record_of(name: str, **more: Any) -> MethodRecord:
    warm = {**PARTS, "build": 0.0}
    told = {
        "state": "done", "error": None, "first": PARTS, "warm": [warm, {**warm, "host": 0.7}, {**warm, "host": 0.4}],
        "kernel_seconds": {"a": 0.01, "b": 0.005}, "memory_bytes": 3e8, "memory_before_bytes": 1e8, "triangles": 1000,
        "cells": {"visited": 50, "all": 2000}, "growing": {"cells_left_out_share": 0.25}, "small": [0.4, 0.2],
    }  # fmt: skip
    return make_record(COMPARED[name], told, {}, {"first": 2.0, "warm": 1.0}).changed(**more)


def test_a_row_is_made_of_medians_without_reading_and_drawing() -> None:
    row = record_of("t-mc")
    assert row.first_s == pytest.approx(1.0) and row.warm_s == pytest.approx(0.6) and row.warm_runs == 3
    assert row.first_parts_s == {"read": 2.0, **PARTS} and row.warm_parts_s["host"] == 0.4
    assert row.kernels_ms == pytest.approx(15.0) and row.memory_own_bytes == 2e8
    assert row.small == {"size": [128, 128], "first_s": 0.4, "warm_s": 0.2, "scaled_s": None}
    assert record_of("rays-cpu").small["scaled_s"] == pytest.approx(0.2 * (480 / 128) ** 2)
    failed = make_record(COMPARED["s-mc"], {"state": "failed", "error": "no"}, {}, {"first": 1.0, "warm": 1.0})
    assert (failed.first_s, failed.warm_s, failed.is_done, failed.error) == (None, None, False, "no")


DISTANCES = {"hd95_mm": 0.1, "max_mm": 0.2, "assd_mm": 0.05, "volume_change_percent": -1.0}


def test_findings_say_the_numbers() -> None:
    rows = [
        record_of("t-mc", warm_s=0.1, slices={"dice": 0.99, "voxel_dice": 1.0}, triangles=1000),
        record_of("t-mc-soup", warm_s=2.0, surfaces={**DISTANCES, "hd95_mm": 0.0}),
        record_of("vtk-fe", warm_s=0.4, surfaces=DISTANCES, cells={"dice": 0.9995}),
        record_of("i-mc", warm_s=0.2, slices={"dice": 0.98, "voxel_dice": 0.97}),
        record_of("i-mc-golden", warm_s=0.25, slices={"dice": 0.91, "voxel_dice": 0.97}),
        record_of(
            "s-mc", warm_s=8.0, triangles=180, surfaces=DISTANCES, slices={"dice": 0.975}, quality={"closed": True}
        ),
        record_of("rays"),
        record_of("rays-cpu", small={"size": [128, 128], "first_s": 9.0, "warm_s": 6.0, "scaled_s": 84.0}),
    ]
    said = find_findings(rows, "t-mc", with_truth=False)
    assert said == [
        "T-MC is the fastest surface: 100 ms from voxels to mesh when warm, 1.0 s the first time; S-MC is the slowest"
        " with 8.0 s, 80 times as long.",
        "T-MC is 4.0 times as fast as the fastest peer, VTK FE (400 ms), when both are warm.",
        "T-MC, soup gives the surface of T-MC, to 0.001 mm.",
        "VTK FE passes through the same cells as T-MC and divides them into other triangles: HD95 up to 0.100 mm.",
        "With vertices at the golden section I-MC takes 1.2 times as long, and its sub-voxel Dice falls from 0.9800 to"
        " 0.9100; Dice on the voxels' own lattice, 0.9700 and 0.9700, and overlap of cells cannot see where on its"
        " edge a"
        " vertex lies.",
        "I-MC visits 50 of 2,000 cells, 1 in 40, and leaves out 25.0 % of those that the surface passes through: the"
        " parts"
        " that are too small to be grown from.",
        "I-MC takes 2.0 times as long as T-MC here: fewer visited cells are not less time on a device.",
        "S-MC keeps 18 % of the triangles at a sub-voxel Dice of 0.9750, HD95 0.100 mm and at most 0.20 mm, closed, in"
        " 8.0 s.",
        "Ray casting on the device is 30 times as fast as in numpy at 128 x 128 pixels (0.20 and 6.0 s).",
    ]
    assert find_findings([rows[0]], "t-mc", with_truth=True) == []
    grown = rows[3].changed(growing={"cells_left_out_share": 0.0}, warm_s=None)
    assert find_findings([grown], "t-mc", with_truth=False) == [
        "I-MC visits 50 of 2,000 cells, 1 in 40, and leaves nothing out."
    ]
    assert find_worse(rows[5], rows[0]) == ["80 times slower", "Dice lower by 0.0150"]
    assert find_worse(rows[0], rows[0]) == find_worse(rows[5], None) == []
    broken = rows[5].changed(quality={"closed": False}, memory_bytes=5e8, truth={"scatter_mm": 0.3})
    whole = rows[0].changed(quality={"closed": True}, truth={"scatter_mm": 0.1})
    assert find_worse(broken, whole)[1:] == [
        "200 MB more",
        "Dice lower by 0.0150",
        "scatter wider by 0.200 mm",
        "not closed",
    ]


def test_numbers_have_the_digits_that_count() -> None:
    assert [seconds(value) for value in (0.0213, 0.387, 7.21, 41.9)] == ["0.021", "0.39", "7.2", "42"]
    assert [milliseconds(value) for value in (3.14, 214.3)] == ["3.1", "214"]
    assert (megabytes(2.345e9), count(12345.6), signed(0.5, 2)) == ("2,345", "12,346", "+0.50")
    assert [share(value) for value in (1.0, 0.999999, 0.5)] == ["1", "1.0000", "0.5000"]
    assert [ratio(value) for value in (1.25, 214.2, float("inf"))] == ["1.2", "214", "inf"]
    assert [join(names) for names in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == ["", "a", "a and b", "a, b and c"]


def test_methods_come_in_the_order_of_the_table_with_the_reference() -> None:
    assert [m.name for m in choose_methods(("s-mc", "cloud"), "vtk-fe")] == ["vtk-fe", "s-mc", "cloud"]
    assert [m.name for m in choose_methods((), "t-mc")] == list(COMPARED) == list(COLORS)


def test_a_difference_is_black_where_pictures_agree() -> None:
    one = np.zeros((2, 2, 3), np.uint8)
    other = one.copy()
    other[0, 0, 1], other[1, 1, 2] = 10, 200
    np.testing.assert_array_equal(difference_of(one, other), [[40, 0], [0, 255]])


def test_memory_is_that_of_this_program_alone(tmp_path: Path) -> None:
    status = tmp_path / "status"
    status.write_text("Name:\tpython\nVmPeak:\t  900 kB\nVmHWM:\t  123456 kB\nVmRSS:\t  5 kB\n")
    assert peak_memory_bytes(status) == 123456 * 1024
    assert (peak_memory_bytes(tmp_path / "none") or 0) > 1e6


def test_a_request_says_its_views() -> None:
    camera = {"position": [0, 0, 9.0], "focal_point": [0, 0, 0.0], "up": [0, 1.0, 0], "parallel_scale": 3.0}
    request = Request("t-mc", "f", 200.0, True, 0, None, 3, 60.0, camera, (48, 40))
    assert list(request.views()) == ["view"] and request.views()["view"][1] == (48, 40)
    both = Request(**{**request.as_dict(), "along": {"camera": camera, "size": [8, 9]}}).views()
    assert both["along"][1] == (8, 9) and both["view"][0].parallel_scale == 3.0


@pytest.mark.parametrize(
    ("page", "fault"),
    [
        ("<p><b></p></b>", "</p> closes ['b']"),
        ("<script></script>", "<script>"),
        ('<img src="https://x.org/a.png" alt="a" width="1" height="1">', "<img src="),
        ('<p id="a"></p><p id="a"></p>', "id a twice"),
        ('<p onclick="f()"></p>', "<p> has onclick"),
        ('<style>@import "a.css";</style>', "@import"),
        ('<img src="data:image/webp;base64,aa" width="1" height="1">', "a picture has no alt"),
        ('<svg><use href="#x"></use></svg>', "#x is nowhere"),
    ],
)
def test_faults_of_a_page_are_found(page: str, fault: str) -> None:
    assert any(found.startswith(fault) for found in find_faults("<!DOCTYPE html>" + page))
    assert find_faults("<!DOCTYPE html><p>1 < 2</p>") == []
