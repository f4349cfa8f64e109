"""``clrecon view --html``: what becomes of scans and meshes, their names, frames and colours, and wrong usage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from coded_pages import decode_surface, parse_slices, unpack_slices
from command_lines import check_refused
from sample_meshes import ball

import clrecon
from clrecon.cli.main import main
from clrecon.exchange.page import parse_page
from clrecon.geometry import Volume
from clrecon.mesh import Mesh

MIDDLE = np.array([40.0, -25.0, -800.0])


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """DOE_JANE.stl, a ball of 10 mm about `MIDDLE` in LPS, and b.ply in RAS, one of 5 mm, 30 mm to the left of it."""
    vertices, triangles = ball(10.0, rings=30)
    found = {name: tmp_path / name for name in ("DOE_JANE.stl", "b.ply", "none.stl", "empty.ply")}
    Mesh(vertices + MIDDLE, triangles).save(found["DOE_JANE.stl"])
    Mesh(0.5 * vertices + MIDDLE + (30.0, 0.0, 0.0), triangles).save(found["b.ply"], "ras")
    return found


def read_facts(page: Path):
    """What a page says of its surface."""
    facts, _ = parse_page(page.read_bytes())
    return facts


@pytest.mark.unit
def test_meshes_of_a_page_lie_at_their_places_in_lps_and_the_turned_one_is_named(files, tmp_path, printed):
    page = tmp_path / "both.html"

    assert main(["view", str(files["DOE_JANE.stl"]), str(files["b.ply"]), "--html", str(page)]) == 0

    printed().assert_output("RAS", "LPS")
    facts, coded = parse_page(page.read_bytes())
    vertices, _, triangles = decode_surface(coded)
    first, second = (
        vertices[triangles[part["first"] : part["first"] + part["count"]].reshape(-1)] for part in facts["parts"]
    )
    step_mm = 0.05  # of the coordinates on a page, and the facets of the balls
    np.testing.assert_allclose((first.min(axis=0) + first.max(axis=0)) / 2, MIDDLE, atol=step_mm)
    np.testing.assert_allclose((second.min(axis=0) + second.max(axis=0)) / 2, MIDDLE + (30, 0, 0), atol=step_mm)


@pytest.mark.unit
def test_meshes_of_a_page_have_their_given_names_colours_and_volumes(files, tmp_path):
    page = tmp_path / "both.html"
    names = ["--name", "bone", "--name", "screw"]

    assert main(["view", str(files["DOE_JANE.stl"]), str(files["b.ply"]), "--html", str(page), *names]) == 0

    bone, screw = read_facts(page)["parts"]
    assert (bone["name"], screw["name"]) == ("bone", "screw")
    assert bone["color"] != screw["color"]
    assert bone["ml"] == pytest.approx(2**3 * screw["ml"], rel=1e-3)  # twice the radius


@pytest.mark.unit
def test_page_and_report_have_numbers_in_place_of_names_of_files(files, tmp_path, printed):
    page = tmp_path / "both.html"
    assert main(["view", str(files["DOE_JANE.stl"]), str(files["b.ply"]), "--html", str(page), "--json"]) == 0
    report = printed().report()
    content = page.read_bytes()
    assert b"DOE_JANE" not in content and str(tmp_path).encode() not in content
    assert [part["name"] for part in report["parts"]] == ["surface 1", "surface 2"]
    _, in_ras = report["inputs"]
    assert in_ras["space_from"] == "file"
    assert report["output"] == {"format": "html", "bytes": len(content)}
    assert report["device"] is None


def write_two_balls(tmp_path: Path) -> tuple[Path, Path]:
    """Balls of 11 and 8 mm, 500 HU in air with 1 mm voxels, and a label map with 1 and 2 a voxel around them."""
    k, j, i = np.indices((30, 32, 60)).astype(float)
    one, other = (np.sqrt((k - 15) ** 2 + (j - 16) ** 2 + (i - x) ** 2) for x in (15, 45))
    voxels = np.where((one < 11) | (other < 8), 500, -1000).astype(np.int16)
    affine = np.eye(4)
    Volume(voxels, affine).save(tmp_path / "scan.nii.gz")
    clrecon.write_volume(Volume(((one < 12) + 2 * (other < 9)).astype(np.int16), affine), tmp_path / "labels.nii.gz")
    return tmp_path / "scan.nii.gz", tmp_path / "labels.nii.gz"


@pytest.mark.opencl
def test_page_of_a_scan_has_its_surface_by_components_with_their_volumes(tmp_path, printed, device):
    source, _ = write_two_balls(tmp_path)
    page = tmp_path / "scan.html"

    assert main(["view", str(source), "--html", str(page), "--hu", "0"]) == 0

    facts = read_facts(page)
    assert [part["name"] for part in facts["parts"]] == ["part 1", "part 2"]
    mesh = clrecon.extract_isosurface(clrecon.read_volume(source), 0)
    assert facts["triangles"] == mesh.triangle_count
    assert sum(part["ml"] for part in facts["parts"]) == pytest.approx(mesh.volume / 1000.0, rel=1e-5)  # float32
    assert "Surface: iso value 0 HU." in facts["about"]
    printed().assert_output(f"{mesh.triangle_count:,}")


@pytest.mark.opencl
def test_page_of_a_scan_with_labels_has_a_part_of_each_in_its_colour(tmp_path, device):
    source, labels = write_two_balls(tmp_path)
    page = tmp_path / "scan.html"
    options = ["--labels", str(labels), "--hu", "0", "--label-color", "2=#ff0000"]

    assert main(["view", str(source), "--html", str(page), *options]) == 0

    first, second = read_facts(page)["parts"]
    assert second["color"] == "#ff0000"
    assert first["color"] != "#ff0000"


@pytest.mark.opencl
def test_labels_of_a_page_have_the_names_of_their_files_as_they_are(tmp_path, device):
    source, _ = write_two_balls(tmp_path)
    folder, name = tmp_path / "masks", "<b>L3 & körper_1"
    folder.mkdir()
    mask = clrecon.read_volume(source).voxels > 0
    mask[..., 30:] = False  # one ball
    clrecon.write_volume(Volume(mask.astype(np.int16), np.eye(4)), folder / f"{name}.nii.gz")

    assert main(["view", str(source), "--html", str(tmp_path / "a.html"), "--labels", str(folder), "--hu", "0"]) == 0

    assert [part["name"] for part in read_facts(tmp_path / "a.html")["parts"]] == [name]


@pytest.mark.opencl
def test_page_with_slices_holds_those_of_its_scan(tmp_path, device):
    source, _ = write_two_balls(tmp_path)
    page = tmp_path / "scan.html"

    assert main(["view", str(source), "--html", str(page), "--hu", "0", "--with-slices"]) == 0

    slices = parse_slices(page.read_bytes())
    assert np.array_equal(unpack_slices(slices.facts, slices.data), clrecon.read_volume(source).voxels)


@pytest.mark.opencl
def test_page_of_a_scan_and_a_mesh_apart_from_it_is_written_with_a_warning(tmp_path, files, printed, device):
    page = tmp_path / "both.html"
    source, _ = write_two_balls(tmp_path)
    assert main(["view", str(source), str(files["b.ply"]), "--html", str(page), "--hu", "0"]) == 0
    assert [part["name"] for part in read_facts(page)["parts"]] == ["surface 1", "surface 2"]
    printed().assert_error("lie")  # the boxes lie apart


@pytest.mark.opencl
def test_mesh_command_writes_a_page(tmp_path, device):
    page = tmp_path / "mesh.html"
    source, _ = write_two_balls(tmp_path)
    assert main(["mesh", str(source), "-o", str(page), "--hu", "0", "--keep-largest", "1"]) == 0
    assert [part["name"] for part in read_facts(page)["parts"]] == ["surface"]


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
        (["{a}", "--html", "{page}", "--with-slices"], "--with-slices"),
        (["{a}", "--with-slices"], "--html"),
        (["{a}", "--html", "{page}", "--label", "L1"], "--labels"),
    ],
)
def test_wrong_usage_of_view_is_refused_in_one_line_and_writes_no_page(arguments, fact, files, tmp_path, printed):
    page = tmp_path / "page.html"
    filled = [word.format(a=files["DOE_JANE.stl"], page=page) for word in arguments]
    check_refused(["view", *filled], 3, fact, tmp_path, printed)
    assert not page.exists()


@pytest.mark.unit
def test_page_of_a_mesh_file_that_ends_early_is_refused_and_an_older_page_stays(files, tmp_path, printed):
    page = tmp_path / "page.html"
    page.write_bytes(b"older")
    path = files["b.ply"]
    path.write_bytes(path.read_bytes()[:-100])

    check_refused(["view", str(path), "--html", str(page)], 4, "b.ply", tmp_path, printed)

    assert page.read_bytes() == b"older"


@pytest.mark.unit
def test_existing_page_of_a_view_stays_with_no_clobber(files, tmp_path, printed):
    page = tmp_path / "page.html"
    page.write_bytes(b"older")

    command = ["view", str(files["DOE_JANE.stl"]), "--html", str(page), "--no-clobber"]
    check_refused(command, 6, "exists", tmp_path, printed)

    assert page.read_bytes() == b"older"
