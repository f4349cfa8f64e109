"""What notebooks show: pages, pictures and tables that need nothing from outside, and text where nothing works."""

from __future__ import annotations

import html
import re

import numpy as np
import pytest
import sample_meshes as samples
from html_check import PageCheck

import clrecon
from clrecon.errors import DeviceError
from clrecon.exchange.page import parse_page
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.mesh import Mesh
from clrecon.points.cloud import PointCloud
from clrecon.reading.common.source_facts import SeriesEntry, SeriesListing
from clrecon.viewer.notebook import _MOST_ROWS, _table

VOLUME = Volume(np.arange(6 * 8 * 10, dtype=np.int16).reshape(6, 8, 10) * 4 - 900, np.diag([1.0, 1.0, 2.0, 1.0]))
ENTRY = SeriesEntry(
    number=2, uid_hash="ab", description="<b>thin</b>", modality="CT", slices=4, shape_ijk=[6, 5, 4],
    spacing_mm=[1.0, 1.0, 2.5], affine_ijk_to_lps_mm=None, tilt_deg=0.0, grid_residual_max_mm=0.0,
    gap_mm={"min": 1.0}, uneven=False, warnings=[], problems=["doubt"],
)  # fmt: skip


def find_addresses(text: str) -> list[str]:
    """Addresses of other places in HTML."""
    return re.findall(r"(?:https?:)?//[\w.-]+\.\w+", re.sub(r"data:[^\"&]*|base64[^<]*", "", text))


@pytest.mark.unit
def test_mesh_in_a_notebook_is_its_page_in_a_frame_that_may_run_scripts_alone():
    mesh = Mesh(*samples.torus(), report={"iso_value_hu": 250.0})
    shown = mesh._repr_html_()
    assert shown.startswith('<iframe sandbox="allow-scripts" ') and shown.count("<") == 2
    page = html.unescape(re.search('srcdoc="([^"]*)"', shown)[1])
    assert parse_page(page.encode())[0]["triangles"] == mesh.triangle_count
    assert find_addresses(shown) == []


@pytest.mark.opencl
def test_mesh_too_large_for_a_page_in_a_notebook_is_a_picture_with_a_hint(device):
    vertices, triangles = samples.torus(rings=1000, sides=240)
    vertices = vertices + np.random.default_rng(1).normal(0.0, 0.3, vertices.shape)  # which packs to 5 bytes a triangle
    shown = Mesh(vertices, triangles)._repr_html_()
    check = PageCheck(shown)
    assert check.faults == [] and len(check.pictures) == 1
    assert "mesh.save(" in shown
    assert find_addresses(shown) == []


@pytest.mark.opencl
def test_volume_in_a_notebook_is_pictures_of_three_slices(device):
    check = PageCheck(VOLUME._repr_html_())
    assert check.faults == []
    assert len(check.pictures) == 3


@pytest.mark.opencl
def test_volume_in_a_notebook_has_a_table_of_its_certificate(device):
    volume = Volume(VOLUME.voxels, VOLUME.affine, report={"tilt_deg": 12.5})

    ((heads, *rows),) = PageCheck(volume._repr_html_()).tables

    assert heads[0] == "certificate"
    assert ["tilt_deg", "12.5"] in rows


@pytest.mark.opencl
def test_cloud_in_a_notebook_is_a_picture(device):
    cloud = PointCloud(np.random.default_rng(1).normal(size=(50, 3)), hu=np.arange(50.0))
    assert len(PageCheck(cloud._repr_html_()).pictures) == 1


@pytest.mark.unit
def test_label_map_in_a_notebook_is_a_table_of_names_voxels_and_ml():
    sixty_of_120 = (np.arange(4 * 5 * 6) > 59).reshape(4, 5, 6)
    labels = LabelMap(sixty_of_120, np.diag([1, 2, 5, 1.0]), {1: "<L1>"})  # voxels of 0.01 ml

    ((_, row),) = PageCheck(labels._repr_html_()).tables

    assert row[1:] == ["<L1>", "60", "0.60"]


@pytest.mark.unit
def test_listing_in_a_notebook_is_a_table_of_series_with_its_warnings_as_text():
    shown = SeriesListing([ENTRY], chosen=2, skipped={}, warnings=["one <warning>"])._repr_html_()

    ((_, row),) = PageCheck(shown).tables
    assert row == ["2", "<b>thin</b>", "CT", "4", "6 x 5 x 4", "1 x 1 x 2.5", "read by default", "doubt"]
    assert "one &lt;warning&gt;" in shown


@pytest.fixture
def no_device(monkeypatch):
    """No picture can be drawn."""

    def refuse(*_: object, **__: object) -> None:
        raise DeviceError("no device here")

    monkeypatch.setattr("clrecon.operators.reformat.cut.cut_slice", refuse)
    monkeypatch.setattr("clrecon.operators.rays.render.render", refuse)


@pytest.mark.unit
@pytest.mark.usefixtures("no_device")
@pytest.mark.parametrize(
    "subject",
    [Mesh(*samples.torus(rings=1000, sides=300)), PointCloud([[0, 0, 0], [1, 2, 3]])],
    ids=["large mesh", "cloud"],
)
def test_picture_in_a_notebook_is_left_out_without_a_device(subject):
    assert subject._repr_html_() is None


@pytest.mark.unit
@pytest.mark.usefixtures("no_device")
def test_volume_in_a_notebook_says_why_it_has_no_slices_without_a_device():
    assert "No slices: no device here" in VOLUME._repr_html_()


@pytest.mark.unit
def test_empty_mesh_in_a_notebook_is_said_to_have_no_triangles():
    assert "0 triangles" in Mesh(np.zeros((0, 3)), np.zeros((0, 3), int))._repr_html_()


@pytest.mark.unit
def test_object_of_another_kind_is_not_shown_in_a_notebook():
    assert clrecon.to_html("text") is None  # type: ignore[arg-type]


def test_table_in_a_notebook_counts_the_rows_that_it_leaves_out() -> None:
    whole = _table(["n"], [(number,) for number in range(_MOST_ROWS)])
    cut = _table(["n"], [(number,) for number in range(_MOST_ROWS + 1234)])

    assert "more" not in whole
    assert cut.endswith("</table><p>and 1,234 more</p>")
