"""`ViewWindow`: the window of a view.  It opens at once, reads in a thread, and draws what the session delivers.

The loop is ours: VTK's own holds Python's lock while it waits, and the threads that read and draw would stand still.
Nothing that takes long is done in it.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator, Sequence

from clrecon.errors import UsageError
from clrecon.system.display import DisplayProbe, NoDisplayError
from clrecon.system.progress import take_interrupt
from clrecon.viewer.window.glass import Glass
from clrecon.viewer.window.layout import lay_out
from clrecon.viewer.window.loading import Load, Loading
from clrecon.viewer.window.pointer import Pointer
from clrecon.viewer.window.window_actions import WindowActions
from clrecon.viewer.window.window_content import WindowContent

SIZE = (1280, 860)
SMALLEST = (320, 240)
SCREEN_SHARE = 0.92
"""Of the screen, that the window has at most."""

CLOSE_S = 10.0
"""Longest wait for work that was cancelled.  Reading looks at each slice whether it is to go on; a kernel that is being
built is built to its end: a driver does not like to end in the middle of it."""

TICK_S = 0.008
"""Longest wait for a picture between two looks at the events."""


def show_window(
    load: Load,
    *,
    title: str = "clrecon view",
    size: tuple[int, int] = SIZE,
    save_as: Sequence[str] = (),
    say: Callable[[str], None] = lambda words: None,
    describe: Callable[[str], str] = str,
    loaded: Callable[[], None] = lambda: None,
    probe: DisplayProbe | None = None,
) -> None:
    """Show a view in a window until it is closed.

    load: See `Load`.  The session is closed with the window.
    size: (width, height). Pixels, at most; on a smaller screen the window is smaller.
    save_as: Files that a save writes; numbers are added where they exist.
    say: Gets lines for the console: what was saved.
    describe: Returns words for a stage of the progress.
    loaded: Called when what was loaded is shown.
    probe: One that has been started.
    """
    probe = probe or DisplayProbe()
    # While the display is still tried, reading begins.
    loading = Loading(load, describe) if probe.is_running else None
    try:
        found = probe.wait()
        if found.fault is not None or loading is None:
            raise NoDisplayError(f"no window can be opened: {found.fault}")
        glass = Glass(title, lay_out(size), found)
        try:
            ViewWindow(glass, save_as=save_as, say=say, loaded=loaded).run(loading, size)
        finally:
            glass.close()
    finally:
        if loading is not None:
            loading.close(CLOSE_S)


class ViewWindow:
    """The window; see `show_window`, which makes one.

    save_as, say, loaded: See `show_window`.
    """

    def __init__(
        self,
        glass: Glass,
        *,
        save_as: Sequence[str] = (),
        say: Callable[[str], None] = lambda words: None,
        loaded: Callable[[], None] = lambda: None,
    ):
        self.glass, self._loaded = glass, loaded
        self.content = WindowContent(glass)
        self.pointer = Pointer()
        self.actions = WindowActions(self.content, end=self.end, save_as=save_as, say=say)
        self._moved = False
        self._failure: BaseException | None = None
        self._ended = threading.Event()

    def run(self, loading: Loading, size: tuple[int, int] = SIZE) -> None:
        """Open the window, show what is loaded, and return when it is closed."""
        glass, interactor = self.glass, self.glass.interactor
        screen = glass.window.GetScreenSize()
        fitting = [
            max(least, min(wish, round(SCREEN_SHARE * most)))
            for least, wish, most in zip(SMALLEST, size, screen, strict=True)
        ]
        glass.window.SetSize(*fitting)
        interactor.Initialize()
        self.content.lay_out()
        self.content.tick(False, False)
        self._observe()
        with self._interruptible():
            while not self._ended.is_set():
                interactor.ProcessEvents()
                if take_interrupt():
                    self._interrupt()
                self._guarded(lambda: self._tick(loading))
                self.content.wait(TICK_S)
        self._close()
        if self._failure is not None:
            raise self._failure

    def end(self) -> None:
        """Leave the loop; what is running is cancelled."""
        self._ended.set()
        self.glass.interactor.TerminateApp()

    def _close(self) -> None:
        """Cancel what runs, and wait for it."""
        self._ended.set()
        self.glass.close()  # first: what is running may need a moment
        self.actions.close()
        if self.content.session is not None:
            self.content.session.close(CLOSE_S)

    def _interrupt(self) -> None:
        self._failure = KeyboardInterrupt()
        self.end()

    @contextlib.contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let Ctrl-C end the loop where it is not held back: an exception in an event would only be printed by VTK."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        before = signal.signal(signal.SIGINT, lambda *_: self._interrupt())
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    # Events

    def _observe(self) -> None:
        events: dict[str, Callable[[], None]] = {
            "ExitEvent": self.end,
            "ExposeEvent": self.glass.touch_all,
            "MouseMoveEvent": self._move,
            "MouseWheelForwardEvent": lambda: self._wheel(1),
            "MouseWheelBackwardEvent": lambda: self._wheel(-1),
            "KeyPressEvent": self._key,
        }
        for button in ("Left", "Middle", "Right"):
            events[f"{button}ButtonPressEvent"] = lambda button=button: self._press(button.lower())  # type: ignore[misc]
            events[f"{button}ButtonDoubleClickEvent"] = events[f"{button}ButtonPressEvent"]
            events[f"{button}ButtonReleaseEvent"] = self._release
        for name, action in events.items():
            self.glass.interactor.AddObserver(name, lambda *_, action=action: self._guarded(action))

    def _guarded(self, action: Callable[[], None]) -> None:
        """Do something in an event of VTK, which would only print an exception: wrong commands are said, faults end."""
        if self._ended.is_set():
            return
        try:
            action()
        except UsageError as error:
            self.content.say(str(error), warning=True)
        except BaseException as error:
            self._failure = error
            self.end()

    def _tick(self, loading: Loading) -> None:
        if self.content.session is None:
            session = loading.take()
            if session is None:
                self.content.say_lines("clrecon", loading.words)
            else:
                self._loaded()
                self.content.attach(session)
        if tuple(self.glass.window.GetSize()) != self.glass.layout.size:
            self.content.lay_out()
        if self._moved:
            self._moved = False
            self.actions.apply(self.pointer.move(self.glass.layout, self.glass.place()))
        self.content.tick(self.actions.is_busy, self.pointer.is_busy)
        self.actions.tick()

    def _press(self, button: str) -> None:
        interactor = self.glass.interactor
        self.content.touch()
        held = {"shift": bool(interactor.GetShiftKey()), "control": bool(interactor.GetControlKey())}
        self.actions.apply(
            self.pointer.press(button, self.glass.layout, self.content.panels, self.glass.place(), **held)
        )

    def _move(self) -> None:
        self._moved = True  # moves are many: `_tick` takes the last of them

    def _release(self) -> None:
        at = self.glass.place()
        self._moved = False
        self.actions.apply(self.pointer.move(self.glass.layout, at))
        self.actions.apply(self.pointer.release(self.glass.layout, at))
        self.actions.let_go()

    def _wheel(self, steps: int) -> None:
        self.content.touch()
        self.actions.apply(self.pointer.wheel(self.glass.layout, self.glass.place(), steps))

    def _key(self) -> None:
        self.content.touch()
        self.actions.press(self.glass.interactor.GetKeySym() or "", self.glass.place())
