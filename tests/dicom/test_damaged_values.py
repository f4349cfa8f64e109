"""Damaged series: each header element that can lie about values, and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from dicom_series import Plan
from value_series import (
    SHAPE,
    make_body,
    make_table,
    radius_from,
    write_values,
)

from clrecon import read_volume
from clrecon.cli.main import main

LUT = {"ModalityLUTSequence": make_table()}
TWELVE = Plan(shape=SHAPE, bits_stored=12, signed=False)


@dataclass
class Row:
    """A damage, the gates that fail of it, and words that name it."""

    values: dict
    gates: set[str]
    words: str
    plan: Plan | None = None
    hu: np.ndarray | None = None


def stated(gates, words, plan=None, hu=None, **values):
    return Row(values, set(gates.split()), words, plan, hu)


def make_padded():
    """The body in a round field of view, padded with the stored value -2000."""
    return np.where(radius_from() > 46, -3024.0, make_body())


UNDECLARED, MASKED = "padding that the files do not declare", "voxels with the HU of tissue"


ROWS = {
    "slope missing": stated("hu_known", "no RescaleSlope", RescaleSlope=None),
    "slope doubled": stated("hu_scale", "rescale slope seems to be wrong", RescaleSlope=2),
    "slope halved": stated("hu_scale", "rescale slope seems to be wrong", RescaleSlope=0.5),
    "slope with the wrong sign": stated("plausible_hu hu_scale", "RescaleSlope -1", RescaleSlope=-1),
    "slope and intercept of another scale": stated(
        "hu_scale", "rescale slope seems to be wrong", RescaleSlope=7, RescaleIntercept=-7168
    ),
    "slope of a thousand": stated("plausible_hu", "RescaleSlope 1000", RescaleSlope=1000),
    "slope of a ten-thousandth": stated("plausible_hu", "RescaleSlope 0.0001", RescaleSlope=0.0001),
    "intercept missing": stated("hu_known hu_scale", "intercept seems to be missing", RescaleIntercept=None),
    "intercept 0": stated("hu_scale", "intercept seems to be missing", RescaleIntercept=0),
    "intercept doubled": stated("hu_scale", "applied twice", RescaleIntercept=-2048),
    "intercept with the wrong sign": stated("plausible_hu", "lowest voxel 1024 HU", RescaleIntercept=1024),
    "intercept off by 324": stated("hu_scale", "HU too high", RescaleIntercept=-700),
    "intercept off by -324": stated("hu_scale", "HU too low", RescaleIntercept=-1348),
    "intercept a tenth": stated("hu_scale", "soft tissue near 9", RescaleIntercept=-102.4),
    "type of other values": stated("hu_known", "RescaleType is 'OD'", RescaleType="OD"),
    "table in place of slope": stated(
        "hu_known hu_scale", "Modality LUT Sequence (0028,3000)", RescaleSlope=None, **LUT, RescaleIntercept=None
    ),
    "table beside the slope": stated("hu_known", "Modality LUT Sequence (0028,3000)", **LUT),
    "sign lost": stated("stored_sign", "seem to be signed", Plan(shape=SHAPE, intercept=0), PixelRepresentation=0),
    "sign made up": stated("stored_sign", "dense bone or metal", TWELVE, PixelRepresentation=1),
    "padding missing": stated("", UNDECLARED, hu=make_padded()),
    "padding doubled": stated("", UNDECLARED, hu=make_padded(), PixelPaddingValue=-4000),
    "padding with the wrong sign": stated("", UNDECLARED, hu=make_padded(), PixelPaddingValue=2000),
    "padding with the value of muscle": stated("", MASKED, PixelPaddingValue=1074),
    "padding with the value of bone": stated("", MASKED, PixelPaddingValue=1274),
    "limit of the padding in tissue": stated(
        "", MASKED, hu=make_padded(), PixelPaddingValue=-2000, PixelPaddingRangeLimit=980
    ),
    "limit of the padding with the wrong sign": stated(
        "padding_share one_volume", MASKED, hu=make_padded(), PixelPaddingValue=-2000, PixelPaddingRangeLimit=2000
    ),
    "bits too few": stated("stored_bits", "beyond the 11 stored bits", TWELVE, BitsStored=11, HighBit=10),
}


def damage(folder, row):
    write_values(folder, make_body() if row.hu is None else row.hu, row.plan, **row.values)
    return folder


@pytest.mark.parametrize("name", ROWS)
def test_what_is_said_of_a_damage(tmp_path, name):
    row = ROWS[name]
    report = read_volume(damage(tmp_path, row)).report
    failed = {gate["name"] for gate in report["gates"] if gate["ok"] is False}
    assert failed == row.gates
    assert any(row.words in text for text in report["warnings"])


@pytest.mark.parametrize("name", ["intercept off by 324", "slope and intercept of another scale", "sign made up"])
def test_every_command_that_reads_says_it(tmp_path, device, capsys, name):
    row = ROWS[name]
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
def test_nothing_is_said_of_padding_around_the_picture(tmp_path, value, limit):
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
