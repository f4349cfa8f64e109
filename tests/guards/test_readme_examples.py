"""The Python examples of README.md, docs/tour.md, rendering.md and python.md run as they stand, on a small phantom."""

from __future__ import annotations

import re
import textwrap
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from house import ROOT
from label_files import write_nrrd

import clrecon
from clrecon.cli.main import main
from clrecon.proof.phantom import PhantomSettings, write_phantom

SMALLER = {
    '"CT_FOLDER"': '"ct"',
    "size=(800, 800)": "size=(80, 80)",
    "clrecon.Camera.fit(volume), 120)": "clrecon.Camera.fit(volume, size=(64, 64)), 2)",
    "renderer.render(camera=camera)": "renderer.render(camera=camera, size=(64, 64))",
}  # fmt: skip
"""What the machine of a test has not, or what takes long, and what stands for it."""


BONE_HU = 226
"""Label T12 of the examples is all voxels of the phantom from this value on, and their mesh is at it."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A series, and a label map and a cloud with the names that the example asks for."""
    folder = tmp_path_factory.mktemp("examples")
    write_phantom(folder / "ct", PhantomSettings(size=(64, 64), slices=48, spacing=(3.0, 3.0, 3.0)))
    volume = clrecon.read_volume(folder / "ct")
    bone = (volume.voxels >= BONE_HU).astype(np.uint8)
    header = {"Segment0_LabelValue": "1", "Segment0_Layer": "0", "Segment0_Name": "T12", "Segment0_ID": "a"}
    write_nrrd(folder / "segmentation.seg.nrrd", bone, volume.affine, **header)
    clrecon.PointCloud(np.random.default_rng(1).normal(size=(500, 3))).save(folder / "scan.ply", "ras")
    return folder


def block_of(name: str) -> str:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 1
    return blocks[0]


@pytest.fixture
def in_folder(folder, device, monkeypatch) -> Path:
    """The folder of examples, which is the current one; `clrecon` takes the device of the test."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    return folder


def run_python(source: str, name: str, **variables: Any) -> dict[str, Any]:
    """Run a block of a document; returns the variables that it makes."""
    exec(compile(source, name, "exec"), variables)
    return variables


def is_drawn(picture: clrecon.Rendering) -> bool:
    return bool(picture.image[..., :3].any())


def test_example_of_the_readme_makes_a_closed_mesh_at_the_automatic_iso_value_and_a_picture(in_folder):
    source = block_of("README.md").replace('"CT_FOLDER"', '"ct"')
    variables = run_python(source, "README.md")
    assert variables["choice"].method == "auto"
    assert variables["mesh"].quality()["closed"]
    assert {"bone.stl", "spine.png"} <= {path.name for path in in_folder.iterdir()}


def test_commands_of_the_readme_name_vertebrae_so_that_l3_is_meshed_within_its_label(in_folder):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    commands = re.search(r"^    (clrecon vertebrae .*)\n    (clrecon mesh .* --label L3)$", text, re.MULTILINE)
    assert commands is not None
    write_phantom(
        in_folder / "loin", PhantomSettings(levels="T12-L3", facet_gap_mm=0.0, size=(112, 112), spacing=(2.0, 2.0, 2.5))
    )

    for command in commands.groups():
        assert main([*command.replace("CT_FOLDER", "loin").split()[1:], "-q"]) == 0

    truth = clrecon.read_labels("loin/levels.nrrd")
    l3 = truth.ijk_to_lps(np.argwhere(truth.voxels == truth.find("L3"))[:, ::-1])
    vertices = clrecon.read_mesh("l3.stl").vertices
    tolerance_mm = 5.0  # two slices: vertebrae are divided at discs, a level is 30 mm high
    assert np.abs(vertices.mean(axis=0) - l3.mean(axis=0)).max() < tolerance_mm
    assert vertices[:, 2].min() > l3[:, 2].min() - tolerance_mm
    assert vertices[:, 2].max() < l3[:, 2].max() + tolerance_mm


def test_example_of_the_tour_makes_a_closed_vertebra_and_pictures(in_folder):
    source = block_of("docs/tour.md")
    for text, smaller in SMALLER.items():
        assert text in source, text
        source = source.replace(text, smaller)

    variables = run_python(source, "docs/tour.md")

    assert variables["vertebra"].quality()["closed"]
    assert is_drawn(variables["front"])
    assert {"bone.stl", "spine.png", "bone.gif"} <= {path.name for path in in_folder.iterdir()}


def test_examples_of_styles_on_the_page_of_rendering_draw_each_of_their_pictures(in_folder):
    text = (ROOT / "docs" / "rendering.md").read_text(encoding="utf-8")
    block = re.search(r"(    bone = clrecon\.SurfaceLook.*?)\n\n", text, re.DOTALL)
    assert block is not None
    volume = clrecon.read_volume("ct")
    variables = run_python(textwrap.dedent(block[1]), "docs/rendering.md", clrecon=clrecon, volume=volume)
    pictures = ("picture", "front", "side", "chest", "spine")
    assert [name for name in pictures if not is_drawn(variables[name])] == []


@pytest.fixture(scope="module")
def scan(folder) -> clrecon.Volume:
    """64 x 64 x 48 voxels of 3 mm."""
    return clrecon.read_volume(folder / "ct")


@pytest.fixture(scope="module")
def of_python_page(folder, scan) -> dict[str, Any]:
    """The variables that the examples of docs/python.md make, from top to bottom."""
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"((?:^    .*\n)+)", text, re.MULTILINE)
    variables: dict[str, Any] = {"clrecon": clrecon, "numpy": np, "threading": threading, "volume": scan}
    variables |= {"mesh": clrecon.extract_isosurface(scan, BONE_HU), "second_volume": scan[3:20, 5:]}
    variables |= {name: pytest.importorskip(name) for name in ("SimpleITK", "nibabel")}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        variables["labels"] = clrecon.read_labels("segmentation.seg.nrrd")
        for block in blocks:
            exec(compile(textwrap.dedent(block), "docs/python.md", "exec"), variables)
    return variables


@pytest.mark.parametrize(
    ("name", "shape"),
    [("spine", (40 - 10, 64, 48 - 16)), ("slab", (1, 64, 64))],
    ids=["slices 10 to 39 and columns 16 to 47", "one slice"],
)
def test_sliced_volume_of_the_page_on_python_has_the_shape_of_its_slices(of_python_page, name, shape):
    assert of_python_page[name].shape == shape


@pytest.mark.parametrize(("name", "spacing"), [("coarse", (6.0, 6.0, 6.0)), ("even", (2.0, 2.0, 2.0))])
def test_resampled_volume_of_the_page_on_python_has_its_spacing(of_python_page, name, spacing):
    assert of_python_page[name].spacing == pytest.approx(spacing)


def test_volume_of_the_page_on_python_comes_back_from_pyvista_with_its_affine(of_python_page, scan):
    assert of_python_page["same"].affine == pytest.approx(scan.affine)


def test_volume_of_the_page_on_python_comes_back_from_nibabel_with_its_type(of_python_page, scan):
    assert of_python_page["scan"].dtype == scan.dtype


def test_surface_of_the_page_on_python_is_closed(of_python_page):
    assert of_python_page["surface"].quality().closed


def test_mean_of_the_bone_of_the_page_on_python_is_above_its_iso_value(of_python_page):
    assert of_python_page["mean_hu"] >= BONE_HU  # measured 423


def test_region_between_two_heights_of_the_page_on_python_has_its_slices(of_python_page):
    slices_in_50_mm = 50 // 3  # from -450 to -400 mm in slices of 3 mm
    assert of_python_page["loin"].shape[0] == slices_in_50_mm


def test_region_around_a_point_of_the_page_on_python_is_a_cube_of_its_radius(of_python_page):
    voxels_in_60_mm = 2 * 30 // 3  # a radius of 30 mm in voxels of 3 mm
    assert of_python_page["near"].shape_ijk == (voxels_in_60_mm,) * 3
