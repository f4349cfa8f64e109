"""`clrecon compare`: all methods on a small phantom, the page, the folder, and what is refused."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import report_schemas
from child_code import run_instead
from html_check import PageCheck, find_faults
from made_once import make_once
from printed_text import Printer
from refusals import refused

from clrecon.cli.compare import _is_missed
from clrecon.cli.main import main
from clrecon.errors import DeviceError, NoSurfaceError, OutputError, UsageError
from clrecon.jobs.run import to_json
from clrecon.proof.compare import child, job
from clrecon.proof.compare.findings import CompareReport, MethodRecord
from clrecon.proof.compare.job import make_comparison
from clrecon.proof.compare.judge import Judge
from clrecon.proof.compare.methods import COMPARED, CompareSettings
from clrecon.proof.compare.processes import MEASURES, Request
from clrecon.proof.compare.table import COLUMNS
from clrecon.proof.phantom import PhantomSettings, write_phantom

pytestmark = pytest.mark.first_device

MOST_BYTES = 2_000_000
OF_TIME = re.compile(r"_s$|_ms$|seconds|_bytes$|^date$|free_cores|findings|warnings")
"""Entries of times, memory and the machine's load; findings and warnings tell of these too."""
NOBODY_TELLS = "import os; os.abort()"
ONE_CRASHES = """
import os, sys
from clrecon.proof.compare import child
run_method = child.run_method
def fail(request):
    if request.method == "skimage":
        os.abort()
    if request.method == "vtk-mc":
        sys.modules["vtkmodules"] = None
    return run_method(request)
child.run_method = fail
child.main()
"""


def _write_ball(folder: Path) -> None:
    settings = PhantomSettings(
        kind="sphere", size=(44, 40), slices=30, spacing=(0.9, 0.8, 1.1), tilt=6.0, oblique=(4.0, -3.0, 10.0)
    )
    write_phantom(folder, settings)


@pytest.fixture(scope="module")
def ball(shared_folder: Path) -> Path:
    """A series of a ball in tilted, oblique slices, and its truth."""
    return make_once(shared_folder, "compare-ball", _write_ball)


def read_report(folder: Path) -> dict[str, Any]:
    """The report of a comparison, which is as its schema says."""
    report = json.loads((folder / "report.json").read_text())
    assert report["schema"] == "clrecon-compare-1"
    assert report_schemas.find_faults(report) == []
    return report


@pytest.fixture(scope="module")
def comparison(ball: Path, shared_folder: Path) -> Path:
    """The comparison of all methods, with truth and the table of the paper."""

    def make(folder: Path) -> None:
        settings = CompareSettings(truth=ball / "truth.json", paper=True, repeat=1, device=_first_device())
        make_comparison(ball, folder, settings)

    return make_once(shared_folder, "compare-whole", make)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods and measures without processes of their own."""
    leave_processes_out(monkeypatch)


def leave_processes_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Methods and measures in this process: each of their own takes seconds to import."""

    def run_method(request: Request) -> dict[str, Any]:
        return json.loads(to_json(child.run_method(request)))

    def measure(told: Mapping[str, Any], methods: Sequence[str]) -> Iterator[tuple[str, dict[str, Any]]]:
        judge = Judge({**told, "measures": list(MEASURES)})
        yield from ((name, json.loads(to_json(judge.measure(name)))) for name in methods)

    monkeypatch.setattr(job, "open_methods", lambda: nullcontext(run_method))
    monkeypatch.setattr(job, "measure_in_processes", measure)


def _first_device() -> str | None:
    wanted = os.environ.get("CLRECON_TEST_DEVICE", "")
    return wanted or None


@pytest.mark.release
@pytest.mark.long
def test_methods_of_a_comparison_have_the_figures_that_follow_from_their_algorithms(
    device: Any, comparison: Path
) -> None:
    report = read_report(comparison)
    assert {m["name"]: m["error"] for m in report["methods"]} == dict.fromkeys(COMPARED)
    truth = {m["name"]: m["truth"]["scatter_mm"] for m in report["methods"] if m["makes"] == "mesh"}
    assert truth["t-mc"] < 0.05 < truth["i-mc-golden"]  # vertices at the golden section lie beside the ball
    rows = {m["name"]: m for m in report["methods"]}
    assert rows["t-mc"]["triangles"] == rows["vtk-fe"]["triangles"] == rows["t-mc-soup"]["triangles"]
    assert rows["g-mc"]["triangles"] < 0.2 * rows["t-mc"]["triangles"]  # cells of two voxels, and more
    assert rows["t-mc-soup"]["surfaces"]["max_mm"] < 1e-4  # float32
    assert rows["t-mc"]["cells"]["dice"] == rows["vtk-mc"]["cells"]["dice"] == 1.0
    assert rows["i-mc"]["cells_visited"] < rows["i-mc"]["cells_all"] == rows["t-mc"]["cells_visited"]
    assert rows["i-mc-golden"]["slices"]["dice"] < rows["i-mc"]["slices"]["dice"] - 0.01  # measured 0.015 less


@pytest.mark.release
@pytest.mark.long
def test_triangle_soup_of_a_surface_has_the_picture_of_the_surface(device: Any, comparison: Path) -> None:
    [soup] = [m for m in read_report(comparison)["methods"] if m["name"] == "t-mc-soup"]
    assert soup["pictures"]["mse"] < 2e-5  # measured 4e-6
    assert soup["pictures"]["ssim"] > 0.999999  # measured 8e-8 less than 1


@pytest.mark.release
@pytest.mark.long
def test_cloud_of_a_comparison_has_points_and_their_distance_from_the_reference(device: Any, comparison: Path) -> None:
    [cloud] = [m for m in read_report(comparison)["methods"] if m["name"] == "cloud"]
    assert cloud["points"] > 0
    assert cloud["points_mm"]["to_reference_mm"]["mean"] > 0.0


@pytest.mark.release
@pytest.mark.long
@pytest.mark.parametrize("name", COMPARED)
def test_method_of_a_comparison_has_its_times_memory_and_picture(name: str, device: Any, comparison: Path) -> None:
    [method] = [m for m in read_report(comparison)["methods"] if m["name"] == name]
    assert method["first_s"] > 0
    assert method["warm_s"] > 0
    assert method["memory_bytes"] > 3e7  # Python and numpy
    assert (comparison / method["picture"]).read_bytes()[:4] == b"\x89PNG"


@pytest.mark.release
@pytest.mark.long
def test_folder_of_a_comparison_has_its_pictures_of_slices(device: Any, comparison: Path) -> None:
    assert {path.name for path in comparison.iterdir()} >= {"slice-k.png", "slice-k-detail.png", "slice-i.png"}


@pytest.mark.release
@pytest.mark.long
def test_parts_of_the_first_time_of_a_method_add_up_to_it(device: Any, comparison: Path) -> None:
    for method in read_report(comparison)["methods"]:
        parts = method["first_parts_s"]
        assert set(parts) == {"read", "build", "upload", "kernels", "host", "download", "draw"}
        assert sum(parts.values()) - parts["read"] - parts["draw"] == pytest.approx(method["first_s"])
        assert (method["kernels_ms"] is not None) == COMPARED[method["name"]].on_device


@pytest.mark.release
@pytest.mark.long
def test_page_of_a_comparison_is_valid_html_of_less_than_2_mb(device: Any, comparison: Path) -> None:
    page = (comparison / "index.html").read_text(encoding="utf-8")
    assert find_faults(page) == []
    assert len(page.encode()) < MOST_BYTES


@pytest.mark.release
@pytest.mark.long
def test_page_of_a_comparison_has_all_its_pictures_within(device: Any, comparison: Path) -> None:
    pictures = PageCheck((comparison / "index.html").read_text(encoding="utf-8")).pictures
    assert len(pictures) == 14 + 12 + 4  # methods, differences from the reference, two slices with a detail of each
    assert {picture["src"].partition(",")[0] for picture in pictures} == {"data:image/webp;base64"}


@pytest.mark.release
@pytest.mark.long
def test_page_of_a_comparison_has_three_drawings_and_one_style_for_dark_screens_and_print(
    device: Any, comparison: Path
) -> None:
    page = (comparison / "index.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 3
    assert "<text" in page
    assert page.count("<style") == 1
    assert "prefers-color-scheme: dark" in page
    assert "@media print" in page


@pytest.mark.release
@pytest.mark.long
def test_table_of_the_page_has_the_numbers_of_the_report(device: Any, comparison: Path) -> None:
    page = PageCheck((comparison / "index.html").read_text(encoding="utf-8"))
    rows = {row[0]: row[1:] for row in page.tables[0] if len(row) > 2}
    for method in read_report(comparison)["methods"]:
        record = MethodRecord(**method)
        values = [(column.take(record), column.write) for column in COLUMNS]
        expected = ["\N{EN DASH}" if value is None else write(value) for value, write in values]
        assert rows[method["title"]][: len(COLUMNS)] == expected


@pytest.mark.release
@pytest.mark.long
def test_page_of_a_comparison_has_every_finding_of_the_report(device: Any, comparison: Path) -> None:
    page = (comparison / "index.html").read_text(encoding="utf-8")
    findings = read_report(comparison)["findings"]
    assert findings
    assert [finding for finding in findings if finding.replace("'", "&#x27;") not in page] == []


@pytest.mark.release
@pytest.mark.long
def test_table_of_the_paper_has_the_likeness_of_a_black_picture(device: Any, comparison: Path) -> None:
    page = PageCheck((comparison / "index.html").read_text(encoding="utf-8"))
    rows = {row[0]: row for row in page.tables[2] if len(row) > 2}
    likeness_column = 3
    assert rows["all black"][likeness_column] == f"{read_report(comparison)['paper']['controls']['black']['ssim']:.3f}"


@pytest.mark.release
@pytest.mark.long
def test_methods_are_compared_with_the_paper_and_with_control_pictures(device: Any, comparison: Path) -> None:
    paper = read_report(comparison)["paper"]
    assert list(paper["controls"]) == ["black", "white", "noise", "next", "shifted"]
    assert set(paper["methods"]) == {name for name in COMPARED if name != "rays-cpu"}
    assert paper["controls"]["next"]["ssim"] > paper["controls"]["shifted"]["ssim"] > paper["controls"]["noise"]["ssim"]


@pytest.mark.release
@pytest.mark.long
def test_written_report_of_a_comparison_is_read_again_unchanged(device: Any, comparison: Path) -> None:
    entries = read_report(comparison)
    del entries["schema"]  # named by the class
    entries["methods"] = [MethodRecord(**method) for method in entries["methods"]]
    assert CompareReport(**entries).as_dict() == read_report(comparison)


def without_time(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: without_time(own) for name, own in value.items() if not OF_TIME.search(name)}
    return [without_time(own) for own in value] if isinstance(value, list) else value


@pytest.mark.release
@pytest.mark.long
def test_comparison_in_one_process_has_the_figures_and_pictures_of_one_with_a_process_for_each_method(
    device: Any, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = CompareSettings(methods=("t-mc", "vtk-fe", "cloud"), repeat=1, device=str(device.index))
    make_comparison(ball, tmp_path / "one", settings)
    leave_processes_out(monkeypatch)
    make_comparison(ball, tmp_path / "other", settings)
    one, other = (read_report(tmp_path / name) for name in ("one", "other"))
    assert without_time(one) == without_time(other)
    pictures = sorted(path.name for path in (tmp_path / "one").glob("*.png"))
    assert len(pictures) == 3 + 2 + 4  # methods, differences from the reference, two slices with a detail of each
    for name in pictures:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


@pytest.mark.parametrize(
    ("state", "named", "is_missed"),
    [
        ("done", (), False), ("declined", (), False), ("failed", (), True),
        ("declined", ("vtk-mc",), True), ("declined", ("skimage",), False),
    ],
)  # fmt: skip
def test_only_a_failed_method_or_a_named_one_that_did_not_run_fails_the_comparison(
    state: str, named: tuple[str, ...], is_missed: bool
) -> None:
    assert _is_missed({"name": "vtk-mc", "state": state}, named) == is_missed


@pytest.mark.parametrize(("error", "state"), [(UsageError("no"), "declined"), (DeviceError("no"), "failed")])
def test_method_that_refuses_its_input_has_declined_and_one_without_a_device_has_failed(
    error: Exception, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(folder: Path) -> Any:
        raise error

    monkeypatch.setattr(child, "load_volume", refuse)
    request: Any = SimpleNamespace(timeout=10.0, method="t-mc", folder="scan")
    assert child.run_method(request)["state"] == state


@pytest.mark.seconds
def test_comparison_with_a_crashed_and_a_broken_method_ends_with_8_and_tells_why_in_report_and_page(
    device: Any, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, printed: Printer
) -> None:
    run_instead(monkeypatch, tmp_path.with_suffix(".code"), "clrecon.proof.compare.child", ONE_CRASHES)
    arguments = ["compare", str(ball), "-o", str(tmp_path / "r"), "--device", str(device.index), "--repeat", "1"]

    code = main([*arguments, "--methods", "skimage,vtk-mc,t-mc"])

    assert code == 8
    rows = {method["name"]: (method["state"], method["error"]) for method in read_report(tmp_path / "r")["methods"]}
    assert rows["t-mc"] == ("done", None)
    assert rows["vtk-mc"] == ("failed", "ModuleNotFoundError: import of vtkmodules halted; None in sys.modules")
    state, reason = rows["skimage"]
    assert state == "failed"
    assert "crashed with SIGABRT" in reason
    page = (tmp_path / "r" / "index.html").read_text()
    assert find_faults(page) == []
    assert "failed: its process crashed with SIGABRT" in page
    assert "failed: ModuleNotFoundError: import of vtkmodules" in page
    printed().assert_output("VTK", "MC")


@pytest.mark.release
def test_comparison_whose_reference_crashes_has_the_measures_that_need_none(
    device: Any, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_instead(monkeypatch, tmp_path.with_suffix(".code"), "clrecon.proof.compare.child", ONE_CRASHES)
    settings = CompareSettings(methods=("t-mc",), reference="skimage", repeat=1, device=str(device.index))

    report = make_comparison(ball, tmp_path / "r", settings)

    methods = {method.name: method for method in report.methods}
    assert methods["skimage"].state == "failed"
    assert methods["t-mc"].surfaces is None
    assert methods["t-mc"].slices is not None
    assert find_faults((tmp_path / "r" / "index.html").read_text()) == []


def test_comparison_in_which_every_method_crashes_is_an_error_and_leaves_no_folder(
    device: Any, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_instead(monkeypatch, tmp_path.with_suffix(".code"), "clrecon.proof.compare.child", NOBODY_TELLS)
    settings = CompareSettings(methods=("t-mc", "vtk-fe"), device=str(device.index))
    with refused(DeviceError, "SIGABRT", 2):
        make_comparison(ball, tmp_path / "r", settings)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.release
def test_measures_whose_process_crashes_are_missing_with_the_reason(
    device: Any, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_instead(monkeypatch, tmp_path.with_suffix(".code"), "clrecon.proof.compare.judge", NOBODY_TELLS)
    settings = CompareSettings(methods=("t-mc",), repeat=1, device=str(device.index))

    (record,) = make_comparison(ball, tmp_path / "r", settings).methods

    assert record.is_done
    assert record.slices is None
    assert "SIGABRT" in record.reasons["all"]
    assert "SIGABRT" in (tmp_path / "r" / "index.html").read_text()


@pytest.mark.parametrize(
    ("hu", "words"), [(5000.0, "no surface at 5000 HU: the volume runs from"), (-3000.0, "every voxel is inside")]
)
def test_iso_value_without_a_surface_is_refused_before_any_method_runs(
    hu: float, words: str, device: Any, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_instead(monkeypatch, tmp_path.with_suffix(".code"), "clrecon.proof.compare.child", NOBODY_TELLS)
    settings = CompareSettings(iso_value=hu, device=str(device.index))
    with pytest.raises(NoSurfaceError, match=words):
        make_comparison(ball, tmp_path / "r", settings)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--methods t-mc,x-mc", "there is no method 'x-mc' to compare: they are t-mc, t-mc-soup"),
        ("--methods t-mc,t-mc", "a method is named twice: t-mc"),
        ("--methods t-mc,,i-mc", "has an empty name"),
        ("--reference rays", "--reference rays makes no mesh to compare with"),
        ("--repeat 0", "between 1 and 100, not at 0"),
        ("--hu 100:300", "compared at one iso value"),
        ("--hu 100,300", "compared at one iso value"),
        ("--hu 100 --preset bone", "not allowed with"),
        ("--truth nowhere/truth.json", "there is no truth of a phantom nowhere\n"),
        ("--truth nosuch.json", "there is no truth of a phantom nosuch.json\n"),
    ],
)
def test_wrong_option_of_a_comparison_is_refused_in_one_line_before_input_and_device_are_looked_for(
    options: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)  # there is no scan
    monkeypatch.setenv("CLRECON_DEVICE", "no such device")

    code = main(["compare", "scan", "-o", "r", *options.split()])

    told = capsys.readouterr().err
    assert code == 3
    assert words in told
    assert told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        pytest.param("notes.txt", "holds other things", id="another file"),
        pytest.param("t-mc.png", "pictures without the page", id="a picture without the page"),
    ],
)
def test_folder_of_a_comparison_with_other_files_is_refused_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, words: str
) -> None:
    monkeypatch.setenv("CLRECON_DEVICE", "no such device")  # it is not looked for
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / name).write_text("mine")
    with pytest.raises(UsageError, match=words):
        make_comparison(tmp_path, tmp_path / "r")
    assert (tmp_path / "r" / name).read_text() == "mine"


def test_file_in_place_of_the_folder_of_a_comparison_is_refused_and_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CLRECON_DEVICE", "no such device")
    (tmp_path / "r").write_text("mine")
    with pytest.raises(OutputError, match="it is a file"):
        make_comparison(tmp_path, tmp_path / "r")
    assert (tmp_path / "r").read_text() == "mine"


def test_folder_of_a_comparison_in_a_folder_that_does_not_exist_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CLRECON_DEVICE", "no such device")
    with pytest.raises(OutputError, match="does not exist, make it first"):
        make_comparison(tmp_path, tmp_path / "none" / "r")


@pytest.fixture
def earlier_comparison(tmp_path: Path) -> Path:
    """A folder with page, report and one picture of an earlier comparison."""
    folder = tmp_path / "r"
    folder.mkdir()
    for name in ("index.html", "report.json", "s-mc.png"):
        (folder / name).write_text("old")
    return folder


def test_earlier_comparison_is_kept_and_the_new_one_refused_with_no_clobber(
    device: Any, ball: Path, earlier_comparison: Path
) -> None:
    settings = CompareSettings(methods=("t-mc",), repeat=1, device=str(device.index))
    with refused(OutputError, "no_clobber=True"):
        make_comparison(ball, earlier_comparison, settings, no_clobber=True)
    assert (earlier_comparison / "report.json").read_text() == "old"


@pytest.mark.seconds
@pytest.mark.usefixtures("in_this_process")
def test_earlier_comparison_is_replaced_as_a_whole_by_a_folder_with_the_rights_of_any_other(
    device: Any, ball: Path, earlier_comparison: Path
) -> None:
    settings = CompareSettings(methods=("t-mc",), repeat=1, device=str(device.index), keep_ids=True)
    stages: list[str] = []

    report = make_comparison(ball, earlier_comparison, settings, progress=lambda stage, *_: stages.append(stage))

    assert [entry.name for entry in earlier_comparison.parent.iterdir()] == ["r"]  # nothing of the work beside it
    assert not (earlier_comparison / "s-mc.png").exists()
    assert read_report(earlier_comparison)["methods"][0]["name"] == "t-mc"
    assert oct(earlier_comparison.stat().st_mode & 0o777) == oct(0o777 & ~_umask())
    assert {"read", "compare methods", "measure methods", "report"} <= set(stages)
    assert report.volume["series"]["uid_hash"]  # keep_ids


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
