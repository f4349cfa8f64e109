"""``clrecon view --html``: what becomes of scans and meshes, their names, frames and colours, and wrong usage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_lines import check_refused
from sample_meshes import ball

import clrecon
from clrecon.cli.main import main
from clrecon.exchange.page import decode_surface, parse_page
from clrecon.geometry import Volume
from clrecon.mesh import Mesh

MIDDLE = np.array([40.0, -25.0, -800.0])


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    vertices, triangles = ball(10.0, 30)
    found = {name: tmp_path / name for name in ("DOE_JANE.stl", "b.ply", "none.stl", "empty.ply")}
    Mesh(vertices + MIDDLE, triangles).save(found["DOE_JANE.stl"])
    Mesh(0.5 * vertices + MIDDLE + (30.0, 0.0, 0.0), triangles).save(found["b.ply"], "ras")
    return found


def read_page(path: Path):
    facts, coded = parse_page(path.read_bytes())
    return facts, *decode_surface(coded)


@pytest.mark.unit
def test_two_meshes_lie_where_they_are_and_the_turned_one_is_said(files, tmp_path, printed):
    page = tmp_path / "both.html"
    inputs = [str(files["DOE_JANE.stl"]), str(files["b.ply"])]
    assert main(["view", *inputs, "--html", str(page), "--name", "bone", "--name", "screw"]) == 0
    said = printed()
    said.assert_output("RAS", "LPS")
    facts, vertices, _, triangles = read_page(page)
    assert [part["name"] for part in facts["parts"]] == ["bone", "screw"]
    assert facts["parts"][0]["color"] != facts["parts"][1]["color"]
    assert facts["parts"][0]["ml"] == pytest.approx(8.0 * facts["parts"][1]["ml"], rel=1e-3)
    for part, middle in zip(facts["parts"], (MIDDLE, MIDDLE + (30.0, 0.0, 0.0)), strict=True):
        own = vertices[triangles[part["first"] : part["first"] + part["count"]].reshape(-1)]
        np.testing.assert_allclose((own.min(axis=0) + own.max(axis=0)) / 2, middle, atol=0.05)


@pytest.mark.unit
def test_names_of_files_are_not_on_the_page(files, tmp_path, printed):
    page = tmp_path / "both.html"
    assert main(["view", str(files["DOE_JANE.stl"]), str(files["b.ply"]), "--html", str(page), "--json"]) == 0
    report = printed().report()
    content = page.read_bytes()
    assert b"DOE_JANE" not in content and str(tmp_path).encode() not in content
    assert [part["name"] for part in report["parts"]] == ["surface 1", "surface 2"]
    assert report["inputs"][1]["space_from"] == "file"
    assert report["output"] == {"format": "html", "bytes": len(content)}
    assert report["device"] is None


def scan(tmp_path: Path) -> tuple[Path, Path]:
    """Two balls of 500 HU in air with 1 mm voxels, and a label map that names one of them."""
    k, j, i = np.indices((30, 32, 60)).astype(float)
    one, other = (np.sqrt((k - 15) ** 2 + (j - 16) ** 2 + (i - x) ** 2) for x in (15, 45))
    voxels = np.where(np.minimum(one, other + 3) < 11, 500, -1000).astype(np.int16)
    affine = np.eye(4)
    Volume(voxels, affine).save(tmp_path / "scan.nii.gz")
    clrecon.write_volume(Volume(((one < 12) + 2 * (other < 9)).astype(np.int16), affine), tmp_path / "labels.nii.gz")
    return tmp_path / "scan.nii.gz", tmp_path / "labels.nii.gz"


@pytest.mark.opencl
def test_a_scan_is_shown_by_its_components_and_with_labels_by_these(tmp_path, printed, device):
    source, labels = scan(tmp_path)
    page = tmp_path / "scan.html"
    assert main(["view", str(source), "--html", str(page), "--hu", "0"]) == 0
    facts = read_page(page)[0]
    assert [part["name"] for part in facts["parts"]] == ["part 1", "part 2"]
    mesh = clrecon.extract_isosurface(clrecon.read_volume(source), 0)
    assert facts["triangles"] == mesh.triangle_count
    assert sum(part["ml"] for part in facts["parts"]) == pytest.approx(mesh.volume / 1000.0, rel=1e-5)
    assert facts["about"][0] == "Surface: iso value 0 HU."
    printed().assert_output(0)
    options = ["--labels", str(labels), "--hu", "0", "--label-color", "2=#ff0000"]
    assert main(["view", str(source), "--html", str(page), *options]) == 0
    parts = read_page(page)[0]["parts"]
    assert len(parts) == 2 and parts[1]["color"] == "#ff0000" != parts[0]["color"]


@pytest.mark.opencl
def test_page_shows_a_scan_and_a_mesh_and_says_that_they_lie_apart(tmp_path, files, printed, device):
    page = tmp_path / "both.html"
    source = scan(tmp_path)[0]
    assert main(["view", str(source), str(files["b.ply"]), "--html", str(page), "--hu", "0"]) == 0
    assert [part["name"] for part in read_page(page)[0]["parts"]] == ["surface 1", "surface 2"]
    printed().assert_error("lie")  # the boxes lie apart


@pytest.mark.opencl
def test_the_mesh_job_writes_pages_too(tmp_path, device):
    page = tmp_path / "mesh.html"
    assert main(["mesh", str(scan(tmp_path)[0]), "-o", str(page), "--hu", "0", "--keep-largest", "1"]) == 0
    assert [part["name"] for part in read_page(page)[0]["parts"]] == ["surface"]


@pytest.mark.unit
@pytest.mark.parametrize(
    ("arguments", "fact"),
    [
        (["{a}", "--keep-largest", "1"], "--keep-largest"),
        (["{a}", "--save-as", "bone.abc"], "bone.abc"),
        (["{a}", "--save-as", "a.stl", "--html", "{page}"], "--save-as"),
        (["{a}", "--no-clobber"], "replaces"),
        (["{a}", "--html", "page.png"], "page.png"),
        (["{a}", "--html", "{page}", "--hu", "300"], "--hu"),
        (["{a}", "--html", "{page}", "--keep-largest", "1"], "--keep-largest"),
        (["{a}", "--html", "{page}", "--name", "a", "--name", "b"], 2),
        (["{a}", "--html", "{page}", "--name", " "], 80),
        (["{a}", "--html", "{page}", "--mesh-space", "abc"], "abc"),
        (["folder/gone.stl", "--html", "{page}"], "folder/gone.stl"),
        (["{a}", "--html", "{page}", "--label", "L1"], "--labels"),
    ],
)
def test_views_without_inputs_or_sense_are_refused(arguments, fact, files, tmp_path, printed):
    page = tmp_path / "page.html"
    filled = [word.format(a=files["DOE_JANE.stl"], page=page) for word in arguments]
    check_refused(["view", *filled], 3, fact, tmp_path, printed)
    assert not page.exists()


@pytest.mark.unit
def test_a_cut_mesh_leaves_the_older_page(files, tmp_path, printed):
    page = tmp_path / "page.html"
    page.write_bytes(b"older")
    path = files["b.ply"]
    path.write_bytes(path.read_bytes()[:-100])
    check_refused(["view", str(path), "--html", str(page)], 4, "b.ply", tmp_path, printed)
    check_refused(
        ["view", str(files["DOE_JANE.stl"]), "--html", str(page), "--no-clobber"], 6, "exists", tmp_path, printed
    )
    assert page.read_bytes() == b"older"
