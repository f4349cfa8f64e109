"""--all-parts: a print of all bones, as objects of one 3MF or as one mesh; and meshes of many small components."""

from __future__ import annotations

import json
import re
import zipfile

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.jobs.mesh import make
from clrecon.jobs.mesh.purposes import settings_for
from clrecon.jobs.mesh.settings import MeshSettings

RADII = (13.0, 10.0, 8.0)
CAVITY = 3.0


def ball(shape, centre, radius):
    way = np.sqrt(sum((axis - middle) ** 2 for axis, middle in zip(np.indices(shape), centre, strict=True)))
    return np.clip(radius - way + 0.5, 0.0, 1.0)


@pytest.fixture(scope="module")
def bones(tmp_path_factory):
    """Three balls of bone in tissue, the largest around a cavity of air, and 150 crumbs of 8 mm3, as a file."""
    shape = (40, 60, 90)
    hu = np.full(shape, 40.0)
    for radius, i in zip(RADII, (16, 44, 68), strict=True):
        hu += 1160.0 * ball(shape, (20, 20, i), radius)
    hu = np.where(ball(shape, (20, 20, 16), CAVITY) > 0.5, -900.0, hu)
    crumbs = np.stack(np.meshgrid([4, 10, 16, 22, 28], [42, 48, 54], np.arange(10, 70, 6), indexing="ij"), -1)
    for k, j, i in crumbs.reshape(-1, 3):
        hu[k : k + 2, j : j + 2, i : i + 2] = 1200
    hu[:, :2] = -1000
    path = tmp_path_factory.mktemp("parts") / "bones.nii.gz"
    clrecon.write_volume(Volume(np.rint(hu).astype(np.int16), np.eye(4)), path)
    return path


def run(bones, output, device, *options):
    report = output.with_suffix(".json")
    given = ["mesh", bones, "-o", output, "--report", report, "--device", device.index, "--hu", 600, *options]
    code = main([str(one) for one in given])
    return code, json.loads(report.read_text()) if report.exists() else None


TRUE_ML = [4 / 3 * np.pi * radius**3 / 1000 for radius in RADII]


@pytest.mark.seconds
def test_all_bones_are_named_objects_of_a_3mf(device, bones, tmp_path, printed):
    code, report = run(bones, tmp_path / "a.3mf", device, "--for", "print", "--all-parts")
    said = printed()
    assert code == 0, said
    assert [mesh["volume_ml"] for mesh in report["meshes"]] == pytest.approx(TRUE_ML, rel=0.02)  # the cavity is filled
    assert (report["all_parts"], report["keep_largest"], report["keep"]) == (True, None, "bone")
    with zipfile.ZipFile(tmp_path / "a.3mf") as packed:
        model = packed.read("3D/3dmodel.model").decode()
    assert re.findall(r'<object [^>]*name="([^"]*)"', model) == ["001", "002", "003"]
    said.assert_output("a.3mf")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.3mf", "a.json"]


@pytest.mark.release
def test_all_bones_are_one_mesh_of_other_formats(device, bones, tmp_path, printed):
    code, report = run(bones, tmp_path / "a.stl", device, "--for", "print", "--all-parts")
    assert code == 0, printed()
    assert (report["components"], report["closed"]) == (3, True)
    assert report["volume_ml"] == pytest.approx(sum(TRUE_ML), rel=0.02)
    assert report["print"]["left_out"]["cavities"] == 1


@pytest.mark.release
def test_a_print_that_leaves_bone_out_names_the_option(device, bones, tmp_path):
    code, report = run(bones, tmp_path / "a.stl", device, "--for", "print")
    assert code == 0 and report["components"] == 1
    [warning] = [text for text in report["warnings"] if "was left out" in text]
    assert "--all-parts keeps all" in warning


def test_crumbs_are_counted_with_the_option_that_drops_them(device, bones, tmp_path):
    _, report = run(bones, tmp_path / "a.stl", device)
    [warning] = [text for text in report["warnings"] if "components enclose less" in text]
    assert warning.startswith("150 of 154 components enclose less than 0.1 ml each, ")
    assert warning.endswith(" ml together: --min-volume 0.1 drops them")
    assert report["all_parts"] is False
    _, report = run(bones, tmp_path / "b.stl", device, "--min-volume", 0.1)
    assert report["components"] == 4 and not any("drops them" in text for text in report["warnings"])


def test_too_many_objects_are_refused_with_the_number_of_crumbs(device, bones, tmp_path, monkeypatch, printed):
    monkeypatch.setattr(make, "MOST_FILES", 100)
    code, _ = run(bones, tmp_path / "a.stl", device, "--split")
    assert code == 3
    error = printed()
    error.assert_error(154, 150, 0.1, "--min-volume", 0.1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"all_parts": True}, "all_parts=True belongs to purpose='print'"),
        ({"all_parts": True, "keep_largest": 2, "purpose": "print"}, "all_parts=True keeps all bones"),
        ({"all_parts": True, "seeds": [(0, 0, 0)], "purpose": "print"}, "all_parts=True keeps all bones"),
    ],
)
def test_options_that_exclude_all_parts_are_refused(given, words):
    with pytest.raises(UsageError, match=words):
        MeshSettings(**given)


def test_least_volumes_go_with_all_parts():
    settings = MeshSettings(**settings_for("print", {"all_parts": True, "min_volume_ml": 0.1}))
    assert (settings.keep, settings.keep_largest, settings.min_volume_ml) == ("bone", None, 0.1)


@pytest.mark.release
def test_the_seal_of_a_print_can_be_given(device, bones, tmp_path):
    code, report = run(bones, tmp_path / "a.stl", device, "--for", "print", "--seal", 0.3)
    assert code == 0 and report["volume"]["solid"]["seal_mm"] == 0.3
    with refused(UsageError, "seal_mm", "solid=True"):
        MeshSettings(**settings_for("print", {"solid": False, "seal_mm": 0.3}))


def test_bones_that_a_level_makes_too_large_share_one_warning(device, bones, tmp_path):
    _, report = run(bones, tmp_path / "a.3mf", device, "--for", "print", "--all-parts", "--hu", 100)
    said = [warning for warning in report["warnings"] if "too large" in warning]
    assert len(said) == 1 and re.match(r"3 meshes, most 003: the surface at 100 HU lies 0\.\d+", said[0]), said
    assert re.search(r"makes the volumes about \d+ to \d+ % too large: --hu auto", said[0]), said
