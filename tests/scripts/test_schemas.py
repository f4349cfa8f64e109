"""docs/schemas is what docs/contract.md says; a report that differs from its schema is found."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from refusals import refused
from report_schemas import find_faults

import make_schemas  # isort: skip

CONTRACT = """
## clrecon weigh

Schema: `clrecon-weigh-1`

| name | type | meaning |
|---|---|---|
| `grams`, `name` | number or null, text | of the bone |
| `parts` | list, may be missing | one object for each part |

Each of `parts`:

| name | type | meaning |
|---|---|---|
| `grams` | as above | of the part |
| `at_mm` | 3 numbers | its centre |
"""
"""A contract of one report."""


def schema_of(contract: str) -> Any:
    """The schema of the report that a contract describes."""
    return make_schemas.make_schema(make_schemas.read_sections(contract)["weigh"])


def test_the_files_are_what_the_contract_says() -> None:
    written = {path.name: path.read_text(encoding="ascii") for path in make_schemas.FOLDER.iterdir()}

    assert written == make_schemas.make_all(), "python scripts/guide/make_schemas.py"


@pytest.mark.parametrize("path", sorted(make_schemas.FOLDER.iterdir()), ids=lambda path: path.stem)
def test_schema_is_valid(path: Path) -> None:
    from jsonschema import Draft202012Validator

    schema = json.loads(path.read_text(encoding="ascii"))
    assert Draft202012Validator.check_schema(schema) is None  # else it raises a SchemaError


def test_rows_of_a_table_become_entries_with_types_and_meaning() -> None:
    assert schema_of(CONTRACT)["properties"] == {
        "schema": {"const": "clrecon-weigh-1"},
        "grams": {"type": ["number", "null"], "description": "of the bone"},
        "name": {"type": "string", "description": "of the bone"},
        "parts": {"type": "array", "items": {"$ref": "#/$defs/parts"}, "description": "one object for each part"},
    }


def test_entries_that_may_be_missing_are_not_required() -> None:
    assert schema_of(CONTRACT)["required"] == ["schema", "grams", "name"]


def test_table_of_a_list_describes_its_objects() -> None:
    assert schema_of(CONTRACT)["$defs"]["parts"]["properties"] == {
        "grams": {"$ref": "#/properties/grams"},
        "at_mm": {
            "type": "array",
            "items": {"type": "number"},
            "minItems": 3,
            "maxItems": 3,
            "description": "its centre",
        },
    }


def test_type_that_the_contract_does_not_use_is_refused() -> None:
    with refused(ValueError, "weight"):
        schema_of(CONTRACT.replace("number or null, text", "weight"))


ERROR = {"schema": "clrecon-error-1", "error": {"kind": "UsageError", "exit_code": 3, "message": "no"}}


def test_report_as_its_schema_has_no_faults() -> None:
    assert find_faults(ERROR) == []


@pytest.mark.parametrize(
    ("report", "place"),
    [({"schema": "clrecon-error-1"}, "$"), ({**ERROR, "more": 1}, "$"), ({**ERROR, "error": "no"}, "$.error")],
    ids=["missing entry", "entry beyond the schema", "other type"],
)
def test_report_that_differs_from_its_schema_is_found(report: dict[str, Any], place: str) -> None:
    (fault,) = find_faults(report)

    schema, found_place, _ = fault.split(": ", 2)
    assert (schema, found_place) == ("docs/schemas/error.json", place)
