"""Kinds of scan against their truth: volumes, places, gates and warnings; the table and the commands of their page."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damaged_kinds import SLICES, make_scan
from variants import daily_rows

import marked_tables  # isort: skip
import measure_kinds  # isort: skip

from clrecon.cli.main import main

FIGURES = json.loads(measure_kinds.FIGURES.read_text(encoding="utf-8"))
PAGE = measure_kinds.PAGE.read_text(encoding="utf-8")


SILENT_VOLUME_SHARE = 0.1
"""The promise of the page: a volume that is further off is warned of."""
OFF_SURFACE_VOXELS = 0.3
"""The promise of the page for options that fit the kind: the mean distance from the true surface."""


def allowed_volume_share(kind: str, way: str) -> float:
    """The promise of the page for options that fit the kind; metal is swollen, and prints are smoothed."""
    return 0.05 if "print" in way or kind == "hip" else 0.03


def assert_promises(kind: str, way: str, found: dict[str, Any]) -> None:
    """Assert that a mesh is true or warned of, and with options that fit its kind closed, true and in its place."""
    off = abs(measure_kinds.volume_error(found))
    assert off < SILENT_VOLUME_SHARE or measure_kinds.said_of(found), (off, found)
    if "default" not in way:
        assert found["closed"]
        assert off < allowed_volume_share(kind, way)
        assert found["off_voxels"] < OFF_SURFACE_VOXELS


ROWS = [(kind, way) for kind, ways in measure_kinds.WAYS.items() for way in ways]
EVERY_DAY = [("mouse", "default"), ("jaw", "auto"), ("longbone", "auto"), ("hand", "default")]


@pytest.mark.parametrize(("kind", "way"), daily_rows(4, EVERY_DAY + [row for row in ROWS if row not in EVERY_DAY]))
def test_mesh_of_a_kind_of_scan_keeps_the_promises_of_the_page(
    shared_folder: Path, tmp_path: Path, device: Any, kind: str, way: str
) -> None:
    scan, settings = make_scan(shared_folder, kind)
    options = measure_kinds.WAYS[kind][way]
    found = measure_kinds.measure_way(scan, settings, options, tmp_path, str(device.index))
    assert found["code"] == 0
    assert_promises(kind, way, found)


@pytest.mark.parametrize(("kind", "way"), ROWS)
def test_recorded_figures_of_a_kind_of_scan_keep_the_promises_of_the_page(kind: str, way: str) -> None:
    assert_promises(kind, way, FIGURES[kind][way])


def test_every_kind_of_scan_has_recorded_figures_of_all_its_options() -> None:
    assert {kind: list(ways) for kind, ways in FIGURES.items()} == {
        kind: list(ways) for kind, ways in measure_kinds.WAYS.items()
    }


def test_page_of_kinds_of_scan_has_the_table_of_the_recorded_figures() -> None:
    assert marked_tables.find_table(PAGE, "kinds of scan") == measure_kinds.make_table(FIGURES)


@pytest.fixture
def hard_tube() -> Any:
    """The walls of a canal of 3 x 3 voxels that goes through all four slices."""
    hard = np.zeros((4, 7, 7), bool)
    hard[:, 1:6, 1:6] = True
    hard[:, 2:5, 2:5] = False
    return hard


def test_canal_within_hard_walls_is_enclosed_though_it_is_open_at_its_ends(hard_tube: Any) -> None:
    whole = np.zeros_like(hard_tube)
    whole[:, 1:6, 1:6] = True
    assert np.array_equal(measure_kinds.enclosed_by(hard_tube), whole)


def test_canal_with_a_hole_in_its_wall_is_not_enclosed(hard_tube: Any) -> None:
    hard_tube[2, 3, 5] = False
    assert np.array_equal(measure_kinds.enclosed_by(hard_tube), hard_tube)


def commands_of_the_page() -> list[tuple[str, list[str], int]]:
    """Title of the section, arguments and exit code of each command."""
    found = []
    for section in PAGE.split("\n## ")[1:]:
        for line in re.findall(r"^    clrecon (.*)$", section, re.MULTILINE):
            command, _, code = line.partition("# exit ")
            found.append((section.split("\n")[0], shlex.split(command), int(code or 0)))
    return found


SECTIONS = dict.fromkeys(title for title, _, _ in commands_of_the_page())


@pytest.mark.parametrize("title", daily_rows(1, [(title,) for title in reversed(SECTIONS)]))
def test_commands_of_a_section_of_the_page_exit_as_stated_and_write_their_files(
    title: str, shared_folder: Path, tmp_path: Path, device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    for _, arguments, code in (row for row in commands_of_the_page() if row[0] == title):
        if arguments[0] == "phantom":
            arguments += ["--slices", str(SLICES[arguments[arguments.index("--kind") + 1]])]
        assert main([*arguments, "-q"]) == code, arguments
        if "-o" in arguments:
            assert Path(arguments[arguments.index("-o") + 1]).stat().st_size > 1000  # bytes: more than heads


def test_page_of_kinds_of_scan_has_a_section_that_makes_each_kind_once() -> None:
    commands = [arguments for _, arguments, _ in commands_of_the_page()]
    kinds = [arguments[arguments.index("--kind") + 1] for arguments in commands if "--kind" in arguments]
    assert sorted(kinds) == sorted(measure_kinds.WAYS)
    assert len(SECTIONS) == len(kinds)
