"""Words of the command line: help, version, presets in any case, and what a misspelt word may have meant."""

from __future__ import annotations

from pathlib import Path

import pytest
from printed_text import Printer
from refusals import refused

from clrecon.cli.main import COMMANDS, main
from clrecon.errors import UsageError
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.presets import find_iso_preset as find_level
from clrecon.jobs.render.settings import RenderSettings
from clrecon.rendering.looks.presets import find_preset as find_look
from clrecon.system.text import count_of, guess_word
from clrecon.version import package_version


@pytest.mark.parametrize(
    ("command", "option"),
    [(["help"], ["--help"]), (["help", "mesh"], ["mesh", "--help-all"])],
    ids=["alone", "of a command"],
)
def test_help_as_a_command_prints_what_its_option_does(command: list[str], option: list[str], printed: Printer) -> None:
    assert main(command) == 0
    by_command = printed().everything
    assert main(option) == 0
    assert printed().everything == by_command


def test_help_of_mesh_has_its_options(printed: Printer) -> None:
    assert main(["help", "mesh"]) == 0
    printed().assert_output("--keep-largest")


def test_help_of_help_is_there() -> None:
    assert main(["help", "help"]) == 0


@pytest.mark.parametrize("option", ["-V", "--version"])
def test_version_has_a_short_option(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([option]) == 0
    assert capsys.readouterr().out == f"clrecon {package_version()}\n"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("mehs ct -o a.stl", "no command 'mehs' (did you mean mesh?): use one of mesh, cloud"),
        ("help rendr", "did you mean render?"),
        ("--verison", "did you mean --version?"),
        ("mesh ct --kep-largest 1 -o a.stl", "unrecognized arguments: --kep-largest (did you mean --keep-largest?)"),
        ("mesh ct --ouput=a.stl", "--ouput (did you mean --output?) (see: clrecon mesh --help)"),
        ("export ct -o a.nii --spacing 2", "--spacing (did you mean --resample?)"),
        ("mesh ct -o a.stl --threshold 200", "--threshold (did you mean --hu?)"),
        ("mesh ct -o a.stl --preset bon", "did you mean bone?"),
        ("mesh ct -o a.slt", "'.slt' (did you mean .stl?)"),
        ("mesh ct -o a.stl --for prnt", "did you mean print?"),
        ("render ct -o a.png --preset spien", "did you mean spine?"),
        ("render ct -o a.pgn", "did you mean .png?"),
        ("render ct -o a.png --mode slcie", "did you mean slice?"),
        ("render ct -o a.png --view lfet", "did you mean left?"),
        ("render ct -o a.png --background wihte", "did you mean white?"),
        ("render ct --turntable a.pm4", "did you mean .mp4?"),
        ("phantom ph --kind skul", "did you mean skull?"),
        ("cloud ct -o a.pyl", "did you mean .ply?"),
    ],
)
def test_a_misspelt_word_is_guessed(
    arguments: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments.split()) == 3
    captured = capsys.readouterr()
    assert words in captured.err
    assert len(captured.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_word_like_none_is_not_guessed(printed: Printer) -> None:
    assert main(["xyzzy"]) == 3
    said = printed()
    said.assert_error(*COMMANDS)
    assert "mean" not in said.everything
    assert guess_word("qqq", ["bone"]) == guess_word(3, ["3"]) == guess_word("b" * 99, ["b" * 98]) == ""
    assert guess_word("BNOE", ["bone", "skin"]) == " (did you mean bone?)"


def test_options_after_two_dashes_are_names(tmp_path: Path, printed: Printer) -> None:
    assert main(["info", "--", "--kep"]) == 2
    printed().assert_error("--kep")


def test_presets_are_found_in_any_case() -> None:
    assert find_level("Cortical-BONE") is find_level("cortical-bone")
    assert find_look("X-Ray") is find_look("x-ray")
    assert MeshSettings(preset="BONE").preset_used == "bone"
    assert MeshSettings(preset="BONE").levels == MeshSettings(preset="bone").levels
    settings = RenderSettings.of(preset="SPINE")
    assert (settings.mode, settings.style) == ("dvr", RenderSettings.of(preset="spine").style)
    for find in (find_level, find_look):
        with refused(UsageError, "unknown"):
            find(None)  # type: ignore[arg-type]


def test_counts_have_the_noun_of_their_number() -> None:
    assert [count_of(number, "slice") for number in (0, 1, 2, 1200)] == [
        "0 slices",
        "1 slice",
        "2 slices",
        "1,200 slices",
    ]
    assert count_of(2, "body", "bodies") == "2 bodies"
