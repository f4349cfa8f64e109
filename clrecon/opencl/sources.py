"""Kernel files: where they are, and how their includes are resolved.

Includes are inlined on the host, each file once, with ``#line`` marks: a compiler error then names the true file
and line, no ``-I`` path with a space can break a driver, and the whole text is the key of every cache.
"""

from __future__ import annotations

import re
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from clrecon.errors import DeviceError

if TYPE_CHECKING:
    from importlib.abc import Traversable  # importlib.resources.abc from Python 3.11 on

_REINSTALL = "its installation is damaged, remove it and install it again (pip uninstall clrecon; pip install clrecon)"
_KNOWN_HEADER = "include/volume.h"
_NUMBER = re.compile(r"(?m)^#define (\w+) +\(?(-?[0-9.]+)f?\)?(?= |$)")
_INCLUDE = re.compile(r'^\s*#\s*include\s+"([^"]+)"\s*$')


@cache
def kernel_root() -> Traversable:
    """Return the folder of the kernel files: the installed package, else ``cl/`` beside the sources."""
    try:
        root: Traversable = resources.files("clrecon.cl")
    except ModuleNotFoundError:
        root = Path(__file__).resolve().parents[2] / "cl"
    if not root.joinpath(_KNOWN_HEADER).is_file():
        raise DeviceError(f"clrecon is installed without its kernels (no cl/{_KNOWN_HEADER}): {_REINSTALL}")
    return root


def _read_file(name: str) -> str:
    """Return the text of a kernel file or header."""
    try:
        return kernel_root().joinpath(name).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise DeviceError(f"clrecon is installed without its kernel file cl/{name}: {_REINSTALL}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise DeviceError(f"clrecon's kernel file cl/{name} cannot be read ({error}): {_REINSTALL}") from error


def kernel_files() -> list[str]:
    """Return the names of all ``.cl`` files, relative to the kernel folder, with forward slashes."""
    names: list[str] = []
    for theme in kernel_root().iterdir():
        if theme.is_dir():
            names.extend(f"{theme.name}/{file.name}" for file in theme.iterdir() if file.name.endswith(".cl"))
    return sorted(names)


def _inline(name: str, seen: set[str]) -> list[str]:
    lines = [f'#line 1 "cl/{name}"']
    for number, line in enumerate(_read_file(name).splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            lines.append(line)
        elif match[1] not in seen:
            seen.add(match[1])
            lines.extend(_inline(match[1], seen))
            lines.append(f'#line {number + 1} "cl/{name}"')
        else:
            lines.append("")
    return lines


@cache
def read_kernel_source(name: str) -> str:
    """Return the text of kernel file `name` (such as ``"primitives/scan.cl"``) with its includes inlined."""
    return "\n".join(_inline(name, {name})) + "\n"


@cache
def _numbers(name: str) -> dict[str, set[str]]:
    """Every number that a kernel file defines; variants may define one differently."""
    found: dict[str, set[str]] = {}
    for macro, number in _NUMBER.findall(_read_file(name)):
        found.setdefault(macro, set()).add(number)
    return found


def kernel_number(name: str, macro: str) -> float:
    """Return the number that a kernel file or header defines as `macro`: its one place.

    name: Such as ``"rays/project.cl"``.
    macro: Such as ``"AIR_HU"``, of a line ``#define AIR_HU (-1000.0f)``.
    """
    numbers = _numbers(name).get(macro, set())
    if len(numbers) != 1:
        there = f"several numbers {macro}: {', '.join(sorted(numbers))}" if numbers else f"no number {macro}"
        raise KeyError(f"cl/{name} defines {there}")
    return float(next(iter(numbers)))


def kernel_constant(name: str, macro: str) -> int:
    """Return the whole number that a kernel file or header defines as `macro`, see `kernel_number`."""
    number = kernel_number(name, macro)
    if not number.is_integer():
        raise ValueError(f"{macro} of cl/{name} is {number}, no whole number")
    return int(number)
