"""What the words and the end of the child that tries a display mean; real displays are tried with the window."""

from __future__ import annotations

import json
import sys

import pytest

from clrecon.system.display import Display, DisplayProbe, read_words


def told(*facts: dict[str, object]) -> bytes:
    return b"".join(json.dumps(each).encode() + b"\n" for each in facts)


START = {"display": True, "window": "vtkXOpenGLRenderWindow"}


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays have names in X11")
@pytest.mark.parametrize(
    ("words", "code", "fault"),
    [
        (told({"display": False}), 0, "the display :5 does not answer"),
        (told(START), -11, "OpenGL does not work on the display :5: drawing ended a process with -11"),
        (b"", 139, "OpenGL does not work on the display :5: drawing ended a process with 139"),
        (told({"display": True, "missing": "no vtk"}), 0, "VTK cannot be imported (no vtk)"),
        (
            told({"display": True, "window": "vtkEGLRenderWindow", "drawn": True}),
            0,
            "the display :5 has no OpenGL (GLX)",
        ),
        (
            told(START, {**START, "drawn": False}),
            0,
            "OpenGL does not work on the display :5: what was drawn is not seen",
        ),
    ],
)
def test_each_fault_of_a_display_is_described(words, code, fault, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":5")
    assert read_words(words, code) == Display(fault)


def test_a_display_that_draws_has_none_and_its_driver_is_known(monkeypatch):
    monkeypatch.setenv("DISPLAY", ":5")
    found = read_words(told(START, {**START, "drawn": True, "driver": ["llvmpipe (LLVM 15)"]}), 0)
    assert found == Display(None, "llvmpipe (LLVM 15)") and found.is_software
    assert not Display(None, "NVIDIA H100").is_software


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays have names in X11")
def test_without_a_display_no_child_is_started(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert DisplayProbe().wait().fault == "there is no display here (DISPLAY is not set)"
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    fault = DisplayProbe().wait().fault
    assert fault is not None and "Xwayland" in fault
