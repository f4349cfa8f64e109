"""``clrecon mesh --solid`` without labels: what it fills and says, what it is refused with, and for print."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from clrecon.cli.main import main
from clrecon.geometry import Volume

SOLID_ML = 1.1 * 4 / 3 * np.pi * 18.0**3 / 1000
"""The volume within the surface at 400 HU of the egg, 36 mm wide and 1.1 times as long."""


@pytest.fixture(scope="module")
def bone(tmp_path_factory):
    """A hollow egg of bone with a pore, in tissue, as a file."""
    import clrecon

    k, j, i = np.indices((50, 44, 46)).astype(float)
    away = np.sqrt(((k - 24.5) / 1.1) ** 2 + (j - 21.5) ** 2 + (i - 22.5) ** 2)
    values = 40 + 760 * np.clip(18.5 - away, 0, 1) * np.clip(away - 13.5, 0, 1)
    values[24:26, 21:23, 22:] = np.minimum(values[24:26, 21:23, 22:], 40)
    values[:, :2] = -1000  # air beside the tissue
    path = tmp_path_factory.mktemp("solid") / "egg.nii.gz"
    clrecon.write_volume(Volume(np.rint(values).astype(np.int16), np.diag([1.0, 1.0, 1.0, 1.0])), path)
    return path


def mesh_egg(bone, folder, *options: object, device=None) -> int:
    """Mesh the egg to a.stl with further options; return the exit code."""
    given = [] if device is None else ["--device", device.index]
    return main(["mesh", *map(str, (bone, "-o", folder / "a.stl", *options, *given))])


def report_of_egg(bone, folder, *options: object, device) -> dict:
    assert mesh_egg(bone, folder, "--hu", 400, *options, "--report", folder / "r.json", device=device) == 0
    return json.loads((folder / "r.json").read_text())


def test_solid_mesh_of_a_hollow_egg_has_its_whole_volume_and_passes_its_gates(device, bone, tmp_path):
    report = report_of_egg(bone, tmp_path, "--solid", device=device)

    assert report["volume_ml"] == pytest.approx(SOLID_ML, rel=0.01)  # in voxels of 1 mm: measured 0.3 % more
    assert report["seconds"]["solid"] > 0.0
    assert [gate["name"] for gate in report["gates"] if gate["ok"] is False] == []


def test_mesh_of_a_hollow_egg_that_is_not_solid_has_the_volume_of_its_wall(device, bone, tmp_path):
    report = report_of_egg(bone, tmp_path, "--no-solid", device=device)

    hollow_ml = 1.1 * 4 / 3 * np.pi * 14.0**3 / 1000  # 28 mm wide
    assert report["volume_ml"] == pytest.approx(SOLID_ML - hollow_ml, rel=0.03)  # measured 1.4 % more
    assert "solid" not in report["volume"]


def test_words_of_a_solid_mesh_have_the_volume_and_share_that_was_filled(device, bone, tmp_path, printed):
    report = report_of_egg(bone, tmp_path, "--solid", device=device)

    facts = report["volume"]["solid"]
    printed().assert_output(round(facts["filled_ml"], 1), round(100 * facts["filled_share"], 0))


@pytest.mark.release
@pytest.mark.seconds
def test_print_of_a_hollow_egg_is_solid_unless_it_is_asked_to_be_hollow(device, bone, tmp_path):
    solid = report_of_egg(bone, tmp_path, "--for", "print", device=device)
    hollow = report_of_egg(bone, tmp_path, "--for", "print", "--no-solid", device=device)

    assert solid["volume_ml"] > 1.5 * hollow["volume_ml"]  # by radii of 18 and 14 mm 1.9 times as much


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--solid", "--below", "-400"], "--solid fills what lies within the values from one level on"),
        (["--solid", "--hu", "100:300"], "it goes with neither --below nor a range"),
        (["--solid", "--hu", "200,300"], "--solid takes one iso value, not 2"),
        (["--seal", "2"], "--seal closes pores for --solid: ask for that too"),
        (["--solid", "--seal", "0"], "the radius that closes pores is a length in mm above 0, not 0"),
        (["--solid", "--seal", "nan"], "the radius that closes pores is a length in mm above 0, not nan"),
        (["--solid", "--seal", "2mm"], "'2mm' is no number: write the length in mm, without a unit"),
    ],
)
def test_option_that_excludes_solid_is_refused_in_one_line(options, words, bone, tmp_path, capsys):
    assert mesh_egg(bone, tmp_path, *options) == 3
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not list(Path(tmp_path).iterdir())
