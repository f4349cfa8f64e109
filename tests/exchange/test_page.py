"""Pages: the coding of surfaces and its twin, what a page says and allows, and what it never holds."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import sample_meshes as samples
import tolerances
from coded_pages import decode_surface, decode_values
from refusals import refused

from clrecon.errors import UsageError
from clrecon.exchange import page as pages
from clrecon.exchange.formats import MOST_PARTS, stage_assembly
from clrecon.exchange.page import STEPS, encode_surface
from clrecon.mesh import Mesh

pytestmark = pytest.mark.unit


def read_page(path):
    """Facts, vertices, normals and triangles of a page."""
    facts, coded = pages.parse_page(path.read_bytes())
    return facts, *decode_surface(coded)


def noisy_surface(seed: int):
    """Triangles in any order, with vertices that none of them uses."""
    random = np.random.default_rng(seed)
    vertices = random.uniform(-500.0, 900.0, (400, 3))
    triangles = random.integers(0, 390, (700, 3)).astype(np.uint32)
    normals = random.normal(size=(400, 3)).astype(np.float32)
    return vertices, normals / np.linalg.norm(normals, axis=1, keepdims=True), triangles


@pytest.mark.parametrize("seed", range(3))
def test_coded_surface_comes_back_within_half_a_step(seed):
    vertices, normals, triangles = noisy_surface(seed)
    coded = encode_surface(vertices, normals, triangles)
    back, back_normals, back_triangles = decode_surface(coded)
    for axis in range(3):
        error = np.abs(back[back_triangles][..., axis] - vertices[triangles][..., axis]).max()
        assert 0.0 < error <= tolerances.HALF_STEP * coded.step_mm[axis]
    assert np.abs(back_normals[back_triangles] - normals[triangles]).max() <= tolerances.PAGE_NORMAL


def test_step_of_a_coded_surface_is_its_extent_over_65_535():
    vertices, normals, triangles = noisy_surface(0)
    coded = encode_surface(vertices, normals, triangles)
    extent = np.ptp(vertices[np.unique(triangles)], axis=0)
    assert STEPS == 2**16 - 1
    np.testing.assert_allclose(coded.step_mm, extent / STEPS, rtol=tolerances.PAGE_STEP_SHARE)
    assert coded.half_step_mm == 0.5 * max(coded.step_mm)


def test_coded_surface_has_the_vertices_that_triangles_use_in_the_order_of_first_use():
    vertices, normals, triangles = noisy_surface(0)
    coded = encode_surface(vertices, normals, triangles)
    back, _, back_triangles = decode_surface(coded)
    assert coded.vertices == len(back) == len(np.unique(triangles))
    numbers = back_triangles.reshape(-1).astype(int)
    highest_before = np.concatenate(([-1], np.maximum.accumulate(numbers)[:-1]))
    assert (numbers <= highest_before + 1).all()  # a new vertex is always the next one


def test_coded_surface_of_one_flat_triangle_comes_back_as_its_corners_are_whole_steps():
    vertices = np.array([[0.0, 0.0, 7.0], [30.0, 0.0, 7.0], [0.0, 40.0, 7.0]])
    down = np.tile(np.float32([0, 0, -1]), (3, 1))
    coded = encode_surface(vertices, down, np.array([[2, 0, 1]], np.uint32))
    back, back_normals, back_triangles = decode_surface(coded)
    np.testing.assert_allclose(back[back_triangles[0]], vertices[[2, 0, 1]], atol=tolerances.PAGE_FLAT_MM)
    np.testing.assert_array_equal(back_normals, down)
    assert coded.step_mm[2] == 0.0


CODED = encode_surface(*noisy_surface(5))


@pytest.mark.faults
@pytest.mark.parametrize(
    "harmed",
    [
        pytest.param(replace(CODED, data=CODED.data[:-20]), id="cut"),
        pytest.param(replace(CODED, data=b"x" + CODED.data), id="a byte more"),
        pytest.param(replace(CODED, triangles=CODED.triangles + 1), id="a triangle more"),
        pytest.param(
            replace(CODED, vertices=CODED.vertices - 15, triangles=CODED.triangles + 8), id="other counts, same bytes"
        ),
    ],
)
def test_coded_surface_that_was_harmed_is_refused(harmed):
    with refused(ValueError, "surface"):
        decode_surface(harmed)


def cubes(count: int) -> Mesh:
    """Cubes with edges of 10, 11, 12 ... mm beside each other, the smallest first."""
    arrays = [samples.box(low=(40.0 * n, 0, 0), size=(10.0 + n,) * 3) for n in range(count)]
    return Mesh(*samples.join(*arrays), report={"iso_value_hu": 300.0})


CUBES_ML = [1.0, 1.331, 1.728]
"""Of edges of 10, 11 and 12 mm."""


def test_components_of_a_page_are_parts_with_the_largest_first(tmp_path):
    cubes(3).save(tmp_path / "page.html")
    facts, *_ = read_page(tmp_path / "page.html")
    parts = facts["parts"]
    assert [(part["name"], part["first"], part["count"]) for part in parts] == [
        ("part 1", 0, 12), ("part 2", 12, 12), ("part 3", 24, 12),
    ]  # fmt: skip
    assert [part["ml"] for part in parts] == pytest.approx(CUBES_ML[::-1])


def test_triangles_of_each_part_of_a_page_are_those_of_its_component(tmp_path):
    cubes(3).save(tmp_path / "page.html")
    facts, vertices, _, triangles = read_page(tmp_path / "page.html")
    for part, cube in zip(facts["parts"], (2, 1, 0), strict=True):
        x = vertices[triangles[part["first"] : part["first"] + part["count"]].reshape(-1), 0]
        ends = 40.0 * cube, 40.0 * cube + 10.0 + cube
        np.testing.assert_allclose([x.min(), x.max()], ends, atol=tolerances.PAGE_CORNER_MM)


def test_page_says_iso_value_rounding_and_that_there_is_no_certificate(tmp_path):
    cubes(1).save(tmp_path / "page.html")
    facts, *_ = read_page(tmp_path / "page.html")
    iso_value, rounding, certificate = facts["about"][:3]
    assert iso_value == "Surface: iso value 300 HU."
    assert f"moved by at most {facts['half_step_mm']:.2g} mm" in rounding
    assert "No certificate" in certificate


def test_components_beyond_the_most_parts_of_a_page_are_one_part(tmp_path):
    cubes(MOST_PARTS + 3).save(tmp_path / "page.html")
    facts, *_ = read_page(tmp_path / "page.html")
    parts = facts["parts"]
    assert len(parts) == MOST_PARTS + 1
    assert [part["name"] for part in parts[-2:]] == [f"part {MOST_PARTS}", "3 smaller parts"]
    assert parts[-1]["count"] == 3 * 12
    assert parts[-1]["ml"] == pytest.approx(sum(CUBES_ML))


@pytest.fixture
def page_of_two_meshes(tmp_path):
    """A page in RAS of a box "L1" of 6 ml, orange, and of two cubes without name and colour."""
    box = Mesh(*samples.box(size=(10, 20, 30)), report={"part_name": "L1", "color": (1.0, 0.5, 0.0)})
    with stage_assembly([box, cubes(2)], tmp_path / "page.html", "ras") as staged:
        staged.commit()
    return read_page(tmp_path / "page.html")


def test_meshes_of_a_page_are_parts_with_their_names_colours_and_volumes(page_of_two_meshes):
    facts, *_ = page_of_two_meshes
    parts = facts["parts"]
    assert [part["name"] for part in parts] == ["L1", "surface 2"]
    assert [part["color"] for part in parts] == ["#ff8000", "#e3dbc7"]  # the second is that of bone
    assert [part["ml"] for part in parts] == pytest.approx([6.0, CUBES_ML[0] + CUBES_ML[1]])


def test_page_in_ras_has_its_vertices_in_lps(page_of_two_meshes):
    facts, vertices, _, _ = page_of_two_meshes
    assert facts["space"] == "RAS"  # in which the page tells places
    assert vertices.min() >= -tolerances.ROUNDED_STEP  # all of them left of and behind the origin


@pytest.fixture
def page_text(tmp_path):
    """The HTML of the page of one cube."""
    cubes(1).save(tmp_path / "page.html")
    return (tmp_path / "page.html").read_text(encoding="utf-8")


def test_content_policy_of_a_page_allows_its_own_script_and_style_alone(page_text):
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page_text)[1]
    hashes = {}
    for tag in ("script", "style"):
        (content,) = re.findall(rf"<{tag}>(.*?)</{tag}>", page_text, re.DOTALL)
        hashes[tag] = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
    assert policy.split("; ") == [
        "default-src 'none'",
        f"script-src 'sha256-{hashes['script']}'",
        f"style-src 'sha256-{hashes['style']}'",
        "base-uri 'none'",
        "form-action 'none'",
    ]


def test_page_refers_to_no_other_file_and_no_address(page_text):
    assert not re.search(r"\b(src|href|srcset|action)=", page_text)
    without_data = re.sub(r"<script id.*?</script>", "", page_text, flags=re.DOTALL)
    assert not re.search(r"(?:https?:)?//\w", without_data)


@pytest.mark.parametrize("name", ["</script><script>alert(1)</script>", "@SURFACE@", 'a "quoted" <b>', "R\u00fccken"])
def test_name_of_a_part_is_text_in_a_page_and_adds_no_script(name, tmp_path):
    mesh = cubes(1)
    mesh.report["part_name"] = name
    mesh.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("<script") == page.count("</script>") == 3  # facts, surface and the script itself
    facts, *_ = read_page(tmp_path / "page.html")
    assert [part["name"] for part in facts["parts"]] == [name]


def test_page_of_more_than_the_most_triangles_is_refused_and_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "MOST_TRIANGLES", 11)
    with refused(UsageError, 12, 11):
        cubes(1).save(tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


def test_facts_of_a_page_are_json_with_the_known_keys(page_text):
    facts = json.loads(re.search(r'id="facts" type="application/json">([^<]*)<', page_text)[1])
    assert set(facts) == {"vertices", "triangles", "low", "step", "half_step_mm", "space", "parts", "about"}


@pytest.fixture
def page_of_walls(tmp_path):
    """A cube whose vertices have thicknesses from 0.5 to 4 mm, one of them none; and HU, which a page does not show."""
    cube = cubes(1)
    cube.values = {
        "thickness_mm": np.linspace(0.5, 4.0, cube.vertex_count, dtype=np.float32),
        "HU": cube.vertices[:, 0],
    }
    cube.values["thickness_mm"][2] = np.nan
    cube.save(tmp_path / "page.html")
    return cube, *pages.parse_page((tmp_path / "page.html").read_bytes())


def test_numbers_in_mm_come_back_from_a_page_within_half_a_step(page_of_walls):
    cube, facts, coded = page_of_walls
    (values,) = decode_values(facts, coded).values()
    first_uses = list(dict.fromkeys(cube.triangles.reshape(-1).tolist()))
    expected = cube.values["thickness_mm"][first_uses]
    lowest_mm, highest_mm = 0.5, 4.0  # one step is for none
    half_step = 0.5 * (highest_mm - lowest_mm) / (STEPS - 1)
    np.testing.assert_allclose(values, expected, rtol=0.0, atol=1.001 * half_step)


def test_page_has_a_scale_in_mm_from_0_to_a_round_number(page_of_walls):
    _, facts, _ = page_of_walls
    (column,) = facts["values"]
    assert column["name"] == "thickness_mm"
    assert column["ticks"] == [0.0, 1.25, 2.5, 3.75, 5.0]  # 95 % of the vertices are below 3.8 mm


def test_html_without_a_surface_is_refused_as_a_page():
    with refused(ValueError, "page"):
        pages.parse_page(b"<!DOCTYPE html>\n<html></html>\n")
