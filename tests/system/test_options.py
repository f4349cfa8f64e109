"""Options of commands that are fields of settings: their flags, values, help and defaults."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pytest
from refusals import refused

from clrecon.system.options import numbers_reader, option, options_of


@dataclass(frozen=True, kw_only=True)
class Settings:
    path: str = option("-f --file FILE", "a file", required=True)
    count: int | None = option("--count N", "how many", default=3, first=True)
    share: float = option("--share SHARE", "how much", default=0.5, parse=lambda text: float(text) / 100.0)
    size: tuple[float, float] = option("--size W H", "two lengths", group="size", default=(1.0, 2.0))
    is_open: bool = option("--open", "leave it open")
    is_closed: bool = option("--no-lid", "without its lid", default=True)
    apart: str = "no option"


def option_named(name: str, group: str = "") -> Any:
    """The option of a field of the settings."""
    [found] = [each for each in options_of(Settings, group) if each.name == name]
    return found


def test_options_without_a_group_are_the_fields_that_declare_one_in_their_order() -> None:
    assert [each.name for each in options_of(Settings)] == ["path", "count", "share", "is_open", "is_closed"]


def test_options_of_a_group_are_the_fields_that_declare_it() -> None:
    assert [each.name for each in options_of(Settings, "size")] == ["size"]


def test_option_has_its_short_and_its_long_flag() -> None:
    assert option_named("path").flags == ["-f", "--file"]


def test_option_has_the_type_of_its_field_with_metavar_and_help() -> None:
    assert option_named("count").how == {"type": int, "metavar": "N", "help": "how many", "first": True}


def test_option_of_two_metavars_takes_two_values() -> None:
    size = option_named("size", "size")
    assert (size.how["metavar"], size.how["nargs"]) == (("W", "H"), 2)


def test_value_of_an_option_is_read_by_the_function_that_it_declares() -> None:
    assert option_named("share").how["type"]("50") == 0.5  # per cent


def test_option_of_a_false_field_stores_true() -> None:
    assert option_named("is_open").how == {"action": "store_true", "help": "leave it open"}


def test_option_of_a_true_field_stores_false() -> None:
    assert option_named("is_closed").how["action"] == "store_false"


def test_defaults_of_options_are_those_of_their_fields() -> None:
    assert Settings(path="a") == Settings(
        path="a", count=3, share=0.5, size=(1.0, 2.0), is_open=False, is_closed=True, apart="no option"
    )


def test_settings_without_a_required_option_are_refused_with_its_name() -> None:
    with refused(TypeError, "path"):
        Settings()  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("count", "text", "numbers"),
    [(2, " 1,-2.5", (1.0, -2.5)), (None, "1,2,3", (1.0, 2.0, 3.0))],
    ids=["two numbers", "any count"],
)
def test_numbers_are_read_from_a_text_with_commas(count: int | None, text: str, numbers: tuple[float, ...]) -> None:
    assert numbers_reader(count, "is wrong")(text) == numbers


@pytest.mark.parametrize("text", ["", "1", "1,2,3", "1,x", "1,"])
def test_text_that_is_not_two_numbers_is_refused_with_itself(text: str) -> None:
    read_point = numbers_reader(2, "is no place")
    with pytest.raises(ValueError, match=f"^'{text}' is no place$"):
        read_point(text)


def test_bounds_that_are_left_out_are_infinite() -> None:
    read_box = numbers_reader(4, "is no box", ends=True)
    assert read_box(",,-50,20") == (-math.inf, math.inf, -50.0, 20.0)
