"""Settings that are made from the options that are their fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

import pytest
from refusals import refused

from clrecon.cli.common import Parser, add_fields, make_settings
from clrecon.cli.main import COMMANDS
from clrecon.errors import UsageError
from clrecon.system.options import make_part, option


def read_even(text: str) -> int:
    if int(text) % 2:
        raise ValueError(f"{text} is odd")
    return int(text)


def refuse(text: str) -> str:
    raise UsageError("that says all")


@dataclass(frozen=True, kw_only=True)
class Settings:
    count: int = option("--count N", "how many", default=3)
    even: int | None = option("--even N", "an even number", parse=read_even)
    refused: str | None = option("--refused X", "never", parse=refuse)
    names: Sequence[str] = option("--name TEXT", "a name", default=(), action="append")
    is_open: bool = option("--open", "leave it open", group="lid")
    is_solid: bool = option("--solid", "fill it", group="lid", action="yes-no")


def parse(*words: str) -> Settings:
    parser = Parser(prog="clrecon")
    add_fields(parser, Settings)
    add_fields(parser, Settings, "lid")
    return make_settings(Settings, parser.parse_args(list(words)))


@pytest.mark.parametrize(
    ("words", "settings"),
    [
        pytest.param([], Settings(), id="defaults"),
        pytest.param(["--count", "5", "--even", "4"], Settings(count=5, even=4), id="numbers"),
        pytest.param(["--open", "--no-solid"], Settings(is_open=True, is_solid=False), id="flags"),
        pytest.param(["--name", "a", "--name", "b", "--solid"], Settings(names=("a", "b"), is_solid=True), id="a list"),
    ],
)
def test_options_are_the_fields_of_their_settings_or_their_defaults(words: list[str], settings: Settings) -> None:
    assert parse(*words) == settings


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--even", "3"], "argument --even: 3 is odd (see: clrecon --help)"),
        (["--refused", "x"], "that says all"),
        (["--count", "x"], "argument --count: 'x' is no whole number (see: clrecon --help)"),
    ],
)
def test_value_that_cannot_be_read_is_refused_in_the_words_of_its_reader(words: list[str], message: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse(*words)
    assert str(caught.value) == message


@dataclass(frozen=True, kw_only=True)
class Part:
    path: str | None = option("--labels FILE", "a map")
    grow: float | None = option("--grow MM", "how far")


@pytest.fixture
def part_parser() -> Parser:
    """A parser with the options of `Part`."""
    parser = Parser(prog="clrecon")
    add_fields(parser, Part)
    return parser


@pytest.mark.parametrize(
    ("words", "part"),
    [([], None), (["--labels", "a", "--grow", "2"], Part(path="a", grow=2.0))],
    ids=["nothing given", "given with its file"],
)
def test_part_of_settings_is_made_where_the_option_that_it_is_about_is_given(
    words: list[str], part: Part | None, part_parser: Parser
) -> None:
    given = part_parser.parse_args(words)
    assert make_part(Part, vars(given), given.path, "is about labels") == part


def test_option_of_a_part_without_the_one_that_it_is_about_is_refused(part_parser: Parser) -> None:
    given = part_parser.parse_args(["--grow", "0"])
    with refused(UsageError, "--grow", "labels"):
        make_part(Part, vars(given), given.path, "is about labels")


@pytest.mark.parametrize("words", [["mesh", "ct", "-o", "a.stl"], ["view", "ct"]], ids=["mesh", "view"])
def test_mesh_and_view_take_a_fitted_surface_in_capitals(words: list[str]) -> None:
    command, *arguments = words
    parser = Parser(prog=command)
    import_module(COMMANDS[command].module).add_arguments(parser)
    assert parser.parse_args([*arguments, "--surface", "CORTEX"]).surface == "cortex"
