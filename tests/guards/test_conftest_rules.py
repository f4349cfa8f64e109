"""The rules of tests/conftest.py: which devices are asked for, and that a session without a test is no success."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import conftest
import pytest
from house import ROOT
from refusals import assert_facts, refused
from variants import daily_rows

POCL = SimpleNamespace(platform="Portable Computing Language", version="OpenCL 3.0 PoCL", driver="3.1")
RUSTICL = SimpleNamespace(platform="rusticl", version="OpenCL 3.0", driver="22.3")


@pytest.mark.parametrize(
    ("wanted", "devices", "missing"),
    [
        ("", [], []),
        ("rusticl, portable computing language", [POCL, RUSTICL], []),
        ("Portable Computing Language, Portable Computing Language", [POCL, RUSTICL], ["Portable Computing Language"]),
        ("Portable Computing Language, Portable Computing Language", [POCL, POCL], []),
        ("Intel", [POCL], ["Intel"]),
        ("3.1", [RUSTICL, POCL], []),
    ],
)
def test_each_entry_needs_a_device_of_its_own(wanted: str, devices: list[SimpleNamespace], missing: list[str]) -> None:
    assert conftest.missing_platforms(wanted, devices) == missing


def test_rows_of_tables_are_named_by_their_values() -> None:
    row = {"up": (0, 1.5), "order": abs, "plan": object()}
    assert conftest.pytest_make_parametrize_id(None, row, "row") == "up=0,1.5,order=abs,plan=object"
    assert conftest.pytest_make_parametrize_id(None, ["x" * 99], "row") == "x" * 60
    assert conftest.pytest_make_parametrize_id(None, "text", "row") is None


def test_facts_of_a_refusal_are_numbers_and_names_not_sentences() -> None:
    text = "slice003.dcm: 13,824 voxels at -5.50 mm, --crop x:1:2 (allow_gaps=True), 1.2e+06 mm"
    assert_facts(text, "slice003.dcm", 13824, -5.5, "--crop", "allow_gaps=True", 1.2e6)
    for absent in (3, 824, 5.5, 50, "crop-box", "gaps"):
        with pytest.raises(AssertionError):
            assert_facts(text, absent)
    for sentence in ((), ("",), ("13,824 voxels",)):
        with pytest.raises(ValueError, match="one word each"):
            assert_facts(text, *sentence)
    with pytest.raises(KeyError), refused(UserWarning, 3):
        raise KeyError(3)
    with refused(KeyError, 3) as caught:
        raise KeyError(3)
    assert caught.type is KeyError


def run_pytest(tmp_path: Path, test: str, *options: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run pytest on one file with a copy of the conftest, away from this project."""
    (tmp_path / "conftest.py").write_text((ROOT / "tests" / "conftest.py").read_text())
    (tmp_path / "test_one.py").write_text(test)
    environment = {key: value for key, value in os.environ.items() if not key.startswith("CLRECON_")}
    # Plugins that happen to be installed take longer to import than these tests run.
    environment |= {"PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", **variables}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--rootdir",
        str(tmp_path),
        *options,
        str(tmp_path),
    ]
    return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)


CHOOSE = """
def choose(n):
    if n == 1:
        return 1
    if n == 2:
        return 2
    return 3
"""

PROJECT = {
    "tests/support/coverage_figure.py": (ROOT / "tests" / "support" / "coverage_figure.py").read_text("utf-8"),
    "pyproject.toml": (ROOT / "pyproject.toml").read_text("utf-8"),
    "pytest.ini": "[pytest]\nmarkers =\n    slow\n    untraced\n    every_device\n",
    "clrecon/__init__.py": "",
    "clrecon/seen.py": CHOOSE,
    "clrecon/unseen.py": "a = 1\nb = 2\n",
}
"""A project of 8 lines and 4 branches."""

COVERED = """
import time
import pytest
from clrecon.seen import choose
@pytest.fixture
def inner():
    return 0
@pytest.fixture
def three(request):
    request.getfixturevalue("inner")
    return choose(3)
@pytest.mark.parametrize("n", PARAMETERS)
def test_quick(n):
    until = time.process_time() + (n == "long")
    while time.process_time() < until:
        pass
    assert choose(1 if n == "long" else n)
@pytest.mark.MARK
def test_marked(three):
    assert three == 3
"""


WORKERS = ["-p", "xdist", "-n", "2", "--dist", "loadfile"]


@pytest.mark.release
@pytest.mark.parametrize(
    ("options", "parameters", "mark", "lines", "branches"),
    [
        (WORKERS, [1], "every_device", "62.5", "75.0"),  # a mark of those that are traced
        ([], [1, "long", 2], "untraced", "37.5", "25.0"),  # nothing new for a long time: the rest is not traced
        # the coverage is measured for a release
        pytest.param(WORKERS, [1], "slow", "37.5", "25.0", marks=pytest.mark.release),  # def, if, return
        pytest.param([], [1, 1, 2], "slow", "62.5", "75.0", marks=pytest.mark.release),
        pytest.param([], ["long", 2], "slow", "62.5", "75.0", marks=pytest.mark.release),
    ],
)
def test_the_coverage_is_said_before_the_last_line(
    tmp_path: Path, options: list[str], parameters: list[object], mark: str, lines: str, branches: str
) -> None:
    for name, text in PROJECT.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    test = COVERED.replace("PARAMETERS", repr(parameters)).replace("MARK", mark)
    search = os.pathsep.join([str(tmp_path / "tests" / "support"), str(tmp_path)])
    done = run_pytest(tmp_path, test, *options, CLRECON_COVERAGE="1", PYTHONPATH=search)
    assert done.returncode == 0, done.stdout + done.stderr
    *_, said, last = done.stdout.splitlines()
    figure = re.match(r"coverage of clrecon: (\d+\.\d) % of 8 lines and (\d+\.\d) % of 4 branches", said)
    assert figure and f"{len(parameters) + 1} passed" in last, done.stdout
    assert figure.groups() == (lines, branches)


NO_DRIVER = "import clrecon.opencl\nclrecon.opencl.list_devices = lambda: []\n"
USES_DEVICE = "def test_it(device):\n    assert device.name\n"
SKIPPED = "import pytest\ndef test_it():\n    pytest.skip('no')\n"


@pytest.mark.parametrize(
    ("test", "variables", "code"),
    daily_rows(
        4,
        [
            ("def test_it():\n    assert 1 + 1 == 2\n", {"CLRECON_REQUIRE_TESTS": "1"}, 0),
            (SKIPPED, {}, 0),
            (SKIPPED, {"CLRECON_REQUIRE_TESTS": "1"}, 5),
            (NO_DRIVER + USES_DEVICE, {}, 0),
            (NO_DRIVER + USES_DEVICE, {"CLRECON_REQUIRE_DEVICE": "1"}, 1),
            (NO_DRIVER + USES_DEVICE, {"CLRECON_REQUIRE_PLATFORMS": "Intel"}, 2),
            (USES_DEVICE, {"CLRECON_TEST_DEVICE": "no such device"}, 2),
            ("def test_it(real_data):\n    assert real_data.is_dir()\n", {"CLRECON_TEST_DATA": "no-such-folder"}, 1),
        ],
    ),
)
def test_session_exits_by_what_is_required(tmp_path: Path, test: str, variables: dict[str, str], code: int) -> None:
    done = run_pytest(tmp_path, test, **variables)
    assert done.returncode == code, done.stdout + done.stderr


TWO_DEVICES = """
import pytest
from types import SimpleNamespace
import clrecon.opencl
names = ("CPU", "llvmpipe (LLVM 15.0.6, 256 bits)")
same = {"platform": "p", "type": "cpu", "version": "", "driver": "", "is_simulator": False, "known_good": None}
found = [SimpleNamespace(index=index, name=name, **same) for index, name in enumerate(names)]
clrecon.opencl.list_devices = lambda: found
@pytest.mark.every_device
@pytest.mark.parametrize("kind", ["int16", pytest.param("int8", marks=pytest.mark.first_device)])
def test_kinds(device, kind):
    assert device in found
@pytest.mark.oclgrind
def test_watched(device):
    assert device in found
def test_first(device):
    assert device is found[0]
@pytest.mark.release
def test_release():
    pass
"""


@pytest.mark.parametrize(
    ("variables", "passed"),
    daily_rows(
        2,
        [
            ({}, "6 passed, 1 deselected"),  # one parameter and what a simulator watches on both, the rest on the first
            ({"CLRECON_TEST_EVERY_DEVICE": "1"}, "1 failed, 7 passed, 1 deselected"),
            ({"CLRECON_RELEASE_TESTS": "1"}, "7 passed"),
            ({"CLRECON_FAST_TESTS": "1"}, "3 passed, 5 deselected"),
            ({"CLRECON_TEST_DEVICE": "0"}, "4 passed"),  # the 0 in the name of the other is no index
        ],
    ),
)
def test_what_is_for_every_device_runs_on_every_device(tmp_path: Path, variables: dict[str, str], passed: str) -> None:
    done = run_pytest(tmp_path, TWO_DEVICES, **variables)
    assert passed in done.stdout.splitlines()[-1], done.stdout + done.stderr


LONG_AND_SHORT = """
import pytest
def test_short():
    pass
@pytest.mark.long
def test_long():
    pass
"""


def test_a_run_begins_with_what_takes_long(tmp_path: Path) -> None:
    done = run_pytest(tmp_path, LONG_AND_SHORT, "-vv")
    assert done.stdout.index("test_long PASSED") < done.stdout.index("test_short PASSED"), done.stdout + done.stderr


def test_required_platforms_are_there(device: object) -> None:
    """Asks for the devices of this session, so that a platform that got lost shows in every run."""
    wanted = os.environ.get("CLRECON_REQUIRE_PLATFORMS", "")
    named = os.environ.get("CLRECON_TEST_DEVICE", "").strip()
    assert named or conftest.missing_platforms(wanted, conftest.Devices.get()[0]) == []
