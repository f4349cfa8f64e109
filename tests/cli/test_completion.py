"""The scripts that shells complete clrecon's words with, and what they offer."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

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
        (["clrecon", "render", "ct", "--preset", ""], list(PRESETS)),
        (["clrecon", "render", "ct", "--view", "ax"], ["axial"]),
        (["clrecon", "mesh", "ct", "-o", ""], []),  # bash itself completes the names of files
        (["clrecon", "mesh", ""], []),
        (["clrecon", "completion", ""], list(SHELLS)),
    ],
)
def test_bash_offers_the_words_of_the_place(words: list[str], offered: list[str], bash_script: Path) -> None:
    assert complete(bash_script, *words) == offered


@needs_bash
def test_bash_offers_every_command(bash_script: Path) -> None:
    assert complete(bash_script, "clrecon", "") == [*COMMANDS, "help", "--help", "--version"]


@pytest.mark.parametrize("shell", SHELLS)
def test_a_script_names_all_commands_and_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    dashes = "-l " if shell == "fish" else "--"
    for word in (*COMMANDS, f"{dashes}keep-largest", f"{dashes}transfer-function", "cortical-bone", f"{dashes}json"):
        assert word in captured.out
    if shutil.which(shell):  # the shell itself finds no fault in it
        subprocess.run([shell, "-n"], input=captured.out, text=True, timeout=30, check=True)


def test_another_shell_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bahs"]) == 3
    assert "did you mean bash" in capsys.readouterr().err
