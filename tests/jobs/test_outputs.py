"""Names of the files of a job; what stands in the way of what; all or nothing."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

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
from clrecon.system.files import allow_open_files, stage_file

pytestmark = pytest.mark.unit


def names_of(levels: list[float], split: bool = False) -> list[str]:
    """Names of the files of a job for a.b/bone.v2.stl with these iso values, the first component of each if split."""
    return [str(path) for path in name_outputs("a.b/bone.v2.stl", first_names(plan_surfaces(levels), split))]


def test_file_of_one_mesh_has_the_given_name() -> None:
    path = Path("x") / "bone.stl"
    assert name_outputs(path, [""]) == [path]
    assert names_of([226.5]) == ["a.b/bone.v2.stl"]


def test_names_of_several_meshes_have_iso_value_or_number_before_the_extension() -> None:
    assert names_of([200.0, 350]) == ["a.b/bone.v2_200hu.stl", "a.b/bone.v2_350hu.stl"]
    assert names_of([200.0], split=True) == ["a.b/bone.v2_001.stl"]
    assert names_of([-0.0, -150.5], split=True) == ["a.b/bone.v2_0hu_001.stl", "a.b/bone.v2_-150.5hu_001.stl"]


def test_names_of_close_iso_values_have_all_their_digits() -> None:
    assert names_of([1234567.0, 1234568.0, 200.0000001]) == [
        f"a.b/bone.v2_{digits}hu.stl" for digits in ("1234567", "1234568", "200.0000001")
    ]


@pytest.mark.parametrize("names", [["T12", "T12"], ["T12", "t12"]], ids=["same name", "case alone differs"])
def test_two_meshes_with_one_name_are_refused(names: list[str]) -> None:
    with refused(UsageError, *names):
        name_outputs("bone.stl", names)


def test_mesh_named_as_the_report_by_another_path_is_refused(tmp_path: Path) -> None:
    report = tmp_path / "." / "bone_T12.stl"
    with refused(UsageError, "T12", "mesh"):
        name_outputs(tmp_path / "bone.stl", ["L1", "T12"], report)


def test_mesh_that_a_link_leads_to_another_mesh_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bone_L1.stl").symlink_to(tmp_path / "bone_T12.stl")
    with refused(UsageError, "T12", "L1"):
        check_outputs(tmp_path / "bone.stl", report_path=None, names=["L1", "T12"])


@pytest.mark.parametrize("name", ["../T12", "a/b", "a\\b", "/tmp"])
def test_name_of_a_mesh_that_leads_to_another_folder_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="cannot be a part of the name of a file"):
        name_outputs("bone.stl", [name])


def test_more_files_than_a_job_writes_are_refused() -> None:
    names = [f"{number}" for number in range(MOST_FILES + 1)]

    assert len(name_outputs("bone.stl", names[1:])) == MOST_FILES
    with refused(UsageError, MOST_FILES + 1, MOST_FILES):
        name_outputs("bone.stl", names)


def test_folder_in_the_place_of_a_mesh_is_refused_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "bone_350hu.stl").mkdir()

    with refused(OutputError, "bone_350hu.stl"):
        check_outputs(tmp_path / "bone.stl", report_path=None, names=["200hu", "350hu"])

    assert [path.name for path in tmp_path.iterdir()] == ["bone_350hu.stl"]


def test_folder_in_a_place_that_no_mesh_has_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "bone.stl").mkdir()  # the meshes are bone_200hu.stl and bone_400hu.stl

    check_outputs(tmp_path / "bone.stl", tmp_path / "r.json", ["200hu", "400hu"])

    assert [path.name for path in tmp_path.iterdir()] == ["bone.stl"]


@pytest.mark.parametrize("blocked", [0, 2])
def test_file_that_cannot_be_put_in_place_is_refused_with_the_number_of_those_that_are(
    blocked: int, tmp_path: Path
) -> None:
    paths = [tmp_path / f"{number}.stl" for number in range(3)]
    with ExitStack() as stack:
        files = [stack.enter_context(stage_file(path, lambda stream: stream.write(b"new"))) for path in paths]
        paths[blocked].mkdir()
        with pytest.raises(OutputError, match=r"2.stl: .* \(2 of 3 files" if blocked else r"0.stl: [^(]*$"):
            commit_all(files)
    there = [path.name for path in tmp_path.iterdir() if path.is_file()]
    assert sorted(there) == [path.name for path in paths[:blocked]]


@pytest.fixture
def set_limit_of_open_files() -> Iterator[Callable[[int], None]]:
    """A function that sets the soft limit of this process; it is restored after the test."""
    resource = pytest.importorskip("resource", reason="the limit of open files is that of POSIX systems")
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    yield lambda most: resource.setrlimit(resource.RLIMIT_NOFILE, (most, limits[1]))
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def stage_files(folder: Path, count: int, stack: ExitStack) -> list[Any]:
    """Stage files of one byte, named by their numbers."""
    return [
        stack.enter_context(stage_file(folder / f"{number}", lambda stream: stream.write(b"x")))
        for number in range(count)
    ]


def test_more_files_than_the_soft_limit_are_staged_at_once_where_it_can_be_raised(
    tmp_path: Path, set_limit_of_open_files: Callable[[int], None]
) -> None:
    set_limit_of_open_files(200)

    allow_open_files(300)
    with ExitStack() as stack:
        commit_all(stage_files(tmp_path, 300, stack))

    assert len(list(tmp_path.iterdir())) == 300


def test_more_files_than_the_limit_are_refused_with_the_command_that_raises_it(
    tmp_path: Path, set_limit_of_open_files: Callable[[int], None]
) -> None:
    set_limit_of_open_files(60)
    with refused(OutputError, "ulimit", "files"), ExitStack() as stack:
        stage_files(tmp_path, 100, stack)


@pytest.fixture
def inputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Inputs of jobs in the working folder, and a link to the scan; all of them stay as they are."""
    monkeypatch.chdir(tmp_path)
    names = ("ct.nrrd", "labels.nrrd", "tf.json", "line.json")
    for name in names:
        Path(name).write_bytes(b"mine")
    Path("link.json").symlink_to("ct.nrrd")
    yield
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == dict.fromkeys(
        (*names, "link.json"), b"mine"
    )


@pytest.mark.usefixtures("inputs")
@pytest.mark.parametrize("report", ["ct.nrrd", "link.json", "labels.nrrd"])
def test_report_of_a_mesh_over_an_input_is_refused(report: str) -> None:
    settings = MeshSettings(labels=LabelChoice("labels.nrrd"))
    with refused(UsageError, "report", report):
        make_mesh("ct.nrrd", "a.stl", settings, report_path=report)


@pytest.mark.usefixtures("inputs")
@pytest.mark.parametrize(
    ("report", "settings"),
    [
        pytest.param("ct.nrrd", RenderSettings.of(), id="scan"),
        pytest.param("tf.json", RenderSettings.of(transfer_function="tf.json:bone"), id="transfer function"),
        pytest.param("line.json", RenderSettings.of(curve="line.json"), id="centre line"),
        pytest.param("labels.nrrd", RenderSettings.of(labels=LabelLook("labels.nrrd")), id="label map"),
    ],
)
def test_report_of_a_picture_over_an_input_is_refused(report: str, settings: RenderSettings) -> None:
    with refused(UsageError, "report", report):
        make_pictures("ct.nrrd", PictureFiles("a.png", report=report), settings)


def test_word_of_a_setting_that_is_no_file_is_no_input() -> None:
    assert RenderSettings.of(curve="auto").files_read == RenderSettings.of().files_read


def test_folder_of_frames_that_holds_an_input_is_refused(tmp_path: Path) -> None:
    scan = tmp_path / "frames" / "scan" / "ct.nrrd"
    scan.parent.mkdir(parents=True)
    scan.write_bytes(b"mine")

    check_kept([("the frames", tmp_path / "frames" / "other")], scan)  # beside it
    with refused(UsageError, "frames"):
        check_kept([("the frames", tmp_path / "frames")], scan)


class InterruptedFile:
    """A staged file during whose commit the user presses Ctrl-C."""

    size = 1

    def __init__(self) -> None:
        self.commits = 0

    def commit(self) -> None:
        signal.raise_signal(signal.SIGINT)
        self.commits += 1


@pytest.mark.parametrize("last_fails", [False, True], ids=["all can be written", "the last cannot"])
def test_interrupt_waits_until_all_files_that_can_be_are_in_place(last_fails: bool, tmp_path: Path) -> None:
    handler = signal.getsignal(signal.SIGINT)
    files = [InterruptedFile(), InterruptedFile()]

    with ExitStack() as stack:
        last = stack.enter_context(stage_file(tmp_path / "a.json", lambda stream: stream.write(b"new")))
        if last_fails:
            (tmp_path / "a.json").mkdir()
        with pytest.raises(KeyboardInterrupt):
            commit_all([*files, last])

    assert [file.commits for file in files] == [1, 1]
    assert (tmp_path / "a.json").is_dir() == last_fails
    assert signal.getsignal(signal.SIGINT) is handler


def test_files_are_put_in_place_by_another_thread_than_the_first(tmp_path: Path) -> None:
    with stage_file(tmp_path / "a.json", lambda stream: stream.write(b"new")) as staged:
        thread = threading.Thread(target=commit_all, args=([staged],))
        thread.start()
        thread.join()
    assert (tmp_path / "a.json").read_bytes() == b"new"
