"""One-place changes of Python files: what can be changed, a seeded choice of it, and which changes change nothing.

Places and changed texts come from the operators of cosmic-ray, the extra ``mutation`` of setup.cfg.
"""

from __future__ import annotations

import ast
import difflib
import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

ARITHMETIC = ("Add", "Sub", "Mul", "Div", "FloorDiv", "Mod")
BITS = ("BitAnd", "BitOr", "BitXor", "LShift", "RShift")
ORDER = ("Eq", "NotEq", "Lt", "LtE", "Gt", "GtE")
KINDS = re.compile(
    "|".join(
        [
            *(f"ReplaceBinaryOperator_(?:{names})_(?:{names})" for names in ("|".join(ARITHMETIC), "|".join(BITS))),
            "ReplaceBinaryOperator_Pow_(?:Mul|Add)",
            f"ReplaceComparisonOperator_(?:{'|'.join(ORDER)})_(?:{'|'.join(ORDER)})",
            "ReplaceComparisonOperator_(?:Is_IsNot|IsNot_Is)",
            "ReplaceUnaryOperator_(?:UAdd_USub|Delete_USub|Delete_Invert|Delete_Not)",
            "AddNot|ReplaceTrueWithFalse|ReplaceFalseWithTrue|ReplaceAndWithOr|ReplaceOrWithAnd",
            "ReplaceBreakWithContinue|ReplaceContinueWithBreak|NumberReplacer|ZeroIterationForLoop",
        ]
    )
)
"""Operators of cosmic-ray that are used.  An operator of arithmetic becomes one of arithmetic: `x >> y` of floats is an
error that any test finds.  Decorators and except clauses stay as they are."""

Position = tuple[int, int]
"""Line, counted from 1, and column, counted from 0."""


@dataclass(frozen=True)
class Place:
    """What one operator of cosmic-ray can do at one position of a file.

    operator: Name of the operator.
    occurrence: Number of this place among all places of the operator in the file.
    start: Line and column.
    """

    operator: str
    occurrence: int
    start: Position


@dataclass(frozen=True)
class Change:
    """A change of a file in one place.

    file: Path below the root of the project.
    operator: Name of the operator of cosmic-ray.
    occurrence: Number of the place among those of the operator in the file.
    before, after: The lines that differ, without the blanks around them.
    text: The whole changed file.
    """

    file: str
    line: int
    operator: str
    occurrence: int
    before: str
    after: str
    text: str

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.operator}\n    - {self.before}\n    + {self.after}"

    def as_dict(self) -> dict[str, Any]:
        """The change as JSON, without the file's text."""
        return {name: value for name, value in asdict(self).items() if name != "text"}


@dataclass(frozen=True)
class Equivalent:
    """A change that changes no result.

    before, after: As in `Change`.
    """

    file: str
    before: str
    after: str
    why: str

    def names(self, change: Change) -> bool:
        """True if this is the change."""
        return (self.file, self.before, self.after) == (change.file, change.before, change.after)


def read_equivalents(path: Path) -> list[Equivalent]:
    """Read the list of equivalent changes."""
    return [Equivalent(**entry) for entry in json.loads(path.read_text(encoding="utf-8"))]


@cache
def _operators() -> dict[str, Any]:
    from cosmic_ray.operators.number_replacer import NumberReplacer
    from cosmic_ray.operators.provider import OperatorProvider

    class NumberInPlace(NumberReplacer):
        """The operator, which by itself joins a number to the line before."""

        def mutate(self, node: Any, index: int) -> Any:
            prefix, node = node.prefix, super().mutate(node, index)
            node.prefix, node.value = prefix, node.value.strip()
            return node

    provider = OperatorProvider()
    found = {name: provider[name]() for name in provider if KINDS.fullmatch(name)}
    return {**found, NumberReplacer.__name__: NumberInPlace()}


def _annotations(tree: ast.Module) -> Iterator[ast.expr]:
    for node in ast.walk(tree):
        if isinstance(node, (ast.arg, ast.AnnAssign)) and node.annotation is not None:
            yield node.annotation
        elif isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)) and node.returns is not None:
            yield node.returns


def _is_left_out(node: ast.AST) -> bool:
    """A block for type checkers, or ``strict=True`` of zip: an assertion that is never wrong in a right program."""
    if isinstance(node, ast.keyword):
        return node.arg == "strict"
    return isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")


def _spans_left_out(text: str) -> list[tuple[Position, Position]]:
    """Start and end of annotations, which no program reads, and of `_is_left_out`."""
    tree = ast.parse(text)
    nodes: list[Any] = [*_annotations(tree), *(node for node in ast.walk(tree) if _is_left_out(node))]
    # ast counts columns in bytes: compared as such with a line of letters beyond ASCII, a place may be left out.
    return [((node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)) for node in nodes]


def _count_slashes(tree: ast.Module) -> int:
    return sum(bool(node.posonlyargs) for node in ast.walk(tree) if isinstance(node, ast.arguments))


def find_places(text: str) -> list[Place]:
    """Find everything that can be changed in a file with the given text, in the order of the file."""
    from cosmic_ray.ast import ast_nodes, get_ast

    left_out = _spans_left_out(text)
    tree = list(ast_nodes(get_ast(text)))
    places = []
    for name, operator in _operators().items():
        starts = [start for node in tree for start, _ in operator.mutation_positions(node)]
        places += [
            Place(name, occurrence, start)
            for occurrence, start in enumerate(starts)
            if not any(first <= start < last for first, last in left_out)
        ]
    return sorted(places, key=lambda place: (place.start, place.operator, place.occurrence))


def make_change(file: str, text: str, place: Place) -> Change | None:
    """Change a text in one place; None if it stays the same program or becomes none.

    None too for ``frozen=True`` of a dataclass, as nothing assigns to its fields in a right program, and for the star
    of a signature, which is no product.
    """
    from cosmic_ray.mutating import mutate_code

    changed = mutate_code(text, _operators()[place.operator], place.occurrence)
    try:
        if changed is None:
            return None
        now, was = ast.parse(changed), ast.parse(text)
        if ast.dump(now) == ast.dump(was) or _count_slashes(now) > _count_slashes(was):
            return None
        compile(changed, file, "exec")
    except SyntaxError:
        return None
    old, new = text.splitlines(), changed.splitlines()
    rows = [
        code for code in difflib.SequenceMatcher(None, old, new, autojunk=False).get_opcodes() if code[0] != "equal"
    ]
    first, last = rows[0], rows[-1]
    before = " ".join(line.strip() for line in old[first[1] : last[2]])
    after = " ".join(line.strip() for line in new[first[3] : last[4]])
    if after.count("frozen=False") > before.count("frozen=False"):
        return None
    return Change(file, first[1] + 1, place.operator, place.occurrence, before, after, changed)


def name_places(texts: dict[str, str]) -> dict[tuple[str, ...], list[Place]]:
    """Name each position of files that can be changed.

    A name is file, definition around the position, text of its line without the blanks at its ends, and the number of
    the position among those of the same three.  An edit elsewhere leaves it alone.

    texts: Path below the root -> text of the file.
    Returns name -> what can be done there, in an order that another edit leaves alone too.
    """
    named: dict[tuple[str, ...], list[Place]] = {}
    for file in sorted(texts):
        lines = texts[file].split("\n")
        at: dict[Position, list[Place]] = {}
        for place in find_places(texts[file]):
            at.setdefault(place.start, []).append(place)
        names = definition_names(texts[file])
        seen: Counter[tuple[str, ...]] = Counter()
        for start in sorted(at):
            place_of = (file, names.get(start[0], ""), lines[start[0] - 1].strip())
            name = (*place_of, str(seen[place_of]))
            named[name] = at[start]
            seen[place_of] += 1
    return named


def definition_names(text: str) -> dict[int, str]:
    """Line -> names of the classes and functions around it, from the outermost, with dots between; none outside."""
    names: dict[int, str] = {}

    def walk(node: ast.AST, outer: str) -> None:
        for child in ast.iter_child_nodes(node):
            name = outer
            if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
                name = f"{outer}.{child.name}".lstrip(".")
                names.update(dict.fromkeys(range(child.lineno, (child.end_lineno or child.lineno) + 1), name))
            walk(child, name)

    walk(ast.parse(text), "")
    return names


def choose_changes(texts: dict[str, str], count: int, seed: str) -> list[Change]:
    """Choose changes at random: each position of a file alike, and at each position one of its changes.

    The order is that of a hash of the seed and the position's name: an edit draws no other changes elsewhere.

    texts: Path below the root -> text of the file.
    count: At most so many; fewer where there are fewer positions.
    """

    def draw(*words: str) -> str:
        return hashlib.sha256("\0".join((seed, *words)).encode()).hexdigest()

    named = name_places(texts)
    chosen: list[Change] = []
    for name in sorted(named, key=lambda name: draw(*name)):
        if len(chosen) >= count:
            break
        seen: Counter[str] = Counter()
        draws = []
        for place in named[name]:
            draws.append((draw(*name, place.operator, str(seen[place.operator])), place))
            seen[place.operator] += 1
        change = make_change(name[0], texts[name[0]], min(draws, key=lambda entry: entry[0])[1])
        if change is not None:
            chosen.append(change)
    return chosen


def statement_lines(text: str, line: int) -> Sequence[int]:
    """Lines of the innermost statement around a line; of a statement with a body, only those before the body."""
    found = range(line, line + 1)
    smallest = None
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.stmt) or node.end_lineno is None:
            continue
        body = getattr(node, "body", None)
        end = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno
        if node.lineno <= line <= end and (smallest is None or end - node.lineno < smallest):
            smallest, found = end - node.lineno, range(node.lineno, end + 1)
    return found
