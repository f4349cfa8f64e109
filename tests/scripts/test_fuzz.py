"""Some harmed input of every family; and each kind of fault is one for the fuzzer.

The campaign over many more cases is one of scripts/release_checks.py; what is found is found again by its case.
"""

from __future__ import annotations

import json
import os
import random
import tempfile
import time
from collections import Counter
from functools import partial
from pathlib import Path

import clouds
import commands
import fuzz
import numpy as np
import pytest
import slices
from fuzz import Campaign, Case, NamedCases, Schedule, Worker, run_campaign
from trials import FAULTS, MEMORY_LIMIT_BYTES, Answer, Judge, Outcome, Trial, WrongOutcome
from variants import daily_rows

from clrecon.errors import RefusedInputError

CASES = {
    "values": 4, "bytes": 3, "ends": 1, "volumes": 2, "labels": 1, "clouds": 1, "options": 2, "environment": 1,
}  # fmt: skip
"""The first cases of each family, about as the time of a campaign is shared."""
UNHARMED = Answer({"voxels": "a"}, ("known",))


@pytest.mark.fuzz
def test_harmed_input_is_refused_or_told() -> None:
    cases = [Case(family, number) for family, count in CASES.items() for number in range(count)]
    campaign = run_campaign(NamedCases(cases), seconds=float("inf"))
    assert [f"{case} {outcome.kind}: {outcome.trial}: {outcome.text}" for case, outcome in campaign.faults] == []
    assert set(CASES) == set(fuzz.SHARES)
    assert {family: counter.total() for family, counter in campaign.counts.items()} == CASES


def judge(run, contradicted=True, limit_s=5.0):
    return Judge().judge(Trial("a trial", run, UNHARMED, lambda answer: contradicted, limit_s)).kind


def fail(error):
    raise error


def say(stream):
    os.write(stream, b"libraries talk")
    return UNHARMED


def hoard():
    np.ones(MEMORY_LIMIT_BYTES // 4)
    return UNHARMED


@pytest.mark.parametrize(
    ("kind", "run"),
    [
        ("same", lambda: UNHARMED),
        ("warned", lambda: Answer({"voxels": "b"}, ("known", "beware"))),
        ("refused", lambda: fail(RefusedInputError("no"))),
        ("silent", lambda: Answer({"voxels": "b"}, ("known",))),
        ("silent", lambda: Answer({}, ())),
        ("foreign", lambda: fail(KeyError("made up"))),
        ("foreign", lambda: fail(RefusedInputError("two\nlines"))),
        ("secret", lambda: Answer({"voxels": "a"}, (), "SECRET^NAME")),
        ("secret", lambda: fail(RefusedInputError("of SECRET^NAME"))),
        ("noise", lambda: say(1)),
        ("noise", lambda: say(2)),
        ("memory", hoard),
        ("files", lambda: fail(WrongOutcome("files", "left behind"))),
    ],
)
def test_outcomes_are_told_apart(kind, run) -> None:
    assert judge(run) == kind


def test_change_that_nothing_contradicts_is_no_fault() -> None:
    assert judge(lambda: Answer({"voxels": "b"}), contradicted=False) == "agreed"


def test_a_case_over_its_time_hangs() -> None:
    def work():
        start = time.process_time()
        while time.process_time() - start < 0.3:
            pass
        return UNHARMED

    assert judge(work, limit_s=0.1) == "hang"


def test_time_on_a_busy_machine_is_no_fault() -> None:
    def wait():
        time.sleep(0.3)
        return UNHARMED

    assert judge(wait, limit_s=0.1) == "same"


@pytest.mark.parametrize(
    ("program", "kind", "words"),
    daily_rows(
        2,
        [
            ("import os; os.abort()", "crash", "SIGABRT"),
            ("raise SystemExit('no such thing')", "crash", "no such thing"),
            ("import time; time.sleep(60)", "hang", "no answer in 1 s"),
            ("while True: pass", "hang", "over 1 s of processor time"),
        ],
    ),
)
def test_a_worker_that_dies_or_hangs_is_a_fault(tmp_path, program, kind, words) -> None:
    (tmp_path / "worker.py").write_text(program)
    limit = {"stall_limit_s" if "sleep" in program else "start_limit_s": 1.0}
    start = partial(Worker.start, program=tmp_path / "worker.py", **limit)
    campaign = run_campaign(NamedCases([Case("values", 7)]), seconds=30, start_worker=start)
    ((case, outcome),) = campaign.faults
    assert str(case) == "values:7" and outcome.kind == kind and words in outcome.text
    assert campaign.as_dict()["counts"] == {"values": {kind: 1}}


def test_a_worker_is_replaced(tmp_path, monkeypatch) -> None:
    answer = json.dumps(Outcome("same", "a trial").as_dict())
    program = f"""
import sys
for line in sys.stdin:
    assert line.split()[1] != "2"
    print({answer!r}, flush=True)
"""
    (tmp_path / "worker.py").write_text(program)
    start = partial(Worker.start, program=tmp_path / "worker.py")
    campaign = run_campaign(Schedule(["values"], 5), seconds=30, start_worker=start)
    assert campaign.counts == {"values": Counter(same=4, crash=1)}
    assert [str(case) for case, _ in campaign.faults] == ["values:2"]
    assert "same" in campaign.table() and all(kind in campaign.table() for kind in FAULTS)


def test_families_share_the_time() -> None:
    schedule = Schedule(["values", "environment"])
    for _ in range(1000):
        case = schedule.draw()
        schedule.spend(case, 10.0 if case.family == "environment" else 0.1)
    values, environment = schedule.spent["values"], schedule.spent["environment"]
    assert values / environment == pytest.approx(fuzz.SHARES["values"] / fuzz.SHARES["environment"], rel=0.2)
    assert Schedule(["values"], 0).draw() is None


def test_a_case_is_made_again(tmp_path) -> None:
    for trial in (slices.values_trial, slices.bytes_trial, slices.ends_trial, clouds.clouds_trial):
        words = {trial(20_000, tmp_path, random.Random("1")).words for _ in range(2)}
        assert len(words) == 1


def test_clouds_are_read_and_given_to_the_command(tmp_path) -> None:
    said = []
    for number in range(12):
        trial = clouds.clouds_trial(number, tmp_path, random.Random(f"1 clouds {number}"))
        assert (tmp_path / "ct" / trial.words.partition(":")[0]).is_file()
        said.append(trial.words)
    assert 2 < sum("'-" in words for words in said) < 11
    assert {"same", "refused"} <= {Judge().judge(plain_cloud(name)).kind for name in ("full.ply", "none.ply")}


def plain_cloud(name):
    """A trial of a file as it was written, or of one that is not there."""
    path = Path(tempfile.mkdtemp()) / name
    if name in clouds.clouds():
        path.write_bytes(clouds.clouds()[name])
    return Trial(name, lambda: clouds.answer_of_cloud(path), clouds.unharmed_cloud("full.ply"), lambda answer: True)


def test_values_harm_one_element() -> None:
    data = slices.series()[0]
    harmed = slices.put(data, "RescaleIntercept", b"-24 ")
    assert slices.value_in(data, "RescaleIntercept").strip() == b"-1024.0"
    assert slices.value_in(harmed, "RescaleIntercept").strip() == b"-24"
    assert slices.value_in(slices.put(data, "RescaleIntercept", None), "RescaleIntercept") == b""
    assert slices.value_in(slices.put(data, "GantryDetectorTilt", b"12"), "GantryDetectorTilt") == b"12"


def test_an_element_behind_all_others_is_put_at_the_end() -> None:
    data = slices.series()[0]
    pixels = next(element for element in slices.find_elements(data) if data[element.start :].startswith(b"\xe0\x7f"))
    cut = data[: pixels.start]
    assert slices.put(cut, "PixelData", b"12") == cut + slices.element_bytes("PixelData", b"12")


@pytest.mark.parametrize("keyword", [*slices.GEOMETRY, *slices.PIXELS])
def test_a_harmed_value_leaves_the_other_elements_readable(keyword) -> None:
    """A VR that depends on other elements is written as one of its two."""
    data = slices.series()[0]
    was_there = slices.value_in(data, keyword) != b""
    harmed = slices.put(data, keyword, b"12")
    assert len(slices.find_elements(harmed)) == len(slices.find_elements(data)) + (not was_there)


@pytest.mark.parametrize(
    ("given", "code", "out", "err", "kind"),
    [
        (["mesh"], -6, "", "", "crash"),
        (["mesh"], 1, "", "clrecon: error: unexpected error (KeyError)", "foreign"),
        (["mesh"], 3, "", "", "foreign"),
        (["mesh"], 3, "", "clrecon: error: a\nclrecon: error: b\n", "foreign"),
        (["mesh"], 0, "", "vtk says\n", "noise"),
        (["mesh", "--json"], 0, "vtk says {}", "", "noise"),
    ],
)
def test_calls_that_went_wrong_are_told_by_their_kind(given, code, out, err, kind) -> None:
    with pytest.raises(WrongOutcome) as caught:
        commands.check_call(given, code, out, err)
    assert caught.value.kind == kind


def test_words_on_stderr_beside_an_output_on_stdout_are_right() -> None:
    commands.check_call(["mesh", "ct", "-o", "-"], 0, "solid", "wrote    standard output\n")


@pytest.mark.parametrize(("code", "name"), [(3, "out.stl"), (0, ".out.stl.tmp")])
def test_files_that_are_left_behind_are_a_fault(code, name) -> None:
    with pytest.raises(WrongOutcome, match="left"):
        commands.check_files(code, [Path(name)])
    commands.check_files(0, [Path("out.stl")])


def test_a_fault_is_the_exit_status(tmp_path, monkeypatch, printed) -> None:
    campaign = Campaign()
    campaign.add(Case("values", 3), Outcome("silent", "a value", "slice 1"))
    monkeypatch.setattr(fuzz, "run_campaign", lambda *args, **kwargs: campaign)
    assert fuzz.main(["--seconds", "1", "--json", str(tmp_path / "found.json")]) == 1
    printed().assert_output(3)
    assert json.loads((tmp_path / "found.json").read_text())["faults"][0]["case"] == "values:3"
    monkeypatch.setattr(fuzz, "run_campaign", lambda *args, **kwargs: Campaign())
    assert fuzz.main([]) == 0
