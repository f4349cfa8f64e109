"""Cases of `clrecon view` without a window: what a step of the slider, a picture, a pick and the start cost."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from itertools import cycle
from typing import Any

from measure import busy_seconds, run_program, spread
from registry import Job, case

SIDE, SHARP_SIDE, SLICE_SIDE = 512, 1024, 400
PICKS = 2000
PATIENCE_S = 120.0

BARS = {
    "slider": 50.0, "release": 45.0, "sharp surface": 150.0, "sharp dvr": 250.0,
}  # fmt: skip
"""Processor milliseconds that a step may take."""


@case("view", "steps of a view: slider, sharp pictures, slices, parts, the mesh on release; it has no peer")
def measure_view(job: Job) -> dict[str, Any]:
    """Time each step from a command to its result, through the threads of a session."""
    from clrecon.viewer.model.objects import show_objects
    from clrecon.viewer.session.session import ViewSession

    volume = job.input.volume()
    with ViewSession(show_objects([volume]), device=job.device, iso_value=job.hu) as view:
        view.prepare()
        _wait(view)
        steps = dict(_steps(view, job.hu))
        found = {name: _alone(step, job, BARS.get(name)) for name, step in steps.items()}
        error = view.facts()["error"]
    if error is not None:
        raise RuntimeError(error)
    return {"ratios": {}, "voxels": list(volume.shape_ijk), "hu": job.hu, "steps": found}


def _steps(view: Any, hu: float) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield the steps; each call works on another iso value or from another side, as a hand would."""
    levels, turns = cycle([hu + 7.0 * n for n in range(12)]), cycle((0.01, -0.01))

    def ask(side: int, moving: bool) -> None:
        view.picture((side, side), moving, lambda made: None)
        _wait(view)

    def slider() -> None:
        view.do({"do": "set_iso", "hu": next(levels)})
        ask(SIDE, True)

    def turn(mode: str, side: int, moving: bool) -> Callable[[], None]:
        def step() -> None:
            if view.model.state.mode != mode:
                view.do({"do": "set_mode", "name": mode})
            view.do({"do": "turn", "dx": next(turns), "dy": 0.0})
            ask(side, moving)

        return step

    def slices() -> None:
        view.do({"do": "scroll", "plane": "axial", "steps": 100 * next(turns)})
        for plane in ("axial", "coronal", "sagittal"):
            view.slice(plane, (SLICE_SIDE, SLICE_SIDE), lambda made: None)
        _wait(view)

    def release() -> None:
        view.do({"do": "set_iso", "hu": next(levels)})
        (mesh,) = view.painter.mesh_of_shown(view.model.state)
        mesh.to_pyvista()

    def parts() -> None:
        view.do({"do": "set_iso", "hu": next(levels)})
        view.painter._found.clear()  # what is known already would be taken
        view.painter.find_parts(view.model.state)

    yield "slider", slider
    yield "release", release
    yield "sharp surface", turn("surface", SHARP_SIDE, False)
    yield "sharp dvr", turn("bone", SHARP_SIDE, False)
    yield "moving surface", turn("surface", SIDE, True)
    yield "moving dvr", turn("bone", SIDE, True)
    yield "moving mip", turn("mip", SIDE, True)
    yield "three slices", slices
    yield "parts", parts

    def hidden() -> None:
        view.do({"do": "turn", "dx": next(turns), "dy": 0.0})
        ask(SIDE, True)

    def hide() -> None:
        view.do({"do": "set_mode", "name": "surface"})
        view.do({"do": "set_iso", "hu": hu})
        view.model.take_parts(view.painter.find_parts(view.model.state))
        view.do({"do": "show", "key": "1/1", "visible": False})
        hidden()

    yield "first with a part hidden", hide
    yield "moving with a part hidden", hidden


SHARP_SIZE = (754, 822)
SHARP_BARS_MS = {"drr": 1000.0, "mip": 600.0, "muscle": 600.0, "lung": 600.0}


@case("view-sharp", "sharp pictures of 754 x 822 in the modes that take longest, another side each; it has no peer")
def measure_sharp(job: Job) -> dict[str, Any]:
    from clrecon.viewer.drawing.painter import Painter
    from clrecon.viewer.model.model import ViewModel
    from clrecon.viewer.model.objects import show_objects

    objects = show_objects([job.input.volume()])
    model = ViewModel(objects, iso_value=job.hu)
    model.set_aspect(SHARP_SIZE[0] / SHARP_SIZE[1])
    turns = cycle((0.01, -0.01))
    found: dict[str, Any] = {}
    with Painter(objects, device=job.device) as painter:

        def take() -> None:
            model.turn(next(turns), 0.0)
            painter.picture(model.state, SHARP_SIZE)

        for mode in SHARP_BARS_MS:
            model.set_mode(mode)
            found[mode] = _alone(take, job, None)
    return {"ratios": {}, "size": SHARP_SIZE, "modes": found, "bars_wall_ms": SHARP_BARS_MS}


@case("view-picks", "distance of 2,000 picks in a picture to the mesh of the same iso value, mm; it has no peer")
def measure_picks(job: Job) -> dict[str, Any]:
    """Pick pixels that show bone, evenly over them, from three sides."""
    import numpy as np

    from clrecon.mesh.compare.distances import SurfaceDistance
    from clrecon.viewer.drawing.painter import Painter
    from clrecon.viewer.model.model import ViewModel
    from clrecon.viewer.model.objects import show_objects

    objects = show_objects([job.input.volume()])
    model = ViewModel(objects, iso_value=job.hu)
    places, size, seconds = [], (SIDE, SIDE), 0.0
    with Painter(objects, device=job.device) as painter:
        (mesh,) = painter.mesh_of_shown(model.state)
        angles: list[Any] = ["anterior", "left", (40, 25)]
        for view in angles:
            model.look(view)
            state = model.state
            rows, columns = np.nonzero(painter.picture(state, size).image[..., 3])
            chosen = np.linspace(0, len(rows) - 1, PICKS // 3).astype(int)
            start = time.perf_counter()
            found = [painter.pick(state, size, columns[n] + 0.5, rows[n] + 0.5) for n in chosen]
            seconds += time.perf_counter() - start
            places += [pick.point for pick in found if pick is not None]
    away = SurfaceDistance(mesh.vertices, mesh.triangles)(np.array(places))
    return {
        "ratios": {},
        "picks": len(places),
        "triangles": mesh.triangle_count,
        "ms_a_pick": 1000.0 * seconds / len(places),
        "distance_mm": {
            "median": float(np.median(away)), "p99": float(np.percentile(away, 99)), "most": float(away.max()),
        },
        "bars_mm": {"median": 0.02, "most": 0.3},
    }  # fmt: skip


_FIRST = """
import sys, time
start = time.perf_counter()
import clrecon
from clrecon.viewer.model.objects import show_objects
from clrecon.viewer.session.session import ViewSession
volume = clrecon.read_volume(sys.argv[1])
read = time.perf_counter()
done = []
with ViewSession(show_objects([volume]), device=sys.argv[2], iso_value=float(sys.argv[3])) as view:
    view.slice("axial", (400, 400), lambda made: done.append(time.perf_counter()))
    view.wait(120)
    view.picture((512, 512), False, lambda made: done.append(time.perf_counter()))
    view.wait(120)
print(read - start, done[0] - read, done[1] - read)
"""


@case("view-first", "seconds of a fresh process to its first slice and picture, kernels in the cache; it has no peer")
def measure_first_picture(job: Job) -> dict[str, Any]:
    """Start processes that read the scan and take a slice and a picture; the first is not counted."""
    folder = str(job.input.ct_folder())
    runs: list[list[float]] = []
    for number in range(max(2, min(job.pairs, 7)) + 1):
        _, said = run_program([sys.executable, "-c", _FIRST, folder, str(job.device.index), str(job.hu)])
        if number:
            runs.append([float(value) for value in said.split()])
    names = ("read_s", "first_slice_s", "first_picture_s")
    return {
        "ratios": {},
        **{name: spread([run[place] for run in runs]) for place, name in enumerate(names)},
        "bars_s": {"first_picture": 1.5},
    }


def _wait(view: Any) -> None:
    if not view.wait(PATIENCE_S):
        raise RuntimeError(f"a step took more than {PATIENCE_S:g} s")


def _alone(run: Callable[[], Any], job: Job, bar: float | None) -> dict[str, Any]:
    """Time a function that has no peer, twice untimed first; milliseconds."""
    for _ in range(2):
        run()
    wall: list[float] = []
    cpu: list[float] = []
    begin = time.perf_counter()
    while len(wall) < job.pairs and (not wall or time.perf_counter() - begin < job.limit_s):
        start, busy = time.perf_counter(), busy_seconds()
        run()
        wall.append(1000.0 * (time.perf_counter() - start))
        cpu.append(1000.0 * (busy_seconds() - busy))
    return {"cpu_ms": spread(cpu), "cpu_ms_least": min(cpu), "wall_ms": spread(wall), "bar_cpu_ms": bar}
