"""Names of the library's parameters as options of the command line."""

from __future__ import annotations

import argparse

from clrecon.system.arguments import Speaker, in_python

_DESTINATIONS = {
    "color_by": "color",
    "direction": "light",
    "eps": "clusters",
    "grow_mm": "grow",
    "half_way": "hu",
    "iso_value": "hu",
    "kind": "points",
    "min_samples": "clusters",
    "only": "label",
    "picture": "output",
}
"""Options of parameters by another name; used if the command has no option of the parameter's own name."""

_PARTS = {"eps": "eps=", "min_samples": "min="}
"""Parameters that are a part of an option's value."""


def speaker_of(parser: argparse.ArgumentParser) -> Speaker:
    """Make a function that names parameters as options of a command; others keep their names in Python."""
    options = {action.dest: action.option_strings[0] for action in parser._actions if action.option_strings}

    def speak(parameter: str, value: object = None) -> str:
        option = options.get(parameter) or options.get(_DESTINATIONS.get(parameter, ""))
        if option is None:
            return in_python(parameter, value)
        part = _PARTS.get(parameter, "")
        if part:
            return f"{option} {part}{'MM' if value is None and parameter == 'eps' else 'N' if value is None else value}"
        if value is None or value is True or (parameter == "closed" and value is False):
            return option
        words = str(value).strip("()").replace(", ", ",")
        return f"{option} {'half:' if parameter == 'half_way' and value != 'auto' else ''}{words}"

    return speak
