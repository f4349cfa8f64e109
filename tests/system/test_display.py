"""What the output and the exit code of the process that tries a display mean; windows try real displays."""

from __future__ import annotations

import json
import sys

import pytest

from clrecon.system.display import Display, DisplayProbe, read_words


def printed_by_child(*facts: dict[str, object]) -> bytes:
    """What a process that tries a display prints: a line of JSON for each."""
    return b"".join(json.dumps(each).encode() + b"\n" for each in facts)


START = {"display": True, "window": "vtkXOpenGLRenderWindow"}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays have names in X11")
@pytest.mark.parametrize(
    ("output", "code", "fault"),
    [
        (printed_by_child({"display": False}), 0, "the display :5 does not answer"),
        (printed_by_child(START), -11, "OpenGL does not work on the display :5: drawing ended a process with -11"),
        (b"", 139, "OpenGL does not work on the display :5: drawing ended a process with 139"),
        (printed_by_child({"display": True, "missing": "no vtk"}), 0, "VTK cannot be imported (no vtk)"),
        (
            printed_by_child({"display": True, "window": "vtkEGLRenderWindow", "drawn": True}),
            0,
            "the display :5 has no OpenGL (GLX)",
        ),
        (
            printed_by_child(START, {**START, "drawn": False}),
            0,
            "OpenGL does not work on the display :5: what was drawn is not seen",
        ),
    ],
    ids=["no answer", "crash", "crash by code of a shell", "no VTK", "no GLX", "nothing drawn"],
)
def test_fault_of_a_display_is_read_from_the_output_and_exit_code(output, code, fault, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":5")
    assert read_words(output, code) == Display(fault=fault)


def test_display_that_draws_has_no_fault_and_the_name_of_its_driver(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":5")
    output = printed_by_child(START, {**START, "drawn": True, "driver": ["llvmpipe (LLVM 15)"]})
    assert read_words(output, 0) == Display(fault=None, driver="llvmpipe (LLVM 15)")


@pytest.mark.parametrize(("driver", "is_software"), [("llvmpipe (LLVM 15)", True), ("NVIDIA H100", False)])
def test_llvmpipe_is_a_software_driver(driver, is_software):
    assert Display(driver=driver).is_software == is_software


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays have names in X11")
@pytest.mark.parametrize(
    ("wayland", "words"),
    [(None, "there is no display here (DISPLAY is not set)"), ("wayland-0", "Xwayland")],
    ids=["no display at all", "Wayland alone"],
)
def test_probe_without_an_x11_display_finds_a_fault(wayland, words, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if wayland is not None:
        monkeypatch.setenv("WAYLAND_DISPLAY", wayland)
    assert words in (DisplayProbe().wait().fault or "")
