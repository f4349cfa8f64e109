"""``clrecon mesh --solid`` without labels: what it fills and says, what it is refused with, and for print."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from clrecon.cli.main import main
from clrecon.geometry import Volume


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


def run(*arguments: object, device=None) -> int:
    given = [] if device is None else ["--device", device.index]
    return main(["mesh", *map(str, (*arguments, *given))])


def test_solid_fills_and_says_how_much(device, bone, tmp_path, printed):
    reports = {}
    for option in ("--no-solid", "--solid"):
        path = tmp_path / f"{option}.json"
        assert run(bone, "-o", tmp_path / "a.stl", "--hu", 400, option, "--report", path, device=device) == 0
        reports[option] = json.loads(path.read_text())
    said = printed()
    assert "solid" not in reports["--no-solid"]["volume"]
    facts = reports["--solid"]["volume"]["solid"]
    said.assert_output(round(facts["filled_ml"], 1), round(100 * facts["filled_share"], 0))
    true_ml = 1.1 * 4 / 3 * np.pi * 18.0**3 / 1000
    assert reports["--solid"]["volume_ml"] == pytest.approx(true_ml, rel=0.01)
    assert reports["--no-solid"]["volume_ml"] < 0.65 * true_ml
    assert reports["--solid"]["seconds"]["solid"] > 0.0
    assert [gate for gate in reports["--solid"]["gates"] if gate["ok"] is False] == []


@pytest.mark.release
@pytest.mark.seconds
def test_for_print_is_solid_unless_it_shall_not_be(device, bone, tmp_path, printed):
    ml = {}
    for option in ([], ["--no-solid"]):
        path = tmp_path / "r.json"
        code = run(
            bone, "-o", tmp_path / "a.stl", "--for", "print", "--hu", 400, *option, "--report", path, device=device
        )
        assert code == 0, printed()
        ml[bool(option)] = json.loads(path.read_text())["volume_ml"]
    assert ml[False] > 1.5 * ml[True]


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
def test_options_that_exclude_solid_are_refused_in_one_line(options, words, bone, tmp_path, capsys):
    assert run(bone, "-o", tmp_path / "a.stl", *options) == 3
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert not list(Path(tmp_path).iterdir())
