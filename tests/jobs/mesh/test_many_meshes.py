"""Several meshes in one job: iso values, components one by one, and what the report says of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tolerances
from refusals import refused

from clrecon.errors import DeviceMemoryError, NoSurfaceError, OutputError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh import make
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings

AFFINE = np.array([[0.5, 0.0, 0.0, -10.0], [0.0, 0.8, 0.0, 20.0], [0.0, 0.0, 2.0, -300.0], [0.0, 0.0, 0.0, 1.0]])
SUMMED = ("vertices", "triangles", "components", "area_mm2", "volume_ml")


BOX_ML = {
    "large": 8 * 10 * 12 * 0.8 / 1000.0,  # voxels of 0.8 cubic mm
    "middle": 4 * 3 * 6 * 0.8 / 1000.0,
    "small": 2 * 2 * 2 * 0.8 / 1000.0,
}


@pytest.fixture
def boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The input of each job is a scan with one warning, of three boxes in air of -1000 HU: a large and a middle one of
    800 HU, a small one of 300 HU."""
    voxels = np.full((12, 20, 30), -1000, np.int16)
    voxels[2:10, 2:12, 2:14] = 800
    voxels[2:6, 15:18, 18:24] = 800
    voxels[8:10, 15:17, 4:6] = 300
    report = {"hu_range": [-1000.0, 800.0], "warnings": ["the table is in the picture"]}
    monkeypatch.setattr(
        "clrecon.reading.dicom.reader.read_series",
        lambda source, selection, progress: Volume(voxels, AFFINE, dict(report)),
    )


def mesh_boxes(tmp_path: Path, device: Any, **settings: Any) -> dict[str, Any]:
    """Mesh the scan of `boxes` to bone.ply, or files named after it, and bone.json; return the report."""
    return make_mesh(
        "scan",
        tmp_path / "bone.ply",
        MeshSettings(device=str(device.index), **settings),
        report_path=tmp_path / "bone.json",
    )


@pytest.mark.usefixtures("boxes")
def test_report_of_one_mesh_has_its_entries_at_the_top_too(device: Any, tmp_path: Path) -> None:
    entries = [*SUMMED, "closed", "manifold", "bounds_mm", "iso_value_hu", "iso_level_hu", "quality"]

    report = mesh_boxes(tmp_path, device, iso_value=200.0)

    (mesh,) = report["meshes"]
    assert {entry: report[entry] for entry in entries} == {entry: mesh[entry] for entry in entries}
    assert None not in [mesh[entry] for entry in entries]


@pytest.mark.usefixtures("boxes")
def test_one_mesh_of_all_components_is_one_file_without_a_name_of_its_own(device: Any, tmp_path: Path) -> None:
    report = mesh_boxes(tmp_path, device, iso_value=200.0)

    (mesh,) = report["meshes"]
    assert (mesh["name"], mesh["label"]) == (None, None)
    assert (report["components"], report["components_found"]) == (3, None)  # none was chosen, so none was looked for
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bone.json", "bone.ply"]
    assert report["output"] == mesh["output"] == {"format": "ply", "bytes": (tmp_path / "bone.ply").stat().st_size}


@pytest.mark.usefixtures("boxes")
def test_each_of_several_iso_values_gives_the_file_and_figures_that_it_gives_alone(device: Any, tmp_path: Path) -> None:
    (alone,) = mesh_boxes(tmp_path, device, iso_value=500.0)["meshes"]
    file_alone = (tmp_path / "bone.ply").read_bytes()

    at_200, at_500 = mesh_boxes(tmp_path, device, iso_value=(200.0, 500.0))["meshes"]

    assert (at_200["name"], at_500["name"]) == ("200hu", "500hu")
    assert (at_200["components"], at_500["components"]) == (3, 2)  # the small box has 300 HU
    assert (tmp_path / "bone_500hu.ply").read_bytes() == file_alone
    own = {"name": None, "cortex": None}  # constants of the scan are measured in its largest surface
    assert {**at_500, **own} == {**alone, **own}


@pytest.mark.usefixtures("boxes")
def test_report_of_several_iso_values_sums_their_figures_and_leaves_those_of_one_open(
    device: Any, tmp_path: Path
) -> None:
    report = mesh_boxes(tmp_path, device, iso_value=(200.0, 500.0))

    sums = {name: sum(mesh[name] for mesh in report["meshes"]) for name in SUMMED}
    assert {name: report[name] for name in SUMMED} == pytest.approx(sums)
    assert (report["closed"], report["manifold"]) == (True, True)  # both are
    assert (report["iso_value_hu"], report["iso_level_hu"], report["quality"]) == (None, None, None)
    size = sum((tmp_path / f"bone_{level}hu.ply").stat().st_size for level in (200, 500))
    assert report["output"] == {"format": "ply", "bytes": size}


@pytest.mark.usefixtures("boxes")
def test_written_report_of_several_iso_values_lists_their_meshes_and_what_the_scan_has_once(
    device: Any, tmp_path: Path
) -> None:
    report = mesh_boxes(tmp_path, device, iso_value=(200.0, 500.0))

    written = json.loads((tmp_path / "bone.json").read_text())
    assert written["meshes"] == report["meshes"]
    assert written["warnings"] == ["the table is in the picture"]
    assert written["outside_hu"] == -1000.0  # the lowest value of the scan closes both surfaces


@pytest.mark.usefixtures("boxes")
def test_split_writes_a_numbered_file_for_each_component_the_largest_first(device: Any, tmp_path: Path) -> None:
    report = mesh_boxes(tmp_path, device, iso_value=200.0, split=True)

    assert sorted(path.name for path in tmp_path.glob("*.ply")) == ["bone_001.ply", "bone_002.ply", "bone_003.ply"]
    assert [mesh["name"] for mesh in report["meshes"]] == ["001", "002", "003"]
    assert [mesh["components"] for mesh in report["meshes"]] == [1, 1, 1]
    areas = [mesh["area_mm2"] for mesh in report["meshes"]]
    assert areas == sorted(areas, reverse=True)


@pytest.mark.usefixtures("boxes")
def test_report_of_a_split_surface_has_the_figures_of_the_whole(device: Any, tmp_path: Path) -> None:
    whole = mesh_boxes(tmp_path, device, iso_value=200.0)

    split = mesh_boxes(tmp_path, device, iso_value=200.0, split=True)

    figures = (*SUMMED, "iso_value_hu", "closed")
    assert {name: split[name] for name in figures} == pytest.approx({name: whole[name] for name in figures})
    assert split["bounds_mm"] == whole["bounds_mm"]
    assert split["components_found"] == 3


@pytest.mark.usefixtures("boxes")
def test_numbered_files_of_an_earlier_run_are_left_with_a_warning_of_their_number(device: Any, tmp_path: Path) -> None:
    of_this_name, of_others = ["bone_500hu_003.ply"], ["bone_1.ply", "bones_001.ply", "bone_001.stl"]
    for name in ("bone_002.ply", *of_this_name, *of_others):
        (tmp_path / name).write_bytes(b"earlier")

    first = mesh_boxes(tmp_path, device, iso_value=200.0, split=True)  # writes 001, 002 and 003
    again = mesh_boxes(tmp_path, device, iso_value=200.0, split=True, keep_largest=1)  # writes 001

    assert first["warnings"][1:] == ["1 more numbered file of this name lies beside the new ones, from an earlier run"]
    assert again["warnings"][1:] == ["3 more numbered files of this name lie beside the new ones, from an earlier run"]
    assert [(tmp_path / name).read_bytes() for name in (*of_this_name, *of_others)] == [b"earlier"] * 4
    assert (tmp_path / "bone_003.ply").stat().st_size > 100  # a mesh, of the first run


@pytest.mark.usefixtures("boxes")
def test_limits_and_split_are_applied_to_each_iso_value(device: Any, tmp_path: Path) -> None:
    limit_ml = 0.1
    assert BOX_ML["large"] > limit_ml > BOX_ML["middle"]

    report = mesh_boxes(tmp_path, device, iso_value=(200.0, 500.0), split=True, keep_largest=2, min_volume_ml=limit_ml)

    assert [mesh["name"] for mesh in report["meshes"]] == ["200hu_001", "500hu_001"]
    assert [mesh["components_found"] for mesh in report["meshes"]] == [3, 2]
    assert (report["components_found"], report["components_kept"], report["components"]) == (5, 2, 2)
    assert (report["keep_largest"], report["min_volume_ml"], report["split"]) == (2, limit_ml, True)


@pytest.mark.usefixtures("boxes")
@pytest.mark.parametrize(("space", "sign"), [("lps", 1.0), ("ras", -1.0)])
def test_seed_in_the_frame_of_the_mesh_keeps_the_component_about_it(
    space: str, sign: float, device: Any, tmp_path: Path
) -> None:
    middle_ijk = (20.5, 16.0, 3.5)  # of the voxels 18 to 23, 15 to 17 and 2 to 5 of the middle box
    middle_box_lps = AFFINE[:3, :3].diagonal() * middle_ijk + AFFINE[:3, 3]
    seed = (middle_box_lps * [sign, sign, 1]).tolist()

    report = mesh_boxes(tmp_path, device, iso_value=(200.0, 500.0), seeds=[seed], space=space)

    assert (report["components_found"], report["components_kept"]) == (5, 2)
    assert report["seeds_mm"] == [seed]
    for mesh in report["meshes"]:
        low, high = np.array(mesh["bounds_mm"])
        assert ((low < seed) & (seed < high)).all()
        assert 0.8 < mesh["seed_distances_mm"][0] < 1.2  # a row of 0.8 mm to the last voxel, and a part of one


@pytest.mark.usefixtures("boxes")
def test_seed_far_from_the_surface_is_refused_with_its_place_in_lps(device: Any, tmp_path: Path) -> None:
    with refused(UsageError, "LPS", 200, 100, 20):  # the iso value; x and y with their signs turned
        mesh_boxes(tmp_path, device, iso_value=200.0, seeds=[(-100.0, -20.0, -290.0)], space="ras")

    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("boxes")
def test_components_that_do_not_fit_the_device_are_found_without_it_with_a_warning(
    device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_device = mesh_boxes(tmp_path, device, iso_value=200.0, split=True)

    def refuse(*_: Any, **__: Any) -> Any:
        raise DeviceMemoryError("the components of the mesh cannot be found: too large")

    monkeypatch.setattr("clrecon.operators.primitives.union_find.label_components", refuse)
    report = mesh_boxes(tmp_path, device, iso_value=200.0, split=True)

    assert report["meshes"] == on_device["meshes"]
    assert report["warnings"][1:] == [
        "the components of the mesh cannot be found: too large: they were found without it"
    ]


@pytest.mark.usefixtures("boxes")
def test_bounds_in_ras_are_those_in_lps_with_x_and_y_turned(device: Any, tmp_path: Path) -> None:
    _, at_500 = mesh_boxes(tmp_path, device, iso_value=(200.0, 500.0))["meshes"]
    _, at_500_in_ras = mesh_boxes(tmp_path, device, iso_value=(200.0, 500.0), space="ras")["meshes"]

    low, high = at_500["bounds_mm"]
    np.testing.assert_allclose(at_500_in_ras["bounds_mm"], [[-high[0], -high[1], low[2]], [-low[0], -low[1], high[2]]])


@pytest.mark.usefixtures("boxes")
@pytest.mark.parametrize(
    ("settings", "error", "facts"),
    [
        pytest.param({"iso_value": (200.0, 900.0)}, NoSurfaceError, (900, "HU"), id="above every voxel"),
        pytest.param({"iso_value": (200.0, -1000.0)}, NoSurfaceError, (-1000, "HU"), id="at the lowest voxel"),
        pytest.param(
            {"iso_value": (200.0, 500.0), "min_volume_ml": 1000.0},
            NoSurfaceError,
            (200, 3, "HU"),  # 3 components are smaller
            id="no component large enough",
        ),
    ],
)
def test_job_with_one_empty_surface_is_refused_and_an_older_file_stays(
    settings: dict[str, Any], error: type[Exception], facts: tuple[str | int, ...], device: Any, tmp_path: Path
) -> None:
    (tmp_path / "bone_200hu.ply").write_bytes(b"old")

    with refused(error, *facts):
        mesh_boxes(tmp_path, device, **settings)

    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


@pytest.fixture
def two_files_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(make, "MOST_FILES", 2)


@pytest.mark.usefixtures("boxes", "two_files_at_most")
def test_more_components_than_a_job_writes_are_refused_with_the_volume_that_leaves_fewer(
    device: Any, tmp_path: Path
) -> None:
    with refused(UsageError, "min_volume_ml=0.1", 3, 2):  # 3 components, 2 files at most
        mesh_boxes(tmp_path, device, iso_value=200.0, split=True)

    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("boxes", "two_files_at_most")
def test_as_many_components_as_a_job_writes_are_written(device: Any, tmp_path: Path) -> None:
    report = mesh_boxes(tmp_path, device, iso_value=200.0, split=True, keep_largest=2)

    assert len(report["meshes"]) == 2


@pytest.mark.usefixtures("boxes")
def test_no_older_file_is_replaced_where_one_of_several_cannot_be_written(device: Any, tmp_path: Path) -> None:
    (tmp_path / "bone_001.ply").write_bytes(b"old")
    (tmp_path / "bone_003.ply").mkdir()  # a folder in the way of the third mesh

    with refused(OutputError, "bone_003.ply"):
        mesh_boxes(tmp_path, device, iso_value=200.0, split=True)

    assert sorted(path.name for path in tmp_path.iterdir()) == ["bone_001.ply", "bone_003.ply"]
    assert (tmp_path / "bone_001.ply").read_bytes() == b"old"


@pytest.mark.parametrize("level", [6, 2, 3.5])
def test_surface_of_several_iso_values_is_that_of_each_alone(level: float, device: Any) -> None:
    import clrecon

    levels = [6, 2, 3.5]
    noise = np.random.default_rng(5).integers(0, 9, (9, 10, 33)).astype(np.int16)
    volume = Volume(noise, AFFINE)

    together = clrecon.extract_isosurfaces(volume, levels, device=device, closed=False)[levels.index(level)]
    alone = clrecon.extract_isosurface(volume, level, device=device, closed=False)

    assert together.report["iso_value_hu"] == level
    np.testing.assert_array_equal(together.vertices, alone.vertices)
    np.testing.assert_array_equal(together.triangles, alone.triangles)


@pytest.mark.usefixtures("boxes")
def test_ranges_and_iso_values_of_one_job_give_meshes_named_by_their_ends(device: Any, tmp_path: Path) -> None:
    report = mesh_boxes(tmp_path, device, iso_value=(200.0, (100.0, 300.0), (-50.5, 500.0)), strict=True)

    level, narrow, wide = report["meshes"]
    assert (level["name"], level["inside"], level["inside_hu"]) == ("200hu", "above", [200.0, None])
    assert (narrow["name"], narrow["inside"], narrow["inside_hu"]) == ("100to300hu", "between", [100.0, 300.0])
    assert (wide["name"], wide["inside"], wide["inside_hu"]) == ("-50.5to500hu", "between", [-50.5, 500.0])
    assert (report["inside"], report["inside_hu"], report["preset"]) == (None, None, None)  # they differ


@pytest.mark.usefixtures("boxes")
def test_surface_of_a_range_encloses_the_box_of_its_hu_half_a_unit_beyond_its_ends(device: Any, tmp_path: Path) -> None:
    report = mesh_boxes(tmp_path, device, iso_value=((100.0, 300.0),), strict=True)

    assert report["components"] == 1  # the small box of 300 HU
    assert report["iso_value_hu"] is None
    (mesh,) = report["meshes"]
    assert mesh["inside_levels_hu"] == [99.5, 300.5]
    assert report["gates"] and all(gate["ok"] is not False for gate in report["gates"])


@pytest.mark.usefixtures("boxes")
def test_ply_of_a_range_names_its_hu_in_the_header(device: Any, tmp_path: Path) -> None:
    mesh_boxes(tmp_path, device, iso_value=((100.0, 300.0),))

    header = (tmp_path / "bone.ply").read_bytes().split(b"end_header")[0]
    assert b"INSIDE=100 to 300 HU" in header


@pytest.mark.usefixtures("boxes")
def test_surface_below_a_level_encloses_the_scan_without_what_is_above(device: Any, tmp_path: Path) -> None:
    scan_ml = 12 * 20 * 30 * 0.8 / 1000.0  # voxels of 0.8 cubic mm
    above_ml = mesh_boxes(tmp_path, device, iso_value=200.0)["volume_ml"]

    report = mesh_boxes(tmp_path, device, below=200.0, keep_outside=True)

    assert report["volume_ml"] == pytest.approx(scan_ml - above_ml, rel=0.02)  # corners of the scan are cut off
    assert report["components"] == 1 + 3  # the outer surface and three hollows


@pytest.mark.usefixtures("boxes")
def test_surfaces_below_several_levels_are_named_by_them(device: Any, tmp_path: Path) -> None:
    report = mesh_boxes(tmp_path, device, below=(200.0, 500.0), keep_outside=True)

    assert [mesh["name"] for mesh in report["meshes"]] == ["below200hu", "below500hu"]
    assert [mesh["components"] for mesh in report["meshes"]] == [1 + 3, 1 + 2]  # the small box has 300 HU
    assert report["outside_hu"] is None  # each has its own, above its level


@pytest.mark.usefixtures("boxes")
def test_vertices_of_a_surface_below_a_level_lie_on_the_iso_surface(device: Any, tmp_path: Path) -> None:
    report = mesh_boxes(tmp_path, device, below=200.0, keep_outside=True, keep_largest=1)

    assert (report["iso_value_hu"], report["inside"], report["components"]) == (200.0, "below", 1)
    assert report["iso_distance"]["vertices_voxel"]["max"] < tolerances.DEVICE_ISO_VERTEX_VOXEL


@pytest.mark.usefixtures("boxes")
@pytest.mark.parametrize(
    ("settings", "facts"),
    [
        pytest.param({"below": 900.0, "keep_outside": True}, (900, "HU"), id="all are below"),
        pytest.param({"iso_value": ((-2000.0, 900.0),)}, (-2000, 900, "HU"), id="all are in the range"),
        pytest.param({"iso_value": ((810.0, 900.0),)}, (810, 900, "HU"), id="none is in the range"),
    ],
)
def test_levels_that_hold_all_voxels_or_none_are_refused(
    settings: Any, facts: tuple[str | int, ...], device: Any, tmp_path: Path
) -> None:
    with refused(NoSurfaceError, *facts):
        mesh_boxes(tmp_path, device, **settings)

    assert not list(tmp_path.iterdir())
