"""Parameters of tests: which are for every device, which for the first alone, and which for a release."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable
from itertools import combinations, product
from typing import Any

import pytest

FOR_RELEASE = pytest.mark.release

VOXEL_TYPES = [
    "int16",
    "float32",
    pytest.param("uint8", marks=pytest.mark.first_device),
    *(pytest.param(kind, marks=[pytest.mark.first_device, FOR_RELEASE]) for kind in ("int8", "uint16", "int32")),
]
"""In a test for every device, those of scans and of computed volumes are built on each: a build takes seconds.  All of
them are built every day on the first by tests/opencl/test_sources.py: kernels read voxels by one macro."""


def daily(number: int, values: Iterable[Any]) -> list[Any]:
    """Values of one parameter of which the first `number` run every day, and the others for a release."""
    return daily_rows(number, (value if hasattr(value, "marks") else pytest.param(value) for value in values))


def daily_rows(number: int, rows: Iterable[Any]) -> list[Any]:
    """Rows of several parameters of which the first `number` run every day, and the others for a release.

    A row may have marks and a name, as `pytest.param` gives them.
    """
    made = [row if hasattr(row, "marks") else pytest.param(*row) for row in rows]
    return [*made[:number], *(row._replace(marks=(*row.marks, FOR_RELEASE)) for row in made[number:])]


def but_seldom(values: Iterable[Any], seldom: Container[Any]) -> list[Any]:
    """Values of one parameter; those of `seldom` are for a release."""
    return [pytest.param(value, marks=FOR_RELEASE) if value in seldom else value for value in values]


def each_value(*axes: Iterable[Any]) -> list[Any]:
    """All rows of the product of `axes`: every day few in which each value stands, the others for a release.

    Each next row of every day has the most values that no other has, then the most new pairs, then the rarest values.
    """
    lists = [list(axis) for axis in axes]
    rows = list(product(*(range(len(values)) for values in lists)))
    often: list[tuple[int, ...]] = []
    for _ in range(max(map(len, lists))):
        values = Counter(place for row in often for place in enumerate(row))
        pairs = {pair for row in often for pair in combinations(enumerate(row), 2)}

        def gain(row: tuple[int, ...], values: Counter[Any] = values, pairs: set[Any] = pairs) -> tuple[int, int, int]:
            used = [values[place] for place in enumerate(row)]
            return used.count(0), len({*combinations(enumerate(row), 2)} - pairs), -sum(used)

        often.append(max(rows, key=gain))
    return [
        pytest.param(
            *(values[place] for values, place in zip(lists, row, strict=True)),
            marks=() if row in often else FOR_RELEASE,
        )
        for row in rows
    ]
