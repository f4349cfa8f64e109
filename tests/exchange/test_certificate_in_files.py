"""The certificate of the volume stands in the mesh files, one fact a line, and nothing else of its report does."""

from __future__ import annotations

import json
import struct
import zipfile
from xml.etree import ElementTree

import numpy as np
import pytest
import sample_meshes as samples

from clrecon import Mesh, Volume, extract_isosurface
from clrecon.exchange.content import LINE_LENGTH, WARNINGS_WRITTEN, certificate_lines

REPORT = {
    "series": {"number": 3, "uid_hash": "0123456789abcdef", "modality": "CT"},
    "description": "SECRET",
    "slices": 27,
    "slices_missing": 1,
    "phase": {"number": 2, "of": 3, "keyword": "AcquisitionNumber", "value": "5"},
    "dropped": {"identical duplicate": 4, "other phase": 2},
    "affine_ijk_to_lps_mm": [[0.5, 0, 0, -12.5], [0, 0.7, 0, 31.25], [0, 0, 1.25, -400], [0, 0, 0, 1]],
    "orientation": {"axes": "LPS"},
    "tilt_deg": 18.5,
    "grid_residual_max_mm": 12.4751234567,
    "grid_residual_rms_mm": 6.47,
    "grid_tolerance_mm": 0.04,
    "gap_mm": {"min": 1.081, "max": 6.999, "median": 4.002},
    "gap_runs": [{"count": 13, "gap_mm": 4.002}, {"count": 1, "gap_mm": 1.081}],
    "slice_thickness_mm": 4.0,
    "thickness": {"overlap_mm": {"min": -0.00193, "max": 4.42}},
    "padding_share": 0.2127,
    "frame_of_reference_hash": "ee740dfa4069b59a",
    "gates": [
        {"name": "usable", "ok": True, "text": "fine"},
        {"name": "grid_residual", "ok": False, "text": "12.5 mm, at most 0.04"},
        {"name": "padding_share", "ok": None, "text": "not read"},
    ],
    "warnings": ["gantry tilt 18.50 degrees: kept exactly, as a shear", "4 < 5 & so on"],
}
LINES = [
    "grid_residual_max_mm 12.4751235",
    "grid_residual_rms_mm 6.47",
    "grid_tolerance_mm 0.04",
    "tilt_deg 18.5",
    "slice_thickness_mm 4",
    "padding_share 0.2127",
    "gap_mm min 1.081 max 6.999 median 4.002",
    "gap_runs 13 x 4.002 1 x 1.081",
    "slice_overlap_mm min -0.00193 max 4.42",
    "slices used 27 dropped 6 missing 1",
    "phase 2 of 3",
    "dropped 4 identical duplicate",
    "dropped 2 other phase",
    "axes LPS",
    "affine_ijk_to_lps_mm 0.5 0 0 -12.5 0 0.7 0 31.25 0 0 1.25 -400 0 0 0 1",
    "gates 1 passed 1 failed",
    "gate_failed grid_residual: 12.5 mm, at most 0.04",
    "warning gantry tilt 18.50 degrees: kept exactly, as a shear",
    "warning 4 < 5 & so on",
]


@pytest.fixture
def mesh() -> Mesh:
    """A box whose report has the certificate `REPORT`."""
    vertices, triangles = samples.box()
    return Mesh(vertices, triangles, report={"iso_value_hu": 226.0, "certificate": REPORT})


def test_certificate_of_a_report_has_one_fact_a_line():
    assert list(certificate_lines(REPORT)) == LINES


def test_certificate_names_the_frame_of_reference_on_request_alone():
    with_ids = certificate_lines(REPORT, keep_ids=True)
    assert [line for line in with_ids if line not in LINES] == ["frame_of_reference ee740dfa4069b59a"]


def test_ply_holds_the_certificate_in_its_comments(mesh, tmp_path):
    mesh.save(tmp_path / "box.ply")
    header = (tmp_path / "box.ply").read_bytes().split(b"end_header\n")[0].decode("ascii").splitlines()
    assert [line for line in header if "CERTIFICATE" in line] == [f"comment CERTIFICATE {line}" for line in LINES]


def test_obj_holds_the_certificate_in_its_comments(mesh, tmp_path):
    mesh.save(tmp_path / "box.obj")
    lines = (tmp_path / "box.obj").read_text("ascii").splitlines()
    assert [line for line in lines if "CERTIFICATE" in line] == [f"# CERTIFICATE {line}" for line in LINES]


def test_vtp_holds_the_certificate_as_a_field_array(mesh, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh.save(tmp_path / "box.vtp")
    assert list(pyvista.read(tmp_path / "box.vtp").field_data["CERTIFICATE"]) == LINES


def test_glb_holds_the_certificate_in_its_extras(mesh, tmp_path):
    mesh.save(tmp_path / "box.glb")
    content = (tmp_path / "box.glb").read_bytes()
    (json_length,) = struct.unpack("<I", content[12:16])
    document = json.loads(content[20 : 20 + json_length])
    assert document["asset"]["extras"]["certificate"] == LINES


def test_3mf_holds_the_certificate_in_its_description(mesh, tmp_path):
    mesh.save(tmp_path / "box.3mf")
    with zipfile.ZipFile(tmp_path / "box.3mf") as package:
        root = ElementTree.fromstring(package.read("3D/3dmodel.model"))
    (description,) = [element.text for element in root if element.get("name") == "Description"]
    assert description.splitlines() == [
        "SPACE=LPS UNIT=mm ISO_VALUE_HU=226",
        *(f"CERTIFICATE {line}" for line in LINES),
    ]


@pytest.mark.parametrize("extension", [".ply", ".obj", ".glb", ".3mf"])
def test_trimesh_reads_mesh_files_with_a_certificate(mesh, extension, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh.save(tmp_path / f"box{extension}")
    read = trimesh.load_scene(tmp_path / f"box{extension}", process=False).to_mesh()
    assert (len(read.vertices), len(read.faces)) == (mesh.vertex_count, mesh.triangle_count)


def test_vtk_reads_a_ply_with_a_certificate(mesh, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    mesh.save(tmp_path / "box.ply")
    assert pyvista.read(tmp_path / "box.ply").n_cells == mesh.triangle_count


@pytest.mark.parametrize("extension", [".stl", ".ply", ".obj", ".glb", ".3mf", ".vtp"])
def test_mesh_files_hold_neither_description_nor_hash_of_the_series(mesh, extension, tmp_path):
    path = tmp_path / f"box{extension}"
    mesh.save(path)
    content = path.read_bytes()
    if extension == ".3mf":
        with zipfile.ZipFile(path) as package:
            content += b"".join(package.read(name) for name in package.namelist())
    assert REPORT["description"].encode() not in content
    assert REPORT["series"]["uid_hash"].encode() not in content


@pytest.mark.parametrize(
    "report",
    [
        pytest.param({}, id="empty"),
        pytest.param(
            {"warnings": "no list", "gap_mm": 3, "gates": {}, "dropped": [], "orientation": [], "thickness": 5},
            id="other types",
        ),
        pytest.param(
            {
                "tilt_deg": float("nan"),
                "grid_residual_max_mm": "0.1\nelement vertex 0",
                "slices": True,
                "dropped": {},
                "gates": 1,
            },
            id="no numbers",
        ),
        pytest.param(
            {
                "frame_of_reference_hash": "1.2.840.113619.2.5",
                "orientation": {"axes": "DOE"},
                "affine_ijk_to_lps_mm": [1],
            },
            id="identifiers of a patient",
        ),
        pytest.param(
            {"gap_mm": {"min": 1, "max": None, "median": 2}, "gap_runs": [{"count": 1}], "hu_range": [1, 2]},
            id="incomplete",
        ),
    ],
)
def test_facts_of_a_report_that_are_not_sound_have_no_line(report):
    assert certificate_lines(report) == ()


HOSTILE_WARNINGS = ["SPACE=RAS", "line\nend_header\r\nx", "gr\xf6\xdfe \u202e \x1b[31m", "x" * 1000, *["more"] * 30]


def test_each_warning_becomes_one_short_line_of_printable_ascii():
    lines = certificate_lines({"warnings": HOSTILE_WARNINGS})
    assert lines[0] == "warning SPACE:RAS"
    assert lines[1] == "warning line\\x0aend_header\\x0d\\x0ax"
    assert all(line.isascii() and line.isprintable() and len(line) <= LINE_LENGTH for line in lines)


def test_warnings_beyond_the_first_twenty_are_counted():
    lines = certificate_lines({"warnings": HOSTILE_WARNINGS})
    assert WARNINGS_WRITTEN == 20
    assert len(lines) == 20 + 1
    assert lines[-1] == f"warning and {len(HOSTILE_WARNINGS) - 20} more, in the report"


@pytest.mark.parametrize("extension", [".ply", ".obj", ".vtp", ".glb", ".3mf"])
def test_mesh_file_with_hostile_warnings_is_read_back_by_its_check(extension, tmp_path):
    mesh = Mesh(*samples.box(), report={"certificate": {"warnings": HOSTILE_WARNINGS}})
    assert mesh.save(tmp_path / f"box{extension}") > 0  # every writer checks its file


def test_isosurface_has_the_certificate_of_its_volume(device):
    voxels = np.zeros((6, 6, 6), np.int16)
    voxels[2:4, 2:4, 2:4] = 500
    report = {"warnings": ["one"], "tilt_deg": 3.0}
    mesh = extract_isosurface(Volume(voxels, np.eye(4), report), 250, device=device)
    assert certificate_lines(mesh.report["certificate"]) == ("tilt_deg 3", "warning one")
