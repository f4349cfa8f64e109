"""Bounds, defaults and words of what all rooms share, each on its last value and the next."""

from __future__ import annotations

import shutil
import signal
import threading
import warnings
from collections.abc import Sequence
from dataclasses import field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from refusals import refused

from clrecon.errors import OutputError, RefusedInputError, UsageError
from clrecon.system import arguments, files, foreign_words, memory, progress
from clrecon.system.light_dataclass import dataclass
from clrecon.system.packages import import_package
from clrecon.system.paths import find_extension, read_regular
from clrecon.system.records import at_most


def test_memory_is_told_in_kibibytes(tmp_path: Path) -> None:
    (tmp_path / "meminfo").write_text("MemFree: 1 kB\nMemAvailable: 5 kB\n")
    assert memory.available_memory_bytes(tmp_path, tmp_path) == 5 * 1024


def test_groups_are_looked_through_up_to_their_root(tmp_path: Path) -> None:
    groups = tmp_path / "above" / "groups"
    (tmp_path / "self").mkdir()
    (tmp_path / "self" / "cgroup").write_text("0::/box\n")
    for folder, most in ((groups / "box", 90), (groups, 50), (groups.parent, 10)):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in (("max", str(most)), ("current", "3"), ("stat", "inactive_file 2\n")):
            (folder / f"memory.{name}").write_text(text)
    assert list(memory._group_bytes(tmp_path, groups)) == [89, 49]


def test_a_volume_that_does_not_fit_is_named_with_its_gib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_memory_bytes", lambda: 2.0**30)
    with pytest.raises(RefusedInputError) as caught:
        memory.allocate_voxels((1 << 10, 1 << 10, 3 << 9), np.int16, "a.nii")
    assert (
        str(caught.value)
        == "a.nii: the volume of 1536 x 1024 x 1024 voxels needs 3.00 GiB of memory, 1.00 GiB are free"
    )
    assert memory.allocate_voxels((2, 3, 4), np.int16).nbytes == 48


def test_interrupts_are_held_and_given_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    handled = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with files.hold_interrupts():
        assert signal.getsignal(signal.SIGINT) is not before
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL  # which this process does not handle
    signal.signal(signal.SIGTERM, handled)
    assert signal.getsignal(signal.SIGINT) is before
    seen: list[Any] = []

    def hold() -> None:
        with files.hold_interrupts():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=hold)
    thread.start()
    thread.join()
    assert seen == [before]


@pytest.mark.parametrize(
    ("hard", "soft", "asked"),
    [(4096, 256, [(1000 + files._FILES_OF_OTHERS, 4096)]), (700, 256, [(700, 700)]), (-1, 9000, []), (-1, -1, [])],
)
def test_the_limit_of_open_files_is_raised_as_far_as_it_goes(
    hard: int, soft: int, asked: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    resource = pytest.importorskip("resource")
    told: list[tuple[int, int]] = []
    no_limit = {-1: resource.RLIM_INFINITY}
    limits = no_limit.get(soft, soft), no_limit.get(hard, hard)
    monkeypatch.setattr(resource, "getrlimit", lambda _: limits)
    monkeypatch.setattr(resource, "setrlimit", lambda _, both: told.append(both))
    files.allow_open_files(1000)
    assert told == asked


def test_a_file_may_fill_the_disk_to_its_last_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = 5 * 10**11
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=10**12, free=free))
    files.check_writable(tmp_path / "a.ply", expected_bytes=free)
    with refused(OutputError, "MB", 500000.0):
        files.check_writable(tmp_path / "a.ply", expected_bytes=2 * free)


def test_a_folder_is_made_once_and_removed(tmp_path: Path) -> None:
    with files.temporary_folder(tmp_path) as made:
        (made / "a").write_text("a")
        assert list(tmp_path.iterdir()) == [made] and made.stat().st_mode & 0o777 == 0o700
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "fact"), [("a", "extension"), ("a.plx", ".plx"), (".ply", "extension")])
def test_an_extension_that_is_wrong_is_named(name: str, fact: str) -> None:
    with refused(UsageError, fact, ".ply", ".stl"):
        find_extension(name, (".ply", ".stl"), "mesh")
    assert find_extension("A.PLY", (".ply", ".stl"), "mesh") == ".ply"


def test_a_file_of_the_largest_size_is_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1234")
    assert read_regular(tmp_path / "a", 4) == b"1234"
    with refused(OSError, "bytes", 3):
        read_regular(tmp_path / "a", 3)


def test_warnings_of_libraries_are_left_out_by_default() -> None:
    shown = warnings.showwarning
    with foreign_words.own_streams():
        assert warnings.showwarning is not shown
    with foreign_words.own_streams(show=True):
        assert warnings.showwarning is shown


def test_a_missing_package_is_named_as_it_is_installed() -> None:
    for package, name in ((None, "no_such_module"), ("other-name", "other-name")):
        with refused(UsageError, name):
            import_package("no_such_module", "a table", package)


def test_a_device_may_be_without_progress_for_ten_minutes() -> None:
    assert progress.DEFAULT_SECONDS == 600.0


def test_a_figure_has_the_digits_that_tell_it_from_its_bound() -> None:
    assert at_most("a", 1.0, 1.0, None, "x").text == "x: 1, at most 1"
    assert at_most("a", 1.0000004, 1.0, None, "x").text == "x: 1.0000004, at most 1"


def test_values_of_up_to_40_characters_are_named() -> None:
    assert arguments._name_value("x" * 38) == repr("x" * 38)
    assert arguments._name_value("x" * 39) == "str"
    assert [arguments._name_value(value) for value in (None, 1.5, 2j, int)] == ["None", "1.5", "2j", "the class int"]


def test_flags_and_sequences_are_told() -> None:
    assert [arguments._is_flag(value) for value in (True, np.bool_(False), 1, 2, 0.0, "1")] == [True] * 3 + [False] * 3
    assert [arguments._is_sequence(value) for value in ([1], "1", b"1", {1: 1}, {1})] == [True] + [False] * 4


@arguments.explains_arguments
def add_up(points: tuple[float, float] | Sequence[float] | str, more: list[float] | None = None) -> float:
    return sum(points) + sum(more)  # type: ignore[arg-type]


def test_arguments_of_known_kinds_are_explained() -> None:
    wrong: Any = 5
    with refused(UsageError, "points", 2, 5):
        add_up(wrong)
    with pytest.raises(TypeError):
        add_up([1.0], wrong)  # of a kind that is not known nothing is said


@dataclass(frozen=True)
class Few:
    first: int
    second: int = 2
    third: list[int] = field(default_factory=list)


def test_fields_are_taken_by_place_and_by_name() -> None:
    assert Few(1) == Few(1, 2, []) == Few(1, second=2) == Few(first=1)
    with refused(TypeError, "Few", "arguments"):
        Few(1, 2, [], 4)  # type: ignore[call-arg]
    with refused(TypeError, "Few"):
        Few(1, first=1)  # type: ignore[misc]
