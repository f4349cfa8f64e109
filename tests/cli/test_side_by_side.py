"""Rows of the list of faults that are about whole processes: side by side, one after the other, in odd environments."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from variants import daily

from clrecon.proof.phantom import PhantomSettings, write_phantom

UNEQUAL = {"seconds", "peak_memory_bytes"}


@pytest.fixture(scope="module")
def ct(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small noisy spine, of which every run has to make the same."""
    folder = tmp_path_factory.mktemp("ct") / "spine"
    write_phantom(folder, PhantomSettings(kind="spine", size=(48, 48), slices=24, noise=20.0))
    return folder


def start_mesh(ct: Path, target: Path, device: Any, **variables: str) -> subprocess.Popen[str]:
    """Make a mesh and a report in a process."""
    command = [sys.executable, "-m", "clrecon", "mesh", str(ct), "-o", str(target), "--device", str(device.index)]
    command += ["--report", str(target.with_suffix(".json")), "-q"]
    return subprocess.Popen(
        command,
        env={**os.environ, **variables},
        umask=int(variables.get("UMASK", "0o022"), 8),
        stderr=subprocess.PIPE,
        text=True,
    )


def finish(process: subprocess.Popen[str]) -> None:
    _, errors = process.communicate(timeout=300)
    own = [line for line in errors.splitlines() if not line.startswith("MESA: ")]  # a driver's own words
    assert (process.returncode, own) == (0, [])


def make_targets(folder: Path, extension: str) -> list[Path]:
    """Two files of one name, each in a folder of its own."""
    targets = [folder / name / f"mesh{extension}" for name in ("first", "second")]
    for target in targets:
        target.parent.mkdir()
    return targets


def without_unequal_facts(value: Any) -> Any:
    """A report without what differs from run to run."""
    if isinstance(value, dict):
        return {key: without_unequal_facts(own) for key, own in value.items() if key not in UNEQUAL}
    return [without_unequal_facts(own) for own in value] if isinstance(value, list) else value


def read_output(target: Path) -> tuple[str, Any]:
    """The checksum of a mesh, and its report without what differs from run to run."""
    text = target.with_suffix(".json").read_text().replace(str(target.parent), "")
    return hashlib.sha256(target.read_bytes()).hexdigest(), without_unequal_facts(json.loads(text))


@pytest.mark.fault_row(60, 72)
@pytest.mark.slow
@pytest.mark.parametrize("extension", daily(1, [".stl", ".vtp"]))
def test_mesh_and_report_are_the_same_with_other_threads_locale_time_zone_and_umask(
    device, ct: Path, tmp_path: Path, extension: str
) -> None:
    plain, odd = make_targets(tmp_path, extension)
    finish(start_mesh(ct, plain, device))
    finish(
        start_mesh(
            ct,
            odd,
            device,
            POCL_MAX_PTHREAD_COUNT="1",
            LP_NUM_THREADS="1",
            OMP_NUM_THREADS="1",
            LC_ALL="de_DE.UTF-8",
            LANG="de_DE.UTF-8",
            TZ="Pacific/Kiritimati",
            UMASK="0o000",
            PYTHONHASHSEED="1",
        )
    )
    assert read_output(plain) == read_output(odd)


def test_trilinear_topology_may_be_that_of_the_first_surface_of_a_process(device, ct: Path, tmp_path: Path) -> None:
    """Its kernels are built by themselves, while those of other meshes are built as one program."""
    target = tmp_path / "trilinear.stl"
    command = [sys.executable, "-m", "clrecon", "mesh", str(ct), "-o", str(target), "--device", str(device.index)]
    done = subprocess.run([*command, "--topology", "trilinear", "-q"], timeout=300)
    assert (done.returncode, target.exists()) == (0, True)


@pytest.mark.fault_row(58)
@pytest.mark.release
@pytest.mark.seconds
def test_two_processes_on_one_device_at_once_write_the_same_mesh_and_report(device, ct: Path, tmp_path: Path) -> None:
    """Both begin with an empty cache of kernels."""
    cache = tmp_path / "cache"
    cache.mkdir(mode=0o700)
    variables = {"XDG_CACHE_HOME": str(cache), "POCL_CACHE_DIR": str(cache / "pocl")}
    targets = make_targets(tmp_path, ".stl")
    processes = [start_mesh(ct, target, device, **variables) for target in targets]
    for process in processes:
        finish(process)
    assert read_output(targets[0]) == read_output(targets[1])
