"""`ViewSession`: what a face of a view holds: model, painter and workers, and nothing of a toolkit.

`picture_key` tells when a picture is stale; of each kind of work the latest request wins (`Worker`).
"""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from itertools import chain
from operator import attrgetter
from time import monotonic
from typing import Any, TypeVar

import numpy as np

from clrecon.anatomy.spine_line import SpineLine, find_spine_line
from clrecon.errors import ClreconError, UsageError
from clrecon.opencl import Device
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.object_looks import MESH_COLORS
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.directions import as_point, checked_size, checked_vector
from clrecon.system.arguments import Space
from clrecon.system.base_classes import Closing
from clrecon.system.log import get_logger
from clrecon.system.text import format_volume
from clrecon.viewer.drawing.painter import Painter
from clrecon.viewer.drawing.saving import check_target, save_shown
from clrecon.viewer.drawing.stage import shows_fits
from clrecon.viewer.model.changes import pan_camera, zoom_camera
from clrecon.viewer.model.measures import seen_pieces
from clrecon.viewer.model.model import ViewModel
from clrecon.viewer.model.objects import ShownMesh, ShownObject
from clrecon.viewer.model.saved_view import restore_view
from clrecon.viewer.model.state import LEAST_ZOOM, MOST_ZOOM, SCENE, Pick, ViewState, picture_key
from clrecon.viewer.session.commands import check_command
from clrecon.viewer.session.worker import CLOSE_S, Job, Worker

REST_SECONDS = 0.2
"""After the last change until pictures are drawn sharp."""

log = get_logger(__name__)

Found = TypeVar("Found")

_MOVING_MS = 40.0
"""Time of a coarse picture that its size is steered to."""

LEAST_SHARE = 0.15
"""Least width of a coarse picture, as a share of the picture's."""

_FIRST_SHARE = 0.5

_SCALE_STEPS = 64
"""Colours in which a page draws a scale."""

_MANY_TRIANGLES = 2_000_000
"""Triangles of a mesh above which it is said that pictures take their time."""

_MANY_SMALL = 1_000
"""Small parts of scans that are most likely noise: scans of 1 to 4 mm have 200 to 1,300 at 200 HU."""

_THUMBNAIL = (128, 96)
_WORDS = {
    "prepare": "building kernels",
    "parts": "finding parts",
    "table": "taking the table away",
    "smooth": "smoothing the scan",
    "fit": "fitting the surface to the bone",
    "spine": "finding the spine",
    "coarse": "making coarse meshes",
    "thumbnails": "drawing thumbnails",
    "save": "writing",
}


class ViewSession(Closing):
    """One view.  Methods may be called from any thread; pictures and longer work come in threads of the session.

    painter: Shared with other views of the same objects; it stays open.  None: one of its own.
    space: {"lps", "ras"}. Frame in which places are said and saved.
    on_change: Called, in any thread, when something happened that was not asked for by the caller just now.
    """

    def __init__(
        self,
        objects: Sequence[ShownObject],
        painter: Painter | None = None,
        *,
        device: Device | str | int | None = None,
        memory: int | None = None,
        space: Space = "lps",
        iso_value: float | None = None,
        keep_ids: bool = False,
        no_clobber: bool = False,
        on_change: Callable[[], None] | None = None,
    ):
        self.model = ViewModel(objects, space=space, iso_value=iso_value)
        self._owns = painter is None
        self.painter = Painter(objects, device=device, memory=memory) if painter is None else painter
        self.keep_ids, self.no_clobber = keep_ids, no_clobber
        self._lock = threading.RLock()
        self._on_change = on_change
        self._share = _FIRST_SHARE
        self._error: str | None = None
        self._said: str | None = None
        self._timing: dict[str, Any] = {}
        self._shown: Rendering | None = None
        self._parts_failed = False
        self._warned_of_specks = False
        self._closed = False
        self._pictures = Worker("view-pictures", self._failed)
        self._work = Worker("view-work", self._failed, self._changed)

    def close(self, timeout: float = CLOSE_S) -> None:
        """Cancel everything, and wait for at most `timeout` seconds: a driver that builds a kernel does not stop."""
        if self._closed:
            return
        self._closed = True
        workers, end = (self._work, self._pictures), monotonic() + timeout
        for worker in workers:
            worker.stop()
        ended = [worker.close(max(0.0, end - monotonic())) for worker in workers]
        if self._owns and all(ended):
            self.painter.close()

    # Pictures

    def picture(self, size: Sequence[int], moving: bool, then: Callable[[Rendering], None]) -> None:
        """Ask for the picture; the latest request wins, and `then` is called with it in a thread of the session.

        size: (width, height)
        moving: Coarse, its width steered so that it takes 40 ms.  A coarse one that is drawn is always delivered, a
            sharp one is dropped when the next is asked for.
        """
        width, height = checked_size(size)
        self.fit(size)
        with self._lock:
            state = self.model.state

        def take_picture(job: Job) -> None:
            with self._lock:
                now, share = self.model.state if moving else state, self._share
            picture = self.painter.picture(now, (width, height), sharp=not moving, share=share, cancelled=job.cancelled)
            with self._lock:
                if moving:
                    share = picture.size[0] / width * math.sqrt(_MOVING_MS / max(1.0, picture.report["ms"]))
                    self._share = min(1.0, max(LEAST_SHARE, share))
                self._timing = {
                    "ms": round(picture.report["ms"], 1),
                    "size": list(picture.size),
                    "sharp": not moving,
                    "device": self.painter.device.label,
                    "slabs": picture.report.get("slabs", 1),
                    "warnings": list(picture.report["warnings"]),
                }
                self._shown = picture
            if not job.cancelled():
                then(picture)

        self._pictures.ask("picture", take_picture, rank=0, gives_way=not moving)

    def fit(self, size: Sequence[int]) -> None:
        """Tell the (width, height) of the picture: the view of the start fits it."""
        width, height = checked_size(size)
        with self._lock:
            self.model.set_aspect(width / height)

    def picture_key(self, view: str) -> Hashable:
        """Return what the picture of a view depends on, see the function of this name."""
        state = self.model.state
        return picture_key(state, view), view == SCENE and state.fitted and self.painter.has_fits(state)

    def slice(self, plane: str, size: Sequence[int], then: Callable[[Rendering], None]) -> None:
        """Ask for a slice through the cross: "axial", "coronal" or "sagittal"; the latest of each plane wins."""
        checked = checked_size(size)

        def take_slice(job: Job) -> None:
            with self._lock:
                state = self.model.state
            picture = self.painter.slice(state, plane, checked)
            if not job.cancelled():
                then(picture)

        self._pictures.ask(f"slice {plane}", take_slice, rank=1, gives_way=False)

    def curve_picture(self, size: Sequence[int], then: Callable[[Rendering], None]) -> None:
        checked = checked_size(size)
        with self._lock:
            state = self.model.state
        self._pictures.ask(
            "curve", lambda job: then(self.painter.curve_picture(state, checked)), rank=2, gives_way=False
        )

    def draw_modes(self, then: Callable[[str, Rendering], None]) -> None:
        """Draw a small picture in each mode in the background; `then` gets it with the name of the mode.

        None of a scan in slabs: each would take it to the device again, and hold up the pictures that are wanted.
        """
        if self._timing.get("slabs", 1) > 1:
            return
        with self._lock:
            states = {name: self.model.state_in(name) for name in self.model.modes}

        def draw_thumbnails(job: Job) -> None:
            for name, state in states.items():
                then(name, self.painter.picture(state, _THUMBNAIL, cancelled=job.cancelled))

        self._work.ask("thumbnails", draw_thumbnails, rank=4)

    def prepare(self) -> None:
        """Build the kernels that are needed soon, and the coarse meshes, in the background."""
        self._work.ask("prepare", lambda job: self.painter.prepare(job.progress), rank=0)
        self._work.ask("coarse", lambda job: self.painter.make_coarse(job.cancelled), rank=1)

    # Commands

    def do(self, command: Mapping[str, Any]) -> dict[str, Any]:
        """Do a command of `COMMANDS`; return `facts`, and its own ``"pick"``, ``"undone"`` or ``"measure"``."""
        known_command, arguments = check_command(command)
        with self._lock:
            answer = attrgetter(known_command.method)(self)(**arguments)
            if self.model.parts_known and self.painter.has_parts(self.model.state):
                self._work.cancel("parts")
            return {**self.facts(), **(answer if isinstance(answer, dict) else {})}

    def facts(self) -> dict[str, Any]:
        """Return all that panels show, for JSON."""
        with self._lock:
            return {
                **self.model.facts(),
                "seen_lines": self._seen_lines(),
                "scale": self._describe_scale(),
                "offset": self.painter.find_offset(self.model.state),
                "advice": self._advise(),
                "busy": [_WORDS.get(kind, kind) for kind in self._work.busy],
                "error": self._error,
                "said": self._said,
                "timing": self._timing,
                "warnings": self._warnings(),
            }

    def rest(self) -> None:
        """Say that nothing moves: parts are found where those in the list are outdated."""
        with self._lock:
            state = self.model.state
            wanted = bool(self.model.scans) and not self._parts_failed
            known = self.model.parts_known and self.painter.has_parts(state)
            fitted = not shows_fits(state) or self.painter.has_fits(state)
        if wanted and not known and "parts" not in self._work.busy:
            self.find_parts()
        if not fitted and "fit" not in self._work.busy:
            self._fit()

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Show what a saved view says; table, fit and parts follow in the background."""
        with self._lock:
            bare = not saved.get("table_shown", True)
            restore_view({**saved, "table_shown": not bare or self.painter.knows_table}, self.model)
            if bare and self.model.scans:
                self.set_table(False)
            self.rest()

    def resume(self, state: ViewState) -> None:
        """Show the state of another session of the same objects."""
        with self._lock:
            self.model.show_state(state, "the view before the page was loaded again")

    def find_parts(self, then: Callable[[], None] | None = None) -> None:
        """Find the parts of the scans in the background; `then` is called in its thread with the lock held."""

        def find_parts_now(job: Job) -> None:
            with self._lock:
                state = self.model.state
            parts = self.painter.find_parts(state, job.progress)
            with self._lock:
                if job.cancelled():
                    return
                if parts:
                    self.model.take_parts(parts)
                    self._warn_of_specks(sum(each.small_count for each in parts))
                if then is not None:
                    then()
            self._changed()

        self._work.ask("parts", find_parts_now, rank=2)

    def _warn_of_specks(self, count: int) -> None:
        """Say once that many small parts are most likely noise."""
        if count < _MANY_SMALL or self._warned_of_specks:
            return
        self._warned_of_specks = True
        mm = self.painter.find_smoothing()
        specks = f"{count:,} small parts, most likely noise (n: hide them; y: smooth the scan by {mm:g} mm)"
        self._said = specks if self._said is None else f"{specks}; {self._said}"

    def set_table(self, shown: bool) -> None:
        """Show the table, or take it away, which takes a moment the first time."""
        if not self.model.scans:
            raise UsageError("there is no scan: there is no table to take away")
        self._work.cancel("table")
        if shown or self.painter.knows_table:
            self._apply_table(shown)
            return

        self._do_later("table", lambda job: self.painter.remove_table(job.progress), lambda _: self._apply_table(False))

    def _do_later(self, kind: str, work: Callable[[Job], Found], take: Callable[[Found], None]) -> None:
        """Work in the background, and then, unless it was cancelled, take the result with the lock held."""

        def work_and_take(job: Job) -> None:
            outcome = work(job)
            with self._lock:
                if not job.cancelled():
                    take(outcome)
            self._changed()

        self._work.ask(kind, work_and_take, rank=3)

    def begin_with_bone(self, *, bare: bool) -> None:
        """Begin with the bone by volume rendering; `bare`: the painter took the table away, and its share is said."""
        with self._lock:
            self.model.begin_with_bone(bare=bare)
            self._said = self.painter.say_table() if bare else None

    def set_smooth(self, on: bool) -> None:
        """Smooth scans against their noise, which takes a moment the first time, or show them as they were read."""
        self._work.cancel("smooth")
        if not on or not self.model.scans:
            self.model.set_smooth(0.0)
            self._said = None
            return

        def show_smooth(mm: float) -> None:
            self.model.set_smooth(mm)
            self._said = f"smoothed by a Gaussian of {mm:g} mm (y: as read)"
            self.rest()

        self._do_later("smooth", lambda job: self.painter.smooth_scans(self.model.state), show_smooth)

    def toggle_smooth(self) -> None:
        self.set_smooth(not (self.model.state.smooth_mm or "smooth" in self._work.busy))

    def _advise(self) -> dict[str, str] | None:
        """Return the step against noise that one click takes, for JSON, or the way back; None: there is no need."""
        words = "show as read" if self.model.state.smooth_mm else None
        if words is None and self._warned_of_specks:
            words = f"smooth by {self.painter.find_smoothing():g} mm"
        return None if words is None else {"words": words, "do": "toggle_smooth"}

    def toggle_table(self) -> None:
        self.set_table(not self.model.state.table)

    def _apply_table(self, shown: bool) -> None:
        self.model.set_table(shown)
        if not shown:
            self._said = self.painter.say_table() or "there is no table to take away, and no blankets"
        self.rest()

    def set_fitted(self, shown: bool) -> None:
        """Show surfaces fitted to the bone, which takes a moment the first time, or those at the iso value."""
        self._work.cancel("fit")
        if not shown:
            self.model.set_fitted(False)
            return
        self.model.check_fit()
        self._fit()

    def toggle_fitted(self) -> None:
        self.set_fitted(not (self.model.state.fitted or "fit" in self._work.busy))

    def _fit(self) -> None:
        """Fit the surfaces that are shown in the background, and show them."""

        def fit_scans(job: Job) -> list[str]:
            with self._lock:
                state = self.model.state
            return self.painter.fit_scans(state, job.progress)

        def show_fits(lines: list[str]) -> None:
            self.model.set_fitted(True)
            self._said = "; ".join(lines)

        self._do_later("fit", fit_scans, show_fits)

    def find_spine(self) -> None:
        """Find the canal of the spine in the first scan in the background, and add it as a curve."""
        if not self.model.scans:
            raise UsageError("there is no scan: a spine is found in one")
        volume = self.model.scans[0].volume

        def add_line(line: SpineLine) -> None:
            self.model.add_curve([as_point(point) for point in line.points], "spine")
            self._said = "the picture along the spine follows the middle of its canal"

        self._do_later("spine", lambda job: find_spine_line(volume, progress=job.progress), add_line)

    def pick(self, x: float, y: float, size: tuple[int, int], plane: str | None = None) -> dict[str, Any]:
        """Return what is seen at a pixel of the picture, or of a slice."""
        return {"pick": self._facts_of_pick(self._pick(x, y, size, plane))}

    def cross_at(self, x: float, y: float, size: tuple[int, int], plane: str | None = None) -> dict[str, Any]:
        """Move the slices to what is seen at a pixel."""
        picked = self._pick(x, y, size, plane)
        if picked is not None:
            self.model.set_cross(picked.point)
        return {"pick": self._facts_of_pick(picked)}

    def add_point(self, x: float, y: float, size: tuple[int, int], plane: str | None = None) -> dict[str, Any]:
        """Add what is seen at a pixel to the tool that is used."""
        picked = self._pick(x, y, size, plane)
        if picked is None:
            return {"pick": None, "measure": None}
        axes = None
        if plane is not None:
            axes = self.painter.slice_camera(self.model.state, plane, checked_size(size)).basis()[:2]
        measure = self.model.add_point(picked, axes)
        return {"pick": self._facts_of_pick(picked), "measure": None if measure is None else measure.describe()}

    def probe(self, point: Sequence[float]) -> dict[str, Any]:
        """Return what the first scan holds at a place, LPS mm, without looking whether it is shown."""
        position = checked_vector("a place", point)
        return {"probe": {"hu": self.painter.hu_at(position), "words": self.model.say_place(position)}}

    def zoom_slice(
        self, plane: str, factor: float, size: Sequence[int], about: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Show a slice of (width, height) pixels larger; what is seen at `about` stays, see `zoom_camera`."""
        camera = self.painter.slice_camera(self.model.state, plane, checked_size(size))
        self._frame_slice(plane, factor, zoom_camera(camera, factor, about), size)

    def pan_slice(self, plane: str, dx: float, dy: float, size: Sequence[int]) -> None:
        """Shift a slice of (width, height) pixels by shares of its height, to the right and down."""
        camera = self.painter.slice_camera(self.model.state, plane, checked_size(size))
        self._frame_slice(plane, 1.0, pan_camera(camera, dx, dy), size)

    def _frame_slice(self, plane: str, factor: float, camera: Camera, size: Sequence[int]) -> None:
        """Show what a camera sees of a slice; its picture of (width, height) pixels reaches the scan."""
        frame, (right, up, _) = self.model.state.frame(plane), np.abs(camera.basis())
        reach = camera.half_height() * (up + size[0] / size[1] * right)
        zoom = factor if frame is None else factor * frame.zoom
        if LEAST_ZOOM <= zoom <= MOST_ZOOM:
            self.model.frame_slice(plane, zoom, camera.focal_point, reach)

    def mark_at(self, x: float, y: float, size: tuple[int, int], plane: str | None = None) -> dict[str, Any]:
        """Keep what is seen at a pixel as a seed, without a tool."""
        picked = self._pick(x, y, size, plane)
        if picked is not None:
            self.model.add_seed(picked)
        return {"pick": self._facts_of_pick(picked)}

    def hide_at(self, x: float, y: float, size: tuple[int, int], plane: str | None = None) -> dict[str, Any]:
        """Hide the part at a pixel; parts that are not known yet are found first, in the background."""
        return self._with_part(x, y, size, plane, lambda key: self.model.show(key, False))

    def only_at(self, x: float, y: float, size: tuple[int, int], plane: str | None = None) -> dict[str, Any]:
        """Show the part at a pixel alone; see `hide_at`."""
        return self._with_part(x, y, size, plane, self.model.only)

    def undo(self) -> dict[str, Any]:
        """Take the last change back."""
        undone = self.model.undo()
        self.rest()
        return {"undone": undone}

    def save(
        self,
        path: str | os.PathLike[str],
        then: Callable[[list[str]], None] | None = None,
        size: Sequence[int] = (1024, 1024),
    ) -> None:
        """Write what is shown at (width, height) to a file in the background; `then` gets lines about it."""
        checked = checked_size(size)
        with self._lock:
            state = self.model.state
        check_target(path, self.painter, state)

        def write_shown(job: Job) -> None:
            lines = save_shown(
                path, self.painter, state, size=checked, space=self.model.space, keep_ids=self.keep_ids,
                no_clobber=self.no_clobber, progress=job.progress,
            )  # fmt: skip
            with self._lock:
                self._said = "; ".join(lines)
            if then is not None:
                then(lines)

        self._work.ask("save", write_shown, rank=1, gives_way=False)

    def cancel(self) -> None:
        for kind in _WORDS:
            if kind != "prepare":
                self._work.cancel(kind)

    def dismiss(self) -> None:
        self._error = self._said = None

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until no work and no picture is under way; False where time ran out."""
        return self._work.wait(timeout) and self._pictures.wait(timeout)

    # Inside

    def _pick(self, x: float, y: float, size: tuple[int, int], plane: str | None) -> Pick | None:
        width, height = checked_size(size)
        if not (0.0 <= x <= width and 0.0 <= y <= height):
            raise UsageError(f"the pixel {x:g}, {y:g} lies outside of a picture of {width} x {height}")
        state = self.model.state
        if plane is not None:
            return self.painter.pick_slice(state, plane, (width, height), x, y)
        return self.painter.pick(state, (width, height), x, y)

    def _with_part(
        self, x: float, y: float, size: tuple[int, int], plane: str | None, apply: Callable[[str], None]
    ) -> dict[str, Any]:
        picked = self._pick(x, y, size, plane)
        if picked is None:
            return {"pick": None}
        state, described = self.model.state, self._facts_of_pick(picked)
        part = None if picked.part is None else state.part(picked.part)
        divided = self.model.parts_known and self.painter.has_parts(state)
        if divided or (part is not None and part.kind in ("mesh", "cloud", "label")):
            if picked.part is not None:
                apply(picked.part)
            return {"pick": described}

        def again() -> None:
            picked = self._pick(x, y, size, plane)
            if picked is not None and picked.part is not None:
                apply(picked.part)

        self.find_parts(again)
        return {"pick": described}

    def _facts_of_pick(self, picked: Pick | None) -> dict[str, Any] | None:
        """Return a pick for JSON, with words that say what it is and where."""
        if picked is None:
            return None
        part = None if picked.part is None else self.model.state.part(picked.part)
        words = [] if part is None else [part.name]
        if part is not None and part.ml is not None:
            words.append(format_volume(part.ml))
        if picked.hu is not None:
            words.append(f"{picked.hu:.0f} HU")
        return {**picked.describe(), "words": ", ".join([*words, self.model.say_place(picked.point)])}

    def _describe_scale(self) -> dict[str, Any] | None:
        """Return the scale of the colours of fitted surfaces for JSON, its colours from the lowest number on."""
        state = self.model.state
        scale = None if state.color_by is None else self.painter.find_fit_scale(state)
        if scale is None or state.color_by is None:
            return None
        colors = scale.colors(np.linspace(scale.low, scale.limit, _SCALE_STEPS)).tolist()
        return {"title": MESH_COLORS[state.color_by], "ticks": scale.ticks, "colors": colors}

    def _seen_lines(self) -> list[list[list[float]]]:
        """Return the pieces of measured lines that are not hidden in the picture that was taken last."""
        state = self.model.state
        lines = [*(each.outline for each in state.measures), tuple(each.point for each in state.points)]
        if self._shown is None or not any(len(line) > 1 for line in lines):
            return []
        mode = self.model.modes[state.mode]
        expected = mode.kind not in ("surface", "labels")
        return seen_pieces(self._shown, [np.array(line) for line in lines if len(line) > 1], expected=expected)

    def _warnings(self) -> list[str]:
        notes = list(chain(*(each.said for each in self.model.objects)))
        if self._timing.get("slabs", 1) > 1:
            notes.append("the scan does not fit the device: every picture takes it through in slabs, which is slow")
        for shown in self.model.objects:
            if isinstance(shown, ShownMesh) and shown.mesh.triangle_count > _MANY_TRIANGLES:
                notes.append(
                    f"{shown.name} has {shown.mesh.triangle_count:,} triangles: a sharp picture takes a while, and a"
                    " coarse mesh is shown while anything moves"
                )
        notes += self._timing.get("warnings", [])
        return list(dict.fromkeys(notes))

    def _failed(self, kind: str, words: str) -> None:
        log.warning("%s: %s", kind, words)
        with self._lock:
            self._error = words
            self._parts_failed |= kind == "parts"
            if kind == "fit":
                self.model.set_fitted(False)
        self._changed()

    def _changed(self) -> None:
        if self._on_change is not None and not self._closed:
            try:
                self._on_change()
            except ClreconError as error:  # a face that fails must not stop the work
                log.warning("a view does not take news: %s", error)
