"""Damaged series: each header element that can lie about values, and what is said of it."""

from __future__ import annotations

import numpy as np
import pytest
from damaged_series import MASKED, VALUES
from value_series import make_body, radius_from, write_values
from variants import daily

from clrecon import read_volume
from clrecon.cli.main import main


def damage(folder, row):
    write_values(folder, make_body() if row.hu is None else row.hu, row.plan, **row.values)
    return folder


@pytest.mark.parametrize("name", VALUES)
def test_damaged_values_fail_their_gates_with_words(tmp_path, name):
    row = VALUES[name]
    report = read_volume(damage(tmp_path, row)).report
    failed = {gate["name"] for gate in report["gates"] if gate["ok"] is False}
    assert failed == row.gates
    assert any(row.words in text for text in report["warnings"])


@pytest.mark.parametrize(
    "name",
    daily(1, ["intercept off by 324", "slope and intercept of another scale", "unsigned values declared signed"]),
)
def test_every_command_tells_damaged_values(tmp_path, device, capsys, name):
    row = VALUES[name]
    folder = str(damage(tmp_path / "ct", row))
    (gate,) = row.gates
    assert main(["info", folder, "--pixels"]) == 0
    assert f"FAILED     {gate}: " in capsys.readouterr().out
    assert main(["info", folder, "--pixels", "--strict"]) == 4
    assert f"{gate}: " in capsys.readouterr().err
    mesh = ["mesh", folder, "-o", str(tmp_path / "a.ply"), "--hu", "300", "--device", str(device.index)]
    assert main(mesh) == 0
    assert row.words in capsys.readouterr().err
    assert main([*mesh, "--strict"]) == 7
    assert f"gate {gate} failed" in capsys.readouterr().err
    assert f"comment CERTIFICATE gate_failed {gate}: ".encode() in (tmp_path / "a.ply").read_bytes()


@pytest.mark.parametrize(("value", "limit"), [(-2000, None), (-2000, 24), (1074, None), (1074, 1075)])
def test_padding_around_the_picture_is_not_warned_of(tmp_path, value, limit):
    """Below air, up to air, and with a value of tissue that nothing in the picture has."""
    body = make_body()
    body[np.isin(body, (50, 51))] = 52
    hu = np.where(radius_from() > 46, value - 1024, body)
    elements = {"PixelPaddingValue": value, **({} if limit is None else {"PixelPaddingRangeLimit": limit})}
    report = read_volume(write_values(tmp_path, hu, **elements)).report
    assert report["warnings"] == [] and report["padding_share"] > 0.2


def test_masked_tissue_is_counted_exactly(tmp_path):
    body = make_body()
    folder = write_values(tmp_path, body, PixelPaddingValue=1074)
    assert read_volume(folder).report["warnings"][0].startswith(f"{np.count_nonzero(body == 50):,} {MASKED}")
