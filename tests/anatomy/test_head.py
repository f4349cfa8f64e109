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
SAID = "a surface of the skin can show a face: treat the file as one that identifies the patient"


@cache
def phantom(kind: str, **settings: Any) -> Volume:
    return Volume(*make_phantom(PhantomSettings(kind=kind, **{**COARSE, **settings}))[:2])


@pytest.mark.parametrize(
    "kind", daily(5, ["head", "skull", "bones", "limb", "pair", "pelvis", "contrast", "water", "spine", "sphere"])
)
def test_row_70_heads_are_told_from_other_bodies(kind: str) -> None:
    spacing = {"pelvis": (4.0, 4.0, 4.0), "contrast": (3.8, 3.8, 5.0), "spine": (2.7, 2.7, 3.2)}.get(
        kind, COARSE["spacing"]
    )
    assert (find_head(phantom(kind, spacing=spacing)) is True) == (kind == "head")


@pytest.mark.parametrize(
    "settings", daily(1, [{"tilt": 20.0}, {"prone": True}, {"table": "headrest"}]), ids=lambda given: next(iter(given))
)
def test_row_70_head_is_found_in_any_position(settings: dict[str, Any]) -> None:
    assert find_head(phantom("head", **settings)) is True


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 0, 2), (2, 1, 0)], ids=["axial", "coronal", "sagittal"])
@pytest.mark.parametrize(
    ("kind", "spacing", "is_head"), [("head", (2.4, 2.4, 3.5), True), ("pelvis", (4.0, 4.0, 4.0), False)]
)
def test_row_70_heads_are_told_from_trunks_in_slices_along_any_axis(
    kind: str, spacing: tuple[float, ...], is_head: bool, axes: tuple[int, int, int]
) -> None:
    volume = phantom(kind, spacing=spacing)
    affine = volume.affine.copy()
    affine[:3, :3] = volume.affine[:3, 2::-1][:, list(axes)][:, ::-1]
    assert find_head(Volume(np.transpose(volume.voxels, axes), affine)) is is_head


def test_row_70_every_level_below_bone_is_warned_of() -> None:
    head, spine = phantom("head"), phantom("pelvis", spacing=(4.0, 4.0, 4.0))
    levels = (-1000.0, -950.0, -500.0, -200.0, -100.0, 0.0, 50.0, 100.0, 150.0, 151.0, 300.0)
    assert [shows_face(head, level) for level in levels] == [False, *[True] * 8, False, False]
    assert not any(shows_face(spine, level) for level in levels)
    unknown = phantom("limb")  # as before: nothing says that it is no face
    assert [shows_face(unknown, level) for level in levels] == [False, *[True] * 3, *[False] * 7]
    assert warn_of_face(head, [None, 400.0], "surface") == [] and warn_of_face(head, [None, 40.0], "surface") == [SAID]


@pytest.mark.release
@pytest.mark.seconds
def test_row_70_meshes_of_python_warn_of_a_face(device: Any) -> None:
    head = phantom("head")

    def warnings(level: Any, volume: Volume = head, **given: Any) -> list[str]:
        mesh = clrecon.extract_isosurface(volume, level, device=device, **given)
        return [text for text in mesh.report["warnings"] if "face" in text]

    assert [warnings(level) for level in (-100, 20, 100)] == [[SAID]] * 3
    assert warnings((-150, -30)) == warnings(-300, below=True) == [SAID]
    assert warnings(300) == warnings((200, 400)) == warnings(50, phantom("pelvis", spacing=(4.0, 4.0, 4.0))) == []


@pytest.mark.release
@pytest.mark.slow
def test_row_70_commands_warn_of_a_face_once(device: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_phantom(tmp_path / "ct", PhantomSettings(kind="head", **COARSE))

    def said(*arguments: str) -> int:
        assert main([*arguments, "--device", str(device.index)]) == 0
        return capsys.readouterr().err.count("can show a face")

    mesh = ("mesh", str(tmp_path / "ct"), "-o", str(tmp_path / "a.stl"), "--hu")
    assert [said(*mesh, level) for level in ("-50", "100", "-100,100", "300")] == [1, 1, 1, 0]
    render = ("render", str(tmp_path / "ct"), "-o", str(tmp_path / "a.png"), "--size", "64")
    looks = (["--iso", "0"], ["--preset", "muscle"], ["--preset", "bone"], ["--iso", "300"], ["--mode", "slice"])
    assert [said(*render, *look) for look in looks] == [1, 1, 0, 0, 0]


def test_row_70_the_skin_that_a_surface_shows_is_measured() -> None:
    """Of a plate amid air one half is skin; in a closed case of plates all its surface is apart from the air around."""
    k, j, i = np.indices((40, 40, 40))
    plate = np.where((k >= 20) & (k < 24), 40, -1000).astype(np.int16)
    square = np.array([[10.0, 10.0, 23.5], [30.0, 10.0, 23.5], [30.0, 30.0, 23.5], [10.0, 30.0, 23.5]]) * 2.0
    upwards = np.array([[0, 1, 2], [0, 2, 3]])
    volume = Volume(plate, np.diag([2.0, 2.0, 2.0, 1.0]))
    assert measure_skin(volume, square, upwards) == pytest.approx(16.0)  # 40 mm x 40 mm
    assert measure_skin(volume, square, upwards[:, ::-1]) == 0.0
    case = (abs(k - 20) < 18) & (abs(j - 20) < 18) & (abs(i - 20) < 18) & (plate < 0)
    hollow = np.where(case & ~((abs(k - 20) < 15) & (abs(j - 20) < 15) & (abs(i - 20) < 15)), 40, plate)
    assert measure_skin(Volume(hollow, volume.affine), square, upwards) == 0.0
    for side, area in ((8.0, 0.0), (24.0, 16.0)):  # mm of a passage through the lid
        drilled = np.where((k >= 34) & (abs(j - 20) < side / 4) & (abs(i - 20) < side / 4), -1000, hollow)
        assert measure_skin(Volume(drilled, volume.affine), square, upwards) == pytest.approx(area, abs=1.0)


@pytest.mark.slow
def test_row_70_surfaces_of_labels_warn_of_a_face(
    device: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = PhantomSettings(kind="head", **COARSE)
    head = Volume(phantom("head").voxels, phantom("head").affine)  # of which nothing is known yet
    map_ = LabelMap(label_materials(settings), head.affine)
    tissue, bone = MATERIALS.index("tissue"), MATERIALS.index("bone")

    def told(iso_value: float) -> dict[int, int]:
        meshes = clrecon.extract_labels(head, map_, iso_value, label=[tissue, bone], device=device)
        return {number: mesh.report["warnings"].count(SAID) for number, mesh in meshes.items()}

    looks: list[int] = []
    thin = ndimage.minimum_filter
    monkeypatch.setattr(ndimage, "minimum_filter", lambda air, **how: looks.append(air.size) or thin(air, **how))
    assert told(-100.0) == {tissue: 1, bone: 0} and told(200.0)[bone] == 0
    assert len(looks) == 1  # for all labels
    write_phantom(tmp_path / "ct", settings)
    for number, count in ((tissue, 1), (bone, 0)):
        given = ["--labels", str(tmp_path / "ct" / "materials.nrrd"), "--label", str(number), "--surface", "mask"]
        assert (
            main(["mesh", str(tmp_path / "ct"), "-o", str(tmp_path / "a.stl"), *given, "--device", str(device.index)])
            == 0
        )
        assert capsys.readouterr().err.count("can show a face") == count


@pytest.mark.parametrize(
    ("name", "found"), daily_rows(2, [("head_tilt_gaps", True), ("lumbar_4p25mm", False), ("thoracic_0p8mm", False)])
)
def test_row_70_heads_are_told_from_trunks_in_real_scans(name: str, found: bool, real_data: Path) -> None:
    volume = clrecon.read_volume(real_data / name, allow_gaps=True)
    assert find_head(volume) is found
    assert [shows_face(volume, level) for level in (-500.0, 0.0, 100.0)] == [found] * 3
