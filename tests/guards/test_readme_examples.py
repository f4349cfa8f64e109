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


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A series, and a label map and a cloud with the names that the example asks for."""
    folder = tmp_path_factory.mktemp("examples")
    write_phantom(folder / "ct", PhantomSettings(size=(64, 64), slices=48, spacing=(3.0, 3.0, 3.0)))
    volume = clrecon.read_volume(folder / "ct")
    bone = (volume.voxels >= 226).astype(np.uint8)
    header = {"Segment0_LabelValue": "1", "Segment0_Layer": "0", "Segment0_Name": "T12", "Segment0_ID": "a"}
    write_nrrd(folder / "segmentation.seg.nrrd", bone, volume.affine, **header)
    clrecon.PointCloud(np.random.default_rng(1).normal(size=(500, 3))).save(folder / "scan.ply", "ras")
    return folder


def block_of(name: str) -> str:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 1
    return blocks[0]


def test_the_example_of_the_readme_runs(folder, device, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    made: dict = {}
    exec(compile(block_of("README.md").replace('"CT_FOLDER"', '"ct"'), "README.md", "exec"), made)
    assert made["mesh"].quality()["closed"] and made["choice"].method == "auto"
    assert {"bone.stl", "spine.png"} <= {path.name for path in folder.iterdir()}


def test_vertebrae_of_the_readme_are_named_so_that_the_next_command_finds_l3(folder, device, monkeypatch):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    chain = re.search(r"^    (clrecon vertebrae .*)\n    (clrecon mesh .* --label L3)$", text, re.MULTILINE)
    assert chain is not None
    loin = PhantomSettings(levels="T12-L3", facet_gap_mm=0.0, size=(112, 112), spacing=(2.0, 2.0, 2.5))
    write_phantom(folder / "loin", loin)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    for command in chain.groups():
        assert main([*command.replace("CT_FOLDER", "loin").split()[1:], "-q"]) == 0
    truth = clrecon.read_labels("loin/levels.nrrd")
    l3 = truth.ijk_to_lps(np.argwhere(truth.voxels == truth.find("L3"))[:, ::-1])
    found = clrecon.read_mesh("l3.stl").vertices
    assert np.abs(found.mean(axis=0) - l3.mean(axis=0)).max() < 5.0
    assert found[:, 2].min() > l3[:, 2].min() - 5.0 and found[:, 2].max() < l3[:, 2].max() + 5.0


def test_code_of_the_tour_runs(folder, device, monkeypatch):
    source = block_of("docs/tour.md")
    for text, other in SMALLER.items():
        assert text in source, text
        source = source.replace(text, other)
    monkeypatch.chdir(folder)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    made: dict = {}
    exec(compile(source, "docs/tour.md", "exec"), made)
    assert made["vertebra"].quality()["closed"] and made["front"].image[..., :3].any()
    assert {"bone.stl", "spine.png", "bone.gif"} <= {path.name for path in folder.iterdir()}


def test_the_examples_of_styles_run(folder, device, monkeypatch):
    text = (ROOT / "docs" / "rendering.md").read_text(encoding="utf-8")
    block = re.search(r"(    bone = clrecon\.SurfaceLook.*?)\n\n", text, re.DOTALL)
    assert block is not None
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    made: dict[str, Any] = {"clrecon": clrecon, "volume": clrecon.read_volume(folder / "ct")}
    exec(compile(textwrap.dedent(block[1]), "docs/rendering.md", "exec"), made)
    assert all(made[name].image[..., :3].any() for name in ("picture", "front", "side", "chest", "spine"))


def test_the_examples_of_volumes_run(folder, monkeypatch):
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    blocks = re.findall(r"((?:^    .*\n)+)", text, re.MULTILINE)
    assert len(blocks) == 5
    monkeypatch.chdir(folder)
    volume, labels = clrecon.read_volume("ct"), clrecon.read_labels("segmentation.seg.nrrd")
    made: dict[str, Any] = {"clrecon": clrecon, "numpy": np, "threading": threading, "volume": volume, "labels": labels}
    made |= {"mesh": clrecon.extract_isosurface(volume, 226), "second_volume": volume[3:20, 5:]}
    made.update({name: pytest.importorskip(name) for name in ("SimpleITK", "nibabel")})
    for block in blocks:
        exec(compile(textwrap.dedent(block), "docs/python.md", "exec"), made)
    assert made["spine"].shape == (30, 64, 32) and made["slab"].shape == (1, 64, 64)
    assert made["coarse"].spacing == pytest.approx((6.0, 6.0, 6.0))
    assert made["same"].affine == pytest.approx(volume.affine) and made["scan"].dtype == volume.dtype
    assert made["surface"].quality().closed
    assert made["mean_hu"] >= 226 and made["even"].spacing == pytest.approx((2.0, 2.0, 2.0))
    assert made["loin"].shape[0] == 16 and made["near"].shape_ijk == (20, 20, 20)
