"""A batch on a real Dask cluster: the same files, a killed worker, a scheduler that goes away or is not there."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from batch_processes import children_of, wait_until

from clrecon.cli.main import main
from clrecon.proof.phantom import PhantomSettings, write_phantom

pytestmark = [
    pytest.mark.seconds,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc"),
]

CASES = [f"case{number}" for number in range(6)]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Cases of one small ball, and one whose scan is missing."""
    ball = PhantomSettings(kind="sphere", size=(24, 24), slices=12, spacing=(0.5, 0.5, 0.5), radius_mm=2.0, noise=0.0)
    write_phantom(tmp_path / "ball", ball)
    rows = [f"{case},ball\n" for case in CASES]
    (tmp_path / "m.csv").write_text("".join(["case,input\n", *rows, "gone,nowhere\n"]))
    return tmp_path


def start_batch(folder: Path, *options: str, **variables: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "clrecon", "batch", "--no-picture", "m.csv", "-o", "out", "--hu", "300", *options]
    return subprocess.Popen(
        command, cwd=folder, env=os.environ | variables, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def meshes(folder: Path) -> dict[str, bytes]:
    return {path.parent.name: path.read_bytes() for path in (folder / "out").glob("*/mesh.stl")}


def test_killed_worker_of_a_cluster_loses_no_case_and_each_has_the_bytes_of_the_mesh_command(folder: Path) -> None:
    process = start_batch(folder, "--scheduler", "local", "--json")
    wait_until(process, (folder / "out" / CASES[0]).exists)
    (worker,) = (child for child in children_of(process.pid) if children_of(child))  # its child makes the cases
    os.kill(worker, signal.SIGKILL)
    output, errors = process.communicate(timeout=240)

    assert process.returncode == 8, errors
    assert json.loads(output)["statuses"] == {"done": len(CASES), "refused": 1}
    alone = ["mesh", str(folder / "ball"), "-o", str(folder / "mesh.stl"), "--hu", "300", "-q"]
    assert main(alone) == 0
    assert meshes(folder) == dict.fromkeys(CASES, (folder / "mesh.stl").read_bytes())


@pytest.fixture
def dask(folder: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Start a part of Dask on the loopback interface; all parts end with the test."""
    with ExitStack() as stack:

        def start_part(part: str, *options: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", f"distributed.cli.dask_{part}", "--scheduler-file", "s.json", *options]
            process = subprocess.Popen(
                [*command, "--host", "127.0.0.1", "--no-dashboard"],
                cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
            stack.enter_context(process)
            stack.callback(process.kill)
            return process

        yield start_part


def test_batch_whose_scheduler_goes_away_ends_with_9_and_resumes_without_one(
    folder: Path, dask: Callable[..., subprocess.Popen[bytes]]
) -> None:
    scheduler = dask("scheduler", "--port", "0")
    wait_until(scheduler, (folder / "s.json").exists)
    dask("worker", "--nthreads", "1", "--no-nanny")
    address = json.loads((folder / "s.json").read_text())["address"]
    process = start_batch(folder, "--scheduler", address, DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT="2s")
    wait_until(process, (folder / "out" / CASES[0]).exists)
    scheduler.kill()
    _, errors = process.communicate(timeout=240)

    assert process.returncode == 9, errors
    *_, last = errors.splitlines()
    assert address in last and "--resume" in last
    resumed = start_batch(folder, "--resume", "--json")
    output, _ = resumed.communicate(timeout=240)
    assert json.loads(output)["statuses"] == {"done": len(CASES), "refused": 1}
    assert json.loads(output)["kept"] >= 1


def test_address_where_no_scheduler_answers_ends_with_9_before_any_case(folder: Path) -> None:
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))  # and does not listen
        address = f"tcp://127.0.0.1:{nobody.getsockname()[1]}"
        process = start_batch(folder, "--scheduler", address, DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT="200ms")
        _, errors = process.communicate(timeout=240)

    assert process.returncode == 9 and address in errors and len(errors.splitlines()) == 1
    assert list((folder / "out").iterdir()) == []
