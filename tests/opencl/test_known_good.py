"""What PoCL keeps is compared with what worked before it is loaded: PoCL ends the process on a damaged file."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys

import pytest
from variants import daily

from clrecon.opencl import pocl
from clrecon.opencl.pocl import DAMAGED, UNFINISHED, KnownGood
from clrecon.opencl.quirks import is_pocl

CODE = """
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


def run_child(device, folder, end="well"):
    """Build and launch two small programs in a process; returns its warnings."""
    environment = {**os.environ, "POCL_CACHE_DIR": str(folder), "CLRECON_CHILD": "1"}
    command = [sys.executable, "-c", CODE, str(device.index), end]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == (0 if end == "well" else -6), done.stderr
    count, warnings = json.loads(done.stdout)
    assert count == 140
    return warnings


@pytest.fixture
def built(device, shared_folder, tmp_path):
    """A copy of a folder in which a process has built two programs."""
    if not is_pocl(device.platform):
        pytest.skip("this driver does not end the process")
    made = shared_folder / f"built-on-{device.index}"
    if not made.exists():
        assert run_child(device, made / "clrecon") == []
    return shutil.copytree(made / "clrecon", tmp_path / "clrecon")


def files_of(folder, suffix):
    found = sorted(path for path in folder.glob("??/*/**/*") if path.is_file() and path.suffix == suffix)
    assert found
    return found


def cut(folder):
    for path in files_of(folder, ".bc"):
        os.truncate(path, 100)


def empty(folder):
    for path in files_of(folder, ".so"):
        os.truncate(path, 0)


def overwrite(folder):
    for path in (*files_of(folder, ".bc"), *files_of(folder, ".so")):
        path.write_bytes(random.Random(59).randbytes(path.stat().st_size))


def swap(folder):
    first, second, *_ = (path for path in files_of(folder, ".bc") if path.name == "program.bc")
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)


@pytest.mark.release
@pytest.mark.parametrize("damage", daily(2, [overwrite, swap, cut, empty]))
@pytest.mark.fault_row(59)
def test_damaged_kernels_are_built_anew(damage, device, built):
    damage(built)
    assert run_child(device, built) == [DAMAGED]
    assert run_child(device, built) == []


@pytest.mark.seconds
@pytest.mark.fault_row(59)
def test_programs_of_a_dead_process_are_built_anew(device, built):
    """The process before died: PoCL's files are there, cut by a full disk, and nobody has seen them work."""
    shutil.rmtree(built / "records")
    cut(built)
    assert run_child(device, built) == [UNFINISHED]
    assert run_child(device, built) == []


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.fault_row(59)
def test_a_process_that_dies_leaves_no_record(device, tmp_path):
    if not is_pocl(device.platform):
        pytest.skip("this driver does not end the process")
    run_child(device, tmp_path / "clrecon", end="killed")
    assert files_of(tmp_path / "clrecon", ".bc") and not list((tmp_path / "clrecon" / "records").iterdir())
    assert run_child(device, tmp_path) == [UNFINISHED]


# Without a driver: a folder with files as PoCL writes them


KEY, PROGRAM = "a" * 64, "AB/CDEFG"


@pytest.fixture
def records(tmp_path, monkeypatch):
    """Makes a `KnownGood` as in a new process, with no end of it but `record`."""
    monkeypatch.setattr(pocl.atexit, "register", lambda call: None)
    made: list[KnownGood] = []

    def make():
        for earlier in made:
            os.close(earlier._handle)
        made[:] = [KnownGood(tmp_path)]
        return made[0]

    return make


def touch(folder, kernel=b"kernel"):
    program = folder / PROGRAM
    (program / "scan" / "64").mkdir(parents=True, exist_ok=True)
    (program / "last_accessed").write_bytes(b"")
    if not (program / "program.bc").exists():
        (program / "program.bc").write_bytes(b"program")
    if not (program / "scan" / "64" / "scan.so").exists():
        (program / "scan" / "64" / "scan.so").write_bytes(kernel)


def build(store, tmp_path):
    with store.building(KEY):
        is_there = (tmp_path / PROGRAM).exists()
        touch(tmp_path)
    return is_there


def test_programs_that_worked_are_used_again(records, tmp_path):
    store = records()
    assert not build(store, tmp_path)
    store.record()
    store = records()
    assert build(store, tmp_path) and store.warnings == []


def test_a_copy_of_the_folder_is_as_good(records, tmp_path):
    store = records()
    build(store, tmp_path)
    store.record()
    for path in tmp_path.rglob("*.*"):
        os.utime(path)
    store = records()
    assert build(store, tmp_path) and store.warnings == []


@pytest.mark.parametrize("content", [b"", b"[]", b'{"AB/CDEFG": {"program.bc": [1]}}', b"\xff{"])
def test_a_record_that_cannot_be_read_is_none(content, records, tmp_path):
    store = records()
    build(store, tmp_path)
    store.record()
    (tmp_path / "records" / KEY).write_bytes(content)
    store = records()
    assert not build(store, tmp_path) and store.warnings == [UNFINISHED]


def test_files_that_were_added_later_are_recorded_by_the_process_that_made_them(records, tmp_path):
    store = records()
    build(store, tmp_path)
    store.record()
    added = tmp_path / PROGRAM / "scan" / "128.so"
    added.write_bytes(b"kernel")
    store.record()
    store = records()
    assert build(store, tmp_path) and store.warnings == []
    (tmp_path / PROGRAM / "scan" / "256.so").write_bytes(b"of a process that died")
    store = records()
    assert not build(store, tmp_path) and store.warnings == [UNFINISHED]


def test_two_environments_keep_their_programs_of_the_same_text(records, tmp_path, monkeypatch):
    for program in (PROGRAM, "AB/OF_ANOTHER", PROGRAM, "AB/OF_ANOTHER"):
        monkeypatch.setitem(globals(), "PROGRAM", program)
        for path in tmp_path.rglob("*.bc"):
            os.utime(path, (1, 1))
        for path in tmp_path.rglob("last_accessed"):
            os.utime(path, (1, 1))
        store = records()
        build(store, tmp_path)
        store.record()
        assert store.warnings == []
    assert json.loads((tmp_path / "records" / KEY).read_bytes()).keys() == {PROGRAM, "AB/OF_ANOTHER", "AB/CDEFG"}


def test_programs_built_beside_by_another_process_do_not_stay_in_a_record(records, tmp_path):
    store = records()
    with store.building(KEY):
        touch(tmp_path)
        (tmp_path / "AB" / "OTHER").mkdir()
        (tmp_path / "AB" / "OTHER" / "program.bc").write_bytes(b"of another process")
    store.record()
    assert json.loads((tmp_path / "records" / KEY).read_bytes()).keys() == {PROGRAM, "AB/OTHER"}
    (tmp_path / "records" / ("b" * 64)).write_text(json.dumps({"AB/OTHER": {"program.bc": [1, 1, "of its own"]}}))
    os.utime(tmp_path / "AB" / "OTHER" / "program.bc", (1, 1))
    (tmp_path / "AB" / "LATER").mkdir()
    store = records()
    with store.building(KEY):
        touch(tmp_path)
        (tmp_path / "AB" / "LATER" / "program.bc").write_bytes(b"of another process too")
    store.record()
    assert json.loads((tmp_path / "records" / KEY).read_bytes()).keys() == {PROGRAM}


def test_program_that_turned_out_wrong_is_forgotten(records, tmp_path):
    store = records()
    build(store, tmp_path)
    store.record()
    store.forget(KEY)
    store.record()
    store = records()
    assert not build(store, tmp_path) and store.warnings == []


def test_a_folder_that_is_removed_meanwhile_is_no_error(records, tmp_path):
    store = records()
    shutil.rmtree(tmp_path)
    assert not build(store, tmp_path)
    store.record()


def test_program_that_another_process_builds_stays(records, tmp_path):
    touch(tmp_path)
    store = records()
    other = os.open(tmp_path / "in-use", os.O_RDWR)
    try:
        pocl.fcntl.flock(other, pocl.fcntl.LOCK_SH)
        assert build(store, tmp_path) and store.warnings == []
        (tmp_path / "tempfile_abc.so").write_bytes(b"")
        records()
        assert (tmp_path / "tempfile_abc.so").exists()
    finally:
        os.close(other)
    records()
    assert not (tmp_path / "tempfile_abc.so").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
@pytest.mark.parametrize("is_shared", [True, False])
def test_program_that_another_process_replaces_is_built_again_in_silence(is_shared, records, tmp_path):
    """Two processes build one program; the first has recorded its files when the second replaces them."""
    store = records()
    build(store, tmp_path)
    store.record()
    store = records()
    other = KnownGood(tmp_path)
    try:
        (tmp_path / PROGRAM / "scan" / "64" / "scan.so").write_bytes(b"of the second process")
        if not is_shared:
            os.close(other._handle)
        assert not build(store, tmp_path) and store.warnings == ([] if is_shared else [DAMAGED])
    finally:
        if is_shared:
            os.close(other._handle)
    store.record()
    store = records()
    assert build(store, tmp_path) and store.warnings == []


@pytest.mark.skipif(sys.platform == "win32", reason="no locks of this kind")
def test_a_process_that_asked_in_vain_still_counts(records, tmp_path):
    """A lock that cannot be made exclusive is lost: it has to be taken again."""
    first, second = records(), KnownGood(tmp_path)
    try:
        assert not second._is_alone()
        assert not first._is_alone()
    finally:
        os.close(second._handle)
    assert first._is_alone()


def test_a_long_process_records_what_has_worked_for_some_seconds(records, tmp_path, monkeypatch):
    store = records()
    build(store, tmp_path)
    store.record_when_due()
    assert not (tmp_path / "records" / KEY).exists()
    monkeypatch.setattr(pocl.time, "perf_counter", lambda: float("inf"))
    store.record_when_due()
    assert (tmp_path / "records" / KEY).exists()
