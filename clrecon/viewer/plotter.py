"""Scans, meshes, clouds and label maps in a plain window of pyvista, with pyvista's own widgets."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from clrecon.anatomy.iso_choice import settle_level
from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume
from clrecon.geometry.iso_rule import checked_iso_value
from clrecon.jobs.mesh.settings import MeshSettings
from clrecon.jobs.view import ViewSettings
from clrecon.jobs.view.inputs import check_view_settings
from clrecon.operators import take_device
from clrecon.operators.surface.cortex_mesh import fit_cortex
from clrecon.operators.surface.extract import SurfaceExtractor
from clrecon.operators.surface.label_masks import extract_label_masks
from clrecon.rendering.pictures.label_style import distinct_colors
from clrecon.rendering.pictures.object_looks import MESH_COLORS, MeshLook
from clrecon.rendering.pictures.pillow import load_pillow
from clrecon.rendering.pictures.style_checks import flag
from clrecon.rendering.pictures.styles import DEFAULT_ISO_VALUE
from clrecon.rendering.views.directions import DIRECTIONS
from clrecon.system.display import Display, DisplayProbe, NoDisplayError
from clrecon.system.progress import Progress, ignore_progress
from clrecon.viewer.model.objects import (
    ShownCloud,
    ShownLabels,
    ShownMesh,
    ShownObject,
    ShownScan,
    find_iso_range,
    show_objects,
)
from clrecon.viewer.model.state import FIT_COLORS

if TYPE_CHECKING:
    import pyvista

    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.points.cloud import PointCloud
    from clrecon.viewer.notebook import LivePage

SIZE = (1100, 850)
BONE = (0.90, 0.86, 0.78)

KEYS = (
    "c: clip plane, again: without   m: measure, again: without   1 to 6: sides of the patient   q: quit\n"
    "t: surface fitted to the bone, again: at the iso value   T: its thickness, its error, plain"
)

_SIDES = {str(key): side for key, side in enumerate(DIRECTIONS.values(), start=1)}
"""Where the camera stands, LPS: anterior, posterior, left, right, superior, inferior."""

_LISTEN_MS = 100
"""Between two moments in which Python sees a Ctrl-C: VTK's loop is not Python's."""


def show(
    *shown: Volume | Mesh | PointCloud | LabelMap,
    iso_value: float | Literal["auto"] | None = None,
    device: Any = None,
    page: bool = False,
) -> LivePage | None:
    """Show objects in a window of pyvista, until it is closed, or in the page of ``clrecon view``.

    A plain ``pyvista.Plotter``: drag turns, Shift and drag pans, the wheel zooms.  A slider sets the iso value of
    volumes, whose surfaces are extracted on the device; ``t`` fits them to the bone, ``T`` colours those by thickness
    or error, ``c`` adds a plane that clips everything, ``m`` measures a distance by two clicks, ``1`` to ``6`` are the
    sides of the patient, ``q`` closes the window.  ``clrecon view`` shows more, in the browser.

    Parameters
    ----------
    shown : Volume, Mesh, PointCloud or LabelMap
        Together, each in its place.
    iso_value : float or "auto", optional
        HU at the start, 200 by default; "auto" is that of `choose_iso_value` of the first volume.
    device : Device, str or int, optional
        For volumes and label maps, see `clrecon.device`; None is the best of the machine.
    page : bool
        In place of a window return the page, which a notebook shows in the cell: modes, slices, measures, parts.

    Returns
    -------
    LivePage or None
        The page has ``address``, ``open()`` and ``close()``; see ``clrecon.viewer.notebook``.

    Raises
    ------
    UsageError
        There is nothing to show, no display, or OpenGL does not work on it.
    DeviceError
        The device does not exist.
    """
    level, _ = settle_level(next((each for each in shown if isinstance(each, Volume)), None), iso_value)
    if flag("page", page):
        from clrecon.viewer.notebook import LivePage

        level = None if level is None else checked_iso_value(level)
        scan = MeshSettings(iso_value=level, device=str(take_device(device).index))
        return LivePage(show_objects(shown), ViewSettings(scan=scan))
    with DisplayProbe() as probe:
        display = _wait_for_display(probe)
    with open_plotter(show_objects(shown), iso_value=level, device=device) as plotter:
        _run(plotter, display)
    return None


def show_inputs(
    inputs: Sequence[str | Path],
    settings: ViewSettings | None = None,
    *,
    progress: Progress = ignore_progress,
    ready: Callable[[list[str]], object] = lambda said: None,
    probe: DisplayProbe,
) -> None:
    """Read inputs, say with `ready` what is to be said of them, and show them in a window until it is closed."""
    from clrecon.viewer.session.opening import choose_iso, read_objects

    settings = settings or ViewSettings()
    check_view_settings(settings)
    display = _wait_for_display(probe)
    objects = read_objects(inputs, settings, progress)
    scan = settings.scan
    fitted, iso_value = scan.surface == "cortex", choose_iso(objects, scan, progress)
    with open_plotter(objects, iso_value=iso_value, fitted=fitted, device=scan.device, memory=scan.memory) as plotter:
        ready(list(dict.fromkeys(chain(*(each.said for each in objects)))))
        _run(plotter, display)


@contextmanager
def open_plotter(
    objects: Sequence[ShownObject],
    *,
    iso_value: float | None = None,
    fitted: bool = False,
    device: Any = None,
    memory: int | None = None,
    off_screen: bool = False,
) -> Iterator[pyvista.Plotter]:
    """A plotter with the objects, the slider of the iso value and the keys; it is closed with the block."""
    load_pillow()
    import pyvista

    with ExitStack() as opened:
        plotter = pyvista.Plotter(window_size=SIZE, title="clrecon view", off_screen=off_screen)
        opened.callback(plotter.close)
        plotter.set_background((0.055, 0.06, 0.07))
        extractors, scans = [], [each for each in objects if isinstance(each, ShownScan)]
        for shown in objects:
            if isinstance(shown, ShownMesh):
                plotter.add_mesh(shown.mesh.to_pyvista(), color=BONE, name=shown.name, smooth_shading=True)
            elif isinstance(shown, ShownCloud):
                plotter.add_points(shown.cloud.to_pyvista(), color=BONE, name=shown.name, point_size=3)
            elif isinstance(shown, ShownLabels):
                _add_labels(plotter, shown, device, memory)
            elif isinstance(shown, ShownScan):
                extractor = opened.enter_context(SurfaceExtractor(shown.volume, device=device, memory=memory))
                extractors.append((shown.name, extractor))
        if extractors:
            surfaces = _Surfaces(plotter, extractors, find_iso_range(scans), iso_value, fitted=fitted)
            plotter.add_key_event("t", surfaces.toggle_fitted)
            plotter.add_key_event("T", surfaces.step_color_by)
        plotter.add_axes(xlabel="L", ylabel="P", zlabel="S", color="white")
        plotter.add_text(KEYS, position="upper_left", font_size=9, color="white", name="keys")
        _add_keys(plotter)
        plotter.enable_parallel_projection()
        plotter.view_vector(_SIDES["1"], viewup=(0, 0, 1))
        yield plotter


def _add_labels(plotter: pyvista.Plotter, shown: ShownLabels, device: Any, memory: int | None) -> None:
    """Add the surface of each label in a colour of its own, translucent around the bone of a scan."""
    label_masks = extract_label_masks(shown.labels, device=device, memory=memory)
    for (number, mesh), color in zip(label_masks.items(), distinct_colors(len(label_masks)), strict=True):
        name = f"{shown.name} {shown.labels.name(number)}"
        opacity = 1.0 if shown.within is None else 0.4
        plotter.add_mesh(mesh.to_pyvista(), color=color, name=name, smooth_shading=True, opacity=opacity)


class _Surfaces:
    """The surfaces of volumes, and a slider that makes them anew where it is let go, at the iso value or fitted."""

    def __init__(
        self,
        plotter: pyvista.Plotter,
        extractors: Sequence[tuple[str, SurfaceExtractor]],
        limits: tuple[float, float],
        iso_value: float | None,
        *,
        fitted: bool,
    ) -> None:
        import pyvista

        self._plotter, self._extractors = plotter, extractors
        self._fitted, self._color_by = fitted, 0
        self._surfaces = {name: pyvista.PolyData() for name, _ in extractors}
        self._actors: dict[str, Any] = {}
        self._hu = min(max(DEFAULT_ISO_VALUE if iso_value is None else iso_value, limits[0]), limits[1])
        self._make_surfaces(self._hu)
        for name, surface in self._surfaces.items():
            self._actors[name] = plotter.add_mesh(surface, color=BONE, name=name)
            self._actors[name].prop.interpolation = "Phong"  # by our normals, without a copy
        plotter.add_slider_widget(
            self._make_surfaces, limits, value=self._hu, title="iso value, HU", pointa=(0.25, 0.08),
            pointb=(0.75, 0.08), fmt="%.0f", color="white",
        )  # fmt: skip

    def toggle_fitted(self) -> None:
        self._fitted, self._color_by = not self._fitted, 0
        self._make_surfaces(self._hu)

    def step_color_by(self) -> None:
        """Colour by the next number, which only fitted surfaces have."""
        if self._fitted:
            self._color_by = (self._color_by + 1) % (len(FIT_COLORS) + 1)
            self._color_surfaces()

    def _make_surfaces(self, hu: float) -> None:
        import pyvista

        self._hu, refused = hu, ""
        for name, extractor in self._extractors:
            shown = pyvista.PolyData()
            try:
                mesh = extractor.extract(round(hu))
                shown = mesh.to_pyvista()
                if self._fitted:
                    shown = fit_cortex(mesh, extractor.volume, device=extractor.device).to_pyvista()
            except NoSurfaceError as error:
                refused += f"{name}: {error}\n" * self._fitted
            self._surfaces[name].copy_from(shown, deep=False)
        self._plotter.add_text(
            refused, position=(0.01, 0.12), viewport=True, font_size=9, color="yellow", name="refused"
        )
        self._color_surfaces()

    def _color_surfaces(self) -> None:
        """Colour the surfaces that have the number at their vertices, with a scale in mm beside them."""
        import pyvista

        name = (None, *FIT_COLORS)[self._color_by]
        for title in [*self._plotter.scalar_bars.keys()]:
            self._plotter.remove_scalar_bar(title)
        for surface_name, actor in self._actors.items():
            surface, mapper = self._surfaces[surface_name], actor.mapper
            mapper.scalar_visibility = f"{name}_mm" in surface.point_data
            if name is None or not mapper.scalar_visibility:
                continue
            scale, _ = MeshLook(color_by=name).find_scale(surface.point_data)
            ends = scale.low, scale.limit
            steps = np.full((256, 4), 255, np.uint8)
            steps[:, :3] = scale.colors(np.linspace(*ends, len(steps)))
            surface.point_data.active_scalars_name = f"{name}_mm"
            mapper.lookup_table = pyvista.LookupTable(values=steps, scalar_range=ends, nan_color="gray")
            mapper.scalar_range = ends
            self._plotter.add_scalar_bar(MESH_COLORS[name], mapper=mapper, color="white", vertical=True)


def _add_keys(plotter: pyvista.Plotter) -> None:
    """Let keys look from the sides of the patient, and add or remove pyvista's widgets."""
    from vtkmodules.vtkCommonDataModel import vtkPlane

    plane, on = vtkPlane(), {"clip": False, "measure": False}

    def cut_meshes(normal: Sequence[float], origin: Sequence[float]) -> None:
        plane.SetNormal(*(-value for value in normal))  # what the arrow points to is taken away
        plane.SetOrigin(*origin)

    def toggle_clip() -> None:
        on["clip"] = not on["clip"]
        if on["clip"]:
            plotter.add_plane_widget(cut_meshes, normal=(0, -1, 0), interaction_event="always", color="white")
        else:
            plotter.clear_plane_widgets()
        for actor in plotter.renderer.actors.values():
            if hasattr(actor, "prop") and hasattr(actor, "mapper"):  # texts and axes have none
                (actor.mapper.AddClippingPlane if on["clip"] else actor.mapper.RemoveClippingPlane)(plane)
        plotter.render()

    def say_distance(first: object, last: object, mm: float) -> None:
        plotter.add_text(f"{mm:.1f} mm", position="upper_right", color="yellow", name="distance")  # bone hides its own

    def toggle_measure() -> None:
        on["measure"] = not on["measure"]
        if on["measure"]:
            plotter.add_measurement_widget(say_distance, color="yellow")
        else:
            plotter.clear_measure_widgets()
            plotter.remove_actor("distance")

    plotter.add_key_event("c", toggle_clip)
    plotter.add_key_event("m", toggle_measure)
    for key, side in _SIDES.items():
        up = (0, 0, 1) if side[2] == 0 else (0, -1, 0)
        plotter.add_key_event(key, lambda side=side, up=up: plotter.view_vector(side, viewup=up))


def _wait_for_display(probe: DisplayProbe) -> Display:
    """Refuse where VTK would end the process with a segmentation fault, or show nothing."""
    display = probe.wait()
    if display.fault is not None:
        raise NoDisplayError(f"no window can be opened: {display.fault}")
    return display


def _run(plotter: pyvista.Plotter, display: Display) -> None:
    """Show a plotter until it is closed; Ctrl-C closes it."""
    interrupted = False
    if display.is_software:
        plotter.disable_anti_aliasing()  # it would take most of the time

    def interrupt(*_: object) -> None:
        nonlocal interrupted
        interrupted = True
        plotter.iren.terminate_app()

    in_main = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, interrupt) if in_main else None
    try:
        plotter.iren.add_observer("TimerEvent", lambda *_: None)  # `add_timer_event` would draw each time
        plotter.iren.create_timer(_LISTEN_MS)
        plotter.show(auto_close=False)
    finally:
        if in_main:
            signal.signal(signal.SIGINT, before)
    if interrupted:
        raise KeyboardInterrupt
