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

RADII_MM = (13.0, 10.0, 8.0)
CAVITY_MM = 3.0


def ball(shape, centre, radius):
    """The share of each voxel that lies in a ball, about."""
    way = np.sqrt(sum((axis - middle) ** 2 for axis, middle in zip(np.indices(shape), centre, strict=True)))
    return np.clip(radius - way + 0.5, 0.0, 1.0)


@pytest.fixture(scope="module")
def bones(tmp_path_factory):
    """A file of three balls of bone in tissue, the largest about a cavity of air, and 150 crumbs of 8 mm3."""
    shape = (40, 60, 90)
    hu = np.full(shape, 40.0)
    for radius, i in zip(RADII_MM, (16, 44, 68), strict=True):
        hu += 1160.0 * ball(shape, (20, 20, i), radius)
    hu = np.where(ball(shape, (20, 20, 16), CAVITY_MM) > 0.5, -900.0, hu)
    crumbs = np.stack(np.meshgrid([4, 10, 16, 22, 28], [42, 48, 54], np.arange(10, 70, 6), indexing="ij"), -1)
    for k, j, i in crumbs.reshape(-1, 3):
        hu[k : k + 2, j : j + 2, i : i + 2] = 1200
    hu[:, :2] = -1000
    path = tmp_path_factory.mktemp("parts") / "bones.nii.gz"
    clrecon.write_volume(Volume(np.rint(hu).astype(np.int16), np.eye(4)), path)
    return path


def mesh_bones(bones, output, device, *options):
    """Mesh the file at 600 HU with further options; return the exit code, and the report if one was written."""
    report = output.with_suffix(".json")
    given = ["mesh", bones, "-o", output, "--report", report, "--device", device.index, "--hu", 600, *options]
    code = main([str(one) for one in given])
    return code, json.loads(report.read_text()) if report.exists() else None


BALLS_ML = [4 / 3 * np.pi * radius**3 / 1000 for radius in RADII_MM]
VOXELS_OF_BALLS = 0.02
"""Relative volume of balls of 8 to 13 mm in voxels of 1 mm."""


@pytest.mark.seconds
def test_all_bones_of_a_print_are_solid_named_objects_of_a_3mf(device, bones, tmp_path, printed):
    code, report = mesh_bones(bones, tmp_path / "a.3mf", device, "--for", "print", "--all-parts")

    assert code == 0
    assert (report["all_parts"], report["keep_largest"], report["keep"]) == (True, None, "bone")
    assert [mesh["volume_ml"] for mesh in report["meshes"]] == pytest.approx(BALLS_ML, rel=VOXELS_OF_BALLS)
    with zipfile.ZipFile(tmp_path / "a.3mf") as packed:
        model = packed.read("3D/3dmodel.model").decode()
    assert re.findall(r'<object [^>]*name="([^"]*)"', model) == ["001", "002", "003"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.3mf", "a.json"]
    printed().assert_output("a.3mf")


@pytest.mark.release
def test_all_bones_of_a_print_are_one_solid_mesh_of_an_stl(device, bones, tmp_path):
    code, report = mesh_bones(bones, tmp_path / "a.stl", device, "--for", "print", "--all-parts")

    assert code == 0
    assert (report["components"], report["closed"]) == (3, True)
    assert report["volume_ml"] == pytest.approx(sum(BALLS_ML), rel=VOXELS_OF_BALLS)
    assert report["print"]["left_out"]["cavities"] == 1


@pytest.mark.release
def test_print_that_leaves_bones_out_warns_with_the_option_that_keeps_all(device, bones, tmp_path):
    code, report = mesh_bones(bones, tmp_path / "a.stl", device, "--for", "print")

    assert (code, report["components"]) == (0, 1)
    (warning,) = [text for text in report["warnings"] if "was left out" in text]
    assert "--all-parts keeps all" in warning


def test_many_small_components_are_warned_of_with_the_option_that_drops_them(device, bones, tmp_path):
    _, report = mesh_bones(bones, tmp_path / "a.stl", device)

    balls_cavity_and_crumbs = 3 + 1 + 150
    assert report["components"] == balls_cavity_and_crumbs
    (warning,) = [text for text in report["warnings"] if "components enclose less" in text]
    assert warning.startswith("150 of 154 components enclose less than 0.1 ml each, ")
    assert warning.endswith(" ml together: --min-volume 0.1 drops them")


def test_least_volume_drops_small_components_and_their_warning(device, bones, tmp_path):
    _, report = mesh_bones(bones, tmp_path / "b.stl", device, "--min-volume", 0.1)

    assert report["components"] == 3 + 1  # the balls and the cavity
    assert not any("drops them" in text for text in report["warnings"])


def test_all_parts_are_not_kept_by_default(device, bones, tmp_path):
    _, report = mesh_bones(bones, tmp_path / "a.stl", device)
    assert report["all_parts"] is False


def test_too_many_components_are_refused_with_the_number_of_small_ones_and_the_option_that_drops_them(
    device, bones, tmp_path, monkeypatch, printed
):
    monkeypatch.setattr(make, "MOST_FILES", 100)

    code, _ = mesh_bones(bones, tmp_path / "a.stl", device, "--split")

    assert code == 3
    printed().assert_error(154, 150, "--min-volume", 0.1)  # 150 of 154 are below 0.1 ml
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"all_parts": True}, "all_parts=True belongs to purpose='print'"),
        ({"all_parts": True, "keep_largest": 2, "purpose": "print"}, "all_parts=True keeps all bones"),
        ({"all_parts": True, "seeds": [(0, 0, 0)], "purpose": "print"}, "all_parts=True keeps all bones"),
    ],
    ids=["no print", "largest components", "components at seeds"],
)
def test_all_parts_with_a_setting_that_excludes_them_are_refused(given, words):
    with pytest.raises(UsageError, match=words):
        MeshSettings(**given)


def test_all_parts_keep_bone_and_a_least_volume_but_not_the_largest_alone():
    settings = MeshSettings(**settings_for("print", {"all_parts": True, "min_volume_ml": 0.1}))
    assert (settings.keep, settings.keep_largest, settings.min_volume_ml) == ("bone", None, 0.1)


@pytest.mark.release
def test_given_seal_of_a_print_is_reported(device, bones, tmp_path):
    code, report = mesh_bones(bones, tmp_path / "a.stl", device, "--for", "print", "--seal", 0.3)
    assert (code, report["volume"]["solid"]["seal_mm"]) == (0, 0.3)


def test_seal_of_a_hollow_print_is_refused():
    with refused(UsageError, "seal_mm", "solid=True"):
        MeshSettings(**settings_for("print", {"solid": False, "seal_mm": 0.3}))


def test_bones_that_a_low_iso_value_makes_too_large_share_one_warning(device, bones, tmp_path):
    far_below_half_way = 100

    _, report = mesh_bones(
        bones, tmp_path / "a.3mf", device, "--for", "print", "--all-parts", "--hu", far_below_half_way
    )

    (warning,) = [text for text in report["warnings"] if "too large" in text]
    assert re.match(r"3 meshes, most 003: the surface at 100 HU lies 0\.\d+", warning)
    assert re.search(r"makes the volumes about \d+ to \d+ % too large: --hu auto", warning)
