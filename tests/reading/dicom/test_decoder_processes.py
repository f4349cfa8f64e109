"""Decoding in processes with limits: rows 38 (bombs) and 40 (garbage, decoder crash) of the fault list."""

from __future__ import annotations

import io
import json
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from clrecon.reading.dicom.pixels import decoder_pool, decoder_process
from clrecon.reading.dicom.pixels.decoder_pool import DecoderError, DecoderPool

PIXELS = np.arange(12 * 9, dtype=np.int16).reshape(12, 9)
LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="how processes end is looked up in /proc")


def make_pool(*names, **limits):
    """A pool with the decoder that copies, and others of tests/support/hostile_decoders.py."""
    return DecoderPool([f"hostile_decoders:{name}" for name in ("copy", *names)], PIXELS.nbytes, **limits)


def decode(pool, name="copy"):
    out = np.zeros_like(PIXELS)
    pool.decode(PIXELS.tobytes(), f"hostile_decoders:{name}", out)
    return out


def is_alive(pid: int) -> bool:
    """True while a process runs; a zombie does not count as one, and does as a fault where we are its parent."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def wait_for_end(pids, seconds=10.0):
    end = time.monotonic() + seconds
    while any(map(is_alive, pids)) and time.monotonic() < end:
        time.sleep(0.02)
    return not any(map(is_alive, pids))


def test_frames_are_decoded_one_after_the_other_in_one_process():
    with make_pool() as pool:
        assert np.array_equal(decode(pool), PIXELS)
        assert np.array_equal(decode(pool), PIXELS)
        assert len(pool.process_ids()) == 1


@pytest.mark.fault_row(40)
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("crash", r"crash the decoder \(signal 11\)"),
        ("leave", r"crash the decoder \(exit code 7\)"),
        ("give_another_shape", r"do not decode \(an image of shape \(13, 9\), int16\)"),
        ("fail", r"do not decode \(ValueError: no such\\nmarker \\x1b\[31m\)"),
    ],
)
def test_decoder_that_fails_refuses_its_frame_and_the_next_one_is_decoded(name, words):
    with make_pool(name) as pool:
        assert np.array_equal(decode(pool), PIXELS)
        with pytest.raises(DecoderError, match=words):
            decode(pool, name)
        assert np.array_equal(decode(pool), PIXELS)


@pytest.mark.fault_row(40)
def test_decoder_that_hangs_is_ended_in_time_and_the_next_frame_is_decoded():
    limit_s = 1.5
    with make_pool("hang", seconds=limit_s) as pool:
        assert np.array_equal(decode(pool), PIXELS)
        start = time.monotonic()
        with refused(DecoderError, limit_s):
            decode(pool, "hang")
        assert time.monotonic() - start < 10  # measured 1.5, the limit; more on a busy machine
        assert np.array_equal(decode(pool), PIXELS)


@LINUX
def test_decoder_process_waits_for_its_next_frame_longer_than_a_frame_may_take():
    """A disk or network drive may be slower than any decoder."""
    with make_pool(seconds=0.9) as pool:
        assert np.array_equal(decode(pool), PIXELS)
        time.sleep(6.0)  # also longer than the alarm of a process, 5 s and the whole seconds for a frame
        assert np.array_equal(decode(pool), PIXELS)


def test_time_in_which_the_whole_program_stood_still_is_not_counted_for_a_frame(monkeypatch):
    """Ctrl-Z and fg, or a debugger: the processes stood still with it."""
    clock, stood_still = time.monotonic, [0.0]
    monkeypatch.setattr(decoder_pool.time, "monotonic", lambda: clock() + stood_still[0])
    with make_pool("nap", seconds=20.0) as pool:
        stop = threading.Timer(0.5, lambda: stood_still.__setitem__(0, 1000.0))
        stop.start()
        assert np.array_equal(decode(pool, "nap"), PIXELS)
        stop.join()
        assert np.array_equal(decode(pool, "nap"), PIXELS)


@pytest.mark.fault_row(38)
def test_decoder_that_takes_too_much_memory_is_stopped_and_the_next_frame_is_decoded():
    with make_pool("allocate", memory_bytes=100 * 2**20) as pool:
        with refused(DecoderError, 100, "MiB"):
            decode(pool, "allocate")
        assert np.array_equal(decode(pool), PIXELS)


def test_limits_of_time_and_memory_grow_with_the_bytes_of_a_frame():
    small, large = (DecoderPool([], frame_bytes=mebibytes << 20) for mebibytes in (1, 128))
    assert (small.seconds, large.seconds) == (60 + 1, 60 + 128)  # a minute, and a second a MiB
    memory_mib = [pool.memory_bytes / 2**20 for pool in (small, large)]
    assert memory_mib == [256 + 32 * 1, 256 + 32 * 128]  # 256 MiB, and 32 times the frame


def test_what_a_decoder_prints_is_dropped(capfd):
    with make_pool("print_much") as pool:
        assert np.array_equal(decode(pool, "print_much"), PIXELS)
    assert capfd.readouterr() == ("", "")


def test_decoder_that_cannot_be_imported_is_refused_with_its_module():
    with (
        DecoderPool(["no_such_module:decode"], frame_bytes=8) as pool,
        refused(DecoderError, "ModuleNotFoundError", "no_such_module"),
    ):
        pool.decode(b"", "no_such_module:decode", np.zeros((1, 1), np.int16))


@pytest.mark.parametrize(
    ("executable", "words"),
    [
        ("/no/such/python", "no process can be started"),
        ("", "has none"),
        ("/bin/false", r"the process for it does not start \(exit code 1\)"),
    ],
)
def test_frame_is_refused_and_not_decoded_in_this_process_where_no_other_can_be_started(monkeypatch, executable, words):
    monkeypatch.setattr(sys, "executable", executable)
    with make_pool() as pool:
        with pytest.raises(DecoderError, match=words):
            decode(pool)
        assert pool.process_ids() == []


@LINUX
def test_processes_inherit_no_handles_and_leave_none(tmp_path):
    before = sorted(os.listdir("/proc/self/fd"))
    with open(tmp_path / "secret", "w") as file:
        os.set_inheritable(file.fileno(), True)
        with make_pool("list_handles") as pool:
            handles = decode(pool, "list_handles")
            # Output, errors, replies, the lifeline, and the folder that is being listed; 0 is standard input.
            assert np.count_nonzero(handles) == 5
            pids = pool.process_ids()
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)  # no zombie either
    assert sorted(os.listdir("/proc/self/fd")) == before


@LINUX
def test_threads_have_at_most_a_decoder_process_each_and_all_of_them_end():
    thread_count, frames = 3, 20
    with make_pool() as pool:
        barrier = threading.Barrier(thread_count)
        results: list = []

        def work():
            barrier.wait()
            results.extend(np.array_equal(decode(pool), PIXELS) for _ in range(frames))

        threads = [threading.Thread(target=work) for _ in range(thread_count)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        pids = pool.process_ids()
    assert results == [True] * (thread_count * frames)
    assert 1 <= len(pids) <= thread_count
    assert not any(Path(f"/proc/{pid}").exists() for pid in pids)


def test_killing_a_pool_ends_the_decoder_of_another_thread_and_refuses_further_frames():
    with make_pool("hang") as pool:
        errors = []

        def decode_for_ever():
            try:
                decode(pool, "hang")
            except DecoderError as error:
                errors.append(str(error))

        thread = threading.Thread(target=decode_for_ever)
        thread.start()
        time.sleep(0.3)
        pool.kill()
        thread.join(10)
        assert errors == ["are not decoded: reading was stopped"]
        with refused(DecoderError, "stopped"):
            decode(pool)


SCRIPT = """
import sys, threading, time
import numpy as np
sys.path[:0] = {path!r}
from clrecon.reading.dicom.pixels.decoder_pool import DecoderPool
pool = DecoderPool(["hostile_decoders:copy", "hostile_decoders:hang"], 16)
out = np.zeros((2, 2), np.int16)
pool.decode(bytes(8), "hostile_decoders:copy", out)
threading.Thread(target=pool.decode, args=(bytes(8), {name!r}, out), daemon=True).start()
time.sleep(0.2)
print(*pool.process_ids(), flush=True)
time.sleep(60)
"""


STREAMS_CLOSED = """
import os, sys
sys.path[:0] = {path!r}
for number in {numbers!r}:
    os.close(number)
import numpy as np
from clrecon.reading.dicom.pixels.decoder_pool import DecoderPool
out = np.zeros((2, 2), np.int16)
with DecoderPool(["hostile_decoders:copy"], 16) as pool:
    pool.decode(bytes(range(8)), "hostile_decoders:copy", out)
    pool.decode(bytes(range(8)), "hostile_decoders:copy", out)
os._exit(0 if out.tobytes() == bytes(range(8)) else 9)
"""


@pytest.mark.skipif(os.name != "posix", reason="numbers of open files")
@pytest.mark.parametrize("numbers", [(0,), (1,), (0, 1, 2), (0, 2)])
def test_frames_are_decoded_in_a_program_with_closed_standard_streams(numbers):
    """Services start programs so; what is opened next takes the numbers of the streams."""
    code = STREAMS_CLOSED.format(path=[entry for entry in sys.path if entry], numbers=numbers)
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0


def test_decoder_process_imports_no_module_from_the_current_folder(tmp_path, monkeypatch):
    """A folder of scans is anybody's: a numpy.py in it must not run."""
    (tmp_path / "numpy.py").write_text("open('ran', 'w')")
    (tmp_path / "own_decoder.py").write_text("open('ran', 'w')")
    monkeypatch.chdir(tmp_path)
    for entry in ("", ".", str(tmp_path)):
        monkeypatch.setattr(sys, "path", [entry, *sys.path])
    with make_pool() as pool:
        assert np.array_equal(decode(pool), PIXELS)
    with DecoderPool(["own_decoder:decode"], frame_bytes=8) as pool, refused(DecoderError, "module"):
        pool.decode(b"", "own_decoder:decode", np.zeros((1, 1), np.int16))
    assert not (tmp_path / "ran").exists()


@LINUX
@pytest.mark.parametrize("name", ["hostile_decoders:copy", "hostile_decoders:hang"], ids=["idle", "in a decoder"])
def test_decoder_process_ends_with_a_parent_that_is_killed(name):
    """A script without a guard around its start, killed while its decoder is idle or at work."""
    code = SCRIPT.format(path=[entry for entry in sys.path if entry], name=name)
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        pids = [int(word) for word in parent.stdout.readline().split()]
        (pid,) = pids
        assert is_alive(pid)
        parent.kill()
        assert wait_for_end(pids)


@pytest.mark.parametrize("words", ["import clrecon", "from clrecon", "pydicom import"])
def test_script_of_the_decoder_process_imports_neither_clrecon_nor_pydicom(words):
    assert words not in Path(decoder_pool.SCRIPT).read_text(encoding="utf-8")


@LINUX
def test_process_is_signalled_when_the_other_end_of_its_lifeline_closes_and_exits_if_it_is_closed_already():
    """The steps of the decoder process, taken in this one, which gets the same signal and does not end."""
    import fcntl

    signals = []
    before = signal.signal(signal.SIGIO, lambda number, frame: signals.append(number))
    ours, theirs = os.pipe()
    try:
        fcntl.fcntl(ours, fcntl.F_SETFL, fcntl.fcntl(ours, fcntl.F_GETFL) | os.O_NONBLOCK)
        decoder_process.end_with(ours)
        assert fcntl.fcntl(ours, fcntl.F_GETFL) & os.O_ASYNC
        assert not os.get_blocking(ours)
        assert fcntl.fcntl(ours, fcntl.F_GETOWN) == os.getpid()
        assert signals == []
        os.close(theirs)
        assert signals == [signal.SIGIO]
        with record_exits() as codes:
            decoder_process.end_with(ours)
        assert codes == [1]  # it had ended before we asked
    finally:
        os.close(ours)
        signal.signal(signal.SIGIO, before)


@contextmanager
def record_exits():
    codes: list[int] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "_exit", codes.append)
        yield codes


@pytest.mark.parametrize(("lifeline", "is_orphan"), [(-1, True), (0, False), (3, False)])
def test_decoder_process_answers_with_pixels_and_is_limited_as_an_orphan_only_without_a_lifeline(
    monkeypatch, lifeline, is_orphan
):
    """The main function in this process, with what changes the process itself put aside."""
    settings = {"path": sys.path, "decoders": ["hostile_decoders:copy"], "memory_bytes": 1, "seconds": 4.0}
    request = {"decoder": "hostile_decoders:copy", "dtype": "<i2", "rows": 12, "columns": 9, "length": PIXELS.nbytes}
    lines = f"{json.dumps(settings)}\n{json.dumps(request)}\n".encode()
    source, sink = io.BytesIO(lines + PIXELS.tobytes()), io.BytesIO()
    limits: list[object] = []
    alarms: list[int] = []
    for name, aside in {
        "end_with": lambda number: None,
        "take_standard_output": lambda: sink,
        "limit_memory": lambda count: limits.append(count),
        "limit_time": lambda *arguments: limits.append(arguments),
    }.items():
        monkeypatch.setattr(decoder_process, name, aside)
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(signal, "alarm", alarms.append)
    monkeypatch.setattr(sys, "argv", ["decoder_process.py", str(lifeline)])
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(source))
    decoder_process.main()
    assert limits == [1, (4.0, is_orphan)]
    assert alarms == [0]  # none runs while it waits for the next frame
    ready = struct.pack(decoder_process.REPLY, decoder_process.READY, 0)
    done = struct.pack(decoder_process.REPLY, decoder_process.DONE, PIXELS.nbytes)
    assert sink.getvalue() == ready + done + PIXELS.tobytes()
