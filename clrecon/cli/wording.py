"""Parameters of the library in the words of the command line: the one place that translates them."""

from __future__ import annotations

import argparse

from clrecon.system.wording import Speaker, in_python

__all__ = ["speaker_of"]

_DESTINATIONS = {
    "direction": "light",
    "grow_mm": "grow",
    "half_way": "hu",
    "iso_value": "hu",
    "only": "label",
    "picture": "output",
}
"""Parameters whose option has another name, where the command has none of the parameter's own name."""


def speaker_of(parser: argparse.ArgumentParser) -> Speaker:
    """Words for the parameters that a command has options for; the others are named as in Python."""
    options = {action.dest: action.option_strings[0] for action in parser._actions if action.option_strings}

    def speak(parameter: str, value: object = None) -> str:
        option = options.get(parameter) or options.get(_DESTINATIONS.get(parameter, ""))
        if option is None:
            return in_python(parameter, value)
        if value is None or value is True or (parameter == "closed" and value is False):
            return option
        words = str(value).strip("()").replace(", ", ",")
        return f"{option} {'half:' if parameter == 'half_way' and value != 'auto' else ''}{words}"

    return speak
