"""scripts/proof/compare_versions.py finds what differs between two versions, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
from compare_versions import (
    COMMANDS,
    _commands,
    _compare_folders,
    _differing_lines,
    _distance_of,
    _still,
    differing_names,
)

from clrecon.cli.main import COMMANDS as OF_CLRECON


def test_value_of_a_report_that_changed_is_named_by_its_path() -> None:
    old = {"mesh": {"triangles": 12, "bounds_mm": [[0, 1], [2, 3]]}}
    new = {"mesh": {"triangles": 12, "bounds_mm": [[0, 1], [2, 4]]}}
    assert list(differing_names(old, new)) == ["mesh.bounds_mm[1][1]: 3 became 4"]


@pytest.mark.parametrize("seconds", [{"read": 2.0}, {}])
def test_seconds_of_a_report_are_not_compared(seconds: dict) -> None:
    assert (
        list(differing_names({"triangles": 12, "seconds": {"read": 1.0}}, {"triangles": 12, "seconds": seconds})) == []
    )


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ({"a": 1}, {"a": 1, "b": 2}, "b: 'absent' became 2"),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}, "report: another order of names"),
        ({"a": [1]}, {"a": [1, 2]}, "a: [1] became [1, 2]"),
        ({"a": 1}, {"a": 1.5}, "a: 1 became 1.5"),
    ],
)
def test_difference_of_reports_in_names_order_length_or_type_is_named(old: dict, new: dict, line: str) -> None:
    assert list(differing_names(old, new)) == [line]


@pytest.fixture
def outputs(tmp_path: Path) -> tuple[Path, Path]:
    """Folders of outputs of the old and the new version: a file that differs in one byte."""
    for side, content in (("old", b"solid bone"), ("new", b"solid bane")):
        (tmp_path / side).mkdir()
        (tmp_path / side / "a.stl").write_bytes(content)
    return tmp_path / "old", tmp_path / "new"


def test_first_byte_that_differs_between_two_outputs_is_named(outputs: tuple[Path, Path]) -> None:
    assert _compare_folders(*outputs) == ["a.stl: 10 and 10 bytes, first difference at 7"]


def test_output_that_one_version_alone_writes_is_named(outputs: tuple[Path, Path]) -> None:
    old, new = outputs
    (new / "a.stl").write_bytes((old / "a.stl").read_bytes())
    (new / "b.png").write_bytes(b"")
    assert _compare_folders(old, new) == ["b.png is written by one side only"]


def test_equal_outputs_have_no_difference(outputs: tuple[Path, Path]) -> None:
    old, _ = outputs
    assert _compare_folders(old, old) == []


@pytest.mark.parametrize(
    ("text", "compared"),
    [
        ("read 1/9\rread 9/9\rvertices 12\n", "vertices 12\n"),
        ("time     1.9 s (read 0.72, write 0.03)\n", ""),
        ("3 frames, 0.041 s each\n", "3 frames, N s each\n"),
        ("steps    9 points, 0.07 s\n", "steps    9 points, N s\n"),
        ("warning: 3 s\n", "warning: 3 s\n"),
    ],
    ids=["progress", "line of times", "time of a frame", "time of a step", "a warning"],
)
def test_progress_and_times_of_printed_lines_are_not_compared(text: str, compared: str) -> None:
    assert _still(text) == compared


@pytest.fixture
def compared_commands(tmp_path: Path) -> list[list[str]]:
    """The command lines that both versions run."""
    commands = list(_commands(tmp_path, tmp_path / "levels.nrrd", "L3", "0"))
    folders = [tmp_path / str(number) for number in range(len(commands))]
    return [*commands, _distance_of(folders, commands)]


def test_every_command_of_clrecon_is_named_in_the_comparison_of_versions() -> None:
    assert set(COMMANDS) == {*OF_CLRECON, "help"}


def test_every_command_but_the_listed_ones_is_compared(compared_commands: list[list[str]]) -> None:
    without_scan = {"phantom", "completion", "devices"}
    of_times_or_many_cases = {"batch", "selftest", "bench", "compare", "demo"}
    assert {command[0] for command in compared_commands} == {*OF_CLRECON} - without_scan - of_times_or_many_cases


def test_distance_is_compared_between_two_meshes_that_the_versions_write(compared_commands: list[list[str]]) -> None:
    name, first, second = compared_commands[-1][:3]
    assert name == "distance"
    assert [Path(first).name, Path(second).name] == ["bone.stl", "auto.ply"]


def test_new_and_lost_lines_and_another_exit_code_are_named_and_no_line_that_moved() -> None:
    old, new = (0, "a\nb\nc\n", ""), (4, "a\nnew\nb\n", "warning\n")
    assert list(_differing_lines(old, new)) == ["exit code 0 became 4", "+new", "-c", "+warning"]


def test_equal_exit_codes_and_lines_have_no_difference() -> None:
    old = (0, "a\nb\nc\n", "")
    assert list(_differing_lines(old, old)) == []
