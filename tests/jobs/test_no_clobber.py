"""With ``--no-clobber`` nothing that exists is replaced: refused before any work, and by the last step too."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

import clrecon
from clrecon.cli.main import main
from clrecon.errors import OutputError
from clrecon.jobs.outputs import refuse_numbered
from clrecon.rendering.movies import stage_animation, write_animation
from clrecon.system.files import replace_file, stage_file
from clrecon.system.paths import keep_existing

FRAMES = [np.zeros((8, 8, 3), np.uint8)] * 2
MADE_BEFORE = b'{"generator": "clrecon phantom"}'
"""An older file, which a folder of a phantom may hold too."""

COMMANDS = {
    "mesh": ("mesh scan -o old.stl", "old.stl"),
    "report of a mesh": ("mesh scan -o new.stl --report old.json", "old.json"),
    "one of several meshes": ("mesh scan -o bone.stl --hu 200,350", "bone_350hu.stl"),
    "components": ("mesh scan -o bone.stl --split", "bone_002.stl"),
    "picture": ("render scan -o old.png", "old.png"),
    "one of several views": ("render scan -o bone.png --view left,right", "bone_right.png"),
    "depths": ("render scan -o new.png --depth old.npy", "old.npy"),
    "report of a picture": ("render scan -o new.png --report old.json", "old.json"),
    "movie": ("render scan --turntable old.gif", "old.gif"),
    "frames": ("render scan --turntable old", "old/frame_0000.png"),
    "phantom": ("phantom old --kind sphere --size 16 --slices 8", "old/truth.json"),
    "demo": ("demo old", "old/report.json"),
    "comparison": ("compare scan -o old", "old/report.json"),
    "report of a bench": ("bench --report old.json", "old.json"),
}
"""Commands, and the file that each would replace."""


@pytest.mark.fault_row(63)
@pytest.mark.parametrize(("command", "existing"), COMMANDS.values(), ids=COMMANDS)
def test_command_with_no_clobber_is_refused_before_any_work_where_a_file_exists(
    command: str, existing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither the input nor a device is looked for: there is none of either."""
    old = tmp_path / existing
    old.parent.mkdir(exist_ok=True)
    old.write_bytes(MADE_BEFORE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CLRECON_DEVICE", "no such device")

    assert main([*command.split(), "--no-clobber"]) == 6

    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.endswith("already and stays (--no-clobber): name another") or "exist already and stay" in line
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == {old: MADE_BEFORE}


@pytest.mark.fault_row(63)
def test_existing_mesh_of_a_label_is_refused_with_no_clobber_before_the_scan_is_read(
    tmp_path: Path, device: object
) -> None:
    from clrecon.jobs.mesh.job import make_mesh
    from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings

    labels = np.zeros((4, 5, 6), np.uint16)
    labels[1:3, 1:3, 1:3], labels[1:3, 1:3, 4:] = 1, 2
    nibabel = pytest.importorskip("nibabel")
    nibabel.save(nibabel.Nifti1Image(labels, np.eye(4)), tmp_path / "labels.nii")
    (tmp_path / "bone_label_2.stl").write_bytes(b"older")
    settings = MeshSettings(labels=LabelChoice(str(tmp_path / "labels.nii")), device=str(device.index))  # type: ignore[attr-defined]

    with refused(OutputError, "bone_label_2.stl", "no_clobber=True"):
        make_mesh(tmp_path / "no scan", tmp_path / "bone.stl", settings, no_clobber=True)


PHANTOM = ["--kind=sphere", "--size=16", "--slices=8", "-q"]


@pytest.mark.fault_row(63)
def test_phantom_in_a_new_folder_is_written_with_no_clobber(tmp_path: Path) -> None:
    assert main(["phantom", str(tmp_path / "ct"), *PHANTOM, "--no-clobber"]) == 0
    assert (tmp_path / "ct" / "truth.json").exists()


@pytest.mark.fault_row(63)
def test_phantom_over_an_earlier_one_is_refused_with_no_clobber_alone(tmp_path: Path) -> None:
    assert main(["phantom", str(tmp_path / "ct"), *PHANTOM]) == 0

    assert main(["phantom", str(tmp_path / "ct"), *PHANTOM, "--no-clobber"]) == 6
    assert main(["phantom", str(tmp_path / "ct"), *PHANTOM]) == 0


@pytest.mark.fault_row(63)
def test_frames_in_an_empty_folder_are_written_with_no_clobber(tmp_path: Path) -> None:
    (tmp_path / "turn").mkdir()

    assert write_animation(FRAMES, tmp_path / "turn", no_clobber=True) > 0

    assert len(list((tmp_path / "turn").iterdir())) == len(FRAMES)


@pytest.mark.fault_row(63)
def test_frames_over_earlier_ones_are_refused_with_no_clobber(tmp_path: Path) -> None:
    write_animation(FRAMES, tmp_path / "turn")
    with refused(OutputError, "turn", "no_clobber=True"):
        write_animation(FRAMES, tmp_path / "turn", no_clobber=True)


@pytest.fixture(params=["hard links", "no hard links"])
def file_system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system that has hard links, and one that refuses them."""

    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "not permitted")

    if request.param == "no hard links":
        monkeypatch.setattr(os, "link", refuse)


@pytest.mark.fault_row(63)
@pytest.mark.usefixtures("file_system")
def test_file_that_comes_before_the_last_step_stays_with_no_clobber(tmp_path: Path) -> None:
    target = tmp_path / "a.stl"

    with keep_existing(keep=True), stage_file(target, lambda stream: stream.write(b"new")) as staged:
        target.write_bytes(b"came meanwhile")
        with refused(OutputError, "a.stl", "no_clobber=True"):
            staged.commit()

    assert target.read_bytes() == b"came meanwhile"
    assert [path.name for path in tmp_path.iterdir()] == ["a.stl"]


@pytest.mark.fault_row(63)
@pytest.mark.usefixtures("file_system")
def test_new_file_is_written_with_no_clobber(tmp_path: Path) -> None:
    target = tmp_path / "a.stl"

    with keep_existing(keep=True):
        bytes_written = replace_file(target, lambda stream: stream.write(b"new"))

    assert bytes_written == len(b"new")
    assert target.read_bytes() == b"new"
    assert [path.name for path in tmp_path.iterdir()] == ["a.stl"]


@pytest.mark.fault_row(63)
def test_frames_that_come_before_the_last_step_stay_with_no_clobber(tmp_path: Path) -> None:
    with keep_existing(keep=True), stage_animation(FRAMES, tmp_path / "turn") as staged:
        write_animation(FRAMES[:1], tmp_path / "turn")
        with refused(OutputError, "turn", "no_clobber=True"):
            staged.commit()

    assert [path.name for path in (tmp_path / "turn").iterdir()] == ["frame_0000.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["turn"]


@pytest.mark.fault_row(63)
def test_one_of_many_writers_at_once_writes_with_no_clobber(tmp_path: Path) -> None:
    target = tmp_path / "a.stl"
    written: list[int] = []
    together = threading.Barrier(8)

    def write(number: int) -> None:
        with keep_existing(keep=True), stage_file(target, lambda stream: stream.write(b"%d" % number)) as staged:
            together.wait()
            try:
                staged.commit()
            except OutputError:
                return
            written.append(number)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    (first,) = written
    assert target.read_bytes() == b"%d" % first
    assert [path.name for path in tmp_path.iterdir()] == ["a.stl"]


SAVING = {
    "a.stl": clrecon.Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32)).save,
    "a.json": clrecon.TransferFunction([(0, 1, 1, 1, 0), (100, 1, 1, 1, 1)]).save,
}


@pytest.mark.fault_row(63)
@pytest.mark.parametrize("name", SAVING)
def test_save_from_python_is_refused_with_no_clobber_where_the_file_exists(name: str, tmp_path: Path) -> None:
    path, save = tmp_path / name, SAVING[name]
    path.write_bytes(b"older")

    with refused(OutputError, "no_clobber=True"):
        save(path, no_clobber=True)

    assert path.read_bytes() == b"older"


@pytest.mark.fault_row(63)
@pytest.mark.parametrize("name", SAVING)
def test_save_from_python_writes_a_new_file_with_no_clobber_as_without_it(name: str, tmp_path: Path) -> None:
    new, again, save = tmp_path / name, tmp_path / f"again_{name}", SAVING[name]
    again.write_bytes(b"older")

    save(new, no_clobber=True)
    save(again)

    assert new.read_bytes() == again.read_bytes()


@pytest.mark.fault_row(63)
def test_output_with_numbered_files_is_refused_only_with_no_clobber(tmp_path: Path) -> None:
    (tmp_path / "bone_001.stl").write_bytes(b"")

    refuse_numbered(tmp_path / "bone.stl")
    with keep_existing(keep=True), refused(OutputError, "bone.stl", "no_clobber=True", 1):  # one file
        refuse_numbered(tmp_path / "bone.stl")
