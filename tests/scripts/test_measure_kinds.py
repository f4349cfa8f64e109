"""Kinds of scan against their truth: volumes, places, gates and warnings; the page's table and each of its commands."""

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


def measure(shared_folder: Path, tmp_path: Path, device: Any, kind: str, way: str) -> dict[str, Any]:
    scan, settings = make_scan(shared_folder, kind)
    options = measure_kinds.WAYS[kind][way]
    return measure_kinds.measure_way(scan, settings, options, tmp_path, str(device.index))


def most_off(kind: str, way: str) -> float:
    return 0.05 if "print" in way or kind == "hip" else 0.03  # metal is swollen


ROWS = [(kind, way) for kind, ways in measure_kinds.WAYS.items() for way in ways]
EVERY_DAY = [("mouse", "default"), ("jaw", "auto"), ("longbone", "auto"), ("hand", "default")]


@pytest.mark.parametrize(("kind", "way"), daily_rows(4, EVERY_DAY + [row for row in ROWS if row not in EVERY_DAY]))
def test_volumes_are_true_or_the_reason_is_named(
    shared_folder: Path, tmp_path: Path, device: Any, kind: str, way: str
) -> None:
    found = measure(shared_folder, tmp_path, device, kind, way)
    off = abs(measure_kinds.volume_error(found))
    assert off < 0.1 or measure_kinds.said_of(found), (off, found)
    assert found["code"] == 0
    if "default" not in way:
        assert found["closed"] and off < most_off(kind, way) and found["off_voxels"] < 0.3


@pytest.mark.parametrize(("kind", "ways"), FIGURES.items())
def test_the_figures_of_the_page_reach_what_is_promised(kind: str, ways: dict[str, Any]) -> None:
    assert list(ways) == list(measure_kinds.WAYS[kind])
    for way, found in ways.items():
        off = abs(measure_kinds.volume_error(found))
        assert off < 0.1 or measure_kinds.said_of(found)
        if "default" not in way:
            assert found["closed"] and off < most_off(kind, way) and found["off_voxels"] < 0.3


def test_the_page_has_the_figures() -> None:
    assert marked_tables.find_table(PAGE, "kinds of scan") == measure_kinds.make_table(FIGURES)


def test_what_hard_walls_enclose_is_open_at_the_sides_alone() -> None:
    hard = np.zeros((4, 7, 7), bool)
    hard[:, 1:6, 1:6] = True
    hard[:, 2:5, 2:5] = False  # a canal from end to end
    assert measure_kinds.enclosed_by(hard)[:, 1:6, 1:6].all() and measure_kinds.enclosed_by(hard).sum() == 100
    hard[2, 3, 5] = False
    assert np.array_equal(measure_kinds.enclosed_by(hard), hard)


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
def test_the_commands_of_a_section_run(
    title: str, shared_folder: Path, tmp_path: Path, device: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    for _, arguments, code in (row for row in commands_of_the_page() if row[0] == title):
        if arguments[0] == "phantom":
            arguments += ["--slices", str(SLICES[arguments[arguments.index("--kind") + 1]])]
        assert main([*arguments, "-q"]) == code, arguments
        if "-o" in arguments:
            assert Path(arguments[arguments.index("-o") + 1]).stat().st_size > 1000


def test_the_page_has_a_section_for_each_kind() -> None:
    made = [
        arguments[arguments.index("--kind") + 1] for _, arguments, _ in commands_of_the_page() if "--kind" in arguments
    ]
    assert sorted(made) == sorted(measure_kinds.WAYS) == sorted(FIGURES) and len(SECTIONS) == len(made)
