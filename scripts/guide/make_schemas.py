#!/usr/bin/env python3
"""JSON Schemas of what the commands print and report, made from the tables of docs/contract.md.

    python scripts/guide/make_schemas.py

A section with a line "Schema: `clrecon-NAME-VERSION`" becomes docs/schemas/NAME.json.  Its tables with the columns
name, type and meaning are the entries of the report, those after a line "Entries of `X`" the entries of the object X,
and those after "Each of `X`" of each object in the list X.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
CONTRACT, FOLDER = ROOT / "docs" / "contract.md", ROOT / "docs" / "schemas"

HEAD = "| name | type | meaning |"
WORDS = {"int": "integer", "number": "number", "text": "string", "bool": "boolean", "object": "object"}
MISSING = ", may be missing"

Schema = dict[str, Any]


@dataclass
class Table:
    """Entries of an object: `of` are the names of objects or lists of this section, none for the report itself."""

    of: list[str]
    rows: list[tuple[list[str], str, str]]


@dataclass
class Section:
    """What the contract says about one report; `identity` is ``clrecon-NAME-VERSION``, empty for a part of others."""

    name: str
    identity: str
    tables: list[Table] = field(default_factory=list)

    def has_entries_of(self, name: str) -> bool:
        return any(name in table.of for table in self.tables)


def read_sections(text: str) -> dict[str, Section]:
    """Return the sections of the contract that have a schema, by name."""
    sections = {}
    for block in text.split("\n## ")[1:]:
        found = re.search(r"^Schema: `(clrecon-(\w+)-\d+)`|^Schema of a part: `([\w-]+)`", block, re.MULTILINE)
        if found:
            name = found[2] or found[3]
            sections[name] = Section(name, found[1] or "", list(_read_tables(block)))
    return sections


def _read_tables(block: str) -> Iterator[Table]:
    for before, body in re.findall(rf"((?:[^\n]+\n)*)\n{re.escape(HEAD)}\n\|---\|---\|---\|\n((?:\|.*\n?)+)", block):
        of = re.match(r"(?:Entries|Each) of ((?:`\w+`(?:, | and )?)+)", before)
        rows = []
        for line in body.splitlines():
            names, kind, meaning = (cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1])
            rows.append((re.findall(r"`(\w+)`", names), kind, _plain(meaning)))
        yield Table(re.findall(r"`(\w+)`", of[1]) if of else [], rows)


def _plain(meaning: str) -> str:
    return re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", meaning).replace("`", "")


def make_schema(section: Section) -> Schema:
    """Return the schema of a section, with the entries of its objects as definitions."""
    root: Schema = {"type": "object", "properties": {}, "required": []}
    if section.identity:
        root["properties"]["schema"] = {"const": section.identity}
        root["required"].append("schema")
    definitions: dict[str, Schema] = {}
    for table in section.tables:
        for part in [root] if not table.of else [definitions.setdefault(name, _empty()) for name in table.of]:
            _add_rows(part, table, section, root)
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": section.identity or section.name}
    return {**head, **root, **({"$defs": definitions} if definitions else {})}


def _empty() -> Schema:
    return {"type": "object", "properties": {}, "required": []}


def _add_rows(part: Schema, table: Table, section: Section, root: Schema) -> None:
    previous = ""
    for names, kind, meaning in table.rows:
        kind = previous if kind == "the same" else kind
        previous = kind
        for name, own in zip(names, _share_types(kind, len(names)), strict=True):
            is_missing, own = own.endswith(MISSING), own.removesuffix(MISSING)
            if own == "as above":
                if part is root or name not in root["properties"]:
                    raise ValueError(f"{section.name}: no entry {name!r} above")
                entry: Schema = {"$ref": f"#/properties/{name}"}
            else:
                entry = {**_read_type(own, name, section), "description": meaning}
            part["properties"][name] = entry
            if not is_missing:
                part["required"].append(name)


def _share_types(kind: str, count: int) -> list[str]:
    """Return the type of each of several names: as many types as names, or one for all."""
    kinds = re.split(r", (?![^{\[]*[}\]])", kind.removesuffix(MISSING))
    ending = MISSING if kind.endswith(MISSING) else ""
    if kinds[-1] == "each or null":
        ending, kinds = " or null" + ending, kinds[:-1]
    return [f"{own}{ending}" for own in (kinds if len(kinds) == count > 1 else [", ".join(kinds)] * count)]


def _read_type(kind: str, name: str, section: Section) -> Schema:
    alternatives = [_read_word(word.strip(), name, section) for word in kind.split(" or ")]
    if len(alternatives) == 1:
        return alternatives[0]
    if all(list(each) == ["type"] for each in alternatives):
        return {"type": [each["type"] for each in alternatives]}
    return {"anyOf": alternatives}


def _read_word(word: str, name: str, section: Section) -> Schema:
    if word == "null":
        return {"type": "null"}
    if word in ("object", "list") and section.has_entries_of(name):
        entries = {"$ref": f"#/$defs/{name}"}
        return entries if word == "object" else {"type": "array", "items": entries}
    if word in WORDS:
        return {"type": WORDS[word]}
    if found := re.fullmatch(r"as for `clrecon ([\w-]+)`", word):
        return {"$ref": f"{found[1]}.json#/properties/{name}"}
    if word == "as in the certificate":
        return {"$ref": f"certificate.json#/properties/{name}"}
    if word == "as in a gate":
        return {"$ref": f"certificate.json#/$defs/gates/properties/{name}"}
    if word == "certificate":
        return {"$ref": "certificate.json"}
    if found := re.fullmatch(r"list(?: of (.+?)s?)?", word):
        if found[1] == "object":  # not those of a table
            return {"type": "array", "items": {"type": "object"}}
        return {"type": "array", **({"items": _read_word(found[1], name, section)} if found[1] else {})}
    if found := re.fullmatch(r"(\d+) (int|number)s?", word):
        return _array(int(found[1]), {"type": WORDS[found[2]]})
    if found := re.fullmatch(r"(\d+) x (\d+)", word):
        return _array(int(found[1]), _array(int(found[2]), {"type": "number"}))
    if word == "point":
        return _array(3, {"type": "number"})
    if word == "[low, high]":
        return _array(2, {"type": ["number", "null"]})
    if found := re.fullmatch(r"`\{(.*)\}`", word):
        names = re.findall(r'"(\w+)"', found[1])
        return {"type": "object", "properties": {each: {} for each in names}, "required": names}
    if section.has_entries_of(word):
        return {"$ref": f"#/$defs/{word}"}
    raise ValueError(f"{section.name}: the type of {name!r} is {word!r}, which is none of the contract's")


def _array(count: int, items: Schema) -> Schema:
    return {"type": "array", "items": items, "minItems": count, "maxItems": count}


def schema_text(schema: Schema) -> str:
    """Return the schema as JSON with one entry a line."""
    return "{\n" + ",\n".join(f' "{key}": {_part_text(key, part, 1)}' for key, part in schema.items()) + "\n}\n"


def _part_text(key: str, part: Any, depth: int) -> str:
    indent = " " * (depth + 1)
    if key == "properties":
        lines = [f"{indent}{json.dumps(name)}: {json.dumps(entry)}" for name, entry in part.items()]
    elif key == "$defs":
        lines = [
            f'{indent}"{name}": {{\n'
            + ",\n".join(f'{indent} "{own}": {_part_text(own, value, depth + 2)}' for own, value in entry.items())
            + f"\n{indent}}}"
            for name, entry in part.items()
        ]
    else:
        return json.dumps(part)
    return "{\n" + ",\n".join(lines) + "\n" + " " * depth + "}"


def make_all() -> dict[str, str]:
    """Return the text of each file of the folder, by name."""
    sections = read_sections(CONTRACT.read_text(encoding="utf-8"))
    return {f"{name}.json": schema_text(make_schema(section)) for name, section in sections.items()}


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    for name, text in make_all().items():
        (FOLDER / name).write_text(text, encoding="ascii")


if __name__ == "__main__":
    main()
