"""What a command has printed, without its sentences: a report, how many lines, the numbers and names in them."""

from __future__ import annotations

import json
from typing import Any

import pytest
from refusals import assert_facts


class Printed:
    """What came since the last look at both streams; the words of a text are pinned in the test nearest to it."""

    def __init__(self, output: str, error: str) -> None:
        self._output, self._error = output, error
        self.output_lines, self.error_lines = (len(text.splitlines()) for text in (output, error))
        self.is_silent = not output and not error

    def __repr__(self) -> str:
        return f"output: {self._output}\nerror: {self._error}"

    @property
    def everything(self) -> str:
        """What came on both streams, to be searched for what must not be there."""
        return self._output + self._error

    def report(self) -> Any:
        """Return the JSON on standard output."""
        return json.loads(self._output)

    def assert_output(self, *facts: str | float) -> None:
        """Assert that standard output has the numbers and names `facts`."""
        assert_facts(self._output, *facts)

    def assert_error(self, *facts: str | float) -> None:
        """Assert that standard error has the numbers and names `facts`."""
        assert_facts(self._error, *facts)


class Printer:
    """The fixture `printed`: a call takes what was printed since the last one."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self) -> Printed:
        return Printed(*self._capsys.readouterr())
