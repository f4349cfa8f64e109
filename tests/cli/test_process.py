"""The command line as a process of its own: streams, exit codes, start-up."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from ct_files import write_series
from house import ROOT

COMMAND = [sys.executable, "-m", "clrecon.cli.main"]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT)}


def run_clrecon(*arguments: str, stdout: Any = subprocess.PIPE, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *arguments],
        env=ENVIRONMENT | variables, stdout=stdout, stderr=subprocess.PIPE, text=True, timeout=120,
    )  # fmt: skip


def test_help_is_on_standard_output_within_three_seconds() -> None:
    start = time.perf_counter()
    done = run_clrecon("--help")
    elapsed = time.perf_counter() - start
    assert (done.returncode, done.stderr) == (0, "")
    assert "mesh         make a mesh from a CT series" in done.stdout
    assert elapsed < 3.0  # 0.07 s on an idle machine; what is imported is what the guards look at


def test_help_imports_neither_numpy_nor_a_driver() -> None:
    done = run_clrecon("mesh", "--help", PYTHONPROFILEIMPORTTIME="1")
    imported = {line.rpartition("|")[2].strip().partition(".")[0] for line in done.stderr.splitlines()}
    assert "argparse" in imported
    assert imported & {"numpy", "pydicom", "pyopencl", "vtk", "vtkmodules", "pyvista", "skimage", "scipy"} == set()


def test_error_of_a_process_is_one_line_on_standard_error_and_its_exit_code(tmp_path: Path) -> None:
    done = run_clrecon("info", str(tmp_path / "nothing here"))
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("clrecon: error: ")


@pytest.mark.skipif(os.name != "posix", reason="pipes and signals of POSIX")
def test_reader_that_leaves_early_is_no_error(tmp_path: Path) -> None:
    write_series(tmp_path / "ct")
    reading, writing = os.pipe()
    os.close(reading)
    done = run_clrecon("info", str(tmp_path / "ct"), stdout=writing)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_process_with_a_full_disk_behind_standard_output_ends_with_6(tmp_path: Path) -> None:
    write_series(tmp_path / "ct")
    with open("/dev/full", "w") as full:
        done = run_clrecon("info", str(tmp_path / "ct"), "--json", stdout=full)
    assert done.returncode == 6
    assert done.stderr == "clrecon: error: cannot write to standard output: No space left on device\n"


def test_letters_that_a_plain_locale_has_not_are_printed_as_codes(tmp_path: Path) -> None:
    done = run_clrecon("info", str(tmp_path / "größe"), PYTHONIOENCODING="ascii", PYTHONUTF8="0")
    assert done.returncode == 2
    assert "gr\\xf6\\xdfe" in done.stderr


@pytest.mark.skipif(os.name != "posix", reason="pipes and signals of POSIX")
@pytest.mark.parametrize("sent_signal", [signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)])
def test_interrupted_phantom_ends_with_130_and_leaves_no_files(sent_signal: signal.Signals, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*COMMAND, "phantom", str(tmp_path / "ph"), "--slices", "300", "-v"],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    assert "drawing the phantom" in process.stderr.readline()
    process.send_signal(sent_signal)
    output, errors = process.communicate(timeout=60)
    assert (process.returncode, output) == (130, "")
    assert errors == "clrecon: error: interrupted\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.seconds
def test_pillow_is_imported_by_render_and_not_by_info(tmp_path: Path) -> None:
    write_series(tmp_path / "ct")
    told = "import sys; print(sys.modules.get('PIL') is not None, flush=True)"
    code = f"import atexit; from clrecon.cli import main; atexit.register(lambda: exec({told!r})); main.run()"
    found = []
    for command in (["info"], ["render", "-o", str(tmp_path / "a.png"), "--size", "32", "-q"]):
        done = subprocess.run(
            [sys.executable, "-c", code, *command, str(tmp_path / "ct")],
            env=ENVIRONMENT,
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert done.stdout, (done.returncode, done.stderr)
        found.append((done.returncode, done.stdout.splitlines()[-1]))
    if found[1][0] == 5:
        pytest.skip("no OpenCL device")
    assert found == [(0, "False"), (0, "True")]
    assert (tmp_path / "a.png").stat().st_size > 600  # bytes, so it is no empty file; measured 1293
