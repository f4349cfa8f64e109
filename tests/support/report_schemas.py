"""Reports held against the JSON Schemas of docs/schemas, which allow further entries, and here none."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "schemas"


def find_faults(report: Mapping[str, Any], name: str | None = None) -> list[str]:
    """Return what a report lacks of the schema that it or `name` says, or has beyond it; reports without one pass."""
    if name is None:
        if not isinstance(report.get("schema"), str):  # a number: of a bench, which has no schema file
            return []
        name = report["schema"].split("-")[1]
    errors = _validator(name).iter_errors(report)
    made_in_memory = "format" not in (report.get("volume") or {})  # by a test, without a certificate
    leaves = [leaf for leaf in _leaves(errors) if not (made_in_memory and leaf.json_path == "$.volume")]
    return [f"docs/schemas/{name}.json: {leaf.json_path}: {leaf.message:.200}" for leaf in leaves]


def _leaves(errors: Iterable[Any]) -> Iterator[Any]:
    """Give the errors of all alternatives where none fits."""
    for error in errors:
        yield from _leaves(error.context) if error.context else [error]


@cache
def _validator(name: str) -> Any:
    from jsonschema import Draft202012Validator
    from referencing import Registry, Resource

    schemas = {path.name: _closed(json.loads(path.read_text())) for path in FOLDER.glob("*.json")}
    registry = Registry().with_resources((key, Resource.from_contents(schema)) for key, schema in schemas.items())
    return Draft202012Validator({"$ref": f"{name}.json"}, registry=registry)


def _closed(schema: Any) -> Any:
    """Return a schema without further entries of objects whose entries it names."""
    if isinstance(schema, list):
        return [_closed(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    parts = {key: _closed(part) for key, part in schema.items()}
    return {**parts, "additionalProperties": False} if "type" in parts and "properties" in parts else parts
