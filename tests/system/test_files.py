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
import threading
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


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def raise_in_the_middle(error: BaseException):
    def write(stream) -> None:
        stream.write(b"half")
        raise error

    return write


@pytest.fixture
def older(tmp_path) -> Path:
    path = tmp_path / "bone.stl"
    path.write_bytes(b"older")
    return path


def check_untouched(path: Path) -> None:
    assert path.read_bytes() == b"older"
    assert names(path.parent) == [path.name]


def test_new_file_appears_once_it_is_verified(tmp_path):
    seen = []

    def verify(temporary: Path) -> None:
        seen.append((temporary.parent, temporary.read_bytes(), stat.S_IMODE(temporary.stat().st_mode)))
        assert temporary.name.startswith(".clrecon-")
        assert not (tmp_path / "bone.stl").exists()

    assert replace_file(tmp_path / "bone.stl", lambda stream: stream.write(b"12345"), verify) == 5
    assert seen == [(tmp_path, b"12345", 0o600)]
    assert (tmp_path / "bone.stl").read_bytes() == b"12345"
    assert names(tmp_path) == ["bone.stl"]


def test_older_file_is_replaced_in_one_step(older):
    def write(stream) -> None:
        stream.write(b"newer and longer")
        stream.flush()
        assert older.read_bytes() == b"older"

    assert replace_file(str(older), write) == 16
    assert older.read_bytes() == b"newer and longer"


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o000, 0o666), (0o027, 0o640)])
def test_new_file_has_the_mode_of_the_umask(tmp_path, umask, mode):
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
def test_errors_of_the_system_are_told_in_words(older, code, fact):
    with pytest.raises(OutputError) as caught:
        replace_file(older, raise_in_the_middle(OSError(code, os.strerror(code))))
    assert_one_line(caught.value, fact, older.name)
    assert caught.value.exit_code == 6
    check_untouched(older)


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_a_folder_of_the_system_takes_no_files():
    with refused(OutputError, "a.stl"):
        check_writable("/proc/a.stl")


def test_a_folder_that_vanishes_is_said(tmp_path):
    target = tmp_path / "folder" / "a.stl"
    target.parent.mkdir()
    with refused(OutputError, "a.stl", "vanished"), stage_file(target, lambda stream: stream.write(b"1")) as staged:
        shutil.rmtree(target.parent)
        staged.commit()


@pytest.mark.parametrize("error", [KeyboardInterrupt(), UsageError("no"), RuntimeError("no"), SystemExit(3)])
def test_other_errors_leave_the_older_file_and_pass_through(older, error):
    with pytest.raises(type(error), match=f"^{error}$"):
        replace_file(older, raise_in_the_middle(error))
    check_untouched(older)


def test_older_file_stays_when_verifying_is_interrupted(older):
    def verify(temporary: Path) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="^$"):
        replace_file(older, lambda stream: stream.write(b"newer"), verify)
    check_untouched(older)


def test_file_that_fails_its_check_leaves_the_older_one(older):
    def verify(temporary: Path) -> None:
        raise OutputError("3 triangles, 4 expected")

    with refused(OutputError, "triangles", 3, 4):
        replace_file(older, lambda stream: stream.write(b"newer"), verify)
    check_untouched(older)


def test_bytes_that_are_lost_are_noticed(older):
    def write(stream) -> None:
        stream.write(b"12345678")
        stream.flush()
        os.truncate(stream.fileno(), 3)

    with refused(OutputError, "bytes", 8, 3):
        replace_file(older, write)
    check_untouched(older)


@pytest.mark.parametrize("piece", [100_000, 300])  # more and less than the buffer holds
def test_limit_on_the_size_of_files_leaves_the_older_one(older, piece):
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


def test_full_disk_is_foreseen(older):
    calls: list = []
    with refused(OutputError, "MB", "free", 1e9):
        replace_file(older, calls.append, expected_bytes=10**15)
    with refused(OutputError, "MB", "free", 1e9):
        check_writable(older, expected_bytes=10**15)
    with pytest.raises(OutputError) as caught:
        check_writable(older, expected_bytes=10**15)
    assert caught.value.__cause__.errno == errno.ENOSPC  # as where the disk fills while it is written
    assert calls == []
    check_untouched(older)


@pytest.mark.parametrize("action", [check_writable, lambda path: replace_file(path, lambda stream: None)])
class TestRefusedTargets:
    def test_a_file_in_a_missing_folder_is_refused(self, action, tmp_path):
        with refused(OutputError, "folder"):
            action(tmp_path / "no" / "bone.stl")
        assert names(tmp_path) == []

    def test_file_below_a_file_is_refused(self, action, older):
        with refused(OutputError, "bone.stl", "folder"):
            action(older / "bone.stl")
        check_untouched(older)

    def test_a_folder_in_place_of_the_file_is_refused(self, action, tmp_path):
        with pytest.raises(OutputError, match="it is a folder"):
            action(tmp_path)
        with pytest.raises(OutputError, match="this names a folder"):
            action(f"{tmp_path}/new/")
        with pytest.raises(OutputError, match="this names a folder"):
            action("")

    def test_a_fifo_in_place_of_the_file_is_refused(self, action, tmp_path):
        os.mkfifo(tmp_path / "x.stl")
        with refused(OutputError, "FIFO"):
            action(tmp_path / "x.stl")
        assert stat.S_ISFIFO((tmp_path / "x.stl").stat().st_mode)

    def test_a_character_device_in_place_of_the_file_is_refused(self, action):
        with refused(OutputError, "character", "device"):
            action("/dev/null")
        assert stat.S_ISCHR(os.stat("/dev/null").st_mode)

    def test_a_socket_in_place_of_the_file_is_refused(self, action, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)  # the name of a socket must be short
        with socket.socket(socket.AF_UNIX) as server:
            server.bind("s")
            with refused(OutputError, "socket"):
                action("s")

    def test_name_too_long_is_refused(self, action, tmp_path):
        with refused(OutputError, "long"):
            action(tmp_path / ("x" * 300 + ".stl"))
        assert names(tmp_path) == []

    def test_link_loop_is_refused(self, action, tmp_path):
        (tmp_path / "a").symlink_to(tmp_path / "b")
        (tmp_path / "b").symlink_to(tmp_path / "a")
        with refused(OutputError, "itself"):
            action(tmp_path / "a")

    def test_null_character_in_a_name_is_refused(self, action, tmp_path):
        with refused(OutputError, "character"):
            action(f"{tmp_path}/a\0b")

    def test_message_is_one_line(self, action, tmp_path):
        with pytest.raises(OutputError) as caught:
            action(tmp_path / "no\nfolder\x1b[31m" / "x.stl")
        assert_one_line(caught.value, "exist")

    def test_missing_permission_is_refused(self, action, older, monkeypatch):
        real = os.open

        def refuse(path, flags, *rest, **more):
            if flags & os.O_CREAT:
                raise PermissionError(errno.EACCES, "Permission denied")
            return real(path, flags, *rest, **more)

        monkeypatch.setattr(os, "open", refuse)
        with refused(OutputError, "permission", "folder"):
            action(older)
        check_untouched(older)

    def test_write_protected_file_is_refused(self, action, older, monkeypatch):
        monkeypatch.setattr(os, "access", lambda path, mode: False)  # root may write to everything
        with pytest.raises(OutputError, match="write-protected"):
            action(older)
        check_untouched(older)


def test_check_writable_leaves_nothing(older):
    assert check_writable(older) is None
    assert check_writable(older.parent / "new.stl") is None
    check_untouched(older)


def test_link_to_a_file_is_followed(tmp_path):
    (tmp_path / "there").mkdir()
    real, link, dangling = tmp_path / "there" / "real.stl", tmp_path / "link.stl", tmp_path / "dangling.stl"
    real.write_bytes(b"older")
    link.symlink_to(real)
    dangling.symlink_to(tmp_path / "there" / "new.stl")
    replace_file(link, lambda stream: stream.write(b"newer"))
    replace_file(dangling, lambda stream: stream.write(b"new"))
    assert link.is_symlink() and real.read_bytes() == b"newer"
    assert dangling.is_symlink() and (tmp_path / "there" / "new.stl").read_bytes() == b"new"
    assert names(tmp_path / "there") == ["new.stl", "real.stl"]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_stopped_process_leaves_the_older_file(older, how):
    """The older file stays; what a killed process leaves is removed by the next writer, and only that."""
    code = f"""
        import sys, time
        from clrecon.system.files import replace_file
        def write(stream):
            stream.write(b"half")
            stream.flush()
            print("writing", flush=True)
            time.sleep(60)
        replace_file({str(older)!r}, write)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert process.stdout is not None
    with process, process.stdout:
        assert process.stdout.readline() == "writing\n"
        temporary = [name for name in names(older.parent) if name.startswith(".clrecon-")]
        assert len(temporary) == 1
        # A living process keeps its file, although another one writes into the same folder.
        replace_file(older.parent / "other.stl", lambda stream: stream.write(b"x"))
        assert (older.parent / temporary[0]).read_bytes() == b"half"
        process.send_signal(how)
        process.wait(timeout=30)
    assert older.read_bytes() == b"older"
    assert (temporary[0] in names(older.parent)) == (how == signal.SIGKILL)
    (older.parent / ".clrecon-notes").write_text("of the user")
    replace_file(older.parent / "other.stl", lambda stream: stream.write(b"y"))
    assert names(older.parent) == [".clrecon-notes", "bone.stl", "other.stl"]


def test_many_writers_of_one_name_leave_a_whole_file(tmp_path):
    """Whoever is last, the file is whole; nobody's temporary file is swept away."""
    path = tmp_path / "bone.stl"
    failures: list[BaseException] = []

    def work(number: int) -> None:
        try:
            for _ in range(15):
                replace_file(path, lambda stream: stream.write(bytes([number]) * 5000))
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    content = path.read_bytes()
    assert len(content) == 5000 and len(set(content)) == 1
    assert names(tmp_path) == ["bone.stl"]


def test_a_file_swept_before_it_was_locked_is_made_again(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")
    flock, calls = fcntl.flock, []

    def lock(descriptor, operation):
        calls.append(descriptor)
        if len(calls) == 1:
            for entry in tmp_path.iterdir():
                entry.unlink()
        flock(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", lock)
    assert replace_file(tmp_path / "x", lambda stream: stream.write(b"abc")) == 3
    assert len(calls) == 2
    assert (tmp_path / "x").read_bytes() == b"abc"


def test_a_folder_is_searched_once_for_files_that_belong_together(tmp_path, monkeypatch):
    """Each search lists the folder: with one a file, a thousand files took a million looks."""
    searched = []
    scan = os.scandir
    monkeypatch.setattr(os, "scandir", lambda folder: searched.append(folder) or scan(folder))
    with contextlib.ExitStack() as stack:
        for number in range(5):
            stack.enter_context(stage_file(tmp_path / f"{number}.bin", lambda stream: stream.write(b"x")))
    assert searched == [tmp_path]
    with stage_file(tmp_path / "later.bin", lambda stream: stream.write(b"x")):
        assert searched == [tmp_path, tmp_path]
