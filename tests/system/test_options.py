"""Options that are fields of settings: what is declared, and what reads a value."""

from __future__ import annotations

import math
from dataclasses import dataclass

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


def test_a_field_is_an_option_with_its_flags_and_values() -> None:
    found = {own.name: own for own in options_of(Settings)}
    assert list(found) == ["path", "count", "share", "is_open", "is_closed"]
    assert found["path"].flags == ["-f", "--file"]
    assert found["count"].how == {"type": int, "metavar": "N", "help": "how many", "first": True}
    assert found["share"].how["type"]("50") == 0.5
    assert found["is_open"].how == {"action": "store_true", "help": "leave it open"}
    assert found["is_closed"].how["action"] == "store_false"
    (size,) = options_of(Settings, "size")
    assert (size.how["metavar"], size.how["nargs"]) == (("W", "H"), 2)


def test_defaults_are_those_of_the_fields() -> None:
    assert Settings(path="a") == Settings(
        path="a", count=3, share=0.5, size=(1.0, 2.0), is_open=False, is_closed=True, apart="no option"
    )
    with refused(TypeError, "path"):
        Settings()  # type: ignore[call-arg]


def test_numbers_with_commas_are_read_by_their_count() -> None:
    point = numbers_reader(2, "is no place")
    assert point(" 1,-2.5") == (1.0, -2.5)
    for text in ("", "1", "1,2,3", "1,x", "1,"):
        with pytest.raises(ValueError, match=f"^'{text}' is no place$"):
            point(text)
    assert numbers_reader(None, "are no numbers")("1,2,3") == (1.0, 2.0, 3.0)
    assert numbers_reader(4, "is no box", ends=True)(",,-50,20") == (-math.inf, math.inf, -50.0, 20.0)
