"""Fixtures for all tests: the real data, and the OpenCL devices of the machine.

Variables
---------
CLRECON_TEST_DATA
    Folder of the real CT data, default ``../shared/data`` beside the project; tests over it skip where it is absent.
CLRECON_TEST_DEVICE
    Only the devices of this index or with this text in platform or name; naming one that is not there is an error.
CLRECON_TEST_EVERY_DEVICE=1
    Every test with the fixture ``device`` runs on every device, not only those marked ``every_device``.
CLRECON_TEST_SIMULATORS=1
    Simulators such as Oclgrind too.
CLRECON_REQUIRE_DEVICE=1
    No device is a failure, not a skip.
CLRECON_REQUIRE_PLATFORMS
    Comma list of texts; each must be found in platform, version or driver of a device of its own.
CLRECON_RELEASE_TESTS=1
    Tests marked ``release`` too.
CLRECON_FAST_TESTS=1
    All guards, and of other tests the first parameter on the first device, but for those marked seconds, slow, long or
    fuzz.
CLRECON_COVERAGE=1
    Lines and branches of clrecon that the tests run are counted, see `coverage_figure`.
CLRECON_REQUIRE_TESTS=1
    A session in which no test has run fails.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import tempfile
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

# Before numpy is imported: on a busy machine, as with several processes of pytest, threads of BLAS wait for each other
# without leaving their cores, for up to 30 times as long as they work.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

ROOT = Path(__file__).resolve().parent.parent


def is_set(variable: str) -> bool:
    return os.environ.get(variable, "") not in ("", "0")


def find_devices() -> tuple[list[Any], str]:
    """Devices to test on, and why there are none."""
    try:
        from clrecon.errors import DeviceError
        from clrecon.opencl import list_devices
        from clrecon.opencl.quirks import is_software_gpu, kernel_variants
    except ImportError as error:
        return [], f"the device layer cannot be imported: {error}"
    try:
        found = list_devices()
    except DeviceError as error:
        return [], str(error)
    for device in found:
        device.fault = ""  # passed: the check at its first use is tests/operators/test_first_use.py's
        if device.known_good is not None:  # an earlier session may have been killed
            device.known_good.sweep()
            device.known_good.warnings.clear()
        # llvmpipe makes vectors of work-items itself, and takes three times as long to build kernels that are written
        # with vectors.  It runs the variant of GPUs, as no other device here does; `users_kernels` gives its own back.
        if is_software_gpu(device.name):
            device.kernel_variants = kernel_variants(device.platform, "gpu")
    devices = [device for device in found if is_set("CLRECON_TEST_SIMULATORS") or not device.is_simulator]
    wanted = os.environ.get("CLRECON_TEST_DEVICE", "").strip().lower()
    if wanted:
        devices = [
            device
            for device in devices
            if wanted == str(device.index)
            or (not wanted.isdigit() and wanted in f"{device.platform} {device.name}".lower())
        ]
        if not devices:
            there = "; ".join(f"{device.index}: {device.label}" for device in found) or "none"
            raise pytest.UsageError(f"CLRECON_TEST_DEVICE={wanted!r} is not there; devices found: {there}")
    return devices, "" if devices else "no OpenCL device found"


def missing_platforms(wanted: str, devices: list[Any]) -> list[str]:
    """Entries of the comma list `wanted` that find no device of their own."""
    left = [f"{device.platform} {device.version} {device.driver}".lower() for device in devices]
    missing = []
    for entry in filter(None, (part.strip() for part in wanted.split(","))):
        match = next((text for text in left if entry.lower() in text), None)
        if match is None:
            missing.append(entry)
        else:
            left.remove(match)
    return missing


def device_id(device: Any) -> str:
    platform = "".join(letter if letter.isalnum() else "-" for letter in device.platform.lower())
    return f"{device.index}-{platform}-{device.type}"


class Devices:
    """The devices of this session, found when the first test asks for one."""

    found: tuple[list[Any], str] | None = None

    @classmethod
    def get(cls) -> tuple[list[Any], str]:
        if cls.found is None:
            devices, reason = find_devices()
            missing = missing_platforms(os.environ.get("CLRECON_REQUIRE_PLATFORMS", ""), devices)
            if missing and not os.environ.get("CLRECON_TEST_DEVICE", "").strip():
                there = ", ".join(f"{device.platform} {device.driver}" for device in devices) or "none"
                raise pytest.UsageError(f"CLRECON_REQUIRE_PLATFORMS: no device of {missing}; found {there}")
            cls.found = devices, reason
        return cls.found


def first_of(devices: list[Any]) -> list[Any]:
    """The first device, for tests that are not for every one; with CLRECON_TEST_EVERY_DEVICE=1 all."""
    return devices if is_set("CLRECON_TEST_EVERY_DEVICE") else devices[:1]


def is_for_every_device(node: Any) -> bool:
    """True for tests of what a driver makes of kernels; what a simulator watches is as small."""
    return any(node.get_closest_marker(name) for name in ("every_device", "oclgrind"))


def is_for_release(item: pytest.Item) -> bool:
    """True where a test of an operator, or one of seconds, is to run on a further device: every day the self-test asks
    that one.
    """
    is_one = item.path.is_relative_to(ROOT / "tests" / "operators") or item.get_closest_marker("seconds") is not None
    return is_one and not is_set("CLRECON_RELEASE_TESTS")


def is_left_out(item: pytest.Item, seen: set[str]) -> bool:
    """True for what waits for a release and for what a fast session leaves out; `seen` gets the names of its tests."""
    if item.get_closest_marker("release"):
        return not is_set("CLRECON_RELEASE_TESTS")
    if not is_set("CLRECON_FAST_TESTS") or item.path.is_relative_to(ROOT / "tests" / "guards"):
        return False
    name = item.nodeid.partition("[")[0]
    is_new = name not in seen
    seen.add(name)
    return not is_new or any(item.get_closest_marker(mark) for mark in ("seconds", "slow", "long", "fuzz"))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect without a search for garbage: half a million objects stay to the end, and no search looks at them."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.collect()
        gc.freeze()
        gc.enable()


@pytest.hookimpl(trylast=True)  # after pytest has brought together what runs on one device
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Choose the devices of parameters, mark what runs on a further one, and begin with what takes longest.

    The first process gets the beginning of the list, and when it comes to the end the others take of its rest: a test
    of a minute must not be the last.
    """
    devices = Devices.found[0] if Devices.found else []
    first, chosen, left = first_of(devices), [], []
    seen: set[str] = set()
    for item in items:
        if " at 0x" in item.nodeid:  # processes that share the tests would not agree on them
            raise pytest.UsageError(f"{item.nodeid} is named by an address: give its rows ids")
        if is_left_out(item, seen):
            left.append(item)
            continue
        device = item.callspec.params.get("device") if hasattr(item, "callspec") else None
        if device in devices[1:]:
            item.add_marker("further_device")
            if device not in first and (item.get_closest_marker("first_device") or is_for_release(item)):
                continue
        chosen.append(item)
    config.hook.pytest_deselected(items=left)
    items[:] = sorted(chosen, key=lambda item: item.get_closest_marker("long") is None)


def describe_value(value: object) -> str | None:
    """Return a short text of a value of a table: containers as they are written, functions by their names."""
    if isinstance(value, dict):
        parts = [f"{key}={describe_value(part) or type(part).__name__}" for key, part in value.items()]
    elif isinstance(value, (list, tuple)):
        parts = [describe_value(part) or type(part).__name__ for part in value]
    elif value is None or isinstance(value, (str, int, float, bytes)):
        return str(value)
    else:
        return getattr(value, "__name__", None)
    return ",".join(parts)[:60]


def pytest_make_parametrize_id(config: pytest.Config, val: object, argname: str) -> str | None:
    """Name rows of tables by their lists and dicts too, which pytest only numbers; other values as pytest does."""
    return describe_value(val) if isinstance(val, (list, tuple, dict)) else None


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device" in metafunc.fixturenames:
        devices, reason = Devices.get()
        if not is_for_every_device(metafunc.definition):
            devices = first_of(devices)
        parameters = devices or [pytest.param(reason, id="no-device")]
        ids = [device_id(device) for device in devices] or None
        metafunc.parametrize("device", parameters, ids=ids, indirect=True, scope="session")


@pytest.fixture(scope="session")
def device(request: pytest.FixtureRequest) -> Any:
    """The first OpenCL device of the machine; with the marks `every_device` and `oclgrind` one after the other."""
    if isinstance(request.param, str):
        if is_set("CLRECON_REQUIRE_DEVICE"):
            pytest.fail(f"CLRECON_REQUIRE_DEVICE is set: {request.param}")
        pytest.skip(request.param)
    return request.param


@pytest.fixture(autouse=True)
def own_remarks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test makes the device remark is forgotten after it: others would find it among their warnings."""
    if "device" in request.fixturenames:
        device = request.getfixturevalue("device")
        monkeypatch.setattr(device, "_remarks", list(getattr(device, "_remarks", ())), raising=False)


@pytest.fixture(autouse=True)
def reports_keep_their_schemas(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Each report that a test makes is held against its JSON Schema in docs/schemas."""
    from clrecon.jobs import run

    to_json, faults = run.to_json, []

    def to_checked_json(value: Any, indent: int | None = 2) -> str:
        from report_schemas import find_faults

        text = to_json(value, indent)
        faults.extend(find_faults(json.loads(text)))
        return text

    monkeypatch.setattr(run, "to_json", to_checked_json)
    yield
    assert faults == []


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Any:
    """What a command prints, without its sentences."""
    from printed_text import Printer

    return Printer(capsys)


@pytest.fixture
def users_kernels(device: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The variant of the kernels that users of this device get: that of the tests is another one on llvmpipe."""
    from clrecon.opencl.quirks import kernel_variants

    monkeypatch.setattr(device, "kernel_variants", kernel_variants(device.platform, device.type))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Folder of the real CT data; skips where it is absent."""
    named = os.environ.get("CLRECON_TEST_DATA", "")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        if named:
            pytest.fail(f"CLRECON_TEST_DATA={named!r} is not a folder")
        pytest.skip("real CT data is absent (CLRECON_TEST_DATA names its folder)")
    return folder


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the processes of this session share, for what takes long to make."""
    root = tmp_path_factory.getbasetemp()
    folder = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def odd(shared_folder: Path) -> Any:
    """The odd bodies of `odd_bodies`."""
    from odd_bodies import OddBodies

    return OddBodies(shared_folder)


@pytest.fixture(scope="module")
def downloads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where `view_browser` saves what a page gives it."""
    return tmp_path_factory.mktemp("downloads")


@pytest.fixture(scope="module")
def view_browser(downloads: Path) -> Iterator[Any]:
    """A browser of 1200 x 800 pixels that saves into `downloads`."""
    from browser import open_browser

    with open_browser(width=1200, height=800) as driver:
        driver.execute_cdp_cmd("Page.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(downloads)})
        yield driver


@pytest.fixture(scope="module")
def view_server(device: Any) -> Iterator[Any]:
    """A view of a scan and a mesh, for pages in `view_browser`."""
    from view_pages import serve_scene

    with serve_scene(device) as running:
        yield running


@pytest.fixture
def cloud_command(device: Any, tmp_path: Path) -> Any:
    """A function that runs ``clrecon cloud`` with options into an empty folder and returns the exit code."""
    from clrecon.cli.main import main

    def run(source: Path, *options: str, output: str = "out.ply") -> int:
        return main(["cloud", str(source), "-o", str(tmp_path / output), "--device", str(device.index), *options])

    return run


@pytest.fixture(scope="session", autouse=True)
def interruptible() -> Iterator[None]:
    """Ctrl-C as in a terminal, here and in processes of tests: what a shell starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def project_root() -> Path:
    """The folder that holds setup.cfg."""
    return ROOT


COVERAGE_DATA = pytest.StashKey["tempfile.TemporaryDirectory[str]"]()


def pytest_configure(config: pytest.Config) -> None:
    """With CLRECON_COVERAGE=1 the coverage is measured; before clrecon is imported for the first time."""
    if not is_set("CLRECON_COVERAGE"):
        return
    from coverage_figure import CoverageFigure

    worker: str | None = getattr(config, "workerinput", {}).get("workerid")
    if worker is None:
        config.stash[COVERAGE_DATA] = tempfile.TemporaryDirectory(prefix="clrecon-coverage-")
        os.environ["CLRECON_COVERAGE_DATA"] = config.stash[COVERAGE_DATA].name
    traces = worker or (None if getattr(config.option, "numprocesses", None) else "alone")
    plugin = CoverageFigure(Path(os.environ["CLRECON_COVERAGE_DATA"]), traces, combines=worker is None)
    config.pluginmanager.register(plugin)


def pytest_unconfigure(config: pytest.Config) -> None:
    if COVERAGE_DATA in config.stash:
        config.stash[COVERAGE_DATA].cleanup()
        del os.environ["CLRECON_COVERAGE_DATA"]


class RanTests:
    """How many tests have got as far as their own body."""

    count = 0


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.when == "call" and not report.skipped:
        RanTests.count += 1


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    if is_set("CLRECON_REQUIRE_TESTS") and RanTests.count == 0 and exitstatus == 0:
        session.exitstatus = pytest.ExitCode.NO_TESTS_COLLECTED
