"""The fuzzer: some damaged input of every family, and each kind of fault that it must notice.

The campaign over many more cases is one of scripts/release_checks.py; a fault is reproduced by the name of its case.
"""

from __future__ import annotations

import json
import os
import random
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
from refusals import refused
from trials import FAULTS, MEMORY_LIMIT_BYTES, Answer, Judge, Outcome, Trial, WrongOutcome
from variants import daily_rows

from clrecon.errors import RefusedInputError

CASES = {
    "values": 4, "bytes": 3, "ends": 1, "volumes": 2, "labels": 1, "clouds": 1, "options": 2, "environment": 1,
}  # fmt: skip
"""The first cases of each family, about as the time of a campaign is shared."""
UNHARMED = Answer({"voxels": "a"}, ("known",))
"""What undamaged input gives: the hash of its voxels, and one warning."""


@pytest.fixture(scope="module")
def short_campaign() -> Campaign:
    """The outcomes of the first cases of each family."""
    cases = [Case(family, number) for family, count in CASES.items() for number in range(count)]
    return run_campaign(NamedCases(cases), seconds=float("inf"))


@pytest.mark.fuzz
def test_no_damaged_input_is_read_without_a_warning_or_ends_otherwise_badly(short_campaign: Campaign) -> None:
    faults = [f"{case} {outcome.kind}: {outcome.trial}: {outcome.text}" for case, outcome in short_campaign.faults]
    assert faults == []


@pytest.mark.fuzz
def test_campaign_over_named_cases_counts_an_outcome_of_each(short_campaign: Campaign) -> None:
    assert {family: counter.total() for family, counter in short_campaign.counts.items()} == CASES


def test_short_campaign_has_cases_of_every_family() -> None:
    assert set(CASES) == set(fuzz.SHARES)


def kind_of_outcome(run, is_contradicted=True, limit_s=5.0):
    """The kind of the outcome of damaged input whose reading is `run`; other files may contradict another answer."""
    trial = Trial("a trial", run, unharmed=UNHARMED, contradicted=lambda answer: is_contradicted, limit_s=limit_s)
    return Judge().judge(trial).kind


def fail(error):
    raise error


def print_to(stream):
    os.write(stream, b"libraries talk")
    return UNHARMED


def allocate_too_much():
    np.ones(MEMORY_LIMIT_BYTES // 4)  # of 8 bytes each: twice the limit
    return UNHARMED


@pytest.mark.parametrize(
    ("kind", "run"),
    [
        pytest.param("same", lambda: UNHARMED, id="same answer"),
        pytest.param("warned", lambda: Answer({"voxels": "b"}, ("known", "beware")), id="new warning"),
        pytest.param("refused", lambda: fail(RefusedInputError("no")), id="refused in one line"),
        pytest.param("silent", lambda: Answer({"voxels": "b"}, ("known",)), id="other voxels without a new warning"),
        pytest.param("silent", lambda: Answer({}, ()), id="no voxels and no warning"),
        pytest.param("foreign", lambda: fail(KeyError("made up")), id="an error that is not clrecon's"),
        pytest.param("foreign", lambda: fail(RefusedInputError("two\nlines")), id="refused in two lines"),
        pytest.param(
            "secret", lambda: Answer({"voxels": "a"}, (), "SECRET^NAME"), id="name of the patient in a report"
        ),
        pytest.param(
            "secret", lambda: fail(RefusedInputError("of SECRET^NAME")), id="name of the patient in a message"
        ),
        pytest.param("noise", lambda: print_to(1), id="printed on standard output"),
        pytest.param("noise", lambda: print_to(2), id="printed on standard error"),
        pytest.param("memory", allocate_too_much, id="more memory than the limit"),
        pytest.param("files", lambda: fail(WrongOutcome("files", "left behind")), id="a file left behind"),
    ],
)
def test_outcome_of_damaged_input_has_its_kind(kind, run) -> None:
    assert kind_of_outcome(run) == kind


def test_other_voxels_that_nothing_contradicts_are_no_fault() -> None:
    assert kind_of_outcome(lambda: Answer({"voxels": "b"}), is_contradicted=False) == "agreed"


def test_reading_over_its_limit_of_processor_time_is_a_hang() -> None:
    def compute():
        start = time.process_time()
        while time.process_time() - start < 0.3:
            pass
        return UNHARMED

    assert kind_of_outcome(compute, limit_s=0.1) == "hang"


def test_reading_that_waits_longer_than_its_limit_of_processor_time_is_no_hang() -> None:
    """As on a busy machine."""

    def wait():
        time.sleep(0.3)
        return UNHARMED

    assert kind_of_outcome(wait, limit_s=0.1) == "same"


@pytest.mark.parametrize(
    ("program", "limits", "kind", "words"),
    daily_rows(
        2,
        [
            ("import os; os.abort()", {}, "crash", "SIGABRT"),
            ("raise SystemExit('no such thing')", {}, "crash", "no such thing"),
            ("import time; time.sleep(60)", {"stall_limit_s": 1.0}, "hang", "no answer in 1 s"),
            ("while True: pass", {"start_limit_s": 1.0}, "hang", "over 1 s of processor time"),
        ],
    ),
)
def test_worker_that_dies_or_hangs_is_a_fault_of_its_case(tmp_path, program, limits, kind, words) -> None:
    (tmp_path / "worker.py").write_text(program)
    start_worker = partial(Worker.start, program=tmp_path / "worker.py", **limits)
    campaign = run_campaign(NamedCases([Case("values", 7)]), seconds=30, start_worker=start_worker)
    [(case, outcome)] = campaign.faults
    assert (str(case), outcome.kind) == ("values:7", kind)
    assert words in outcome.text
    assert campaign.as_dict()["counts"] == {"values": {kind: 1}}


ENDS_AT_CASE_2 = f"""
import sys
for line in sys.stdin:
    assert line.split()[1] != "2"
    print({json.dumps(Outcome("same", "a trial").as_dict())!r}, flush=True)
"""


def test_campaign_goes_on_with_a_new_worker_after_one_that_died(tmp_path) -> None:
    (tmp_path / "worker.py").write_text(ENDS_AT_CASE_2)
    start_worker = partial(Worker.start, program=tmp_path / "worker.py")
    campaign = run_campaign(Schedule(["values"], most=5), seconds=30, start_worker=start_worker)
    assert campaign.counts == {"values": Counter(same=4, crash=1)}
    assert [str(case) for case, _ in campaign.faults] == ["values:2"]


def test_table_of_a_campaign_has_a_column_of_each_kind_of_fault() -> None:
    table = Campaign().table()
    assert [kind for kind in FAULTS if kind not in table] == []


def test_families_get_their_shares_of_the_time_although_their_cases_take_different_times() -> None:
    seconds = {"values": 0.1, "environment": 10.0}
    schedule = Schedule(list(seconds))
    for _ in range(1000):
        case = schedule.draw()
        schedule.spend(case, seconds[case.family])
    ratio = schedule.spent["values"] / schedule.spent["environment"]
    expected = fuzz.SHARES["values"] / fuzz.SHARES["environment"]
    assert ratio == pytest.approx(expected, rel=0.2)  # one of the five cases of 10 s, more or less


def test_schedule_of_no_cases_draws_none() -> None:
    assert Schedule(["values"], most=0).draw() is None


@pytest.mark.parametrize(
    "make_trial", [slices.values_trial, slices.bytes_trial, slices.ends_trial, clouds.clouds_trial]
)
def test_trial_of_the_same_case_and_seed_is_the_same(make_trial, tmp_path) -> None:
    case_number = 20_000
    first, second = (make_trial(case_number, tmp_path, random.Random("1")).words for _ in range(2))
    assert first == second


@pytest.fixture(scope="module")
def cloud_trials(tmp_path_factory):
    """Descriptions of twelve trials of clouds, and the folder with their files."""
    folder = tmp_path_factory.mktemp("clouds")
    trials = [clouds.clouds_trial(number, folder, random.Random(f"1 clouds {number}")).words for number in range(12)]
    return trials, folder


def test_trial_of_a_cloud_has_its_damaged_file(cloud_trials) -> None:
    trials, folder = cloud_trials
    assert [words for words in trials if not (folder / "ct" / words.partition(":")[0]).is_file()] == []


def test_some_damaged_clouds_are_given_to_the_command_and_some_to_the_reader(cloud_trials) -> None:
    trials, _ = cloud_trials
    given_to_command = ["'-" in words for words in trials]  # options of the command line
    assert set(given_to_command) == {True, False}


@pytest.mark.parametrize(("name", "kind"), [("full.ply", "same"), ("none.ply", "refused")])
def test_undamaged_cloud_is_read_and_a_missing_one_refused(name, kind, tmp_path) -> None:
    path = tmp_path / name
    if name in clouds.clouds():
        path.write_bytes(clouds.clouds()[name])
    unharmed = clouds.unharmed_cloud("full.ply")
    trial = Trial(name, lambda: clouds.answer_of_cloud(path), unharmed=unharmed, contradicted=lambda answer: True)
    assert Judge().judge(trial).kind == kind


SLICE = slices.series()[0]
"""The bytes of an undamaged slice."""


@pytest.mark.parametrize(
    ("keyword", "before", "value", "after"),
    [
        ("RescaleIntercept", b"-1024.0", b"-24 ", b"-24"),
        ("RescaleIntercept", b"-1024.0", None, b""),
        ("GantryDetectorTilt", b"", b"12", b"12"),
    ],
    ids=["changed", "removed", "added"],
)
def test_value_of_an_element_of_a_slice_is_changed_removed_or_added(keyword, before, value, after) -> None:
    assert slices.value_in(SLICE, keyword).strip() == before
    assert slices.value_in(slices.put(SLICE, keyword, value), keyword).strip() == after


def test_element_with_the_largest_tag_is_added_at_the_end_of_a_slice() -> None:
    tag_of_pixels = b"\xe0\x7f"
    pixels = next(each for each in slices.find_elements(SLICE) if SLICE[each.start :].startswith(tag_of_pixels))
    without_pixels = SLICE[: pixels.start]
    with_pixels = without_pixels + slices.element_bytes("PixelData", b"12")
    assert slices.put(without_pixels, "PixelData", b"12") == with_pixels


@pytest.mark.parametrize("keyword", [*slices.GEOMETRY, *slices.PIXELS])
def test_changed_value_leaves_the_number_of_elements_and_an_added_one_raises_it_by_one(keyword) -> None:
    """A VR that depends on other elements is written as one of its two."""
    is_added = slices.value_in(SLICE, keyword) == b""
    harmed = slices.put(SLICE, keyword, b"12")
    assert len(slices.find_elements(harmed)) == len(slices.find_elements(SLICE)) + is_added


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
    ids=[
        "ended by a signal",
        "unexpected error",
        "no message",
        "two messages",
        "words on success",
        "words before JSON",
    ],
)
def test_command_that_went_wrong_has_the_kind_of_its_fault(given, code, out, err, kind) -> None:
    with pytest.raises(WrongOutcome) as caught:
        commands.check_call(given, code, out, err)
    assert caught.value.kind == kind


def test_words_on_standard_error_beside_a_mesh_on_standard_output_are_no_fault() -> None:
    given, code, out, err = ["mesh", "ct", "-o", "-"], 0, "solid", "wrote    standard output\n"
    assert commands.check_call(given, code, out, err) is None  # else it raises a WrongOutcome


@pytest.mark.parametrize(
    ("code", "name"), [(3, "out.stl"), (0, ".out.stl.tmp")], ids=["output of a failed command", "temporary file"]
)
def test_file_that_a_command_leaves_behind_is_a_fault(code, name) -> None:
    with refused(WrongOutcome, "left"):
        commands.check_files(code, [Path(name)])


def test_output_of_a_command_that_succeeds_is_no_fault() -> None:
    assert commands.check_files(0, [Path("out.stl")]) is None  # else it raises a WrongOutcome


@pytest.fixture
def campaign_with_fault(monkeypatch) -> None:
    """The fuzzer finds a fault in case 3 of the family of values."""
    campaign = Campaign()
    campaign.add(Case("values", 3), Outcome("silent", "a value", "slice 1"))
    monkeypatch.setattr(fuzz, "run_campaign", lambda *args, **kwargs: campaign)


@pytest.mark.usefixtures("campaign_with_fault")
def test_fuzzer_that_finds_a_fault_exits_with_1_and_prints_its_case(printed) -> None:
    assert fuzz.main(["--seconds", "1"]) == 1
    printed().assert_output("values", 3)


@pytest.mark.usefixtures("campaign_with_fault")
def test_fault_is_written_to_json_with_its_case(tmp_path) -> None:
    fuzz.main(["--seconds", "1", "--json", str(tmp_path / "found.json")])
    [fault] = json.loads((tmp_path / "found.json").read_text())["faults"]
    assert fault["case"] == "values:3"


def test_fuzzer_that_finds_no_fault_exits_with_0(monkeypatch) -> None:
    monkeypatch.setattr(fuzz, "run_campaign", lambda *args, **kwargs: Campaign())
    assert fuzz.main([]) == 0
