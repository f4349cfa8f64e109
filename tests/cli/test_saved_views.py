"""``clrecon view --state`` and ``--picture``: a saved view is opened and drawn again, and wrong options are refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from printed_text import Printer

import clrecon
from clrecon.cli.main import main
from clrecon.geometry import Volume
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.view import ViewSettings
from clrecon.proof.phantom import PhantomSettings, write_phantom
from clrecon.viewer.session.opening import OpenedView, open_view
from clrecon.viewer.session.session import ViewSession

PATIENCE = 60.0
"""Seconds for work in the background of a busy machine."""

SIZE = (160, 120)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A spine of several components."""
    folder = tmp_path_factory.mktemp("view") / "ct"
    write_phantom(folder, PhantomSettings(kind="spine", size=(96, 96), slices=40, spacing=(1.6, 1.6, 2.0)))
    return folder


def open_scan(scan: Path, device: Any, state: Path | None = None) -> OpenedView:
    settings = MeshSettings(device=str(device.index))
    return open_view([scan], ViewSettings(scan=settings, state=None if state is None else str(state)))


def save(session: ViewSession, path: Path) -> None:
    session.do({"do": "save", "path": str(path), "size": list(SIZE)})
    assert session.wait(PATIENCE)
    assert session.facts()["error"] is None


@pytest.fixture(scope="module")
def saved(device: Any, scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with shown.view.json and shown.png: from the left, a part red, one hidden, cut, without the table."""
    folder = tmp_path_factory.mktemp("saved")
    with open_scan(scan, device) as view, view.session() as session:
        session.do({"do": "set_table", "shown": False})
        assert session.wait(PATIENCE)
        session.do({"do": "find_parts"})
        assert session.wait(PATIENCE)
        session.do({"do": "look", "view": "left"})
        session.do({"do": "set_color", "key": "1/1", "rgb": [1.0, 0.0, 0.0]})
        session.do({"do": "show", "key": "1/2", "visible": False})
        session.do({"do": "add_clip", "direction": "superior"})
        save(session, folder / "shown.view.json")
        save(session, folder / "shown.png")
    return folder


@pytest.mark.opencl
@pytest.mark.parametrize(("command", "option"), [("view", "--picture"), ("render", "-o")])
def test_picture_of_a_saved_view_is_the_one_that_the_view_saved(
    command: str, option: str, device: Any, scan: Path, saved: Path, tmp_path: Path
) -> None:
    arguments = [command, str(scan), "--state", str(saved / "shown.view.json"), option, str(tmp_path / "again.png")]

    assert main([*arguments, "--size", "160x120", "--device", str(device.index)]) == 0

    assert (tmp_path / "again.png").read_bytes() == (saved / "shown.png").read_bytes()


RENDERED = {
    "preset": (["-o", "a.png", "--preset", "spine"], "--preset"),
    "camera": (["-o", "a.png", "--zoom", "2"], "--zoom"),
    "report": (["-o", "a.png", "--report", "a.json"], "--report"),
    "colour of a mesh": (["-o", "a.png", "--mesh", "a.stl=red"], "--mesh"),
    "no picture": ([], "-o"),
}


@pytest.mark.parametrize(("options", "fact"), RENDERED.values(), ids=RENDERED)
def test_render_with_a_saved_view_refuses_what_the_view_says_itself(
    options: list[str], fact: str, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printer
) -> None:
    monkeypatch.chdir(tmp_path)

    assert main(["render", str(scan), "--state", "shown.view.json", *options]) == 3

    printed().assert_error(fact)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.opencl
def test_view_opened_with_a_saved_view_saves_the_same_again(
    device: Any, scan: Path, saved: Path, tmp_path: Path
) -> None:
    with open_scan(scan, device, saved / "shown.view.json") as view, view.session() as session:
        assert session.wait(PATIENCE)
        save(session, tmp_path / "again.view.json")

    before, after = (json.loads((folder / name).read_text()) for folder, name in
                     ((saved, "shown.view.json"), (tmp_path, "again.view.json")))  # fmt: skip
    assert after == before


@pytest.mark.opencl
def test_picture_without_a_saved_view_is_the_first_of_the_view(device: Any, scan: Path, tmp_path: Path) -> None:
    with open_scan(scan, device) as view, view.session() as session:
        session.fit(SIZE)
        save(session, tmp_path / "first.png")

    arguments = ["view", str(scan), "--picture", str(tmp_path / "drawn.png"), "--size", "160x120"]
    assert main([*arguments, "--device", str(device.index)]) == 0

    assert (tmp_path / "drawn.png").read_bytes() == (tmp_path / "first.png").read_bytes()


def test_input_that_is_no_saved_view_is_refused_before_anything_is_served(tmp_path: Path, printed: Any) -> None:
    (tmp_path / "shown.view.json").write_text("{}")

    assert main(["view", str(tmp_path / "shown.view.json"), "--no-open"]) == 4

    printed().assert_error("shown.view.json", "schema")


@pytest.mark.opencl
def test_saved_view_among_the_inputs_is_that_of_the_others(
    device: Any, scan: Path, saved: Path, tmp_path: Path
) -> None:
    arguments = ["view", str(saved / "shown.view.json"), str(scan), "--picture", str(tmp_path / "again.png")]

    assert main([*arguments, "--size", "160x120", "--device", str(device.index)]) == 0

    assert (tmp_path / "again.png").read_bytes() == (saved / "shown.png").read_bytes()


@pytest.mark.opencl
def test_view_of_a_scan_begins_with_bone_without_the_table_and_says_what_was_taken(device: Any, tmp_path: Path) -> None:
    _, j, i = np.indices((24, 64, 64)) - 32
    radius = np.hypot(i, j)
    voxels = np.select([radius < 5, radius < 20, (abs(j - 26) < 2) & (abs(i) < 24)], [700, 40, 300], -1000)
    clrecon.write_volume(Volume(voxels.astype(np.int16), np.diag([2.0, 2.0, 2.0, 1.0])), tmp_path / "table.nii.gz")

    with open_scan(tmp_path / "table.nii.gz", device) as view, view.session() as session:
        facts = session.do({"do": "undo"})

        assert (session.model.state.mode, session.model.state.table) == ("bone", False)
        assert "27 ml of table and blankets taken away" in facts["said"]  # 24 x 3 x 47 voxels of 8 cubic mm
        assert facts["undone"] is None  # the table and the mode of the start are no step


@pytest.mark.opencl
def test_view_of_a_scan_without_a_table_says_nothing_of_one(device: Any, scan: Path) -> None:
    with open_scan(scan, device) as view, view.session() as session:
        assert session.facts()["said"] is None


@pytest.mark.opencl
def test_view_brings_the_table_of_the_first_picture_back_by_a_command(device: Any, scan: Path) -> None:
    with open_scan(scan, device) as view, view.session() as session:
        session.do({"do": "toggle_table"})

        assert session.model.state.table


@pytest.mark.opencl
def test_view_with_an_iso_value_begins_with_the_surface_of_the_whole_scan(device: Any, scan: Path) -> None:
    settings = MeshSettings(device=str(device.index), iso_value=250.0)
    with open_view([scan], ViewSettings(scan=settings)) as view, view.session() as session:
        assert (session.model.state.mode, session.model.state.table) == ("surface", True)


@pytest.mark.opencl
def test_view_of_a_scan_without_a_body_begins_with_all_of_it_and_says_why(device: Any, tmp_path: Path) -> None:
    voxels = np.full((8, 16, 16), -1000, np.int16)
    voxels[3:5, 7:9, 7:9] = 50
    clrecon.write_volume(Volume(voxels, np.eye(4)), tmp_path / "ct.nii.gz")

    with open_scan(tmp_path / "ct.nii.gz", device) as view, view.session() as session:
        assert session.model.state.table
        assert any("the table is shown" in words for words in view.said)


REFUSED = {
    "picture and page": (["--picture", "a.png", "--html", "a.html"], 3, "--html"),
    "picture and window": (["--picture", "a.png", "--window"], 3, "--window"),
    "saved view and page": (["--state", "a.view.json", "--html", "a.html"], 3, "--state"),
    "size without a picture": (["--size", "100"], 3, "--picture"),
    "size that is none": (["--picture", "a.png", "--size", "large"], 3, "large"),
    "picture of an animation": (["--picture", "a.gif"], 3, ".gif"),
    "picture and port": (["--picture", "a.png", "--port", "8000"], 3, "--port"),
    "two saved views": (["a.view.json", "--state", "b.view.json"], 3, "--state"),
    "saved view that is missing": (["--state", "gone.view.json", "--picture", "a.png"], 3, "gone.view.json"),
}


@pytest.mark.parametrize(("options", "code", "fact"), REFUSED.values(), ids=REFUSED)
def test_options_that_make_no_sense_are_refused_and_nothing_is_written(
    options: list[str],
    code: int,
    fact: str,
    scan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    printed: Printer,
) -> None:
    monkeypatch.chdir(tmp_path)

    assert main(["view", str(scan), *options]) == code

    printed().assert_error(fact)
    assert list(tmp_path.iterdir()) == []
