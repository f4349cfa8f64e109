"""``clrecon render --sheet`` and ``--mode slice`` with labels: colours, opacities, and what is said of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from printed_text import Printer

from clrecon.cli.main import main
from clrecon.proof.phantom import PhantomSettings, write_phantom


@pytest.fixture(scope="module")
def spine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a CT of L2 and L3, with levels.nrrd, a map of their labels 21 and 22."""
    folder = tmp_path_factory.mktemp("labels") / "ct"
    write_phantom(folder, PhantomSettings(size=(48, 48), spacing=(4.0, 4.0, 4.0), levels="L2-L3"))
    return folder


@pytest.fixture
def sheet_command(spine: Path, device: Any) -> list[str]:
    """The words for six sagittal slices of the spine in one picture."""
    return ["render", str(spine), "--sheet", "6", "--view", "sagittal", "--device", str(device.index)]


def colours_of(path: Path) -> np.ndarray:
    """Pixels whose channels differ: those of labels, as HU are grey."""
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    return image[np.ptp(image, axis=-1) > 40]


@pytest.mark.release
@pytest.mark.seconds
def test_sheet_without_labels_is_grey(sheet_command: list[str], tmp_path: Path) -> None:
    assert main([*sheet_command, "-o", str(tmp_path / "a.png")]) == 0
    assert len(colours_of(tmp_path / "a.png")) == 0


@pytest.mark.release
@pytest.mark.seconds
def test_sheet_with_labels_has_coloured_pixels_and_names_them_in_words_and_report(
    sheet_command: list[str], spine: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--labels", str(spine / "levels.nrrd"), "--report", str(tmp_path / "r.json")]

    assert main([*sheet_command, *options, "-o", str(tmp_path / "a.png")]) == 0

    assert len(colours_of(tmp_path / "a.png")) > 15_000  # pixels; measured 31,580
    (picture,) = json.loads((tmp_path / "r.json").read_text())["pictures"]
    assert len(picture["tiles"]) == 6
    assert {label["label_number"] for label in picture["labels"]} == {21, 22}
    output = capsys.readouterr().out
    assert "6 slices of " in output
    assert " L2 (21)" in output and " L3 (22)" in output


@pytest.mark.release
@pytest.mark.seconds
def test_sheet_with_a_colour_for_one_label_shows_it_alone_in_this_colour(
    sheet_command: list[str], spine: Path, tmp_path: Path, printed: Printer
) -> None:
    options = ["--labels", str(spine / "levels.nrrd"), "--label-color", "L3=red"]

    assert main([*sheet_command, *options, "-o", str(tmp_path / "a.png")]) == 0

    red, green, blue = colours_of(tmp_path / "a.png").T
    assert len(red) > 0
    assert (red > green).all() and (red > blue).all()
    assert " L2 (21)" not in printed().everything


@pytest.mark.slow
def test_label_over_slices_is_stronger_with_its_opacity_and_has_no_outline_at_0(
    sheet_command: list[str], spine: Path, tmp_path: Path
) -> None:
    def colours_at(opacity: str) -> np.ndarray:
        options = [
            "--labels",
            str(spine / "levels.nrrd"),
            "--label-color",
            "L3=red",
            "--label-opacity",
            f"L3={opacity}",
        ]
        assert main([*sheet_command, *options, "-o", str(tmp_path / "a.png")]) == 0
        return colours_of(tmp_path / "a.png")

    hidden, faint, full = colours_at("0"), colours_at("0.3"), colours_at("1")

    assert len(hidden) == 0
    assert np.ptp(faint, axis=-1).mean() < np.ptp(full, axis=-1).mean()  # from grey


def test_label_that_is_not_in_the_map_is_refused_with_those_that_are(
    spine: Path, tmp_path: Path, printed: Printer
) -> None:
    given = ["--sheet", "4", "--labels", str(spine / "levels.nrrd"), "--label-color", "L9=red"]
    assert main(["render", str(spine), *given, "-o", str(tmp_path / "a.png")]) == 3
    said = printed()
    assert said.error_lines == 1
    said.assert_error("L9", 21, "L2", 22, "L3")
    assert not (tmp_path / "a.png").exists()
