"""Names of the files of a job; what stands in the way of what; all or nothing."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest
from refusals import refused

from clrecon.errors import OutputError, UsageError
from clrecon.jobs.mesh.job import make_mesh
from clrecon.jobs.mesh.make import first_names
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.jobs.mesh.surfaces import plan_surfaces
from clrecon.jobs.outputs import MOST_FILES, check_kept, check_outputs, commit_all, name_outputs
from clrecon.jobs.render.job import PictureFiles, make_pictures
from clrecon.jobs.render.settings import LabelLook, RenderSettings
from clrecon.system.files import stage_file

pytestmark = pytest.mark.unit


def names_of(levels: list[float], split: bool = False) -> list[str]:
    return [str(path) for path in name_outputs("a.b/bone.v2.stl", first_names(plan_surfaces(levels), split))]


def test_one_mesh_has_the_name_that_was_given() -> None:
    path = Path("x") / "bone.stl"
    assert name_outputs(path, [""]) == [path]
    assert names_of([226.5]) == ["a.b/bone.v2.stl"]


def test_names_of_several_meshes_differ_before_the_extension() -> None:
    assert names_of([200.0, 350]) == ["a.b/bone.v2_200hu.stl", "a.b/bone.v2_350hu.stl"]
    assert names_of([200.0], split=True) == ["a.b/bone.v2_001.stl"]
    assert names_of([-0.0, -150.5], split=True) == ["a.b/bone.v2_0hu_001.stl", "a.b/bone.v2_-150.5hu_001.stl"]


def test_close_iso_values_keep_all_their_digits() -> None:
    assert names_of([1234567.0, 1234568.0, 200.0000001]) == [
        f"a.b/bone.v2_{digits}hu.stl" for digits in ("1234567", "1234568", "200.0000001")
    ]


def test_two_meshes_are_never_one_file(tmp_path: Path) -> None:
    output = tmp_path / "bone.stl"
    with refused(UsageError, "T12", "mesh"):
        name_outputs(output, ["T12", "T12"])
    with refused(UsageError, "t12", "T12"):
        name_outputs(output, ["T12", "t12"])
    with refused(UsageError, "T12", "mesh"):
        name_outputs(output, ["L1", "T12"], tmp_path / "." / "bone_T12.stl")
    (tmp_path / "bone_L1.stl").symlink_to(tmp_path / "bone_T12.stl")
    with refused(UsageError, "T12", "L1"):
        check_outputs(output, None, ["L1", "T12"])


@pytest.mark.parametrize("name", ["../T12", "a/b", "a\\b", "/tmp"])
def test_a_name_stays_in_the_folder(name: str) -> None:
    with pytest.raises(UsageError, match="cannot be a part of the name of a file"):
        name_outputs("bone.stl", [name])


def test_too_many_files_are_refused() -> None:
    names = [f"{number}" for number in range(MOST_FILES + 1)]
    assert len(name_outputs("bone.stl", names[1:])) == MOST_FILES
    with refused(UsageError, 1001, 1000):
        name_outputs("bone.stl", names)


def test_outputs_are_checked_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "bone_350hu.stl").mkdir()
    with refused(OutputError, "bone_350hu.stl"):
        check_outputs(tmp_path / "bone.stl", None, ["200hu", "350hu"])
    (tmp_path / "bone.stl").mkdir()  # not a file of this job
    check_outputs(tmp_path / "bone.stl", tmp_path / "r.json", ["200hu", "400hu"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bone.stl", "bone_350hu.stl"]


@pytest.mark.parametrize("blocked", [0, 2])
def test_a_rename_that_fails_says_what_is_in_place(blocked: int, tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.stl" for number in range(3)]
    with ExitStack() as stack:
        files = [stack.enter_context(stage_file(path, lambda stream: stream.write(b"new"))) for path in paths]
        paths[blocked].mkdir()
        with pytest.raises(OutputError, match=r"2.stl: .* \(2 of 3 files" if blocked else r"0.stl: [^(]*$"):
            commit_all(files)
    there = [path.name for path in tmp_path.iterdir() if path.is_file()]
    assert sorted(there) == [path.name for path in paths[:blocked]]


@pytest.mark.skipif(os.name != "posix", reason="the limit of open files is that of POSIX systems")
def test_a_thousand_files_can_be_staged_at_once(tmp_path: Path) -> None:
    import resource

    from clrecon.system.files import allow_open_files

    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (200, limits[1]))
    try:
        allow_open_files(300)
        with ExitStack() as stack:
            files = [
                stack.enter_context(stage_file(tmp_path / f"{number}", lambda stream: stream.write(b"x")))
                for number in range(300)
            ]
            commit_all(files)
        assert len(list(tmp_path.iterdir())) == 300
        resource.setrlimit(resource.RLIMIT_NOFILE, (60, limits[1]))
        with refused(OutputError, "ulimit", "files"), ExitStack() as stack:
            for number in range(100):
                stack.enter_context(stage_file(tmp_path / f"{number}", lambda stream: stream.write(b"x")))
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def test_a_report_replaces_no_file_that_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All inputs stay what they are, also through a link; names that are no files count for nothing."""
    monkeypatch.chdir(tmp_path)
    for name in ("ct.nrrd", "labels.nrrd", "tf.json", "line.json"):
        (tmp_path / name).write_bytes(b"mine")
    (tmp_path / "link.json").symlink_to("ct.nrrd")
    for report in ("ct.nrrd", "link.json", "labels.nrrd"):
        with refused(UsageError, "report", report):
            make_mesh("ct.nrrd", "a.stl", MeshSettings(labels=LabelChoice("labels.nrrd")), report_path=report)
    for report, settings in {
        "ct.nrrd": RenderSettings.of(),
        "tf.json": RenderSettings.of(transfer_function="tf.json:bone"),
        "line.json": RenderSettings.of(curve="line.json"),
        "labels.nrrd": RenderSettings.of(labels=LabelLook("labels.nrrd")),
    }.items():
        with refused(UsageError, "report", report):
            make_pictures("ct.nrrd", PictureFiles("a.png", report=report), settings)
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"mine"} and len(list(tmp_path.iterdir())) == 5
    check_kept([("the report", "auto")], "ct.nrrd", *RenderSettings.of(curve="auto").files_read)
    check_kept([("the report", None)], "ct.nrrd")


def test_a_folder_of_frames_replaces_no_folder_of_an_input(tmp_path: Path) -> None:
    scan = tmp_path / "frames" / "scan" / "ct.nrrd"
    scan.parent.mkdir(parents=True)
    scan.write_bytes(b"mine")
    with refused(UsageError, "frames"):
        check_kept([("the frames", tmp_path / "frames")], scan)
    check_kept([("the frames", tmp_path / "frames" / "other")], scan)


class Disturbed:
    """A staged file during whose commit the user presses Ctrl-C."""

    size = 1

    def __init__(self, number: int):
        self.number, self.done = number, 0

    def commit(self) -> None:
        signal.raise_signal(self.number)
        self.done += 1


@pytest.mark.parametrize("fails", [False, True])
def test_an_interrupt_waits_until_all_files_are_in_place(fails: bool, tmp_path: Path) -> None:
    handler = signal.getsignal(signal.SIGINT)
    files = [Disturbed(signal.SIGINT), Disturbed(signal.SIGINT)]
    with ExitStack() as stack:
        own = stack.enter_context(stage_file(tmp_path / "a.json", lambda stream: stream.write(b"new")))
        if fails:
            (tmp_path / "a.json").mkdir()
        with pytest.raises(KeyboardInterrupt):
            commit_all([*files, own])
    assert [file.done for file in files] == [1, 1]
    assert (tmp_path / "a.json").is_dir() == fails
    assert signal.getsignal(signal.SIGINT) is handler


def test_other_threads_commit_without_signals(tmp_path: Path) -> None:
    with stage_file(tmp_path / "a.json", lambda stream: stream.write(b"new")) as staged:
        thread = threading.Thread(target=commit_all, args=([staged],))
        thread.start()
        thread.join()
    assert (tmp_path / "a.json").read_bytes() == b"new"
