"""What goes to which stream, and how a command ends."""

from __future__ import annotations

import io
import json
import os
import sys

import pytest
from printed_text import Printer

from clrecon.cli.common import guard, table
from clrecon.cli.console import Console, printable
from clrecon.errors import DeviceError, NoDicomError
from clrecon.system.text import format_bytes


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class ClosedPipe(io.StringIO):
    def write(self, text: str) -> int:
        raise BrokenPipeError(32, "Broken pipe")

    def flush(self) -> None:
        raise BrokenPipeError(32, "Broken pipe")


class FullDisk(ClosedPipe):
    def write(self, text: str) -> int:
        raise OSError(28, "No space left on device")

    def flush(self) -> None:
        pass


def make_raising_action(error: BaseException):  # noqa: ANN201
    def action() -> int:
        raise error

    return action


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("LUNG 1.0", "LUNG 1.0"),
        ("a\x1b[31mb", "a\\x1b[31mb"),
        ("two\nlines", "two lines"),
        ("gpj.\u202eexe", "gpj.\\u202eexe"),
        ("Größe 3", "Größe 3"),
        ("nul\0", "nul\\x00"),
        ("\udcc3\udca4.ply", "\\xc3\\xa4.ply"),  # ä where the locale is C
    ],
)
def test_control_characters_of_a_text_are_printed_as_codes(text: str, shown: str) -> None:
    assert printable(text) == shown


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (DeviceError("no driver"), 5, "clrecon: error: no driver"),
        (NoDicomError("x\ny"), 2, "clrecon: error: x y"),
        (KeyboardInterrupt(), 130, "clrecon: error: interrupted"),
        (MemoryError(), 1, "clrecon: error: out of memory: free some, or use a smaller series"),
        (
            KeyError("thing"),
            1,
            "clrecon: error: unexpected error (KeyError: 'thing'); run again with --debug for details,"
            " and please report it",
        ),
    ],
)
def test_error_is_one_line_on_standard_error_and_its_exit_code(
    error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert guard(make_raising_action(error), Console(), debug=False) == code
    captured = capsys.readouterr()
    assert captured.err.splitlines() == [line]
    assert captured.out == ""


def test_error_with_debug_has_its_traceback_and_the_same_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    assert guard(make_raising_action(DeviceError("no driver")), Console(), debug=True) == 5
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "Traceback (most recent call last):"
    assert lines[-1] == "clrecon: error: no driver"


def test_error_with_json_is_an_object_on_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    assert guard(make_raising_action(DeviceError("no driver")), Console(as_json=True), debug=False) == 5
    captured = capsys.readouterr()
    error = json.loads(captured.out)["error"]
    assert error == {"kind": "DeviceError", "exit_code": 5, "message": "no driver"}
    assert captured.err == "clrecon: error: no driver\n"


def test_error_after_a_result_leaves_it_the_only_object_on_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console(as_json=True)

    def action() -> int:
        console.say("for people")
        console.warn("in the object already")
        console.result({"nan": float("nan"), "one": 1})
        raise DeviceError("late")

    assert guard(action, console, debug=False) == 5
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {"nan": None, "one": 1}
    assert captured.err == "clrecon: error: late\n"


def test_pipe_that_its_reader_closed_is_no_error(monkeypatch: pytest.MonkeyPatch, printed: Printer) -> None:
    monkeypatch.setattr(sys, "stdout", ClosedPipe())
    console = Console()

    def action() -> int:
        console.say("one")
        console.say("two")
        return 0

    assert guard(action, console, debug=False) == 0
    assert printed().error_lines == 0


def test_full_disk_behind_standard_output_ends_with_6(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdout", FullDisk())
    console = Console(as_json=True)

    def action() -> int:
        console.result({})
        return 0

    assert guard(action, console, debug=False) == 6
    assert capsys.readouterr().err == "clrecon: error: cannot write to standard output: No space left on device\n"


def test_missing_standard_output_ends_with_6_only_where_something_is_printed_and_nothing_else_failed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    console = Console()
    assert guard(lambda: 0, console, debug=False) == 0
    assert guard(lambda: console.say("nobody hears") or 0, console, debug=False) == 6
    assert guard(lambda: console.say("nobody hears") or 8, console, debug=False) == 8


def test_progress_is_silent_without_a_terminal(printed: Printer) -> None:
    console = Console()
    console.progress("read", done=3, total=10)
    console.finish()
    assert printed().is_silent


def test_progress_moves_on_a_terminal_and_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    console = Console()
    console.progress("read", done=5, total=10)
    assert "reading slices [############............] 5/10" in terminal.getvalue()
    console.progress("build", done=0, total=0)
    assert "building kernels (takes seconds on the first run" in terminal.getvalue()
    console.finish()
    assert terminal.getvalue().endswith(" \r")
    assert "\n" not in terminal.getvalue()


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (60, "clrecon: looking through the files [####............] 25/95"),  # the bar is shorter
        (48, "clrecon: looking through the files 25/95"),  # there is no room for one
        (36, "clrecon: looking through the 25/95"),  # what is done stays in sight
    ],
)
def test_progress_on_a_narrow_terminal_keeps_its_count(
    monkeypatch: pytest.MonkeyPatch, columns: int, expected: str
) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(os, "get_terminal_size", lambda _: os.terminal_size((columns, 24)))
    Console().progress("scan", done=25, total=95)
    assert terminal.getvalue().strip() == expected and len(expected) < columns


def test_quiet_console_shows_no_progress_and_no_warnings_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    console = Console()
    console.set_loudness(quiet=True, verbose=False)
    console.progress("read", done=5, total=10)
    console.warn("hidden")
    assert terminal.getvalue() == ""


def test_verbose_console_prints_a_line_for_each_stage(capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    console.set_loudness(quiet=False, verbose=True)
    for done in range(4):
        console.progress("read", done=done, total=3)
    console.progress("write")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split("  ")[-1] for line in lines] == ["reading slices", "writing"]


def test_columns_of_a_table_are_aligned_left_or_right() -> None:
    assert table([("n", "name"), (12, "b"), (3, "long")], right=(0,)) == [" n  name", "12  b", " 3  long"]


@pytest.mark.parametrize(
    ("size", "shown"), [(12, "12 bytes"), (2500, "2.5 kB"), (7_340_000, "7.3 MB"), (4 * 10**9, "4.0 GB")]
)
def test_sizes_are_shown_in_bytes_kb_mb_and_gb(size: int, shown: str) -> None:
    assert format_bytes(size) == shown
