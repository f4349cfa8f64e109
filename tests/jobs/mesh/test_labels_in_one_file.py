"""Labels as named, coloured objects of one file; labels that are hidden; colours of single files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer
from refusals import refused
from variants import daily

from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import LabelChoice
from clrecon.labels import LabelMap
from clrecon.labels.label_map import encode_nifti

pytest.importorskip("nibabel")
trimesh = pytest.importorskip("trimesh")

NAMES = {2: "vertebrae_L2", 3: "vertebrae_L3", 9: "left & right"}
AFFINE = np.diag((1.5, 1.5, 2.0, 1.0))


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a CT of three cubes, ct.nii, and their labels."""
    nibabel = pytest.importorskip("nibabel")
    folder = tmp_path_factory.mktemp("cubes")
    voxels, numbers = np.full((30, 20, 20), -50, np.int16), np.zeros((30, 20, 20), np.uint8)
    for place, number in enumerate(NAMES):
        where = (slice(3 + 9 * place, 9 + 9 * place), slice(5, 12), slice(4, 13))
        voxels[where], numbers[where] = 700, number
    image = nibabel.Nifti1Image(voxels.transpose(2, 1, 0), np.diag((-1.5, -1.5, 2.0, 1.0)))
    nibabel.save(image, folder / "ct.nii")
    (folder / "labels.nii.gz").write_bytes(encode_nifti(LabelMap(numbers, AFFINE, NAMES), packed=True))
    return folder


def run(scan: Path, device: Any, output: Path, *extra: str) -> int:
    given = ["mesh", str(scan / "ct.nii"), "-o", str(output), "--labels", str(scan / "labels.nii.gz"), "--hu", "300"]
    return main([*given, "--device", str(device.index), "-q", *extra])


@pytest.mark.parametrize("kind", ["glb", "3mf"])
def test_all_labels_are_objects_of_one_file(kind: str, scan: Path, device: Any, tmp_path: Path) -> None:
    assert run(scan, device, tmp_path / f"a.{kind}", "--one-file", "--label-color", "L3 vertebra=#ff0000") == 0
    assert [path.name for path in tmp_path.iterdir()] == [f"a.{kind}"]
    assert run(scan, device, tmp_path / "one.stl") == 0
    scene = trimesh.load(tmp_path / f"a.{kind}")
    names = ["left_right", "vertebrae_L2", "vertebrae_L3"]
    assert sorted(scene.geometry) == names
    for name in names:
        alone = trimesh.load(tmp_path / f"one_{name}.stl")
        assert scene.geometry[name].volume == pytest.approx(alone.volume, rel=1e-4)  # in the buffer's mm
    if kind == "glb":
        colors = {name: tuple(scene.geometry[name].visual.material.baseColorFactor[:3]) for name in names}
        assert colors["vertebrae_L3"] == (255, 0, 0) and len(set(colors.values())) == 3
    else:
        import zipfile

        with zipfile.ZipFile(tmp_path / "a.3mf") as package:
            model = package.read("3D/3dmodel.model").decode()
        assert '<base name="vertebrae_L3" displaycolor="#FF0000"/>' in model
        assert model.count("<object ") == model.count("<item ") == model.count("<base ") == 3


def test_a_hidden_label_has_no_mesh(scan: Path, device: Any, tmp_path: Path) -> None:
    assert run(scan, device, tmp_path / "a.glb", "--one-file", "--hide-label", "L3") == 0
    assert sorted(trimesh.load(tmp_path / "a.glb").geometry) == ["left_right", "vertebrae_L2"]
    assert run(scan, device, tmp_path / "b.stl", "--hide-label", "l2", "--hide-label", "9") == 0
    assert [path.name for path in tmp_path.glob("*.stl")] == ["b.stl"]


def test_components_of_labels_are_objects_too(scan: Path, device: Any, tmp_path: Path) -> None:
    assert run(scan, device, tmp_path / "a.glb", "--one-file", "--split") == 0
    assert len(trimesh.load(tmp_path / "a.glb").geometry) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"]


def test_a_ply_has_the_colour_at_its_vertices(scan: Path, device: Any, tmp_path: Path) -> None:
    assert run(scan, device, tmp_path / "a.ply", "--label", "L2", "--label-color", "vertebrae_L2=orange") == 0
    colors = trimesh.load(tmp_path / "a.ply").visual.vertex_colors
    assert (colors == [255, 165, 0, 255]).all()
    assert run(scan, device, tmp_path / "b.ply", "--label", "L2") == 0
    assert b"red" not in (tmp_path / "b.ply").read_bytes()[:2000]


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["-o", "a.stl", "--one-file"], ".obj, .glb, .vtp, .3mf"),
        (["-o", "a.glb", "--one-file", "--hide-label", "L4"], "L4"),
        (["-o", "a.glb", "--hide-label", "2", "--hide-label", "3", "--hide-label", "9"], "all labels are hidden"),
        (["-o", "a.glb", "--label-color", "L3=nocolour"], "nocolour"),
        (["-o", "a.glb", "--label-color", "L3"], "LABEL=COLOUR"),
        (["-o", "a.glb", "--label-color", "L3=red", "--label-color", "3=blue"], "two colours"),
    ],
)
def test_wrong_choices_are_one_line(
    extra: list[str], words: str, scan: Path, device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    output = Path(extra[1])
    assert run(scan, device, output, *extra[2:]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line and list(tmp_path.iterdir()) == []


def test_colours_are_looked_at_when_they_are_chosen() -> None:
    with refused(UsageError, "colour"):
        LabelChoice("a.nii", colors=(("L3", "no"),))


@pytest.mark.parametrize("option", ["--hide-label=L3", "--label-color=L3=red"])
def test_label_looks_without_labels_are_refused(option: str, scan: Path, printed: Printer) -> None:
    assert main(["mesh", str(scan / "ct.nii"), "-o", "a.glb", option]) == 3
    printed().assert_error("--labels", "FILE")


def test_one_mesh_needs_no_objects(scan: Path, printed: Printer) -> None:
    assert main(["mesh", str(scan / "ct.nii"), "-o", "a.glb", "--one-file"]) == 3
    printed().assert_error("--one-file")


def test_an_obj_has_named_coloured_objects(scan: Path, device: Any, tmp_path: Path) -> None:
    assert run(scan, device, tmp_path / "a.obj", "--one-file", "--label-color", "L3=#ff0000") == 0
    assert run(scan, device, tmp_path / "one.obj") == 0
    found = read_objects(tmp_path / "a.obj")
    assert sorted(found) == ["left_right", "vertebrae_L2", "vertebrae_L3"]
    for name, (vertices, triangles, colors) in found.items():
        alone = trimesh.load(tmp_path / f"one_{name}.obj", process=False)
        assert np.array_equal(vertices[triangles], alone.vertices[alone.faces])
        assert (colors == (1, 0, 0)).all() == (name == "vertebrae_L3")
    whole = trimesh.load(tmp_path / "a.obj", process=False)  # a reader that joins them
    assert whole.is_watertight and len(whole.faces) == sum(len(triangles) for _, triangles, _ in found.values())


def read_objects(path: Path) -> dict[str, tuple[Any, Any, Any]]:
    """Read vertices, triangles and colours of the vertices of each object of an OBJ file with normals."""
    found: dict[str, tuple[list, list, list]] = {}
    name, before, count, normals = "", 0, 0, 0
    for line in path.read_text().splitlines():
        kind, *words = line.split()
        if kind == "o":
            (name,), before = words, count
            found[name] = [], [], []
        elif kind == "v":
            numbers = [float(word) for word in words]
            found[name][0].append(numbers[:3])
            found[name][2].append(numbers[3:])
            count += 1
        elif kind == "vn":
            normals += 1
        elif kind == "f":
            assert all(word == f"{word.split('/')[0]}//{word.split('/')[0]}" for word in words)
            found[name][1].append([int(word.split("/")[0]) - 1 - before for word in words])
    assert normals == count
    return {name: tuple(map(np.array, own)) for name, own in found.items()}  # type: ignore[misc]


def test_a_vtp_tells_the_mesh_of_each_triangle(scan: Path, device: Any, tmp_path: Path) -> None:
    pyvista = pytest.importorskip("pyvista")
    assert run(scan, device, tmp_path / "a.vtp", "--one-file", "--label-color", "L3=#ff0000") == 0
    assert run(scan, device, tmp_path / "one.vtp") == 0
    found = pyvista.read(tmp_path / "a.vtp")
    names = list(found.field_data["PART_NAMES"])
    assert sorted(names) == ["left_right", "vertebrae_L2", "vertebrae_L3"]
    for number, name in enumerate(names):
        own = found.extract_cells(found.cell_data["PART"] == number).extract_surface()
        alone = pyvista.read(tmp_path / f"one_{name}.vtp")
        assert own.n_cells == alone.n_cells and own.volume == pytest.approx(alone.volume, rel=1e-6)
        assert own.bounds == pytest.approx(alone.bounds)
        assert ((own.cell_data["COLOR"] == [255, 0, 0]).all()) == (name == "vertebrae_L3")


@pytest.mark.parametrize("kind", daily(2, ["glb", "3mf", "obj", "vtp"]))
def test_components_and_iso_values_without_labels_are_objects(
    kind: str, scan: Path, device: Any, tmp_path: Path
) -> None:
    given = ["mesh", str(scan / "ct.nii"), "-o", str(tmp_path / f"a.{kind}"), "--device", str(device.index), "-q"]
    for extra, names in (
        (["--hu", "300", "--split"], ["001", "002", "003"]),
        (["--hu", "200,500"], ["200hu", "500hu"]),
    ):
        assert main([*given, *extra, "--one-file", "--report", str(tmp_path / "a.json")]) == 0
        assert {path.name for path in tmp_path.iterdir()} == {"a.json", f"a.{kind}"}
        report = json.loads((tmp_path / "a.json").read_text())
        assert [mesh["name"] for mesh in report["meshes"]] == names
        if kind == "vtp":
            pyvista = pytest.importorskip("pyvista")
            assert list(pyvista.read(tmp_path / "a.vtp").field_data["PART_NAMES"]) == names
        elif kind == "obj":
            assert list(read_objects(tmp_path / "a.obj")) == names
        else:
            assert sorted(trimesh.load(tmp_path / f"a.{kind}").geometry) == names
