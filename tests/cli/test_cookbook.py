"""The tasks of docs/cookbook.md run as they stand, commands and checks in their order."""

from __future__ import annotations

import re
import shlex
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from house import ROOT

from clrecon.cli.main import main

PAGE = ROOT / "docs" / "cookbook.md"
BLOCK = re.compile(r"^```python\n(?P<python>[\s\S]*?)^```|^ {4}clrecon (?P<command>.*)$", re.MULTILINE)
OPTIONAL = ("gmsh",)
"""What a block may import that is installed for a release alone; without it the block is left out."""


def read_tasks(text: str) -> dict[str, list[tuple[str, str]]]:
    """The tasks of a page: by title their blocks, each a kind, command or python, and its text."""
    parts = [part.partition("\n") for part in text.split("\n## ")[1:]]
    return {
        title: [(str(block.lastgroup), block[str(block.lastgroup)]) for block in BLOCK.finditer(body)]
        for title, _, body in parts
    }


TASKS = read_tasks(PAGE.read_text(encoding="utf-8"))


def test_cookbook_has_ten_tasks() -> None:
    assert len(TASKS) == 10


@pytest.mark.parametrize("title", TASKS)
def test_task_has_a_command_of_clrecon_and_ends_with_a_check(title: str) -> None:
    assert "command" in dict(TASKS[title])
    kind, text = TASKS[title][-1]
    assert kind == "python"
    assert "assert " in text


def test_commands_and_python_of_a_task_are_found_in_their_order() -> None:
    page = "x\n## Weigh\n\n    clrecon a b\n    clrecon c\n\nwords\n\n```python\nx = 1\n```\n\n    clrecon d\n"
    assert read_tasks(page) == {
        "Weigh": [("command", "a b"), ("command", "c"), ("python", "x = 1\n"), ("command", "d")]
    }


@pytest.mark.slow
@pytest.mark.parametrize("title", TASKS)
def test_task_of_the_cookbook_runs_and_its_check_holds(
    title: str, device: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CLRECON_DEVICE", str(device.index))
    (tmp_path / "scans").mkdir()
    names: dict[str, Any] = {}
    for kind, text in TASKS[title]:
        if kind == "command":
            assert main([*shlex.split(text), "-q"]) == 0, text
        elif all(find_spec(name) or f"import {name}" not in text for name in OPTIONAL):
            exec(compile(text, f"docs/cookbook.md: {title}", "exec"), names)
