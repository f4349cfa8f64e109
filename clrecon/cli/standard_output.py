"""``-o -`` and ``--report -``: a file or the report on standard output; remarks then go to standard error."""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from clrecon.cli.console import Console
from clrecon.errors import OutputError, UsageError

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


def run_with_streams(command: str, run: Callable[[], int], options: argparse.Namespace, console: Console) -> int:
    """Run a command; what it should write to ``-`` goes to standard output once the command is done.

    A file is made as a whole first, checked as any other, and then copied: nothing of it appears if the command fails.
    """
    wanted = {name: str(getattr(options, name, None) or "") for name in _FILES}
    wanted = {name: value for name, value in wanted.items() if value == DASH or value.startswith(f"{DASH}.")}
    has_report = getattr(options, "report", None) == DASH
    takers = [_FILES[name] for name in wanted] + ["--report"] * has_report
    if not takers:
        return run()
    if len(takers) > 1 or (wanted and options.json):
        both = " and ".join([*takers, *(["--json"] * bool(wanted and options.json))])
        raise UsageError(f"{both} cannot share standard output: name a file for one of them")
    if sys.stdout is None:
        raise OutputError(f"{takers[0]} -: standard output is closed")
    if has_report:
        console.stream_result()
        options.report, options.json = None, True  # measured and made as with --json
        return run()
    return _stream_file(command, run, options, console, *next(iter(wanted.items())))


def _stream_file(
    command: str, run: Callable[[], int], options: argparse.Namespace, console: Console, option: str, value: str
) -> int:
    """Run a command with one of its files in a folder of its own, and copy it to standard output."""
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
        code = run()
        made = sorted(os.listdir(folder))
        if made != [path.name]:
            raise UsageError(f"{_FILES[option]} {value}: {len(made)} files were made, and one stream holds one")
        with open(path, "rb") as stream:
            while piece := stream.read(_PIECE):
                console.send(piece)
        return code
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _find_several(command: str, options: argparse.Namespace) -> str:
    """Name the options that make several files of ``-o``; empty where it is one."""
    if command == "render":
        return "several views" if sum(map(len, options.view)) > 1 else ""
    if command != "mesh" or options.one_file:
        return ""
    if options.split:
        return "the components of --split"
    levels = options.below or options.hu.get("iso_value", ())
    if isinstance(levels, tuple) and len(levels) > 1:
        return "several iso values"
    picked = options.labels is not None and not any(str(seed).startswith("label:") for seed in options.grow_from)
    return "labels (name one with --label)" if picked and len(options.label or ()) != 1 else ""
