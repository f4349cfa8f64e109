"""Odd bodies through the jobs: what each option takes is what the truth says, or it is refused or said with figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from odd_bodies import BODIES, OddBodies, OddBody
from refusals import refused
from variants import but_seldom, daily, daily_rows

from clrecon.cli.mesh import describe_purposes
from clrecon.errors import ClreconError, NoSurfaceError, RefusedInputError
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.purposes import LEFT_SHARE, settings_for
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import RenderSettings
from clrecon.system.text import count_of, format_ml

BONY = [name for name in BODIES if name not in ("water", "empty")]
SELDOM = ("skull-prone", "head", "pair", "contrast")
"""Bodies whose tables or shapes others have too: the longest test of each is for a release."""
SPINELESS = [name for name in BODIES if name != "contrast"]


def mesh_of(odd: OddBodies, device: Any, folder: Path, name: str, **settings: Any) -> tuple[dict[str, Any], np.ndarray]:
    """Report, and the vertices in index coordinates (i, j, k)."""
    import trimesh

    path = folder / "mesh.ply"
    report = make_mesh(odd.series(name), path, MeshSettings(device=str(device.index), **settings))
    vertices = np.asarray(trimesh.load(path, process=False).vertices)
    return report, odd[name].volume.lps_to_ijk(vertices)


def share_near(body: OddBody, vertices: np.ndarray, *materials: str) -> float:
    """Share of the vertices that lie within a voxel of these materials."""
    from scipy import ndimage

    near = ndimage.binary_dilation(body.of(*materials), np.ones((3, 3, 3)))
    i, j, k = np.clip(np.rint(vertices).astype(int), 0, np.array(near.shape[::-1]) - 1).T
    return float(near[k, j, i].mean())


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("name", daily(2, but_seldom(BONY, SELDOM)))
def test_the_mesh_without_the_table_is_that_of_the_bone(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    body = odd[name]
    report, vertices = mesh_of(odd, device, tmp_path, name, iso_value=300.0, remove_table=True, strict=True)
    facts = report["volume"]["remove_table"]
    assert facts["bone_kept"] >= 0.98
    assert next(gate for gate in report["volume"]["gates"] if gate["name"] == "bone_kept")["ok"]
    assert any(f"{100 * facts['bone_kept']:.4g} % stay" in warning for warning in report["warnings"])
    low, high = report["volume"]["hu_range"]
    assert low <= facts["air_hu"] and high == body.volume.voxels.max()
    materials = ("bone", "metal", "contrast")
    assert share_near(body, vertices, *materials) > 0.8  # the rest is skin and table in the margin
    # every dense body is there: its voxels have the surface beside them or lie within
    _, whole = mesh_of(odd, device, tmp_path, name, iso_value=300.0)
    assert vertices_of_bone(body, vertices) == pytest.approx(vertices_of_bone(body, whole), rel=0.02)


def vertices_of_bone(body: OddBody, vertices: np.ndarray, *materials: str) -> int:
    """How many vertices lie between the voxels of bone, and far from the table."""
    from scipy import ndimage

    near = ndimage.binary_dilation(body.of(*(materials or ("bone", "metal", "contrast"))), np.ones((3, 3, 3)))
    near &= ~ndimage.binary_dilation(body.of("table"), np.ones((3, 3, 3)))
    i, j, k = np.clip(np.rint(vertices).astype(int), 0, np.array(near.shape[::-1]) - 1).T
    return int(np.count_nonzero(near[k, j, i]))


@pytest.mark.parametrize("settings", [{"remove_table": True}, {"remove_table": True, "half_way": "auto"}])
def test_a_table_alone_is_refused_and_writes_nothing(
    odd: OddBodies, device: Any, tmp_path: Path, settings: dict[str, Any]
) -> None:
    path = tmp_path / "mesh.stl"
    with refused(RefusedInputError, "body"):
        make_mesh(odd.series("empty"), path, MeshSettings(device=str(device.index), **settings))
    assert not list(tmp_path.iterdir())


def test_water_without_its_table_has_no_surface_at_the_level_of_bone(
    odd: OddBodies, device: Any, tmp_path: Path
) -> None:
    with refused(NoSurfaceError, "HU"):
        mesh_of(odd, device, tmp_path, "water", iso_value=300.0, remove_table=True)
    _, vertices = mesh_of(odd, device, tmp_path, "water", iso_value=-300.0, remove_table=True, keep_largest=1)
    assert share_near(odd["water"], vertices, "water") > 0.7


@pytest.mark.parametrize("name", daily(4, BODIES))
def test_a_circle_says_what_it_cuts(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    body = odd[name]
    report, vertices = mesh_of(odd, device, tmp_path, name, iso_value=-300.0, field_of_view=60.0)
    facts = report["volume"]["field_of_view"]
    centre = (np.array(body.volume.shape_ijk[:2]) - 1.0) / 2.0
    assert (np.linalg.norm((vertices[:, :2] - centre) * body.volume.spacing[:2], axis=1) < 60.0 + 4.0).all()
    cuts = facts["bone_voxels_removed"] > 0
    assert cuts == any("it cuts bone off" in warning for warning in report["warnings"])
    if name in ("pair", "pelvis", "skull"):
        assert cuts and facts["bone_kept"] < 0.98


@pytest.mark.parametrize("name", daily(5, BODIES))
def test_a_level_that_the_scan_gives_fits_its_bone_or_is_refused(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    body = odd[name]
    try:
        report, vertices = mesh_of(odd, device, tmp_path, name, half_way="auto")
    except ClreconError as error:
        assert any(letter.isdigit() for letter in repr(error))  # a refusal with its figures
        assert name not in ("head", "limb", "pair", "pelvis"), error
        return
    choice = report["iso_value_choice"]
    assert choice["tissue_hu"] < report["iso_value_hu"] < choice["bone_hu"]
    if name == "contrast":
        assert choice["contrast_medium_share"] > 0.0
    elif name == "water":  # the brightest is its shell, and the report says so: this is no bone
        assert choice["bone_hu"] < 300.0
    else:  # rails of a table are hard too
        assert share_near(body, vertices, "bone", "metal", "table") > 0.9


@pytest.mark.parametrize("name", daily(1, BONY))
def test_the_largest_piece_is_of_the_body(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    body = odd[name]
    report, vertices = mesh_of(odd, device, tmp_path, name, iso_value=300.0, remove_table=True, keep_largest=1)
    assert report["components_kept"] == 1 <= report["components_found"]
    assert share_near(body, vertices, "bone", "metal", "contrast") > 0.9


@pytest.mark.parametrize("name", daily(3, BONY))
def test_a_seed_in_bone_keeps_bone(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    body = odd[name]
    dense = np.argwhere(body.of("bone") & (body.volume.voxels > 500))
    seed = body.volume.ijk_to_lps(dense[len(dense) // 2][None, ::-1])[0]
    report, vertices = mesh_of(odd, device, tmp_path, name, iso_value=300.0, seeds=[tuple(seed)])
    assert report["components_kept"] == 1
    nearest = np.linalg.norm(body.volume.ijk_to_lps(vertices) - seed, axis=1).min()
    assert nearest < 10.0 and share_near(body, vertices, "bone", "metal", "table") > 0.9


@pytest.mark.parametrize("name", daily(4, SPINELESS))
def test_no_spine_is_found_where_there_is_none(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    settings = RenderSettings.of(curve="auto", device=str(device.index), size=(40, 40))
    with refused(RefusedInputError, "spine"):
        make_pictures(odd.series(name), PictureFiles(picture=str(tmp_path / "spine.png")), settings)
    assert not list(tmp_path.iterdir())


def test_a_trunk_has_a_spine(odd: OddBodies, device: Any, tmp_path: Path) -> None:
    settings = RenderSettings.of(curve="auto", device=str(device.index), size=(40, 40))
    report = make_pictures(odd.series("contrast"), PictureFiles(picture=str(tmp_path / "spine.png")), settings)
    (picture,) = report["pictures"]
    assert picture["curve"] and (tmp_path / "spine.png").stat().st_size > 200


@pytest.mark.parametrize("name", daily(3, BONY))
def test_pictures_say_what_was_left_out(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    settings = RenderSettings.of(preset="bone", remove_table=True, device=str(device.index), size=(48, 40))
    report = make_pictures(odd.series(name), PictureFiles(picture=str(tmp_path / "bone.png")), settings)
    assert report["volume"]["remove_table"]["bone_kept"] >= 0.98
    assert any("of them dense (table, blankets)" in warning for warning in report["warnings"])
    assert not any("nothing of the volume shows" in warning for warning in report["warnings"])


@pytest.mark.parametrize("name", ("water", "empty"))
def test_body_without_bone_is_warned_of_once(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    report, _ = mesh_of(odd, device, tmp_path, name, half_way="auto")
    (said,) = [warning for warning in report["warnings"] if "like bone" in warning or "contrast" in warning]
    assert "nothing here looks like bone, none of" in said
    assert f"{report['walls']['wall_hu']['median']:.0f} HU" in said
    assert ("rails of a table" in said) == (name == "empty")  # hard as bone, and straight
    before = (tmp_path / "mesh.ply").read_bytes()
    with refused(NoSurfaceError, "nothing", "bone"):
        mesh_of(odd, device, tmp_path, name, half_way="auto", keep="bone")
    assert (tmp_path / "mesh.ply").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "least"),  # walls of cavities are pieces of their own, and loose pieces of dry bone go
    daily_rows(1, [("skull", 0.9), ("skull-prone", 0.9), ("head", 0.95), ("bones", 0.7), ("limb", 0.95), ("pair", 0.95),
     ("pelvis", 0.95)]),
)  # fmt: skip
def test_bone_is_kept_and_no_alarm_is_false(
    odd: OddBodies, device: Any, tmp_path: Path, name: str, least: float
) -> None:
    body = odd[name]
    report, vertices = mesh_of(odd, device, tmp_path, name, preset="bone", remove_table=True, keep="bone")
    assert report["walls"]["looks_like"] == "bone"
    assert share_near(body, vertices, "bone", "metal") > 0.8
    everything, whole = mesh_of(odd, device, tmp_path, name, preset="bone", remove_table=True)
    kept, there = (vertices_of_bone(body, some, "bone") for some in (vertices, whole))
    assert kept > least * there
    assert not any("looks like" in warning for warning in report["warnings"] + everything["warnings"])


def test_contrast_medium_goes_where_bone_is_kept(odd: OddBodies, device: Any, tmp_path: Path) -> None:
    body = odd["contrast"]
    everything, whole = mesh_of(odd, device, tmp_path, "contrast", preset="bone", remove_table=True)
    assert share_near(body, whole, "contrast") > 0.3
    assert any("in part like heart, vessels or organs" in warning for warning in everything["warnings"])
    _, vertices = mesh_of(odd, device, tmp_path, "contrast", preset="bone", remove_table=True, keep="bone")
    assert share_near(body, vertices, "contrast") < 0.05 < 0.9 < share_near(body, vertices, "bone")


@pytest.mark.parametrize(
    ("name", "kept_ml"),
    daily_rows(
        2,
        [
            ("skull", (1000.0, 1600.0)),  # the hollow of the brain
            ("skull-prone", (1000.0, 1600.0)),
            ("head", (20.0, 400.0)),
            ("bones", (5.0, 40.0)),
            ("contrast", (200.0, 6000.0)),
        ],
    ),
)
def test_air_within_a_body_is_told_from_the_air_around_it(
    odd: OddBodies, device: Any, tmp_path: Path, name: str, kept_ml: tuple[float, float]
) -> None:
    body = odd[name]
    report, vertices = mesh_of(odd, device, tmp_path, name, below=-400.0)
    facts = report["volume"]["outside_air"]
    assert kept_ml[0] < facts["kept_ml"] < kept_ml[1] < facts["left_out_ml"]
    assert any(f"{format_ml(facts['kept_ml'])} within it" in warning for warning in report["warnings"])
    assert share_near(body, vertices, "table") < 0.1
    assert share_near(body, vertices, "tissue", "bone") > 0.85


@pytest.mark.parametrize("name", daily(2, ("limb", "pair", "pelvis", "water", "empty")))
def test_scan_without_air_of_a_body_is_refused(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    expected = (
        "no body found" if name == "empty" else r"nothing below -400 HU lies within the body: [\d,.]+ ml are outside"
    )
    with pytest.raises(ClreconError, match=expected):
        mesh_of(odd, device, tmp_path, name, below=-400.0)
    assert not list(tmp_path.iterdir())


def test_a_range_takes_contrast_medium_and_leaves_metal(odd: OddBodies, device: Any, tmp_path: Path) -> None:
    body = odd["contrast"]
    _, vertices = mesh_of(odd, device, tmp_path, "contrast", iso_value=((200.0, 500.0),), remove_table=True)
    assert share_near(body, vertices, "contrast", "bone") > 0.9
    body = odd["pelvis"]
    _, vertices = mesh_of(odd, device, tmp_path, "pelvis", iso_value=((2500.0, 3071.0),))
    assert share_near(body, vertices, "metal") > 0.95


@pytest.mark.parametrize("name", daily(1, ("pair", "limb")))
def test_a_print_is_of_the_body_closed_and_says_what_it_left_out(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    given = settings_for("print", {"iso_value": 300.0, "remove_table": True})
    report, vertices = mesh_of(odd, device, tmp_path, name, **given)
    assert share_near(odd[name], vertices, "bone", "metal") > 0.9
    assert (report["closed"], report["components"]) == (True, 1)
    assert all(gate["ok"] for gate in report["gates"] if gate["name"] in ("bone_kept", "watertight"))
    left_out = report["print"]["left_out"]
    if name == "pair":  # the other leg
        assert left_out["pieces_ml"] > 0.0 and any("left out" in warning for warning in report["warnings"])


@pytest.mark.seconds
@pytest.mark.parametrize("name", daily(2, ("skull", "contrast", "pelvis", "bones", "limb", "pair")))
def test_a_print_is_of_bone_and_says_what_is_none(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    """Without --remove-table."""
    given = settings_for("print", {"iso_value": 300.0, "smooth": 5, "decimate": 0.3})
    report, vertices = mesh_of(odd, device, tmp_path, name, **given)
    assert share_near(odd[name], vertices, "bone", "metal") > 0.9
    assert (report["keep"], report["components"]) == ("bone", 1)
    left_out, kept_ml = report["print"]["left_out"], report["print"]["pieces_ml"]
    assert 0.0 <= left_out["not_bone_ml"] <= left_out["pieces_ml"]
    without = f"{count_of(left_out['not_bone'], 'piece')} without"
    assert any(without in line and "kept 1 of" in line for line in describe_purposes([report])), without
    warned = any("bone that was left out encloses" in warning for warning in report["warnings"])
    assert warned == (left_out["pieces_ml"] - left_out["not_bone_ml"] > LEFT_SHARE * kept_ml)


def test_a_print_of_what_is_no_bone_is_refused_and_says_how_to_have_it(
    odd: OddBodies, device: Any, tmp_path: Path
) -> None:
    with refused(NoSurfaceError, "keep_largest=1", 1):
        mesh_of(odd, device, tmp_path, "empty", **settings_for("print", {}))
    given = settings_for("print", {"keep_largest": 1, "smooth": 5, "decimate": 0.3})
    report, _ = mesh_of(odd, device, tmp_path, "empty", **given)
    assert (report["keep"], report["print"]["left_out"]["not_bone"]) == (None, None)
