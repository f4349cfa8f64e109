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


def sorted_corners(mesh: Any) -> np.ndarray:
    """Triangles as their places, each beginning with its lowest, in one order."""
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    first = np.lexsort(corners.transpose(2, 0, 1), axis=1)[:, 0]
    turned = (first[:, None] + np.arange(3)) % 3
    flat = np.take_along_axis(corners, turned[..., None], axis=1).reshape(len(corners), 9)
    return flat[np.lexsort(np.round(flat, 2).T)]


@pytest.mark.parametrize("affine", [OBLIQUE, MIRRORED])
@pytest.mark.parametrize("closed", [True, False])
def test_the_soup_is_the_same_surface(affine: np.ndarray, closed: bool, device: Any) -> None:
    volume = smooth_volume((9, 10, 24), affine)
    soup = extract_by_method(volume, 100.5, "t-mc-soup", closed=closed)
    whole = extract_by_method(volume, 100.5, "t-mc", closed=closed, device=device)
    assert soup.vertex_count == whole.vertex_count and soup.triangle_count == whole.triangle_count
    assert np.abs(np.sort(soup.vertices, 0) - np.sort(whole.vertices, 0)).max() < 8 * float32_unit(whole.vertices)
    ours, theirs = (mesh.quality() for mesh in (whole, soup))
    assert theirs["closed"] == ours["closed"] == closed and theirs["manifold"]
    assert theirs["volume_ml"] == pytest.approx(ours["volume_ml"], rel=1e-4)
    assert soup.report["cells"] == whole.report["cells"] and soup.report["method"] == "t-mc-soup"


def test_the_soup_of_uneven_slices_lies_at_their_places(device: Any) -> None:
    values = smooth_volume((6, 12, 20)).voxels
    volume = uneven(values)
    soup = extract_by_method(volume, 100.5, "t-mc-soup")
    whole = extract_isosurface(volume, 100.5, device=device)
    assert np.abs(np.sort(soup.vertices, 0) - np.sort(whole.vertices, 0)).max() < 8 * float32_unit(whole.vertices)


@pytest.mark.parametrize("affine", [OBLIQUE, MIRRORED, None])
def test_scikit_image_is_placed_and_wound_alike(affine: np.ndarray | None, device: Any) -> None:
    pytest.importorskip("skimage")
    volume = uneven(smooth_volume((6, 12, 20)).voxels) if affine is None else smooth_volume((12, 14, 24), affine)
    theirs = extract_by_method(volume, 100.5, "skimage").quality()
    ours = extract_isosurface(volume, 100.5, device=device, topology="trilinear").quality()
    assert theirs["volume_ml"] > 0 and theirs["volume_ml"] == pytest.approx(ours["volume_ml"], rel=0.02)
    assert theirs["area_mm2"] == pytest.approx(ours["area_mm2"], rel=0.02)


def test_methods_that_grow_or_decimate_do_so(device: Any) -> None:
    volume = smooth_volume()
    grown = extract_by_method(volume, 250, "i-mc", device=device)
    assert_sound(grown)
    assert grown.report["growing"]["from"] == ["auto"]
    fewer = extract_by_method(volume, 250, "s-mc", decimate=0.3, device=device)
    assert fewer.report["method"] == "s-mc" and "decimate" in fewer.report["refinement"]
    whole = extract_isosurface(volume, 250, device=device)
    collapsed = extract_by_method(volume, 250, "g-mc", decimate=0.3, device=device)
    assert collapsed.triangle_count == pytest.approx(0.7 * whole.triangle_count, rel=0.02)


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


def test_share_of_triangles_is_refused_by_methods_that_do_not_decimate() -> None:
    assert [name for name, method in METHODS.items() if method.decimates] == ["g-mc", "s-mc"]
    with refused(UsageError, "triangles", "t-mc-soup"):
        extract_by_method(smooth_volume((4, 5, 6)), 0, "t-mc-soup", decimate=0.5)


@pytest.mark.parametrize("method", ["t-mc-soup", "skimage"])
def test_level_above_all_voxels_has_no_surface_by_any_method(method: str) -> None:
    with refused(NoSurfaceError, 9000, "surface"):
        extract_by_method(smooth_volume((4, 5, 6)), 9000, method)
