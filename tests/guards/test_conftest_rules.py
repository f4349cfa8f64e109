"""The rules of tests/conftest.py: which devices are asked for, and that a session without a test is no success."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

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
    ids=["none", "two drivers", "one driver for two entries", "two of one driver", "absent", "by version"],
)
def test_required_platforms_without_a_device_of_their_own_are_missing(
    wanted: str, devices: list[SimpleNamespace], missing: list[str]
) -> None:
    assert conftest.missing_platforms(wanted, devices) == missing


@pytest.mark.parametrize(
    ("value", "name"),
    [
        ({"up": (0, 1.5), "order": abs, "plan": object()}, "up=0,1.5,order=abs,plan=object"),
        (["x" * 99], "x" * 60),
        ("text", None),
    ],
    ids=["a dict by its entries", "a long list cut to 60 letters", "a text as pytest does"],
)
def test_row_of_a_table_is_named_by_its_values(value: object, name: str | None) -> None:
    config: Any = None
    assert conftest.pytest_make_parametrize_id(config, value, "row") == name


MESSAGE = "slice003.dcm: 13,824 voxels at -5.50 mm, --crop x:1:2 (allow_gaps=True), 1.2e+06 mm"


@pytest.mark.parametrize("fact", ["slice003.dcm", 13824, -5.5, "--crop", "allow_gaps=True", 1.2e6])
def test_number_or_name_in_a_message_is_found_as_a_fact(fact: str | float) -> None:
    assert_facts(MESSAGE, fact)


@pytest.mark.parametrize("part", [3, 824, 5.5, 50, "crop-box", "gaps"])
def test_part_of_a_number_or_name_in_a_message_is_no_fact(part: str | float) -> None:
    with pytest.raises(AssertionError, match="is not in: slice003"):
        assert_facts(MESSAGE, part)


@pytest.mark.parametrize("facts", [(), ("",), ("13,824 voxels",)], ids=["none", "empty", "two words"])
def test_sentence_in_place_of_facts_is_refused(facts: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match="one word each"):
        assert_facts(MESSAGE, *facts)


def test_error_of_the_expected_kind_with_its_facts_is_caught() -> None:
    with refused(KeyError, 3) as caught:
        raise KeyError(3)
    assert caught.type is KeyError


def test_error_of_another_kind_than_expected_is_raised() -> None:
    with refused(KeyError, 3), refused(UserWarning, 3):
        raise KeyError(3)


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


@pytest.mark.release  # as is the coverage itself
@pytest.mark.parametrize(
    ("options", "parameters", "mark", "lines", "branches"),
    [
        pytest.param(WORKERS, [1], "every_device", 5, 3, id="two workers, a traced mark"),
        pytest.param([], [1, "long", 2], "untraced", 3, 1, id="nothing new for a long time: the rest is not traced"),
        pytest.param(WORKERS, [1], "slow", 3, 1, id="two workers, slow tests are not traced: def, if, return"),
        pytest.param([], [1, 1, 2], "slow", 5, 3, id="one process"),
        pytest.param([], ["long", 2], "slow", 5, 3, id="one process, the first test is long"),
    ],
)
def test_coverage_of_lines_and_branches_is_printed_before_the_last_line(
    tmp_path: Path, options: list[str], parameters: list[object], mark: str, lines: int, branches: int
) -> None:
    """choose(1) runs three lines (def, if, return) and one branch; choose(3) two lines and two branches more."""
    for name, text in PROJECT.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    test = COVERED.replace("PARAMETERS", repr(parameters)).replace("MARK", mark)
    search = os.pathsep.join([str(tmp_path / "tests" / "support"), str(tmp_path)])

    done = run_pytest(tmp_path, test, *options, CLRECON_COVERAGE="1", PYTHONPATH=search)

    assert done.returncode == 0, done.stdout + done.stderr
    *_, coverage, last = done.stdout.splitlines()
    assert f"{len(parameters) + 1} passed" in last, done.stdout
    shares = f"{100 * lines / 8:.1f} % of 8 lines and {100 * branches / 4:.1f} % of 4 branches"
    assert coverage.startswith(f"coverage of clrecon: {shares}")


NO_DRIVER = "import clrecon.opencl\nclrecon.opencl.list_devices = lambda: []\n"
USES_DEVICE = "def test_it(device):\n    assert device.name\n"
USES_DATA = "def test_it(real_data):\n    assert real_data.is_dir()\n"
SKIPPED = "import pytest\ndef test_it():\n    pytest.skip('no')\n"
PASSES = "def test_it():\n    assert 1 + 1 == 2\n"

OK, FAILED = pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED
WRONG, NO_TESTS = pytest.ExitCode.INTERRUPTED, pytest.ExitCode.NO_TESTS_COLLECTED


@pytest.mark.parametrize(
    ("test", "variables", "code"),
    daily_rows(
        4,
        [
            pytest.param(PASSES, {"CLRECON_REQUIRE_TESTS": "1"}, OK, id="required test runs"),
            pytest.param(SKIPPED, {}, OK, id="all skipped"),
            pytest.param(SKIPPED, {"CLRECON_REQUIRE_TESTS": "1"}, NO_TESTS, id="required test skipped"),
            pytest.param(NO_DRIVER + USES_DEVICE, {}, OK, id="no driver"),
            pytest.param(NO_DRIVER + USES_DEVICE, {"CLRECON_REQUIRE_DEVICE": "1"}, FAILED, id="no required device"),
            pytest.param(
                NO_DRIVER + USES_DEVICE, {"CLRECON_REQUIRE_PLATFORMS": "Intel"}, WRONG, id="no required platform"
            ),
            pytest.param(USES_DEVICE, {"CLRECON_TEST_DEVICE": "no such device"}, WRONG, id="no named device"),
            pytest.param(USES_DATA, {"CLRECON_TEST_DATA": "no-such-folder"}, FAILED, id="no named data"),
        ],
    ),
)
def test_session_fails_where_a_required_or_named_test_device_or_folder_is_missing(
    tmp_path: Path, test: str, variables: dict[str, str], code: pytest.ExitCode
) -> None:
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
            # int16 and what a simulator watches on both devices, int8 and test_first on the first
            pytest.param({}, "6 passed, 1 deselected", id="every day"),
            # test_first fails on the second device
            pytest.param({"CLRECON_TEST_EVERY_DEVICE": "1"}, "1 failed, 7 passed, 1 deselected", id="every device"),
            pytest.param({"CLRECON_RELEASE_TESTS": "1"}, "7 passed", id="release"),
            # of each test the first parameter on the first device
            pytest.param({"CLRECON_FAST_TESTS": "1"}, "3 passed, 5 deselected", id="fast"),
            # the 0 in the name of the second is no index
            pytest.param({"CLRECON_TEST_DEVICE": "0"}, "4 passed", id="device 0"),
        ],
    ),
)
def test_tests_run_on_the_devices_of_their_marks_and_of_the_variables(
    tmp_path: Path, variables: dict[str, str], passed: str
) -> None:
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


def test_test_marked_long_runs_before_the_others(tmp_path: Path) -> None:
    done = run_pytest(tmp_path, LONG_AND_SHORT, "-vv")
    assert done.stdout.index("test_long PASSED") < done.stdout.index("test_short PASSED"), done.stdout + done.stderr


NAMED_BY_AN_ADDRESS = """
import pytest
@pytest.mark.parametrize("answer", [lambda: 1], ids=str)
def test_answer(answer):
    pass
"""


def test_row_that_is_named_by_an_address_ends_the_session(tmp_path: Path) -> None:
    done = run_pytest(tmp_path, NAMED_BY_AN_ADDRESS)
    assert (done.returncode, "give its rows ids" in done.stdout + done.stderr) == (pytest.ExitCode.USAGE_ERROR, True)


def test_required_platforms_are_found_in_this_session(device: object) -> None:
    """Asks for the devices of this session, so that a platform that got lost shows in every run."""
    wanted = os.environ.get("CLRECON_REQUIRE_PLATFORMS", "")
    named = os.environ.get("CLRECON_TEST_DEVICE", "").strip()
    # With a named device alone in use, other platforms have none here.
    assert named or conftest.missing_platforms(wanted, conftest.Devices.get()[0]) == []
