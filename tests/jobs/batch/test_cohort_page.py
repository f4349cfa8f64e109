"""Table and page of a cohort: rows in the order of the manifest, outliers marked, escaped, offline, sortable."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from browser import open_browser, outside_requests, severe_lines
from html_check import PageCheck

from clrecon.cli.main import main

VOLUMES = [101.0, 99.5, 100.2, 98.7, 1500.0, 100.9, 102.3, 99.1, 97.8]


def make_report(name: str, volume_ml: float, gates: list[dict[str, Any]]) -> dict[str, Any]:
    mesh = {
        "iso_value_hu": 200.0, "triangles": 1000, "components": 1, "area_mm2": 10.0 * volume_ml, "volume_ml": volume_ml,
        "closed": True, "meshes": [{}], "gates": gates,
    }  # fmt: skip
    volume = {"slices": 40, "spacing_mm": [1.0, 1.0, 2.5], "tilt_deg": 0.0, "gates": []}
    shared = {"warnings": [], "seconds": {"total": 1.5}, "peak_memory_bytes": None, "device": "a device"}
    return {
        "case": name,
        "status": "done",
        "error": None,
        "key": "0",
        "files": [],
        "mesh": mesh,
        "volume": volume,
    } | shared


@pytest.fixture
def output(tmp_path: Path) -> Path:
    """A cohort of nine cases, of which one is far from the others and fails a gate, one hostile and one not there."""
    output = tmp_path / "out"
    names = [f"case-{10 - number}" for number in range(len(VOLUMES))]
    for name, volume_ml in zip(names, VOLUMES, strict=True):
        gates = [{"name": "manifold", "ok": volume_ml < 1000.0}, {"name": "closed", "ok": None}]
        (output / name).mkdir(parents=True)
        (output / name / "case.json").write_text(json.dumps(make_report(name, volume_ml, gates)))
    failed = {"status": "failed", "error": {"kind": "<script>alert(1)</script>"}, "mesh": None, "volume": None}
    (output / "hostile").mkdir()
    (output / "hostile" / "case.json").write_text(json.dumps(make_report("hostile", 1.0, []) | failed))
    rows = "".join(f"{name},ct\n" for name in (*names, "hostile", "gone"))
    (tmp_path / "m.csv").write_text(f"case,input\n{rows}")
    assert main(["batch", str(tmp_path / "m.csv"), "-o", str(output), "--collect", "-q"]) == 8
    return output


def test_outlier_among_nine_cases_is_named_in_the_table(output: Path) -> None:
    with (output / "cohort.csv").open(newline="") as stream:
        rows = {row["case"]: row for row in csv.DictReader(stream)}
    assert [*rows][0] == "case-10" and [*rows][-2:] == ["hostile", "gone"]
    far = {name: row["outliers"] for name, row in rows.items() if row["outliers"]}
    assert far == {"case-6": "area_mm2 volume_ml"}
    assert rows["case-6"]["gates_failed"] == "manifold" and rows["gone"]["status"] == "missing"


def test_page_is_whole_marks_what_is_far_and_runs_no_words_of_a_report(output: Path) -> None:
    text = (output / "cohort.html").read_text(encoding="utf-8")
    page = PageCheck(text)
    assert [fault for fault in page.faults if not fault.endswith("/case.json>")] == []  # the files beside it
    (rows,) = page.tables
    assert len(rows) == 1 + len(VOLUMES) + 2
    assert text.count('class="far"') == 2
    assert "<script>alert" not in text and "&lt;script&gt;alert" in text


def test_page_sorts_by_a_click_and_asks_nobody(output: Path) -> None:
    with open_browser() as driver:
        driver.get((output / "cohort.html").as_uri())

        def click_on(heading: str) -> list[str]:
            driver.execute_script(
                "[...document.querySelectorAll('thead button')].find(b => b.textContent === arguments[0]).click()",
                heading,
            )
            return driver.execute_script(
                "return [...document.querySelector('tbody').rows].map(r => r.cells[1].textContent)"
            )

        assert click_on("case")[:2] == ["case-2", "case-3"] and click_on("case")[0] == "hostile"
        rising, falling = click_on("volume, ml"), click_on("volume, ml")
        assert (rising[0], rising[8], falling[0]) == ("case-2", "case-6", "case-6")
        assert {*rising[-2:]} == {*falling[-2:]} == {"hostile", "gone"}
        assert outside_requests(driver) == [] and severe_lines(driver) == []
