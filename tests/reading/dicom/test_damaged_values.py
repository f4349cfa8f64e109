"""Damaged series: each header element that can lie about values, and what is said of it."""

from __future__ import annotations

import numpy as np
import pytest
from damaged_series import MASKED, VALUES
from value_series import make_body, radius_from, write_values
from variants import daily

from clrecon import read_volume
from clrecon.cli.main import main
from clrecon.errors import RefusedInputError
from clrecon.jobs.mesh.settings import SCAN_GATE_FAILED


def write_damaged(folder, row):
    """A series with the HU, the plan and the elements of a row."""
    write_values(folder, make_body() if row.hu is None else row.hu, row.plan, **row.values)
    return folder


@pytest.mark.parametrize("name", VALUES)
def test_damaged_values_fail_the_gates_of_their_row_with_a_warning(tmp_path, name):
    row = VALUES[name]
    report = read_volume(write_damaged(tmp_path, row)).report
    assert {gate["name"] for gate in report["gates"] if gate["ok"] is False} == row.gates
    assert any(row.words in warning for warning in report["warnings"])


ONE_GATE = daily(1, ["intercept off by 324", "slope and intercept of another scale", "unsigned values declared signed"])
"""Rows of VALUES that fail one gate."""


@pytest.fixture(params=ONE_GATE)
def damaged_folder(request, tmp_path):
    """A damaged series, the name of the gate that it fails, and words of its warning."""
    row = VALUES[request.param]
    (gate,) = row.gates
    return str(write_damaged(tmp_path / "ct", row)), gate, row.words


def test_command_info_shows_the_gate_that_damaged_values_fail(damaged_folder, printed):
    folder, gate, _ = damaged_folder
    assert main(["info", folder, "--pixels"]) == 0
    printed().assert_output("FAILED", gate)


def test_command_info_refuses_damaged_values_with_strict(damaged_folder, printed):
    folder, gate, _ = damaged_folder
    assert main(["info", folder, "--pixels", "--strict"]) == RefusedInputError.exit_code
    printed().assert_error(gate)


def test_command_mesh_warns_of_damaged_values_and_writes_the_failed_gate_into_the_mesh(
    damaged_folder, tmp_path, device, capsys
):
    folder, gate, words = damaged_folder
    output = tmp_path / "a.ply"
    assert main(["mesh", folder, "-o", str(output), "--hu", "300", "--device", str(device.index)]) == 0
    assert words in capsys.readouterr().err
    assert f"comment CERTIFICATE gate_failed {gate}: ".encode() in output.read_bytes()


def test_command_mesh_fails_for_damaged_values_with_strict(damaged_folder, tmp_path, device, printed):
    folder, gate, _ = damaged_folder
    mesh = ["mesh", folder, "-o", str(tmp_path / "a.ply"), "--hu", "300", "--device", str(device.index)]
    assert main([*mesh, "--strict"]) == SCAN_GATE_FAILED
    printed().assert_error("gate", gate, "failed")


@pytest.mark.parametrize(
    ("stored_padding", "limit"),
    [
        pytest.param(-2000, None, id="below air"),
        pytest.param(-2000, 24, id="from below air up to air"),
        pytest.param(1074, None, id="tissue of 50 HU"),
        pytest.param(1074, 1075, id="tissue of 50 and 51 HU"),
    ],
)
def test_declared_padding_around_the_picture_is_not_warned_of(tmp_path, stored_padding, limit):
    body = make_body()
    body[np.isin(body, (50, 51))] = 52  # no voxel of the picture has a value of tissue that is padding
    hu = np.where(radius_from() > 46, stored_padding - 1024, body)
    elements = {"PixelPaddingValue": stored_padding, **({} if limit is None else {"PixelPaddingRangeLimit": limit})}
    report = read_volume(write_values(tmp_path, hu, **elements)).report
    assert report["warnings"] == []
    assert report["padding_share"] > 0.2  # around a circle of 46 pixels in a square of 96


def test_tissue_that_declared_padding_masks_is_warned_of_with_its_voxels(tmp_path):
    body = make_body()
    folder = write_values(tmp_path, body, PixelPaddingValue=1074)  # 50 HU
    assert read_volume(folder).report["warnings"][0].startswith(f"{np.count_nonzero(body == 50):,} {MASKED}")
