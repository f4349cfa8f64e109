"""What the console says of a decimation."""

from __future__ import annotations

from typing import Any

import pytest
from printed_text import Printer

from clrecon.cli.console import Console
from clrecon.cli.mesh import describe_refinement, finish_with_gates

pytestmark = pytest.mark.unit


def told(**topology: int) -> str:
    numbers = {
        "euler_number_before": 1454, "euler_number_after": 1454, "components_before": 932, "components_lost": 0,
        "components_changed": 0,
    } | topology  # fmt: skip
    deviation: dict[str, Any] = {"hd95_mm": 0.1, "assd_mm": 0.05, "max_mm": 0.2, "volume_change_percent": None}
    found = {"fraction": 0.9, "reached": 0.8359, "ended_by": "bound", "max_deviation_mm": 0.175, "topology": numbers}
    return describe_refinement([{"refinement": {"decimate": found, "deviation": deviation, "voxel_mm": 0.7}}])[0]


def test_the_euler_number_is_said_before_and_after() -> None:
    start = "refined  83.6 % of the triangles removed; the error bound of 0.175 mm does not allow 90 %; "
    assert told() == start + "Euler number 1454 before and after"
    assert told(euler_number_after=1456, components_changed=1) == (
        start + "Euler number 1454 before, 1456 after (changed in 1 of 932 components)"
    )
    # Changes of two components can cancel out.
    assert "changed in 2 of 932 components" in told(components_changed=2)
    assert "changed in 0 of 932 components, 3 lost)" in told(components_lost=3, euler_number_after=1448)


@pytest.mark.parametrize(
    ("scan", "mesh", "strict", "code"),
    [
        (True, True, True, 0),
        (False, True, True, 7),
        (True, False, True, 8),
        (False, False, True, 8),
        (False, False, False, 0),
    ],
)
def test_a_gate_of_the_scan_and_one_of_the_mesh_have_codes_of_their_own(
    scan: bool, mesh: bool, strict: bool, code: int, printed: Printer
) -> None:
    gate = {"name": "closed", "measured": 1, "bound": 0, "unit": None, "text": "text"}
    uneven = {**gate, "name": "grid_residual", "ok": False}
    report = {
        "volume": {"gates": [{**gate, "name": "hu_scale", "ok": scan}, uneven]},
        "gates": [{**gate, "mesh": None, "ok": mesh}],
        "warnings": [],
    }
    assert finish_with_gates(report, Console(), strict) == code
    assert printed().error_lines == strict * ((not scan) + (not mesh))


@pytest.mark.parametrize(
    ("left", "expected"),
    [
        (0, "smoothed (1 iteration; roughness 0.200 to 0.050 mm)"),
        (1, "smoothed (1 iteration; roughness 0.200 to 0.050 mm; 1 component left unsmoothed to keep the volume)"),
        (
            1200,
            "smoothed (1 iteration; roughness 0.200 to 0.050 mm; 1,200 components left unsmoothed to keep the volume)",
        ),
    ],
)
def test_amount_of_smoothing_is_printed(left: int, expected: str) -> None:
    deviation: dict[str, Any] = {"hd95_mm": 0.1, "assd_mm": 0.05, "max_mm": 0.2, "volume_change_percent": None}
    found = {"iterations": 1, "components_left": left, "roughness_before_mm": 0.2, "roughness_after_mm": 0.05}
    line = describe_refinement([{"refinement": {"smooth": found, "deviation": deviation, "voxel_mm": 0.7}}])[0]
    assert line == f"refined  {expected}"
