"""The words by which a message names a parameter: Python's, or those of the command line when it runs.

>>> name_parameter("keep_largest", "N")
'keep_largest=N'

On the command line the same call returns the option of the running command: see `clrecon.cli.wording`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Speaker = Callable[[str, object], str]
"""Function that takes a parameter and its value (None for the parameter alone) and returns the words."""


def in_python(parameter: str, value: object = None) -> str:
    """Return the words for a caller in Python; capital letters stand for a value: ``N``, ``(BONE, TISSUE)``."""
    if value is None:
        return parameter
    placeholder = isinstance(value, str) and value == value.upper()
    return f"{parameter}={value if placeholder else repr(value)}"


_speaker: Speaker = in_python


def name_parameter(parameter: str, value: object = None) -> str:
    """Name a parameter, with a value if one is given, in Python's words or those of the command line.

    parameter: As Python calls it, such as ``"keep_largest"``.
    value: True, a number, a text, or capital letters that stand for one: ``"N"``.
    """
    return _speaker(parameter, value)


@contextmanager
def spoken_by(speaker: Speaker) -> Iterator[None]:
    """Let `speaker` name parameters within a block; messages of other threads change with it during that time."""
    global _speaker
    before, _speaker = _speaker, speaker
    try:
        yield
    finally:
        _speaker = before
