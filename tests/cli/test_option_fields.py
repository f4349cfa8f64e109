"""Settings that are made from the options that are their fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

import pytest
from refusals import refused

from clrecon.cli.common import Parser, add_fields, make_part, make_settings
from clrecon.cli.main import COMMANDS
from clrecon.errors import UsageError
from clrecon.system.options import option


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


def test_option_that_is_not_given_is_the_default_of_its_field() -> None:
    assert parse() == Settings()
    assert parse("--count", "5", "--even", "4", "--open", "--no-solid") == Settings(count=5, even=4, is_open=True)
    assert parse("--name", "a", "--name", "b", "--solid") == Settings(names=("a", "b"), is_solid=True)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--even", "3"], "argument --even: 3 is odd (see: clrecon --help)"),
        (["--refused", "x"], "that says all"),
        (["--count", "x"], "argument --count: 'x' is no whole number (see: clrecon --help)"),
    ],
)
def test_a_value_is_refused_in_the_words_of_its_reader(words: list[str], said: str) -> None:
    with pytest.raises(UsageError) as caught:
        parse(*words)
    assert str(caught.value) == said


@dataclass(frozen=True, kw_only=True)
class Part:
    path: str | None = option("--labels FILE", "a map")
    grow: float | None = option("--grow MM", "how far")


def test_options_of_a_part_need_the_one_that_it_is_about() -> None:
    parser = Parser(prog="clrecon")
    add_fields(parser, Part)
    made = [
        make_part(Part, given, given.path, "is about labels")
        for given in (parser.parse_args([]), parser.parse_args(["--labels", "a", "--grow", "2"]))
    ]
    assert made == [None, Part(path="a", grow=2.0)]
    lone = parser.parse_args(["--grow", "0"])
    with refused(UsageError, "--grow", "labels"):
        make_part(Part, lone, lone.path, "is about labels")


def test_a_view_takes_the_kinds_of_surface_that_a_mesh_takes() -> None:
    for name in ("mesh", "view"):
        parser = Parser(prog=name)
        import_module(COMMANDS[name].module).add_arguments(parser)
        given = parser.parse_args(["ct", *(("-o", "a.stl") if name == "mesh" else ()), "--surface", "CORTEX"])
        assert given.surface == "cortex"
