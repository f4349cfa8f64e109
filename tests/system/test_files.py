"""A file is replaced as a whole or not at all, whatever happens on the way."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from refusals import assert_one_line, refused

from clrecon.errors import OutputError, UsageError
from clrecon.system.files import check_writable, replace_file, stage_file

pytestmark = [
    pytest.mark.unit,
    pytest.mark.faults,
    pytest.mark.skipif(sys.platform == "win32", reason="faults are made with POSIX means"),
]


def names_in(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def writing_half_then_raising(error: BaseException):
    def write(stream) -> None:
        stream.write(b"half")
        raise error

    return write


@pytest.fixture
def older(tmp_path) -> Path:
    """A file that is there before another is written in its place."""
    path = tmp_path / "bone.stl"
    path.write_bytes(b"older")
    return path


def check_untouched(older: Path) -> None:
    """Assert that the older file has its content, and that there is no other file beside it."""
    assert older.read_bytes() == b"older"
    assert names_in(older.parent) == [older.name]


def test_new_file_is_verified_whole_under_a_temporary_private_name_before_it_appears(tmp_path):
    target = tmp_path / "bone.stl"
    verified: list[Path] = []

    def verify(temporary: Path) -> None:
        verified.append(temporary)
        assert temporary.read_bytes() == b"12345"
        assert stat.S_IMODE(temporary.stat().st_mode) == 0o600
        assert not target.exists()

    replace_file(target, lambda stream: stream.write(b"12345"), verify=verify)

    [temporary] = verified
    assert temporary.parent == tmp_path
    assert temporary.name.startswith(".clrecon-")
    assert target.read_bytes() == b"12345"
    assert names_in(tmp_path) == ["bone.stl"]


def test_older_file_has_its_content_until_the_newer_one_is_written(older):
    def write(stream) -> None:
        stream.write(b"newer and longer")
        stream.flush()
        assert older.read_bytes() == b"older"

    replace_file(str(older), write)
    assert older.read_bytes() == b"newer and longer"


def test_size_of_the_written_file_is_returned(tmp_path):
    assert replace_file(tmp_path / "a", lambda stream: stream.write(b"12345")) == 5


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o000, 0o666), (0o027, 0o640)])
def test_new_file_has_the_mode_that_the_umask_leaves_and_the_umask_is_kept(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        replace_file(tmp_path / "x", lambda stream: None)
        assert os.umask(umask) == umask
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "x").stat().st_mode) == mode


def test_replaced_file_keeps_its_mode(older):
    older.chmod(0o640)
    replace_file(older, lambda stream: stream.write(b"newer"))
    assert stat.S_IMODE(older.stat().st_mode) == 0o640


@pytest.mark.parametrize(
    ("code", "fact"),
    [
        (errno.ENOSPC, "full"),
        (errno.EDQUOT, "quota"),
        (errno.EROFS, "read-only"),
        (errno.EPERM, "permit"),
        (errno.EIO, os.strerror(errno.EIO).split()[0]),
    ],
)
def test_error_of_the_system_while_writing_is_told_in_one_line_and_leaves_the_older_file(older, code, fact):
    with pytest.raises(OutputError) as caught:
        replace_file(older, writing_half_then_raising(OSError(code, os.strerror(code))))
    assert_one_line(caught.value, fact, older.name)
    assert caught.value.exit_code == 6
    check_untouched(older)


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_target_in_a_folder_of_the_system_that_takes_no_files_is_refused():
    with refused(OutputError, "files", "folder"):
        check_writable("/proc/a.stl")


def test_folder_that_is_removed_before_its_file_appears_is_an_error_that_says_so(tmp_path):
    target = tmp_path / "folder" / "a.stl"
    target.parent.mkdir()
    with refused(OutputError, "a.stl", "vanished"), stage_file(target, lambda stream: stream.write(b"1")) as staged:
        shutil.rmtree(target.parent)
        staged.commit()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), UsageError("no"), RuntimeError("no"), SystemExit(3)])
def test_error_of_the_writing_function_is_raised_and_leaves_the_older_file(older, error):
    with pytest.raises(type(error), match=f"^{error}$"):
        replace_file(older, writing_half_then_raising(error))
    check_untouched(older)


def test_interrupt_while_verifying_leaves_the_older_file(older):
    def interrupt(temporary: Path) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        replace_file(older, lambda stream: stream.write(b"newer"), verify=interrupt)
    check_untouched(older)


def test_file_that_fails_its_verification_leaves_the_older_file(older):
    def find_fault(temporary: Path) -> None:
        raise OutputError("3 triangles, 4 expected")

    with refused(OutputError, "triangles", 3, 4):
        replace_file(older, lambda stream: stream.write(b"newer"), verify=find_fault)
    check_untouched(older)


def test_file_that_has_lost_bytes_on_the_disk_is_refused_and_leaves_the_older_file(older):
    def write(stream) -> None:
        stream.write(b"12345678")
        stream.flush()
        os.truncate(stream.fileno(), 3)

    with refused(OutputError, "bytes", 8, 3):
        replace_file(older, write)
    check_untouched(older)


@pytest.mark.parametrize("piece", [100_000, 300], ids=["pieces above the buffer", "pieces within the buffer"])
def test_file_beyond_the_largest_size_that_the_system_allows_is_refused_and_leaves_the_older_file(older, piece):
    """A real limit of the system, in a process of its own."""
    code = f"""
        import resource
        from clrecon.errors import OutputError
        from clrecon.system.files import replace_file
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        try:
            replace_file({str(older)!r}, lambda stream: [stream.write(bytes({piece})) for _ in range(500)])
        except OutputError as error:
            print(error)
    """
    run = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=60)
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout == f"cannot write {older}: the file grew beyond the largest size that is allowed here\n"
    check_untouched(older)


PETABYTE = 10**15


def test_file_larger_than_the_free_space_is_refused_before_it_is_written(older):
    calls: list = []
    with refused(OutputError, "GB", "free", PETABYTE / 10**9):
        replace_file(older, calls.append, expected_bytes=PETABYTE)
    assert calls == []
    check_untouched(older)


def test_target_without_enough_free_space_is_refused_as_a_full_disk_is(older):
    with refused(OutputError, "GB", "free", PETABYTE / 10**9) as caught:
        check_writable(older, expected_bytes=PETABYTE)
    assert caught.value.__cause__.errno == errno.ENOSPC
    check_untouched(older)


def write_nothing(path) -> None:
    replace_file(path, lambda stream: None)


@pytest.mark.parametrize("action", [check_writable, write_nothing])
class TestRefusedTargets:
    def test_file_in_a_missing_folder_is_refused(self, action, tmp_path):
        with refused(OutputError, "folder"):
            action(tmp_path / "no" / "bone.stl")
        assert names_in(tmp_path) == []

    def test_file_below_a_file_is_refused(self, action, older):
        with refused(OutputError, "bone.stl", "folder"):
            action(older / "bone.stl")
        check_untouched(older)

    @pytest.mark.parametrize(
        ("name", "words"),
        [(".", "it is a folder"), ("new/", "this names a folder"), ("", "this names a folder")],
        ids=["a folder", "a name that ends with a slash", "no name"],
    )
    def test_name_of_a_folder_is_refused(self, action, name, words, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(OutputError, match=words):
            action(name)

    def test_fifo_in_place_of_the_file_is_refused_and_left(self, action, tmp_path):
        os.mkfifo(tmp_path / "x.stl")
        with refused(OutputError, "FIFO"):
            action(tmp_path / "x.stl")
        assert stat.S_ISFIFO((tmp_path / "x.stl").stat().st_mode)

    def test_character_device_in_place_of_the_file_is_refused_and_left(self, action):
        with refused(OutputError, "character", "device"):
            action("/dev/null")
        assert stat.S_ISCHR(os.stat("/dev/null").st_mode)

    def test_socket_in_place_of_the_file_is_refused(self, action, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)  # the name of a socket must be short
        with socket.socket(socket.AF_UNIX) as server:
            server.bind("s")
            with refused(OutputError, "socket"):
                action("s")

    def test_file_name_of_300_letters_is_refused(self, action, tmp_path):
        with refused(OutputError, "long"):
            action(tmp_path / ("x" * 300 + ".stl"))
        assert names_in(tmp_path) == []

    def test_link_that_leads_to_itself_is_refused(self, action, tmp_path):
        (tmp_path / "a").symlink_to(tmp_path / "b")
        (tmp_path / "b").symlink_to(tmp_path / "a")
        with refused(OutputError, "itself"):
            action(tmp_path / "a")

    def test_null_character_in_a_name_is_refused(self, action, tmp_path):
        with refused(OutputError, "character"):
            action(f"{tmp_path}/a\0b")

    def test_message_about_a_name_with_a_line_break_is_one_printable_line(self, action, tmp_path):
        with pytest.raises(OutputError) as caught:
            action(tmp_path / "no\nfolder\x1b[31m" / "x.stl")
        assert_one_line(caught.value, "exist")

    def test_folder_without_permission_to_create_files_is_refused(self, action, older, monkeypatch):
        open_file = os.open

        def refuse_to_create(path, flags, *rest, **more):
            if flags & os.O_CREAT:
                raise PermissionError(errno.EACCES, "Permission denied")
            return open_file(path, flags, *rest, **more)

        monkeypatch.setattr(os, "open", refuse_to_create)
        with refused(OutputError, "permission", "folder"):
            action(older)
        check_untouched(older)

    def test_write_protected_file_is_refused_and_left(self, action, older, monkeypatch):
        monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write to everything
        with refused(OutputError, "write-protected"):
            action(older)
        check_untouched(older)


def test_check_of_a_target_leaves_the_older_file_and_makes_no_new_one(older):
    check_writable(older)
    check_writable(older.parent / "new.stl")
    check_untouched(older)


def test_file_behind_a_link_is_replaced_and_the_link_kept(tmp_path):
    (tmp_path / "folder").mkdir()
    real, link = tmp_path / "folder" / "real.stl", tmp_path / "link.stl"
    real.write_bytes(b"older")
    link.symlink_to(real)
    replace_file(link, lambda stream: stream.write(b"newer"))
    assert link.is_symlink()
    assert real.read_bytes() == b"newer"
    assert names_in(tmp_path / "folder") == ["real.stl"]


def test_file_behind_a_dangling_link_is_made_and_the_link_kept(tmp_path):
    (tmp_path / "folder").mkdir()
    new, link = tmp_path / "folder" / "new.stl", tmp_path / "link.stl"
    link.symlink_to(new)
    replace_file(link, lambda stream: stream.write(b"new"))
    assert link.is_symlink()
    assert new.read_bytes() == b"new"


@contextlib.contextmanager
def process_writing_to(target: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A process that has written half of a file, and its temporary file; it ends by a signal alone."""
    code = f"""
        import time
        from clrecon.system.files import replace_file
        def write(stream):
            stream.write(b"half")
            stream.flush()
            print("writing", flush=True)
            time.sleep(60)
        replace_file({str(target)!r}, write)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout is not None
    with process, process.stdout:
        assert process.stdout.readline() == "writing\n"
        [temporary] = target.parent.glob(".clrecon-*")
        try:
            yield process, temporary
        finally:
            process.kill()


def stop(process: subprocess.Popen[str], by: signal.Signals) -> None:
    process.send_signal(by)
    process.wait(timeout=30)


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGINT])
def test_process_that_is_stopped_while_writing_leaves_the_older_file(older, by):
    with process_writing_to(older) as (process, _):
        stop(process, by)
    assert older.read_bytes() == b"older"


def test_process_that_is_interrupted_while_writing_removes_its_temporary_file(older):
    with process_writing_to(older) as (process, temporary):
        stop(process, signal.SIGINT)
    assert not temporary.exists()


def test_temporary_file_of_a_process_that_is_writing_is_kept_by_other_writers(older):
    with process_writing_to(older) as (_, temporary):
        replace_file(older.parent / "other.stl", lambda stream: stream.write(b"x"))
        assert temporary.read_bytes() == b"half"


def test_temporary_file_of_a_killed_process_and_no_other_file_is_removed_by_the_next_writer(older):
    with process_writing_to(older) as (process, temporary):
        stop(process, signal.SIGKILL)
    assert temporary.exists()
    (older.parent / ".clrecon-notes").write_text("of the user")
    replace_file(older.parent / "other.stl", lambda stream: stream.write(b"y"))
    assert names_in(older.parent) == [".clrecon-notes", "bone.stl", "other.stl"]


def test_six_threads_that_write_to_one_name_leave_one_whole_file(tmp_path):
    path = tmp_path / "bone.stl"

    def write_15_times(number: int) -> None:
        for _ in range(15):
            replace_file(path, lambda stream: stream.write(bytes([number]) * 5000))

    with ThreadPoolExecutor(6) as threads:
        list(threads.map(write_15_times, range(6)))  # raises what a thread raises

    content = path.read_bytes()
    assert content in [bytes([number]) * 5000 for number in range(6)]
    assert names_in(tmp_path) == ["bone.stl"]


def test_temporary_file_that_another_writer_removed_before_it_was_locked_is_made_again(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    flock, locked = fcntl.flock, []

    def remove_then_lock(descriptor, operation):
        if not locked:
            for entry in tmp_path.iterdir():
                entry.unlink()
        locked.append(descriptor)
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", remove_then_lock)
    replace_file(tmp_path / "x", lambda stream: stream.write(b"abc"))
    assert len(locked) == 2
    assert (tmp_path / "x").read_bytes() == b"abc"


@pytest.fixture
def listed_folders(monkeypatch) -> list[Path]:
    """The folders that have been listed since, in their order."""
    listed: list[Path] = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda folder: listed.append(folder) or scandir(folder))
    return listed


def test_folder_is_listed_once_for_all_files_that_are_staged_at_the_same_time(tmp_path, listed_folders):
    """Listed once for each file, a folder of a thousand files took a million looks."""
    with contextlib.ExitStack() as stack:
        for number in range(5):
            stack.enter_context(stage_file(tmp_path / f"{number}.bin", lambda stream: stream.write(b"x")))
    assert listed_folders == [tmp_path]


def test_folder_is_listed_again_for_a_file_that_is_staged_later(tmp_path, listed_folders):
    for _ in range(2):
        with stage_file(tmp_path / "a.bin", lambda stream: stream.write(b"x")):
            pass
    assert listed_folders == [tmp_path, tmp_path]
