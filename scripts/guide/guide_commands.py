"""The options of a command for its page of the Guide, from the parser that reads them."""

from __future__ import annotations

import argparse
from importlib import import_module

from clrecon.cli.common import Parser, add_common
from clrecon.cli.main import COMMANDS


def command_parser(command: str) -> Parser:
    """Return the parser of a command, with the options that all commands have."""
    parser = Parser(prog=f"clrecon {command}", description=COMMANDS[command].help)
    import_module(COMMANDS[command].module).add_arguments(parser)
    add_common(parser)
    return parser


def _name_of(action: argparse.Action, formatter: argparse.HelpFormatter) -> str:
    if not action.option_strings:
        return formatter._format_args(action, action.dest.upper())
    if action.nargs == 0:
        return ", ".join(action.option_strings)
    value = formatter._format_args(action, action.dest.upper())
    return f"{', '.join(action.option_strings)} {value}"


def describe_options(command: str) -> str:
    """Return the options of a command as Markdown: a list of definitions for each group.

    command: A key of `clrecon.cli.main.COMMANDS`.
    Returns Markdown from the heading on.
    """
    parser = command_parser(command)
    formatter = parser._get_formatter()
    parts = ["## Options\n", f"What `clrecon help {command}` prints.\n"]
    for group in parser._action_groups:
        actions = [action for action in group._group_actions if action.help != argparse.SUPPRESS]
        if not actions:
            continue
        parts.append(f"**{(group.title or '').capitalize()}**\n")
        if group.description:
            parts.append(_escape(group.description) + "\n")
        for action in actions:
            said = " ".join(formatter._expand_help(action).split()) if action.help else ""
            parts.append(f"`{_name_of(action, formatter)}`\n: {_escape(said)}\n")
    if parser.epilog:
        parts.append("```text\n" + parser.epilog.strip().replace("%(prog)s", parser.prog) + "\n```\n")
    return "\n".join(parts)


def _escape(text: str) -> str:
    """The text of a help, whose characters mean nothing, as Markdown."""
    for sign in "\\`*_[]<>#|$~":
        text = text.replace(sign, "\\" + sign)
    return text
