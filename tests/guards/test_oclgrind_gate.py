"""The Oclgrind check fails for a faulty kernel although Oclgrind itself exits 0, and passes for a sound one."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys

import pytest
from house import ROOT

PROGRAM = """
import os
os.environ.setdefault("PYOPENCL_CACHE_FAILURE_FATAL", "")
import numpy, pyopencl
(platform,) = pyopencl.get_platforms()
assert platform.name == "Oclgrind"
context = pyopencl.Context(platform.get_devices()[:1])
queue = pyopencl.CommandQueue(context)
out = pyopencl.Buffer(context, pyopencl.mem_flags.READ_WRITE, 64)
scratch = pyopencl.Buffer(context, pyopencl.mem_flags.READ_WRITE, 64)
source = "kernel void run(global int *out, global int *scratch) { int i = get_global_id(0); STATEMENT; }"
program = pyopencl.Program(context, source.replace("STATEMENT", STATEMENT)).build(cache_dir=False)
program.run(queue, (16,), (4,), out, scratch)
queue.finish()
"""


def check_python(code: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run Python code under the check."""
    script = str(ROOT / "scripts" / "proof" / "check_oclgrind.py")
    return subprocess.run(
        [sys.executable, script, *options, sys.executable, "-c", code], capture_output=True, text=True
    )


def check_kernel(statement: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run 16 work-items of a kernel with this statement, which may write 16 integers to `out`, under the check."""
    return check_python(PROGRAM.replace("STATEMENT)", f"{statement!r})"), *options)


@pytest.fixture
def oclgrind() -> str:
    """The path of Oclgrind; skips where it is missing."""
    path = shutil.which("oclgrind")
    if path is None or importlib.util.find_spec("pyopencl") is None:
        if os.environ.get("CLRECON_REQUIRE_OCLGRIND"):
            pytest.fail("CLRECON_REQUIRE_OCLGRIND is set, but oclgrind or pyopencl is not installed")
        pytest.skip("oclgrind is not installed")
    return path


@pytest.mark.parametrize(("statement", "fault"), [("out[i + 1] = i", "Invalid write"), ("out[0] = i", "data race")])
@pytest.mark.usefixtures("oclgrind")
def test_oclgrind_check_fails_for_a_faulty_kernel_and_names_the_fault(statement: str, fault: str) -> None:
    done = check_kernel(statement)
    assert done.returncode == 1
    assert "Oclgrind reports faults" in done.stderr
    assert fault in done.stderr


READS_UNWRITTEN = "out[i] = scratch[i] > 3 ? 1 : 2"


@pytest.mark.usefixtures("oclgrind")
def test_oclgrind_check_passes_for_uninitialised_values_by_default() -> None:
    assert check_kernel(READS_UNWRITTEN).returncode == 0


@pytest.mark.usefixtures("oclgrind")
def test_oclgrind_check_fails_for_uninitialised_values_on_request() -> None:
    done = check_kernel(READS_UNWRITTEN, "--uninitialized")
    assert done.returncode == 1
    assert "Uninitialized value" in done.stderr


@pytest.mark.usefixtures("oclgrind")
def test_oclgrind_check_passes_for_a_sound_kernel() -> None:
    done = check_kernel("out[i] = i")
    assert (done.returncode, done.stdout.strip()) == (0, "Oclgrind reports nothing"), done.stderr


@pytest.mark.usefixtures("oclgrind")
@pytest.mark.parametrize(("code", "fault"), [("raise SystemExit(3)", "exit status 3"), ("pass", "no log")])
def test_oclgrind_check_fails_for_a_command_that_fails_or_launches_nothing(code: str, fault: str) -> None:
    done = check_python(code)
    assert done.returncode == 1
    assert fault in done.stderr
