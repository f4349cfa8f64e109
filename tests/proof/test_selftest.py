"""The self-test: every check passes and launches what it declares, and a driver that ends badly becomes words."""

from __future__ import annotations

import hashlib
import json
import os
import pickle
import re
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from child_code import run_instead
from conftest import is_set
from house import ROOT
from refusals import refused

from clrecon.errors import DeviceError
from clrecon.opencl import Device
from clrecon.opencl.sources import definitions_of
from clrecon.proof.checking import LEAST_ITEMS, Check, require_close, require_equal, require_share
from clrecon.proof.rays import ray_checks
from clrecon.proof.run import CHECKS, run_check, run_selftest
from clrecon.proof.surface import surface_checks

FEW = {"scan_block_sums": 64, "total_counts": 64}
"""Kernels that are launched over one work-group, whatever the data."""

ASKED_BY_OPERATORS = frozenset({
    "exclusive_scan", "compact", "radix_sort", "label_components", "bricks", "extract_isosurface", "types of voxels",
    "uneven slices", "ranges", "below a level", "trilinear topology", "triangles that cut each other", "extract_labels",
    "survey of labels", "extract_label_masks", "volumes of masks", "distances to a surface",
    "witnesses of triangles near a surface", "leaps of rays", "entries of tiles", "volume rendering",
    "gradient opacity", "steep transfer functions", "volume rendering of uneven slices", "labels in volume rendering",
    "projections", "radiographs", "projections of uneven slices", "surfaces without a mesh",
    "surfaces of uneven slices", "labels on surfaces", "slices in space", "points as discs",
    "a volume before and behind triangles", "slices before and behind triangles", "triangles and layers", "slices",
    "slices of uneven stacks", "bilateral filter", "bilateral filter of uneven stacks", "filter near a level",
    "grid of points", "nearest points", "clusters of voxels", "overlap of slices", "balls", "holes and growing",
    "boxes and tubes", "field around points", "normals of points", "normals by the gradient", "gradients at points",
    "gradients in uneven stacks", "filter of points", "outliers of points", "thinned points", "sparse cells of points",
    "clusters of free points", "points of voxels", "growing",
})  # fmt: skip
"""Checks whose kernels, with the same variants, tests of operators compare with their twins: every day on the first
device, for a release on all.  They too are for a release: a driver takes minutes to build what they need, and their
twins are slow."""

EVERY_DAY = frozenset({"exclusive_scan", "distances to a surface", "radiographs", "slices"})
"""Those of them that run every day on further devices: of each room one that is built in seconds.  Surfaces, points and
masks are made by what no operator's test asks: golden sections, links of free points, logic of masks."""

OF_TYPES = {"VOXEL", "VALUE", "LABEL", "VOXEL_IS_SHORT"}
OF_DEVICES = {"LANES", "WORDS_PER_ITEM", "HAS_BUILTIN_PREFETCH", "SCAN_GROUP", "CPU_NAME", "ATOMIC_LOADS"}


def macros_of(programs: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """What programs were built with, beside types and what the device needs."""
    found: dict[str, set[str]] = {}
    for file, options in programs:
        switched = {macro for macro, value in definitions_of(options).items() if value != "0"}
        found.setdefault(file, set()).update(switched - OF_TYPES - OF_DEVICES)
    return found


REMEMBERED: dict[bytes, bytes] = {}
"""What twins have said, by what they were asked."""


def remember(monkeypatch: pytest.MonkeyPatch, module: ModuleType, name: str) -> None:
    """Ask a slow twin once for all devices: it knows nothing of them.

    One that grows is asked each time: it counts as it takes cells, and that is compared too.
    """
    twin = getattr(module, name)

    def ask(*given: Any, **named: Any) -> Any:
        if named.get("grown") is not None:
            return twin(*given, **named)
        question = hashlib.sha256(pickle.dumps((twin.__module__, twin.__qualname__, given, named))).digest()
        if question not in REMEMBERED:
            REMEMBERED[question] = pickle.dumps(twin(*given, **named))
        return pickle.loads(REMEMBERED[question])

    monkeypatch.setattr(module, name, ask)


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.every_device
@pytest.mark.fault_row(57)
def test_every_check_passes_and_launches_what_it_declares(
    device: Device, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So each kernel and each of its variants is compared with its twin on every device."""
    is_further = request.node.get_closest_marker("further_device") is not None
    left_out = ASKED_BY_OPERATORS - (EVERY_DAY if is_further else frozenset())
    if is_set("CLRECON_RELEASE_TESTS"):
        left_out = frozenset()
    checks = [check for check in CHECKS if check.name not in left_out]
    launched: dict[str, int] = {}

    def note(doing: str) -> None:
        match = re.fullmatch(r"kernel (\w+) \(([\d,]+) items\)", doing)
        if match is not None:
            launched[match[1]] = max(launched.get(match[1], 0), int(match[2].replace(",", "")))

    for module, name in ((ray_checks, "cast_rays"), (ray_checks, "surface_twin"), (surface_checks, "extract_twin")):
        remember(monkeypatch, module, name)
    monkeypatch.setattr(device, "trace", note)
    most: dict[str, int] = {}
    for check in checks:
        launched.clear()
        monkeypatch.setattr(device, "programs", {})
        outcome = run_check(device, check)
        assert outcome["passed"], outcome
        assert set(check.kernels) <= set(launched), check.name
        built = macros_of(device.programs)
        for file, macros in check.variants.items():
            assert set(macros) <= built.get(file, set()), (check.name, file)
        for kernel in check.kernels:
            most[kernel] = max(most.get(kernel, 0), launched[kernel])
    judged = set(most) - {kernel for check in CHECKS if check.name in left_out for kernel in check.kernels}
    assert {kernel for kernel in judged if most[kernel] <= LEAST_ITEMS} == set(FEW) & judged


def test_names_that_are_left_out_are_checks() -> None:
    assert EVERY_DAY < ASKED_BY_OPERATORS < {check.name for check in CHECKS}


LAUNCHED = """
import json, os, re
kernels, programs = set(), set()
def pytest_runtest_call(item):
    device = item.funcargs.get("device")
    if hasattr(device, "programs"):
        device.trace = lambda doing: kernels.update(re.findall(r"kernel (\\w+) ", doing))
def pytest_runtest_teardown(item):
    programs.update(getattr(item.funcargs.get("device"), "programs", ()))
def pytest_sessionfinish():
    with open(os.environ["LAUNCHED"], "w") as file:
        json.dump([sorted(kernels), sorted(programs)], file)
"""
"""A plugin of pytest that keeps which kernels were launched, and what programs were built with."""


@pytest.mark.release
def test_operators_ask_what_is_left_out(device: Device, tmp_path: Path) -> None:
    (tmp_path / "launched.py").write_text(LAUNCHED)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "launched", "-p", "no:cacheprovider"]
    command += ["-m", "every_device or oclgrind", "tests/operators", "tests/opencl"]
    done = subprocess.run(
        [*command, f"--basetemp={tmp_path / 'tests'}"], cwd=ROOT, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(tmp_path), "LAUNCHED": str(tmp_path / "launched.json"),
             "CLRECON_TEST_DEVICE": str(device.index), "CLRECON_COVERAGE": ""},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
    kernels, programs = json.loads((tmp_path / "launched.json").read_text())
    built = macros_of(programs)
    for check in CHECKS:
        if check.name in ASKED_BY_OPERATORS:
            assert set(check.kernels) <= set(kernels), check.name
            assert all(set(macros) <= built[file] for file, macros in check.variants.items()), check.name


@pytest.mark.fault_row(57)
def test_mismatches_are_told() -> None:
    require_equal([1, 2], [1, 2], "numbers")
    with refused(DeviceError, "numbers", 1, 2):
        require_equal([1, 3], [1, 2], "numbers")
    with refused(DeviceError, "numbers", 3, 2):
        require_equal([1, 3, 4], [1, 2], "numbers")
    assert require_close([1.0, np.nan], [1.25, np.nan], 0.5, "numbers") == 0.25
    for found in ([1.0, 2.0], [1.6, np.nan], [np.inf, np.nan]):
        with refused(DeviceError, 2, 0.5):
            require_close(found, [1.0, np.nan], 0.5, "numbers")
    assert require_share([0.0] * 99 + [9.0], [0.0] * 100, 1.0, 0.01, "numbers") == 0.0
    with refused(DeviceError, 2, 100, 9):
        require_share([0.0] * 98 + [9.0, 2.0], [0.0] * 100, 1.0, 0.01, "numbers")


def check_named(name: str) -> Check:
    return Check(name, (), lambda device: "")


STORY = """
import json, os, signal, sys, time
checks = json.load(sys.stdin)["checks"]
for check in checks:
    print(json.dumps({"check": check}), flush=True)
    print(json.dumps({"doing": f"kernel of_{check} (64 items)"}), flush=True)
    if check == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if check == "hang":
        time.sleep(60)
    if check == "exit":
        os._exit(7)
    print(json.dumps({"warnings": ["a remark of the process"]}), flush=True)
    print(json.dumps({"operator": check, "passed": True, "detail": "", "seconds": 0.0}), flush=True)
"""


@pytest.fixture
def storied(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Device:
    """The device, whose self-test runs `STORY` in the place of checks."""
    run_instead(monkeypatch, tmp_path / "code", "clrecon.proof.run", STORY)
    return device


@pytest.mark.parametrize("error", [ModuleNotFoundError("No module named 'scipy'"), IndexError("9 is out of bounds")])
def test_error_of_a_check_is_its_failure_in_words(device: Device, error: Exception) -> None:
    def fail(device: Device) -> str:
        raise error

    outcome = run_check(device, Check("a check", (), fail))
    assert not outcome["passed"] and outcome["detail"] == f"{type(error).__name__}: {error}"


@pytest.mark.fault_row(57)
def test_a_driver_that_crashes_or_hangs_becomes_words(storied: Device) -> None:
    names = ["first", "crash", "second", "exit", "third", "hang", "last"]
    outcomes = list(run_selftest(storied, [check_named(name) for name in names], silent_seconds=1.5, processes=1))
    assert [outcome["operator"] for outcome in outcomes] == names
    assert [outcome["passed"] for outcome in outcomes] == [True, False, True, False, True, False, False]
    words = {outcome["operator"]: outcome["detail"] for outcome in outcomes}
    assert words["crash"] == "the driver crashed with SIGSEGV in kernel of_crash (64 items)"
    assert words["exit"] == "the process of the test ended with exit code 7 in kernel of_exit (64 items)"
    assert words["hang"] == "the driver hangs: nothing for 1.5 s in kernel of_hang (64 items)"
    assert storied.warnings == ["a remark of the process"]
    assert words["last"] == "not run: the driver hangs"


def test_processes_run_side_by_side_and_one_that_hangs_holds_no_other(storied: Device) -> None:
    names = ["hang", "first", "left", "second", "last", "crash", "fourth", "third"]
    outcomes = list(run_selftest(storied, [check_named(name) for name in names], silent_seconds=1.5, processes=2))
    assert {outcome["operator"]: outcome["passed"] for outcome in outcomes} == {
        "hang": False, "left": False, "last": False, "fourth": False,
        "first": True, "second": True, "crash": False, "third": True,
    }  # fmt: skip
    assert [outcome["operator"] for outcome in outcomes][0] == "first"  # it does not wait for the other process
    assert sorted(outcome["detail"] for outcome in outcomes if "not run" in outcome["detail"]) == (
        ["not run: the driver hangs"] * 3
    )


def test_a_caller_that_leaves_ends_all_processes(storied: Device) -> None:
    names = ["hang", "first", "left", "second"]
    outcomes = run_selftest(storied, [check_named(name) for name in names], silent_seconds=600.0, processes=2)
    assert next(outcomes)["operator"] == "first"
    began = time.perf_counter()
    outcomes.close()
    assert time.perf_counter() - began < 20.0
