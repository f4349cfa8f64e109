"""Command lines: those of documents, parsed as clrecon does, and wrong ones, which are refused."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

from printed_text import Printer


def parse_command(arguments: list[str]) -> None:
    """Parse `arguments` as clrecon would."""
    from clrecon.cli.common import Parser, add_common
    from clrecon.cli.main import COMMANDS
    from clrecon.errors import UsageError

    if arguments == ["--help"]:
        return
    if arguments[0] not in COMMANDS:
        raise UsageError(f"no command {arguments[0]}")
    parser = Parser(prog=arguments[0])
    import_module(COMMANDS[arguments[0]].module).add_arguments(parser)
    add_common(parser)
    parser.parse_args(arguments[1:])


def check_refused(arguments: list[str], code: int, fact: str | float, folder: Path, printed: Printer) -> None:
    """Run `arguments`, which end with `code` and one line with `fact`, and leave `folder` as it was."""
    from clrecon.cli.main import main

    before = sorted(folder.iterdir())
    assert main([*arguments, "-q"]) == code
    said = printed()
    assert said.error_lines == 1
    said.assert_error(fact)
    assert sorted(folder.iterdir()) == before
