"""Command lines of documents, parsed as clrecon does."""

from __future__ import annotations

from importlib import import_module

__all__ = ["parse_command"]


def parse_command(arguments: list[str]) -> None:
    """Parse `arguments` as clrecon would.

    Raises
    ------
    UsageError
        They are not understood.
    """
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
