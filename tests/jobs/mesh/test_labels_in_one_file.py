"""Labels as named, coloured objects of one file; labels that are hidden; colours of single files."""

from __future__ import annotations

import json
import zipfile
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
def cubes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a CT of three cubes of 700 HU, ct.nii, and their labels, which have NAMES."""
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


def mesh_labels(cubes: Path, device: Any, output: Path, *extra: str) -> int:
    """Mesh the labels of the cubes at 300 HU to `output`, with further options; return the exit code."""
    given = ["mesh", str(cubes / "ct.nii"), "-o", str(output), "--labels", str(cubes / "labels.nii.gz"), "--hu", "300"]
    return main([*given, "--device", str(device.index), "-q", *extra])


OBJECT_NAMES = ["left_right", "vertebrae_L2", "vertebrae_L3"]
"""NAMES as files and objects have them, in alphabetical order."""


@pytest.mark.parametrize("kind", ["glb", "3mf"])
def test_labels_in_one_file_are_named_objects_with_the_volumes_that_they_have_alone(
    kind: str, cubes: Path, device: Any, tmp_path: Path
) -> None:
    (tmp_path / "one").mkdir()

    assert mesh_labels(cubes, device, tmp_path / "one" / f"a.{kind}", "--one-file") == 0
    assert mesh_labels(cubes, device, tmp_path / "alone.stl") == 0

    assert [path.name for path in (tmp_path / "one").iterdir()] == [f"a.{kind}"]
    scene = trimesh.load(tmp_path / "one" / f"a.{kind}")
    assert sorted(scene.geometry) == OBJECT_NAMES
    for name in OBJECT_NAMES:
        alone = trimesh.load(tmp_path / f"alone_{name}.stl")
        assert scene.geometry[name].volume == pytest.approx(alone.volume, rel=1e-4)  # both in mm, float32 and decimals


def test_labels_in_one_glb_have_the_given_colour_and_different_ones(cubes: Path, device: Any, tmp_path: Path) -> None:
    assert mesh_labels(cubes, device, tmp_path / "a.glb", "--one-file", "--label-color", "L3 vertebra=#ff0000") == 0

    geometry = trimesh.load(tmp_path / "a.glb").geometry
    colors = {name: tuple(geometry[name].visual.material.baseColorFactor[:3]) for name in OBJECT_NAMES}
    assert colors["vertebrae_L3"] == (255, 0, 0)
    assert len(set(colors.values())) == len(OBJECT_NAMES)


def test_labels_in_one_3mf_have_the_given_colour_by_their_names(cubes: Path, device: Any, tmp_path: Path) -> None:
    assert mesh_labels(cubes, device, tmp_path / "a.3mf", "--one-file", "--label-color", "L3 vertebra=#ff0000") == 0

    with zipfile.ZipFile(tmp_path / "a.3mf") as package:
        model = package.read("3D/3dmodel.model").decode()
    assert '<base name="vertebrae_L3" displaycolor="#FF0000"/>' in model
    assert model.count("<object ") == model.count("<item ") == model.count("<base ") == len(OBJECT_NAMES)


def test_hidden_label_is_no_object_of_one_file(cubes: Path, device: Any, tmp_path: Path) -> None:
    assert mesh_labels(cubes, device, tmp_path / "a.glb", "--one-file", "--hide-label", "L3") == 0
    assert sorted(trimesh.load(tmp_path / "a.glb").geometry) == ["left_right", "vertebrae_L2"]


def test_single_label_that_is_not_hidden_is_one_file_without_its_name(cubes: Path, device: Any, tmp_path: Path) -> None:
    assert mesh_labels(cubes, device, tmp_path / "b.stl", "--hide-label", "l2", "--hide-label", "9") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["b.stl"]


def test_components_of_labels_in_one_file_are_objects(cubes: Path, device: Any, tmp_path: Path) -> None:
    assert mesh_labels(cubes, device, tmp_path / "a.glb", "--one-file", "--split") == 0

    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"]
    assert len(trimesh.load(tmp_path / "a.glb").geometry) == len(NAMES)  # each cube is one component


def test_ply_of_a_coloured_label_has_the_colour_at_every_vertex(cubes: Path, device: Any, tmp_path: Path) -> None:
    assert mesh_labels(cubes, device, tmp_path / "a.ply", "--label", "L2", "--label-color", "vertebrae_L2=orange") == 0

    colors = trimesh.load(tmp_path / "a.ply").visual.vertex_colors
    assert len(colors) > 0
    assert (colors == [255, 165, 0, 255]).all()  # orange of CSS


def test_ply_of_a_label_without_a_given_colour_has_none(cubes: Path, device: Any, tmp_path: Path) -> None:
    assert mesh_labels(cubes, device, tmp_path / "b.ply", "--label", "L2") == 0

    header = (tmp_path / "b.ply").read_bytes().split(b"end_header")[0]
    assert b"red" not in header


@pytest.mark.parametrize(
    ("output", "extra", "words"),
    [
        ("a.stl", ["--one-file"], ".obj, .glb, .vtp, .3mf"),
        ("a.glb", ["--one-file", "--hide-label", "L4"], "L4"),
        ("a.glb", ["--hide-label", "2", "--hide-label", "3", "--hide-label", "9"], "all labels are hidden"),
        ("a.glb", ["--label-color", "L3=nocolour"], "nocolour"),
        ("a.glb", ["--label-color", "L3"], "LABEL=COLOUR"),
        ("a.glb", ["--label-color", "L3=red", "--label-color", "3=blue"], "two colours"),
    ],
)
def test_wrong_looks_of_labels_are_refused_in_one_line_and_write_nothing(
    output: str, extra: list[str], words: str, cubes: Path, device: Any, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)

    assert mesh_labels(cubes, device, Path(output), *extra) == 3

    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert list(tmp_path.iterdir()) == []


def test_unknown_colour_of_a_label_is_refused_by_the_settings() -> None:
    with refused(UsageError, "colour"):
        LabelChoice("a.nii", colors=(("L3", "no"),))


@pytest.mark.parametrize("option", ["--hide-label=L3", "--label-color=L3=red"])
def test_look_of_a_label_without_a_label_map_is_refused(option: str, cubes: Path, printed: Printer) -> None:
    assert main(["mesh", str(cubes / "ct.nii"), "-o", "a.glb", option]) == 3
    printed().assert_error("--labels", "FILE")


def test_one_file_is_refused_where_there_is_one_mesh(cubes: Path, printed: Printer) -> None:
    assert main(["mesh", str(cubes / "ct.nii"), "-o", "a.glb", "--one-file"]) == 3
    printed().assert_error("--one-file")


def test_obj_of_labels_has_named_objects_with_the_triangles_that_they_have_alone(
    cubes: Path, device: Any, tmp_path: Path
) -> None:
    assert mesh_labels(cubes, device, tmp_path / "a.obj", "--one-file", "--label-color", "L3=#ff0000") == 0
    assert mesh_labels(cubes, device, tmp_path / "one.obj") == 0

    objects = read_objects(tmp_path / "a.obj")
    assert sorted(objects) == OBJECT_NAMES
    for name, (vertices, triangles, colors) in objects.items():
        alone = trimesh.load(tmp_path / f"one_{name}.obj", process=False)
        assert np.array_equal(vertices[triangles], alone.vertices[alone.faces])
        assert (colors == (1, 0, 0)).all() == (name == "vertebrae_L3")


def test_obj_of_labels_is_one_closed_mesh_for_a_reader_that_joins_its_objects(
    cubes: Path, device: Any, tmp_path: Path
) -> None:
    assert mesh_labels(cubes, device, tmp_path / "a.obj", "--one-file") == 0

    joined = trimesh.load(tmp_path / "a.obj", process=False)
    assert joined.is_watertight
    assert len(joined.faces) == sum(len(triangles) for _, triangles, _ in read_objects(tmp_path / "a.obj").values())


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


def test_vtp_of_labels_has_name_and_colour_of_the_label_of_each_triangle(
    cubes: Path, device: Any, tmp_path: Path
) -> None:
    pyvista = pytest.importorskip("pyvista")
    assert mesh_labels(cubes, device, tmp_path / "a.vtp", "--one-file", "--label-color", "L3=#ff0000") == 0
    assert mesh_labels(cubes, device, tmp_path / "one.vtp") == 0

    together = pyvista.read(tmp_path / "a.vtp")
    names = list(together.field_data["PART_NAMES"])
    assert sorted(names) == OBJECT_NAMES
    for number, name in enumerate(names):
        part = together.extract_cells(together.cell_data["PART"] == number).extract_surface()
        alone = pyvista.read(tmp_path / f"one_{name}.vtp")
        assert part.n_cells == alone.n_cells
        assert part.volume == pytest.approx(alone.volume, rel=1e-6)  # the same float32 vertices in another order
        assert part.bounds == pytest.approx(alone.bounds)
        assert (part.cell_data["COLOR"] == [255, 0, 0]).all() == (name == "vertebrae_L3")


def read_names(path: Path) -> list[str]:
    """Names of the objects of a file, in alphabetical order."""
    if path.suffix == ".vtp":
        return sorted(pytest.importorskip("pyvista").read(path).field_data["PART_NAMES"])
    if path.suffix == ".obj":
        return sorted(read_objects(path))
    return sorted(trimesh.load(path).geometry)


@pytest.mark.parametrize("kind", daily(2, ["glb", "3mf", "obj", "vtp"]))
@pytest.mark.parametrize(
    ("options", "names"),
    [(["--hu", "300", "--split"], ["001", "002", "003"]), (["--hu", "200,500"], ["200hu", "500hu"])],
    ids=["components", "iso values"],
)
def test_components_and_iso_values_without_labels_are_objects_of_one_file(
    kind: str, options: list[str], names: list[str], cubes: Path, device: Any, tmp_path: Path
) -> None:
    output, report = tmp_path / f"a.{kind}", tmp_path / "a.json"
    command = ["mesh", str(cubes / "ct.nii"), "-o", str(output), "--device", str(device.index), "-q", *options]

    assert main([*command, "--one-file", "--report", str(report)]) == 0

    assert {path.name for path in tmp_path.iterdir()} == {"a.json", f"a.{kind}"}
    assert [mesh["name"] for mesh in json.loads(report.read_text())["meshes"]] == names
    assert read_names(output) == names
