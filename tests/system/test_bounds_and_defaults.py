"""Bounds and defaults of what all of clrecon shares, each at its last value and the next."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
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


def test_available_memory_is_read_from_meminfo_in_kibibytes(tmp_path: Path) -> None:
    (tmp_path / "meminfo").write_text("MemFree: 1 kB\nMemAvailable: 5 kB\n")
    assert memory.available_memory_bytes(tmp_path, tmp_path) == 5 * 1024


def test_memory_of_control_groups_is_free_memory_of_each_group_up_to_their_root(tmp_path: Path) -> None:
    """Free is what the group may use less what it uses, without the inactive pages of files."""
    root = tmp_path / "above" / "groups"
    (tmp_path / "self").mkdir()
    (tmp_path / "self" / "cgroup").write_text("0::/box\n")
    for folder, allowed in ((root / "box", 90), (root, 50), (root.parent, 10)):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "memory.max").write_text(str(allowed))
        (folder / "memory.current").write_text("3")
        (folder / "memory.stat").write_text("inactive_file 2\n")
    assert list(memory._group_bytes(tmp_path, root)) == [90 - 3 + 2, 50 - 3 + 2]


def test_volume_larger_than_the_free_memory_is_refused_with_both_in_gib(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "available_memory_bytes", lambda: 2.0**30)
    with pytest.raises(RefusedInputError) as caught:
        memory.allocate_voxels((1024, 1024, 1536), np.int16, name="a.nii")  # (k, j, i), 2 bytes a voxel
    needed = "the volume of 1536 x 1024 x 1024 voxels needs 3.00 GiB of memory"
    assert str(caught.value) == f"a.nii: {needed}, 1.00 GiB are free"


class Chunked:
    """The shape of an array of int16 and that of its chunks, as zarr or Dask says it."""

    dtype = np.dtype(np.int16)

    def __init__(self, shape: tuple[int, ...], chunks: tuple[Any, ...]):
        self.shape, self.chunks = shape, chunks


@pytest.mark.parametrize(
    ("source", "slices"),
    [
        (Chunked((200, 1024, 1024), (64, 64, 64)), 64),  # a layer has 128 MiB: one at a time
        (Chunked((200, 1024, 1024), (1, 1024, 1024)), 32),  # as many as 64 MiB have
        (Chunked((200, 1024, 1024), ((100, 60, 40), (1024,), (1024,))), 100),
        (Chunked((200, 8192, 8192), (64, 64, 64)), 4),  # of a layer of 8 GiB as much as 512 MiB have
    ],
    ids=["layer", "thin layers", "uneven layers", "part of a layer"],
)
def test_chunked_array_is_read_by_whole_layers_as_far_as_they_are_small(source: Chunked, slices: int) -> None:
    parts = [*memory.iterate_layers(source)]
    assert parts[0] == (0, slices)
    assert [first for first, _ in parts[1:]] == [end for _, end in parts[:-1]]
    assert parts[-1][1] == source.shape[0]


def test_volume_that_fits_into_the_free_memory_is_allocated() -> None:
    voxels = memory.allocate_voxels((2, 3, 4), np.int16)
    assert (voxels.shape, voxels.dtype) == ((2, 3, 4), np.int16)


def test_held_interrupt_has_its_handler_again_afterwards() -> None:
    before = signal.getsignal(signal.SIGINT)
    with files.hold_interrupts():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_signal_that_this_process_does_not_handle_is_not_held() -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with files.hold_interrupts():
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before)


def test_thread_beside_the_main_one_holds_no_interrupts() -> None:
    """Only the main thread of a process can set the handlers of signals."""

    def handler_while_held() -> Any:
        with files.hold_interrupts():
            return signal.getsignal(signal.SIGINT)

    with ThreadPoolExecutor(1) as thread:
        assert thread.submit(handler_while_held).result() is signal.getsignal(signal.SIGINT)


@pytest.mark.parametrize(
    ("hard", "soft", "new_limits"),
    [
        pytest.param(4096, 256, [(1000 + files._FILES_OF_OTHERS, 4096)], id="to what is needed"),
        pytest.param(700, 256, [(700, 700)], id="to the hard limit"),
        pytest.param(None, 9000, [], id="high enough"),
        pytest.param(None, None, [], id="no limit"),
    ],
)
def test_limit_of_open_files_is_raised_to_what_1000_files_need_or_as_far_as_allowed(
    hard: int | None, soft: int | None, new_limits: list[tuple[int, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    resource = pytest.importorskip("resource")
    limits = tuple(resource.RLIM_INFINITY if limit is None else limit for limit in (soft, hard))
    set_limits: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda _: limits)
    monkeypatch.setattr(resource, "setrlimit", lambda _, both: set_limits.append(both))
    files.allow_open_files(1000)
    assert set_limits == new_limits


@pytest.fixture
def free_bytes(monkeypatch: pytest.MonkeyPatch) -> int:
    """The free bytes of the disk, as the system gives them."""
    free = 5 * 10**11
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(total=10**12, free=free))
    return free


def test_file_that_fills_the_disk_to_its_last_byte_is_accepted(tmp_path: Path, free_bytes: int) -> None:
    files.check_writable(tmp_path / "a.ply", expected_bytes=free_bytes)


def test_file_larger_than_the_free_space_is_refused_with_the_free_gigabytes(tmp_path: Path, free_bytes: int) -> None:
    with refused(OutputError, "GB", free_bytes / 10**9):
        files.check_writable(tmp_path / "a.ply", expected_bytes=2 * free_bytes)


def test_temporary_folder_is_for_its_owner_alone_and_removed_with_its_files(tmp_path: Path) -> None:
    with files.temporary_folder(tmp_path) as folder:
        (folder / "a").write_text("a")
        assert list(tmp_path.iterdir()) == [folder]
        assert folder.stat().st_mode & 0o777 == 0o700
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "fact"), [("a", "extension"), ("a.plx", ".plx")])
def test_missing_or_unknown_extension_is_refused_with_the_known_ones(name: str, fact: str) -> None:
    with refused(UsageError, fact, ".ply", ".stl"):
        find_extension(name, (".ply", ".stl"), noun="mesh")


def test_name_that_is_only_an_extension_is_refused_with_it() -> None:
    with refused(UsageError, "only", ".ply"):
        find_extension(".ply", (".ply", ".stl"), noun="mesh")


def test_extension_in_capitals_is_found() -> None:
    assert find_extension("A.PLY", (".ply", ".stl"), noun="mesh") == ".ply"


def test_file_is_read_up_to_its_largest_size_and_refused_a_byte_above(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1234")
    assert read_regular(tmp_path / "a", limit=4) == b"1234"
    with refused(OSError, "bytes", 3):
        read_regular(tmp_path / "a", limit=3)


@pytest.mark.parametrize("is_shown", [False, True])
def test_warnings_of_libraries_are_shown_only_on_request(is_shown: bool) -> None:
    shows_warnings = warnings.showwarning
    with foreign_words.own_streams(show=is_shown):
        assert (warnings.showwarning is shows_warnings) == is_shown


def test_warnings_of_libraries_are_not_shown_by_default() -> None:
    shows_warnings = warnings.showwarning
    with foreign_words.own_streams():
        assert warnings.showwarning is not shows_warnings


@pytest.mark.parametrize(
    ("module", "package"), [("no_such_module", "no_such_module"), ("skimage.no_such_module", "scikit-image")]
)
def test_missing_package_is_named_as_it_is_installed(module: str, package: str) -> None:
    with refused(UsageError, package):
        import_package(module, "a table")


def test_default_time_limit_of_a_device_is_ten_minutes() -> None:
    assert progress.DEFAULT_SECONDS == 10 * 60


@pytest.mark.parametrize("value", ["x" * 38, None, 1.5, 2j])
def test_value_of_up_to_40_characters_is_written_out_in_a_message(value: object) -> None:
    assert arguments._name_value(value) == repr(value)  # quotes make the text one of 40


def test_longer_value_is_named_by_its_type_in_a_message() -> None:
    assert arguments._name_value("x" * 39) == "str"


def test_class_is_named_as_a_class_in_a_message() -> None:
    assert arguments._name_value(int) == "the class int"


@pytest.mark.parametrize(
    ("value", "is_flag"), [(True, True), (np.bool_(False), True), (1, True), (2, False), (0.0, False), ("1", False)]
)
def test_flag_is_a_truth_value_or_the_integer_0_or_1(value: object, is_flag: bool) -> None:
    assert arguments._is_flag(value) == is_flag


@pytest.mark.parametrize(
    ("value", "is_sequence"), [([1], True), ("1", False), (b"1", False), ({1: 1}, False), ({1}, False)]
)
def test_sequence_is_ordered_and_no_text(value: object, is_sequence: bool) -> None:
    assert arguments._is_sequence(value) == is_sequence


@arguments.explains_arguments
def add_up(points: tuple[float, float] | Sequence[float] | str, more: list[float] | None = None) -> float:
    return sum(points) + sum(more)  # type: ignore[arg-type]


NOT_A_LIST: Any = 5


def test_argument_of_a_wrong_known_kind_is_refused_with_its_name_and_value() -> None:
    with refused(UsageError, "points", 2, 5):  # expected are 2 numbers
        add_up(NOT_A_LIST)


def test_argument_of_a_kind_that_is_not_known_raises_the_error_of_python() -> None:
    with refused(TypeError, "iterable"):
        add_up([1.0], NOT_A_LIST)


@dataclass(frozen=True)
class Few:
    first: int
    second: int = 2
    third: list[int] = field(default_factory=list)


def test_fields_of_a_dataclass_are_given_by_position_or_name() -> None:
    assert Few(1) == Few(1, 2, []) == Few(1, second=2) == Few(first=1)


def test_more_arguments_than_fields_are_refused_with_the_class() -> None:
    with refused(TypeError, "Few", "arguments"):
        Few(1, 2, [], 4)  # type: ignore[call-arg]


def test_field_given_twice_is_refused_with_the_class() -> None:
    with refused(TypeError, "Few", "first"):
        Few(1, first=1)  # type: ignore[misc]


def test_package_that_needs_pillow_is_imported_where_the_command_line_hides_it(tmp_path: Path) -> None:
    """As matplotlib does, with which ``clrecon compare`` draws."""
    (tmp_path / "draws.py").write_text("from PIL import Image\n", encoding="utf-8")
    code = """
from clrecon.system.packages import hide_unused, import_package
hide_unused()
print(import_package("draws", "a page").Image.__name__)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "PIL.Image\n", done.stderr
