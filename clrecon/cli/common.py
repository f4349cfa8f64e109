"""Shared parts of all commands: their parser, options that several have, formats of numbers, and exit codes."""

from __future__ import annotations

import argparse
import copy
import re
import sys
import textwrap
import traceback
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from typing import Any, NoReturn, cast

from clrecon.cli.console import STREAMED, Console, fit_help, printable
from clrecon.errors import ClreconError, OutputError, UsageError
from clrecon.jobs.options import DeviceSettings, InputSettings, ScanSettings
from clrecon.system.arguments import OptionSpeaker
from clrecon.system.options import Settings, option_beside, options_of, pick_fields, read_value
from clrecon.system.packages import missing_package
from clrecon.system.processes import has_hung_device
from clrecon.system.progress import DEFAULT_SECONDS, check_time_limit
from clrecon.system.text import format_bytes, guess_word

_INTERRUPTED = 130

_LONG_WORD = re.compile(r"[^\s/\\]{300,}")

_STREAM = re.compile(r"-\.[A-Za-z0-9.]+")
"""``-.ply`` behind ``-o``: standard output, and the format."""

_NEGATIVE_LIST = re.compile(r"-[0-9.]+(?:[eE][+-]?[0-9]+)?[,:]")


def speaker_of(parser: argparse.ArgumentParser) -> OptionSpeaker:
    return OptionSpeaker({action.dest: action.option_strings[0] for action in parser._actions if action.option_strings})


EXIT_CODES = """\
exit codes: 0 done; 1 unexpected error; 2 no usable DICOM or no surface; 3 wrong usage;
            4 corrupt or refused input, or "info --strict" found a failed gate; 5 no device or
            device failure; 6 output cannot be written; 7 and 8 all is written, but with "mesh
            --strict" a gate failed, of the scan (7) or of a mesh (8); 8 also partly done;
            9 another computer cannot be reached; 130 interrupted"""


_MEANT = {"--spacing": "--resample", "--threshold": "--hu", "--iso": "--hu"}
"""Options of other programs, or of other commands, and that which does the same where it exists."""


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Texts of options that are broken between words, never within one, and not at its hyphens either."""

    def _split_lines(self, text: str, width: int) -> list[str]:
        return textwrap.wrap(" ".join(text.split()), width, break_long_words=False, break_on_hyphens=False)


class Parser(argparse.ArgumentParser):
    """An argparse parser whose errors are `UsageError`: one line, exit code 3.

    Options declared with ``first=True`` are those that most people need: ``-h`` shows these alone.  With ``words`` a
    shell completes the value.
    """

    def __init__(self, **options: object):
        options.setdefault("formatter_class", _Formatter)
        super().__init__(allow_abbrev=False, **options)  # type: ignore[arg-type]
        self.register("action", "yes-no", argparse.BooleanOptionalAction)
        for kind in (None, "store_true", "store_false", "append", "yes-no"):
            self.register("action", kind, _make_markable(self._registry_get("action", kind, kind)))

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse as argparse does, but also accept lists that begin with a minus, as in ``--seed -12,3,40``."""
        given = _join_negative_lists(sys.argv[1:] if args is None else args)
        if self._subparsers is None:  # before argparse complains that something required is missing
            self._refuse_unknown([word.partition("=")[0] for word in _options_in(given)])
        options, unknown = super().parse_known_args(given, namespace)
        if unknown:  # reported here, so that the hint names the command
            self._refuse_unknown([word for word in unknown if word.startswith("--")])
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown

    def _refuse_unknown(self, words: Sequence[str]) -> None:
        """Raise `UsageError` for the first word that is no option of this parser, with the one that is most like it."""
        for word in words:
            if word not in self._option_string_actions:
                meant = _MEANT.get(word, word)
                self.error(f"unrecognized arguments: {word}{guess_word(meant, self._option_string_actions)}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse a command that there is not, with the one that is most like it."""
        if isinstance(action, argparse._SubParsersAction) and value not in action.choices:
            raise UsageError(
                f"no command {value!r:.60}{guess_word(value, action.choices)}: use one of {', '.join(action.choices)}"
                f" (see: {self.prog} --help)"
            )
        super()._check_value(action, value)

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:  # type: ignore[override]
        """Read ``--option=--`` as the value ``--``, as Python 3.13 does; before, argparse dropped it."""
        if action.option_strings and arg_strings == ["--"]:
            value = self._get_value(action, "--")
            self._check_value(action, value)
            return value
        return super()._get_values(action, arg_strings)

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:  # type: ignore[override]
        try:
            return read_value(cast("Callable[[str], Any] | None", action.type), arg_string, action.metavar)
        except UsageError:
            raise
        except ValueError as error:
            raise argparse.ArgumentError(action, str(error)) from None

    def format_help(self) -> str:
        """Return the help text; where all options do not fit one screen, those that most people need."""
        full = self.format_full_help()
        if full.count("\n") <= SCREEN_LINES or self._subparsers is not None:
            return full
        firsts = [action for action in self._actions if not action.option_strings or getattr(action, "is_first", False)]
        formatter = self._get_formatter()
        needed = [_name_value(action, formatter) for action in firsts if action.required or not action.option_strings]
        formatter.add_usage(" ".join((self.prog, *needed, "[options]")), [], [])
        formatter.add_text(self.description)
        formatter.start_section("the options that most people need")
        formatter.add_arguments([_with_short_help(action) for action in firsts])
        formatter.end_section()
        formatter.add_text("\n".join(_find_examples(self.epilog or "")))
        count = sum(bool(action.option_strings) for action in self._actions)
        called = self.prog.removeprefix("clrecon ")
        formatter.add_text(f"all {count} options, by group: clrecon help {called}, or clrecon {called} --help-all")
        return fit_help(formatter.format_help(), sys.stdout)

    def format_full_help(self) -> str:
        """Return the help text with all options, by group, and no line longer than the terminal."""
        return fit_help(super().format_help(), sys.stdout)

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see: {self.prog} --help)")


def _make_markable(kind: Any) -> Callable[..., argparse.Action]:
    """Return the maker of a kind of action that takes `first` too: an option that most people need, and its `words`."""

    def make_action(*given: Any, first: bool = False, words: Iterable[str] = (), **how: Any) -> argparse.Action:
        action: Any = kind(*given, **how)
        action.is_first, action.words = first, words
        return cast("argparse.Action", action)

    return make_action


def _name_value(action: argparse.Action, formatter: argparse.HelpFormatter) -> str:
    """Return an argument as it stands in the usage: ``INPUT``, ``-o OUT``."""
    return " ".join((*action.option_strings[:1], formatter._format_args(action, action.dest.upper())))


def _with_short_help(action: argparse.Action) -> argparse.Action:
    """Return a copy of an option with the first clause of its help, without what stands in brackets at length."""
    short = copy.copy(action)
    short.help = re.sub(r" \([^()]{26,}\)", "", action.help or "").partition(";")[0]
    return short


SCREEN_LINES = 40
"""Lines that the help of ``-h`` has at most."""

_EXAMPLES_SHOWN = 3


def _find_examples(epilog: str) -> list[str]:
    """Return the heading of the examples in an epilog and the first of them; nothing where it has none."""
    lines = epilog.split("\n")
    start = next((place for place, line in enumerate(lines) if line in ("example:", "examples:")), len(lines))
    return lines[start : start + 1 + _EXAMPLES_SHOWN]


class _FullHelp(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *values: object) -> NoReturn:  # type: ignore[override]
        assert isinstance(parser, Parser)
        parser._print_message(parser.format_full_help(), sys.stdout)
        parser.exit()


def _options_in(arguments: Sequence[str]) -> list[str]:
    """Return the words that argparse takes for long options: they begin with two dashes and have no blank."""
    ended = list(arguments).index("--") if "--" in arguments else len(arguments)
    return [word for word in arguments[:ended] if word.startswith("--") and " " not in word]


def _join_negative_lists(arguments: Sequence[str]) -> list[str]:
    """Write ``--option -1,2`` as ``--option=-1,2``: argparse takes what begins with a minus for an option."""
    joined: list[str] = []
    for position, argument in enumerate(arguments):
        if argument == "--":
            return [*joined, *arguments[position:]]
        previous = joined[-1] if joined else ""
        if previous.startswith("--") and "=" not in previous and _NEGATIVE_LIST.match(argument):
            joined[-1] = f"{previous}={argument}"
        elif previous in ("-o", "--output") and _STREAM.fullmatch(argument):
            joined[-1] = f"--output={argument}"
        else:
            joined.append(argument)
    return joined


def add_common(parser: argparse.ArgumentParser) -> None:
    parser._option_string_actions["--help"].help = "show the options that most people need, on one screen, and exit"
    parser.add_argument("--help-all", action=_FullHelp, nargs=0, help="show all options, by group, and exit")
    streams = [option for option in ("-o", "--report") if option in parser._option_string_actions]
    if "-o" in streams and parser.prog.split()[-1] not in STREAMED:
        streams.remove("-o")
    names = " and ".join(f"{option} -" for option in streams)
    writes = f"{names} write{'s' * (len(streams) == 1)} to standard output"
    group = parser.add_argument_group("output", writes if streams else None)
    group.add_argument("--json", action="store_true", help="print one JSON object on stdout and nothing else")
    loudness = group.add_mutually_exclusive_group()
    loudness.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    loudness.add_argument("-v", "--verbose", action="store_true", help="print more, and each stage on stderr")
    group.add_argument("--debug", action="store_true", help="print the traceback of an error")


def pick(options: argparse.Namespace, settings: type) -> dict[str, Any]:
    """Pick the options that are fields of settings and that are given; those that may be given again make a tuple."""
    return pick_fields(settings, vars(options))


def make_settings(settings: type[Settings], options: argparse.Namespace, **more: Any) -> Settings:
    """Make settings from the options that are their fields, and more fields, which win."""
    return settings(**pick(options, settings) | more)


def run_options(options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Return what every job is told beside its settings; see `clrecon.jobs.run.Run`."""
    return {"no_clobber": options.no_clobber, "progress": console.progress}


def add_fields(
    container: argparse._ActionsContainer, settings: type, *groups: str, without: Container[str] = ()
) -> None:
    """Add the options of groups that are fields of settings; without a group those that have none."""
    for group in groups or ("",):
        for option in options_of(settings, group):
            if option.name not in without:
                container.add_argument(*option.flags, dest=option.name, **option.how)


def add_option(container: argparse._ActionsContainer, name: str, declared: Any) -> None:
    """Add an option that no settings hold; see `clrecon.system.options.option`."""
    option = option_beside(name, declared)
    container.add_argument(*option.flags, dest=option.name, **option.how)


def add_output(parser: argparse._ActionsContainer, text: str, metavar: str = "OUT", *, required: bool = True) -> None:
    parser.add_argument("-o", "--output", metavar=metavar, required=required, help=text, first=True)


def add_picture(container: argparse._ActionsContainer, text: str, metavar: str = "FILE") -> None:
    container.add_argument("--picture", metavar=metavar, help=text, first=True)


def add_report(container: argparse._ActionsContainer, content: str, *, first: bool = True) -> None:
    container.add_argument("--report", metavar="FILE", help=f"write {content} as JSON", first=first)


def add_store(container: argparse._ActionsContainer, result: str, form: str) -> None:
    """Add --store, which puts the `result` into an archive in a `form` of DICOM."""
    container.add_argument(
        "--store",
        metavar="URL",
        help=f"also store the {result} in the DICOMweb archive dicomweb+https://HOST/PATH, as {form} with the name, ID"
        " and birth date of the patient",
    )


def describe_stored(report: Any) -> list[str]:
    """Say what an archive has got; nothing where it was not asked."""
    stored = report.get("stored")
    return [] if stored is None else [f"stored   {format_bytes(stored['bytes'])}, with the name of the patient"]


def add_no_clobber(container: argparse._ActionsContainer, *, with_ids: bool = True) -> None:
    """Add --no-clobber, and --keep-ids where something of a scan is written."""
    container.add_argument(
        "--no-clobber",
        action="store_true",
        help="replace nothing: stop before any work if a file or folder to be written exists already",
    )
    if with_ids:
        add_fields(container, ScanSettings, "ids")


def add_device(container: argparse._ActionsContainer, *, computes: bool = True, memory: bool = True) -> None:
    """Add --device, --timeout where the command computes on it, and --memory where that is limited."""
    add_fields(container, DeviceSettings, "device")
    if computes:
        container.add_argument(
            "--timeout",
            type=_parse_seconds,
            metavar="SECONDS",
            help="stop with exit code 5 if the device finishes nothing for this long, as when a kernel hangs"
            f" (default: {DEFAULT_SECONDS:g}; 0 disables the timeout)",
        )
    if memory:
        add_fields(container, DeviceSettings, "memory")


def _parse_seconds(text: str) -> float:
    try:
        check_time_limit(float(text))
    except ValueError as error:
        raise ValueError(f"{text!r} is no number of seconds from 0 on") from error
    return float(text)


GRID_FILE = (
    "a NIfTI, NRRD or MetaImage file or OME-Zarr folder; or a zip or tar file or URL of them (dicomweb+https://, s3://,"
    " https://)"
)
SCAN_FOLDER = "DICOM folder (subfolders and any file names are fine) or file"
SCAN = f"DICOM folder or file, or {GRID_FILE}"


def add_input(parser: argparse.ArgumentParser, text: str = SCAN, nargs: str | None = None) -> None:
    parser.add_argument("input", metavar="INPUT", nargs=nargs, help=text)


def add_reading(parser: argparse.ArgumentParser) -> None:
    add_fields(parser.add_argument_group("reading"), InputSettings, "reading")


_CROP = """\
Whole voxels outside the box are left out, after --remove-table and --fov and before --region.
Surfaces end there as at the ends of a scan. Several boxes are intersected."""


def add_masking(parser: argparse.ArgumentParser, *, crop: bool = False) -> None:
    """Add the options that turn parts of the scan into air or work on its voxels, and those that cut it."""
    add_fields(parser.add_argument_group("masking"), InputSettings, "masking")
    if crop:
        add_cropping(parser, "of the frame of --space")


def add_cropping(parser: argparse.ArgumentParser, frame: str) -> None:
    """Add the options that cut a scan; `frame` is that of their numbers, for the help."""
    add_fields(parser.add_argument_group(f"crop, in mm {frame}", _CROP), InputSettings, "crop")


def describe_fit(cortex: dict[str, Any]) -> str:
    share = 100.0 * cortex["fitted"] / cortex["vertices"]
    return f"{share:.0f} % of it, error {cortex['error_mm']['p50']:.2f} mm"


def show_report(
    report: dict[str, Any], lines: Iterable[str], options: argparse.Namespace, console: Console, of: str = ""
) -> None:
    """Print a report: as JSON or its lines for people, and its warnings, or those of its part `of`."""
    console.result(report)
    for line in lines:
        console.say(line)
    if getattr(options, "report", None):
        console.say(f"report   {printable(options.report)}")
    for warning in (report[of] if of else report)["warnings"]:
        console.warn(warning)


def guard(action: Callable[[], int], console: Console, debug: bool) -> int:
    """Run `action` and turn any error into an exit code and at most one line on stderr."""
    try:
        code = action()
    except (Exception, KeyboardInterrupt) as error:
        code = _report_error(error, console, debug)
        if has_hung_device():
            _unfreed.append(error)
    try:
        console.finish()
    except OutputError as error:
        if code == 0:
            console.error(str(error))
            return error.exit_code
    return code


_unfreed: list[BaseException] = []
"""Errors of a device that hangs: their frames hold buffers, and a driver may wait for the kernel to free one."""


def _report_error(error: BaseException, console: Console, debug: bool) -> int:
    if debug:
        console.clear()
        traceback.print_exception(type(error), error, error.__traceback__, file=sys.stderr)
    if isinstance(error, KeyboardInterrupt):
        console.error("interrupted")
        return _INTERRUPTED
    if isinstance(error, ClreconError):
        known = error
    elif isinstance(error, MemoryError):
        known = ClreconError("out of memory: free some, or use a smaller series")
    elif isinstance(error, ModuleNotFoundError) and error.name and not error.name.startswith("clrecon"):
        known = missing_package(error.name, "this")
    else:
        hint = "" if debug else "; run again with --debug for details, and please report it"
        known = ClreconError(f"unexpected error ({type(error).__name__}: {str(error)[:300]}){hint}")
    known = type(known)(_shorten(str(known)))
    console.error(str(known))
    try:
        from clrecon.jobs.run import error_as_dict

        console.fail(error_as_dict(known))
    except OutputError:
        pass  # only the first error is reported
    return known.exit_code


def _shorten(message: str) -> str:
    """Shorten words that are longer than any name of a file: a number of a thousand digits would bury the message."""
    return _LONG_WORD.sub(lambda word: f"{word[0][:40]}... ({len(word[0]):,} characters)", message)


def table(rows: Sequence[Sequence[object]], right: Sequence[int] = ()) -> list[str]:
    """Lay out rows of cells in columns; `right` has the numbers of the columns that are aligned to the right."""
    cells = [[str(cell) for cell in row] for row in rows]
    widths = [max(len(cell) for cell in column) for column in zip(*cells, strict=True)]
    return [
        "  ".join(
            cell.rjust(width) if n in right else cell.ljust(width)
            for n, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in cells
    ]


def describe_space(path: str, space: str) -> str:
    """Say in what unit and frame the coordinates of a file are: ``LPS mm``; glTF prescribes metres, Y up."""
    return "metres, Y up" if path.lower().endswith(".glb") else f"{space.upper()} mm"


def describe_known(*, normals: bool, hu: bool, labels: bool) -> str:
    """Name what is known of points: `` with normals, HU``; empty if nothing is."""
    known = [word for word, is_known in (("normals", normals), ("HU", hu), ("labels", labels)) if is_known]
    return f" with {', '.join(known)}" if known else ""


def describe_frame(entry: dict[str, Any]) -> str:
    """Say in which frame the coordinates of a mesh that was read are, and where that is known from."""
    source = {"file": "named by the file", "argument": "as you say", "assumed": "assumed"}[entry["space_from"]]
    return f"{entry['space']}, {source}{', turned to LPS' if entry['space'] != 'LPS' else ''}"


def name_device(device: dict[str, Any]) -> str:
    return printable(f"{device['name']} ({device['platform']}, driver {device['driver']})")


def describe_times(seconds: Mapping[str, float], parts: Iterable[str] = ()) -> str:
    """Describe the seconds of a job for people, those of the parts that can be felt in brackets."""
    shown = [part for part in parts or seconds if part != "total" and seconds.get(part, 0.0) >= 0.005]
    return f"{seconds['total']:.2f} s ({', '.join(f'{part} {seconds[part]:.2f}' for part in shown)})"
