"""Odd bodies through the jobs: what each option takes is what the truth says, or it is refused or said with figures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from odd_bodies import BODIES, OddBodies, OddBody
from refusals import refused
from variants import but_seldom, daily, daily_rows

from clrecon.anatomy.dense_pieces import BONE_KEPT
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


DENSE = ("bone", "metal", "contrast")


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("name", daily(2, but_seldom(BONY, SELDOM)))
def test_mesh_without_the_table_has_the_vertices_of_all_dense_tissue_of_the_body(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    body = odd[name]

    _, vertices = mesh_of(odd, device, tmp_path, name, iso_value=300.0, remove_table=True, strict=True)
    _, with_table = mesh_of(odd, device, tmp_path, name, iso_value=300.0)

    assert share_near(body, vertices, *DENSE) > 0.98  # measured from 0.990 on; the rest is table in the margin
    count, of_all = (vertices_away_from_the_table(body, some, *DENSE) for some in (vertices, with_table))
    assert count == of_all


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.parametrize("name", daily(2, but_seldom(BONY, SELDOM)))
def test_report_without_the_table_states_and_judges_the_share_of_bone_that_stays(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    report, _ = mesh_of(odd, device, tmp_path, name, iso_value=300.0, remove_table=True, strict=True)

    facts = report["volume"]["remove_table"]
    assert facts["bone_kept"] >= BONE_KEPT
    (gate,) = (gate for gate in report["volume"]["gates"] if gate["name"] == "bone_kept")
    assert gate["ok"]
    assert any(f"{100 * facts['bone_kept']:.4g} % stay" in warning for warning in report["warnings"])
    low, high = report["volume"]["hu_range"]
    assert low <= facts["air_hu"]
    assert high == odd[name].volume.voxels.max()


def vertices_away_from_the_table(body: OddBody, vertices: np.ndarray, *materials: str) -> int:
    """How many vertices lie within a voxel of these materials, and not of the table."""
    from scipy import ndimage

    near = ndimage.binary_dilation(body.of(*materials), np.ones((3, 3, 3)))
    near &= ~ndimage.binary_dilation(body.of("table"), np.ones((3, 3, 3)))
    i, j, k = np.clip(np.rint(vertices).astype(int), 0, np.array(near.shape[::-1]) - 1).T
    return int(np.count_nonzero(near[k, j, i]))


@pytest.mark.parametrize("settings", [{"remove_table": True}, {"remove_table": True, "half_way": "auto"}])
def test_scan_of_a_table_alone_is_refused_as_without_a_body_and_writes_nothing(
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


def test_water_without_its_table_has_its_surface_at_the_level_of_skin(
    odd: OddBodies, device: Any, tmp_path: Path
) -> None:
    _, vertices = mesh_of(odd, device, tmp_path, "water", iso_value=-300.0, remove_table=True, keep_largest=1)
    assert share_near(odd["water"], vertices, "water") > 0.95  # measured 0.983; the rest lies on its shell


@pytest.mark.parametrize("name", daily(4, BODIES))
def test_mesh_in_a_field_of_view_lies_within_its_circle_and_is_warned_of_where_it_cuts_bone(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    body, radius_mm, voxel_mm = odd[name], 60.0, 4.0

    report, vertices = mesh_of(odd, device, tmp_path, name, iso_value=-300.0, field_of_view=radius_mm)

    centre = (np.array(body.volume.shape_ijk[:2]) - 1.0) / 2.0
    from_centre_mm = np.linalg.norm((vertices[:, :2] - centre) * body.volume.spacing[:2], axis=1)
    assert from_centre_mm.max() < radius_mm + voxel_mm
    cuts_bone = report["volume"]["field_of_view"]["bone_voxels_removed"] > 0
    assert cuts_bone == any("it cuts bone off" in warning for warning in report["warnings"])


@pytest.mark.parametrize("name", ["pair", "pelvis", "skull"])
def test_field_of_view_narrower_than_the_bone_of_a_body_cuts_some_of_it(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    report, _ = mesh_of(odd, device, tmp_path, name, iso_value=-300.0, field_of_view=60.0)

    facts = report["volume"]["field_of_view"]
    assert facts["bone_voxels_removed"] > 0
    assert facts["bone_kept"] < BONE_KEPT


@pytest.mark.parametrize("name", daily(5, [name for name in BODIES if name not in ("water", "contrast")]))
def test_auto_iso_value_lies_on_bone_or_table_or_is_refused_with_figures(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    try:
        report, vertices = mesh_of(odd, device, tmp_path, name, half_way="auto")
    except ClreconError as error:
        assert any(letter.isdigit() for letter in repr(error))
        assert name not in ("head", "limb", "pair", "pelvis"), error  # these have plain bone
        return
    choice = report["iso_value_choice"]
    assert choice["tissue_hu"] < report["iso_value_hu"] < choice["bone_hu"]
    # Rails of a table are hard too: measured from 0.9957 on.
    assert share_near(odd[name], vertices, "bone", "metal", "table") > 0.99


def test_auto_iso_value_of_a_trunk_with_contrast_medium_states_its_share(
    odd: OddBodies, device: Any, tmp_path: Path
) -> None:
    report, _ = mesh_of(odd, device, tmp_path, "contrast", half_way="auto")

    choice = report["iso_value_choice"]
    assert choice["contrast_medium_share"] > 0.0
    assert choice["tissue_hu"] < report["iso_value_hu"] < choice["bone_hu"]


def test_auto_iso_value_of_water_is_below_that_of_bone(odd: OddBodies, device: Any, tmp_path: Path) -> None:
    report, _ = mesh_of(odd, device, tmp_path, "water", half_way="auto")

    choice = report["iso_value_choice"]
    assert choice["tissue_hu"] < report["iso_value_hu"] < choice["bone_hu"]
    assert choice["bone_hu"] < 300.0  # the shell of the phantom, its brightest


@pytest.mark.parametrize("name", daily(1, BONY))
def test_largest_component_without_the_table_is_bone(odd: OddBodies, device: Any, tmp_path: Path, name: str) -> None:
    body = odd[name]
    report, vertices = mesh_of(odd, device, tmp_path, name, iso_value=300.0, remove_table=True, keep_largest=1)
    assert report["components_kept"] == 1 <= report["components_found"]
    # A prosthesis is in one piece with the pelvis: measured from 0.988 on, 0.908 there without it.
    assert share_near(body, vertices, "bone", "metal") > 0.97


@pytest.mark.parametrize("name", daily(3, BONY))
def test_seed_in_bone_keeps_one_component_of_bone_about_it(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    body = odd[name]
    dense_kji = np.argwhere(body.of("bone") & (body.volume.voxels > 500))
    some_ijk = dense_kji[len(dense_kji) // 2][::-1]
    seed = body.volume.ijk_to_lps([some_ijk])[0]
    report, vertices = mesh_of(odd, device, tmp_path, name, iso_value=300.0, seeds=[tuple(seed)])
    assert report["components_kept"] == 1
    nearest = np.linalg.norm(body.volume.ijk_to_lps(vertices) - seed, axis=1).min()
    assert nearest < 5.0  # mm, a voxel or two: measured up to 2.3
    # A prosthesis is in one piece with the pelvis: measured from 0.988 on; what lies by the table alone is none of it.
    assert share_near(body, vertices, "bone", "metal") > 0.98


@pytest.mark.parametrize("name", daily(4, SPINELESS))
def test_picture_along_the_spine_of_a_body_without_one_is_refused_and_writes_nothing(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    settings = RenderSettings.of(curve="auto", device=str(device.index), size=(40, 40))
    with refused(RefusedInputError, "spine"):
        make_pictures(odd.series(name), PictureFiles(picture=str(tmp_path / "spine.png")), settings)
    assert not list(tmp_path.iterdir())


def test_picture_along_the_spine_of_a_trunk_is_drawn(odd: OddBodies, device: Any, tmp_path: Path) -> None:
    settings = RenderSettings.of(curve="auto", device=str(device.index), size=(40, 40))
    report = make_pictures(odd.series("contrast"), PictureFiles(picture=str(tmp_path / "spine.png")), settings)
    (picture,) = report["pictures"]
    assert picture["curve"] and (tmp_path / "spine.png").stat().st_size > 1000  # measured 2,615 bytes


@pytest.mark.parametrize("name", daily(3, BONY))
def test_picture_without_the_table_keeps_bone_and_warns_of_what_was_removed(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    settings = RenderSettings.of(preset="bone", remove_table=True, device=str(device.index), size=(48, 40))
    report = make_pictures(odd.series(name), PictureFiles(picture=str(tmp_path / "bone.png")), settings)
    assert report["volume"]["remove_table"]["bone_kept"] >= BONE_KEPT
    assert any("of them dense (table, blankets)" in warning for warning in report["warnings"])
    assert not any("nothing of the volume shows" in warning for warning in report["warnings"])


@pytest.mark.parametrize("name", ("water", "empty"))
def test_auto_surface_of_a_scan_without_bone_is_warned_of_once_with_its_hu(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    report, _ = mesh_of(odd, device, tmp_path, name, half_way="auto")

    (warning,) = [text for text in report["warnings"] if "like bone" in text or "contrast" in text]
    assert "nothing here looks like bone, none of" in warning
    assert f"{report['walls']['wall_hu']['median']:.0f} HU" in warning
    is_of_a_table = name == "empty"  # whose rails are hard as bone, and straight
    assert ("rails of a table" in warning) == is_of_a_table


@pytest.mark.parametrize("name", ("water", "empty"))
def test_bone_of_a_scan_without_bone_is_refused_and_an_older_file_stays(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    (tmp_path / "mesh.ply").write_bytes(b"older")

    with refused(NoSurfaceError, "nothing", "bone"):
        mesh_of(odd, device, tmp_path, name, half_way="auto", keep="bone")

    assert (tmp_path / "mesh.ply").read_bytes() == b"older"


@pytest.mark.parametrize(
    ("name", "least"),  # walls of cavities are pieces of their own, and loose pieces of dry bone go
    daily_rows(1, [("skull", 0.9), ("skull-prone", 0.9), ("head", 0.95), ("bones", 0.7), ("limb", 0.95), ("pair", 0.95),
     ("pelvis", 0.95)]),
)  # fmt: skip
def test_keep_bone_keeps_most_of_the_bone_of_a_body_without_a_warning_of_its_looks(
    odd: OddBodies, device: Any, tmp_path: Path, name: str, least: float
) -> None:
    body = odd[name]

    kept, vertices = mesh_of(odd, device, tmp_path, name, preset="bone", remove_table=True, keep="bone")
    everything, of_all = mesh_of(odd, device, tmp_path, name, preset="bone", remove_table=True)

    assert kept["walls"]["looks_like"] == "bone"
    assert share_near(body, vertices, "bone", "metal") > 0.8  # measured 0.91 (head, bones), else from 0.97 on
    kept_count, count = (vertices_away_from_the_table(body, some, "bone") for some in (vertices, of_all))
    assert kept_count > least * count
    assert not any("looks like" in warning for warning in kept["warnings"] + everything["warnings"])


def test_contrast_medium_in_the_surface_of_a_trunk_is_warned_of(odd: OddBodies, device: Any, tmp_path: Path) -> None:
    report, vertices = mesh_of(odd, device, tmp_path, "contrast", preset="bone", remove_table=True)

    assert share_near(odd["contrast"], vertices, "contrast") > 0.3  # measured 0.311 of the vertices
    assert any("in part like heart, vessels or organs" in warning for warning in report["warnings"])


def test_keep_bone_leaves_out_the_contrast_medium_of_a_trunk(odd: OddBodies, device: Any, tmp_path: Path) -> None:
    _, vertices = mesh_of(odd, device, tmp_path, "contrast", preset="bone", remove_table=True, keep="bone")

    assert share_near(odd["contrast"], vertices, "contrast") < 0.01  # measured 1e-4; with all that is there 0.311
    assert share_near(odd["contrast"], vertices, "bone") > 0.99  # measured 0.998


@pytest.mark.parametrize(
    ("name", "kept_ml"),
    daily_rows(
        2,
        [
            ("skull", (1000.0, 1600.0)),  # the hollow of the brain
            ("skull-prone", (1000.0, 1600.0)),
            ("head", (20.0, 400.0)),  # the airways
            ("bones", (5.0, 40.0)),  # gaps between them
            ("contrast", (200.0, 6000.0)),  # the lungs
        ],
    ),
)
def test_surface_below_a_level_encloses_the_air_within_a_body_and_leaves_out_that_around_it(
    odd: OddBodies, device: Any, tmp_path: Path, name: str, kept_ml: tuple[float, float]
) -> None:
    body = odd[name]

    report, vertices = mesh_of(odd, device, tmp_path, name, below=-400.0)

    facts = report["volume"]["outside_air"]
    least_ml, most_ml = kept_ml
    assert least_ml < facts["kept_ml"] < most_ml < facts["left_out_ml"]
    assert any(f"{format_ml(facts['kept_ml'])} within it" in warning for warning in report["warnings"])
    assert share_near(body, vertices, "table") < 0.01  # measured up to 0.004 (skull in its headrest)
    assert share_near(body, vertices, "tissue", "bone") > 0.85  # measured 0.89 (bones), else from 0.97 on


@pytest.mark.parametrize("name", daily(1, ("limb", "pair", "pelvis", "water")))
def test_surface_below_a_level_of_a_body_without_air_is_refused_with_the_air_around_it(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    with pytest.raises(ClreconError, match=r"nothing below -400 HU lies within the body: [\d,.]+ ml are outside"):
        mesh_of(odd, device, tmp_path, name, below=-400.0)
    assert not list(tmp_path.iterdir())


def test_surface_below_a_level_of_a_table_alone_is_refused_as_without_a_body(
    odd: OddBodies, device: Any, tmp_path: Path
) -> None:
    with refused(ClreconError, "body"):
        mesh_of(odd, device, tmp_path, "empty", below=-400.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "band", "materials", "is_exceeded"),
    [
        pytest.param("contrast", (200.0, 500.0), ("contrast", "bone"), True, id="medium up to 461, bone up to 828 HU"),
        pytest.param("pelvis", (2500.0, 3071.0), ("metal",), False, id="metal of 3071 HU, the highest"),
    ],
)
def test_surface_of_a_range_of_hu_lies_on_its_material_at_the_lower_end_and_where_that_exceeds_it_at_the_upper(
    odd: OddBodies, device: Any, tmp_path: Path, name: str, band: tuple[float, float], materials: tuple[str, ...],
    is_exceeded: bool,
) -> None:  # fmt: skip
    from scipy import ndimage

    body = odd[name]

    _, vertices = mesh_of(odd, device, tmp_path, name, iso_value=(band,), remove_table=True)

    assert share_near(body, vertices, *materials) > 0.99  # measured 0.998 and 1
    hu = ndimage.map_coordinates(body.volume.voxels.astype(float), vertices[:, ::-1].T, order=1)
    at_lower, at_upper = ((np.abs(hu - end) < 1.0).mean() for end in band)
    assert at_lower > 0.7  # measured 0.83 and 0.99
    assert (at_upper > 0.05) == is_exceeded  # measured 0.105 and 0


PRINT_WITHOUT_TABLE = settings_for("print", {"iso_value": 300.0, "remove_table": True})


@pytest.fixture(scope="module")
def printed_pair(odd: OddBodies, device: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, np.ndarray]:
    """Report and vertices of a print of a pair of legs, of which it has one."""
    return mesh_of(odd, device, tmp_path_factory.mktemp("pair"), "pair", **PRINT_WITHOUT_TABLE)


@pytest.mark.parametrize("name", daily(1, ("pair", "limb")))
def test_print_without_the_table_is_one_closed_piece_of_bone(
    odd: OddBodies, device: Any, tmp_path: Path, name: str, request: pytest.FixtureRequest
) -> None:
    if name == "pair":
        report, vertices = request.getfixturevalue("printed_pair")
    else:
        report, vertices = mesh_of(odd, device, tmp_path, name, **PRINT_WITHOUT_TABLE)

    assert (report["closed"], report["components"]) == (True, 1)
    assert share_near(odd[name], vertices, "bone", "metal") > 0.95  # measured 0.98 of both
    (bone_kept,) = (gate for gate in report["volume"]["gates"] if gate["name"] == "bone_kept")
    assert bone_kept["ok"]
    assert [gate["name"] for gate in report["gates"] if gate["ok"] is False] == []


def test_print_of_one_leg_of_a_pair_warns_of_the_other(printed_pair: tuple[dict, np.ndarray]) -> None:
    report, _ = printed_pair
    assert report["print"]["left_out"]["pieces_ml"] > 0.0
    assert any("left out" in warning for warning in report["warnings"])


@pytest.mark.seconds
@pytest.mark.parametrize("name", daily(2, ("skull", "contrast", "pelvis", "bones", "limb", "pair")))
def test_print_with_the_table_there_is_one_piece_of_bone_and_states_what_is_none(
    odd: OddBodies, device: Any, tmp_path: Path, name: str
) -> None:
    settings = settings_for("print", {"iso_value": 300.0, "smooth": 5, "decimate": 0.3})

    report, vertices = mesh_of(odd, device, tmp_path, name, **settings)

    assert (report["keep"], report["components"]) == ("bone", 1)
    assert share_near(odd[name], vertices, "bone", "metal") > 0.95  # measured from 0.976 on
    left_out, kept_ml = report["print"]["left_out"], report["print"]["pieces_ml"]
    assert 0.0 <= left_out["not_bone_ml"] <= left_out["pieces_ml"]
    without = f"{count_of(left_out['not_bone'], 'piece')} without"
    assert any(without in line and "kept 1 of" in line for line in describe_purposes([report])), without
    left_out_bone_ml = left_out["pieces_ml"] - left_out["not_bone_ml"]
    is_warned_of = any("bone that was left out encloses" in warning for warning in report["warnings"])
    assert is_warned_of == (left_out_bone_ml > LEFT_SHARE * kept_ml)


def test_print_of_a_table_alone_is_refused_with_the_setting_that_prints_it(
    odd: OddBodies, device: Any, tmp_path: Path
) -> None:
    with refused(NoSurfaceError, "keep_largest=1"):
        mesh_of(odd, device, tmp_path, "empty", **settings_for("print", {}))


def test_print_of_the_largest_component_of_a_table_is_made(odd: OddBodies, device: Any, tmp_path: Path) -> None:
    settings = settings_for("print", {"keep_largest": 1, "smooth": 5, "decimate": 0.3})

    report, _ = mesh_of(odd, device, tmp_path, "empty", **settings)

    assert (report["keep"], report["print"]["left_out"]["not_bone"]) == (None, None)
