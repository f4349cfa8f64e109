"""`WindowActions`: what keys, buttons and clicks of the window do; what asks the device is done in a thread."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from clrecon.errors import ClreconError
from clrecon.geometry import frame_from_lps
from clrecon.rendering.pictures.label_style import distinct_colors
from clrecon.system.text import format_volume
from clrecon.viewer.window.file_names import DEFAULT_MESH, DEFAULT_PICTURE, free_name
from clrecon.viewer.window.layout import PLANES
from clrecon.viewer.window.panels import slider_value
from clrecon.viewer.window.slice_dressing import slice_place
from clrecon.viewer.window.window_content import WindowContent
from clrecon.viewer.window.window_keys import find_key

ISO_STEP = 5.0
LEAST_BOX = 0.02
"""Share between the ends of a clip box."""

COLORS = 12
"""Colours that a click on a part's colour goes through."""

BOX_SHARE = 0.5
"""Of what is shown along each axis, in a clip box that is made by a key."""


class WindowActions:
    """What the user does.

    end: Closes the window.
    save_as: Files that a save writes; empty: a mesh.
    say: Gets lines for the console.
    """

    def __init__(
        self, content: WindowContent, *, end: Callable[[], None], save_as: Sequence[str], say: Callable[[str], None]
    ):
        self._content, self._end, self._say = content, end, say
        self._save_as = tuple(save_as) or (DEFAULT_MESH,)
        self._to_save: list[tuple[str, tuple[int, int]]] = []
        self._saving = False
        self._view = "anterior"
        self._hand: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._at_hand = 0
        self._thread = threading.Thread(target=self._work, name="view-hand", daemon=True)
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        """True while the device is asked what lies at a pixel."""
        return self._at_hand > 0

    def close(self) -> None:
        """End the thread, once it has answered."""
        self._hand.put(None)
        self._thread.join(1.0)

    def apply(self, actions: Iterable[Mapping[str, Any]]) -> None:
        """Do what a `Pointer` or a panel says."""
        for action in actions:
            if "scroll" in action and "do" not in action:
                self._scroll_parts(action["scroll"])
            elif self._content.session is None:
                continue
            elif "do" in action:
                self._content.do(action)
            elif "key" in action:
                self.press(action["key"], None)
            elif "at" in action:
                self._click(action)
            elif "window" in action:
                self._change_window(*action["window"])
            elif "nudge" in action:
                self._set_iso(self._content.facts["iso"]["hu"] + ISO_STEP * action["nudge"])
            elif "clip_box" in action:
                self._move_box(action["clip_box"], action["share"])
            elif "slider" in action:
                self._slide()
            elif "select" in action:
                self._select(action["select"])
            elif "recolor" in action:
                self._recolor(action["recolor"])

    def let_go(self) -> None:
        """The button was let go: the slider shows the model's value again."""
        if self._content.slider_hu is not None:
            self._content.slider_hu = None
            self._content.stale("slider")

    def press(self, name: str, at: tuple[float, float] | None) -> None:
        """Press a key, with the pointer at a place of the window; None: by a button."""
        key = find_key(name)
        if key is None:
            return
        if key.own in ("quit", "help", "escape"):
            getattr(self, f"_{key.own}")()
            return
        if self._content.session is None:
            return
        if key.command is not None:
            facts = self._content.do(key.command)
            if facts.get("undone"):
                self._content.say(f"undone: {facts['undone']}")
            elif name == "u":
                self._content.say("there is nothing to undo")
        else:
            getattr(self, f"_{key.own}")(*([at] if key.own in _AT_POINTER else []))

    def tick(self) -> None:
        """Write the next file that waits."""
        if not self._to_save or self._saving:
            return
        session = self._content.session
        assert session is not None
        wanted, size = self._to_save.pop(0)
        path = free_name(wanted)
        self._saving = True

        def then(lines: list[str]) -> None:
            self._content.call(lambda: self._saved(lines))

        try:
            session.save(path, then, size)
        except ClreconError as error:
            self._saving = False
            self._content.say(str(error), warning=True)

    # Keys

    def _quit(self) -> None:
        self._end()

    def _help(self) -> None:
        self._content.show_help(not self._content.help_shown)

    def _escape(self) -> None:
        content = self._content
        if content.help_shown:
            content.show_help(False)
        elif content.session is not None:
            if content.facts.get("tool"):
                content.do({"do": "end_tool"})
            else:
                content.do({"do": "cancel"})
                content.do({"do": "dismiss"})

    def _perspective(self) -> None:
        self._content.do({"do": "set_perspective", "on": bool(self._content.facts["camera"]["parallel"])})

    def _next_mode(self, step: int = 1) -> None:
        names = [mode["name"] for mode in self._content.facts["modes"]]
        at = names.index(self._content.facts["mode"])
        self._content.do({"do": "set_mode", "name": names[(at + step) % len(names)]})

    def _last_mode(self) -> None:
        self._next_mode(-1)

    def _table(self) -> None:
        self._content.do({"do": "set_table", "shown": not self._content.facts["table"]})

    def _iso_down(self) -> None:
        self._step_iso(-ISO_STEP)

    def _iso_up(self) -> None:
        self._step_iso(ISO_STEP)

    def _step_iso(self, step: float) -> None:
        if self._content.facts.get("iso"):
            self._set_iso(self._content.facts["iso"]["hu"] + step)

    def _set_iso(self, hu: float) -> None:
        iso = self._content.facts.get("iso")
        if iso:
            self._content.do({"do": "set_iso", "hu": min(max(hu, iso["low"]), iso["high"])})

    def _curve(self) -> None:
        """Begin a curve; end one, and show the picture along it; take that picture away."""
        content = self._content
        if content.facts.get("tool") == "curve":
            enough = len(content.facts.get("points", ())) > 1
            content.do({"do": "end_tool"})
            if enough and content.facts.get("iso"):
                content.curve_shown = True
                content.say("right below: along the curve; k takes it away")
                content.wait_at(PLANES[-1], "along the curve")
                content.ask_slices()
        elif content.curve_shown:
            content.curve_shown = False
            content.ask_slices()
        else:
            content.do({"do": "start_tool", "name": "curve"})

    def _seed(self, at: tuple[float, float] | None) -> None:
        content = self._content
        content.do({"do": "start_tool", "name": "seed"})
        spot = None if at is None else self._spot(at)
        if spot is not None:
            self._ask({"do": "add_point", **spot}, self._measured)

    def _hide(self, at: tuple[float, float] | None) -> None:
        self._on_part("hide_at", {"do": "show", "visible": False}, at)

    def _only(self, at: tuple[float, float] | None) -> None:
        self._on_part("only_at", {"do": "only"}, at)

    def _on_part(self, command: str, by_key: Mapping[str, Any], at: tuple[float, float] | None) -> None:
        """Do something with the part under the pointer; elsewhere with the one that was picked last."""
        content = self._content
        spot = None if at is None else self._spot(at)
        if spot is not None:
            self._ask({"do": command, **spot}, lambda facts: self._picked(facts, "nothing is seen here"))
            return
        if content.chosen is None:
            content.say("point at a part in the picture, or click its name, first")
            return
        content.do({**by_key, "key": content.chosen})

    def _color_parts(self) -> None:
        colored = any(part["color"] for part in self._content.facts["parts"] if part["kind"] == "cluster")
        self._content.do({"do": "color_parts", "distinct": not colored})

    def _clip_box(self) -> None:
        content = self._content
        if content.facts.get("clip_box"):
            content.do({"do": "set_clip_box", "low": None, "high": None})
            return
        low, high = content.bounds()
        half = 0.5 * BOX_SHARE * (high - low)
        middle = np.clip(content.facts["cross"], low + half, high - half)
        content.do({"do": "set_clip_box", "low": (middle - half).tolist(), "high": (middle + half).tolist()})

    def _move_box(self, axis: int, share: float) -> None:
        """Move the nearer end of the clip box along an axis to a share of what there is."""
        content = self._content
        shares = content.clip_box_shares()
        first, last = shares[axis]
        lower = abs(share - first) <= abs(share - last)
        shares[axis] = (min(share, last - LEAST_BOX), last) if lower else (first, max(share, first + LEAST_BOX))
        low, high = content.bounds()
        ends = low + np.array(shares).T * (high - low)
        content.do({"do": "set_clip_box", "low": ends[0].tolist(), "high": ends[1].tolist()})

    def _save(self) -> None:
        self._queue_files(self._save_as)

    def _picture(self) -> None:
        self._queue_files((DEFAULT_PICTURE,))

    def _queue_files(self, names: Iterable[str]) -> None:
        width, height = self._content.glass.box("picture").size
        self._to_save += [(name, (width, height)) for name in names]

    def _saved(self, lines: list[str]) -> None:
        self._saving = False
        for line in lines:
            self._say(line)
        self._content.say("; ".join(lines))

    # The mouse

    def _click(self, action: Mapping[str, Any]) -> None:
        """A click on the picture or a slice: a point of a tool, a pick, or on a slice the cross."""
        content = self._content
        area, (x, y) = action["at"], action["place"]
        size = list(content.glass.box(area).size)
        spot = {"x": x + 0.5, "y": y + 0.5, "size": size, "plane": None if area == "picture" else area}
        if action["pick"]:
            self._ask({"do": "cross_at", **spot}, lambda facts: self._picked(facts, "nothing is seen here"))
        elif content.facts.get("tool"):
            if not action.get("drag"):
                self._ask({"do": "add_point", **spot}, self._measured)
        elif area in PLANES:
            camera = content.slice_cameras.get(area)
            if camera is not None and not (content.curve_shown and area == PLANES[-1]):
                place = slice_place(camera, content.glass.box(area).size, (x, y), content.facts["cross"])
                content.do({"do": "set_cross", "point": list(place)})

    def _spot(self, at: tuple[float, float]) -> dict[str, Any] | None:
        """Return the arguments of a pixel at a place of the window, None outside of picture and slices."""
        glass = self._content.glass
        area = glass.layout.find(*at)
        if area is None or area not in ("picture", *PLANES):
            return None
        box = glass.layout.boxes[area]
        plane = None if area == "picture" else area
        return {"x": at[0] - box.left + 0.5, "y": at[1] - box.top + 0.5, "size": list(box.size), "plane": plane}

    def _picked(self, facts: Mapping[str, Any], nothing: str) -> None:
        pick = facts.get("pick")
        content = self._content
        if pick is None:
            content.say(nothing)
            return
        content.chosen = pick["part"] or content.chosen
        content.stale("side")
        part = next((each for each in facts["parts"] if each["key"] == pick["part"]), None)
        words = [] if part is None else [part["name"]]
        if part is not None and part["ml"] is not None:
            words.append(format_volume(part["ml"]))
        if pick["hu"] is not None:
            words.append(f"{pick['hu']:.0f} HU")
        signs = np.diag(frame_from_lps(facts["space"]))
        place = ", ".join(f"{value:.1f}" for value in signs * np.array(pick["point"]) + 0.0)
        content.say("   ".join([*words, f"{place} mm {facts['space']}"]))

    def _measured(self, facts: Mapping[str, Any]) -> None:
        if facts.get("pick") is None:
            self._content.say("nothing is seen here: click on a surface")
            return
        made = facts.get("measure")
        if made is not None:
            self._content.do({"do": "end_tool"})
            last = self._content.facts["measures"][-1]
            self._content.say(f"{last['kind']}: {last['text']}")
            if last["kind"] == "seed":
                self._say(f"seed {last['text']}")

    def _change_window(self, wider: float, higher: float) -> None:
        """Window by a drag to the right, level by one down, as radiologists have it."""
        low, high = self._content.facts["window"]
        width = max(high - low + wider, 1.0)
        middle = 0.5 * (low + high) + higher
        self._content.do({"do": "set_window", "low": middle - 0.5 * width, "high": middle + 0.5 * width})

    def _slide(self) -> None:
        content = self._content
        iso = content.facts.get("iso")
        if not iso:
            return
        box = content.glass.box("slider")
        x, _ = content.glass.place()
        hu = slider_value(box.size, x - box.left, (iso["low"], iso["high"]))
        content.slider_hu = hu
        if hu != iso["hu"]:
            self._set_iso(hu)

    def _scroll_parts(self, rows: int) -> None:
        content = self._content
        count = len(content.facts.get("parts", ()))
        content.first_part = min(max(content.first_part + rows, 0), max(count - 1, 0))
        content.stale("side")

    def _select(self, key: str) -> None:
        content = self._content
        content.chosen = None if content.chosen == key else key
        content.stale("side")

    def _recolor(self, key: str) -> None:
        """Give a part the next colour; after the last one its own."""
        content = self._content
        part = next(each for each in content.facts["parts"] if each["key"] == key)
        colors = [[round(float(value), 4) for value in color] for color in distinct_colors(COLORS)]
        at = colors.index(part["color"]) + 1 if part["color"] in colors else 0
        content.do({"do": "set_color", "key": key, "rgb": colors[at] if at < COLORS else None})

    # What asks the device

    def _ask(self, command: Mapping[str, Any], then: Callable[[Mapping[str, Any]], None]) -> None:
        """Do a command in a thread: it waits for the device, which may build kernels.  `then` gets the facts."""
        self._at_hand += 1

        def work() -> None:
            session = self._content.session
            assert session is not None
            try:
                facts = session.do(command)
            except ClreconError as error:
                words = str(error)
                self._content.call(lambda: self._answered(None, lambda _: self._content.say(words, warning=True)))
                return
            self._content.call(lambda: self._answered(facts, then))

        self._hand.put(work)

    def _answered(self, facts: dict[str, Any] | None, then: Callable[[Any], None]) -> None:
        self._at_hand -= 1
        if facts is not None:
            self._content.take(facts)
        then(facts)

    def _work(self) -> None:
        while (work := self._hand.get()) is not None:
            try:
                work()
            except Exception as error:  # a fault: it is said, and the view goes on
                words = f"{type(error).__name__}: {error} (a fault of clrecon: please report it)"
                self._content.call(
                    lambda words=words: self._answered(None, lambda _: self._content.say(words, warning=True))
                )


_AT_POINTER = ("seed", "hide", "only")
