"""The scripts that shells complete clrecon's words with, and what they offer."""

from __future__ import annotations

import argparse
import shutil
import subprocess
from pathlib import Path

import pytest
from command_lines import parser_of

from clrecon.cli.completion import SHELLS, write_script
from clrecon.cli.main import COMMANDS, main
from clrecon.rendering.looks.presets import PRESETS

needs_bash = pytest.mark.skipif(shutil.which("bash") is None, reason="no bash on this machine")


def complete(script: Path, *words: str) -> list[str]:
    """What bash offers for the last of the words."""
    quoted = " ".join(f"'{word}'" for word in words)
    lines = f"source '{script}'; COMP_WORDS=({quoted}); COMP_CWORD={len(words) - 1}; _clrecon"
    shown = lines + '; printf "%s\\n" "${COMPREPLY[@]}"'
    made = subprocess.run(["bash", "--norc", "-c", shown], capture_output=True, text=True, timeout=30, check=True)
    assert made.stderr == ""
    return made.stdout.split()


@pytest.fixture(scope="module")
def bash_script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the script for bash."""
    path = tmp_path_factory.mktemp("completion") / "clrecon.bash"
    path.write_text(write_script("bash"))
    return path


@needs_bash
@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["clrecon", "me"], ["mesh"]),
        (["clrecon", "help", "rend"], ["render"]),
        (["clrecon", "mesh", "ct", "--keep-l"], ["--keep-largest"]),
        (["clrecon", "mesh", "ct", "--space", ""], ["lps", "ras"]),
        (["clrecon", "mesh", "ct", "--preset", "cort"], ["cortical-bone"]),
        (["clrecon", "render", "ct", "--preset", ""], [*PRESETS, "all"]),
        (["clrecon", "render", "ct", "--view", "ax"], ["axial"]),
        (["clrecon", "mesh", "ct", "-o", ""], []),  # bash itself completes the names of files
        (["clrecon", "mesh", ""], []),
        (["clrecon", "completion", ""], list(SHELLS)),
    ],
)
def test_bash_completes_commands_options_and_their_values(
    words: list[str], offered: list[str], bash_script: Path
) -> None:
    assert complete(bash_script, *words) == offered


@needs_bash
def test_bash_offers_every_command_where_nothing_is_typed(bash_script: Path) -> None:
    assert complete(bash_script, "clrecon", "") == [*COMMANDS, "help", "--help", "--version"]


def options_of(command: str) -> list[str]:
    """The long options of a command that its help shows."""
    shown = [action for action in parser_of(command)._actions if action.help != argparse.SUPPRESS]
    return [option for action in shown for option in action.option_strings if option.startswith("--")]


@pytest.mark.parametrize("shell", SHELLS)
def test_completion_script_names_all_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0

    printed = capsys.readouterr()
    dashes = "-l " if shell == "fish" else "--"
    options = {f"{dashes}{option[2:]}" for command in COMMANDS for option in options_of(command)}
    assert len(options) > 100  # the parsers have options
    assert [word for word in (*COMMANDS, *options, "cortical-bone") if word not in printed.out] == []
    assert printed.err == ""


@pytest.mark.parametrize(
    ("option", "words"),
    [("report", "-l report -r -d"), ("quiet", "-s q -l quiet -d"), ("preset", "-l preset -x -a 'bone")],
    ids=["a value", "none", "a word of a list"],
)
def test_fish_offers_words_files_or_nothing_for_the_value_of_an_option(option: str, words: str) -> None:
    of_mesh = [line for line in write_script("fish").splitlines() if "from mesh' " in line]
    assert words in next(line for line in of_mesh if f"-l {option} " in line)


@pytest.mark.parametrize("shell", SHELLS)
def test_completion_script_is_sound_for_its_shell(shell: str) -> None:
    if not shutil.which(shell):
        pytest.skip(f"no {shell} on this machine")
    checked = subprocess.run([shell, "-n"], input=write_script(shell), text=True, timeout=30, capture_output=True)
    assert (checked.returncode, checked.stderr) == (0, "")


def test_completion_for_another_shell_is_refused_with_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bahs"]) == 3
    assert "did you mean bash" in capsys.readouterr().err
