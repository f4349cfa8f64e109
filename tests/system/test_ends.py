"""How processes end, what they keep of freed memory, and folders that cannot be placed."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path

import pytest
from refusals import refused

from clrecon.errors import OutputError
from clrecon.system.paths import place_folder
from clrecon.system.processes import describe_end

pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (7, "its process ended with exit code 7"),
        (-11, "its process crashed with SIGSEGV"),
        (-9, "its process crashed with SIGKILL: out of memory, or ended by somebody"),
        (-99, "its process crashed with signal 99"),
    ],
    ids=["exit code", "signal", "killed", "unknown signal"],
)
def test_end_of_a_process_is_described_by_its_exit_code_or_signal(code: int, words: str) -> None:
    assert describe_end(code) == words


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs the allocator of glibc")
def test_freed_memory_is_kept_for_the_next_array() -> None:
    code = """
from resource import RUSAGE_SELF, getrusage
from clrecon.system.processes import keep_freed_memory
keep_freed_memory()
bytearray(1 << 26)
before = getrusage(RUSAGE_SELF).ru_minflt
bytearray(1 << 26)
print(getrusage(RUSAGE_SELF).ru_minflt - before)
"""
    faults = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout

    assert int(faults) < 100  # of 16,384 pages


def test_older_folder_comes_back_where_a_new_one_cannot_be_placed(tmp_path: Path) -> None:
    older = tmp_path / "scan"
    older.mkdir()
    (older / "slice").write_text("kept")

    with refused(OutputError, "scan"):
        place_folder(tmp_path / "never_made", older, older, keep=False)

    assert [path.name for path in tmp_path.iterdir()] == ["scan"]
    assert (older / "slice").read_text() == "kept"
