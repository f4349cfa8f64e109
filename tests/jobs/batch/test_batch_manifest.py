"""Manifests of ``clrecon batch``: what a table or a folder names, and tables that are refused before any work."""

from __future__ import annotations

import sys
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
from ct_files import write_series
from refusals import refused

from clrecon.cli.main import main
from clrecon.errors import DeviceError, NoDicomError, UsageError
from clrecon.jobs.batch.plan import BatchSettings, Case, Plan, check_places, make_key, read_cases
from clrecon.jobs.mesh.settings import LabelChoice, MeshSettings
from clrecon.opencl import list_devices
from clrecon.system.options import options_of

PLAN = Plan(output="out")


def read_table(folder: Path, text: str) -> list[Case]:
    path = folder / "cohort.csv"
    path.write_bytes(text.encode())
    return read_cases(path, PLAN)


def test_paths_of_a_table_start_at_its_folder_and_further_columns_may_be_empty(tmp_path: Path) -> None:
    cases = read_table(tmp_path, "\ufeffinput, case ,labels,series\r\nct/a,P-1,,\r\n\r\n/abs/b , p.2,l.nii,7\r\n")
    assert cases == [
        Case("P-1", source=str(tmp_path / "ct/a")),
        Case("p.2", source="/abs/b", labels=str(tmp_path / "l.nii"), cells=(("series", "7"),)),
    ]


def test_table_with_semicolons_as_excel_writes_it_in_many_countries_is_read(tmp_path: Path) -> None:
    cases = read_table(tmp_path, "\ufeffcase;input;series\r\nP-1;/ct/a,b;7\r\n")
    assert cases == [Case("P-1", source="/ct/a,b", cells=(("series", "7"),))]


def read_settings(folder: Path, column: str, cell: str, **given: Any) -> MeshSettings:
    """Return the settings of the one case of a manifest with this column, beside the options of the command."""
    plan = Plan(output="out", given=given)
    (folder / "cohort.csv").write_text(f'case,input,labels,{column}\na,ct,map.nii,"{cell}"\n')
    (case,) = read_cases(folder / "cohort.csv", plan)
    return plan.settings_of(case)


CELLS: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "hu": ("300", 300.0, {"keep_largest": 2}),
    "--Keep_Largest": ("1", 1, {"keep_largest": 2}),
    "keep-largest": ("", 2, {"keep_largest": 2}),
    "open": ("yes", False, {}),
    "remove-table": ("no", False, {"remove_table": True}),
    "smooth": ("yes", 20, {}),
    "fov": ("90", 90.0, {}),
    "seed": ("1,2,3 | -4,5,6", ((1.0, 2.0, 3.0), (-4.0, 5.0, 6.0)), {}),
    "series": ("7", "7", {"series": "3"}),
}
"""Cells of columns, the value of the option, and what the command has beside: a cell wins, an empty one does not."""


@pytest.mark.parametrize("column", CELLS)
def test_cell_of_a_column_is_the_option_of_its_case(column: str, tmp_path: Path) -> None:
    cell, expected, given = CELLS[column]
    field = {"hu": "levels", "open": "closed", "fov": "field_of_view", "seed": "seeds"}.get(
        column, column.strip("-").lower().replace("-", "_")
    )
    value = getattr(read_settings(tmp_path, column, cell, **given), field)
    assert value == ((expected,) if column == "hu" else expected)


def test_labels_of_a_cell_are_those_of_its_map(tmp_path: Path) -> None:
    labels = read_settings(tmp_path, "label", "T12|L1").labels
    assert labels is not None
    assert (labels.path, labels.label) == (str(tmp_path / "map.nii"), ("T12", "L1"))


def test_level_of_a_cell_takes_the_place_of_the_preset_of_the_command(tmp_path: Path) -> None:
    settings = read_settings(tmp_path, "hu", "300", preset="skin")
    assert (settings.levels, settings.preset) == ((300.0,), None)


def test_each_option_of_the_meshes_is_a_column_but_those_of_the_machine(tmp_path: Path) -> None:
    options = {own.flags[0] for kind in (MeshSettings, LabelChoice) for own in options_of(kind, None)}
    columns = options - {"--device", "--memory", "--scheduler", "--labels"}
    assert len(columns) > 40  # 46
    assert len(read_table(tmp_path, f"case,input,{','.join(columns)}\na,ct{',' * len(columns)}\n")) == 1


def test_outputs_of_a_cell_are_those_of_its_case_alone(tmp_path: Path) -> None:
    first, second = read_table(tmp_path, "case,input,no-picture,format\na,ct,yes,ply\nb,ct,,\n")
    assert (PLAN.outputs_of(first).picture, PLAN.outputs_of(first).format) == (False, ".ply")
    assert PLAN.outputs_of(second) == PLAN.batch


def test_key_of_a_case_is_the_same_for_an_option_of_the_command_and_a_cell_of_this_value(tmp_path: Path) -> None:
    (tmp_path / "ct").touch()
    with_cell, with_another, without = read_table(tmp_path, "case,input,hu\na,ct,300\nb,ct,310\nc,ct,\n")
    command = Plan(output="out", given={"iso_value": {"iso_value": (300.0,)}})
    assert make_key(with_cell, PLAN) == make_key(without, command) != make_key(with_another, PLAN)


def test_key_of_a_case_changes_with_the_file_of_its_region_which_lies_beside_the_manifest(tmp_path: Path) -> None:
    (tmp_path / "ct").touch()
    (tmp_path / "mask.nii").write_text("one")
    (case,) = read_table(tmp_path, 'case,input,region\na,ct,"hu:100,900 | mask:mask.nii"\n')
    before = make_key(case, PLAN)
    (tmp_path / "mask.nii").write_text("another")
    assert make_key(case, PLAN) != before


BAD_TABLES = {
    "a misspelt option": ("case,input,age,keep_largst\na,b,1,2\n", ("keep_largst", "keep-largest")),
    "an option of the batch": ("case,input,workers\na,b,1\n", ("workers", "batch")),
    "a column of the table": ("case,input,area_mm2\na,b,1\n", ("area_mm2", "cohort.csv", "rename")),
    "a column without a name": ("case,input,\na,b,1\n", ("name",)),
    "a column in two spellings": ("case,input,keep_largest,keep-largest\na,x,1,1\n", ("keep-largest", "twice")),
    "no number": ("case,input,hu\na,x,300\nb,x,bone\n", (3, "hu", "bone")),
    "no whole number": ("case,input,keep_largest\na,x,1.5\n", (2, "keep-largest", "1.5")),
    "neither yes nor no": ("case,input,no-picture\na,x,maybe\n", (2, "no-picture", "yes")),
    "a view that is none": ("case,input,view\na,x,top\n", (2, "view", "top")),
    "options that cannot be together": ("case,input,hu,preset\na,x,,\nb,x,300,skin\n", (3, "preset")),
    "a label without a map": ("case,input,label\na,x,L3\n", (2, "label")),
    "a region that is none": ("case,input,region\na,x,hu:3\n", (2, "hu:3")),
    "no column of inputs": ("case,series\na,b\n", ("input",)),
    "a column twice": ("case,input,case\na,b,c\n", ("twice",)),
    "one case twice": ("case,input\nP-1,x\nb,x\nP-1,y\n", (2, 4, "P-1")),
    "cases that differ in capitals": ("case,input\nScan,x\nscan,y\n", (2, 3)),
    "too few cells": ("case,input\na,x\nb\n", (3, 1, 2)),
    "too many cells": ("case,input\na,x,y\n", (2, 3)),
    "no input": ("case,input\nP-1,\n", (2, "P-1")),
    "a case without a name": ("case,input\n,x\n", (2,)),
    "a way out of the output": ("case,input\n../a,x\n", (2,)),
    "a hidden folder": ("case,input\n.a,x\n", (2,)),
    "the name of the table": ("case,input\ncohort.csv,x\n", (2, "cohort.csv")),
    "a name too long": (f"case,input\n{'a' * 101},x\n", (2, 100)),
    "an open quote": ('case,input\n"a,x\n', ("manifest",)),
    "no case": ("case,input\n\n", ("case",)),
    "nothing": ("", ("case", "input")),
}


@pytest.mark.parametrize("table", BAD_TABLES)
def test_bad_table_is_refused_with_what_is_wrong_and_where(table: str, tmp_path: Path) -> None:
    text, facts = BAD_TABLES[table]
    with refused(UsageError, *facts):
        read_table(tmp_path, text)


@pytest.mark.parametrize("content", [b"case,input\n\xff,x\n", b"\0" * 200, None], ids=["Latin-1", "zeros", "no file"])
def test_manifest_that_is_no_text_or_missing_is_refused_with_its_name(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "scan.csv"
    if content is not None:
        path.write_bytes(content)
    with refused(UsageError, "scan.csv"):
        read_cases(path, PLAN)


def test_manifest_in_utf_16_is_refused_with_the_encoding_to_save_it_in(tmp_path: Path) -> None:
    (tmp_path / "cohort.csv").write_text("case,input\na,x\n", encoding="utf-16")
    with refused(UsageError, "cohort.csv", "save", "UTF-8"):
        read_cases(tmp_path / "cohort.csv", PLAN)


def test_unknown_format_of_meshes_is_refused_with_the_parameter_that_names_it() -> None:
    with refused(UsageError, "format", "xyz", "stl"):
        BatchSettings(format=".xyz")


def test_index_of_no_device_is_refused_with_the_parameter_that_names_it() -> None:
    with refused(DeviceError, "devices", 99):
        BatchSettings(devices="99").deal_devices()


@pytest.mark.seconds
def test_manifest_of_a_hundred_thousand_rows_is_read_in_less_than_100_mb(tmp_path: Path) -> None:
    text = "case,input,hu\n" + "".join(f"case-{number},/data/ct/{number},300\n" for number in range(100_000))
    tracemalloc.start()
    cases = read_table(tmp_path, text)
    check_places(cases, tmp_path / "out")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(cases) == 100_000 and cases[-1].name == "case-99999"
    assert peak < 100e6  # measured 34e6: 340 bytes a row


def test_manifest_in_parquet_names_the_cases_of_the_same_table_in_csv(tmp_path: Path) -> None:
    pyarrow, parquet = (pytest.importorskip(name) for name in ("pyarrow", "pyarrow.parquet"))
    columns = {"case": ["P-1", "P-2"], "input": ["ct/a", "ct/b"], "series": [None, 7]}
    parquet.write_table(pyarrow.table(columns), tmp_path / "cohort.parquet")
    expected = read_table(tmp_path, "case,input,series\nP-1,ct/a,\nP-2,ct/b,7\n")
    assert read_cases(tmp_path / "cohort.parquet", PLAN) == expected


def test_manifest_in_parquet_without_pyarrow_is_refused_with_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    (tmp_path / "cohort.parquet").write_bytes(b"PAR1")
    with refused(UsageError, "pyarrow", "install"):
        read_cases(tmp_path / "cohort.parquet", PLAN)


def test_all_devices_are_those_without_simulators_and_shortcomings_one_for_each_worker() -> None:
    usable = [str(own.index) for own in list_devices() if not (own.is_simulator or own.shortcoming)]
    assert BatchSettings(devices="all").deal_devices() == usable
    assert BatchSettings(devices="all", workers=1).deal_devices() == usable[:1]


def test_each_stack_of_a_folder_is_a_case_named_by_its_number(tmp_path: Path) -> None:
    write_series(tmp_path / "Jolanthe" / "first", number=1)
    write_series(tmp_path / "Jolanthe" / "second", number=2)
    write_series(tmp_path / "other", number=3, modality="MR")
    cases = read_cases(tmp_path, PLAN)
    assert [case.name for case in cases] == ["series-001", "series-002"]
    assert [Path(case.source).name for case in cases] == ["first", "second"]


def test_folder_without_stacks_is_refused_and_the_columns_of_manifests_are_named(tmp_path: Path) -> None:
    write_series(tmp_path, modality="MR")
    with refused(NoDicomError, "case", "input", "labels"):
        read_cases(tmp_path, PLAN)


def test_folder_of_zarr_is_refused_as_a_manifest_and_the_columns_of_manifests_are_named(tmp_path: Path) -> None:
    (tmp_path / "zarr.json").write_text("{}")
    with refused(NoDicomError, "case", "input", "labels"):
        read_cases(tmp_path, PLAN)


@pytest.mark.parametrize("output", ["ct/out", "."], ids=["within the input", "around the input"])
def test_output_within_or_about_an_input_is_refused(output: str, tmp_path: Path) -> None:
    (tmp_path / "ct").mkdir()
    case = Case("P-1", source=str(tmp_path / "ct"))
    with refused(UsageError, "P-1"):
        check_places([case], tmp_path / output)


def test_folder_of_a_case_with_other_files_is_refused_and_stays(tmp_path: Path, printed: Any) -> None:
    thesis = tmp_path / "out" / "a" / "thesis.txt"
    thesis.parent.mkdir(parents=True)
    thesis.write_text("years of work")
    (tmp_path / "m.csv").write_text("case,input\na,ct\n")
    assert main(["batch", str(tmp_path / "m.csv"), "-o", str(tmp_path / "out")]) == 3
    assert printed().error_lines == 1
    assert thesis.read_text() == "years of work"


WRONG_OPTIONS = {
    "part beyond the last": (["--part", "3/2"], 3, "3/2"),
    "part from zero": (["--part", "0/2"], 3, "0/2"),
    "no worker": (["--workers", "0"], 3, "0"),
    "format unknown": (["--format", "xyz"], 3, ".stl"),
    "two ways with earlier cases": (["--resume", "--retry"], 3, "--retry"),
    "status unknown": (["--retry", "refuse"], 3, "refused"),
    "collect a part": (["--collect", "--part", "1/2"], 3, "--part"),
    "devices and a device": (["--devices", "0,1", "--device", "cpu"], 3, "--device"),
    "devices by name": (["--devices", "cpu"], 3, "cpu"),
    "labels of meshes without a map": (["--label", "L3"], 3, "--label"),
    "nothing to collect": (["--collect"], 3, "out"),
    "level that is no number": (["--hu", "bone"], 3, "bone"),
    "no folder around the output": (["-o", "nowhere/out"], 6, "nowhere"),
}


@pytest.mark.parametrize("name", WRONG_OPTIONS)
def test_wrong_option_is_refused_before_any_work(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Any
) -> None:
    options, code, fact = WRONG_OPTIONS[name]
    monkeypatch.chdir(tmp_path)
    Path("m.csv").write_text("case,input\na,ct\n")
    assert main(["batch", "m.csv", "-o", "out", *options]) == code
    said = printed()
    said.assert_error(fact)
    assert said.error_lines == 1
    assert [path.name for path in tmp_path.iterdir()] == ["m.csv"]
