"""Methods by name: the same surface from each that makes it whole, and what does not go together is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from refusals import refused
from surface_volumes import MIRRORED, OBLIQUE, assert_sound, smooth_volume
from tolerances import float32_unit
from uneven_volume import uneven

from clrecon.errors import NoSurfaceError, UsageError
from clrecon.operators.surface.extract import extract_isosurface
from clrecon.operators.surface.methods import METHODS, check_method, extract_by_method


@pytest.fixture(params=[OBLIQUE, MIRRORED], ids=["oblique", "mirrored"])
def smooth_field(request: pytest.FixtureRequest) -> Any:
    return smooth_volume((9, 10, 24), affine=request.param)


@pytest.mark.parametrize("closed", [True, False])
def test_welded_triangle_soup_has_the_vertices_and_cells_of_marching_cubes(
    smooth_field: Any, closed: bool, device: Any
) -> None:
    soup = extract_by_method(smooth_field, 100.5, "t-mc-soup", closed=closed)
    whole = extract_by_method(smooth_field, 100.5, "t-mc", closed=closed, device=device)
    assert (soup.vertex_count, soup.triangle_count) == (whole.vertex_count, whole.triangle_count)
    off = np.abs(np.sort(soup.vertices, 0) - np.sort(whole.vertices, 0)).max()
    assert off <= float32_unit(whole.vertices)  # measured 0
    assert soup.report["method"] == "t-mc-soup"
    assert soup.report["cells"] == whole.report["cells"]


@pytest.mark.parametrize("closed", [True, False])
def test_welded_triangle_soup_is_as_closed_as_marching_cubes_with_its_volume(
    smooth_field: Any, closed: bool, device: Any
) -> None:
    soup = extract_by_method(smooth_field, 100.5, "t-mc-soup", closed=closed).quality()
    whole = extract_by_method(smooth_field, 100.5, "t-mc", closed=closed, device=device).quality()
    assert soup["closed"] == whole["closed"] == closed
    assert soup["manifold"]
    assert soup["volume_ml"] == pytest.approx(whole["volume_ml"], rel=1e-6)  # float32; measured 0


def test_vertices_of_a_triangle_soup_of_uneven_slices_are_those_of_marching_cubes(device: Any) -> None:
    volume = uneven(smooth_volume((6, 12, 20)).voxels)
    soup = extract_by_method(volume, 100.5, "t-mc-soup")
    whole = extract_isosurface(volume, 100.5, device=device)
    off = np.abs(np.sort(soup.vertices, 0) - np.sort(whole.vertices, 0)).max()
    assert off <= float32_unit(whole.vertices)  # measured an eighth of it


@pytest.mark.parametrize("affine", [OBLIQUE, MIRRORED, None], ids=["oblique", "mirrored", "uneven"])
def test_surface_by_scikit_image_has_the_volume_and_area_of_the_trilinear_topology(
    affine: np.ndarray | None, device: Any
) -> None:
    pytest.importorskip("skimage")
    volume = uneven(smooth_volume((6, 12, 20)).voxels) if affine is None else smooth_volume((12, 14, 24), affine=affine)
    theirs = extract_by_method(volume, 100.5, "skimage").quality()
    ours = extract_isosurface(volume, 100.5, device=device, topology="trilinear").quality()
    assert theirs["volume_ml"] > 0  # wound outward
    assert theirs["volume_ml"] == pytest.approx(ours["volume_ml"], rel=0.002)  # measured 0.001
    assert theirs["area_mm2"] == pytest.approx(ours["area_mm2"], rel=5e-4)  # measured 2e-4


def test_method_i_mc_grows_a_sound_surface_from_the_largest_component(device: Any) -> None:
    grown = extract_by_method(smooth_volume(), 250, "i-mc", device=device)
    assert_sound(grown)
    assert grown.report["growing"]["from"] == ["auto"]


def test_method_s_mc_decimates_and_reports_it(device: Any) -> None:
    report = extract_by_method(smooth_volume(), 250, "s-mc", decimate=0.3, device=device).report
    assert report["method"] == "s-mc"
    assert "decimate" in report["refinement"]


def test_method_g_mc_removes_the_share_of_triangles_that_is_asked_for(device: Any) -> None:
    whole = extract_isosurface(smooth_volume(), 250, device=device)
    decimated = extract_by_method(smooth_volume(), 250, "g-mc", decimate=0.3, device=device)
    assert decimated.triangle_count == pytest.approx((1 - 0.3) * whole.triangle_count, abs=2)  # a collapse takes two


@pytest.mark.parametrize(
    ("method", "options", "words"),
    [
        ("mc33", {}, ("method=", "mc33", "t-mc", "i-mc")),
        ("t-mc", {"grows": True}, ("method=", "t-mc", "grow_from")),
        ("i-mc", {"topology": "trilinear"}, ("growing",)),
        ("skimage", {"vertex_rule": "golden"}, ("method=", "vertex_rule=")),
        ("t-mc-soup", {"plain": False}, ("value",)),
    ],
)
def test_methods_refuse_options_that_they_do_not_have(method: str, options: dict[str, Any], words: str) -> None:
    with refused(UsageError, *words):
        check_method(method, **options)


def test_methods_that_decimate_are_g_mc_and_s_mc() -> None:
    assert [name for name, method in METHODS.items() if method.decimates] == ["g-mc", "s-mc"]


def test_share_of_triangles_is_refused_by_a_method_that_does_not_decimate() -> None:
    with refused(UsageError, "triangles", "t-mc-soup"):
        extract_by_method(smooth_volume((4, 5, 6)), 0, "t-mc-soup", decimate=0.5)


@pytest.mark.parametrize("method", ["t-mc-soup", "skimage"])
def test_level_above_all_voxels_has_no_surface_by_a_method_of_the_host(method: str) -> None:
    with refused(NoSurfaceError, 9000, "surface"):
        extract_by_method(smooth_volume((4, 5, 6)), 9000, method)
