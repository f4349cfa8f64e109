"""Entry point of ``clrecon``: finds the command and imports only that."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from types import FrameType
from typing import NamedTuple

from clrecon.cli.common import EXIT_CODES, Parser, guard
from clrecon.cli.console import Console
from clrecon.cli.wording import speaker_of
from clrecon.errors import UsageError
from clrecon.system.wording import spoken_by

__all__ = ["main", "run"]


class _Command(NamedTuple):
    module: str
    help: str


COMMANDS = {
    "mesh": _Command("clrecon.cli.mesh", "make a mesh from a CT series: the main job"),
    "render": _Command("clrecon.cli.render", "make pictures of a CT series, still or moving"),
    "info": _Command("clrecon.cli.info", "show which series a folder holds and whether they can be used"),
    "devices": _Command("clrecon.cli.devices", "show the OpenCL devices and which one would be used"),
    "phantom": _Command("clrecon.cli.phantom", "write a made-up CT series with a known surface"),
    "selftest": _Command("clrecon.cli.selftest", "check that a device computes rightly"),
    "bench": _Command("clrecon.cli.bench", "time every stage on this computer, beside VTK's flying edges"),
    "demo": _Command("clrecon.cli.demo", "phantom, mesh, picture and report in one go: what clrecon does, in seconds"),
}

UNUSED_MODULES = ("requests", "PIL")
"""pydicom imports these where it finds them, to download test files and for colour profiles.  Reading needs neither,
and they cost as much time as reading a series; ``None`` in `sys.modules` is "not installed".  What makes pictures
takes Pillow out again when it starts: `clrecon.rendering.pictures.pillow`."""

DESCRIPTION = "Surfaces in patient millimetres from CT series, computed on any OpenCL device."

EPILOG = f"""\
example:    clrecon mesh CT_FOLDER -o bone.stl
            clrecon mesh --help

{EXIT_CODES}"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the name of the program; default: those of the process.

    Returns
    -------
    int
        The exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    _escape_unencodable()
    flags = arguments[: arguments.index("--")] if "--" in arguments else arguments
    console = Console(as_json="--json" in flags)
    debug = "--debug" in flags
    return guard(lambda: _dispatch(arguments, console), console, debug)


def run() -> None:
    """Console script: run `main`, end the process with its exit code."""
    signal.signal(signal.SIGTERM, _interrupt)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:  # nohup ignores it: so do we
        signal.signal(signal.SIGHUP, _interrupt)
    for name in UNUSED_MODULES:
        sys.modules.setdefault(name, None)  # type: ignore[arg-type]
    code = main()
    for stream in (sys.stdout, sys.stderr):
        # None where the process was started without it; closed by its reader; `main` has said what there is to say.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
    atexit._run_exitfuncs()
    # Every file is closed by now.  Freeing modules, drivers and voxels one by one takes the interpreter as long as
    # extracting the surface; the system does it at once.
    os._exit(code)


def _dispatch(arguments: list[str], console: Console) -> int:
    from clrecon.cli import common

    parser = Parser(prog="clrecon", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands", parser_class=Parser)
    called = next((argument for argument in arguments if not argument.startswith("-")), None)
    module = None
    for name, command in COMMANDS.items():
        subparser = commands.add_parser(name, help=command.help, description=command.help)
        if name == called:
            module = import_module(command.module)
            module.add_arguments(subparser)
            common.add_common(subparser)
            subparser.epilog = "\n\n".join(filter(None, (subparser.epilog, EXIT_CODES)))
    try:
        options = parser.parse_args(arguments)
    except SystemExit as stop:  # --help
        return int(stop.code or 0)
    if options.version:
        from clrecon.version import package_version

        console.result({"version": package_version()})
        console.say(f"clrecon {package_version()}")
        return 0
    if module is None or called is None:
        raise UsageError(f"no command given: use one of {', '.join(COMMANDS)} (see: clrecon --help)")
    console.set_loudness(quiet=options.quiet, verbose=options.verbose)
    with spoken_by(speaker_of(commands.choices[called])):
        return int(module.run(options, console))


def _escape_unencodable() -> None:
    """Show what a stream's encoding lacks as escapes: a folder with an umlaut is no reason to fail."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _interrupt(number: int, frame: FrameType | None) -> None:
    """SIGTERM and SIGHUP (a closed terminal) end a command like Ctrl-C, so that temporary files are removed."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    run()
