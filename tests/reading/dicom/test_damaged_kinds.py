"""Damaged series of kinds of scan: cone beam, micro-CT, hand, legs, hip with metal, mouse; what is said of each."""

from __future__ import annotations

from pathlib import Path

import pytest
from damaged_kinds import BLANK, DAMAGES, KNOWN, REFUSED, SAID, SCALE, SLICES, WARNED, damage, list_damages, make_scan
from house import ROOT
from refusals import refused
from variants import daily_rows

import clrecon
from clrecon.errors import RefusedInputError

ROWS = [(name, kind) for name in DAMAGES for kind in SLICES]
EVERY_DAY = [
    ("intercept + 400", "jaw"),
    ("intercept + 1024", "jaw"),
    (BLANK, "jaw"),
    (BLANK, "mouse"),
    ("0.6 of the values + 400", "hand"),
]


@pytest.mark.parametrize(("name", "kind"), daily_rows(5, EVERY_DAY + [row for row in ROWS if row not in EVERY_DAY]))
def test_damaged_scan_of_every_kind_is_refused_or_fails_its_gates_as_listed(
    shared_folder: Path, tmp_path: Path, name: str, kind: str
) -> None:
    scan, _ = make_scan(shared_folder, kind)
    expected = SAID[name][list(SLICES).index(kind)]  # REFUSED, or gates and WARNED
    folder = damage(scan, tmp_path / "ct", name)
    if expected == REFUSED:
        with refused(RefusedInputError, "slice", "missing", 1):
            clrecon.read_volume(folder)
        return

    report = clrecon.read_volume(folder).report

    failed = {gate["name"] for gate in report["gates"] if gate["ok"] is False}
    assert failed == {gate for gate in (KNOWN, SCALE) if gate in expected}
    is_warned_of = any("show one value alone, no picture" in warning for warning in report["warnings"])
    assert is_warned_of == (WARNED in expected)
    if not expected and kind != "hip":  # whose metal is warned of
        assert report["warnings"] == []


def test_page_lists_the_damaged_kinds() -> None:
    assert list_damages() in (ROOT / "docs" / "calibration.md").read_text(encoding="utf-8")
