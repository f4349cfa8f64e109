"""Command lines: those of documents, parsed as clrecon does, and wrong ones, which are refused."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from printed_text import Printer

if TYPE_CHECKING:
    from clrecon.cli.common import Parser


def parser_of(command: str) -> Parser:
    """The parser of a command, as clrecon makes it."""
    from clrecon.cli.common import Parser, add_common
    from clrecon.cli.main import COMMANDS

    parser = Parser(prog=command)
    import_module(COMMANDS[command].module).add_arguments(parser)
    add_common(parser)
    return parser


def parse_command(arguments: list[str]) -> None:
    """Parse `arguments` as clrecon would."""
    from clrecon.cli.main import COMMANDS
    from clrecon.errors import UsageError

    if arguments == ["--help"]:
        return
    if arguments[0] not in COMMANDS:
        raise UsageError(f"no command {arguments[0]}")
    parser_of(arguments[0]).parse_args(arguments[1:])


def check_refused(arguments: list[str], code: int, fact: str | float, folder: Path, printed: Printer) -> None:
    """Run `arguments`, which end with `code` and one line with `fact`, and leave `folder` as it was."""
    from clrecon.cli.main import main

    before = sorted(folder.iterdir())
    assert main([*arguments, "-q"]) == code
    said = printed()
    assert said.error_lines == 1
    said.assert_error(fact)
    assert sorted(folder.iterdir()) == before
