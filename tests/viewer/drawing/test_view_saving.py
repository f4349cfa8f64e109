"""What a view shows, saved to each format of meshes, clouds, volumes and pictures."""

from __future__ import annotations

import numpy as np
import pytest
import view_scenes as scenes
from open_views import open_sessions
from refusals import refused

from clrecon.errors import UsageError
from clrecon.geometry import AIR_HU
from clrecon.mesh.mesh_reader import read_mesh
from clrecon.points.cloud_reader import read_points
from clrecon.reading import read_volume
from clrecon.viewer.drawing.saving import free_name
from clrecon.viewer.model.state import Pick

PATIENCE = 60.0


@pytest.fixture
def open_session(device):
    """A function that opens the session of objects, by default of a scan of three balls and a mesh."""
    with open_sessions(device) as make:
        yield make


@pytest.mark.opencl
@pytest.mark.parametrize("name", ["a.stl", "a.ply", "a.glb", "a.3mf", "a.obj", "a.vtp", "a.html"])
def test_shown_meshes_are_saved_to_each_mesh_format(open_session, tmp_path, name):
    view = open_session(scenes.make_scan(), scenes.make_mesh())
    view.do({"do": "find_parts"})
    assert view.wait(PATIENCE)
    view.do({"do": "show", "key": "1/1", "visible": False})
    view.do({"do": "save", "path": str(tmp_path / name)})
    assert view.wait(PATIENCE)
    facts = view.facts()
    assert facts["error"] is None and f"{name}: 2 meshes" in facts["said"]
    assert (tmp_path / name).stat().st_size > 1000  # measured 41,003 bytes (.html) to 223,581 (.obj)
    if name.endswith((".stl", ".ply")):
        shown = view.painter.mesh_of_shown(view.model.state)
        assert read_mesh(tmp_path / name).triangle_count == sum(each.triangle_count for each in shown)


@pytest.mark.opencl
def test_mesh_beside_a_hidden_scan_is_all_that_is_shown(open_session):
    view = open_session(scenes.make_scan(), scenes.make_mesh())
    _, mesh = view.painter.mesh_of_shown(view.model.state)
    view.do({"do": "show", "key": "1", "visible": False})
    (shown,) = view.painter.mesh_of_shown(view.model.state)
    assert np.array_equal(shown.vertices, mesh.vertices)


@pytest.mark.opencl
@pytest.mark.parametrize("name", ["a.ply", "a.npz", "a.xyz", "a.vtp"])
def test_cloud_is_saved_to_each_cloud_format(open_session, tmp_path, name):
    view = open_session(scenes.make_cloud(count=200))
    view.do({"do": "save", "path": str(tmp_path / name)})
    assert view.wait(PATIENCE) and view.facts()["error"] is None
    assert len(read_points(tmp_path / name)) == 200


@pytest.mark.opencl
def test_scan_saved_as_a_cloud_is_the_vertices_of_its_surface(open_session, tmp_path):
    view = open_session(scenes.make_scan())
    view.do({"do": "save", "path": str(tmp_path / "a.npz")})
    assert view.wait(PATIENCE) and view.facts()["error"] is None
    (mesh,) = view.painter.mesh_of_shown(view.model.state)
    assert np.array_equal(read_points(tmp_path / "a.npz").points, mesh.vertices)


@pytest.mark.opencl
def test_scan_is_saved_without_hidden_parts_and_cropped_to_the_clip_box(open_session, tmp_path):
    view = open_session(scenes.make_scan())
    view.do({"do": "find_parts"})
    assert view.wait(PATIENCE)
    view.do({"do": "show", "key": "1/2", "visible": False})
    low, high = (scenes.middle(0) - 12.0).tolist(), (scenes.middle(2) + 12.0).tolist()
    view.do({"do": "set_clip_box", "low": np.minimum(low, high).tolist(), "high": np.maximum(low, high).tolist()})
    view.do({"do": "save", "path": str(tmp_path / "a.nii.gz")})
    assert view.wait(PATIENCE) and view.facts()["error"] is None
    saved = read_volume(tmp_path / "a.nii.gz")
    assert saved.voxels.size < 0.9 * scenes.make_scan().voxels.size  # measured 0.795
    values = [saved.voxels[tuple(np.rint(saved.lps_to_ijk([scenes.middle(n)])[0]).astype(int)[::-1])] for n in range(3)]
    in_first, in_hidden, in_third = values
    assert in_first == in_third == 1000  # the HU of all balls
    assert in_hidden == AIR_HU  # in place of the ball


@pytest.mark.opencl
@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif"])
def test_screenshot_has_the_given_size(open_session, tmp_path, name):
    from PIL import Image

    view = open_session()
    view.do({"do": "save", "path": str(tmp_path / name), "size": [120, 90]})
    assert view.wait(PATIENCE) and view.facts()["error"] is None
    assert Image.open(tmp_path / name).size == (120, 90)


@pytest.mark.opencl
def test_volume_of_a_view_without_a_scan_is_refused(open_session, tmp_path):
    with refused(UsageError, "scan"):
        open_session(scenes.make_mesh()).do({"do": "save", "path": str(tmp_path / "a.nii.gz")})


@pytest.mark.opencl
def test_mesh_of_a_view_with_all_objects_hidden_is_refused(open_session, tmp_path):
    view = open_session(scenes.make_mesh())
    view.do({"do": "show", "key": "1", "visible": False})
    with refused(UsageError, "nothing", "surface"):
        view.do({"do": "save", "path": str(tmp_path / "a.stl")})


@pytest.mark.opencl
def test_mesh_for_a_missing_folder_is_an_error_of_the_view(open_session, tmp_path):
    view = open_session(scenes.make_mesh())

    view.do({"do": "save", "path": str(tmp_path / "none" / "a.stl")})

    assert view.wait(PATIENCE)
    assert "none" in view.facts()["error"]
    assert not list(tmp_path.iterdir())


@pytest.mark.opencl
def test_existing_file_stays_and_a_new_one_is_saved_with_no_clobber(open_session, tmp_path):
    view = open_session(scenes.make_mesh(), no_clobber=True)
    (tmp_path / "a.stl").write_text("mine")

    for name in ("a.stl", "b.stl"):
        view.do({"do": "save", "path": str(tmp_path / name)})
        assert view.wait(PATIENCE)

    assert (tmp_path / "a.stl").read_text() == "mine"
    assert "a.stl" in view.facts()["error"] and "exists" in view.facts()["error"]
    assert (tmp_path / "b.stl").exists()


@pytest.mark.unit
@pytest.mark.parametrize(
    ("wanted", "second", "third"),
    [
        ("bone.stl", "bone-2.stl", "bone-3.stl"),
        ("ct.nii.gz", "ct-2.nii.gz", "ct-3.nii.gz"),
        ("a.b.stl", "a.b-2.stl", "a.b-3.stl"),
    ],
)
def test_number_is_put_to_a_name_until_one_is_free(tmp_path, wanted, second, third):
    assert free_name(tmp_path / wanted) == tmp_path / wanted
    (tmp_path / wanted).touch()
    assert free_name(tmp_path / wanted) == tmp_path / second
    (tmp_path / second).symlink_to(tmp_path / "nowhere")  # a name that is taken, though nothing is there
    assert free_name(tmp_path / wanted) == tmp_path / third


@pytest.mark.opencl
@pytest.mark.parametrize("name", ["a.csv", "a.json", "a.mrk.json"])
def test_measures_are_saved_to_a_table_json_or_markups(open_session, tmp_path, name):
    view = open_session()
    view.model.add_seed(Pick(point=(1.0, 2.0, 3.0)))

    view.do({"do": "save", "path": str(tmp_path / name)})

    assert view.wait(PATIENCE)
    assert view.facts()["error"] is None
    assert f"{name}: 1 measure" in view.facts()["said"]
    assert "place 1" in (tmp_path / name).read_text(encoding="utf-8")


@pytest.mark.unit
def test_number_is_put_before_both_extensions_of_markups(tmp_path):
    (tmp_path / "a.mrk.json").touch()
    assert free_name(tmp_path / "a.mrk.json").name == "a-2.mrk.json"


@pytest.mark.opencl
def test_table_of_a_view_without_measures_is_refused(open_session, tmp_path):
    with refused(UsageError, "measure"):
        open_session().do({"do": "save", "path": str(tmp_path / "a.csv")})
    assert not (tmp_path / "a.csv").exists()
