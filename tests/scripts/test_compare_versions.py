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


def test_a_value_that_changed_is_named() -> None:
    old = {"mesh": {"triangles": 12, "bounds_mm": [[0, 1], [2, 3]]}, "seconds": {"read": 1.0}}
    new = {"mesh": {"triangles": 12, "bounds_mm": [[0, 1], [2, 4]]}, "seconds": {"read": 2.0}}
    assert list(differing_names(old, new)) == ["mesh.bounds_mm[1][1]: 3 became 4"]
    assert list(differing_names(old, old | {"seconds": {}})) == []


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ({"a": 1}, {"a": 1, "b": 2}, "b: 'absent' became 2"),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}, "report: another order of names"),
        ({"a": [1]}, {"a": [1, 2]}, "a: [1] became [1, 2]"),
        ({"a": 1}, {"a": 1.5}, "a: 1 became 1.5"),
    ],
)
def test_reports_that_differ_in_names_order_or_length_are_told(old: dict, new: dict, line: str) -> None:
    assert list(differing_names(old, new)) == [line]


def test_a_changed_byte_and_a_missing_file_are_found(tmp_path: Path) -> None:
    for side, data in (("old", b"solid bone"), ("new", b"solid bane")):
        (tmp_path / side).mkdir()
        (tmp_path / side / "a.stl").write_bytes(data)
    (tmp_path / "new" / "b.png").write_bytes(b"")
    assert _compare_folders(tmp_path / "old", tmp_path / "new") == [
        "b.png is written by one side only",
        "a.stl: 10 and 10 bytes, first difference at 7",
    ]
    assert _compare_folders(tmp_path / "old", tmp_path / "old") == []


def test_only_times_are_left_out_of_the_console() -> None:
    times = "time     1.9 s (read 0.72, write 0.03)\n3 frames, 0.041 s each\nsteps    9 points, 0.07 s\n"
    text = f"read 1/9\rread 9/9\rvertices 12\n{times}warning: 3 s\n"
    assert _still(text) == "vertices 12\n3 frames, N s each\nsteps    9 points, N s\nwarning: 3 s\n"


def test_every_command_is_compared_or_left_out_by_name(tmp_path: Path) -> None:
    commands = list(_commands(tmp_path, tmp_path / "levels.nrrd", "L3", "0"))
    folders = [tmp_path / str(number) for number in range(len(commands))]
    commands.append(_distance_of(folders, commands))
    assert set(COMMANDS) == {*OF_CLRECON, "help"}
    alone = {"phantom", "completion", "devices", "help"}
    assert {command[0] for command in commands} == {*OF_CLRECON} - alone - {
        "batch",
        "selftest",
        "bench",
        "compare",
        "demo",
    }
    assert [Path(path).name for path in commands[-1][1:3]] == ["bone.stl", "auto.ply"]


def test_a_line_that_came_moves_no_others() -> None:
    old, new = (0, "a\nb\nc\n", ""), (4, "a\nnew\nb\n", "warning\n")
    assert list(_differing_lines(old, new)) == ["exit code 0 became 4", "+new", "-c", "+warning"]
    assert list(_differing_lines(old, old)) == []
