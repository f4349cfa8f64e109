"""Words of the command line: help, version, presets in any case, and what a misspelt word may have meant."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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


def test_help_of_the_command_help_ends_with_0() -> None:
    assert main(["help", "help"]) == 0


@pytest.mark.parametrize("option", ["-V", "--version"])
def test_version_is_printed_by_its_long_and_its_short_option(option: str, capsys: pytest.CaptureFixture[str]) -> None:
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
def test_misspelt_word_of_a_command_is_refused_with_the_nearest_one(
    arguments: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments.split()) == 3
    captured = capsys.readouterr()
    assert words in captured.err
    assert len(captured.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_word_like_no_command_is_refused_with_all_of_them_and_no_guess(printed: Printer) -> None:
    assert main(["xyzzy"]) == 3

    said = printed()
    said.assert_error(*COMMANDS)
    assert "mean" not in said.everything


@pytest.mark.parametrize(
    ("word", "words", "guess"),
    [
        pytest.param("BNOE", ["bone", "skin"], " (did you mean bone?)", id="letters in another order and case"),
        pytest.param("qqq", ["bone"], "", id="no letter of it"),
        pytest.param(3, ["3"], "", id="no text"),
        pytest.param("b" * 99, ["b" * 98], "", id="longer than a word"),
    ],
)
def test_nearest_word_is_guessed_where_it_is_near(word: Any, words: list[str], guess: str) -> None:
    assert guess_word(word, words) == guess


def test_word_after_two_dashes_is_a_name_and_no_option(tmp_path: Path, printed: Printer) -> None:
    assert main(["info", "--", "--kep"]) == 2
    printed().assert_error("--kep")


@pytest.mark.parametrize(
    ("find_preset", "name"), [(find_level, "Cortical-BONE"), (find_look, "X-Ray")], ids=["iso value", "look"]
)
def test_preset_is_found_by_its_name_with_capital_letters(find_preset: Any, name: str) -> None:
    assert find_preset(name) is find_preset(name.lower())


@pytest.mark.parametrize("find_preset", [find_level, find_look], ids=["iso value", "look"])
def test_preset_that_is_no_text_is_refused(find_preset: Any) -> None:
    with refused(UsageError, "unknown"):
        find_preset(None)


def test_settings_with_a_preset_in_capitals_are_those_in_small_letters() -> None:
    mesh, picture = MeshSettings(preset="BONE"), RenderSettings.of(preset="SPINE")

    assert (mesh.preset_used, mesh.levels) == ("bone", MeshSettings(preset="bone").levels)
    assert (picture.mode, picture.style) == ("dvr", RenderSettings.of(preset="spine").style)


@pytest.mark.parametrize(("count", "words"), [(0, "0 slices"), (1, "1 slice"), (2, "2 slices"), (1200, "1,200 slices")])
def test_noun_of_a_count_is_singular_for_1_alone(count: int, words: str) -> None:
    assert count_of(count, "slice") == words


def test_noun_of_a_count_has_the_given_plural() -> None:
    assert count_of(2, "body", several="bodies") == "2 bodies"
