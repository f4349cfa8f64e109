"""A folder of frames as a whole: what is refused before anything is drawn, what is left when something fails."""

from __future__ import annotations

import errno
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import OutputError, UsageError
from clrecon.rendering.movies import check_animation, stage_animation, write_animation
from clrecon.system.files import replace_file

NAMES = ["frame_0000.png", "frame_0001.png"]
STALE = ".clrecon-0123456789abcdef.folder"


def frames(count: int = 2) -> list[np.ndarray]:
    """Even pictures of 8 x 8 pixels, each lighter than the one before."""
    return [np.full((8, 8, 3), 100 * number, np.uint8) for number in range(count)]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def folder_of_3(tmp_path: Path) -> Path:
    """A folder with three frames of an earlier run."""
    write_animation(frames(3), tmp_path / "turn")
    return tmp_path / "turn"


@pytest.mark.parametrize("name", [".", "./", "../turn"])
def test_animation_into_the_current_folder_is_refused_and_it_stays(
    name: str, folder_of_3: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever stands in it would stand in a folder that was removed."""
    monkeypatch.chdir(folder_of_3)
    with refused(UsageError, "current"):
        check_animation(name)
    assert len(names(folder_of_3)) == 3 and os.path.samefile(folder_of_3, ".")


def test_animation_without_a_name_is_refused_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with refused(UsageError, "name", "empty"):
        write_animation(frames(), "")
    assert names(tmp_path) == []


def test_folder_that_is_a_mounted_disk_is_refused_before_anything_is_drawn(
    folder_of_3: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, refused(OutputError, "disk", "mounted"):
        patch.setattr("os.path.ismount", lambda path: os.path.samefile(path, folder_of_3))
        check_animation(folder_of_3)
    assert len(names(folder_of_3)) == 3


def test_folder_that_is_write_protected_is_refused_before_anything_is_drawn(
    folder_of_3: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, refused(OutputError, "write-protected"):
        patch.setattr("os.access", lambda path, _: not os.path.samefile(path, folder_of_3))
        check_animation(folder_of_3)
    assert len(names(folder_of_3)) == 3


def test_link_that_leads_back_to_itself_is_refused_as_a_folder_of_frames(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    with refused(OutputError, "leads", "itself"):
        check_animation(tmp_path / "loop")
    assert names(tmp_path) == ["loop"]


@pytest.fixture
def umask_027() -> Iterator[None]:
    """New folders have the permissions 750."""
    before = os.umask(0o027)
    yield
    os.umask(before)


def permissions(folder: Path) -> int:
    return folder.stat().st_mode & 0o777


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
@pytest.mark.usefixtures("umask_027")
def test_new_folder_of_frames_has_the_permissions_of_the_umask(tmp_path: Path) -> None:
    write_animation(frames(), tmp_path / "turn")
    assert permissions(tmp_path / "turn") == 0o750


@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
@pytest.mark.usefixtures("umask_027")
def test_folder_of_frames_has_the_permissions_of_the_one_that_it_replaces_from_the_start(folder_of_3: Path) -> None:
    folder_of_3.chmod(0o700)

    with stage_animation(frames(), folder_of_3) as staged:
        (staged_folder,) = (path for path in folder_of_3.parent.iterdir() if path.name.startswith(".clrecon-"))
        assert permissions(staged_folder) == 0o700
        staged.commit()

    assert permissions(folder_of_3) == 0o700
    assert names(folder_of_3) == NAMES


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("place", [1, 2, 3])
def test_interrupt_between_two_renames_leaves_one_whole_folder(
    place: int, when: str, folder_of_3: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The older folder goes, the new one comes, the older one gets a name to be removed by: none of it alone."""
    true_way, done = os.rename, []

    def rename(source: Path, target: Path) -> None:
        done.append(target)
        if (len(done), when) == (place, "before"):
            signal.raise_signal(signal.SIGINT)
        true_way(source, target)
        if (len(done), when) == (place, "after"):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("os.rename", rename)
    with pytest.raises(KeyboardInterrupt):
        write_animation(frames(2), folder_of_3)
    assert names(folder_of_3.parent) == ["turn"] and names(folder_of_3) == NAMES
    assert len(done) == 3  # renames


@pytest.mark.parametrize("place", [1, 2])
def test_rename_that_fails_leaves_the_older_folder_of_frames(
    place: int, folder_of_3: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    true_way, done = os.rename, []

    def rename(source: Path, target: Path) -> None:
        done.append(target)
        if len(done) == place:
            raise OSError(errno.EBUSY, "busy")
        true_way(source, target)

    monkeypatch.setattr("os.rename", rename)
    with refused(OutputError, "turn", "busy"):
        write_animation(frames(2), folder_of_3)
    assert names(folder_of_3.parent) == ["turn"] and len(names(folder_of_3)) == 3


@pytest.mark.skipif(os.name != "posix", reason="locks of POSIX")
@pytest.mark.parametrize("writes", ["frames", "a file"])
def test_folder_of_a_killed_process_is_removed_by_the_next_writer_when_its_lock_is_free(
    writes: str, tmp_path: Path
) -> None:
    import fcntl

    def write() -> None:
        if writes == "frames":
            write_animation(frames(), tmp_path / "turn")
        else:
            replace_file(tmp_path / "turn", lambda stream: stream.write(b"x"))

    (tmp_path / STALE).mkdir()
    (tmp_path / STALE / "frame_0000.png").write_bytes(b"half")
    (tmp_path / ".clrecon-notes.folder").mkdir()
    descriptor = os.open(tmp_path / STALE, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)  # as the process that is writing it does
        write()
        assert names(tmp_path) == [STALE, ".clrecon-notes.folder", "turn"]
    finally:
        os.close(descriptor)
    write()
    assert names(tmp_path) == [".clrecon-notes.folder", "turn"]


def test_folder_of_frames_that_is_being_written_stays_beside_other_writers(tmp_path: Path) -> None:
    with stage_animation(frames(), tmp_path / "turn") as staged:
        during = names(tmp_path)
        replace_file(tmp_path / "other", lambda stream: stream.write(b"x"))
        assert names(tmp_path) == sorted([*during, "other"]) and len(during) == 1
        staged.commit()
    assert names(tmp_path) == ["other", "turn"]
