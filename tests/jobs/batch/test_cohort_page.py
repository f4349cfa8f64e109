"""Table and page of a cohort: rows in the order of the manifest, outliers marked, escaped, offline, sortable."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import open_browser, outside_requests, severe_lines
from html_check import PageCheck

from clrecon.cli.main import main

VOLUMES_ML = {
    "case-10": 101.0, "case-9": 99.5, "case-8": 100.2, "case-7": 98.7, "case-6": 1500.0, "case-5": 100.9,
    "case-4": 102.3, "case-3": 99.1, "case-2": 97.8,
}  # fmt: skip
SOME_CASES_NOT_DONE = 8
"""The exit code, see docs/contract.md."""


def make_report(name: str, volume_ml: float, gates: list[dict[str, Any]]) -> dict[str, Any]:
    mesh = {
        "iso_value_hu": 200.0, "triangles": 1000, "components": 1, "area_mm2": 10.0 * volume_ml, "volume_ml": volume_ml,
        "closed": True, "meshes": [{}], "gates": gates,
    }  # fmt: skip
    volume = {"slices": 40, "spacing_mm": [1.0, 1.0, 2.5], "tilt_deg": 0.0, "gates": []}
    shared = {"warnings": [], "seconds": {"total": 1.5}, "peak_memory_bytes": None, "device": "a device"}
    case = {"case": name, "status": "done", "error": None, "key": "0", "files": []}
    return case | shared | {"mesh": mesh, "volume": volume}


@pytest.fixture
def output(tmp_path: Path) -> Path:
    """The cases of VOLUMES_ML, of which that of 1500 ml fails a gate, and one hostile and one that is not there."""
    output = tmp_path / "out"
    for name, volume_ml in VOLUMES_ML.items():
        gates = [{"name": "manifold", "ok": volume_ml < 1000.0}, {"name": "closed", "ok": None}]
        (output / name).mkdir(parents=True)
        (output / name / "case.json").write_text(json.dumps(make_report(name, volume_ml, gates)))
    failed = {"status": "failed", "error": {"kind": "<script>alert(1)</script>"}, "mesh": None, "volume": None}
    (output / "hostile").mkdir()
    (output / "hostile" / "case.json").write_text(json.dumps(make_report("hostile", volume_ml=1.0, gates=[]) | failed))
    rows = "".join(f"{name},ct\n" for name in (*VOLUMES_ML, "hostile", "gone"))
    (tmp_path / "m.csv").write_text(f"case,input\n{rows}")
    assert main(["batch", str(tmp_path / "m.csv"), "-o", str(output), "--collect", "-q"]) == SOME_CASES_NOT_DONE
    return output


def read_rows(output: Path) -> dict[str, dict[str, str]]:
    with (output / "cohort.csv").open(newline="") as stream:
        return {row["case"]: row for row in csv.DictReader(stream)}


def test_case_with_fifteen_times_the_volume_of_the_others_is_an_outlier_in_the_table(output: Path) -> None:
    outliers = {name: row["outliers"] for name, row in read_rows(output).items() if row["outliers"]}
    assert outliers == {"case-6": "area_mm2 volume_ml"}  # 1500 ml among some 100 ml


def test_table_lists_cases_in_the_order_of_the_manifest_with_failed_gates_and_missing_ones(output: Path) -> None:
    rows = read_rows(output)

    assert [*rows] == [*VOLUMES_ML, "hostile", "gone"]
    assert {name: row["gates_failed"] for name, row in rows.items() if row["gates_failed"]} == {"case-6": "manifold"}
    assert (rows["hostile"]["status"], rows["gone"]["status"]) == ("failed", "missing")


def test_page_of_a_cohort_is_sound_html_with_a_row_for_each_case(output: Path) -> None:
    page = PageCheck((output / "cohort.html").read_text(encoding="utf-8"))

    assert [fault for fault in page.faults if not fault.endswith("/case.json>")] == []  # the files beside it
    (rows,) = page.tables
    heading, missing_and_hostile = 1, 2
    assert len(rows) == heading + len(VOLUMES_ML) + missing_and_hostile


def test_page_of_a_cohort_marks_the_figures_of_an_outlier(output: Path) -> None:
    text = (output / "cohort.html").read_text(encoding="utf-8")
    assert text.count('class="far"') == 2  # area and volume of case-6


def test_page_of_a_cohort_shows_script_in_a_report_as_text(output: Path) -> None:
    text = (output / "cohort.html").read_text(encoding="utf-8")
    assert "<script>alert" not in text
    assert "&lt;script&gt;alert" in text


@pytest.fixture
def page_driver(output: Path) -> Iterator[Any]:
    """A browser that shows the page of the cohort."""
    with open_browser() as driver:
        driver.get((output / "cohort.html").as_uri())
        yield driver


def click_on(driver: Any, heading: str) -> list[str]:
    """Click on the heading of a column; return the names of the cases from top to bottom."""
    driver.execute_script(
        "[...document.querySelectorAll('thead button')].find(b => b.textContent === arguments[0]).click()", heading
    )
    return driver.execute_script("return [...document.querySelector('tbody').rows].map(r => r.cells[1].textContent)")


def test_click_on_the_heading_of_cases_sorts_their_numbers_as_numbers(page_driver: Any) -> None:
    assert click_on(page_driver, "case")[:3] == ["case-2", "case-3", "case-4"]  # as text case-10 comes first


def test_clicks_on_the_heading_of_volumes_sort_them_upwards_then_downwards_with_cases_without_one_last(
    page_driver: Any,
) -> None:
    rising, falling = click_on(page_driver, "volume, ml"), click_on(page_driver, "volume, ml")

    upwards = sorted(VOLUMES_ML, key=lambda name: VOLUMES_ML[name])
    without_volume = {"hostile", "gone"}
    assert rising[:-2] == upwards and {*rising[-2:]} == without_volume
    assert falling[:-2] == upwards[::-1] and {*falling[-2:]} == without_volume


def test_page_of_a_cohort_loads_nothing_from_outside_and_has_no_faults_in_the_console(page_driver: Any) -> None:
    click_on(page_driver, "case")
    assert outside_requests(page_driver) == []
    assert severe_lines(page_driver) == []


@pytest.fixture
def carried(tmp_path: Path) -> Path:
    """A cohort whose manifest has an age, words with tags and quotes, and cells that spreadsheets would run."""
    output = tmp_path / "out"
    (output / "b").mkdir(parents=True)
    (output / "b" / "case.json").write_text(json.dumps(make_report("b", volume_ml=100.0, gates=[])))
    rows = ['b,ct,63,"<b>x</b>, ""y""",=1+1', "gone,ct,-5,Ö,+4917", "last,ct,,@a,-2.5e3"]
    (tmp_path / "m.csv").write_text("\n".join(["case,input,Age,my_Group,=note", *rows]), encoding="utf-8")
    assert main(["batch", str(tmp_path / "m.csv"), "-o", str(output), "--collect", "-q"]) == SOME_CASES_NOT_DONE
    return output


def test_other_columns_of_the_manifest_are_carried_into_the_table(carried: Path) -> None:
    rows = read_rows(carried)
    assert list(rows["b"])[-3:-1] == ["Age", "my_Group"]
    assert [(row["Age"], row["my_Group"]) for row in rows.values()] == [
        ("63", '<b>x</b>, "y"'), ("-5", "Ö"), ("", "'@a"),
    ]  # fmt: skip
    assert float(rows["b"]["volume_ml"]) == 100.0


def test_cells_that_spreadsheets_would_run_as_formulas_become_text(carried: Path) -> None:
    rows = read_rows(carried)
    assert list(rows["b"])[-1] == "'=note"
    assert [row["'=note"] for row in rows.values()] == ["'=1+1", "+4917", "-2.5e3"]  # signed numbers stay


def test_carried_cells_are_escaped_on_the_page(carried: Path) -> None:
    page = (carried / "cohort.html").read_text(encoding="utf-8")
    PageCheck(page)
    assert "<b>x</b>" not in page
    assert "<td>&lt;b&gt;x&lt;/b&gt;, &quot;y&quot;</td>" in page
    assert "<th>my_Group</th>" in page
