"""What the console says of a decimation."""

from __future__ import annotations

from typing import Any

import pytest
from printed_text import Printer

from clrecon.cli.console import Console
from clrecon.cli.mesh import describe_refinement, finish_with_gates

pytestmark = pytest.mark.unit


DEVIATION: dict[str, Any] = {"hd95_mm": 0.1, "assd_mm": 0.05, "max_mm": 0.2, "volume_change_percent": None}
UNCHANGED = {
    "euler_number_before": 1454, "euler_number_after": 1454, "components_before": 932, "components_lost": 0,
    "components_changed": 0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("topology", "words"),
    [
        pytest.param({}, "Euler number 1454 before and after", id="unchanged"),
        pytest.param(
            {"euler_number_after": 1456, "components_changed": 1},
            "Euler number 1454 before, 1456 after (changed in 1 of 932 components)",
            id="changed",
        ),
        pytest.param({"components_changed": 2}, "changed in 2 of 932 components", id="changes that cancel out"),
        pytest.param(
            {"components_lost": 3, "euler_number_after": 1448},
            "changed in 0 of 932 components, 3 lost)",
            id="components lost",
        ),
    ],
)
def test_words_of_decimation_have_the_euler_number_before_and_after(topology: dict[str, int], words: str) -> None:
    decimate = {
        "fraction": 0.9, "reached": 0.8359, "ended_by": "bound", "max_deviation_mm": 0.175,
        "topology": UNCHANGED | topology,
    }  # fmt: skip
    refinement = {"decimate": decimate, "deviation": DEVIATION, "voxel_mm": 0.7}
    line, *_ = describe_refinement([{"refinement": refinement}])
    assert line.startswith(
        "refined  83.6 % of the triangles removed; the error bound of 0.175 mm does not allow 90 %; "
    )
    assert words in line


@pytest.mark.parametrize(
    ("scan_passes", "mesh_passes", "strict", "error_lines"),
    [
        pytest.param(True, True, True, 0, id="both pass"),
        pytest.param(False, True, True, 1, id="that of the scan fails"),
        pytest.param(True, False, True, 1, id="that of the mesh fails"),
        pytest.param(False, False, True, 2, id="both fail"),
        pytest.param(False, False, False, 0, id="both fail, not strict"),
    ],
)
def test_each_failed_gate_of_scan_and_mesh_is_a_line_of_errors_with_strict(
    scan_passes: bool, mesh_passes: bool, strict: bool, error_lines: int, printed: Printer
) -> None:
    gate = {"name": "closed", "measured": 1, "bound": 0, "unit": None, "text": "text"}
    never_an_error = {**gate, "name": "grid_residual", "ok": False}
    report = {
        "volume": {"gates": [{**gate, "name": "hu_scale", "ok": scan_passes}, never_an_error]},
        "gates": [{**gate, "mesh": None, "ok": mesh_passes}],
        "warnings": [],
    }

    finish_with_gates(report, Console(), strict)

    assert printed().error_lines == error_lines


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
def test_words_of_smoothing_have_iterations_roughness_and_components_left_out(left: int, expected: str) -> None:
    smooth = {"iterations": 1, "components_left": left, "roughness_before_mm": 0.2, "roughness_after_mm": 0.05}
    line, *_ = describe_refinement([{"refinement": {"smooth": smooth, "deviation": DEVIATION, "voxel_mm": 0.7}}])
    assert line == f"refined  {expected}"
