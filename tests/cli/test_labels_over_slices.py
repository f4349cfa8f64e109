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
    folder = tmp_path_factory.mktemp("labels") / "ct"
    write_phantom(folder, PhantomSettings(size=(48, 48), spacing=(4.0, 4.0, 4.0), levels="L2-L3"))
    return folder


def colours_of(path: Path) -> np.ndarray:
    """Pixels whose channels differ: those of labels, as HU are grey."""
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    return image[np.ptp(image, axis=-1) > 40]


@pytest.mark.release
@pytest.mark.seconds
def test_a_sheet_shows_its_labels_in_their_colours_and_names_them(
    spine: Path, tmp_path: Path, device: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["render", str(spine), "--sheet", "6", "--view", "sagittal", "--device", str(device.index)]
    labels = ["--labels", str(spine / "levels.nrrd")]
    plain, drawn, one = (tmp_path / name for name in ("plain.png", "drawn.png", "one.png"))
    assert main([*common, "-o", str(plain)]) == 0
    assert len(colours_of(plain)) == 0
    capsys.readouterr()
    assert main([*common, *labels, "-o", str(drawn), "--report", str(tmp_path / "r.json")]) == 0
    said = capsys.readouterr().out
    assert "6 slices of " in said and " L2 (21)" in said and " L3 (22)" in said
    (picture,) = json.loads((tmp_path / "r.json").read_text())["pictures"]
    assert len(picture["tiles"]) == 6 and {each["label_number"] for each in picture["labels"]} == {21, 22}
    assert len(colours_of(drawn)) > 200
    assert main([*common, *labels, "--label-color", "L3=red", "-o", str(one)]) == 0
    red = colours_of(one)
    assert 0 < len(red) < len(colours_of(drawn)) and (red[:, 0] > red[:, 1]).all() and (red[:, 0] > red[:, 2]).all()
    assert " L2 (21)" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_hidden_label_leaves_no_outline(spine: Path, tmp_path: Path, device: Any) -> None:
    common = ["render", str(spine), "--sheet", "6", "--view", "sagittal", "--device", str(device.index)]
    common += ["--labels", str(spine / "levels.nrrd"), "--label-color", "L3=red"]
    found = {}
    for share in ("0", "0.3", "1"):
        assert main([*common, "--label-opacity", f"L3={share}", "-o", str(tmp_path / "a.png")]) == 0
        found[share] = colours_of(tmp_path / "a.png")
    assert len(found["0"]) == 0 and np.ptp(found["0.3"], axis=-1).mean() < np.ptp(found["1"], axis=-1).mean()


def test_a_label_that_is_not_in_the_map_is_refused(spine: Path, tmp_path: Path, printed: Printer) -> None:
    given = ["--sheet", "4", "--labels", str(spine / "levels.nrrd"), "--label-color", "L9=red"]
    assert main(["render", str(spine), *given, "-o", str(tmp_path / "a.png")]) == 3
    said = printed()
    assert said.error_lines == 1
    said.assert_error("L9", 21, "L2", 22, "L3")
    assert not (tmp_path / "a.png").exists()
