"""Cases of a batch whose input is a URL: what a manifest may name, and what a second run asks of the server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from ct_files import write_series
from refusals import refused
from web_servers import Archive, running

from clrecon.errors import UsageError
from clrecon.jobs.batch.case import Answer, make_case
from clrecon.jobs.batch.plan import BatchSettings, Case, Plan, check_places, make_key, read_cases

URL = "dicomweb+https://pacs.example/studies/1.2/series/3.4"


def read_table(folder: Path, *rows: str, columns: str = "case,input") -> list[Case]:
    """Read the cases of a manifest with these lines."""
    (folder / "m.csv").write_text("\n".join([columns, *rows]))
    return read_cases(folder / "m.csv", Plan(output="out"))


def test_url_of_a_manifest_stays_as_it_is_beside_a_path(tmp_path: Path) -> None:
    cases = read_table(tmp_path, f"a,{URL}", "b,ct")

    assert [case.source for case in cases] == [URL, str(tmp_path / "ct")]


WRONG_ROWS = {
    "password": ("case,input", "b,https://me:sesame@pacs.example/scan.zip"),
    "not encrypted": ("case,input", "b,http://pacs.example/scan.zip"),
    "labels": ("case,input,labels", f"b,{URL},https://pacs.example/map.nii"),
}


@pytest.mark.parametrize("what", WRONG_ROWS)
def test_wrong_url_of_a_manifest_is_refused_with_its_line_and_no_password(what: str, tmp_path: Path) -> None:
    columns, row = WRONG_ROWS[what]

    with refused(UsageError, 2, "m.csv") as caught:  # line 2, below the columns
        read_table(tmp_path, row, columns=columns)

    assert "sesame" not in str(caught.value)


def test_manifest_behind_a_url_is_refused() -> None:
    with refused(UsageError, "manifest"):
        read_cases("s3://bucket/cohort.csv", Plan(output="out"))


def case_of(url: str, name: str = "a") -> Case:
    return Case(name, source=url)


def test_url_lies_in_no_folder_of_the_output_but_a_path_of_its_words_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    check_places([case_of("s3://scans/p")], tmp_path)
    with refused(UsageError, "path"):
        check_places([case_of("s3:/scans/p", name="path")], tmp_path)


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Archive]:
    """The archive of a ball; no test waits before it asks again."""
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setenv("NETRC", "")
    with running(Archive(write_series(tmp_path / "ct"))) as server:
        yield server


def plan_of(folder: Path, *, resume: bool = False) -> Plan:
    batch = BatchSettings(picture=False, measure=False, resume=resume)
    return Plan(output=str(folder), batch=batch, given={"iso_value": {"iso_value": 0.0}}, timeout=60)


def test_key_of_a_case_changes_with_the_instances_of_its_archive(archive: Archive, tmp_path: Path) -> None:
    case, plan = case_of(archive.url), plan_of(tmp_path)

    first, again = make_key(case, plan), make_key(case, plan)
    archive.uids[0] += ".1"
    with_another_instance = make_key(case, plan)

    assert first == again != with_another_instance


def make_once(archive: Archive, folder: Path) -> Case:
    """Make the case of the archive, and forget what was asked for it."""
    case = case_of(archive.url)
    assert make_case(case, plan_of(folder)) == Answer("done")
    archive.asked.clear()
    return case


def test_finished_case_is_kept_without_fetching_its_scan_again(archive: Archive, tmp_path: Path) -> None:
    case = make_once(archive, tmp_path)

    assert make_case(case, plan_of(tmp_path, resume=True)) == Answer("done", kept=True)
    assert {path.split("?")[0].rsplit("/", 1)[1] for path, _ in archive.asked} == {
        "instances"
    }  # their list, none alone


def test_finished_case_is_kept_and_named_where_its_server_is_gone(archive: Archive, tmp_path: Path) -> None:
    case = make_once(archive, tmp_path)
    archive.close()

    answer = make_case(case, plan_of(tmp_path, resume=True))

    assert (answer.status, answer.kept) == ("done", True)
    assert archive.host in answer.error
    assert (tmp_path / "a" / "mesh.stl").is_file()


def test_case_whose_server_is_gone_fails_and_is_not_refused(archive: Archive, tmp_path: Path) -> None:
    archive.close()

    answer = make_case(case_of(archive.url), plan_of(tmp_path))

    assert answer.status == "failed"
    assert archive.host in answer.error
