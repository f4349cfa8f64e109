"""Kernel files: where they are, how their includes are resolved, and the arguments of each kernel.

Includes are inlined on the host, each file once, with ``#line`` marks: a compiler error then names the true file
and line, no ``-I`` path with a space can break a driver, and the whole text is the key of every cache.

The arguments of kernels are read from the source: names and types, in order.  Drivers know the names only for programs
that were built from source with an option for it, and some never do.  The source is always at hand, also where a
program comes from a binary, so the names are read from it.  The reader follows the preprocessor directives that kernel
files use and replaces types that are macros (VOXEL).  It does not know what a compiler defines itself (__AVX2__):
conditions on that may not change the arguments of a kernel."""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from clrecon.errors import DeviceError
from clrecon.system.light_dataclass import dataclass

if TYPE_CHECKING:
    from importlib.abc import Traversable  # importlib.resources.abc from Python 3.11 on


_REINSTALL = "its installation is damaged, remove it and install it again (pip uninstall clrecon; pip install clrecon)"
_KNOWN_HEADER = "include/volume.h"
EXACT_HEADER = "include/exact.h"
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
def read_kernel_source(*names: str) -> str:
    """Return the text of kernel files (such as ``"primitives/scan.cl"``) with their includes inlined, each once.

    What all compilers have to compute with the same bits stands before every kernel file: ``include/exact.h``.
    """
    seen = set(names)
    lines = _inline(EXACT_HEADER, seen) if names[0].endswith(".cl") else []
    for name in names:
        lines += _inline(name, seen)
    return "\n".join(lines) + "\n"


@cache
def _list_numbers(name: str) -> dict[str, set[str]]:
    """Every number that a kernel file defines; variants may define one differently."""
    numbers: dict[str, set[str]] = {}
    for macro, number in _NUMBER.findall(_read_file(name)):
        numbers.setdefault(macro, set()).add(number)
    return numbers


def kernel_number(name: str, macro: str) -> float:
    """Return the number that a kernel file or header defines as `macro`, as in ``#define AIR_HU (-1000.0f)``."""
    numbers = _list_numbers(name).get(macro, set())
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


_COMMENT = re.compile(r"/\*.*?(?:\*/|\Z)|//[^\n]*", re.DOTALL)
_DIRECTIVE = re.compile(r"^[ \t]*#[ \t]*(\w+)[ \t]*(.*)", re.MULTILINE)
_DEFINE = re.compile(r"(\w+)(\(?)[ \t]*(.*)", re.DOTALL)
_DEFINED = re.compile(r"\bdefined\s*(?:\(\s*(\w+)\s*\)|(\w+))")
_WORD = re.compile(r"\b[A-Za-z_]\w*\b")
_KERNEL = re.compile(r"__kernel\b(?:\s*__attribute__\s*\(\(.*?\)\))?\s+void\s+(\w+)\s*\(([^()]*)\)\s*\{")
_LONGEST_HEAD = 8000  # from __kernel to the body, with comments
_QUALIFIERS = {"const", "restrict", "volatile", "unsigned", "__global", "__constant", "__local", "__private"}


@dataclass(frozen=True)
class KernelArgument:
    """One argument of a kernel, with its type, or its elements', in OpenCL C; `is_written`: elements are not const."""

    name: str
    type: str
    is_buffer: bool
    is_written: bool = False


def definitions_of(options: tuple[str, ...]) -> dict[str, str]:
    given = (option[2:].partition("=") for option in options if option.startswith("-D"))
    return {name: value if equals else "1" for name, equals, value in given}


def _strip_comments(text: str) -> str:
    return _COMMENT.sub(" ", text) if "/" in text else text


@cache
def _split_source(source: str) -> tuple[tuple[str, str, str], ...]:
    """Split a source into pieces: a directive, its text, and the text from there to the next directive."""
    text = source.replace("\\\n", " ")
    pieces = [("", "", 0)]
    ends = []
    for match in _DIRECTIVE.finditer(text):
        ends.append(match.start())
        pieces.append((match[1], _strip_comments(match[2]).strip(), match.end()))
    ends.append(len(text))
    return tuple((name, rest, text[begin:end]) for (name, rest, begin), end in zip(pieces, ends, strict=True))


def find_signatures(source: str, definitions: Mapping[str, str]) -> dict[str, tuple[KernelArgument, ...]]:
    """Return the arguments of all kernels of a source with its includes; `definitions` are those of the build."""
    macros, text = _preprocess(source, definitions)
    signatures = {}
    start = text.find("__kernel")
    while start >= 0:  # comments are long, so they are removed only here
        match = _KERNEL.match(_strip_comments(text[start : start + _LONGEST_HEAD]))
        if match is not None:
            signatures[match[1]] = _arguments(_expand(match[2], macros))
        start = text.find("__kernel", start + 1)
    return signatures


def _preprocess(source: str, definitions: Mapping[str, str]) -> tuple[dict[str, str], str]:
    """Return the macros without parameters at the end of a source, and the text that its conditions keep."""
    macros, lines = dict(definitions), []
    states: list[tuple[bool, bool]] = []  # for each open condition: is its branch kept, and was one kept before
    for name, rest, text in _split_source(source):
        if name in ("if", "ifdef", "ifndef"):
            outside = not states or states[-1][0]
            holds = outside and _holds(name, rest, macros)
            states.append((holds, holds or not outside))
        elif name in ("elif", "else"):
            _, done = states.pop()
            holds = not done and (name == "else" or _holds("if", rest, macros))
            states.append((holds, holds or done))
        elif name == "endif":
            states.pop()
        elif name in ("define", "undef") and (not states or states[-1][0]):
            _define(name, rest, macros)
        elif name not in ("", "define", "undef", "line", "pragma", "error"):
            raise ValueError(f"#{name} {rest}")
        if not states or states[-1][0]:
            lines.append(text)
    return macros, "".join(lines)


def _define(directive: str, rest: str, macros: dict[str, str]) -> None:
    match = _DEFINE.match(rest)
    if match is None:
        raise ValueError(f"#{directive} {rest}")
    if directive == "undef":
        macros.pop(match[1], None)
    elif not match[2] or rest[match.end(1)] == " ":  # macros with parameters cannot name an argument
        macros[match[1]] = rest[match.end(1) :].strip()


def _holds(directive: str, condition: str, macros: Mapping[str, str]) -> bool:
    if directive != "if":
        return (condition in macros) == (directive == "ifdef")
    text = _DEFINED.sub(lambda match: str(int((match[1] or match[2]) in macros)), condition)
    text = _WORD.sub("0", _expand(text, macros))
    if not re.fullmatch(r"[0-9()<>=!&|+\-*/% ]*", text) or re.search(r"[0-9] *\(", text):
        raise ValueError(f"#if {condition}")
    text = text.replace("&&", " and ").replace("||", " or ")
    try:
        return bool(_read_number(ast.parse(re.sub(r"!(?!=)", " not ", text).strip(), mode="eval").body))
    except (SyntaxError, KeyError) as error:
        raise ValueError(f"#if {condition}") from error


_OPERATIONS: dict[type, Callable[[int, int], int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}


def _read_number(node: ast.expr) -> int:
    if isinstance(node, ast.Constant) and isinstance(node.value, int):
        return node.value
    if isinstance(node, ast.BoolOp):
        holds = [_read_number(part) != 0 for part in node.values]
        return int(all(holds) if isinstance(node.op, ast.And) else any(holds))
    if isinstance(node, ast.UnaryOp):
        value = _read_number(node.operand)
        return int(not value) if isinstance(node.op, ast.Not) else -value
    if isinstance(node, ast.BinOp):
        return int(_OPERATIONS[type(node.op)](_read_number(node.left), _read_number(node.right)))
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        return int(_OPERATIONS[type(node.ops[0])](_read_number(node.left), _read_number(node.comparators[0])))
    raise SyntaxError(ast.dump(node))


def _expand(text: str, macros: Mapping[str, str]) -> str:
    for _ in range(10):
        expanded = _WORD.sub(lambda match: macros.get(match[0], match[0]), text)
        if expanded == text:
            return text
        text = expanded
    raise ValueError(f"macros that name themselves: {text}")


def _arguments(text: str) -> tuple[KernelArgument, ...]:
    arguments = []
    for part in text.split(","):
        words = [word for word in _WORD.findall(part) if word not in _QUALIFIERS]
        if len(words) != 2:
            raise ValueError(f"an argument of a kernel is a type and a name, not {part.strip()!r}")
        is_buffer = "*" in part
        arguments.append(KernelArgument(words[1], words[0], is_buffer, is_buffer and "const" not in part.split("*")[0]))
    return tuple(arguments)
