"""Phantom settings: what is refused, with which numbers."""

from __future__ import annotations

import math

import pytest
from refusals import refused

from clrecon.errors import UsageError
from clrecon.proof.phantom import PhantomSettings, make_phantom, parse_size
from clrecon.proof.phantom.series import format_decimal


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"kind": "cube"}, "'cube'.*spine, sphere"),
        ({"size": (4, 64)}, "columns.*from 8 to 4096, got 4"),
        ({"size": (64,)}, "size needs 2 values, got 1"),
        ({"size": (64.5, 64)}, "whole number.*64.5"),
        ({"slices": 0}, "slices.*got 0"),
        ({"slices": True}, "slices.*got True"),
        ({"spacing": (0.5, 0.7)}, "spacing needs 3 values, got 2"),
        ({"spacing": (0.5, -0.7, 1.0)}, "column spacing di.*got -0.7"),
        ({"spacing": (0.5, 0.7, math.nan)}, "slice gap dk.*got nan"),
        ({"tilt": 60.0}, "tilt.*-45 to 45 degrees, got 60"),
        ({"oblique": (0.0, math.inf, 0.0)}, "oblique about y.*got inf"),
        ({"noise": -1.0}, "noise.*got -1"),
        ({"point_spread_mm": 21.0}, "point spread.*got 21"),
        ({"seed": -3}, "seed.*got -3"),
        ({"inside_hu": 40000.0}, "inside HU.*got 40000"),
        ({"inside_hu": 100.0, "outside_hu": 100.2}, "differ by less than 1 HU"),
        ({"radius_mm": 0.0}, "radius.*got 0"),
        ({"transfer_syntax": "jpeg"}, "'jpeg'"),
    ],
)
def test_wrong_setting_of_a_phantom_is_refused_with_its_name_and_value(given: dict, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        PhantomSettings(**given)


@pytest.mark.parametrize("kind", ["sphere", "torus", "cylinder", "plane"])
@pytest.mark.parametrize(
    ("given", "facts"),
    [
        pytest.param({"radius_mm": 30.0}, (30, "radius"), id="larger than the field"),
        pytest.param({"radius_mm": 0.9}, (1, "voxels"), id="smaller than a voxel"),
        pytest.param({"slices": 3}, (4, "voxels"), id="three slices"),
    ],
)
def test_body_that_does_not_fit_is_refused_with_its_numbers(kind: str, given: dict, facts: tuple) -> None:
    field_of_40_mm = {"size": (40, 40), "slices": 40, "spacing": (1.0, 1.0, 1.0)}
    with refused(UsageError, *facts):
        make_phantom(PhantomSettings(**{"kind": kind, **field_of_40_mm, **given}))


@pytest.mark.parametrize(("kind", "noise_hu", "point_spread_mm"), [("spine", 12.0, 0.5), ("sphere", 0.0, 0.0)])
def test_default_noise_and_point_spread_are_those_of_the_kind(
    kind: str, noise_hu: float, point_spread_mm: float
) -> None:
    settings = PhantomSettings(kind=kind)
    assert (settings.noise, settings.point_spread_mm) == (noise_hu, point_spread_mm)


def test_shape_of_the_voxels_is_slices_then_rows_then_columns() -> None:
    columns, rows, slices = 20, 30, 120  # 120 slices by default
    assert PhantomSettings(kind="sphere", size=[columns, rows]).shape_kji == (slices, rows, columns)


@pytest.mark.parametrize(("text", "size"), [("256", (256, 256)), ("256x192", (256, 192)), ("64 X 32", (64, 32))])
def test_size_of_a_phantom_is_read_as_columns_then_rows(text: str, size: tuple[int, int]) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "a", "1x2x3", "256x", "-5", "2.5"])
def test_text_that_is_no_size_is_refused(text: str) -> None:
    with refused(UsageError, "columns", "rows"):
        parse_size(text)


NUMBERS = (0.0, -0.0, 1.0, -1 / 3, 1e-17, -123.456789012345678, -1234.56789012345678, 0.1 + 0.2, -6.123233995736766e-17)


@pytest.mark.parametrize("value", NUMBERS, ids=repr)
def test_decimal_string_of_a_number_has_at_most_16_letters_and_reads_as_nearly_the_same(value: float) -> None:
    text = format_decimal(value)
    assert len(text) <= 16  # the most of DICOM
    assert float(text) == pytest.approx(value, rel=1e-8, abs=1e-30)  # 8 digits fit beside sign, point and exponent


@pytest.mark.parametrize("value", NUMBERS, ids=repr)
def test_decimal_string_read_and_written_again_is_the_same(value: float) -> None:
    text = format_decimal(value)
    assert format_decimal(float(text)) == text
