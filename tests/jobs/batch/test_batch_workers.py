"""What ends in the middle of a batch: a killed worker, Ctrl-C, a disk that takes no more; nothing whole is lost."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
from batch_processes import children_of, wait_until

from clrecon.opencl.pocl import KnownGood
from clrecon.proof.phantom import PhantomSettings, write_phantom

pytestmark = [
    pytest.mark.seconds,
    pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc"),
]

COMMAND = [sys.executable, "-m", "clrecon", "batch", "--no-picture"]


SOME_CASES_NOT_DONE, DISK_FULL, INTERRUPTED = 8, 6, 130
"""Exit codes, see docs/contract.md."""


def write_ball(folder: Path, *, size: int) -> None:
    """Write a CT of a ball in `size` x `size` pixels and half as many slices."""
    settings = PhantomSettings(
        kind="sphere", size=(size, size), slices=size // 2, spacing=(0.5, 0.5, 0.5), radius_mm=size / 12, noise=0.0
    )
    write_phantom(folder, settings)


def write_manifest(folder: Path, inputs: Mapping[str, str]) -> None:
    rows = [f"{case},{scan}\n" for case, scan in inputs.items()]
    (folder / "m.csv").write_text("".join(["case,input\n", *rows]))


@pytest.fixture
def small_cases(tmp_path: Path) -> list[str]:
    """Names of so many small cases that none of these tests meets the last one."""
    write_ball(tmp_path / "small", size=24)
    names = [f"case{number}" for number in range(12)]
    write_manifest(tmp_path, dict.fromkeys(names, "small"))
    return names


def start_batch(folder: Path, *options: str, prepare: Callable[[], None] | None = None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, str(folder / "m.csv"), "-o", str(folder / "out"), "--hu", "300", *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=prepare,
    )  # fmt: skip


def statuses(folder: Path) -> dict[str, str]:
    """Status of each case in the table of the cohort."""
    with (folder / "out" / "cohort.csv").open(newline="") as stream:
        return {row["case"]: row["status"] for row in csv.DictReader(stream)}


def test_case_of_a_killed_worker_is_made_again(tmp_path: Path, small_cases: list[str]) -> None:
    process = start_batch(tmp_path)
    first_case = tmp_path / "out" / small_cases[0]
    wait_until(process, first_case.exists)  # no kernel is built any more, whose file could be cut
    (worker,) = children_of(process.pid)
    os.kill(worker, signal.SIGKILL)
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    assert statuses(tmp_path) == dict.fromkeys(small_cases, "done")


def test_case_whose_process_is_killed_twice_is_lost_with_the_signal_and_resume_makes_it(tmp_path: Path) -> None:
    write_ball(tmp_path / "small", size=24)
    write_manifest(tmp_path, {"only": "small"})
    process = start_batch(tmp_path)
    killed: set[int] = set()
    for _ in range(2):
        wait_until(process, lambda: bool({*children_of(process.pid)} - killed))
        (worker,) = {*children_of(process.pid)} - killed
        os.kill(worker, signal.SIGKILL)
        killed.add(worker)
    _, errors = process.communicate(timeout=240)
    assert process.returncode == SOME_CASES_NOT_DONE, errors
    assert statuses(tmp_path) == {"only": "lost"}
    assert "SIGKILL" in json.loads((tmp_path / "out" / "only" / "case.json").read_text())["error"]["message"]

    again = start_batch(tmp_path, "--resume", "--json")
    assert json.loads(again.communicate(timeout=240)[0])["made"] == 1
    assert again.returncode == 0


def test_cases_of_two_killed_workers_are_made_again(tmp_path: Path) -> None:
    write_ball(tmp_path / "small", size=24)
    cases = ("first", "second", "third")
    write_manifest(tmp_path, dict.fromkeys(cases, "small"))
    process = start_batch(tmp_path, "--workers", "2")
    wait_until(process, lambda: len(children_of(process.pid)) == 2)  # each has been given a case, and still starts
    for worker in children_of(process.pid):
        os.kill(worker, signal.SIGKILL)
    process.communicate(timeout=240)
    assert process.returncode == 0
    assert statuses(tmp_path) == dict.fromkeys(cases, "done")


def test_interrupted_batch_ends_with_130_and_leaves_only_whole_cases(tmp_path: Path, small_cases: list[str]) -> None:
    process = start_batch(tmp_path)
    wait_until(process, (tmp_path / "out" / small_cases[0]).exists)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED and "Traceback" not in errors
    left = sorted((tmp_path / "out").iterdir(), key=lambda folder: small_cases.index(folder.name))
    assert [folder.name for folder in left] == small_cases[: len(left)] and 0 < len(left) < len(small_cases)
    assert all((folder / "mesh.stl").is_file() and (folder / "case.json").is_file() for folder in left)


def test_kernels_that_a_worker_has_built_are_on_record_when_it_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernels = tmp_path / "clrecon"
    monkeypatch.setenv("POCL_CACHE_DIR", str(kernels))
    write_ball(tmp_path / "small", size=24)
    write_manifest(tmp_path, {"only": "small"})
    process = start_batch(tmp_path, "--no-measure")
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    if not list(kernels.glob("??/*")):
        pytest.skip("this driver keeps no programs, or keeps them elsewhere")
    next_process = KnownGood(kernels)
    next_process.sweep()
    assert next_process.warnings == []


def test_batch_on_a_full_disk_ends_with_6_and_resumes_when_there_is_room(tmp_path: Path) -> None:
    import resource

    write_ball(tmp_path / "small", size=24)
    write_ball(tmp_path / "large", size=256)
    write_manifest(tmp_path, {"first": "small", "second": "large", "third": "small"})
    limit = (1_500_000, 1_500_000)  # bytes of a file: built kernels and a small mesh fit, the large mesh does not
    process = start_batch(tmp_path, prepare=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limit))
    _, errors = process.communicate(timeout=240)
    assert process.returncode == DISK_FULL, errors
    assert len(errors.splitlines()) == 1 and "second" in errors
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["first"]
    again = start_batch(tmp_path, "--resume", "--json")
    output, _ = again.communicate(timeout=240)
    assert again.returncode == 0
    assert (json.loads(output)["made"], json.loads(output)["kept"]) == (2, 1)
