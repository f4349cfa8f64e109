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
from refusals import refused

from clrecon.errors import UsageError
from clrecon.exchange import page as pages
from clrecon.exchange.formats import MOST_PARTS, stage_assembly
from clrecon.exchange.page import STEPS, decode_surface, encode_surface
from clrecon.mesh import Mesh

pytestmark = pytest.mark.unit


def parse(path):
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
def test_a_surface_comes_back_within_half_a_step(seed):
    vertices, normals, triangles = noisy_surface(seed)
    coded = encode_surface(vertices, normals, triangles)
    found, turned, corners = decode_surface(coded)
    assert coded.vertices == len(found) == len(np.unique(triangles))
    spread = np.ptp(vertices[np.unique(triangles)], axis=0)
    np.testing.assert_allclose(coded.step_mm, spread / STEPS, rtol=1e-12)
    assert coded.half_step_mm == 0.5 * max(coded.step_mm)
    for axis in range(3):
        off = np.abs(found[corners][..., axis] - vertices[triangles][..., axis]).max()
        assert 0.0 < off <= 0.5 * coded.step_mm[axis] * (1 + 1e-9)
    assert np.abs(turned[corners] - normals[triangles]).max() <= 0.5 / 127 + 1e-6
    # In the order of first use: a new vertex is always the next one.
    flat = corners.reshape(-1).astype(int)
    assert (flat <= np.concatenate(([0], np.maximum.accumulate(flat)[:-1] + 1))).all()


def test_a_flat_surface_of_one_triangle_comes_back_exactly():
    vertices = np.array([[0.0, 0.0, 7.0], [30.0, 0.0, 7.0], [0.0, 40.0, 7.0]])
    coded = encode_surface(vertices, np.tile(np.float32([0, 0, -1]), (3, 1)), np.array([[2, 0, 1]], np.uint32))
    found, turned, corners = decode_surface(coded)
    np.testing.assert_allclose(found[corners[0]], vertices[[2, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(turned, np.tile(np.float32([0, 0, -1]), (3, 1)))
    assert coded.step_mm[2] == 0.0


@pytest.mark.faults
def test_harmed_bytes_are_found():
    coded = encode_surface(*noisy_surface(5))
    for harmed in (
        replace(coded, data=coded.data[:-20]),
        replace(coded, data=b"x" + coded.data),
        replace(coded, triangles=coded.triangles + 1),
        replace(coded, vertices=coded.vertices - 4, triangles=coded.triangles + 3),
    ):
        with refused(ValueError, "surface"):
            decode_surface(harmed)


def boxes(count: int) -> Mesh:
    """Cubes with edges of 10, 11, 12 ... mm beside each other, the smallest first."""
    made = [samples.box((40.0 * n, 0, 0), (10.0 + n,) * 3) for n in range(count)]
    return Mesh(*samples.join(*made), report={"iso_value_hu": 300.0})


def test_components_are_parts_with_ml_and_the_largest_first(tmp_path):
    mesh = boxes(3)
    mesh.save(tmp_path / "page.html")
    facts, vertices, _, triangles = parse(tmp_path / "page.html")
    assert [(part["name"], part["first"], part["count"]) for part in facts["parts"]] == [
        ("part 1", 0, 12), ("part 2", 12, 12), ("part 3", 24, 12),
    ]  # fmt: skip
    assert [part["ml"] for part in facts["parts"]] == pytest.approx([1.728, 1.331, 1.0])
    for part, n in zip(facts["parts"], (2, 1, 0), strict=True):
        own = vertices[triangles[part["first"] : part["first"] + part["count"]].reshape(-1)]
        np.testing.assert_allclose([own[:, 0].min(), own[:, 0].max()], [40.0 * n, 40.0 * n + 10.0 + n], atol=2e-3)
    assert facts["about"][0] == "Surface: iso value 300 HU."
    assert f"moved by at most {facts['half_step_mm']:.2g} mm" in facts["about"][1]
    assert "No certificate" in facts["about"][2]


def test_many_components_end_in_one_part(tmp_path):
    boxes(MOST_PARTS + 3).save(tmp_path / "page.html")
    parts = parse(tmp_path / "page.html")[0]["parts"]
    assert [part["name"] for part in parts[-2:]] == [f"part {MOST_PARTS}", "3 smaller parts"]
    assert (len(parts), parts[-1]["count"]) == (MOST_PARTS + 1, 36)
    assert parts[-1]["ml"] == pytest.approx(1.0 + 1.331 + 1.728)


def test_several_meshes_keep_names_colours_and_frame(tmp_path):
    first = Mesh(*samples.box((0, 0, 0), (10, 20, 30)), report={"part_name": "L1", "color": (1.0, 0.5, 0.0)})
    second = boxes(2)
    with stage_assembly([first, second], tmp_path / "page.html", "ras") as staged:
        staged.commit()
    facts, vertices, _, _ = parse(tmp_path / "page.html")
    assert facts["space"] == "RAS"
    assert [part["name"] for part in facts["parts"]] == ["L1", "surface 2"]
    assert [part["color"] for part in facts["parts"]] == ["#ff8000", "#e3dbc7"]
    assert [part["ml"] for part in facts["parts"]] == pytest.approx([6.0, 2.331])
    assert vertices.min() >= -1e-9  # LPS, whatever the frame in which places are told


def test_the_page_allows_its_own_script_and_style_alone(tmp_path):
    boxes(1).save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)[1]
    assert policy.startswith("default-src 'none'; ")
    for tag, source in (("script", "script-src"), ("style", "style-src")):
        (own,) = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(own.encode()).digest()).decode()
        assert f"{source} 'sha256-{digest}';" in policy
    assert "unsafe" not in policy and "http" not in policy
    assert not re.search(r"\b(src|href|srcset|action)=", page)
    assert not re.search(r"(?:https?:)?//\w", re.sub(r"<script id.*?</script>", "", page, flags=re.DOTALL))


@pytest.mark.parametrize("name", ["</script><script>alert(1)</script>", "@SURFACE@", 'a "quoted" <b>', "R\u00fccken"])
def test_a_name_is_text_and_nothing_else(name, tmp_path):
    mesh = boxes(1)
    mesh.report["part_name"] = name
    mesh.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert page.count("<script") == page.count("</script>") == 3
    assert parse(tmp_path / "page.html")[0]["parts"][0]["name"] == name


def test_page_of_too_many_triangles_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "MOST_TRIANGLES", 11)
    with refused(UsageError, 12, 11):
        boxes(1).save(tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


def test_facts_are_strict_json(tmp_path):
    boxes(1).save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    facts = json.loads(re.search(r'id="facts" type="application/json">([^<]*)<', page)[1])
    assert set(facts) == {"vertices", "triangles", "low", "step", "half_step_mm", "space", "parts", "about"}


def test_html_without_a_mesh_is_refused_as_page(tmp_path):
    with pytest.raises(ValueError, match="no page"):
        pages.parse_page(b"<!DOCTYPE html>\n<html></html>\n")
