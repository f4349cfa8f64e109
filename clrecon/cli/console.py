"""The output of a command: results on stdout, everything else on stderr, in lines that fit the terminal."""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

from clrecon.errors import OutputError, UsageError
from clrecon.system.text import escape_character

_LABEL = re.compile(r"\s*\S+(?: \S+){0,2}\s{2,}|exit codes: |\s*")
_COMMAND = re.compile(r"\s*clrecon \S")

FULL = 90
"""A line of a help text that has no room for the next word within this length was broken for want of room."""


def is_terminal(stream: Any) -> bool:
    """True if `stream` is a terminal that can show moving lines and styles."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") != "dumb"


def fit(text: str, stream: Any) -> str:
    """Break the lines of a text for a terminal; for files and pipes it stays as it is, a line a fact."""
    width = max(shutil.get_terminal_size().columns, 20)
    return "\n".join(chain(*(_fit_line(line, width) for line in text.split("\n")))) if is_terminal(stream) else text


def fit_help(text: str, stream: Any) -> str:
    """Break the lines of a help text for a terminal, or for the width that COLUMNS says; its examples can be pasted."""
    if not (is_terminal(stream) or os.environ.get("COLUMNS")):
        return text
    width = shutil.get_terminal_size().columns
    return "\n".join(_fit_paragraph(lines, max(width, 20)) for lines in _find_paragraphs(text.split("\n")))


def _find_paragraphs(lines: list[str]) -> list[list[str]]:
    """Put lines together that are one text: broken because they were full, with the rest under the beginning."""
    paragraphs: list[list[str]] = []
    for line in lines:
        if paragraphs and line.strip() and not _COMMAND.match(line) and _hang_of(line) <= _indent_of(line):
            last = paragraphs[-1][-1]
            indent, hang = _indent_of(line), _hang_of(paragraphs[-1][0])
            was_full = len(last) + 1 + len(line.split()[0]) > FULL
            if indent == hang > _indent_of(paragraphs[-1][0]) or was_full and indent in (_indent_of(last), hang):
                paragraphs[-1].append(line)
                continue
        paragraphs.append([line])
    return paragraphs


def _fit_paragraph(lines: list[str], width: int) -> str:
    if _COMMAND.match(lines[0]) or max(map(len, lines)) <= width:
        return "\n".join(chain(*(_fit_line(line, width) for line in lines)))
    text = " ".join([lines[0].rstrip(), *(line.strip() for line in lines[1:])])
    hang = _hang_of(lines[0]) if _hang_of(lines[0]) <= width // 2 else _indent_of(lines[0])
    return "\n".join(_wrap(text, width, hang))


def _indent_of(line: str) -> int:
    return len(line) - len(line.lstrip())


def _hang_of(line: str) -> int:
    """Return where the text of a line begins, after its indentation or its label."""
    label = _LABEL.match(line)
    return len(label[0]) if label else 0


def _fit_line(line: str, width: int) -> list[str]:
    if len(line) <= width or "\x1b" in line:  # a table with styles has been laid out for the terminal
        return [line]
    hang = _hang_of(line)
    is_command = _COMMAND.match(line) is not None
    if is_command or hang > width // 2 or not line[:hang].strip():
        hang = _indent_of(line) + 2
    parts = _wrap(line, width - 2 * is_command, hang)
    return [f"{part} \\" for part in parts[:-1]] + parts[-1:] if is_command else parts


def _wrap(line: str, width: int, hang: int) -> list[str]:
    return textwrap.wrap(
        line, width, subsequent_indent=" " * hang, break_long_words=False, break_on_hyphens=False,
        replace_whitespace=False, expand_tabs=False,
    )  # fmt: skip


_STAGES = {
    "device": "choosing a device",
    "scan": "looking through the files",
    "fetch": "fetching files",
    "unpack": "unpacking files",
    "read": "reading slices",
    "build": "building kernels (takes seconds on the first run on this device), extracting the surface",
    "mask": "leaving out what is not the patient",
    "choose": "choosing the iso value",
    "solid": "filling what is enclosed",
    "inside": "looking into vertebrae",
    "curve": "looking for the spinal canal",
    "render": "rendering (takes seconds longer on the first run on this device)",
    "frames": "rendering frames",
    "slabs": "working slab by slab",
    "count": "counting triangles",
    "select": "selecting components",
    "smooth": "smoothing",
    "decimate": "removing triangles",
    "compare": "comparing with the surface before",
    "write": "writing",
    "measure": "measuring the mesh, and its distance from the scan",
    "crossings": "measuring the mesh, looking for crossing triangles",
    "canal": "looking for the spinal canal",
    "vertebrae": "looking for vertebrae",
    "measure labels": "measuring labels",
    "draw": "drawing the phantom",
    "blur": "blurring the phantom",
    "selftest": "testing",
    "bench": "timing",
    "compare methods": "running methods, one after another",
    "measure methods": "measuring what they made",
    "report": "drawing and writing the report",
}
_HIDDEN = {*range(0x202A, 0x202F), *range(0x2066, 0x206A), 0x200E, 0x200F, 0x061C}
_BAR_WIDTH, _LEAST_BAR = 24, 6
_REDRAW_SECONDS = 0.1


def printable(text: object) -> str:
    """Return `text` on one line, with control and direction characters as escapes: files can hold terminal codes."""
    return "".join(
        char if char.isprintable() and ord(char) not in _HIDDEN else escape_character(char)
        for char in " ".join(str(text).splitlines())
    )


class Console:
    """The output streams of one command: stdout has the result, or with `as_json` one JSON object; stderr all else."""

    def __init__(self, *, as_json: bool = False):
        self.as_json = as_json
        self.quiet, self.verbose = False, False
        self.has_result = False
        self._streams_result, self._said_on_stderr = False, False
        self._hidden_name, self._shown_name = "", ""
        self._held: list[str] = []
        self._stdout_closed, self._lacks_stdout = sys.stdout is None, False
        self._stage = ""
        self._drawn = 0
        self._last_draw = 0.0
        self._start = time.perf_counter()
        self._moving = is_terminal(sys.stderr)

    def set_loudness(self, quiet: bool, verbose: bool) -> None:
        """Set how much is printed.  `quiet`: errors only.  `verbose`: a plain line per stage, no moving line."""
        self.quiet, self.verbose = quiet, verbose
        self._moving = is_terminal(sys.stderr) and not quiet and not verbose

    def stream_result(self) -> None:
        """Print the JSON object on stdout, and what is said for people on stderr: ``--report -``."""
        self._streams_result = self._said_on_stderr = True

    def stream_file(self, path: str, name: str) -> None:
        """Leave stdout to a file, see `send`, and call the temporary `path` of it by a `name`: ``-o -``."""
        self._said_on_stderr = True
        self._hidden_name, self._shown_name = path, name

    def send(self, stream: BinaryIO) -> None:
        """Copy a file to stdout, then say that it is written; not to a reader that closed."""
        self._guard_stdout(lambda: shutil.copyfileobj(stream, sys.stdout.buffer, _PIECE))
        self.finish()
        for line in [] if self._stdout_closed else self._held:
            self._to_stderr(line)

    def say(self, text: str = "", *, whole: bool = False) -> None:
        """Print a line of the result for people; nothing with ``--json`` or ``-q``.  A `whole` one is not broken."""
        if self.as_json or self.quiet:
            return
        if self._held or (self._hidden_name and self._hidden_name in text):
            self._held.append(text)  # until stdout has taken the file
        elif self._said_on_stderr:
            self._to_stderr(text)
        else:
            self._to_stdout(text if whole else fit(text, sys.stdout))

    def result(self, value: dict[str, Any]) -> None:
        """Print the JSON object; nothing without ``--json`` or ``--report -``."""
        if (self.as_json or self._streams_result) and not self.has_result:
            from clrecon.jobs.run import to_json

            self.has_result = True
            self._to_stdout(to_json(value))

    def fail(self, value: dict[str, Any]) -> None:
        """Print the JSON object of an error; nothing without ``--json``: a report is there when all went well."""
        if self.as_json:
            self.result(value)

    def warn(self, text: str, *, with_json: bool = False) -> None:
        """Print a warning; with ``--json`` only if the JSON object has no place for it (`with_json`)."""
        if not self.quiet and (with_json or not self.as_json):
            self._to_stderr(f"clrecon: warning: {printable(text)}")

    def error(self, text: str) -> None:
        self._to_stderr(f"clrecon: error: {printable(text)}")

    def progress(self, stage: str, done: int = 0, total: int = 0) -> None:
        if self.verbose and stage != self._stage:
            elapsed = time.perf_counter() - self._start
            self._to_stderr(f"clrecon: {elapsed:6.2f} s  {_STAGES.get(stage, stage)}")
        elif self._moving:
            now = time.perf_counter()
            if stage != self._stage or done == total or now - self._last_draw >= _REDRAW_SECONDS:
                self._last_draw = now
                self._draw(stage, done, total)
        self._stage = stage

    def clear(self) -> None:
        if self._drawn and sys.stderr is not None:
            _write_text(sys.stderr, "\r" + " " * self._drawn + "\r")
            self._drawn = 0

    def finish(self) -> None:
        """Remove the moving line and flush stdout, so that an error of stdout appears here, not at the end."""
        self.clear()
        if self._lacks_stdout:
            raise OutputError("cannot write to standard output: it is closed; add -q if the words are not needed")
        self._guard_stdout(lambda: sys.stdout.flush())

    def _draw(self, stage: str, done: int, total: int) -> None:
        line, room = f"clrecon: {_STAGES.get(stage, printable(stage))}", max(20, _columns() - 1)
        if total > 0:
            count = f" {done}/{total}"
            width = min(_BAR_WIDTH, room - len(line) - len(count) - 3)  # the count is worth more than a long bar
            if width >= _LEAST_BAR:
                filled = width * min(done, total) // total
                line += f" [{'#' * filled}{'.' * (width - filled)}]"
            line = line[: room - len(count)].rstrip() + count
        line = line[:room]
        if sys.stderr is not None:
            _write_text(sys.stderr, "\r" + line + " " * max(0, self._drawn - len(line)))
            self._drawn = len(line)

    def _to_stderr(self, line: str) -> None:
        self.clear()
        if self._hidden_name:
            for hidden in (self._hidden_name, os.path.splitext(self._hidden_name)[0]):  # one of several files too
                line = line.replace(hidden, self._shown_name)
        if sys.stderr is not None:
            _write_text(sys.stderr, fit(line, sys.stderr) + "\n")

    def _to_stdout(self, text: str) -> None:
        self.clear()
        self._guard_stdout(lambda: sys.stdout.write(text + "\n"))

    def _guard_stdout(self, action: Any) -> None:
        self._lacks_stdout = self._lacks_stdout or sys.stdout is None
        if self._stdout_closed:
            return
        try:
            action()
        except OSError as error:
            self._stdout_closed = True
            _discard_stdout()
            if not isinstance(error, BrokenPipeError):
                raise OutputError(f"cannot write to standard output: {error.strerror or error}") from error


def _write_text(stream: Any, text: str) -> None:
    with suppress(OSError):  # nobody reads the stream any more, and there is no other place for a message
        stream.write(text)
        stream.flush()


def _discard_stdout() -> None:
    """Point file descriptor 1 to the null device: Python flushes stdout once more when it ends."""
    null = os.open(os.devnull, os.O_WRONLY)
    with suppress(OSError, ValueError):
        os.dup2(null, sys.stdout.fileno())
    os.close(null)


def _columns() -> int:
    with suppress(OSError):
        return os.get_terminal_size(2).columns
    return 80


DASH = "-"

STREAMED = {
    "cloud": ".ply",
    "distance": ".ply",
    "export": ".nii.gz",
    "mesh": ".stl",
    "render": ".png",
    "vertebrae": ".nii.gz",
}
"""Commands whose ``-o`` is one file, with the format of ``-o -``; ``-o -.ply`` names another."""

_NAME = "standard output"
_FILES = {"output": "-o", "csv": "--csv"}
_PIECE = 1 << 20


@contextmanager
def filled_streams(command: str, options: argparse.Namespace, console: Console) -> Iterator[None]:
    """Let a command run in the block; files meant for ``-`` go to standard output, whole, once it is done."""
    wanted = {name: str(getattr(options, name, None) or "") for name in (*_FILES, "turntable")}
    wanted = {name: value for name, value in wanted.items() if value == DASH or value.startswith(f"{DASH}.")}
    if moving := wanted.get("turntable"):
        raise UsageError(f"--turntable {moving}: an animation needs a file or a folder: name one, such as bone.mp4")
    has_report = getattr(options, "report", None) == DASH
    takers = [_FILES[name] for name in wanted] + ["--report"] * has_report
    if not takers:
        yield
        return
    if len(takers) > 1 or (wanted and options.json):
        both = " and ".join([*takers, *(["--json"] * bool(wanted and options.json))])
        raise UsageError(f"{both} cannot share standard output: name a file for one of them")
    if sys.stdout is None:
        raise OutputError(f"{takers[0]} -: standard output is closed")
    if has_report:
        console.stream_result()
        options.report, options.json = None, True  # measured and made as with --json
        yield
        return
    with _streamed_file(command, options, console, *next(iter(wanted.items()))):
        yield


@contextmanager
def _streamed_file(
    command: str, options: argparse.Namespace, console: Console, option: str, value: str
) -> Iterator[None]:
    """Let a command write one of its files in a folder of its own, and copy it to standard output."""
    extension = ".csv" if option == "csv" else STREAMED.get(command)
    if extension is None:
        raise UsageError(f"{_FILES[option]} {value}: {command} writes several files, which one stream cannot hold")
    if option != "csv" and sys.stdout.isatty():
        raise UsageError(f"{_FILES[option]} {value}: standard output is a terminal: lead it into a file or a program")
    if several := _find_several(command, options):
        raise UsageError(f"{_FILES[option]} {value}: {several} make several files, and one stream holds one")
    options.streams_output = option == "output"
    folder = tempfile.mkdtemp(prefix="clrecon-")
    try:
        path = Path(folder) / f"stream{extension if value == DASH else value[1:]}"
        setattr(options, option, str(path))
        console.stream_file(str(path), _NAME)
        yield
        names = sorted(os.listdir(folder))
        if names != [path.name]:
            raise UsageError(f"{_FILES[option]} {value}: {len(names)} files were made, and one stream holds one")
        with open(path, "rb") as stream:
            console.send(stream)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _find_several(command: str, options: argparse.Namespace) -> str:
    """Name the options that make several files of ``-o``; empty where it is one."""
    if command == "render":
        return "several views" if sum(map(len, options.views or ())) > 1 else ""
    if command != "mesh" or options.one_file:
        return ""
    if options.split:
        return "the components of --split"
    levels = options.below or (options.iso_value or {}).get("iso_value")
    if isinstance(levels, tuple) and len(levels) > 1:
        return "several iso values"
    picked = options.path is not None and not any(str(seed).startswith("label:") for seed in options.grow_from or ())
    return "labels (name one with --label)" if picked and len(options.label or ()) != 1 else ""
