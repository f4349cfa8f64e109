"""Meshes from files in pictures: as the input, and with a scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from PIL import Image
from printed_text import Printer
from refusals import refused
from sample_meshes import ball

import clrecon
from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import MeshFile, RenderSettings
from clrecon.rendering.looks.lighting import UNSHADED
from clrecon.system.color_scale import ColorScale


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Balls of 5 mm: lps.stl about the origin, ras.ply 12 mm to the patient's left, plain.stl that names no frame; and
    scan.nii, a scan of 40 mm around them."""
    vertices, triangles = ball(5.0, rings=12)
    found = {name: tmp_path / name for name in ("lps.stl", "ras.ply", "plain.stl", "scan.nii")}
    clrecon.Mesh(vertices, triangles).save(found["lps.stl"])
    clrecon.Mesh(vertices + (12.0, 0.0, 0.0), triangles).save(found["ras.ply"], "ras")
    content = found["lps.stl"].read_bytes()
    found["plain.stl"].write_bytes(content[:80].replace(b"SPACE=LPS", b"         ") + content[80:])
    import nibabel

    affine = np.diag([-2.0, -2.0, 2.0, 1.0])
    affine[:3, 3] = 19.0, 19.0, -19.0
    image = nibabel.Nifti1Image(np.arange(8000, dtype=np.int16).reshape(20, 20, 20) % 500, affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, found["scan.nii"])
    return found


def test_mesh_file_alone_is_rendered_in_mode_mesh(
    device: Any, files: dict[str, Path], tmp_path: Path, printed: Printer
) -> None:
    out = tmp_path / "out.png"
    look = ["--mode", "mesh", "--size", "64x48", "--color", "orange"]

    assert main(["render", str(files["ras.ply"]), "-o", str(out), *look]) == 0

    assert out.exists()
    said = printed()
    said.assert_output("mode", "mesh", "triangles")
    assert said.error_lines == 0


def test_picture_of_meshes_in_two_frames_is_centred_between_them(
    device: Any, files: dict[str, Path], tmp_path: Path
) -> None:
    settings = RenderSettings.of("mesh", size=(64, 48), meshes=(MeshFile(str(files["lps.stl"]), color="red"),))

    report = make_pictures(files["ras.ply"], PictureFiles(tmp_path / "out.png"), settings)

    assert (report.mode, report.cloud) == ("mesh", None)
    assert [mesh["file"]["space"] for mesh in report.meshes] == ["RAS", "LPS"]
    assert report.meshes[1]["color"] == [1.0, 0.0, 0.0]  # red, as given
    between = (6.0, 0.0, 0.0)  # the balls lie at x = 12 mm and 0 in LPS
    assert np.allclose(report.pictures[0]["camera"]["focal_point_lps_mm"], between, atol=0.2)  # facets of 24 sides


def test_meshes_without_a_scan_have_the_given_colour_and_opacity_or_those_by_default(
    device: Any, files: dict[str, Path], tmp_path: Path, printed: Printer
) -> None:
    glb = tmp_path / "other.glb"
    clrecon.read_mesh(files["ras.ply"]).save(glb)
    command = ["render", "--mesh", str(glb), "--mesh", f"{files['lps.stl']}=red,0.5", "--size", "64x48", "--json"]

    assert main([*command, "-o", str(tmp_path / "out.png")]) == 0

    by_default, red = printed().report()["meshes"]
    assert (by_default["file"]["kind"], by_default["opacity"]) == ("GLB", 1)
    assert (red["file"]["kind"], red["opacity"], red["color"]) == ("STL", 0.5, [1.0, 0.0, 0.0])
    assert by_default["color"] != red["color"]


@pytest.mark.parametrize("words", [[], ["--mesh", "lps.stl", "--mode", "mip"]], ids=["no input", "mode of scans"])
def test_render_without_a_scan_is_refused_where_there_is_nothing_to_draw(
    words: list[str], files: dict[str, Path], monkeypatch: pytest.MonkeyPatch, printed: Printer
) -> None:
    monkeypatch.chdir(files["lps.stl"].parent)

    assert main(["render", *words, "-o", "a.png"]) == 3

    assert printed().error_lines == 1


@pytest.mark.parametrize("mode", ["dvr", "slices", "surface"])
def test_meshes_are_drawn_into_a_scan_in_colours_of_their_own(
    device: Any, files: dict[str, Path], tmp_path: Path, mode: str
) -> None:
    out = tmp_path / "out.png"
    meshes = (MeshFile(str(files["lps.stl"])), MeshFile(str(files["lps.stl"]), opacity=0.5))
    extra = {"iso_value": 300.0} if mode == "surface" else {}
    settings = RenderSettings.of(mode, size=(64, 48), meshes=meshes, **extra)

    report = make_pictures(files["scan.nii"], PictureFiles(out), settings)

    first, second = report.meshes
    assert first["color"] != second["color"]
    with_meshes = np.asarray(Image.open(out)).astype(int)
    make_pictures(files["scan.nii"], PictureFiles(out), replace(settings, meshes=()))
    differs = np.abs(np.asarray(Image.open(out)) - with_meshes).max(axis=2) > 10  # of 255
    assert differs.mean() > 0.003  # measured 0.006 behind translucent slices, 0.014 and 0.015 in the other modes


def test_mesh_that_names_no_frame_is_drawn_with_a_warning(device: Any, files: dict[str, Path], tmp_path: Path) -> None:
    settings = RenderSettings.of("dvr", size=(64, 48), meshes=(MeshFile(str(files["plain.stl"])),))

    report = make_pictures(files["scan.nii"], PictureFiles(tmp_path / "out.png"), settings)

    assert any("plain.stl names no patient frame" in text for text in report.warnings)


@pytest.fixture
def walls_file(files: dict[str, Path]) -> Path:
    """The ball of 5 mm with a thickness at each vertex: 1 mm in the middle, 0.1 mm more a mm to the patient's left, the
    picture's right; NaN in the lowest part. `distance_mm` is what it has more than 1 mm."""
    mesh = clrecon.read_mesh(files["lps.stl"])
    thickness = 1.0 + 0.1 * mesh.vertices[:, 0].astype(float)
    thickness[mesh.vertices[:, 2] < -1.0] = np.nan
    mesh.values = {"thickness_mm": thickness, "distance_mm": thickness - 1.0}
    path = files["lps.stl"].with_name("walls.ply")
    mesh.save(path)
    return path


def test_ply_keeps_values_at_vertices_with_their_gaps(walls_file: Path, files: dict[str, Path]) -> None:
    thickness = clrecon.read_mesh(walls_file).values["thickness_mm"]

    vertices = clrecon.read_mesh(files["lps.stl"]).vertices
    expected = np.where(vertices[:, 2] < -1.0, np.nan, 1.0 + 0.1 * vertices[:, 0].astype(float))
    assert np.array_equal(thickness, expected.astype(np.float32), equal_nan=True)


def test_mesh_is_coloured_by_the_thickness_at_its_vertices(device: Any, walls_file: Path) -> None:
    mesh = clrecon.read_mesh(walls_file)

    picture = clrecon.render(mesh, color_by="thickness", size=(200, 200), lighting=UNSHADED, device=device)

    scale = ColorScale(2.0, signed=False)  # from 0 mm to the largest thickness of 1.5 mm, rounded up
    pixel_mm = 2.0 * picture.camera.parallel_scale / 200
    above_the_unknown = 80
    for column in (30, 100, 170):
        thickness_mm = 1.0 + 0.1 * (column + 0.5 - 100) * pixel_mm
        color = picture.image[above_the_unknown, column, :3].astype(int)
        assert np.abs(color - scale.colors([thickness_mm])[0]).max() <= tolerances.RAY_RESAMPLED_255


def test_vertices_without_a_thickness_are_grey(device: Any, walls_file: Path) -> None:
    mesh = clrecon.read_mesh(walls_file)

    image = clrecon.render(mesh, color_by="thickness", size=(200, 200), lighting=UNSHADED, device=device).image

    row_of_the_lowest_part, middle = 160, 100
    assert image[row_of_the_lowest_part, middle, :3].tolist() == [128, 128, 128]


def test_distance_of_0_at_vertices_has_the_light_middle_of_the_signed_scale(device: Any, walls_file: Path) -> None:
    look = clrecon.MeshLook(color_by="distance", lighting=UNSHADED)

    image = clrecon.render(clrecon.read_mesh(walls_file), look, size=(200, 200), device=device).image

    middle = image[80, 100, :3].astype(int)  # above the unknown part, where the thickness is 1 mm
    light = ColorScale(0.5, signed=True).colors([0.0])[0]
    assert np.abs(middle - light).max() <= tolerances.RAY_RESAMPLED_255


def test_command_draws_thickness_as_the_function_does_with_its_scale_beside_it(
    device: Any, walls_file: Path, tmp_path: Path, printed: Printer
) -> None:
    out = tmp_path / "out.png"
    command = ["render", str(walls_file), "-o", str(out), "--size", "200", "--color", "thickness", "--light", "none"]

    assert main([*command, "--json"]) == 0

    (mesh,) = printed().report()["meshes"]
    assert (mesh["color_by"], mesh["range_mm"]) == ("thickness", [0.0, 2.0])
    of_function = clrecon.render(
        clrecon.read_mesh(walls_file), color_by="thickness", size=(200, 200), lighting=UNSHADED, device=device
    )
    drawn = np.array(Image.open(out))
    assert np.array_equal(drawn[:, :200, :3], of_function.image[..., :3])
    assert drawn.shape[1] > 220  # the bar and its numbers


def test_colour_by_values_that_the_mesh_has_not_is_refused(device: Any, walls_file: Path) -> None:
    with refused(UsageError, "error_mm", "vertices"):
        clrecon.render(clrecon.read_mesh(walls_file), color_by="error", device=device)


def test_colour_by_thickness_of_a_plain_mesh_is_refused_with_the_kind_that_has_it(
    files: dict[str, Path], tmp_path: Path, printed: Printer
) -> None:
    assert main(["render", str(files["lps.stl"]), "-o", str(tmp_path / "a.png"), "--color", "thickness"]) == 3
    printed().assert_error("fitted", "cortex")


def test_turntable_of_a_mesh_writes_the_given_number_of_frames(
    device: Any, files: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "frames"

    assert main(["render", str(files["lps.stl"]), "--turntable", str(folder), "--frames", "3", "--size", "32"]) == 0

    assert len(list(folder.iterdir())) == 3


@pytest.mark.parametrize(
    ("words", "text"),
    [
        pytest.param(
            ["scan.nii", "--mode", "mip", "--mesh", "lps.stl"], "--mesh does not apply to mode mip", id="mode mip"
        ),
        pytest.param(["scan.nii", "--mesh-space", "ras"], "name one with --mesh", id="frame of no mesh"),
        pytest.param(["scan.nii", "--mesh", "lps.stl=octarine"], "unknown colour 'octarine'", id="unknown colour"),
        pytest.param(["scan.nii", "--mesh", "lps.stl=red,2"], "opacity of a mesh", id="opacity above 1"),
        pytest.param(["scan.nii", "--mesh", "lps.stl=red,x"], "FILE[=COLOUR[,OPACITY]]", id="opacity of a word"),
        pytest.param(["scan.nii", "--mesh", "a.off"], ".stl, .ply", id="other format"),
        pytest.param(["lps.stl", "--mode", "dvr"], "mode mesh shows, and not mode dvr", id="mesh in a mode of scans"),
        pytest.param(["lps.stl", "--fov"], "the input is a mesh", id="field of view of a mesh"),
        pytest.param(["lps.stl", "--mesh-space", "ras"], "leave the space out", id="other frame than the file names"),
        pytest.param(["scan.nii", "--mode", "mesh"], ".stl, .ply", id="scan in mode mesh"),
        pytest.param(["scan.nii", "--opacity", "0.5"], "--opacity does not apply to mode dvr", id="opacity of a scan"),
    ],
)
def test_wrong_options_for_a_picture_with_meshes_are_refused_in_one_line(
    words: list[str], text: str, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(files["scan.nii"].parent)

    assert main(["render", *words, "-o", "out.png"]) == 3

    (line,) = capsys.readouterr().err.splitlines()
    assert text in line
    assert not Path("out.png").exists()


def test_mesh_file_in_an_unknown_colour_is_refused() -> None:
    with refused(UsageError, "colour", "octarine"):
        MeshFile("a.stl", color="octarine")
