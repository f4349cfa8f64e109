"""Heads are told from the scan, and warned of where their skin shows."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage
from variants import daily, daily_rows

import clrecon
from clrecon.anatomy.head import find_head, measure_skin, shows_face, warn_of_face
from clrecon.cli.main import main
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.proof.phantom import MATERIALS, PhantomSettings, label_materials, make_phantom, write_phantom

COARSE: dict[str, Any] = {"size": (96, 96), "slices": 48, "spacing": (2.4, 2.4, 3.5)}
FACE_WARNING = "a surface of the skin can show a face: treat the file as one that identifies the patient"


@cache
def phantom(kind: str, **settings: Any) -> Volume:
    return Volume(*make_phantom(PhantomSettings(kind=kind, **{**COARSE, **settings}))[:2])


def pelvis() -> Volume:
    return phantom("pelvis", spacing=(4.0, 4.0, 4.0))


@pytest.mark.fault_row(70)
@pytest.mark.parametrize(
    "kind", daily(5, ["head", "skull", "bones", "limb", "pair", "pelvis", "contrast", "water", "spine", "sphere"])
)
def test_of_ten_bodies_the_head_alone_is_found_to_be_one(kind: str) -> None:
    of_wide_bodies = {"pelvis": (4.0, 4.0, 4.0), "contrast": (3.8, 3.8, 5.0), "spine": (2.7, 2.7, 3.2)}  # mm
    volume = phantom(kind, spacing=of_wide_bodies.get(kind, COARSE["spacing"]))
    assert (find_head(volume) is True) == (kind == "head")


@pytest.mark.fault_row(70)
@pytest.mark.parametrize(
    "settings", daily(1, [{"tilt": 20.0}, {"prone": True}, {"table": "headrest"}]), ids=lambda given: next(iter(given))
)
def test_a_head_is_found_when_tilted_when_prone_and_on_a_headrest(settings: dict[str, Any]) -> None:
    assert find_head(phantom("head", **settings)) is True


@pytest.mark.fault_row(70)
@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 0, 2), (2, 1, 0)], ids=["axial", "coronal", "sagittal"])
@pytest.mark.parametrize(
    ("kind", "spacing", "is_head"), [("head", (2.4, 2.4, 3.5), True), ("pelvis", (4.0, 4.0, 4.0), False)]
)
def test_heads_are_told_from_trunks_in_slices_along_any_axis(
    kind: str, spacing: tuple[float, ...], is_head: bool, axes: tuple[int, int, int]
) -> None:
    volume = phantom(kind, spacing=spacing)
    affine = volume.affine.copy()
    steps_kji = volume.affine[:3, 2::-1]
    affine[:3, :3] = steps_kji[:, list(axes)][:, ::-1]
    assert find_head(Volume(np.transpose(volume.voxels, axes), affine)) is is_head


LEVELS = (-1000.0, -950.0, -500.0, -200.0, -100.0, 0.0, 50.0, 100.0, 150.0, 151.0, 300.0)
SKIN_LEVELS = {-950.0, -500.0, -200.0, -100.0, 0.0, 50.0, 100.0, 150.0}
LEVELS_BETWEEN_AIR_AND_FAT = {-950.0, -500.0, -200.0}


def list_face_levels(volume: Volume) -> set[float]:
    return {level for level in LEVELS if shows_face(volume, level)}


@pytest.mark.fault_row(70)
def test_a_head_shows_a_face_at_every_level_between_air_and_bone() -> None:
    assert list_face_levels(phantom("head")) == SKIN_LEVELS


@pytest.mark.fault_row(70)
def test_a_trunk_shows_no_face_at_any_level() -> None:
    assert list_face_levels(pelvis()) == set()


@pytest.mark.fault_row(70)
def test_a_body_that_may_be_a_face_shows_one_at_levels_between_air_and_fat() -> None:
    assert find_head(phantom("limb")) is None
    assert list_face_levels(phantom("limb")) == LEVELS_BETWEEN_AIR_AND_FAT


@pytest.mark.fault_row(70)
@pytest.mark.parametrize(("level", "warnings"), [(400.0, []), (40.0, [FACE_WARNING])], ids=["bone", "skin"])
def test_a_surface_of_a_head_is_warned_of_at_the_level_of_skin(level: float, warnings: list[str]) -> None:
    assert warn_of_face(phantom("head"), [None, level], "surface") == warnings


@pytest.mark.fault_row(70)
@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize(
    ("kind", "level", "options", "warnings"),
    [
        ("head", -100, {}, [FACE_WARNING]),
        ("head", 20, {}, [FACE_WARNING]),
        ("head", 100, {}, [FACE_WARNING]),
        ("head", (-150, -30), {}, [FACE_WARNING]),
        ("head", -300, {"below": True}, [FACE_WARNING]),
        ("head", 300, {}, []),
        ("head", (200, 400), {}, []),
        ("pelvis", 50, {}, []),
    ],
    ids=["fat", "skin", "muscle", "range of fat", "below fat", "bone", "range of bone", "pelvis"],
)
def test_report_of_a_mesh_warns_of_a_face_at_levels_of_the_skin_of_a_head(
    kind: str, level: Any, options: dict[str, Any], warnings: list[str], device: Any
) -> None:
    volume = pelvis() if kind == "pelvis" else phantom(kind)
    mesh = clrecon.extract_isosurface(volume, level, device=device, **options)
    assert [text for text in mesh.report["warnings"] if "face" in text] == warnings


@pytest.fixture(scope="module")
def head_series(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The DICOM series of the coarse head, with the label map materials.nrrd."""
    folder = tmp_path_factory.mktemp("head") / "ct"
    write_phantom(folder, PhantomSettings(kind="head", **COARSE))
    return folder


def count_face_warnings(capsys: pytest.CaptureFixture[str], device: Any, *arguments: str) -> int:
    """Run a command, which succeeds, and count its lines on standard error that warn of a face."""
    assert main([*arguments, "--device", str(device.index)]) == 0
    return capsys.readouterr().err.count("can show a face")


@pytest.mark.fault_row(70)
@pytest.mark.release
@pytest.mark.slow
@pytest.mark.parametrize(("levels", "warnings"), [("-50", 1), ("100", 1), ("-100,100", 1), ("300", 0)])
def test_command_mesh_warns_once_of_levels_of_the_skin_of_a_head(
    levels: str, warnings: int, head_series: Path, device: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ("mesh", str(head_series), "-o", str(tmp_path / "a.stl"), "--hu", levels)
    assert count_face_warnings(capsys, device, *command) == warnings


@pytest.mark.fault_row(70)
@pytest.mark.release
@pytest.mark.slow
@pytest.mark.parametrize(
    ("look", "warnings"),
    [
        (("--iso", "0"), 1),
        (("--preset", "muscle"), 1),
        (("--preset", "bone"), 0),
        (("--iso", "300"), 0),
        (("--mode", "slice"), 0),
    ],
    ids=["iso of skin", "preset muscle", "preset bone", "iso of bone", "slice"],
)
def test_command_render_warns_once_of_looks_that_show_the_skin_of_a_head(
    look: tuple[str, str],
    warnings: int,
    head_series: Path,
    device: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ("render", str(head_series), "-o", str(tmp_path / "a.png"), "--size", "64", *look)
    assert count_face_warnings(capsys, device, *command) == warnings


SLICE, ROW, COLUMN = np.indices((40, 40, 40))
PLATE = np.where((SLICE >= 20) & (SLICE < 24), 40, -1000).astype(np.int16)
"""Tissue in four slices, in voxels of 2 mm; air elsewhere."""
SQUARE = 2.0 * np.array([[10.0, 10.0, 23.5], [30.0, 10.0, 23.5], [30.0, 30.0, 23.5], [10.0, 30.0, 23.5]])
"""Corners, in mm, of a square of 40 x 40 mm at the upper face of the plate."""
SQUARE_CM2 = 4.0 * 4.0
UPWARDS = np.array([[0, 1, 2], [0, 2, 3]])


def add_case(tissue: np.ndarray, passage_voxels: int) -> Volume:
    """A case of tissue, three voxels thick, around the plate, with a square passage through its lid; odd, or 0."""

    def cube(half: int) -> np.ndarray:
        return (abs(SLICE - 20) < half) & (abs(ROW - 20) < half) & (abs(COLUMN - 20) < half)

    with_case = np.where(cube(18) & ~cube(15), 40, tissue)
    passage = (SLICE >= 34) & (abs(ROW - 20) < passage_voxels / 2) & (abs(COLUMN - 20) < passage_voxels / 2)
    return Volume(np.where(passage, -1000, with_case).astype(np.int16), np.diag([2.0, 2.0, 2.0, 1.0]))


@pytest.mark.fault_row(70)
@pytest.mark.parametrize(
    ("triangles", "area_cm2"), [(UPWARDS, SQUARE_CM2), (UPWARDS[:, ::-1], 0.0)], ids=["towards air", "towards tissue"]
)
def test_a_surface_that_faces_the_air_around_is_skin(triangles: np.ndarray, area_cm2: float) -> None:
    volume = Volume(PLATE, np.diag([2.0, 2.0, 2.0, 1.0]))
    assert measure_skin(volume, SQUARE, triangles) == pytest.approx(area_cm2)


@pytest.mark.fault_row(70)
@pytest.mark.parametrize(
    ("passage_voxels", "area_cm2"), [(0, 0.0), (7, 0.0), (9, SQUARE_CM2)], ids=["closed", "14 mm", "18 mm"]
)
def test_a_surface_inside_of_a_case_is_skin_only_behind_a_passage_wider_than_16_mm(
    passage_voxels: int, area_cm2: float
) -> None:
    area = measure_skin(add_case(PLATE, passage_voxels), SQUARE, UPWARDS)
    assert area == pytest.approx(area_cm2)


TISSUE_LABEL, BONE_LABEL = MATERIALS.index("tissue"), MATERIALS.index("bone")


def count_label_warnings(head: Volume, iso_value: float, device: Any) -> dict[int, int]:
    """The warnings of a face in the reports of the meshes of tissue and of bone."""
    labels = LabelMap(label_materials(PhantomSettings(kind="head", **COARSE)), head.affine)
    meshes = clrecon.extract_labels(head, labels, iso_value, label=[TISSUE_LABEL, BONE_LABEL], device=device)
    return {number: mesh.report["warnings"].count(FACE_WARNING) for number, mesh in meshes.items()}


@pytest.mark.fault_row(70)
@pytest.mark.slow
@pytest.mark.parametrize(("iso_value", "of_tissue"), [(-100.0, 1), (200.0, 0)], ids=["at skin", "at bone"])
def test_a_mesh_of_labelled_tissue_warns_of_a_face_at_the_level_of_skin_and_one_of_bone_never_does(
    iso_value: float, of_tissue: int, device: Any
) -> None:
    warnings = count_label_warnings(phantom("head"), iso_value, device)
    assert warnings == {TISSUE_LABEL: of_tissue, BONE_LABEL: 0}


@pytest.mark.fault_row(70)
@pytest.mark.slow
def test_the_air_around_a_head_is_looked_for_once_for_all_labels(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    unknown_head = Volume(phantom("head").voxels, phantom("head").affine)  # of which nothing is remembered
    searches: list[int] = []
    minimum_filter = ndimage.minimum_filter

    def count_searches(air: np.ndarray, **options: Any) -> np.ndarray:
        searches.append(air.size)
        return minimum_filter(air, **options)

    monkeypatch.setattr(ndimage, "minimum_filter", count_searches)
    count_label_warnings(unknown_head, iso_value=-100.0, device=device)
    assert len(searches) == 1


@pytest.mark.fault_row(70)
@pytest.mark.slow
@pytest.mark.parametrize(("label", "warnings"), [(TISSUE_LABEL, 1), (BONE_LABEL, 0)], ids=["tissue", "bone"])
def test_command_mesh_warns_of_a_face_in_the_mask_of_a_label(
    label: int, warnings: int, head_series: Path, device: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = ("--labels", str(head_series / "materials.nrrd"), "--label", str(label), "--surface", "mask")
    command = ("mesh", str(head_series), "-o", str(tmp_path / "a.stl"), *labels)
    assert count_face_warnings(capsys, device, *command) == warnings


@pytest.mark.fault_row(70)
@pytest.mark.parametrize(
    ("name", "is_head"), daily_rows(2, [("head_tilt_gaps", True), ("lumbar_4p25mm", False), ("thoracic_0p8mm", False)])
)
def test_a_real_head_shows_a_face_and_real_trunks_show_none(name: str, is_head: bool, real_data: Path) -> None:
    volume = clrecon.read_volume(real_data / name, allow_gaps=True)
    assert find_head(volume) is is_head
    assert list_face_levels(volume) == (SKIN_LEVELS if is_head else set())
