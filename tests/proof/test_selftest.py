"""The self-test: every check passes and launches what it declares; a driver that crashes or hangs is reported."""

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

OF_ONE_GROUP = frozenset({"scan_block_sums", "total_counts"})
"""Kernels that are launched over one work-group, whatever the data."""

OF_GPUS = frozenset({"list_output"})
"""Kernels that are launched where each work-item is a lane of its own."""

ASKED_BY_OPERATORS = frozenset({
    "exclusive_scan", "compact", "radix_sort", "label_components", "bricks", "extract_isosurface", "types of voxels",
    "uneven slices", "ranges", "below a level", "trilinear topology", "triangles that cut each other", "extract_labels",
    "survey of labels", "extract_label_masks", "volumes of masks", "collapses of edges", "the first round of collapses",
    "triangles near a surface", "leaps of rays", "entries of tiles", "volume rendering",
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

EVERY_DAY = frozenset({"exclusive_scan", "triangles near a surface", "radiographs", "slices"})
"""Those of them that run every day on further devices: of each room one that is built in seconds.  Surfaces, points and
masks are made by what no operator's test asks: golden sections, links of free points, logic of masks."""

OF_TYPES = {"VOXEL", "VALUE", "LABEL", "VOXEL_IS_SHORT"}
OF_DEVICES = {"LANES", "WORDS_PER_ITEM", "HAS_BUILTIN_PREFETCH", "SCAN_GROUP", "CPU_NAME", "ATOMIC_LOADS"}


def variants_of(programs: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """The macros that programs of each file were built with, beside those of types and of the device."""
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


@pytest.fixture
def left_out_checks(request: pytest.FixtureRequest) -> frozenset[str]:
    """Names of the checks that are not run in this session on this device."""
    if is_set("CLRECON_RELEASE_TESTS"):
        return frozenset()
    is_further = request.node.get_closest_marker("further_device") is not None
    return ASKED_BY_OPERATORS - (EVERY_DAY if is_further else frozenset())


def count_launched_items(device: Device, monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """Return the most work-items of each kernel that is launched from now on."""
    items: dict[str, int] = {}

    def note_launch(doing: str) -> None:
        match = re.fullmatch(r"kernel (\w+) \(([\d,]+) items\)", doing)
        if match is not None:
            items[match[1]] = max(items.get(match[1], 0), int(match[2].replace(",", "")))

    monkeypatch.setattr(device, "trace", note_launch)
    return items


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.every_device
@pytest.mark.fault_row(57)
def test_every_check_passes_and_launches_the_kernels_and_variants_that_it_declares_over_enough_items(
    device: Device, left_out_checks: frozenset[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So each kernel and each of its variants is compared with its twin on every device."""
    for module, name in ((ray_checks, "cast_rays"), (ray_checks, "surface_twin"), (surface_checks, "extract_twin")):
        remember(monkeypatch, module, name)
    launched_items = count_launched_items(device, monkeypatch)
    most_items: dict[str, int] = {}
    for check in CHECKS:
        if check.name in left_out_checks:
            continue
        launched_items.clear()
        monkeypatch.setattr(device, "programs", {})

        outcome = run_check(device, check)

        assert outcome["passed"], outcome
        kernels = set(check.kernels) - (set() if device.kernel_variants["LANES"] == "1" else OF_GPUS)
        assert kernels <= set(launched_items), check.name
        built = variants_of(device.programs)
        for file, macros in check.variants.items():
            assert set(macros) <= built.get(file, set()), (check.name, file)
        for kernel in kernels:
            most_items[kernel] = max(most_items.get(kernel, 0), launched_items[kernel])

    of_left_out = {kernel for check in CHECKS if check.name in left_out_checks for kernel in check.kernels}
    judged = set(most_items) - of_left_out
    assert {kernel for kernel in judged if most_items[kernel] <= LEAST_ITEMS} == OF_ONE_GROUP & judged


def test_checks_that_run_for_a_release_or_on_further_devices_alone_are_some_of_those_there_are() -> None:
    """Proper subsets: on every device some checks of operators are left for a release, and others run every day."""
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
def test_tests_of_operators_launch_the_kernels_and_variants_of_the_checks_that_are_for_a_release(
    device: Device, tmp_path: Path
) -> None:
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
    built = variants_of(programs)
    for check in (check for check in CHECKS if check.name in ASKED_BY_OPERATORS):
        assert set(check.kernels) - OF_GPUS <= set(kernels), check.name
        assert all(set(macros) <= built[file] for file, macros in check.variants.items()), check.name


@pytest.mark.fault_row(57)
def test_first_unequal_number_fails_a_check_of_equality() -> None:
    with refused(DeviceError, "numbers", 1, 2):  # one of two numbers
        require_equal([1, 3], [1, 2], "numbers")


@pytest.mark.fault_row(57)
def test_another_count_of_numbers_fails_a_check_of_equality() -> None:
    with refused(DeviceError, "numbers", 3, 2):
        require_equal([1, 3, 4], [1, 2], "numbers")


@pytest.mark.fault_row(57)
def test_check_of_closeness_returns_the_largest_difference_within_the_tolerance() -> None:
    assert require_close([1.0, np.nan], [1.25, np.nan], allowed=0.5, subject="numbers") == 0.25


@pytest.mark.fault_row(57)
@pytest.mark.parametrize(
    "found",
    [[1.0, 2.0], [1.6, np.nan], [np.inf, np.nan]],
    ids=["a number where NaN is expected", "0.6 above", "infinite"],
)
def test_number_beyond_the_tolerance_fails_a_check_of_closeness(found: list[float]) -> None:
    with refused(DeviceError, 2, 0.5):  # of two numbers, tolerance 0.5
        require_close(found, [1.0, np.nan], allowed=0.5, subject="numbers")


@pytest.mark.fault_row(57)
def test_numbers_beyond_the_tolerance_pass_a_check_of_shares_up_to_the_allowed_share() -> None:
    one_of_100_apart = [0.0] * 99 + [9.0]
    assert require_share(one_of_100_apart, [0.0] * 100, allowed=1.0, share=0.01, subject="numbers") == 0.0


@pytest.mark.fault_row(57)
def test_numbers_beyond_the_tolerance_above_the_allowed_share_fail_with_count_and_largest_difference() -> None:
    two_of_100_apart = [0.0] * 98 + [9.0, 2.0]
    with refused(DeviceError, 2, 100, 9):
        require_share(two_of_100_apart, [0.0] * 100, allowed=1.0, share=0.01, subject="numbers")


def check_named(name: str) -> Check:
    return Check(name, kernels=(), run=lambda device: "")


SECONDS_OF_A_HANG = 60.0
SCRIPTED_CHECKS = """
import json, os, signal, sys, time
checks = json.load(sys.stdin)["checks"]
for check in checks:
    print(json.dumps({"check": check}), flush=True)
    print(json.dumps({"doing": f"kernel of_{check} (64 items)"}), flush=True)
    if check == "crash":
        os.kill(os.getpid(), signal.SIGSEGV)
    if check == "hang":
        time.sleep(SECONDS_OF_A_HANG)
    if check == "exit":
        os._exit(7)
    print(json.dumps({"warnings": ["a remark of the process"]}), flush=True)
    print(json.dumps({"operator": check, "passed": True, "detail": "", "seconds": 0.0}), flush=True)
""".replace("SECONDS_OF_A_HANG", str(SECONDS_OF_A_HANG))


@pytest.fixture
def scripted_device(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Device:
    """The device, whose checks pass, crash, exit or hang in the processes of the self-test as their names say."""
    run_instead(monkeypatch, tmp_path / "code", "clrecon.proof.run", SCRIPTED_CHECKS)
    return device


@pytest.mark.parametrize("error", [ModuleNotFoundError("No module named 'scipy'"), IndexError("9 is out of bounds")])
def test_check_that_raises_an_error_fails_with_its_type_and_message(device: Device, error: Exception) -> None:
    def fail(device: Device) -> str:
        raise error

    outcome = run_check(device, Check("a check", kernels=(), run=fail))
    assert outcome["passed"] is False
    assert outcome["detail"] == f"{type(error).__name__}: {error}"


def run_checks(device: Device, names: list[str], processes: int = 1) -> dict[str, dict[str, Any]]:
    """Run checks of these names in the order given; returns their outcomes by name, in the order of their ends."""
    checks = [check_named(name) for name in names]
    outcomes = run_selftest(device, checks, silent_seconds=1.5, processes=processes)
    return {outcome["operator"]: outcome for outcome in outcomes}


@pytest.mark.fault_row(57)
@pytest.mark.parametrize(
    ("name", "detail"),
    [
        ("crash", "the driver crashed with SIGSEGV in kernel of_crash (64 items)"),
        ("exit", "the process of the test ended with exit code 7 in kernel of_exit (64 items)"),
        ("hang", "the driver hangs: nothing for 1.5 s in kernel of_hang (64 items)"),
    ],
)
def test_driver_that_crashes_exits_or_hangs_fails_its_check_with_the_kernel(
    scripted_device: Device, name: str, detail: str
) -> None:
    outcomes = run_checks(scripted_device, [name])
    assert (outcomes[name]["passed"], outcomes[name]["detail"]) == (False, detail)


@pytest.mark.fault_row(57)
def test_checks_after_a_crash_or_an_exit_are_run(scripted_device: Device) -> None:
    outcomes = run_checks(scripted_device, ["first", "crash", "second", "exit", "third"])
    assert {name: outcome["passed"] for name, outcome in outcomes.items()} == {
        "first": True, "crash": False, "second": True, "exit": False, "third": True,
    }  # fmt: skip


@pytest.mark.fault_row(57)
def test_check_after_one_that_hangs_is_not_run_and_fails(scripted_device: Device) -> None:
    outcomes = run_checks(scripted_device, ["hang", "last"])
    assert (outcomes["last"]["passed"], outcomes["last"]["detail"]) == (False, "not run: the driver hangs")


def test_warnings_of_the_processes_of_checks_are_those_of_the_device_each_once(scripted_device: Device) -> None:
    run_checks(scripted_device, ["first", "second"])
    assert scripted_device.warnings == ["a remark of the process"]


def test_process_whose_check_hangs_leaves_its_checks_and_holds_up_no_other_process(scripted_device: Device) -> None:
    of_first, of_second = ["hang", "left", "last", "fourth"], ["first", "second", "crash", "third"]
    in_turn = [name for pair in zip(of_first, of_second, strict=True) for name in pair]

    outcomes = run_checks(scripted_device, in_turn, processes=2)

    assert next(iter(outcomes)) == "first"  # it does not wait for the check that hangs
    assert [outcomes[name]["passed"] for name in of_second] == [True, True, False, True]
    not_run = ["not run: the driver hangs"] * 3
    assert [outcomes[name]["detail"] for name in of_first[1:]] == not_run


def test_caller_that_stops_reading_outcomes_ends_the_process_that_hangs(scripted_device: Device) -> None:
    checks = [check_named(name) for name in ("hang", "first", "left", "second")]
    outcomes = run_selftest(scripted_device, checks, silent_seconds=600.0, processes=2)
    assert next(outcomes)["operator"] == "first"
    began = time.perf_counter()
    outcomes.close()
    assert time.perf_counter() - began < SECONDS_OF_A_HANG / 3  # it is not waited for
