"""Slices of a scan on a page: what they keep of its HU and places, and how much room they take."""

from __future__ import annotations

import numpy as np
import pytest
import view_scenes as scenes
from coded_pages import parse_slices, unpack_slices
from refusals import refused
from sample_meshes import ball

from clrecon.errors import UsageError
from clrecon.exchange.page import parse_page
from clrecon.exchange.page_slices import MOST_BYTES, pack_slices
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.rendering.looks.window import WINDOWS

HALF_STEP_HU = 2.0  # values on a page are -1024 to 3068 HU in steps of 4


def make_noise(shape: tuple[int, int, int], affine: np.ndarray) -> Volume:
    return Volume(np.random.default_rng(3).integers(-1024, 3000, shape).astype(np.int16), affine)


@pytest.mark.unit
def test_small_scan_keeps_all_voxels_to_two_hu() -> None:
    volume = make_noise((5, 6, 7), scenes.AFFINE)

    packed = pack_slices(volume, WINDOWS)

    assert packed.facts["averaged"] == [1, 1, 1]
    assert np.abs(unpack_slices(packed.facts, packed.data) - volume.voxels).max() <= HALF_STEP_HU


@pytest.mark.unit
def test_values_beyond_those_of_a_page_become_its_lowest_and_highest() -> None:
    volume = Volume(np.array([[[-3024, 0, 30000]]], np.int16), np.eye(4))

    packed = pack_slices(volume, WINDOWS)

    assert unpack_slices(packed.facts, packed.data).ravel().tolist() == [-1024.0, 0.0, 3068.0]


@pytest.mark.unit
def test_scan_that_is_too_large_is_averaged_until_it_fits_its_thin_axes_first() -> None:
    volume = make_noise((10, 40, 40), np.diag([0.5, 0.5, 2.0, 1.0]))
    most = 8000  # bytes; 16,000 voxels of noise take some 26,000

    packed = pack_slices(volume, WINDOWS, most_bytes=most)

    ci, cj, ck = packed.facts["averaged"]
    assert 4 * len(packed.data) / 3 <= most  # base64 writes 4 letters for 3 bytes
    assert (ci, cj) != (1, 1)
    assert ck == 1
    block = volume.voxels[3, 2 * cj : 3 * cj, 4 * ci : 5 * ci]
    assert unpack_slices(packed.facts, packed.data)[3, 2, 4] == pytest.approx(block.mean(), abs=HALF_STEP_HU)


@pytest.mark.unit
def test_averaged_voxel_lies_in_the_middle_of_those_it_was_made_of() -> None:
    volume = make_noise((10, 40, 40), scenes.AFFINE)

    packed = pack_slices(volume, WINDOWS, most_bytes=8000)

    counts = np.array(packed.facts["averaged"])
    first, last = volume.ijk_to_lps(counts * 2), volume.ijk_to_lps(counts * 3 - 1)
    place = (np.array(packed.facts["affine"]) @ [2, 2, 2, 1])[:3]
    assert np.allclose(place, 0.5 * (first + last), rtol=0, atol=1e-9)  # mm, of places of some 200 mm


@pytest.mark.unit
def test_scan_with_uneven_slices_is_refused() -> None:
    positions = np.stack([np.zeros(4), np.zeros(4), [0.0, 1.0, 4.0, 5.0]], axis=1)

    with refused(UsageError, "uneven", "with_slices"):
        pack_slices(Volume(np.zeros((4, 5, 6), np.int16), np.eye(4), slice_positions=positions), WINDOWS)


@pytest.mark.unit
def test_page_holds_the_slices_that_its_mesh_has_and_tells_their_size(tmp_path) -> None:
    packed = pack_slices(scenes.make_scan(), WINDOWS)
    Mesh(*ball(radius=5.0, rings=12), report={"page_slices": packed}).save(tmp_path / "page.html")

    page = (tmp_path / "page.html").read_bytes()

    held = parse_slices(page)
    assert held is not None
    assert (held.facts, held.data) == (packed.facts, packed.data)
    facts, _ = parse_page(page)
    nk, nj, ni = scenes.SHAPE
    assert facts["about"][0].startswith(f"Slices: {ni} x {nj} x {nk} values")
    assert len(page) < MOST_BYTES


@pytest.mark.slow
@pytest.mark.unit
def test_slices_of_a_page_say_the_hu_of_the_place_that_was_clicked_on_its_surface(view_browser, tmp_path) -> None:
    from browser import open_page, severe_lines
    from selenium.webdriver import ActionChains

    radius_mm = 4.0
    vertices, triangles = ball(radius_mm, rings=24)
    mesh = Mesh(
        vertices + scenes.middle(0), triangles, report={"page_slices": pack_slices(scenes.make_scan(), WINDOWS)}
    )
    mesh.save(tmp_path / "page.html")
    severe_lines(view_browser)
    open_page(view_browser, tmp_path / "page.html")
    canvas = view_browser.find_element("id", "scene")

    ActionChains(view_browser).move_to_element(canvas).click().perform()  # the front of the ball, in bone

    words = view_browser.find_element("css selector", "#axial p").text
    said_mm = [float(value) for value in words.split("(")[1].split(")")[0].split(",")]
    assert "1000 HU" in words
    voxel_mm = 1.4  # the longest side: places on a slice are those of voxels
    assert said_mm == pytest.approx((scenes.middle(0) - (0.0, radius_mm, 0.0)).tolist(), abs=voxel_mm)
    assert severe_lines(view_browser) == []
