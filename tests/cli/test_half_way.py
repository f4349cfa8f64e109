"""``--hu auto`` and ``--hu half:BONE,TISSUE``: what they make, say and refuse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import ct_files
import pytest
import tolerances
from printed_text import Printer

from clrecon.cli.main import main
from clrecon.jobs.options import parse_hu

BONE_HU, TISSUE_HU = 700, 0


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball of `BONE_HU` in water of `TISSUE_HU`."""
    voxels = ct_files.sphere_voxels((17, 31, 37))
    inside = (voxels - ct_files.OUTSIDE_HU) / (ct_files.INSIDE_HU - ct_files.OUTSIDE_HU)
    hu = TISSUE_HU + inside * (BONE_HU - TISSUE_HU)
    return ct_files.write_series(tmp_path_factory.mktemp("ct"), hu.round().astype("int16"))


def run_mesh(ct: Path, device: Any, tmp_path: Path, *arguments: str) -> int:
    return main(["mesh", str(ct), "-o", str(tmp_path / "b.stl"), "--device", str(device.index), *arguments])


def test_words_of_auto_have_the_iso_value_and_the_materials_it_lies_half_way_between(
    ct: Path, device: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_mesh(ct, device, tmp_path, "--hu", "auto") == 0
    shown = capsys.readouterr().out
    (line,) = [line for line in shown.splitlines() if line.startswith("surface")]
    level = float(line.split()[1])
    half_way = (BONE_HU + TISSUE_HU) / 2
    assert abs(level - half_way) <= tolerances.HALF_WAY_STEP_SHARE * (BONE_HU - TISSUE_HU)
    assert "HU (auto: half way between tissue 0 and bone 700 HU), closed" in line


def test_half_of_two_given_materials_is_reported_with_a_warning_where_one_is_not_in_the_scan(
    ct: Path, device: Any, tmp_path: Path, printed: Printer
) -> None:
    assert run_mesh(ct, device, tmp_path, "--hu", "half:700,-100", "--json") == 0

    report = printed().report()
    assert report["iso_value_hu"] == (700 - 100) / 2
    assert report["iso_value_choice"]["method"] == "half"
    assert "tissue was given as -100 HU, but the volume runs from 0 to 700 HU" in report["warnings"][0]


def test_words_of_half_have_the_iso_value_and_both_materials(
    ct: Path, device: Any, tmp_path: Path, printed: Printer
) -> None:
    assert run_mesh(ct, device, tmp_path, "--hu", "half:700,0") == 0
    printed().assert_output((700 + 0) / 2, 0, 700)


def test_auto_without_bone_ends_with_2_and_writes_nothing(device: Any, tmp_path: Path, printed: Printer) -> None:
    voxels = ct_files.sphere_voxels() * 0 + 8
    voxels[0, 0, 0] = 9
    water = ct_files.write_series(tmp_path / "water", voxels)
    assert run_mesh(water, device, tmp_path, "--hu", "auto") == 2
    message = printed()
    message.assert_error(8, "--hu")
    assert not (tmp_path / "b.stl").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("half:1200", "does not name two materials"),
        ("half:1200,40,3", "does not name two materials"),
        ("half:bone,muscle", "'bone' in 'bone,muscle' is no number of HU"),
        ("auto,300", "'auto' in 'auto,300' is no number of HU"),
        ("Auto", "'Auto' is no number of HU"),
    ],
)
def test_text_that_is_no_iso_value_and_no_pair_of_materials_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse_hu(text)


@pytest.mark.parametrize(
    ("text", "setting"),
    [
        ("200,350.5", {"iso_value": (200.0, 350.5)}),
        ("-150", {"iso_value": (-150.0,)}),
        ("auto", {"half_way": "auto"}),
        ("half:1200,-40", {"half_way": (1200.0, -40.0)}),
    ],
)
def test_option_hu_takes_iso_values_auto_or_two_materials(text: str, setting: dict[str, Any]) -> None:
    assert parse_hu(text) == setting


def test_bone_with_fewer_hu_than_tissue_is_refused(ct: Path, tmp_path: Path, printed: Printer) -> None:
    assert main(["mesh", str(ct), "-o", str(tmp_path / "b.stl"), "--hu", "half:40,1200"]) == 3
    printed().assert_error(40, 1200)
