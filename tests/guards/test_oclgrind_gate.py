"""The Oclgrind check is red for a faulty kernel although Oclgrind itself exits 0, and green for a sound one."""

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


def check(statement: str, *options: str) -> subprocess.CompletedProcess[str]:
    script = ROOT / "scripts" / "proof" / "check_oclgrind.py"
    code = PROGRAM.replace("STATEMENT)", f"{statement!r})")
    return subprocess.run(
        [sys.executable, str(script), *options, sys.executable, "-c", code], capture_output=True, text=True
    )


@pytest.fixture
def oclgrind() -> str:
    path = shutil.which("oclgrind")
    if path is None or importlib.util.find_spec("pyopencl") is None:
        if os.environ.get("CLRECON_REQUIRE_OCLGRIND"):
            pytest.fail("CLRECON_REQUIRE_OCLGRIND is set, but oclgrind or pyopencl is not installed")
        pytest.skip("oclgrind is not installed")
    return path


@pytest.mark.parametrize(("statement", "fault"), [("out[i + 1] = i", "Invalid write"), ("out[0] = i", "data race")])
def test_a_faulty_kernel_is_red(oclgrind: str, statement: str, fault: str) -> None:
    done = check(statement)
    assert done.returncode == 1
    assert "Oclgrind reports faults" in done.stderr and fault in done.stderr


def test_uninitialised_values_are_reported_on_request(oclgrind: str) -> None:
    statement = "out[i] = scratch[i] > 3 ? 1 : 2"
    assert check(statement).returncode == 0
    done = check(statement, "--uninitialized")
    assert done.returncode == 1
    assert "Uninitialized value" in done.stderr


def test_a_sound_kernel_is_green(oclgrind: str) -> None:
    done = check("out[i] = i")
    assert (done.returncode, done.stdout.strip()) == (0, "Oclgrind reports nothing"), done.stderr


@pytest.mark.parametrize(("code", "said"), [("raise SystemExit(3)", "exit status 3"), ("pass", "no log")])
def test_a_failing_or_idle_command_is_red(oclgrind: str, code: str, said: str) -> None:
    script = str(ROOT / "scripts" / "proof" / "check_oclgrind.py")
    done = subprocess.run([sys.executable, script, sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert said in done.stderr
