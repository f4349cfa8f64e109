"""``clrecon completion``: a script by which a shell completes commands, options and their words."""

from __future__ import annotations

import argparse
import re
from importlib import import_module
from itertools import chain

from clrecon.cli import common
from clrecon.cli.console import Console
from clrecon.errors import UsageError
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.text import guess_word

SHELLS = ("bash", "zsh", "fish")
_WORDS = re.compile(r"[a-z][a-z0-9-]*(?:\|[a-z][a-z0-9-]*)*")
"""A metavar that lists all words of an option, such as ``lps|ras``."""


@dataclass
class _Option:
    """An option: its names, one line of help, whether a value follows, and the words that the value can be."""

    names: list[str]
    help: str
    takes_value: bool
    words: list[str]


@dataclass
class _Words:
    """A command: one line of help, its options, and the words of its first argument if that is no file."""

    help: str
    options: list[_Option] = field(default_factory=list)
    first: list[str] = field(default_factory=list)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "The script is made from the options of this version. Where to save it:\n"
        "  bash   clrecon completion bash > ~/.local/share/bash-completion/completions/clrecon\n"
        '  zsh    clrecon completion zsh > "${fpath[1]}/_clrecon"\n'
        "  fish   clrecon completion fish > ~/.config/fish/completions/clrecon.fish\n"
        "For this shell only: source <(clrecon completion bash), or source <(clrecon completion zsh) after compinit."
    )
    parser.add_argument("shell", metavar="|".join(SHELLS), type=str.lower, help="the shell that completes")


def run(options: argparse.Namespace, console: Console) -> int:
    script = write_script(options.shell)
    console.result({"shell": options.shell, "script": script})
    console.say(script.rstrip("\n"), whole=True)
    return 0


def write_script(shell: str) -> str:
    if shell not in SHELLS:
        raise UsageError(f"no completion for {shell!r:.60}{guess_word(shell, SHELLS)}: use one of {', '.join(SHELLS)}")
    from clrecon.cli.main import COMMANDS, HELP

    words = {}
    for name, command in COMMANDS.items():
        parser = common.Parser(prog=name)
        import_module(command.module).add_arguments(parser)
        common.add_common(parser)
        words[name] = _Words(
            command.help, [_find_option(action) for action in parser._actions if action.option_strings]
        )
    words["completion"].first = list(SHELLS)
    words[HELP] = _Words("show all options of a command", first=list(COMMANDS))
    return {"bash": _write_bash, "zsh": _write_zsh, "fish": _write_fish}[shell](words)


def _find_option(action: argparse.Action) -> _Option:
    text = (action.help or "").replace("%%", "%")
    takes_value = action.nargs != 0
    return _Option(
        list(action.option_strings),
        re.split(r"[;:(]", text)[0].strip(),
        takes_value,
        _find_words(action) if takes_value else [],
    )


def _find_words(action: argparse.Action) -> list[str]:
    """Return the words that a value can be; empty where it is something else."""
    if isinstance(action.metavar, str) and _WORDS.fullmatch(action.metavar):
        return action.metavar.split("|")
    return list(getattr(action, "words", ()))


def _write_bash(commands: dict[str, _Words]) -> str:
    lines = [
        "# bash completion of clrecon, written by: clrecon completion bash",
        "_clrecon() {",
        "    local current=${COMP_WORDS[COMP_CWORD]} previous=${COMP_WORDS[COMP_CWORD-1]} words=",
        "    COMPREPLY=()",
        "    if [[ $COMP_CWORD -eq 1 ]]; then",
        f'        words="{" ".join(commands)} --help --version"',
        "    else",
        "        case ${COMP_WORDS[1]} in",
    ]
    for name, command in commands.items():
        lines += [f"        {name})", "            case $previous in"]
        for option in command.options:
            if option.takes_value:  # without words nothing is offered, and the shell completes files
                lines.append(f'                {"|".join(option.names)}) words="{" ".join(option.words)}" ;;')
        flags = " ".join(name for name in chain(*(option.names for option in command.options)) if name.startswith("--"))
        lines += [
            "                *)",
            f'                    if [[ $current == -* ]]; then words="{flags}"',
            f'                    else words="{" ".join(command.first)}"; fi ;;',
            "            esac ;;",
        ]
    return "\n".join(
        (
            *lines,
            "        esac",
            "    fi",
            '    [[ -n $words ]] && COMPREPLY=($(compgen -W "$words" -- "$current"))',
            "    return 0",
            "}",
            "complete -o default -o bashdefault -F _clrecon clrecon",
            "",
        )
    )


def _write_zsh(commands: dict[str, _Words]) -> str:
    def entry(word: str, help_text: str) -> str:
        return "'" + (f"{word}:{help_text}" if help_text else word).replace("'", "'\\''") + "'"

    lines = [
        "#compdef clrecon",
        "# zsh completion of clrecon, written by: clrecon completion zsh",
        "_clrecon() {",
        "    local -a found",
        "    if (( CURRENT == 2 )); then",
        f"        found=({' '.join(entry(name, command.help) for name, command in commands.items())})",
        "        _describe command found",
        "        return",
        "    fi",
        "    case $words[2] in",
    ]
    for name, command in commands.items():
        lines += [f"    {name})", "        case $words[CURRENT-1] in"]
        for option in command.options:
            if option.takes_value:
                act = f"compadd -- {' '.join(option.words)}" if option.words else "_files"
                lines.append(f"            {'|'.join(option.names)}) {act}; return ;;")
        entries = " ".join(
            entry(one, option.help) for option in command.options for one in option.names if one[1] == "-"
        )
        lines += [
            "        esac",
            "        if [[ $words[CURRENT] == -* ]]; then",
            f"            found=({entries})",
            "            _describe option found",
            f"        else {'compadd -- ' + ' '.join(command.first) if command.first else '_files'}; fi ;;",
        ]
    return "\n".join((*lines, "    esac", "}", "compdef _clrecon clrecon", ""))


def _write_fish(commands: dict[str, _Words]) -> str:
    lines = ["# fish completion of clrecon, written by: clrecon completion fish"]
    for name, command in commands.items():
        lines.append(f"complete -c clrecon -n __fish_use_subcommand -f -a {name} -d {_fish_quote(command.help)}")
    for name, command in commands.items():
        seen = f"complete -c clrecon -n '__fish_seen_subcommand_from {name}'"
        if command.first:
            lines.append(f"{seen} -f -a '{' '.join(command.first)}'")
        for option in command.options:
            names = " ".join(f"-l {one[2:]}" if one.startswith("--") else f"-s {one[1:]}" for one in option.names)
            value = " -r" if option.takes_value else ""
            if option.takes_value and option.words:
                value = f" -x -a '{' '.join(option.words)}'"
            help_text = f" -d {_fish_quote(option.help)}" if option.help else ""
            lines.append(f"{seen} {names}{value}{help_text}")
    return "\n".join((*lines, ""))


def _fish_quote(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
