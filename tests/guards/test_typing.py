"""What a type checker says of user scripts: nothing of right ones, something of each wrong call."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from house import ROOT

RIGHT = """\
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import clrecon


def surfaces(folder: Path) -> list[clrecon.Mesh]:
    volume = clrecon.read_volume(folder)
    with clrecon.DeviceVolume(volume, device="cpu") as kept:
        meshes = clrecon.extract_isosurfaces(kept, [150, (200, 300), (300, None), "auto"], topology="separated")
        part: clrecon.DeviceVolume = kept[4:9]
        meshes.append(clrecon.extract_isosurface(part, 226.0, vertex_rule="golden"))
    return meshes


def cut(mesh: clrecon.Mesh) -> float:
    half = mesh.clip((0, 0, 4), [0, 0, 1], capped=True)
    nearest, distances, rows = half.closest_points(np.zeros((2, 3)))
    lines = [line.shape[0] for line in mesh.section((0, 0, 0), (1, 0, 0))]
    hits = mesh.ray(nearest, (0, 0, 1))
    half.save("half.stl", space="ras", no_clobber=True)
    quality: clrecon.MeshQuality = half.quality()
    return float(distances.max() + sum(lines) + hits[0, 0] + quality.area_mm2 + rows[0])


def labelled(volume: clrecon.Volume, labels: clrecon.LabelMap) -> dict[int, clrecon.Mesh]:
    bone = clrecon.Mask.from_band(volume, (226, None)) & clrecon.Mask.from_labels(volume, labels, label=["L3", 22])
    kept: clrecon.LabelMap = (labels & bone) | bone
    figures: list[clrecon.LabelFigures] = clrecon.measure_labels(volume, kept, label="L3")
    print(figures[0].ml, bone.ml, kept.resample(volume).names[22])
    return clrecon.extract_labels(volume, kept.only("L3"), 226, label="L3")


def pictures(volume: clrecon.Volume) -> clrecon.Rendering:
    image = clrecon.render(volume, clrecon.Projection("mip", window=(0, 1000)), view="left", size=(64, 64))
    image.to_pyvista("plane")
    clrecon.cut_slice(volume, "axial", thickness=5.0, combine="max").save("a.png")
    clrecon.render(volume, "surface", iso_value=300.0, color="orange", clip=clrecon.Clip(), view="left")
    clrecon.render(volume, preset="spine", labels=None, zoom=2.0, background="white")
    extent: tuple[float, float, float, float] = clrecon.cut_slice(volume, "coronal", window="lung").extent
    print(extent)
    return clrecon.render(volume, view=(30, 15), device=clrecon.device())


def filtered(volume: clrecon.Volume) -> clrecon.PointCloud:
    choice: clrecon.IsoChoice = clrecon.choose_iso_value(volume)
    median: clrecon.Volume = clrecon.filter_volume(volume, "median", radius_mm=1.0).crop(between=(0, 9), space="lps")
    cloud = clrecon.extract_points(median, hu=(choice.iso_value, None), kind="shell")
    values = volume.sample(cloud.points, order=3, outside=-1000.0)
    first: clrecon.Device = clrecon.devices()[0]
    print(values, first.label, median.spacing[0] + 1.0)
    return cloud[cloud.points[:, 2] > 3.0]


def sampled(mesh: clrecon.Mesh, volume: clrecon.Volume, found: NDArray[np.uint8]) -> float:
    with_hu = mesh.sample(volume).sample(volume, "near", order=0)
    with_hu.face_values["height"] = with_hu.vertices[with_hu.triangles].mean(axis=(1, 2))
    tumour = clrecon.LabelMap(found, volume, {1: "tumour"}) & clrecon.Mask.from_band(volume, (None, 300))
    camera = clrecon.Camera.fit(volume, (25, 10), up="superior").zoomed(1.5)
    clrecon.render(with_hu, camera=camera).save("mesh.png")
    cloud: clrecon.PointCloud = clrecon.extract_points(volume, "auto").sample(volume, outside=-1024.0)
    return float(with_hu.values["HU"].mean()) + len(cloud) + tumour.spacing[0]
"""

SETUP = """\
import clrecon

volume = clrecon.read_volume("ct")
mesh = clrecon.extract_isosurface(volume, 226)
labels = clrecon.read_labels("map.nii.gz")
mask = clrecon.Mask.from_band(volume, (226, None))
cloud = clrecon.extract_points(volume, 226)
"""

WRONG = [
    'mesh.save("a.stl", space="lpi")',
    'mesh.save("a.stl", "lps", True)',
    'clrecon.extract_isosurface(volume, "bone")',
    'clrecon.extract_isosurface(volume, 226, topology="trilinaer")',
    'clrecon.extract_isosurface(volume, 226, vertex_rule="gold")',
    "clrecon.extract_isosurface(volume.voxels, 226)",
    'clrecon.extract_isosurface(volume, 226, devices="cpu")',
    "clrecon.extract_labels(volume, labels, 226, numbers=[1])",
    'clrecon.filter_volume(volume, "medain")',
    'clrecon.extract_by_method(volume, 226, "mc")',
    'clrecon.extract_points(volume, 226, kind="voxel")',
    'clrecon.Projection("max")',
    'clrecon.cut_slice(volume, "axial", combine="mip")',
    "clrecon.Mask.from_band(volume, 226)",
    "clrecon.smooth_mesh(volume)",
    "clrecon.measure_labels(labels, volume)",
    "volume.crop(box=(0, 1, 0, 1, 0, 1))",
    'volume.resample("1 mm")',
    "mesh.clip((0, 0, 1))",
    "mesh.ray()",
    'mask.dilate("2 mm")',
    "labels & labels",
    "mesh.volume()",
    "mesh.quality().closed_edges",
    "clrecon.rendr(volume)",
    "clrecon.render(volume, size=64)",
    'clrecon.render(volume, "mipp")',
    'clrecon.render(volume, "mip", windw=(0, 1000))',
    'clrecon.render(volume, "mip", window="lungs")',
    'clrecon.render(volume, preset="bones")',
    'clrecon.render(volume, "surface", iso_value="300")',
    'clrecon.render(mesh, color_by="volume")',
    'clrecon.render(volume, view="behind")',
    'clrecon.cut_slice(volume, "transverse")',
    'clrecon.VolumeLook("boen")',
    "cloud.denoise()",
    'clrecon.reformat_curve(volume, kind="bent")',
    'clrecon.Camera.fit(volume, "25,10")',
    'clrecon.render(volume, view="25,10")',
    "mesh.sample(labels)",
    "clrecon.LabelMap(labels.voxels)",
]
"""Words that no choice has, kinds of arguments, parameters that are gone or never were."""


PAGES = "tasks coming_from tour distance inside masks slices solid statistics".split()
PAGES += [f"guide/{page}" for page in ("concepts", "labels_to_meshes", "other_programs", "quickstart")]


def python_of(page: str) -> list[str]:
    """The blocks of a page that use clrecon, which run from top to bottom; those of SimpleITK and VTK alone are not."""
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / f"{page}.md").read_text("utf-8"), re.M | re.S)
    return [block for block in blocks if "vtk" not in block and "itk_" not in block]


def checked_by_mypy(folder: Path) -> list[str]:
    """Lines of errors, each beginning with the file and the number of a line."""
    settings = "[mypy]\npython_version = 3.10\nstrict = true\nfollow_imports = silent\n"
    settings += f"mypy_path = {ROOT}\nignore_missing_imports = true\nuntyped_calls_exclude = SimpleITK,dask\n"
    (folder / "mypy.ini").write_text(settings, encoding="utf-8")
    command = [sys.executable, "-m", "mypy", "--config-file", "mypy.ini", *(path.name for path in folder.glob("*.py"))]
    said = subprocess.run(command, cwd=folder, capture_output=True, text=True).stdout
    return [line for line in said.splitlines() if ": error: " in line]


def checked_by_pyright(folder: Path) -> list[str]:
    """The same of basedpyright, which brings its own Node.js."""
    pytest.importorskip("basedpyright")
    chosen = {
        "typeCheckingMode": "standard",
        "pythonVersion": "3.10",
        "extraPaths": [str(ROOT)],
        "reportMissingImports": False,
    }
    (folder / "pyrightconfig.json").write_text(json.dumps(chosen), encoding="utf-8")
    command = [sys.executable, "-m", "basedpyright", "--outputjson", "--pythonpath", sys.executable]
    said = json.loads(subprocess.run(command, cwd=folder, capture_output=True, text=True).stdout)
    found = [each for each in said["generalDiagnostics"] if each["severity"] == "error"]
    return [f"{Path(each['file']).name}:{each['range']['start']['line'] + 1}: {each['message']}" for each in found]


@pytest.mark.release
@pytest.mark.untraced
@pytest.mark.parametrize("check", [checked_by_mypy, checked_by_pyright])
def test_type_checker_accepts_right_scripts_and_the_pages_and_finds_each_wrong_call(
    check: Callable[[Path], list[str]], tmp_path: Path
) -> None:
    (tmp_path / "right.py").write_text(RIGHT, encoding="utf-8")
    blocks = {page: python_of(page) for page in PAGES}
    for page, own in blocks.items():
        (tmp_path / f"{page.replace('/', '_')}.py").write_text("\n".join(own), encoding="utf-8")
    # enough to check: counted 6 functions and 33 blocks
    assert RIGHT.count("\ndef ") + sum(map(len, blocks.values())) >= 30
    (tmp_path / "wrong.py").write_text(SETUP + "\n".join(WRONG) + "\n", encoding="utf-8")
    errors = check(tmp_path)
    assert [line for line in errors if not line.startswith("wrong.py:")] == []
    named = {int(found[1]) for line in errors if (found := re.match(r"wrong\.py:(\d+):", line))}
    first = SETUP.count("\n") + 1
    assert [call for number, call in enumerate(WRONG, first) if number not in named] == []
    assert min(named) == first, errors
