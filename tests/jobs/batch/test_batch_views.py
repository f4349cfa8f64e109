"""``clrecon batch --state``: each case is drawn as a view of one scan was saved, framed anew, and --resume knows it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_files import write_nifti
from PIL import Image

from clrecon.cli.main import main
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.view import ViewSettings
from clrecon.viewer.session.opening import open_view

PATIENCE = 60.0
"""Seconds for work in the background of a busy machine."""

SIDE = "360"
"""Pixels of the picture of a case."""


@pytest.fixture(scope="module")
def cohort(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A manifest of two equal steps of bone, the second 296 mm away, and plain.view.json of the first one.

    It is seen from the left in red at 250 HU, and the upper third is clipped.  zoomed.view.json has twice the size and
    a measure.
    """
    folder = tmp_path_factory.mktemp("views")
    voxels = np.full((24, 24, 24), -1000, np.int16)
    voxels[6:18, 6:18, 6:12] = voxels[6:12, 6:18, 6:18] = 400
    for name, origin in (("first.nii", (0.0, 0.0, 0.0)), ("second.nii", (256.0, -128.0, 64.0))):
        affine = np.diag([2.0, 2.0, 2.0, 1.0])
        affine[:3, 3] = origin
        write_nifti(folder / name, voxels, affine)
    (folder / "m.csv").write_text("case,input\nA,first.nii\nB,second.nii\n")
    with (
        open_view([folder / "first.nii"], ViewSettings(scan=MeshSettings(device="0"))) as view,
        view.session() as session,
    ):
        for command in (
            {"do": "set_mode", "name": "surface"},
            {"do": "set_iso", "hu": 250.0},
            {"do": "set_color", "key": "1", "rgb": [1.0, 0.0, 0.0]},
            {"do": "look", "view": "left"},
            {"do": "add_clip", "direction": "superior"},
            {"do": "move_clip", "n": 0, "share": 0.7},
        ):
            session.do(command)
        save(session, folder / "plain.view.json")
        session.do({"do": "zoom", "factor": 2.0, "at": [0.1, 0.1]})
        save(session, folder / "zoomed.view.json")
    saved = json.loads((folder / "zoomed.view.json").read_text())
    points = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]
    saved["measures"] = [{"kind": "distance", "name": "", "points_lps_mm": points, "thickness_mm": 0.0}]
    (folder / "zoomed.view.json").write_text(json.dumps(saved))
    return folder


def save(session: Any, path: Path) -> None:
    session.do({"do": "save", "path": str(path), "size": [360, 360]})
    assert session.wait(PATIENCE)


def run_batch(cohort: Path, output: Path, view: str, *options: str) -> int:
    command = ["batch", str(cohort / "m.csv"), "-o", str(output), "--hu", "300", "--no-mesh", "--no-measure"]
    return main([*command, "--state", str(cohort / view), "--device", "0", *options])


@pytest.fixture(scope="module")
def output(cohort: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a batch makes with the zoomed view."""
    folder = tmp_path_factory.mktemp("output")
    assert run_batch(cohort, folder, "zoomed.view.json", "-q") == 0
    return folder


@pytest.mark.seconds
def test_picture_of_a_case_is_that_of_render_from_the_side_of_the_saved_view_framed_anew(
    cohort: Path, output: Path, tmp_path: Path
) -> None:
    command = ["render", str(cohort / "first.nii"), "--state", str(cohort / "plain.view.json"), "--size", SIDE]
    assert main([*command, "-o", str(tmp_path / "a.png"), "--device", "0", "-q"]) == 0

    assert (output / "A" / "picture.png").read_bytes() == (tmp_path / "a.png").read_bytes()


@pytest.fixture(scope="module")
def labelled(cohort: Path) -> Path:
    """The cohort with a label map of the first scan, labelled.csv that names it, and labelled.view.json: the labels
    alone, the first of the two hidden.
    """
    voxels = np.zeros((24, 24, 24), np.uint8)
    voxels[6:18, 6:18, 6:12], voxels[6:12, 6:18, 12:18] = 1, 2
    write_nifti(cohort / "labels.nii", voxels, np.diag([2.0, 2.0, 2.0, 1.0]))
    (cohort / "labelled.csv").write_text("case,input,labels\nA,first.nii,labels.nii\n")
    scan = MeshSettings(device="0", labels=LabelChoice(str(cohort / "labels.nii")))
    with open_view([cohort / "first.nii"], ViewSettings(scan=scan)) as view, view.session() as session:
        hidden = next(part["key"] for part in session.facts()["parts"] if part["kind"] == "label")
        for command in ({"do": "set_mode", "name": "labels"}, {"do": "show", "key": hidden, "visible": False}):
            session.do(command)
        session.do({"do": "look", "view": "left"})
        save(session, cohort / "labelled.view.json")
    return cohort


@pytest.mark.seconds
def test_picture_of_a_labelled_case_has_the_size_asked_for_and_is_that_of_the_view(
    labelled: Path, tmp_path: Path
) -> None:
    state = ["--state", str(labelled / "labelled.view.json"), "--size", "200x160", "--device", "0", "-q"]
    seen = ["view", str(labelled / "first.nii"), "--labels", str(labelled / "labels.nii"), *state]
    assert main([*seen, "--picture", str(tmp_path / "a.png")]) == 0

    output = ["-o", str(tmp_path / "out"), "--hu", "300", "--no-mesh", "--no-measure"]
    assert main(["batch", str(labelled / "labelled.csv"), *output, *state]) == 0

    picture = tmp_path / "out" / "A" / "picture.png"
    assert Image.open(picture).size == (200, 160)
    assert (np.array(Image.open(picture))[..., 3] > 0).mean() > 0.05  # the label that is shown
    assert picture.read_bytes() == (tmp_path / "a.png").read_bytes()


@pytest.mark.seconds
def test_same_scan_at_another_place_has_the_same_pixels(output: Path) -> None:
    first, second = (np.array(Image.open(output / case / "picture.png")) for case in ("A", "B"))

    assert (first[..., 0] > 100).mean() > 0.1  # the red bone covers 19 % of the picture
    np.testing.assert_array_equal(second, first)


@pytest.mark.seconds
@pytest.mark.parametrize(("view", "made"), [("zoomed.view.json", 0), ("bone.view.json", 2)])
def test_resume_makes_cases_again_where_the_saved_view_shows_something_else(
    view: str, made: int, cohort: Path, output: Path, printed: Any
) -> None:
    saved = json.loads((cohort / "zoomed.view.json").read_text())
    (cohort / "bone.view.json").write_text(json.dumps(saved | {"mode": "bone"}))
    printed()

    assert run_batch(cohort, output, view, "--resume", "--json") == 0

    assert printed().report()["made"] == made


REFUSED = {
    "of a mesh": ({"objects": ["mesh"]}, (), 4, "mesh"),
    "label map that no case has": ({"objects": ["scan", "labels"]}, (), 3, "labels"),
    "damaged": ({"parts": None}, (), 4, "damaged"),
    "beside a view": ({}, ("--view", "left"), 3, "--view"),
    "without pictures": ({}, ("--no-picture",), 3, "--no-picture"),
    "picture without a row": ({}, ("--size", "10x0"), 3, "16384"),
}


@pytest.mark.parametrize(("changes", "options", "code", "fact"), REFUSED.values(), ids=REFUSED)
def test_saved_view_that_no_case_can_be_drawn_with_is_refused_before_any_case(
    changes: dict[str, Any], options: tuple[str, ...], code: int, fact: str, cohort: Path, tmp_path: Path, printed: Any
) -> None:
    saved = json.loads((cohort / "plain.view.json").read_text())
    (cohort / "changed.view.json").write_text(json.dumps(saved | changes))

    assert run_batch(cohort, tmp_path / "out", "changed.view.json", *options) == code

    printed().assert_error(fact)
    assert not (tmp_path / "out").exists()
