"""What ends in the middle of a batch: a killed worker, Ctrl-C, a disk that takes no more; nothing whole is lost."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from clrecon.proof.phantom import PhantomSettings, write_phantom

pytestmark = [
    pytest.mark.seconds,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc"),
]

COMMAND = [sys.executable, "-m", "clrecon", "batch"]


@pytest.fixture
def cohort(tmp_path: Path) -> Path:
    """A folder with a large case among small ones, so that something can happen while it is made."""
    for name, size in (("small", 24), ("large", 256)):
        settings = PhantomSettings(
            kind="sphere", size=(size, size), slices=size // 2, spacing=(0.5, 0.5, 0.5), radius_mm=size / 12, noise=0.0
        )
        write_phantom(tmp_path / name, settings)
    (tmp_path / "m.csv").write_text("case,input\nfirst,small\nsecond,large\nthird,small\n")
    return tmp_path


def start(folder: Path, *options: str, prepare: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, str(folder / "m.csv"), "-o", str(folder / "out"), "--hu", "300", *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=prepare,
    )  # fmt: skip


def statuses(folder: Path) -> dict[str, str]:
    with (folder / "out" / "cohort.csv").open(newline="") as stream:
        return {row["case"]: row["status"] for row in csv.DictReader(stream)}


def children_of(process: subprocess.Popen[str]) -> list[int]:
    tasks = Path(f"/proc/{process.pid}/task")
    return [int(word) for task in tasks.iterdir() for word in (task / "children").read_text().split()]


def wait_for_work(folder: Path, process: subprocess.Popen[str], done: str) -> None:
    """Wait until a case is being made behind `done`: kernels are built then, and no file of a driver is left cut."""
    output = folder / "out"
    end = time.monotonic() + 120.0
    while not (os.path.exists(output / done) and list(output.glob(".clrecon-*.folder"))):
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.002)


def test_killed_worker_takes_its_own_case_along_and_is_named(cohort: Path) -> None:
    process = start(cohort)
    wait_for_work(cohort, process, "first")
    (worker,) = children_of(process)
    os.kill(worker, signal.SIGKILL)
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 8
    assert statuses(cohort) == {"first": "done", "second": "lost", "third": "done"}
    assert "second" in errors and "SIGKILL" in errors
    report = json.loads((cohort / "out" / "second" / "case.json").read_text())
    assert "SIGKILL" in report["error"]["message"]
    again = start(cohort, "--resume", "--json")
    output, _ = again.communicate(timeout=240)
    assert again.returncode == 0
    assert (json.loads(output)["made"], json.loads(output)["kept"]) == (1, 2)


def test_case_of_a_killed_worker_among_several_is_made_again_alone(cohort: Path) -> None:
    process = start(cohort, "--workers", "2")
    wait_for_work(cohort, process, "first")
    for worker in children_of(process):
        os.kill(worker, signal.SIGKILL)
    process.communicate(timeout=240)
    assert process.returncode == 0
    assert statuses(cohort) == dict.fromkeys(("first", "second", "third"), "done")


def test_interrupt_leaves_whole_cases_alone(cohort: Path) -> None:
    process = start(cohort)
    wait_for_work(cohort, process, "first")
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in errors
    assert [path.name for path in (cohort / "out").iterdir()] == ["first"]


def test_disk_that_takes_no_more_ends_the_batch_which_resumes_later(cohort: Path) -> None:
    import resource

    limit = (1_500_000, 1_500_000)  # bytes of a file: built kernels and a small mesh fit, the large mesh does not
    process = start(cohort, "--no-picture", prepare=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit))
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 6, errors
    assert len(errors.splitlines()) == 1 and "second" in errors
    assert [path.name for path in (cohort / "out").iterdir()] == ["first"]
    again = start(cohort, "--no-picture", "--resume", "--json")
    output, _ = again.communicate(timeout=240)
    assert again.returncode == 0
    assert (json.loads(output)["made"], json.loads(output)["kept"]) == (2, 1)
