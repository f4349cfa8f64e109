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
    cut_triangles,
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
from clrecon.proof.compare.processes import MEASURES, Request, load_mesh, load_volume, save_mesh, save_volume
from clrecon.proof.compare.records import make_record
from clrecon.system.text import list_names

pytestmark = pytest.mark.first_device

OBLIQUE = np.array([[0.8, 0.1, 0.2, -20.0], [-0.1, 0.7, 0.0, 30.0], [0.05, 0.0, -1.2, 100.0], [0, 0, 0, 1.0]])


RADIUS = 9.3  # voxels


def make_ball(affine: Any = OBLIQUE, radius: float = RADIUS) -> Volume:
    """A ball around i, j, k = 15.7, 15.1, 14.2 in 32 x 30 x 28 voxels: 200 HU at its radius, 100 more a voxel in."""
    k, j, i = np.indices((28, 30, 32))
    away = np.sqrt((k - 14.2) ** 2 + (j - 15.1) ** 2 + (i - 15.7) ** 2)
    return Volume(np.clip(np.rint(100.0 * (radius - away) + 200.0), -1000, 900).astype(np.int16), affine)


def surface_of(volume: Volume, device: Any = None) -> Mesh:
    return clrecon.extract_isosurface(volume, 200, device=device)


def test_cut_of_a_ball_is_one_closed_circle(device: Any) -> None:
    volume = make_ball()
    plane = Plane("", axis=2, at=14.2 + 4.0, across=0, down=1, flip=False)
    mesh = surface_of(volume, device)
    lines = cut_triangles(volume.lps_to_ijk(mesh.vertices), mesh.triangles, plane)
    radius = np.hypot(*(lines.reshape(-1, 2) - [15.7, 15.1]).T)
    np.testing.assert_allclose(radius, np.sqrt(RADIUS**2 - 4.0**2), atol=0.05)  # voxels
    ends, many = np.unique(np.round(lines.reshape(-1, 2), 3), axis=0, return_counts=True)
    assert (many == 2).all()  # one closed line
    assert len(ends) == len(lines) > 50  # measured 146


def test_planes_of_a_comparison_go_through_the_middle_of_the_object() -> None:
    volume = make_ball(np.diag([1.0, 1.0, 1.0, 1.0]))
    planes, box = find_planes(volume, 200)
    np.testing.assert_array_equal(box, [[7, 6, 5], [25, 24, 23]])  # i, j, k: 15.7 - 9.3 is 6.4, 15.7 + 9.3 is 25
    assert [(plane.axis, int(plane.at), plane.flip) for plane in planes] == [(2, 14, False), (0, 16, True)]


def test_grey_of_a_plane_is_interpolated_between_voxels_from_minus_200_to_800_hu() -> None:
    volume = make_ball(np.diag([1.0, 1.0, 1.0, 1.0]))
    plane = Plane("", axis=0, at=16 + 0.487, across=1, down=2, flip=True)
    between = (1 - 0.487) * volume.voxels[:, :, 16] + 0.487 * volume.voxels[:, :, 17]
    expected = 255 * (between + 200.0) / 1000.0  # down along k, across along j
    rounding = 0.51
    np.testing.assert_allclose(read_plane(volume, plane), np.clip(expected, 0, 255), atol=rounding)


@pytest.mark.parametrize("affine", daily(1, [OBLIQUE, np.diag([-1.0, 1.0, 1.0, 1.0]) @ OBLIQUE]))
@pytest.mark.parametrize("name", ["vtk-mc", "vtk-fe"])
def test_peers_lie_where_the_scan_is_and_face_outward(name: str, affine: Any, device: Any) -> None:
    volume = make_ball(affine)
    peer, own = extract_by_vtk(volume, 200, name, closed=True), surface_of(volume, device)
    assert peer.triangle_count == own.triangle_count
    quality = peer.quality()
    assert (quality.closed, quality.outward) == (True, True)
    assert quality.volume_ml == pytest.approx(own.quality().volume_ml, rel=1e-5)  # float32; measured 2.4e-6
    assert clrecon.compare_meshes(peer, own).hd95_mm < 0.003  # measured 0.0014
    cells = (32 + 1) * (30 + 1) * (28 + 1)  # of the voxels and a border
    assert peer.report["cells"] == {"visited": cells, "all": cells}


def test_surface_of_vtk_is_closed_at_the_border_of_the_volume_on_request(device: Any) -> None:
    volume = make_ball(radius=20.0)
    assert extract_by_vtk(volume, 200, "vtk-fe", closed=True).quality().closed
    assert not extract_by_vtk(volume, 200, "vtk-fe", closed=False).quality().closed


def draw_along_slices(volume: Volume, device: Any) -> Any:
    """The picture of the surface of a volume by the camera that looks along its slices, a pixel for each voxel."""
    from clrecon.proof.compare.makers import draw_mesh
    from clrecon.rendering.views.camera import Camera

    along = along_slices(volume)
    size = tuple(along["size"])
    return draw_mesh(surface_of(volume, device), Camera(**along["camera"]), size, device=device).max(axis=2) > 0


def test_camera_along_the_slices_draws_a_pixel_for_each_column_of_voxels(device: Any) -> None:
    volume = make_ball(np.diag([0.8, 0.8, 1.0, 1.0]))
    drawn, inside = draw_along_slices(volume, device), volume.voxels.max(axis=0) >= 200
    assert drawn.shape == inside.shape
    assert (drawn != inside).mean() < 0.005  # pixels on the outline; measured 0


def test_camera_along_the_slices_draws_low_columns_on_the_left(device: Any) -> None:
    volume = make_ball(np.diag([0.8, 0.8, 1.0, 1.0]))
    volume.voxels[:, :, 16:] = -1000
    drawn = draw_along_slices(volume, device)
    assert drawn[:, :14].any()
    assert not drawn[:, 18:].any()


def test_middle_slice_has_the_size_of_the_picture_along_the_slices() -> None:
    volume = make_ball(np.diag([0.8, 0.8, 1.0, 1.0]))
    width, height = along_slices(volume)["size"]
    assert (width, height) == (32, 30)
    assert middle_slice(volume, (width, height)).shape == (height, width)


def test_uneven_volume_for_other_processes_is_read_again_without_its_report(tmp_path: Path) -> None:
    positions = np.cumsum(np.r_[[[0, 0, 0.0]], np.tile([[0, 0, 1.0], [0, 0, 1.5]], (14, 1))[:27]], axis=0)
    volume = Volume(make_ball().voxels, np.diag([1, 1, 1.25, 1]), report={"secret": "name"}, slice_positions=positions)
    save_volume(tmp_path, volume)
    again = load_volume(tmp_path)
    np.testing.assert_array_equal(again.voxels, volume.voxels)
    np.testing.assert_allclose(again.slice_origins(), volume.slice_origins(), atol=1e-12)
    assert "secret" not in again.report


def test_mesh_of_another_process_is_read_again_by_its_method(tmp_path: Path, device: Any) -> None:
    mesh = surface_of(make_ball(), device)
    save_mesh(tmp_path, "t-mc", mesh)
    again = load_mesh(tmp_path, "t-mc")
    assert again is not None
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.triangles, mesh.triangles)


def test_method_without_a_written_mesh_has_none(tmp_path: Path) -> None:
    assert load_mesh(tmp_path, "s-mc") is None


@pytest.fixture
def judge(tmp_path: Path, device: Any) -> Judge:
    """Of the surface of a ball: t-mc is all of it, vtk-mc half of its triangles, cloud its vertices 50 mm above."""
    volume = make_ball()
    save_volume(tmp_path, volume)
    mesh = surface_of(volume, device)
    save_mesh(tmp_path, "t-mc", mesh)
    save_mesh(tmp_path, "vtk-mc", Mesh(mesh.vertices, mesh.triangles[: mesh.triangle_count // 2]))
    np.save(tmp_path / "cloud-points.npy", mesh.vertices + np.float32([0.0, 0.0, 50.0]))
    message = {"reference": "t-mc", "iso_value": 200, "closed": True, "truth": None, "measures": list(MEASURES)}
    return Judge({"folder": tmp_path, **message})


def test_reference_is_measured_as_equal_to_itself(judge: Judge) -> None:
    reference = judge.measure("t-mc")
    assert (reference["reasons"], reference["truth"], reference["points"]) == ({}, None, None)
    assert reference["cells"]["dice"] == 1.0
    assert reference["surfaces"]["max_mm"] < 1e-9  # rounding of distances in float64: measured 2e-12
    # the mesh against trilinear HU on a finer lattice than the voxels: measured 0.9994
    assert reference["slices"]["dice"] > 0.998
    assert reference["slices"]["voxel_dice"] == 1.0


def test_half_of_a_mesh_is_measured_as_open_and_incomplete(judge: Judge) -> None:
    half = judge.measure("vtk-mc")
    assert half["slices"] is None
    assert "open" in half["reasons"]["slices"]
    assert not half["quality"]["closed"]
    assert half["cells"]["recall"] < 0.7 < 0.9 < half["cells"]["precision"]  # measured 0.5 and 1


def test_cloud_is_measured_by_its_distance_from_the_reference(judge: Judge) -> None:
    cloud = judge.measure("cloud")
    assert cloud["points"]["to_reference_mm"]["max"] == pytest.approx(50.0, abs=2e-5)  # float32; measured 8e-6
    assert (cloud["points"]["bias_mm"], cloud["slices"]) == (None, None)


PARTS = {"build": 0.5, "upload": 0.1, "kernels": 0.02, "host": 0.3, "download": 0.08, "draw": 4.0}


def record_of(name: str, **more: Any) -> MethodRecord:
    warm = {**PARTS, "build": 0.0}
    told = {
        "state": "done", "error": None, "first": PARTS, "warm": [warm, {**warm, "host": 0.7}, {**warm, "host": 0.4}],
        "kernel_seconds": {"a": 0.01, "b": 0.005}, "memory_bytes": 3e8, "memory_before_bytes": 1e8, "triangles": 1000,
        "cells": {"visited": 50, "all": 2000}, "growing": {"cells_left_out_share": 0.25}, "small": [0.4, 0.2],
    }  # fmt: skip
    return make_record(COMPARED[name], told, measured={}, read_s={"first": 2.0, "warm": 1.0}).changed(**more)


def test_first_time_of_a_method_is_the_sum_of_its_parts_without_reading_and_drawing() -> None:
    row = record_of("t-mc")
    assert row.first_s == pytest.approx(sum(PARTS.values()) - PARTS["draw"])
    assert row.first_parts_s == {"read": 2.0, **PARTS}


def test_warm_time_of_a_method_is_the_median_of_its_runs() -> None:
    row = record_of("t-mc")  # its host part takes 0.3, 0.7 and 0.4 s
    assert row.warm_runs == 3
    assert row.warm_parts_s["host"] == 0.4
    assert row.warm_s == pytest.approx(0.1 + 0.02 + 0.4 + 0.08)  # upload, kernels, host, download


def test_kernels_of_a_method_take_the_sum_of_their_times() -> None:
    assert record_of("t-mc").kernels_ms == pytest.approx(1000 * (0.01 + 0.005))


def test_own_memory_of_a_method_is_the_peak_above_that_before() -> None:
    assert record_of("t-mc").memory_own_bytes == 3e8 - 1e8


def test_small_picture_of_a_method_has_its_times() -> None:
    assert record_of("t-mc").small == {"size": [128, 128], "first_s": 0.4, "warm_s": 0.2, "scaled_s": None}


def test_small_picture_of_ray_casting_on_the_cpu_is_scaled_to_the_pixels_of_the_whole() -> None:
    assert record_of("rays-cpu").small["scaled_s"] == pytest.approx(0.2 * (480 / 128) ** 2)


def test_failed_method_has_its_error_and_no_times() -> None:
    failed = make_record(
        COMPARED["s-mc"], {"state": "failed", "error": "no"}, measured={}, read_s={"first": 1.0, "warm": 1.0}
    )
    assert (failed.is_done, failed.error) == (False, "no")
    assert (failed.first_s, failed.warm_s) == (None, None)


DISTANCES = {"hd95_mm": 0.1, "max_mm": 0.2, "assd_mm": 0.05, "volume_change_percent": -1.0}


def rows_of_eight_methods() -> list[MethodRecord]:
    return [
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


T_MC, _, _, I_MC, _, S_MC, _, _ = rows_of_eight_methods()


def test_findings_of_a_comparison_have_the_numbers_of_its_methods() -> None:
    assert find_findings(rows_of_eight_methods(), "t-mc", with_truth=False) == [
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


def test_reference_alone_has_no_findings() -> None:
    assert find_findings([T_MC], "t-mc", with_truth=True) == []


def test_finding_of_growing_that_reaches_every_component_says_so() -> None:
    complete = I_MC.changed(growing={"cells_left_out_share": 0.0}, warm_s=None)
    assert find_findings([complete], "t-mc", with_truth=False) == [
        "I-MC visits 50 of 2,000 cells, 1 in 40, and leaves nothing out."
    ]


def test_slower_and_less_like_method_is_worse_by_its_factor_and_its_difference() -> None:
    assert find_worse(S_MC, T_MC) == ["80 times slower", "Dice lower by 0.0150"]


def test_larger_scattered_and_open_mesh_is_worse_by_memory_scatter_and_not_closed() -> None:
    broken = S_MC.changed(quality={"closed": False}, memory_bytes=5e8, truth={"scatter_mm": 0.3})
    whole = T_MC.changed(quality={"closed": True}, truth={"scatter_mm": 0.1})
    _, *others = find_worse(broken, whole)
    assert others == ["200 MB more", "Dice lower by 0.0150", "scatter wider by 0.200 mm", "not closed"]


@pytest.mark.parametrize(("row", "reference"), [(T_MC, T_MC), (S_MC, None)], ids=["itself", "no reference"])
def test_method_is_in_nothing_worse_than_itself_or_no_reference(
    row: MethodRecord, reference: MethodRecord | None
) -> None:
    assert find_worse(row, reference) == []


@pytest.mark.parametrize(
    ("write", "value", "text"),
    [
        (seconds, 0.0213, "0.021"), (seconds, 0.387, "0.39"), (seconds, 7.21, "7.2"), (seconds, 41.9, "42"),
        (milliseconds, 3.14, "3.1"), (milliseconds, 214.3, "214"),
        (megabytes, 2.345e9, "2,345"), (count, 12345.6, "12,346"), (lambda value: signed(value, 2), 0.5, "+0.50"),
        (share, 1.0, "1"), (share, 0.999999, "1.0000"), (share, 0.5, "0.5000"),
        (ratio, 1.25, "1.2"), (ratio, 214.2, "214"), (ratio, float("inf"), "inf"),
    ],
)  # fmt: skip
def test_number_of_a_comparison_is_written_with_the_digits_of_its_kind(write: Any, value: float, text: str) -> None:
    assert write(value) == text


@pytest.mark.parametrize(
    ("names", "text"), [([], ""), (["a"], "a"), (["a", "b"], "a and b"), (["a", "b", "c"], "a, b and c")]
)
def test_names_are_joined_with_commas_and_a_last_and(names: list[str], text: str) -> None:
    assert list_names(names) == text


def test_chosen_methods_are_in_the_order_of_the_table_with_the_reference() -> None:
    assert [m.name for m in choose_methods(("s-mc", "cloud"), "vtk-fe")] == ["vtk-fe", "s-mc", "cloud"]
    assert [m.name for m in choose_methods((), "t-mc")] == list(COMPARED) == list(COLORS)


def test_difference_of_pictures_is_black_where_they_agree_and_four_times_as_bright_elsewhere() -> None:
    one = np.zeros((2, 2, 3), np.uint8)
    other = one.copy()
    other[0, 0, 1], other[1, 1, 2] = 10, 200
    np.testing.assert_array_equal(difference_of(one, other), [[40, 0], [0, 255]])


def test_peak_memory_is_the_resident_high_water_mark_of_the_status_of_a_process(tmp_path: Path) -> None:
    status = tmp_path / "status"
    status.write_text("Name:\tpython\nVmPeak:\t  900 kB\nVmHWM:\t  123456 kB\nVmRSS:\t  5 kB\n")
    assert peak_memory_bytes(status) == 123456 * 1024


def test_peak_memory_without_a_status_is_asked_of_the_system(tmp_path: Path) -> None:
    assert (peak_memory_bytes(tmp_path / "none") or 0) > 1e6  # Python alone takes ten times as much


CAMERA = {"position": [0, 0, 9.0], "focal_point": [0, 0, 0.0], "up": [0, 1.0, 0], "parallel_scale": 3.0}
REQUEST = Request(
    method="t-mc", folder="f", iso_value=200.0, closed=True, device=0, memory=None, repeat=3, timeout=60.0,
    camera=CAMERA, size=(48, 40),
)  # fmt: skip


def test_request_of_one_camera_has_the_view_of_its_size() -> None:
    [(name, (camera, size))] = REQUEST.views().items()
    assert (name, size, camera.parallel_scale) == ("view", (48, 40), 3.0)


def test_request_with_a_camera_along_the_slices_has_both_views() -> None:
    views = Request(**{**REQUEST.as_dict(), "along": {"camera": CAMERA, "size": [8, 9]}}).views()
    assert {name: size for name, (_, size) in views.items()} == {"view": (48, 40), "along": (8, 9)}


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
def test_fault_of_a_page_is_found(page: str, fault: str) -> None:
    assert any(found.startswith(fault) for found in find_faults("<!DOCTYPE html>" + page))


def test_valid_page_has_no_faults() -> None:
    assert find_faults("<!DOCTYPE html><p>1 < 2</p>") == []
