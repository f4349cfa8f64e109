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
COMMANDS = {
    "mesh": ("mesh scan -o {old}.stl", ".stl"),
    "report of a mesh": ("mesh scan -o new.stl --report {old}.json", ".json"),
    "one of several meshes": ("mesh scan -o bone.stl --hu 200,350", "bone_350hu.stl"),
    "components": ("mesh scan -o bone.stl --split", "bone_002.stl"),
    "picture": ("render scan -o {old}.png", ".png"),
    "one of several views": ("render scan -o bone.png --view left,right", "bone_right.png"),
    "depths": ("render scan -o new.png --depth {old}.npy", ".npy"),
    "report of a picture": ("render scan -o new.png --report {old}.json", ".json"),
    "movie": ("render scan --turntable {old}.gif", ".gif"),
    "frames": ("render scan --turntable {old}", "old/frame_0000.png"),
    "phantom": ("phantom {old} --kind sphere --size 16 --slices 8", "old/truth.json"),
    "demo": ("demo {old}", "old/report.json"),
    "comparison": ("compare scan -o {old}", "old/report.json"),
    "report of a bench": ("bench --report {old}.json", ".json"),
}


@pytest.mark.parametrize("what", COMMANDS)
def test_row_63_existing_outputs_are_refused_before_any_work(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither the input nor a device is looked for: there is none of either."""
    command, name = COMMANDS[what]
    old = tmp_path / (f"old{name}" if name.startswith(".") else name)
    old.parent.mkdir(exist_ok=True)
    old.write_bytes(b'{"generator": "clrecon phantom"}')
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CLRECON_DEVICE", "no such device")
    assert main([*command.format(old="old").split(), "--no-clobber"]) == 6
    told = capsys.readouterr()
    assert told.out == "" and told.err.count("\n") == 1
    assert told.err.endswith("already and stays (--no-clobber): name another\n") or "exist already and stay" in told.err
    assert old.read_bytes() == b'{"generator": "clrecon phantom"}'
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [old]


def test_row_63_labels_are_refused_before_the_scan_is_read(tmp_path: Path, device: object) -> None:
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


def test_row_63_new_names_and_empty_folders_are_written(tmp_path: Path) -> None:
    (tmp_path / "turn").mkdir()
    assert write_animation(FRAMES, tmp_path / "turn", no_clobber=True) > 0
    assert (
        main(["phantom", str(tmp_path / "ct"), "--kind=sphere", "--size=16", "--slices=8", "--no-clobber", "-q"]) == 0
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ct", "turn"]
    assert (
        main(["phantom", str(tmp_path / "ct"), "--kind=sphere", "--size=16", "--slices=8", "--no-clobber", "-q"]) == 6
    )
    assert main(["phantom", str(tmp_path / "ct"), "--kind=sphere", "--size=16", "--slices=8", "-q"]) == 0
    with refused(OutputError, "turn", "no_clobber=True"):
        write_animation(FRAMES, tmp_path / "turn", no_clobber=True)


@pytest.mark.parametrize("links", [True, False], ids=["links", "no links"])
def test_row_63_a_file_that_comes_meanwhile_stays(links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "not permitted")

    if not links:
        monkeypatch.setattr(os, "link", refuse)
    target = tmp_path / "a.stl"
    with keep_existing(), stage_file(target, lambda stream: stream.write(b"new")) as staged:
        target.write_bytes(b"came meanwhile")
        with refused(OutputError, "a.stl", "no_clobber=True"):
            staged.commit()
    assert target.read_bytes() == b"came meanwhile"
    target.unlink()
    with keep_existing():
        assert replace_file(target, lambda stream: stream.write(b"new")) == 3
    assert target.read_bytes() == b"new" and [path.name for path in tmp_path.iterdir()] == ["a.stl"]


def test_row_63_frames_that_come_meanwhile_stay(tmp_path: Path) -> None:
    with keep_existing(), stage_animation(FRAMES, tmp_path / "turn") as staged:
        write_animation(FRAMES[:1], tmp_path / "turn")
        with refused(OutputError, "turn", "no_clobber=True"):
            staged.commit()
    assert [path.name for path in (tmp_path / "turn").iterdir()] == ["frame_0000.png"]
    assert [path.name for path in tmp_path.iterdir()] == ["turn"]


def test_row_63_of_many_writers_one_wins(tmp_path: Path) -> None:
    target, won, together = tmp_path / "a.stl", [], threading.Barrier(8)

    def write(number: int) -> None:
        with keep_existing(), stage_file(target, lambda stream: stream.write(b"%d" % number)) as staged:
            together.wait()
            try:
                staged.commit()
            except OutputError:
                return
            won.append(number)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(won) == 1 and target.read_bytes() == b"%d" % won[0]
    assert [path.name for path in tmp_path.iterdir()] == ["a.stl"]


def test_row_63_python_functions_replace_no_file_with_no_clobber(tmp_path: Path) -> None:
    mesh = clrecon.Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.uint32))
    function = clrecon.TransferFunction([(0, 1, 1, 1, 0), (100, 1, 1, 1, 1)])
    for path, save in ((tmp_path / "a.stl", mesh.save), (tmp_path / "a.json", function.save)):
        save(path, no_clobber=True)
        before = path.read_bytes()
        with refused(OutputError, "no_clobber=True"):
            save(path, no_clobber=True)
        save(path)
        assert path.read_bytes() == before


def test_row_63_numbered_files_are_replaced_unless_they_are_kept(tmp_path: Path) -> None:
    (tmp_path / "bone_001.stl").write_bytes(b"")
    refuse_numbered(tmp_path / "bone.stl")
    with keep_existing(), refused(OutputError, "bone.stl", "no_clobber=True", 1):
        refuse_numbered(tmp_path / "bone.stl")
