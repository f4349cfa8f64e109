"""Values of the options of ``clrecon cloud``, read from their texts."""

from __future__ import annotations

import argparse
from typing import Any


def parse_level(text: str) -> float | tuple[float, ...]:
    """Read ``N`` as an iso value, and ``LO,HI`` or ``LO:HI`` as a band of HU."""
    try:
        numbers = tuple(float(part) for part in text.replace(":", ",").split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (1, 2):
        raise argparse.ArgumentTypeError(f"{text!r} is no iso value N and no band LO,HI of HU")
    return numbers[0] if len(numbers) == 1 else numbers


def parse_clusters(text: str) -> dict[str, Any]:
    """Read ``eps=MM,min=N`` (either may be missing) as parameters of `clrecon.jobs.cloud.settings.Clustering`."""
    known = {"eps": "eps", "min": "min_samples"}
    found: dict[str, Any] = {}
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals or name not in known or known[name] in found:
            raise argparse.ArgumentTypeError(f"{text!r} is not eps=MM,min=N, such as eps=1.2,min=6")
        try:
            found[known[name]] = (
                value if value == "plane+1" and name == "min" else (float if name == "eps" else int)(value)
            )
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r}: {name} is no number: {value!r}") from None
    return found


def parse_denoisers(text: str) -> tuple[str, ...]:
    """Read names with commas between them; what is not known is refused with the settings."""
    return tuple(part.strip().lower() for part in text.split(","))
