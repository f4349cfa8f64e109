"""``clrecon mesh --labels``: files, their names, the report, and what is said of what cannot be."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from ct_files import ORIGIN, RADIUS_MM, SPACING, find_words, sphere_voxels, write_series
from label_files import write_nifti
from printed_text import Printer
from variants import daily_rows

from clrecon.cli.main import main

pytest.importorskip("nibabel")
AFFINE = np.diag([*SPACING, 1.0])
AFFINE[:3, 3] = ORIGIN
NAMES = (
    b'<LabelTable><Label Key="1"><![CDATA[left half]]></Label><Label Key="2"><![CDATA[../RIGHT half]]></Label>'
    b'<Label Key="3"><![CDATA[Doe^Jane\x1b[31m]]></Label></LabelTable>'
)
SPHERE_ML = 4.0 / 3.0 * np.pi * RADIUS_MM**3 / 1000.0


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A series of the sphere of `sphere_voxels`."""
    return write_series(tmp_path_factory.mktemp("ct") / "scan")


@pytest.fixture(scope="module")
def labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two halves of the sphere, and a label in the air."""
    voxels = np.zeros(sphere_voxels().shape, np.uint8)
    dense = sphere_voxels() >= 0
    voxels[:, :, :15] = dense[:, :, :15]
    voxels[:, :, 15:] = 2 * dense[:, :, 15:]
    voxels[:2, :2, :2] = 3
    return Path(write_nifti(tmp_path_factory.mktemp("labels") / "a.nii.gz", voxels, AFFINE, extension=NAMES))


def run_mesh(*arguments: object, device: Any = None) -> int:
    chosen = [] if device is None else ["--device", device.index]
    return main([str(argument) for argument in ("mesh", *arguments, *chosen)])


@pytest.fixture(scope="module")
def halves_folder(device: Any, ct: Path, labels: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Meshes of the labels at -150 HU, and r.json."""
    folder = tmp_path_factory.mktemp("halves")
    options = ("--labels", labels, "--hu", -150, "--report", folder / "r.json", "-q")
    assert run_mesh(ct, "-o", folder / "bone.stl", *options, device=device) == 0
    return folder


@pytest.mark.seconds
def test_each_label_is_one_file_named_after_it(halves_folder: Path) -> None:
    names = sorted(path.name for path in halves_folder.iterdir())
    assert names == ["bone_RIGHT_half.stl", "bone_left_half.stl", "r.json"]  # the third label lies in air


def test_report_of_labels_has_their_names_numbers_and_places(halves_folder: Path) -> None:
    left, right = json.loads((halves_folder / "r.json").read_text())["meshes"]

    assert (left["name"], left["label"], left["label_number"]) == ("left_half", "left_half", 1)
    assert (right["name"], right["label"], right["label_number"]) == ("RIGHT_half", "RIGHT_half", 2)
    for mesh in (left, right):
        assert mesh["label_inside_share"] == 1.0  # of the voxels in the CT
        assert 0.5 < mesh["vertices_by_hu_share"] < 1.0  # but those of the cut between the halves
        assert (mesh["grow_mm"], mesh["solid"]) == (None, False)


def test_closed_meshes_of_two_halves_have_the_volume_of_the_whole(halves_folder: Path) -> None:
    report = json.loads((halves_folder / "r.json").read_text())

    assert report["closed"] and report["manifold"]
    assert report["volume_ml"] == pytest.approx(SPHERE_ML, rel=tolerances.CLI_SPHERE_VOLUME_SHARE)


def test_report_of_labels_does_not_name_the_patient(halves_folder: Path) -> None:
    assert find_words((halves_folder / "r.json").read_text()) == []


def test_label_without_a_surface_is_warned_of_with_its_name_and_number(
    device: Any, ct: Path, labels: Path, tmp_path: Path, printed: Printer
) -> None:
    assert run_mesh(ct, "-o", tmp_path / "b.stl", "--labels", labels, "--hu", -150, device=device) == 0

    said = printed()
    said.assert_error("CT", "Doe_Jane_x1b_31m", -150, 3)
    said.assert_output("labels", 2)


@pytest.mark.parametrize("label", ["left half", "1", "LEFT"], ids=["name", "number", "part of the name"])
def test_mesh_of_one_label_has_the_name_of_the_output(
    label: str, device: Any, ct: Path, labels: Path, tmp_path: Path
) -> None:
    options = ("--labels", labels, "--label", label, "--solid", "--grow", "0.9", "--hu", -150)
    assert run_mesh(ct, "-o", tmp_path / "one.stl", *options, device=device) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["one.stl"]


LARGE_LABEL = np.zeros(sphere_voxels().shape, np.uint8)
LARGE_LABEL[2:-2, 2:-2, 2:-2] = 1
"""A label half of which is as thin as air: as lung meshed at the level of bone."""


@pytest.fixture
def large(tmp_path: Path) -> tuple[object, ...]:
    """Options for a mesh of `LARGE_LABEL`, with a report."""
    map_file = write_nifti(tmp_path / "a.nii.gz", LARGE_LABEL, AFFINE)
    return "-o", tmp_path / "b.stl", "--labels", map_file, "--hu", -150, "--report", tmp_path / "r.json"


def test_mesh_far_smaller_than_its_label_is_warned_of_with_options_for_it(
    device: Any, ct: Path, large: tuple[object, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    without_a_report = large[:-2]

    assert run_mesh(ct, *without_a_report, device=device) == 0

    printed = capsys.readouterr()
    assert "gate label_volume failed: the mesh has" in printed.err
    assert "what lies below -150 HU is left out; --solid" in printed.err
    assert "--surface mask" in printed.err
    assert "ml of mesh for" in printed.out


def test_mesh_far_smaller_than_its_label_fails_its_gate_with_the_missing_percent(
    device: Any, ct: Path, large: tuple[object, ...], tmp_path: Path
) -> None:
    assert run_mesh(ct, *large, "--strict", device=device) == 8

    report = json.loads((tmp_path / "r.json").read_text())
    (mesh,) = report["meshes"]
    label_ml = np.count_nonzero(LARGE_LABEL) * np.prod(SPACING) / 1000.0
    assert mesh["label_ml"] == pytest.approx(label_ml, rel=1e-6)  # NIfTI holds spacings as float32
    assert mesh["label_taken_ml"] == pytest.approx(label_ml, rel=1e-6)
    assert mesh["label_mesh_ml"] == pytest.approx(SPHERE_ML, rel=tolerances.CLI_SPHERE_VOLUME_SHARE)
    (gate,) = (gate for gate in report["gates"] if gate["name"] == "label_volume")
    assert gate["ok"] is False
    assert gate["measured"] == pytest.approx(100 * (1 - mesh["label_mesh_ml"] / label_ml))


def test_open_mesh_of_a_label_has_no_volume_and_its_gate_is_not_judged(
    device: Any, ct: Path, large: tuple[object, ...], tmp_path: Path
) -> None:
    assert run_mesh(ct, *large, "--open", device=device) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert [gate["ok"] for gate in report["gates"] if gate["name"] == "label_volume"] == [None]
    assert report["meshes"][0]["label_mesh_ml"] is None


@pytest.fixture(scope="module")
def masks_report(device: Any, ct: Path, labels: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The report of meshes of the masks of the three labels."""
    folder = tmp_path_factory.mktemp("masks")
    options = ("--labels", labels, "--surface", "mask", "--strict", "--report", folder / "r.json", "-q")
    assert run_mesh(ct, "-o", folder / "b.ply", *options, device=device) == 0
    return dict(json.loads((folder / "r.json").read_text()))


def test_masks_of_all_labels_are_meshed_whatever_their_hu(masks_report: dict[str, Any]) -> None:
    names = [mesh["name"] for mesh in masks_report["meshes"]]
    assert names == ["left_half", "RIGHT_half", "Doe_Jane_x1b_31m"]  # the last lies in air
    hu = [masks_report[name] for name in ("iso_value_hu", "preset", "inside_hu")]
    assert hu == [None, None, None]


@pytest.mark.parametrize("place", [0, 1, 2], ids=["left half", "right half", "label in air"])
def test_mesh_of_the_mask_of_a_label_has_the_volume_of_its_voxels(place: int, masks_report: dict[str, Any]) -> None:
    mesh = masks_report["meshes"][place]

    assert mesh["surface"] == "mask"
    assert 0.0 < mesh["mask_level"] < 1.0
    assert mesh["label_taken_ml"] is None  # nothing was taken by HU
    assert mesh["volume_ml"] == pytest.approx(mesh["label_ml"], rel=tolerances.MASK_VOLUME)


def test_words_of_masks_say_that_they_do_not_depend_on_hu(
    device: Any, ct: Path, labels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--labels", labels, "--surface", "mask", "-v")
    assert run_mesh(ct, "-o", tmp_path / "b.ply", *options, device=device) == 0

    output = capsys.readouterr().out
    assert "surface  masks of labels, whatever their HU, closed" in output
    assert "labels   3 labels, by their own mask" in output
    assert "(+0.0 %)" in output


def test_mask_of_a_label_that_leaves_the_ct_is_meshed_whole_with_a_warning(
    device: Any, ct: Path, tmp_path: Path, printed: Printer
) -> None:
    six_slices_higher = AFFINE.copy()
    six_slices_higher[2, 3] += 6 * SPACING[2]
    sphere = (sphere_voxels() >= 0).astype(np.uint8)
    map_file = write_nifti(tmp_path / "a.nii.gz", sphere, six_slices_higher)
    options = ("--labels", map_file, "--surface", "mask", "--report", tmp_path / "r.json")

    assert run_mesh(ct, "-o", tmp_path / "b.stl", *options, device=device) == 0

    (mesh,) = json.loads((tmp_path / "r.json").read_text())["meshes"]
    assert mesh["label_inside_share"] < 1.0
    assert mesh["volume_ml"] == pytest.approx(mesh["label_ml"], rel=tolerances.MASK_VOLUME)
    printed().assert_error("CT", 1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--hu", "200"], "the surface of a mask does not depend on HU"),
        (["--preset", "bone"], "the surface of a mask does not depend on HU"),
        (["--remove-table"], "the surface of a mask does not depend on HU"),
        (["--solid"], "the surface of a mask is solid and does not grow"),
        (["--surface", "nets"], "labels have no surface 'nets': it is hu or mask"),
    ],
)
def test_option_without_meaning_for_the_mask_of_a_label_is_refused(
    options: list[str], words: str, ct: Path, labels: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_mesh(ct, "-o", tmp_path / "b.stl", "--labels", labels, "--surface", "mask", *options) == 3
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_volume_of_a_split_label_is_judged_once_for_all_its_components(
    device: Any, ct: Path, labels: Path, tmp_path: Path
) -> None:
    options = ("--labels", labels, "--label", 2, "--hu", -150, "--split", "--report", tmp_path / "r.json")
    assert run_mesh(ct, "-o", tmp_path / "b.stl", *options, device=device) == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["volume_ml"] == pytest.approx(report["meshes"][0]["label_mesh_ml"], rel=1e-6)  # sums in another order
    assert [gate["mesh"] for gate in report["gates"] if gate["name"] == "label_volume"] == [None]


@pytest.fixture(scope="module")
def pieces(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two halves of the sphere of 1.4 and 1.6 ml, a corner beside the second one, and a label of 0.01 ml."""
    voxels = np.zeros(sphere_voxels().shape, np.uint8)
    dense = sphere_voxels() >= 0
    voxels[:, :, :15] = dense[:, :, :15]
    voxels[:, :, 15:] = 2 * dense[:, :, 15:]
    voxels[-3:, -3:, -3:] = 2
    voxels[:2, :2, :2] = 3
    return Path(write_nifti(tmp_path_factory.mktemp("pieces") / "a.nii.gz", voxels, AFFINE))


def report_of_masks(ct: Path, pieces: Path, folder: Path, options: list[str], device: Any) -> dict[str, Any]:
    """Mesh the masks of the labels `pieces` with further options; return the report."""
    arguments = ("--labels", pieces, "--surface", "mask", "--report", folder / "r.json", *options)
    assert run_mesh(ct, "-o", folder / "b.stl", *arguments, device=device) == 0
    return dict(json.loads((folder / "r.json").read_text()))


def failed_volumes(report: dict[str, Any]) -> list[str]:
    return [gate["mesh"] for gate in report["gates"] if gate["name"] == "label_volume" and not gate["ok"]]


CORNER = ",".join(str(value) for value in np.array(ORIGIN) + SPACING * np.array([29.0, 23.0, 15.0]))
"""The middle of the corner of label 2 in `pieces`, of 31 x 25 x 17 voxels; LPS mm."""


@pytest.mark.parametrize(
    ("options", "names"),
    daily_rows(
        2,
        [
            (["--split"], ["label_1_001", "label_2_001", "label_2_002", "label_3_001"]),
            (["--smooth", "--decimate", "0.5"], ["label_1", "label_2", "label_3"]),
            (["--smooth"], ["label_1", "label_2", "label_3"]),
            (["--for", "print", "--label", "1"], [None]),
        ],
    ),
)
def test_masks_of_labels_are_split_refined_or_printed_one_by_one_with_their_volume(
    options: list[str], names: list[str], device: Any, ct: Path, pieces: Path, tmp_path: Path
) -> None:
    report = report_of_masks(ct, pieces, tmp_path, options, device)

    assert [mesh["name"] for mesh in report["meshes"]] == names
    assert report["closed"] and report["manifold"]
    assert failed_volumes(report) == []


@pytest.mark.parametrize(
    ("options", "failed"),
    daily_rows(
        2,
        [
            (["--keep-largest", "1"], "label_2"),
            (["--min-volume", "0.5", "--label", "1", "--label", "2"], "label_2"),
            (["--seed", CORNER, "--label", "2"], None),  # a single mesh has no name
        ],
    ),
)
def test_mask_of_a_label_without_one_of_its_components_fails_its_gate_and_says_why(
    options: list[str], failed: str | None, device: Any, ct: Path, pieces: Path, tmp_path: Path, printed: Printer
) -> None:
    report = report_of_masks(ct, pieces, tmp_path, options, device)

    assert failed_volumes(report) == [failed]
    said = printed()
    assert "1 of its 2 components were kept" in said.everything
    assert " -0 ml" not in said.everything


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--min-volume", "0.5"], 2, "label_3 at the mask: none of 1 component encloses 0.5 ml"),
        (["--seed", "0,0,0"], 3, "label_1 at the mask: the seed at LPS (0, 0, 0) mm lies"),
        (["--seed", "1,2"], 3, "'1,2' is no point: three numbers in mm with commas"),
        (["--keep-largest", "0"], 3, "the number of components to keep must be 1 or more"),
        (["--min-volume", "-1"], 3, "the smallest volume to keep must be above 0 ml"),
        (["--decimate", "2"], 3, "the share of triangles to remove is between 0 and 1"),
        (["--smooth", "0"], 3, "smoothing takes from 1 to 1000 iterations"),
        (["--max-deviation", "0.1"], 3, "a largest deviation bounds smoothing and decimation"),
        (["--keep", "bone"], 3, "labels say what is kept"),
        (["--below", "-400"], 3, "the surface of a mask does not depend on HU"),
        (["--topology", "trilinear"], 3, "the topology trilinear follows HU"),
    ],
)
def test_impossible_option_for_the_mask_of_a_label_is_refused_in_one_line(
    options: list[str], code: int, words: str, device: Any, ct: Path, pieces: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    arguments = ("--labels", pieces, "--surface", "mask", *options)
    assert run_mesh(ct, "-o", tmp_path / "b.stl", *arguments, device=device) == code
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.seconds
def test_masks_of_small_labels_that_fill_a_map_fail_their_gates_with_the_missing_percent(
    device: Any, ct: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Notches between three of these cells take 3 % of them, which no level brings back."""
    shape = sphere_voxels().shape
    points = np.random.default_rng(0).random((60, 3)) * shape
    away = np.linalg.norm(np.moveaxis(np.indices(shape), 0, -1)[..., None, :] - points, axis=-1)
    cells = Path(write_nifti(tmp_path / "a.nii.gz", (away.argmin(axis=-1) + 1).astype(np.uint8), AFFINE))
    options = ("--labels", cells, "--surface", "mask", "--report", tmp_path / "r.json", "--strict")

    assert run_mesh(ct, "-o", tmp_path / "b.stl", *options, device=device) == 8

    report = json.loads((tmp_path / "r.json").read_text())
    gates = [gate for gate in report["gates"] if gate["name"] == "label_volume"]
    assert [gate["ok"] for gate in gates] == [False] * 60  # one for each label
    for gate, mesh in zip(gates, report["meshes"], strict=True):
        missing_percent = 100 * abs(mesh["volume_ml"] / mesh["label_ml"] - 1)
        assert gate["measured"] == pytest.approx(missing_percent, abs=1e-6)  # digits of the report
        assert gate["bound"] == 1.0 < missing_percent
    error = capsys.readouterr().err
    assert "gate label_volume failed: the mesh has" in error
    assert "labels that fill the map" not in error  # what the gate says is not printed again


def test_label_map_beyond_the_allowed_memory_is_refused(
    device: Any, ct: Path, labels: Path, tmp_path: Path, printed: Printer
) -> None:
    options = ("--labels", labels, "--hu", -150, "--memory", "20kB")
    assert run_mesh(ct, "-o", tmp_path / "bone.stl", *options, device=device) == 5
    printed().assert_error(20000)


def test_each_label_and_iso_value_is_one_file_named_after_both(
    device: Any, ct: Path, labels: Path, tmp_path: Path
) -> None:
    options = ("--labels", labels, "--label", 2, "--label", 1, "--hu", "-150,300")
    assert run_mesh(ct, "-o", tmp_path / "b.ply", *options, device=device) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "b_RIGHT_half_-150hu.ply", "b_RIGHT_half_300hu.ply", "b_left_half_-150hu.ply", "b_left_half_300hu.ply",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--label", "T12"], 3, "label 'T12' is not in the label map; there are: 1 left half, 2 ../RIGHT half, 3 Doe"),
        (["--label", "half"], 3, "'half' names several labels"),
        (["--label", "3"], 2, "no surface of label 3 Doe^Jane\\x1b[31m at -150 HU: its voxels run from -1000 to -1000"),
        (["--grow", "-1"], 3, "labels grow by 0 mm or more"),
        (["--hu", "-1000"], 2, "every voxel is inside"),
    ],
)
def test_impossible_label_level_or_growth_is_refused_in_one_line(
    options: list[str], code: int, words: str, device: Any, ct: Path, labels: Path, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    level = [] if "--hu" in options else ["--hu", "-150"]
    assert run_mesh(ct, "-o", tmp_path / "b.stl", "--labels", labels, *level, *options, device=device) == code
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and "\x1b" not in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [["--label", "1"], ["--grow", "1"]])
def test_option_of_labels_without_a_label_map_is_refused(
    options: list[str], ct: Path, tmp_path: Path, printed: Printer
) -> None:
    assert run_mesh(ct, "-o", tmp_path / "b.stl", *options) == 3
    printed().assert_error(options[0])


@pytest.mark.parametrize(
    ("content", "code"),
    [
        pytest.param(None, 3, id="no file"),
        pytest.param(b"", 4, id="empty"),
        pytest.param(b"\x1f\x8b\x08\0", 4, id="cut off after the head of gzip"),
    ],
)
def test_label_map_that_cannot_be_read_is_refused(
    content: bytes | None, code: int, device: Any, ct: Path, tmp_path: Path, printed: Printer,
) -> None:  # fmt: skip
    if content is not None:
        (tmp_path / "a.nii.gz").write_bytes(content)
    assert run_mesh(ct, "-o", tmp_path / "b.stl", "--labels", tmp_path / "a.nii.gz", device=device) == code
    printed().assert_error("a.nii.gz")
    assert not (tmp_path / "b.stl").exists()


def test_label_with_no_centre_of_a_voxel_in_the_ct_is_compared_with_what_was_taken_of_it(
    device: Any, ct: Path, tmp_path: Path, printed: Printer
) -> None:
    extent = (np.array(sphere_voxels().shape[::-1]) - 1) * SPACING
    affine = np.diag([14.0, 90.0, 90.0, 1.0])
    affine[:3, 3] = ORIGIN + 0.5 * extent
    affine[0, 3] = ORIGIN[0] + extent[0] + 1.0 - 14.0  # label 2: its centre 1 mm beside the scan, half of it within
    map_file = write_nifti(tmp_path / "a.nii.gz", np.array([[[1, 2]]], np.uint8), affine)
    options = ("--labels", map_file, "--label", 2, "--hu", -150, "--report", tmp_path / "r.json")

    assert run_mesh(ct, "-o", tmp_path / "b.stl", *options, device=device) == 0

    (mesh,) = json.loads((tmp_path / "r.json").read_text())["meshes"]
    assert mesh["label_inside_share"] == 0.0
    assert mesh["label_compared_ml"] == mesh["label_taken_ml"] > 0.0
    printed().assert_output(round(mesh["label_taken_ml"], 2))
