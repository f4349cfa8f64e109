"""Is there a screen, and does OpenGL work on it?  A child process tries it.

VTK ends the process with a segmentation fault where there is no OpenGL, and opens an invisible window where the display
does not answer.  So 8 x 8 pixels are really drawn, in a process whose end harms nobody.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

from clrecon.errors import UsageError
from clrecon.system.light_dataclass import dataclass

SECONDS = 30.0
"""Until the child is given up; it takes half a second where nothing else runs."""

_SOFTWARE = ("llvmpipe", "softpipe", "swiftshader", "swr", "software")
"""Words of drivers that draw with the processor."""

_TRIES = 4
"""Attempts to reach the display, a tenth of a second apart."""

_CHILD = """\
import ctypes, json, os, sys, time
def tell(**facts):
    print(json.dumps(facts), flush=True)
if sys.platform.startswith("linux"):
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        x11 = None
    if x11 is not None:
        x11.XOpenDisplay.restype = ctypes.c_void_p
        for attempt in range(_TRIES):  # a server that has just lost its last client begins anew, and is deaf meanwhile
            if x11.XOpenDisplay(None):
                break
            time.sleep(0.1)
        else:
            tell(display=False)
            sys.exit()
try:
    import vtkmodules.vtkRenderingOpenGL2
    from vtkmodules.vtkCommonCore import vtkUnsignedCharArray
    from vtkmodules.vtkRenderingCore import vtkRenderer, vtkRenderWindow
except ImportError as error:
    tell(display=True, missing=str(error))
    sys.exit()
window, renderer, pixels = vtkRenderWindow(), vtkRenderer(), vtkUnsignedCharArray()
tell(display=True, window=window.GetClassName())
window.SetShowWindow(False)
window.SetSize(8, 8)
window.SetMultiSamples(0)
renderer.SetBackground(1.0, 0.5, 0.0)
window.AddRenderer(renderer)
window.Render()
window.GetPixelData(0, 0, 7, 7, 0, pixels, 0)
words = window.ReportCapabilities()
driver = [line.split(":", 1)[1].strip() for line in words.splitlines() if "renderer string" in line.lower()]
red, green, blue = pixels.GetTuple(9)
tell(display=True, window=window.GetClassName(), drawn=red > 250 and 100 < green < 160 and blue < 5, driver=driver[:1])
"""


class NoDisplayError(UsageError):
    """No window can be opened here."""


@dataclass(frozen=True)
class Display:
    """What OpenGL's `driver` calls itself, and the `fault`, the end of a sentence, if no window can be opened."""

    fault: str | None = None
    driver: str = ""

    @property
    def is_software(self) -> bool:
        """True where the processor draws: smoothing of edges by many samples would take most of the time."""
        return any(word in self.driver.lower() for word in _SOFTWARE)


class DisplayProbe:
    """The child that tries the display while the caller prepares something else; none where the answer is known."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[bytes] | None = None
        self._fault: str | None = None
        if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
            self._fault = "there is no display here (DISPLAY is not set)"
            if os.environ.get("WAYLAND_DISPLAY"):
                self._fault = "this Wayland session has no X display (DISPLAY is not set): start Xwayland"
        elif getattr(sys, "frozen", False) or not sys.executable:
            self._fault = "the display is tried by a Python interpreter, and this program has none"
        else:
            try:
                self._child = subprocess.Popen(
                    [sys.executable, "-c", _CHILD.replace("_TRIES", str(_TRIES))],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )
            except OSError as error:
                self._fault = f"no process can be started to try the display: {error.strerror or error}"

    @property
    def is_running(self) -> bool:
        """True until `wait` has its answer; False at once where no display can be there."""
        return self._child is not None

    def __enter__(self) -> DisplayProbe:
        return self

    def __exit__(self, *_: object) -> None:
        if self._child is not None:  # nobody asked
            self._child.kill()
            self._child.communicate()

    def wait(self, seconds: float = SECONDS) -> Display:
        """Return what was found, when the child has ended."""
        if self._child is None:
            return Display(self._fault)
        child, self._child = self._child, None
        try:
            output, _ = child.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            child.kill()
            child.communicate()
            return Display(f"{_where()} did not draw a window within {seconds:g} s")
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
        return read_words(output, child.returncode)


def read_words(output: bytes, code: int) -> Display:
    """Return what the words of a child (lines of JSON, each with more than the one before) and its exit status mean."""
    try:
        facts = json.loads(output.decode().splitlines()[-1])
    except (ValueError, IndexError):
        facts = {}
    if not facts.get("display", True):
        return Display(f"{_where()} does not answer")
    if "missing" in facts:
        return Display(f"VTK cannot be imported ({facts['missing']})")
    window = facts.get("window", "")
    if code != 0:
        return Display(f"OpenGL does not work on {_where()}: drawing ended a process with {code}")
    if sys.platform.startswith("linux") and "X" not in window.removeprefix("vtk")[:1]:
        return Display(f"{_where()} has no OpenGL (GLX)")
    if not facts.get("drawn"):
        return Display(f"OpenGL does not work on {_where()}: what was drawn is not seen")
    return Display(None, "".join(facts.get("driver", ())))


def _where() -> str:
    name = os.environ.get("DISPLAY")
    return f"the display {name}" if name else "the display"
