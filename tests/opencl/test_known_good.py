"""What PoCL keeps is compared with what worked before it is loaded: PoCL ends the process on a damaged file."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from contextlib import contextmanager, nullcontext

import pytest
from variants import daily

from clrecon.opencl import pocl
from clrecon.opencl.pocl import DAMAGED, UNFINISHED, KnownGood
from clrecon.opencl.quirks import is_pocl

COUNT_BITS_ON_DEVICE = """
import json, os, sys
import numpy as np
import clrecon
from clrecon.opencl import upload
from clrecon.operators.primitives.scan import compact
device = clrecon.device(int(sys.argv[1]))
count = compact(device, upload(device, np.full(70, 5, dtype=np.uint32)), 70).count
device.queue.finish()
print(json.dumps([count, device.warnings]), flush=True)
if sys.argv[2] == "killed":
    os.abort()
"""


def warnings_of_process(device, folder, end="well"):
    """Build and launch two small programs in a process with this folder for PoCL's kernels; returns its warnings."""
    environment = {**os.environ, "POCL_CACHE_DIR": str(folder), "CLRECON_CHILD": "1"}
    command = [sys.executable, "-c", COUNT_BITS_ON_DEVICE, str(device.index), end]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == (0 if end == "well" else -6), done.stderr
    count, warnings = json.loads(done.stdout)
    assert count == 70 * 2  # of 70 words with the value 5, which has two set bits
    return warnings


@pytest.fixture
def folder_of_kernels(device, shared_folder, tmp_path):
    """A copy of a folder in which a process has built two programs."""
    if not is_pocl(device.platform):
        pytest.skip("this driver does not end the process")
    original = shared_folder / f"built-on-{device.index}" / "clrecon"
    if not original.exists():
        assert warnings_of_process(device, original) == []
    return shutil.copytree(original, tmp_path / "clrecon")


def files_of(folder, suffix):
    found = sorted(path for path in folder.glob("??/*/**/*") if path.is_file() and path.suffix == suffix)
    assert found
    return found


def cut_programs(folder):
    for path in files_of(folder, ".bc"):
        os.truncate(path, 100)


def empty_kernels(folder):
    for path in files_of(folder, ".so"):
        os.truncate(path, 0)


def overwrite_all(folder):
    for path in (*files_of(folder, ".bc"), *files_of(folder, ".so")):
        path.write_bytes(random.Random(59).randbytes(path.stat().st_size))


def swap_two_programs(folder):
    first, second, *_ = (path for path in files_of(folder, ".bc") if path.name == "program.bc")
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


@pytest.mark.release
@pytest.mark.parametrize("damage", daily(2, [overwrite_all, swap_two_programs, cut_programs, empty_kernels]))
@pytest.mark.fault_row(59)
def test_damaged_kernels_are_built_anew_with_a_warning_once(damage, device, folder_of_kernels):
    damage(folder_of_kernels)
    assert warnings_of_process(device, folder_of_kernels) == [DAMAGED]
    assert warnings_of_process(device, folder_of_kernels) == []  # the next process finds them whole


@pytest.mark.seconds
@pytest.mark.fault_row(59)
def test_kernels_without_a_record_are_built_anew_with_a_warning_once(device, folder_of_kernels):
    """As after a process that died: PoCL's files are there, cut by a full disk, and nobody has seen them work."""
    shutil.rmtree(folder_of_kernels / "records")
    cut_programs(folder_of_kernels)
    assert warnings_of_process(device, folder_of_kernels) == [UNFINISHED]
    assert warnings_of_process(device, folder_of_kernels) == []


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.fault_row(59)
def test_kernels_of_a_process_that_was_killed_are_not_recorded_and_the_next_warns(device, tmp_path):
    if not is_pocl(device.platform):
        pytest.skip("this driver does not end the process")
    folder = tmp_path / "clrecon"
    warnings_of_process(device, folder, end="killed")
    assert files_of(folder, ".bc")
    assert list((folder / "records").iterdir()) == []
    assert warnings_of_process(device, folder) == [UNFINISHED]


# Without a driver: a folder with files as PoCL writes them, and records of those that worked


KEY, PROGRAM = "a" * 64, "AB/CDEFG"
"""The key of a source with its options, and the folder in which PoCL keeps what it built from them."""
KERNEL = f"{PROGRAM}/scan/64/scan.so"


@pytest.fixture
def new_process(tmp_path, monkeypatch):
    """Makes the `KnownGood` of a new process; the earlier process has ended, and what it has not recorded is lost."""
    monkeypatch.setattr(pocl.atexit, "register", lambda call: None)
    made: list[KnownGood] = []

    def make():
        for earlier in made:
            os.close(earlier._handle)
        made[:] = [KnownGood(tmp_path)]
        return made[0]

    return make


def write_program(folder, program=PROGRAM):
    """Write the files of a program and its kernel as PoCL does, those that are not there."""
    (folder / program / "scan" / "64").mkdir(parents=True, exist_ok=True)
    (folder / program / "last_accessed").write_bytes(b"")
    for name in ("program.bc", "scan/64/scan.so"):
        path = folder / program / name
        if not path.exists():
            path.write_bytes(b"built")


def build_program(store, folder, program=PROGRAM):
    """Build a program as PoCL does; returns whether it was still there, and need not be built."""
    with store.building(KEY):
        is_there = (folder / program).exists()
        write_program(folder, program)
    return is_there


def recorded_programs(folder):
    return set(json.loads((folder / "records" / KEY).read_bytes()))


@pytest.fixture
def recorded_folder(new_process, tmp_path):
    """A folder in which a process has built a program and recorded it."""
    store = new_process()
    assert not build_program(store, tmp_path)
    store.record()
    return tmp_path


def test_program_that_an_earlier_process_recorded_is_used(new_process, recorded_folder):
    store = new_process()
    assert build_program(store, recorded_folder)
    assert store.warnings == []


def test_recorded_program_is_used_after_the_times_of_its_files_changed(new_process, recorded_folder):
    """As in a copy of the folder."""
    for path in recorded_folder.rglob("*.*"):
        os.utime(path)
    store = new_process()
    assert build_program(store, recorded_folder)
    assert store.warnings == []


@pytest.mark.parametrize("content", [b"", b"[]", b'{"AB/CDEFG": {"program.bc": [1]}}', b"\xff{"])
def test_program_whose_record_cannot_be_read_is_built_anew_with_a_warning(content, new_process, recorded_folder):
    (recorded_folder / "records" / KEY).write_bytes(content)
    store = new_process()
    assert not build_program(store, recorded_folder)
    assert store.warnings == [UNFINISHED]


def test_kernel_that_the_process_builds_after_its_record_is_recorded_too(new_process, tmp_path):
    store = new_process()
    build_program(store, tmp_path)
    store.record()
    (tmp_path / PROGRAM / "scan" / "128.so").write_bytes(b"kernel for larger groups")
    store.record()

    store = new_process()
    assert build_program(store, tmp_path)
    assert store.warnings == []


def test_kernel_that_no_process_recorded_makes_its_program_built_anew_with_a_warning(new_process, recorded_folder):
    (recorded_folder / PROGRAM / "scan" / "256.so").write_bytes(b"of a process that died")
    store = new_process()
    assert not build_program(store, recorded_folder)
    assert store.warnings == [UNFINISHED]


def test_record_keeps_the_programs_that_two_environments_build_from_the_same_source(new_process, tmp_path):
    for program in (PROGRAM, "AB/OF_ANOTHER", PROGRAM, "AB/OF_ANOTHER"):
        for path in (*tmp_path.rglob("*.bc"), *tmp_path.rglob("last_accessed")):
            os.utime(path, (1, 1))  # not used since
        store = new_process()
        build_program(store, tmp_path, program)
        store.record()
        assert store.warnings == []
    assert recorded_programs(tmp_path) == {PROGRAM, "AB/OF_ANOTHER"}


def test_record_drops_the_program_that_another_process_has_built_at_the_same_time(new_process, tmp_path):
    """A program that appears during a build may belong to it, until the record of another key has it."""
    store = new_process()
    with store.building(KEY):
        write_program(tmp_path)
        (tmp_path / "AB" / "OTHER").mkdir()
        (tmp_path / "AB" / "OTHER" / "program.bc").write_bytes(b"of another process")
    store.record()
    assert recorded_programs(tmp_path) == {PROGRAM, "AB/OTHER"}
    (tmp_path / "records" / ("b" * 64)).write_text(json.dumps({"AB/OTHER": {"program.bc": [1, 1, "of its own"]}}))
    os.utime(tmp_path / "AB" / "OTHER" / "program.bc", (1, 1))

    store = new_process()
    build_program(store, tmp_path)
    store.record()

    assert recorded_programs(tmp_path) == {PROGRAM}


def test_program_that_appears_while_a_recorded_one_is_used_is_not_recorded(new_process, recorded_folder):
    (recorded_folder / "AB" / "LATER").mkdir()
    store = new_process()
    with store.building(KEY):
        write_program(recorded_folder)
        (recorded_folder / "AB" / "LATER" / "program.bc").write_bytes(b"of another process")
    store.record()
    assert recorded_programs(recorded_folder) == {PROGRAM}


def test_forgotten_program_is_built_anew_in_silence(new_process, tmp_path):
    """A program is forgotten when it computes wrongly."""
    store = new_process()
    build_program(store, tmp_path)
    store.record()
    store.forget(KEY)
    store.record()

    store = new_process()
    assert not build_program(store, tmp_path)
    assert store.warnings == []


def test_building_and_recording_in_a_removed_folder_raise_no_error(new_process, tmp_path):
    store = new_process()
    shutil.rmtree(tmp_path)
    assert not build_program(store, tmp_path)
    store.record()


@contextmanager
def locked(path, kind):
    """A file that another process has locked."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT)
    try:
        pocl.fcntl.flock(handle, kind)
        yield
    finally:
        os.close(handle)


def another_process_at_work(folder):
    """Another process builds programs in this folder: it holds the lock of those that use it."""
    return locked(folder / "in-use", pocl.fcntl.LOCK_SH)


def another_process_changing_its_lock(folder):
    """Another process, at work too, tries whether it is alone, and has no lock of those that use it for a moment."""
    return locked(folder / "trying", pocl.fcntl.LOCK_EX)


def test_program_without_a_record_is_kept_while_another_process_is_at_work(new_process, tmp_path):
    write_program(tmp_path)
    store = new_process()
    with another_process_at_work(tmp_path):
        assert build_program(store, tmp_path)
    assert store.warnings == []


def test_temporary_files_are_removed_once_no_other_process_is_at_work(new_process, tmp_path):
    new_process()
    temporary = tmp_path / "tempfile_abc.so"
    temporary.write_bytes(b"")
    with another_process_at_work(tmp_path):
        new_process()
        assert temporary.exists()
    new_process()
    assert not temporary.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_temporary_files_stay_while_another_process_changes_its_lock(new_process, tmp_path):
    temporary = tmp_path / "tempfile_abc.so"
    temporary.write_bytes(b"")
    with another_process_changing_its_lock(tmp_path):
        new_process()
    assert temporary.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
@pytest.mark.parametrize(
    ("is_other_at_work", "warnings"), [(True, []), (False, [DAMAGED])], ids=["by another process", "by nobody"]
)
def test_kernel_that_was_replaced_is_built_anew_with_a_warning_if_no_other_process_is_at_work(
    is_other_at_work, warnings, new_process, recorded_folder
):
    store = new_process()
    (recorded_folder / KERNEL).write_bytes(b"of another process")
    with another_process_at_work(recorded_folder) if is_other_at_work else nullcontext():
        assert not build_program(store, recorded_folder)
    assert store.warnings == warnings


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_program_built_anew_after_another_process_replaced_it_is_recorded(new_process, recorded_folder):
    store = new_process()
    (recorded_folder / KERNEL).write_bytes(b"of another process")
    with another_process_at_work(recorded_folder):
        build_program(store, recorded_folder)
    store.record()

    store = new_process()
    assert build_program(store, recorded_folder)
    assert store.warnings == []


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_two_processes_that_each_asked_whether_they_are_alone_still_see_each_other(new_process, tmp_path):
    """A lock that cannot be made exclusive is lost: it has to be taken again."""
    first, second = new_process(), KnownGood(tmp_path)
    try:
        assert not second._is_alone()
        assert not first._is_alone()
    finally:
        os.close(second._handle)
    assert first._is_alone()


def test_process_records_its_programs_before_its_end_only_after_5_seconds(new_process, tmp_path, monkeypatch):
    now = 100.0
    monkeypatch.setattr(pocl.time, "perf_counter", lambda: now)
    store = new_process()
    build_program(store, tmp_path)
    now += 5.0
    store.record_when_due()
    assert not (tmp_path / "records" / KEY).exists()
    now += 0.1
    store.record_when_due()
    assert (tmp_path / "records" / KEY).exists()
