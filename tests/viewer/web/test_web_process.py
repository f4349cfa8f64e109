"""`clrecon view` as a process: without VTK and without a screen, ended by Ctrl-C, and wrong arguments."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import view_scenes as scenes
from dicom_series import Plan, write_series
from printed_text import Printer
from variants import daily
from web_views import browsing, get_path, secret_of

from clrecon.cli.main import main
from clrecon.errors import NoDicomError, RefusedInputError
from clrecon.reading.grids.write_volume import write_volume
from clrecon.viewer.web.server import bind_port

SECONDS_TO_END = 10.0
"""Of patience; it takes milliseconds where nothing else runs."""

WITHOUT = """
import sys
for name in ("pyvista", "vtk", "vtkmodules"):
    sys.modules[name] = None
from clrecon.cli.main import run
run()
"""


@pytest.fixture(scope="module")
def scan(tmp_path_factory) -> Path:
    """The file of a scan of three balls."""
    path = tmp_path_factory.mktemp("view") / "scan.nii.gz"
    write_volume(scenes.make_scan(), path)
    return path


@contextmanager
def start_view(*arguments: str) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    """A process whose server is ready, with what it printed; without VTK and without a screen."""
    screens = ("DISPLAY", "WAYLAND_DISPLAY")
    environment = {name: value for name, value in os.environ.items() if name not in screens}
    process = subprocess.Popen(
        [sys.executable, "-c", WITHOUT, "view", *arguments, "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip
    try:
        text = ""
        while not text.endswith("}\n"):
            line = process.stdout.readline()
            assert line, process.stderr.read()
            text += line
        yield process, json.loads(text)
    finally:
        process.kill()
        process.communicate()


@pytest.mark.seconds
@pytest.mark.opencl
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
@pytest.mark.parametrize("number", daily(1, [signal.SIGINT, signal.SIGTERM]))
def test_signal_ends_the_server_without_a_word_while_pictures_are_drawn(device, scan: Path, number: int) -> None:
    with start_view(str(scan), "--device", str(device.index), "--hu", "321") as (process, said):
        server = SimpleNamespace(port=said["port"], address=said["address"])

        async def end_while_the_view_turns() -> float:
            async with browsing(server) as client:
                await client.lay_out(scene=[300, 200], axial=[100, 100])
                await client.until(lambda: client.pictures)
                await client.tell(do="turn", dx=0.1, dy=0.1)
                process.send_signal(number)
                await client.until(lambda: client.close_code is not None)
                return client.facts["iso"]["hu"]

        hu = asyncio.run(end_while_the_view_turns())

        assert process.wait(SECONDS_TO_END) == 0
        assert process.stderr.read() == ""
        assert hu == 321.0  # the view that was asked for was there


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.opencl
@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")
def test_server_removes_its_folder_of_temporary_files_when_a_signal_ends_it(
    device, scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))

    with start_view(str(scan), "--device", str(device.index)) as (process, _):
        assert len(list(tmp_path.glob("clrecon-*"))) == 1
        process.send_signal(signal.SIGINT)
        assert process.wait(SECONDS_TO_END) == 0

    assert list(tmp_path.glob("clrecon-*")) == []


@pytest.mark.seconds
@pytest.mark.opencl
def test_folder_of_two_series_opens_the_start_page_with_both_of_them(device, tmp_path: Path) -> None:
    for number in (1, 2):
        write_series(tmp_path / str(number), Plan(shape=(7, 30, 40), series=number))

    with start_view(str(tmp_path), "--device", str(device.index)) as (_, said):
        server = SimpleNamespace(port=said["port"], address=said["address"])
        query = f"?secret={secret_of(server)}"
        status, _, told = get_path(server, f"/start/progress{query}")
        _, _, listed = get_path(server, f"/start/list{query}", "POST", Origin=f"http://127.0.0.1:{server.port}")

    assert (status, json.loads(told)["listed"]) == (200, True)
    assert [choice["title"] for choice in json.loads(listed)["choices"]] == ["series 1 · CT", "series 2 · CT"]
    assert any("choose it on the page" in warning for warning in said["warnings"])


def test_folder_of_one_series_that_is_refused_is_refused_by_the_view(tmp_path: Path, printed: Printer) -> None:
    write_series(tmp_path / "one", Plan(shape=(9, 30, 40), leave_out=(4,)))

    assert main(["view", str(tmp_path), "--no-open"]) == RefusedInputError.exit_code

    printed().assert_error("--allow-gaps")


def test_picture_of_a_folder_of_two_series_is_refused_with_the_option_that_chooses(
    tmp_path: Path, printed: Printer
) -> None:
    for number in (1, 2):
        write_series(tmp_path / str(number), Plan(shape=(7, 30, 40), series=number))

    assert main(["view", str(tmp_path), "--picture", str(tmp_path / "a.png")]) == RefusedInputError.exit_code

    printed().assert_error("--series")


@pytest.mark.release
@pytest.mark.seconds
@pytest.mark.opencl
def test_server_without_a_screen_warns_that_it_opens_no_browser(device, scan: Path) -> None:
    with start_view(str(scan), "--device", str(device.index)) as (_, said):
        assert any("there is no screen" in warning for warning in said["warnings"])


WRONG_ARGUMENTS = {
    "port 0": (["--port", "0"], "a port is a whole number from 1 to 65535, not 0"),
    "port in words": (["--port", "x"], "'x' is no whole number"),
    "port of a page file": (["--html", "page.html", "--port", "8000"], "--port belongs to the view in the browser"),
    "no-open of a page file": (["--html", "page.html", "--no-open"], "--no-open belongs to the view in the browser"),
    "names in a window": (["--window", "--save-as", "a.stl"], "--save-as belongs to the view in the browser"),
    "window and page file": (["--window", "--html", "page.html"], "ask for one of them"),
    "quiet without a browser": (["--no-open", "-q"], "-q hides the address"),
    "no-clobber": (["--no-clobber"], "leave --no-clobber out"),
    "solid": (["--solid"], "--solid says how a mesh is made"),
    "two iso values": (["--hu", "100,200"], "a view begins with one iso value"),
}


@pytest.mark.parametrize(("arguments", "said"), WRONG_ARGUMENTS.values(), ids=WRONG_ARGUMENTS)
def test_wrong_arguments_are_said_in_one_line_before_anything_is_read(
    capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["view", "no_such_folder", *arguments]) == 3
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_port_that_is_taken_is_said_before_anything_is_read(printed: Printer) -> None:
    with bind_port() as listener:
        port = listener.getsockname()[1]
        assert main(["view", "no_such_folder", "--port", str(port)]) == 3
    printed().assert_error(port, "--port")


def test_input_that_is_not_there_is_named_with_the_exit_code_of_no_input(printed: Printer) -> None:
    assert main(["view", "no_such_folder"]) == NoDicomError.exit_code
    printed().assert_error("no_such_folder")


@pytest.mark.unit
def test_fault_that_the_view_logs_is_printed_with_its_trace(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    def serve(*given: Any, **named: Any) -> None:
        try:
            raise ValueError("a number of another kind")
        except ValueError:
            logging.getLogger("clrecon.viewer.session.session").exception("mesh failed")

    monkeypatch.setattr("clrecon.viewer.web.server.serve_view", serve)
    assert main(["view", "scan.nii.gz"]) == 0, "the view goes on"
    said = capsys.readouterr().err
    assert "mesh failed" in said, said
    assert "in serve" in said and "ValueError: a number of another kind" in said, said
    assert not logging.getLogger("clrecon.viewer").handlers, "what listened is gone with the view"


@pytest.mark.parametrize("options", [["--no-open", "--labels", "map.nii.gz"], ["--html", "page.html"]])
def test_option_of_an_input_without_one_is_refused_by_its_name(options: list[str], printed: Printer) -> None:
    assert main(["view", *options]) == 3

    printed().assert_error(options[-2])
