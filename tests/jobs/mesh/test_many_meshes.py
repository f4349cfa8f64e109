"""Several meshes in one job: iso values, components one by one, and what the report says of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import DeviceMemoryError, NoSurfaceError, OutputError, UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh import make
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.settings import MeshSettings

AFFINE = np.array([[0.5, 0.0, 0.0, -10.0], [0.0, 0.8, 0.0, 20.0], [0.0, 0.0, 2.0, -300.0], [0.0, 0.0, 0.0, 1.0]])
SUMMED = ("vertices", "triangles", "components", "area_mm2", "volume_ml")


@pytest.fixture
def boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan of three boxes: 800 HU large and middle, 300 HU small."""
    voxels = np.full((12, 20, 30), -1000, np.int16)
    voxels[2:10, 2:12, 2:14] = 800
    voxels[2:6, 15:18, 18:24] = 800
    voxels[8:10, 15:17, 4:6] = 300
    report = {"hu_range": [-1000.0, 800.0], "warnings": ["the table is in the picture"]}
    monkeypatch.setattr(
        "clrecon.reading.dicom.reader.read_series",
        lambda source, selection, progress: Volume(voxels, AFFINE, dict(report)),
    )


def run(tmp_path: Path, device: Any, **settings: Any) -> dict[str, Any]:
    return make_mesh(
        "scan",
        tmp_path / "bone.ply",
        MeshSettings(device=str(device.index), **settings),
        report_path=tmp_path / "bone.json",
    )


@pytest.mark.usefixtures("boxes")
def test_one_mesh_stands_at_the_top_and_in_the_list(device: Any, tmp_path: Path) -> None:
    report = run(tmp_path, device, iso_value=200.0)
    (mesh,) = report["meshes"]
    assert (mesh["name"], mesh["label"]) == (None, None)
    for name in (*SUMMED, "closed", "manifold", "bounds_mm", "iso_value_hu", "iso_level_hu", "quality"):
        assert report[name] == mesh[name]
        assert report[name] is not None
    assert (report["components"], report["components_found"]) == (3, None)
    assert report["output"] == mesh["output"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bone.json", "bone.ply"]


@pytest.mark.usefixtures("boxes")
def test_several_iso_values_are_one_file_each(device: Any, tmp_path: Path) -> None:
    alone = run(tmp_path, device, iso_value=500.0)
    alone_file = (tmp_path / "bone.ply").read_bytes()
    report = run(tmp_path, device, iso_value=(200.0, 500.0))
    assert [mesh["name"] for mesh in report["meshes"]] == ["200hu", "500hu"]
    assert [mesh["components"] for mesh in report["meshes"]] == [3, 2]
    own = {"name": None, "cortex": None}  # constants of the scan are measured in its largest surface
    assert {**report["meshes"][1], **own} == {**alone["meshes"][0], **own}
    assert (tmp_path / "bone_500hu.ply").read_bytes() == alone_file
    for name in SUMMED:
        assert report[name] == pytest.approx(sum(mesh[name] for mesh in report["meshes"]))
    assert (report["iso_value_hu"], report["iso_level_hu"], report["outside_hu"]) == (None, None, -1000.0)
    assert (report["closed"], report["manifold"], report["quality"]) == (True, True, None)
    assert report["warnings"] == ["the table is in the picture"]
    size = sum((tmp_path / f"bone_{level}hu.ply").stat().st_size for level in (200, 500))
    assert report["output"] == {"format": "ply", "bytes": size}
    assert json.loads((tmp_path / "bone.json").read_text())["meshes"] == report["meshes"]


@pytest.mark.usefixtures("boxes")
def test_split_writes_the_components_by_descending_size(device: Any, tmp_path: Path) -> None:
    whole = run(tmp_path, device, iso_value=200.0)
    (tmp_path / "bone.ply").unlink()
    report = run(tmp_path, device, iso_value=200.0, split=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "bone.json", "bone_001.ply", "bone_002.ply", "bone_003.ply",
    ]  # fmt: skip
    assert [mesh["name"] for mesh in report["meshes"]] == ["001", "002", "003"]
    areas = [mesh["area_mm2"] for mesh in report["meshes"]]
    assert areas == sorted(areas, reverse=True)
    for name in SUMMED:
        assert report[name] == pytest.approx(whole[name])
    assert report["bounds_mm"] == whole["bounds_mm"]
    assert (report["iso_value_hu"], report["closed"], report["components_found"]) == (200.0, True, 3)
    assert [mesh["components"] for mesh in report["meshes"]] == [1, 1, 1]


@pytest.mark.usefixtures("boxes")
def test_components_of_an_earlier_run_are_left_and_said(device: Any, tmp_path: Path) -> None:
    for name in ("bone_002.ply", "bone_500hu_003.ply", "bone_1.ply", "bones_001.ply", "bone_001.stl"):
        (tmp_path / name).write_bytes(b"other")
    first = run(tmp_path, device, iso_value=200.0, split=True)
    again = run(tmp_path, device, iso_value=200.0, split=True, keep_largest=1)
    assert [report["warnings"][1:] for report in (first, again)] == [
        ["1 more numbered file of this name lies beside the new ones, from an earlier run"],
        ["3 more numbered files of this name lie beside the new ones, from an earlier run"],
    ]
    assert (tmp_path / "bone_500hu_003.ply").read_bytes() == b"other"
    assert (tmp_path / "bone_003.ply").stat().st_size > 100


@pytest.mark.usefixtures("boxes")
def test_limits_and_split_hold_for_each_iso_value(device: Any, tmp_path: Path) -> None:
    report = run(tmp_path, device, iso_value=(200.0, 500.0), split=True, keep_largest=2, min_volume_ml=0.1)
    assert [mesh["name"] for mesh in report["meshes"]] == ["200hu_001", "500hu_001"]
    assert [mesh["components_found"] for mesh in report["meshes"]] == [3, 2]
    assert (report["components_found"], report["components_kept"], report["components"]) == (5, 2, 2)
    assert (report["keep_largest"], report["min_volume_ml"], report["split"]) == (2, 0.1, True)


@pytest.mark.usefixtures("boxes")
@pytest.mark.parametrize(("space", "sign"), [("lps", 1.0), ("ras", -1.0)])
def test_seeds_are_in_the_frame_of_the_mesh(space: str, sign: float, device: Any, tmp_path: Path) -> None:
    middle = np.array([20.5 * 0.5 - 10, 16 * 0.8 + 20, 3.5 * 2 - 300])
    seed = (middle * [sign, sign, 1]).tolist()
    report = run(tmp_path, device, iso_value=(200.0, 500.0), seeds=[seed], space=space)
    assert (report["components_found"], report["components_kept"]) == (5, 2)
    assert report["seeds_mm"] == [seed]
    for mesh in report["meshes"]:
        low, high = np.array(mesh["bounds_mm"])
        assert ((low < seed) & (seed < high)).all()
        assert 0.8 < mesh["seed_distances_mm"][0] < 1.2  # a row of 0.8 mm to the last voxel, and a part of one


@pytest.mark.usefixtures("boxes")
def test_a_seed_off_the_surface_ends_the_job(device: Any, tmp_path: Path) -> None:
    with refused(UsageError, "LPS", 200, 100, 20):
        run(tmp_path, device, iso_value=200.0, seeds=[(-100.0, -20.0, -290.0)], space="ras")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("boxes")
def test_components_that_do_not_fit_the_device_are_found_all_the_same(
    device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_device = run(tmp_path, device, iso_value=200.0, split=True)

    def refuse(*_: Any, **__: Any) -> Any:
        raise DeviceMemoryError("the components of the mesh cannot be found: too large")

    monkeypatch.setattr("clrecon.operators.primitives.union_find.label_components", refuse)
    report = run(tmp_path, device, iso_value=200.0, split=True)
    assert report["meshes"] == on_device["meshes"]
    assert report["warnings"][1:] == [
        "the components of the mesh cannot be found: too large: they were found without it"
    ]


@pytest.mark.usefixtures("boxes")
def test_bounds_and_files_follow_the_space(device: Any, tmp_path: Path) -> None:
    lps = run(tmp_path, device, iso_value=(200.0, 500.0))["meshes"][1]["bounds_mm"]
    ras = run(tmp_path, device, iso_value=(200.0, 500.0), space="ras")["meshes"][1]["bounds_mm"]
    np.testing.assert_allclose(np.array(ras) * [-1, -1, 1], [[*lps[1][:2], lps[0][2]], [*lps[0][:2], lps[1][2]]])


@pytest.mark.usefixtures("boxes")
@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ({"iso_value": (200.0, 900.0)}, NoSurfaceError, (900, "HU")),
        ({"iso_value": (200.0, -1000.0)}, NoSurfaceError, (-1000, "HU")),
        ({"iso_value": (200.0, 500.0), "min_volume_ml": 1000.0}, NoSurfaceError, (200, 3, "HU")),
    ],
)
def test_one_surface_that_is_not_there_ends_the_job(
    settings: dict[str, Any], error: type[Exception], words: str, device: Any, tmp_path: Path
) -> None:
    (tmp_path / "bone_200hu.ply").write_bytes(b"old")
    with refused(error, *words):
        run(tmp_path, device, **settings)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


@pytest.mark.usefixtures("boxes")
def test_too_many_components_are_refused_with_advice(
    device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(make, "MOST_FILES", 2)
    with refused(UsageError, "min_volume_ml=0.1", 3, 2, 0.1):
        run(tmp_path, device, iso_value=200.0, split=True)
    assert list(tmp_path.iterdir()) == []
    assert len(run(tmp_path, device, iso_value=200.0, split=True, keep_largest=2)["meshes"]) == 2


@pytest.mark.usefixtures("boxes")
def test_no_old_file_is_replaced_unless_all_can_be(device: Any, tmp_path: Path) -> None:
    (tmp_path / "bone_001.ply").write_bytes(b"old")
    (tmp_path / "bone_003.ply").mkdir()
    with refused(OutputError, "bone_003.ply"):
        run(tmp_path, device, iso_value=200.0, split=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bone_001.ply", "bone_003.ply"]
    assert (tmp_path / "bone_001.ply").read_bytes() == b"old"


def test_surfaces_are_those_of_each_iso_value_alone(device: Any) -> None:
    import clrecon

    voxels = np.random.default_rng(5).integers(0, 9, (9, 10, 33)).astype(np.int16)
    volume = Volume(voxels, AFFINE)
    meshes = clrecon.extract_isosurfaces(volume, [6, 2, 3.5], device=device, closed=False)
    for mesh, level in zip(meshes, (6, 2, 3.5), strict=True):
        alone = clrecon.extract_isosurface(volume, level, device=device, closed=False)
        assert mesh.report["iso_value_hu"] == level
        np.testing.assert_array_equal(mesh.vertices, alone.vertices)
        np.testing.assert_array_equal(mesh.triangles, alone.triangles)


@pytest.mark.usefixtures("boxes")
def test_ranges_and_iso_values_are_named_by_their_ends(device: Any, tmp_path: Path) -> None:
    report = run(tmp_path, device, iso_value=(200.0, (100.0, 300.0), (-50.5, 500.0)), strict=True)
    assert [mesh["name"] for mesh in report["meshes"]] == ["200hu", "100to300hu", "-50.5to500hu"]
    assert [mesh["inside"] for mesh in report["meshes"]] == ["above", "between", "between"]
    assert [mesh["iso_value_hu"] for mesh in report["meshes"]] == [200.0, None, None]
    assert [mesh["inside_hu"] for mesh in report["meshes"]] == [[200.0, None], [100.0, 300.0], [-50.5, 500.0]]
    assert [mesh["components"] for mesh in report["meshes"]] == [3, 1, 1]
    assert report["meshes"][1]["inside_levels_hu"] == [99.5, 300.5]
    assert (report["inside"], report["inside_hu"], report["preset"]) == (None, None, None)
    assert all(gate["ok"] is not False for gate in report["gates"])
    assert "INSIDE=100 to 300 HU" in (tmp_path / "bone_100to300hu.ply").read_bytes()[:2000].decode("latin-1")


@pytest.mark.usefixtures("boxes")
def test_surface_below_a_level_encloses_the_rest(device: Any, tmp_path: Path) -> None:
    report = run(tmp_path, device, below=(200.0, 500.0), keep_outside=True)
    assert [mesh["name"] for mesh in report["meshes"]] == ["below200hu", "below500hu"]
    assert [mesh["components"] for mesh in report["meshes"]] == [4, 3]
    box = 30 * 0.5 * 20 * 0.8 * 12 * 2.0 / 1000.0
    bone = run(tmp_path, device, iso_value=200.0)["volume_ml"]
    assert report["meshes"][0]["volume_ml"] == pytest.approx(box - bone, rel=0.02)
    assert report["outside_hu"] is None
    alone = run(tmp_path, device, below=200.0, keep_outside=True, keep_largest=1)
    assert (alone["iso_value_hu"], alone["inside"], alone["components"]) == (200.0, "below", 1)
    assert alone["iso_distance"]["vertices_voxel"]["max"] < 1e-3


@pytest.mark.usefixtures("boxes")
@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"below": 900.0}, (900, "HU")),
        ({"iso_value": ((-2000.0, 900.0),)}, (-2000, 900, "HU")),
        ({"iso_value": ((810.0, 900.0),)}, (810, 900, "HU")),
    ],
)
def test_levels_that_hold_all_or_nothing_are_refused(settings: Any, said: str, device: Any, tmp_path: Path) -> None:
    with refused(NoSurfaceError, *said):
        run(tmp_path, device, **settings, **({"keep_outside": True} if "below" in settings else {}))
    assert not list(tmp_path.iterdir())
