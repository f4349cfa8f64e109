"""How a message names a parameter: as Python does, or as the command line that runs.

>>> name_parameter("keep_largest", "N")
'keep_largest=N'

On the command line the same call gives the option of the command that runs: see `clrecon.cli.wording`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["Speaker", "in_python", "name_parameter", "spoken_by"]

Speaker = Callable[[str, object], str]
"""Takes a parameter and its value (None for the parameter alone), gives the words."""


def in_python(parameter: str, value: object = None) -> str:
    """The words of a caller in Python; capital letters stand for a value: ``N``, ``(BONE, TISSUE)``."""
    if value is None:
        return parameter
    placeholder = isinstance(value, str) and value == value.upper()
    return f"{parameter}={value if placeholder else repr(value)}"


_speaker: Speaker = in_python


def name_parameter(parameter: str, value: object = None) -> str:
    """Name a parameter, and a value of it, in the words of who runs clrecon.

    Parameters
    ----------
    parameter : str
        As Python calls it, such as ``"keep_largest"``.
    value : object, optional
        True, a number, a text, or capital letters that stand for one: ``"N"``.
    """
    return _speaker(parameter, value)


@contextmanager
def spoken_by(speaker: Speaker) -> Iterator[None]:
    """Let `speaker` name parameters within a block; messages of other threads are worded alike meanwhile."""
    global _speaker
    before, _speaker = _speaker, speaker
    try:
        yield
    finally:
        _speaker = before
