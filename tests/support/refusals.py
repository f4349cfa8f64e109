"""What an error must tell whatever its sentence is: its kind, and the numbers and names that stand in it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?(?![\w]|\.\d)")


def _numbers_in(text: str) -> list[float]:
    return [float(number.replace(",", "")) for number in _NUMBER.findall(text)]


def assert_facts(text: str, *facts: str | float) -> None:
    """Assert that `text` has each of `facts`: a number however it is written, a name as a word of its own."""
    if not facts or any(isinstance(fact, str) and (not fact or re.search(r"\s", fact)) for fact in facts):
        raise ValueError(f"facts are numbers and names, one word each, not {facts}")
    for fact in facts:
        if isinstance(fact, str):
            assert re.search(rf"(?<!\w){re.escape(fact)}(?!\w)", text), f"{fact} is not in: {text}"
        else:
            assert float(fact) in _numbers_in(text), f"the number {fact} is not in: {text}"


def assert_one_line(error: BaseException, *facts: str | float, letters: int = 1000) -> None:
    """Assert that the message of an error is one line of printable letters, fewer than `letters`, and has `facts`."""
    text = str(error)
    assert text.isprintable() and 0 < len(text) < letters, text
    if facts:
        assert_facts(text, *facts)


@contextmanager
def refused(kind: type[BaseException], *facts: str | float) -> Iterator[pytest.ExceptionInfo[BaseException]]:
    """Expect an error of this kind that names each of `facts`; see `assert_facts`."""
    with pytest.raises(kind) as caught:
        yield caught
    assert_facts(str(caught.value), *facts)
