"""scripts/proof/mutate_python.py tries changes of a small package, and counts how many of them its tests notice.

The changes are written here: cosmic-ray, which finds them in clrecon, is not part of the extra ``test``.
"""

from __future__ import annotations

import gc
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import mutate_python
import pytest
from mutate_python import BrokenRoomError, Copy, RoomResult, room_texts, try_room
from printed_text import Printer
from python_changes import (
    Change,
    Equivalent,
    choose_changes,
    definition_names,
    find_places,
    make_change,
    read_equivalents,
    statement_lines,
)
from refusals import refused
from room_traces import FAR, MOST_SECONDS, Imports, Trace
from traced_tests import Caches
from warm_tests import Run, WarmTests

ROOM = """from functools import cache

SCALE = 2


def area(width, height):
    return SCALE * width * height


def count(n):
    while n > 0:
        n -= 1
    return n


@cache
def table():
    return [1, 2]


def untested(x):
    return x + 1
"""
TESTS = """from functools import cache

import pytest
from toy.flat.shapes import area, count, table


@cache
def kept():
    return table()


@pytest.fixture(scope="module")
def small():
    return area(1, 1)


def test_area():
    assert area(1, 3) == 6


def test_square_is_positive(small):
    assert small > 0


def test_small(small):
    assert small == 2


def test_count():
    assert count(3) >= 0


def test_first():
    assert kept()


def test_second():
    assert kept()[1] == 2
"""


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package toy, whose room flat is `ROOM`, and its tests."""
    folder = tmp_path_factory.mktemp("project")
    for name, text in {"toy/__init__.py": "", "toy/flat/__init__.py": "", "toy/flat/shapes.py": ROOM}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / "tests" / "flat").mkdir(parents=True)
    (folder / "tests" / "flat" / "test_shapes.py").write_text(TESTS)
    markers = "slow: long\n    fuzz: harmed"
    (folder / "pytest.ini").write_text(f"[pytest]\nmarkers =\n    {markers}\n")
    return folder


@pytest.fixture(scope="module")
def copy(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Copy]:
    """A private copy of the project, in which changes are tried."""
    made = Copy.make(project, tmp_path_factory.mktemp("private"), "toy")
    yield made
    made.close()


@pytest.fixture(scope="module")
def trace(copy: Copy) -> Trace:
    """Which tests run which lines of the room."""
    return copy.trace("flat")


def change(before: str, after: str) -> Change:
    """A change of the one place in `ROOM` where `before` stands."""
    assert ROOM.count(before) == 1
    line = ROOM[: ROOM.index(before)].count("\n") + 1
    return Change("toy/flat/shapes.py", line, "by hand", line, before, after, ROOM.replace(before, after))


ALL_TESTS = TESTS.count("def test_")
MINUS = change("x + 1", "x - 1")
EQUAL = change("while n > 0", "while n != 0")
TIMES = change("* width *", "/ width *")


def names(trace: Trace, changed: Change) -> set[str]:
    """The tests that a change is tried with, without test_."""
    lines = statement_lines(ROOM, changed.line)
    return {test.partition("::test_")[2] for test in trace.tests_of(changed.file, lines)}


@pytest.mark.release
def test_tests_that_run_a_line_are_found_through_fixtures_and_caches(trace: Trace) -> None:
    runs = {line: {test.partition("::test_")[2] for test in tests} for line, tests in trace.lines[TIMES.file].items()}
    assert runs[TIMES.line] == {"area", "square_is_positive", "small"}
    assert runs[EQUAL.line] == {"count"}
    # The second test finds what the first has left in the cache of the tests.
    assert runs[change("[1, 2]", "[1, 3]").line] == {"first"}
    assert names(trace, change("[1, 2]", "[1, 3]")) >= {"first", "second"}
    assert names(trace, MINUS) == set()
    # A constant of the module belongs to every test of the file.
    assert names(trace, change("SCALE = 2", "SCALE = 3")) == {
        *("area", "square_is_positive", "small", "count", "first", "second")
    }


START_S = 1.5
SECONDS = {"x": 2.0, "y[2]": 0.5, "y[1]": 0.7, "z": 1.0}
TRACED = Trace({"a.py": {3: ["x", "y"], 4: ["z"]}}, SECONDS, START_S)
"""Tests by the lines of a file that they run, with their seconds."""


def test_tests_of_changed_lines_run_from_short_to_long_each_of_their_parameters() -> None:
    assert TRACED.tests_of("a.py", [3, 4, 5]) == ["y[2]", "y[1]", "z", "x"]


def test_file_that_no_test_runs_has_no_tests() -> None:
    assert TRACED.tests_of("b.py", [3]) == []


def test_time_limit_of_tests_is_four_times_theirs_with_the_start_and_10_seconds() -> None:
    assert TRACED.limit_s(["x", "y[2]"]) == 4 * (START_S + SECONDS["x"] + SECONDS["y[2]"]) + 10


@pytest.mark.parametrize(
    ("seconds", "shortest"), [(0.1, ["y[2]"]), (1.4, ["y[2]"]), (1.5, ["y[2]", "z"]), (3.5, ["y[2]", "z", "x"])]
)
def test_shortest_tests_within_some_seconds_are_chosen_and_at_least_one(seconds: float, shortest: list[str]) -> None:
    assert TRACED.shortest(["x", "y[2]", "z"], seconds) == shortest


@pytest.mark.parametrize(("over_s", "chosen"), [(0.0, ["short", "long"]), (0.1, ["short"])], ids=["at most", "beyond"])
def test_longer_test_is_left_out_where_it_and_the_shorter_one_take_more_than_most_seconds(
    over_s: float, chosen: list[str]
) -> None:
    seconds = {"long": MOST_SECONDS - 1.5 + over_s, "short": 1.5}
    trace = Trace({"a.py": {3: ["long", "short"]}}, seconds, START_S)
    assert trace.tests_of("a.py", [3]) == chosen


@pytest.fixture
def imports_of_three_tests(tmp_path: Path) -> Imports:
    """Of test_near, which imports toy.deep, test_far, which does over a helper and toy.middle, and test_apart."""
    texts = {
        "toy/deep.py": "",
        "toy/middle.py": "def f():\n    from toy import deep\n",
        "tests/support/helper.py": "import toy.middle\n",
        "tests/test_near.py": "from toy.deep import x\n",
        "tests/test_far.py": "import helper\n",
        "tests/test_apart.py": "import os\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return Imports.read(tmp_path, ["toy", "tests"])


@pytest.mark.parametrize(("name", "steps"), [("near", 1), ("far", 3), ("apart", FAR)])
def test_imports_between_a_test_and_a_changed_file_are_counted(
    imports_of_three_tests: Imports, name: str, steps: int
) -> None:
    assert imports_of_three_tests.steps("toy/deep.py", f"tests/test_{name}.py") == steps


def test_tests_whose_imports_are_nearer_to_the_changed_file_run_first_and_those_of_other_lines_last(
    imports_of_three_tests: Imports,
) -> None:
    near, far, apart = (f"tests/test_{name}.py::test_it" for name in ("near", "far", "apart"))
    seconds = {apart: 0.1, far: 0.2, near: 3.0, f"{near}_too": 0.1, f"{far}_too": 0.1}
    trace = Trace({"toy/deep.py": {1: [near, far, apart]}}, seconds, 1.0, imports=imports_of_three_tests)
    # Those that do not run the line come last: they may use what the others have kept.
    assert trace.tests_of("toy/deep.py", [1]) == [near, far, apart, f"{near}_too", f"{far}_too"]


def test_caches_of_modules_of_a_folder_are_emptied_also_when_frozen(tmp_path: Path) -> None:
    gc.freeze()
    try:
        module = ModuleType("cached_toy")
        module.__file__ = str(tmp_path / "cached_toy.py")
        exec("from functools import cache\n@cache\ndef f(): return []\n", vars(module))
        gc.freeze()
        caches = Caches()
        sys.modules["cached_toy"] = module
        first = module.f()
        caches.empty({tmp_path / "elsewhere"})
        assert module.f() is first
        caches.empty({tmp_path})
        assert module.f() is not first
        assert gc.get_freeze_count() > 0
    finally:
        sys.modules.pop("cached_toy", None)
        gc.unfreeze()


@pytest.mark.release
@pytest.mark.parametrize(
    ("changed", "outcome"),
    [
        (TIMES, "survived"),  # widths of 1 alone: of the same length as the file before
        (change("width * height", "width + height"), "caught"),
        (change("SCALE = 2", "SCALE = 3"), "caught"),
        (change("[1, 2]", "[1, 3]"), "caught"),
        (MINUS, "not run"),
    ],
)
def test_change_of_code_has_the_outcome_of_its_tests_and_the_file_is_restored(
    copy: Copy, trace: Trace, changed: Change, outcome: str
) -> None:
    assert copy.try_change(changed, trace)[0] == outcome
    assert room_texts(copy.root, "toy", "flat")["toy/flat/shapes.py"] == ROOM


@pytest.mark.release
def test_change_that_makes_a_test_run_on_is_caught_by_its_processor_time(
    copy: Copy, trace: Trace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Trace, "limit_s", lambda self, tests: 3.0)
    assert copy.try_change(change("n -= 1", "n += 1"), trace) == ("time", ALL_TESTS)


@pytest.mark.release
def test_change_that_makes_a_test_wait_is_late_and_neither_caught_nor_survived(
    copy: Copy, trace: Trace, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(copy, "times_wall", 0.0)
    monkeypatch.setattr(copy, "and_wall_s", 1.0)
    assert copy.try_change(change("n -= 1", "__import__('time').sleep(60.0)"), trace) == ("late", ALL_TESTS)


@pytest.mark.release
def test_change_that_ends_the_process_of_its_tests_is_caught_as_a_crash(copy: Copy, trace: Trace) -> None:
    assert copy.try_change(change("n -= 1", "__import__('os').abort()"), trace) == ("crash", ALL_TESTS)


@pytest.mark.release
def test_remaining_tests_are_run_when_the_first_pass(copy: Copy, trace: Trace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(copy, "first_tests", 1)
    assert copy.try_change(change("width * height", "width + height"), trace) == ("caught", ALL_TESTS)
    assert copy.try_change(TIMES, trace) == ("survived", ALL_TESTS)


@pytest.mark.release
def test_process_that_forks_for_tests_has_imported_the_libraries_and_no_module_of_the_project(
    copy: Copy, trace: Trace, tmp_path: Path
) -> None:
    assert "pytest" in trace.modules and not any(name.startswith(("toy", "test_shapes")) for name in trace.modules)
    (copy.root / "tests" / "flat" / "test_warm.py").write_text(
        "import sys\n\nLOADED = {*sys.modules}\n\n\n"
        "def test_it():\n    assert 'colorsys' in LOADED and 'wave' not in LOADED\n"
    )
    test = "tests/flat/test_warm.py::test_it"
    warm = WarmTests(copy.root, copy.environment(writes_bytecode=False), ["colorsys", "no_such_module"])
    allowed_s = 60.0  # of processor time
    output = tmp_path / "said.txt"
    run = Run(stages=[[test]], cpu_s=[allowed_s], wall_s=600.0, folder=str(tmp_path / "tests"), said=str(output))
    try:
        outcome = warm.run(run)
        assert outcome.status == 0, output.read_text()
        assert 0.0 < outcome.cpu_s < allowed_s
        warm.process.send_signal(signal.SIGKILL)
        with pytest.raises(ChildProcessError, match="has ended"):
            warm.run(run)
    finally:
        warm.close()
        (copy.root / "tests" / "flat" / "test_warm.py").unlink()


@pytest.mark.release
def test_rows_are_kept_and_equivalent_changes_are_named(
    copy: Copy, trace: Trace, project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[Change] = []
    monkeypatch.setattr(Copy, "trace", lambda self, room: trace)
    monkeypatch.setattr(Copy, "try_change", lambda self, one, trace: tried.append(one) or ("caught", 1))
    same = [Equivalent(EQUAL.file, EQUAL.before, EQUAL.after, "n never falls below 0")]
    first = list(try_room(copy, "flat", [TIMES, EQUAL, MINUS], equivalents=same))
    assert [row["outcome"] for row in first] == ["caught", "equivalent", "caught"]
    assert tried == [TIMES, MINUS]
    known = json.loads(json.dumps([first[0], {**first[2], "outcome": "survived"}]))
    assert list(try_room(copy, "flat", [TIMES], known=known)) == [first[0]]
    list(try_room(copy, "flat", [MINUS], known=known))
    list(try_room(copy, "flat", [TIMES], known=[{**known[0], "digest": "of another file"}]))
    assert tried == [TIMES, MINUS, MINUS, TIMES]
    assert list(try_room(copy, "flat", [MINUS], until=0.0)) == []
    assert (project / "toy" / "flat" / "shapes.py").read_text() == ROOM


FORTY = [{"outcome": "caught"}] * 37 + [{"outcome": "equivalent"}, {"outcome": "time"}, {"outcome": "survived"}]
"""Outcomes of 40 changes, one of which no test has noticed."""


@pytest.mark.parametrize(
    ("more", "is_good"),
    [
        pytest.param([], True, id="1 of 40 missed"),
        pytest.param(["not run"], True, id="2 of 41 missed"),
        pytest.param(["not run", "survived"], False, id="3 of 42 missed"),
    ],
)
def test_room_is_good_if_its_tests_miss_at_most_one_change_in_twenty(more: list[str], is_good: bool) -> None:
    assert RoomResult("flat", FORTY + [{"outcome": outcome} for outcome in more]).is_good is is_good


def test_sentence_of_a_room_counts_its_changes_by_outcome() -> None:
    sentence = RoomResult("flat", FORTY).sentence()
    assert "40 changes, 38 caught (1 by time, 0 by a crash), 1 equivalent, 1 survive (0 of them" in sentence


@pytest.mark.release
def test_room_whose_tests_fail_without_a_change_is_refused(project: Path, tmp_path: Path) -> None:
    copy = Copy.make(project, tmp_path, "toy")
    (copy.root / "tests" / "flat" / "test_shapes.py").write_text("def test_it():\n    assert 1 == 2\n")
    with pytest.raises(BrokenRoomError, match="fail without a change"):
        copy.trace("flat")


def test_lines_of_a_statement_are_those_of_it_before_its_body() -> None:
    text = "if (a and\n    b):\n    c = [\n        1,\n        2,\n    ]\n    d = 3\n"
    assert [list(statement_lines(text, line)) for line in (1, 2, 4, 7)] == [[1, 2], [1, 2], [3, 4, 5, 6], [7]]


def test_equivalent_changes_are_of_lines_that_exist_and_have_a_reason() -> None:
    entries = read_equivalents(mutate_python.EQUIVALENTS)
    assert entries
    for entry in entries:
        lines = (mutate_python.ROOT / entry.file).read_text(encoding="utf-8").splitlines()
        assert entry.before in " ".join(line.strip() for line in lines), entry
        assert entry.before != entry.after and entry.why


@pytest.mark.parametrize("words", [["--rooms", "nowhere"], ["--changes", "0"], ["--resume"]])
def test_wrong_option_of_the_mutation_script_is_refused_by_name(words: list[str], printed: Printer) -> None:
    with refused(SystemExit, 2):
        mutate_python.main(words)
    printed().assert_error(words[-1] if words[0] == "--rooms" else words[0])


def test_kernels_that_tests_of_a_copy_load_are_those_of_the_copy(tmp_path: Path) -> None:
    """Not those of the folder that an editable installation points to."""
    for name in ("clrecon", "cl", "tests"):
        (tmp_path / "project" / name).mkdir(parents=True)
    (tmp_path / "project" / "clrecon" / "__init__.py").write_text("")
    (tmp_path / "project" / "cl" / "own.cl").write_text("own")
    made = Copy.make(tmp_path / "project", tmp_path)
    program = "from importlib import resources; print(resources.files('clrecon.cl').joinpath('own.cl').read_text())"
    said = subprocess.run(
        [sys.executable, "-c", program],
        cwd=made.root,
        env=made.environment(writes_bytecode=False),
        capture_output=True,
        text=True,
    )
    assert said.stdout == "own\n", said.stderr


FUNCTION = "def f(x: int | None = 1) -> int | str:\n    y: int | str = -x\n    return (x < 2) + y\n"
"""Five places to change: 1, -, <, 2 and +, and none in annotations."""


def test_places_to_change_are_numbers_and_operators_and_no_annotations() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    assert {(place.start, place.operator.partition("_")[0]) for place in find_places(FUNCTION)} == {
        ((1, 22), "NumberReplacer"), ((2, 19), "ReplaceUnaryOperator"), ((3, 14), "ReplaceComparisonOperator"),
        ((3, 16), "NumberReplacer"), ((3, 19), "ReplaceBinaryOperator"),
    }  # fmt: skip


def test_strictness_of_a_zip_in_a_loop_is_no_place_to_change() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    assert find_places("for a, b in zip(c, d, strict=True):\n    pass\n")[-1].operator == "ZeroIterationForLoop"


def test_changes_of_the_same_seed_are_the_same_and_different_from_each_other() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    first, second = (choose_changes({"a.py": FUNCTION}, count=3, seed="1") for _ in range(2))
    assert first == second
    assert len({change.text for change in first}) == 3


def test_changes_of_another_seed_are_others() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    chosen = [choose_changes({"a.py": FUNCTION}, count=3, seed=str(seed)) for seed in range(5)]
    assert any(changes != chosen[0] for changes in chosen)


def test_no_more_changes_are_chosen_than_there_are_places() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    assert len(choose_changes({"a.py": FUNCTION}, count=99, seed="1")) == 5


def chosen_lines(texts: dict[str, str], count: int) -> list[tuple[str, str, str]]:
    """File, line before and line after of the changes that are chosen."""
    return [(change.file, change.before, change.after) for change in choose_changes(texts, count, seed="1")]


EIGHT_FUNCTIONS = "\n\n".join(f"def f{n}(x):\n    y = 2 * x + {n}\n    return y < 1 or y > 5" for n in range(8)) + "\n"


def test_edit_of_a_line_draws_no_other_changes_elsewhere() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    edited = "import math\n\n" + EIGHT_FUNCTIONS.replace("2 * x + 3", "math.exp(x) - 3")

    before = chosen_lines({"a.py": EIGHT_FUNCTIONS, "b.py": EIGHT_FUNCTIONS}, 999)  # more than there are
    after = chosen_lines({"a.py": edited, "b.py": EIGHT_FUNCTIONS}, 999)

    elsewhere = [row for row in before if row[:2] != ("a.py", "y = 2 * x + 3")]
    assert [row for row in after if row[:2] != ("a.py", "y = math.exp(x) - 3")] == elsewhere
    assert len(before) - len(elsewhere) == 4  # 2, *, + and 3


def test_fewer_changes_of_a_seed_are_the_first_of_more() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    texts = {"a.py": EIGHT_FUNCTIONS, "b.py": EIGHT_FUNCTIONS}
    assert chosen_lines(texts, 20) == chosen_lines(texts, 999)[:20]


def test_changes_of_equal_lines_and_of_equal_places_of_a_line_are_told_apart() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    text = "def f(x):\n    return x + x + x + x + x + x + x\n\n\ndef g(x):\n    return x + x + x\n"
    chosen = chosen_lines({"a.py": text}, 9)
    assert len(chosen) == 6 + 2  # every + of both lines
    assert len(set(chosen)) > 5  # some of them change to the same


def test_each_line_of_a_module_has_the_name_of_its_innermost_definition() -> None:
    text = "a = 1\nclass A:\n    b = 2\n    def f(self):\n        def g():\n            return 3\n        return 4\n"
    assert definition_names(text) == {2: "A", 3: "A", 4: "A.f", 5: "A.f.g", 6: "A.f.g", 7: "A.f"}


def test_change_has_its_line_before_and_after() -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    text = "a = [\n    1,\n    x <= 2,\n]\n"
    changes = [make_change("a.py", text, place) for place in find_places(text)]
    found = {(one.line, one.before, one.after) for one in changes if one}
    assert {(3, "x <= 2,", "x < 2,"), (2, "1,", "2,"), (2, "1,", "0,"), (3, "x <= 2,", "x <= 3,")} <= found


@pytest.mark.parametrize(
    "text",
    ["@dataclass(frozen=True)\nclass A:\n    pass\n", "def f(\n    a,\n    *,\n    b,\n):\n    pass\n"],
    ids=["flag of a decorator", "mark of keyword arguments"],
)
def test_decorators_and_marks_of_keyword_arguments_are_not_changed(text: str) -> None:
    pytest.importorskip("cosmic_ray", reason="it is in the extra mutation")
    assert choose_changes({"a.py": text}, count=9, seed="1") == []
