"""``--hu A:B`` and ``--below N``: what they make, say and refuse."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import ct_files
import numpy as np
import pytest
from printed_text import Printer

from clrecon.cli.main import main
from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.options import parse_hu


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A body of water, with a lung that a wall of 30 mm parts from the air around."""
    k, j, i = np.indices((20, 100, 120))
    x, y = (i - 59.5) * ct_files.SPACING[0], (j - 49.5) * ct_files.SPACING[1]
    voxels = np.full(k.shape, -1000, np.int16)
    voxels[x**2 + y**2 < 40.0**2] = 40
    lung = x**2 + y**2 + ((k - 9.5) * ct_files.SPACING[2]) ** 2 < 10.0**2
    voxels[lung] = -850
    return ct_files.write_series(tmp_path_factory.mktemp("ct"), voxels)


def run_mesh(ct: Path, device: Any, tmp_path: Path, *arguments: str) -> int:
    return main(["mesh", str(ct), "-o", str(tmp_path / "b.stl"), "--device", str(device.index), *arguments])


def test_mesh_below_a_level_is_the_lung_without_the_air_about_the_body(
    ct: Path, device: Any, tmp_path: Path, printed: Printer
) -> None:
    assert run_mesh(ct, device, tmp_path, "--below", "-400", "--strict", "--json") == 0
    report = printed().report()
    assert (report["components"], report["inside_hu"]) == (1, [None, -400.0])
    assert report["iso_level_hu"] == -400.0 - 0.5  # between integers
    radius_cm = 1.0  # in voxels of 1 mm: measured 0.9 % less
    assert report["volume_ml"] == pytest.approx(4.0 / 3.0 * np.pi * radius_cm**3, rel=0.02)
    assert report["volume"]["outside_air"]["opening_mm2"] == 0.0
    assert any(text.startswith("air outside of the body was left out: ") for text in report["warnings"])
    assert not any("face" in text for text in report["warnings"])


def test_mesh_below_a_level_with_the_air_about_the_body_is_warned_of_as_one_that_can_show_a_face(
    ct: Path, device: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_mesh(ct, device, tmp_path, "--below", "-400", "--keep-outside") == 0
    shown = capsys.readouterr()
    assert "surface  below -400 HU (as given), closed" in shown.out
    assert "can show a face" in shown.err


def test_range_and_iso_value_of_one_command_are_a_file_each(
    ct: Path, device: Any, tmp_path: Path, printed: Printer
) -> None:
    assert run_mesh(ct, device, tmp_path, "--hu", "-900:-700,0", "-v") == 0
    printed().assert_output(-900, -700, 0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b_-900to-700hu.stl", "b_0hu.stl"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("100:", "'100:' is no range A:B of two numbers of HU; from A on is iso_value=A, below B is below=B"),
        (":300", "':300' is no range"),
        ("200,1:2:3", "'1:2:3' in '200,1:2:3' is no range"),
        ("100:b", "'b' in '100:b' is no number of HU"),
    ],
)
def test_text_that_is_no_range_is_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match="is no") as caught:
        parse_hu(text)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"iso_value": ((300.0, 100.0),)}, "the range 300:100 HU holds nothing"),
        ({"iso_value": ((100.0, 300.0), (100.0, 300.0))}, "the iso value 100:300 HU is given twice"),
        ({"iso_value": ((100.0, 300.0),), "topology": "trilinear"}, "the range 100:300 HU has two"),
        ({"iso_value": ((100.0, 300.0),), "labels": LabelChoice("a")}, "labels take one iso value"),
        ({"below": -400.0, "labels": LabelChoice("a")}, "not below it"),
        ({"below": -400.0, "iso_value": 200.0}, "not both"),
        ({"below": -400.0, "preset": "bone"}, "not both"),
        ({"below": (-400.0, -400.0)}, "given twice"),
        ({"below": ()}, "at least one"),
        ({"keep_outside": True}, "only left out of what lies below"),
    ],
)
def test_range_or_level_below_with_a_setting_that_excludes_it_is_refused(settings: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        MeshSettings(**settings)


@pytest.mark.parametrize(
    ("options", "facts"),
    [(["--below", "-400", "--hu", "200"], ("--below", "--hu")), (["--hu", "300:100"], (300, 100))],
    ids=["below and above", "range upside down"],
)
def test_levels_that_exclude_each_other_are_refused_with_exit_code_3(
    options: list[str], facts: tuple[str | int, ...], ct: Path, device: Any, tmp_path: Path, printed: Printer
) -> None:
    assert run_mesh(ct, device, tmp_path, *options) == 3
    printed().assert_error(*facts)
