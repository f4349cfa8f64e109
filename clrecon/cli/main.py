"""Entry point of ``clrecon``: it imports only the module of the command that was called."""

from __future__ import annotations

import contextlib
import gc
import signal
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from types import FrameType
from typing import NamedTuple

from clrecon.cli import common
from clrecon.cli.common import EXIT_CODES, Parser, guard, speaker_of
from clrecon.cli.console import Console, filled_streams
from clrecon.errors import UsageError
from clrecon.system.arguments import in_python, spoken_by
from clrecon.system.foreign_words import own_streams
from clrecon.system.packages import hide_unused
from clrecon.system.processes import end_process
from clrecon.system.progress import DEFAULT_SECONDS, time_limit
from clrecon.version import package_version


class _Command(NamedTuple):
    module: str
    help: str


COMMANDS = {
    "mesh": _Command("clrecon.cli.mesh", "make a mesh from a CT series"),
    "cloud": _Command("clrecon.cli.cloud", "make a cloud of points from a CT series, or clean one"),
    "inside": _Command("clrecon.cli.inside", "measure dense and trabecular bone and canal of vertebrae, as meshes"),
    "render": _Command("clrecon.cli.render", "make pictures and animations of a CT series"),
    "view": _Command("clrecon.cli.view", "view a CT series or meshes in the browser: turn, clip, measure"),
    "export": _Command("clrecon.cli.export", "write the volume of a CT series as NIfTI, NRRD or MetaImage"),
    "vertebrae": _Command("clrecon.cli.vertebrae", "make a first guess of a label map of the vertebrae"),
    "corridor": _Command("clrecon.cli.corridor", "find the widest straight line through each pedicle of a vertebra"),
    "stats": _Command("clrecon.cli.stats", "measure volume and HU of each label of a label map"),
    "distance": _Command("clrecon.cli.distance", "measure the distance between two meshes, in mm and as colours"),
    "batch": _Command("clrecon.cli.batch", "make the meshes of many scans, with a table and a page"),
    "info": _Command("clrecon.cli.info", "show which series a folder holds and whether they can be used"),
    "devices": _Command("clrecon.cli.devices", "show the OpenCL devices and which one would be used"),
    "phantom": _Command("clrecon.cli.phantom", "write a synthetic CT series with a known surface"),
    "selftest": _Command("clrecon.cli.selftest", "check that a device computes correctly"),
    "bench": _Command("clrecon.cli.bench", "time every stage on this computer, beside VTK's flying edges"),
    "compare": _Command("clrecon.cli.compare", "compare methods of surfaces and clouds on your own scan"),
    "demo": _Command("clrecon.cli.demo", "make a phantom, its mesh, a picture and a report, in seconds"),
    "completion": _Command("clrecon.cli.completion", "print a script for completion in the shell"),
}

HELP = "help"

_COLLECTED_AFTER = 50_000
"""Objects after which unused ones are looked for, 700 by default: imports make many and leave none unused, and looking
takes 5 % of the processor time of a mesh."""

_DESCRIPTION = "Surfaces in patient millimetres from CT series, computed on any OpenCL device."

_EPILOG = f"""\
example:    clrecon mesh CT_FOLDER -o bone.stl
            clrecon help mesh

{EXIT_CODES}"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command with these arguments, by default those of the process; return the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # a folder with an umlaut is no error
    flags = arguments[: arguments.index("--")] if "--" in arguments else arguments
    console = Console(as_json="--json" in flags)
    debug = "--debug" in flags
    with own_streams(show=debug):
        return guard(partial(_dispatch, arguments, console), console, debug)


def run() -> None:
    """Run `main` and end the process with its exit code: the console script."""
    signal.signal(signal.SIGTERM, _interrupt)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:  # not under nohup
        signal.signal(signal.SIGHUP, _interrupt)
    hide_unused()
    gc.set_threshold(_COLLECTED_AFTER)
    code = main()
    for stream in (sys.stdout, sys.stderr):
        # The stream is None (never opened) or its reader closed it; `main` has already printed everything.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
    end_process(code)


def _dispatch(arguments: list[str], console: Console) -> int:
    arguments = _as_help_option(arguments)
    parser = Parser(prog="clrecon", description=_DESCRIPTION, epilog=_EPILOG)
    parser.add_argument("-V", "--version", action="store_true", help="print the version and stop")
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
    commands.add_parser(HELP, help="show all options of a command: clrecon help COMMAND")
    speaker = in_python if module is None or called is None else speaker_of(commands.choices[called])
    try:
        with spoken_by(speaker):
            options = parser.parse_args(arguments)
    except SystemExit as stop:  # --help
        return int(stop.code or 0)
    if options.version:
        console.result({"version": package_version()})
        console.say(f"clrecon {package_version()}")
        return 0
    if module is None or called is None:
        raise UsageError(f"no command given: use one of {', '.join(COMMANDS)} (see: clrecon --help)")
    console.set_loudness(quiet=options.quiet, verbose=options.verbose)
    limit = getattr(options, "timeout", None)
    with (
        spoken_by(speaker),
        time_limit(DEFAULT_SECONDS if limit is None else limit),
        filled_streams(called, options, console),
    ):
        return int(module.run(options, console))


def _as_help_option(arguments: list[str]) -> list[str]:
    """Write ``help COMMAND`` as ``COMMAND --help-all``, and ``help`` alone as ``--help``."""
    if arguments[:1] != [HELP]:
        return arguments
    words = [word for word in arguments[1:] if word != HELP]
    return [*words, "--help-all" if any(word in COMMANDS for word in words) else "--help"]


def _interrupt(number: int, frame: FrameType | None) -> None:
    """End a command on SIGTERM and SIGHUP (a closed terminal) like on Ctrl-C, so that temporary files are removed."""
    raise KeyboardInterrupt


if __name__ == "__main__":
    run()
