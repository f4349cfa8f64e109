"""`Painter`: pictures of states of a view on the device, for any number of views of the same objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import Cancelled, UsageError
from clrecon.geometry import Volume
from clrecon.labels.resample import ResampledLabels
from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.operators.rays.mesh_pictures import box_around
from clrecon.operators.rays.scene import ScenePictures
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points.cloud import PointCloud
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.rendering.pictures.styles import CurveCut, Projection, SlicesInSpace, Style, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.directions import as_point, checked_size
from clrecon.rendering.views.reformation import find_plane
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress
from clrecon.viewer.drawing.looks import LEAST_OPACITY, LabelledLook, Looks, to_voxels
from clrecon.viewer.drawing.shown_meshes import divide_surface, make_meshes
from clrecon.viewer.drawing.stage import (
    COARSE_TRIANGLES,
    FittedScan,
    Stage,
    coarsen_mesh,
    shows_fits,
    take_strips,
    warm_kernels,
)
from clrecon.viewer.model.changes import pixel_camera, shift_camera, zoom_camera
from clrecon.viewer.model.objects import (
    ShownCloud,
    ShownLabels,
    ShownMesh,
    ShownObject,
    ShownScan,
    ViewMode,
    find_modes,
)
from clrecon.viewer.model.parts import number_at
from clrecon.viewer.model.planes import check_plane, turn_plane
from clrecon.viewer.model.state import Pick, ShownPart, ViewState

SMALLEST_SIDE = 64
"""Pixels of the shorter side of a coarse picture."""

_COARSE_STEP_VOXELS = 2.0


def never() -> bool:
    return False


@dataclass(frozen=True, eq=False)
class _Drawn:
    number: int
    subject: DeviceVolume | Mesh | PointCloud
    style: Style
    labelled: LabelledLook | None = None


class Painter(Stage):
    """Draws states of views, which take turns; a context manager; a scan over `memory` goes through in slabs."""

    def __init__(
        self, objects: Sequence[ShownObject], *, device: Device | str | int | None = None, memory: int | None = None
    ):
        super().__init__(objects, device=device, memory=memory)
        self._looks = Looks()
        self._scene: tuple[tuple[Any, ...], ScenePictures] | None = None
        self._coarse: dict[int, Mesh] = {}
        self._fitted: dict[tuple[int, bool], tuple[tuple[Any, ...], list[_Drawn]]] = {}

    def close(self) -> None:
        with self.lock:
            if self._scene is not None:
                self._scene[1].close()
                self._scene = None
            super().close()

    # Pictures

    def picture(
        self,
        state: ViewState,
        size: Sequence[int],
        *,
        sharp: bool = True,
        share: float = 1.0,
        cancelled: Callable[[], bool] = never,
    ) -> Rendering:
        """Take the picture of a state, with a transparent background; ``depth`` in mm, NaN where there is nothing.

        size: (width, height)
        sharp: False: coarse meshes, translucent ones opaque, longer steps in volume rendering.
        share: Of a coarse picture, its width as a share of `size`.
        """
        width, height = checked_size(size)
        if not sharp:
            share = min(1.0, max(share, SMALLEST_SIDE / min(width, height)))
            width, height = max(1, round(share * width)), max(1, round(share * height))
        with self.lock:
            _stop(cancelled)
            begun = perf_counter()
            rendering = self._take_state(state, (width, height), sharp, cancelled)
            rendering.report["ms"] = 1000.0 * (perf_counter() - begun)
            rendering.report["sharp"] = sharp
            return rendering

    def slice(self, state: ViewState, plane: str, size: Sequence[int]) -> Rendering:
        """Cut a slice ("axial", "coronal" or "sagittal") through the cross; empty where there is no scan."""
        width, height = checked_size(size)
        if state.compare is not None:
            camera = self.slice_camera(state, plane, (width, height))
            return join_sides([self._slice_at(side, plane, camera, (width, height)) for side in state.sides], state)
        return self._slice_at(state, plane, self.slice_camera(state, plane, (width, height)), (width, height))

    def _slice_at(self, state: ViewState, plane: str, camera: Camera, size: tuple[int, int]) -> Rendering:
        with self.lock:
            sliced = self._sliced(state)
            if sliced is None:
                return self._empty(state, size, "slice", camera)
            resident, labelled = sliced
            style = self._looks.plane(state, labelled, 0.0)
            self.place(resident, labelled)
            try:
                return self.renderer(resident).render(style, camera=camera, size=size)
            except UsageError:  # the cross lies beside an oblique scan
                return self._empty(state, size, "slice", camera)

    def slice_camera(self, state: ViewState, plane: str, size: Sequence[int]) -> Camera:
        """Return the camera of a slice: its focal point lies in the slice, so that places can be told from pixels."""
        sliced = self._sliced(state)
        grid = sliced[0].volume if sliced is not None else box_around([each.corners for each in self.objects])
        camera = find_plane(grid, check_plane(plane), size)
        if state.turn is not None:
            camera = turn_plane(camera, state.turn)
        frame, forward = state.frame(plane), camera.basis().forward
        center = np.array(camera.focal_point if frame is None else frame.center)
        center += float(forward @ (state.cross - center)) * forward
        camera = shift_camera(camera, center - camera.focal_point)
        return camera if frame is None else zoom_camera(camera, frame.zoom)

    # Places

    def pick(self, state: ViewState, size: Sequence[int], x: float, y: float) -> Pick | None:
        """Return what is seen at a pixel (x, y) from the top left corner of a picture of this size, or None."""
        camera = pixel_camera(state.camera, checked_size(size), x, y)
        state = _find_side(state, x / size[0])
        nearest: tuple[float, _Drawn] | None = None
        with self.lock:
            for drawn in self._drawn(state, sharp=True, opaque=True):
                picture = self._take([drawn], state, (1, 1), never, camera)
                hazy = isinstance(drawn.style, VolumeLook | SlicesInSpace)
                depth = float((picture.expected_depth if hazy else picture.depth)[0, 0])
                if np.isfinite(depth) and (nearest is None or depth < nearest[0]):
                    nearest = depth, drawn
            if nearest is None:
                return None
            depth, drawn = nearest
            origins, directions = camera.rays((1, 1))
            point = as_point(origins[0, 0] + depth * directions[0, 0])
            part = self._part_at(drawn, point, state)
            return Pick(point=point, object=drawn.number, part=part, hu=self.hu_at(point))

    def pick_slice(self, state: ViewState, plane: str, size: Sequence[int], x: float, y: float) -> Pick:
        camera = self.slice_camera(state, plane, checked_size(size))
        point = pixel_camera(camera, checked_size(size), x, y).focal_point
        state = _find_side(state, x / size[0])
        with self.lock:
            key, number = None, None
            sliced = self._sliced(state)
            if sliced is not None and sliced[1] is not None:
                key = _key_of(sliced[1], self._number_at(sliced[0], sliced[1], point))
                part = state.part(key) if key else None
                number = None if part is None else part.object
            return Pick(point=point, object=number, part=key, hu=self.hu_at(point))

    def _part_at(self, drawn: _Drawn, point: tuple[float, float, float], state: ViewState) -> str:
        labelled = drawn.labelled
        if labelled is None:
            return str(drawn.number)
        resident = drawn.subject if isinstance(drawn.subject, DeviceVolume) else self.resident(drawn.number, state)
        key = _key_of(labelled, self._number_at(resident, labelled, point))
        return key or str(drawn.number)

    def _number_at(self, resident: DeviceVolume, labelled: LabelledLook, point: tuple[float, float, float]) -> int:
        return number_at(resident.volume, self.labels_on(resident, labelled), point)

    def mesh_of_shown(self, state: ViewState, progress: Progress | None = None) -> list[Mesh]:
        """Make the meshes of what is shown, see `clrecon.viewer.drawing.saving`."""
        return make_meshes(self, state, progress)

    def curve_picture(self, state: ViewState, size: Sequence[int]) -> Rendering:
        """Straighten the first scan along the curve of the tool, or the last one that was made."""
        if not self.scans:
            raise UsageError("there is no scan: a picture along a curve needs one")
        if len(state.curve) < 2:
            raise UsageError("a picture along a curve needs two points and more: pick them with the tool curve")
        with self.lock:
            renderer = self.renderer(self.resident(self.scans[0].number, state))
            return renderer.render(CurveCut(list(state.curve), window=state.window), size=checked_size(size))

    def prepare(self, progress: Progress | None = None) -> None:
        """Build the kernels of surfaces, slices and extraction, and of bricks, which the second extraction uses."""
        warm_kernels(self.objects, self.device, progress)

    def make_coarse(self, cancelled: Callable[[], bool] = never) -> None:
        """Make the coarse meshes that are drawn while anything moves, once."""
        for shown in self.objects:
            if isinstance(shown, ShownMesh) and shown.mesh.triangle_count > COARSE_TRIANGLES:
                if shown.number not in self._coarse:
                    _stop(cancelled)
                    self._coarse[shown.number] = coarsen_mesh(shown.mesh, COARSE_TRIANGLES)[0]

    def _drawn(self, state: ViewState, sharp: bool, *, opaque: bool = False) -> list[_Drawn]:
        """Return what a state shows, with looks, in the order of the objects; meshes opaque where that is enough."""
        mode = find_modes()[state.mode]
        drawn: list[_Drawn] = []
        for shown in self.objects:
            whole = state.whole(shown.number)
            if whole is None or not whole.visible:
                continue
            fit = self.find_fits(state)[shown.number] if isinstance(shown, ShownScan) and shows_fits(state) else None
            if isinstance(shown, ShownScan) and fit is not None:
                drawn += self._drawn_fit(shown, fit, state, whole, sharp=sharp, opaque=opaque or not sharp)
            elif isinstance(shown, ShownScan):
                if mode.kind == "labels" or (drawn and not mode.joins):
                    continue
                used = mode if not any(isinstance(one.subject, DeviceVolume) for one in drawn) else _SURFACE
                drawn.append(self._drawn_scan(shown, state, used, whole, sharp))
            elif not mode.joins:
                continue
            elif isinstance(shown, ShownMesh):
                if whole.opacity >= LEAST_OPACITY:
                    mesh = shown.mesh if sharp else self._coarse.get(shown.number, shown.mesh)
                    drawn.append(_Drawn(shown.number, mesh, self._looks.mesh(state, whole, opaque or not sharp)))
            elif isinstance(shown, ShownCloud):
                drawn.append(_Drawn(shown.number, shown.cloud, self._looks.cloud(state, whole)))
            elif isinstance(shown, ShownLabels) and (mode.kind == "labels" or shown.within is None):
                drawn.append(self._drawn_labels(shown, state, whole, sharp))
        return drawn

    def _drawn_fit(
        self, scan: ShownScan, fit: FittedScan, state: ViewState, whole: ShownPart, *, sharp: bool, opaque: bool
    ) -> list[_Drawn]:
        """Return the pieces of a surface fitted to the bone; they are the same objects as long as their looks are."""
        labelled, scale = self.labelled(scan.number, state), self.find_fit_scale(state)
        looks = None if labelled is None else (id(labelled.labels), labelled.parts)
        key = (id(fit), state.color_by, scale, state.clip, whole, looks, opaque)
        if self._fitted.get((scan.number, sharp), ((), []))[0] != key:
            pieces = []
            for mesh, part in divide_surface(self, scan, state, whole, fit.sharp if sharp else fit.coarse):
                opacity = 1.0 if opaque else part.opacity * (1.0 if part is whole else whole.opacity)
                colors = None if scale is None else scale.colors(mesh.values[f"{state.color_by}_mm"])
                color = None if colors is not None else part.color or whole.color
                if part.opacity * whole.opacity >= LEAST_OPACITY:
                    look = MeshLook(color, opacity=opacity, vertex_colors=colors, clip=state.clip)
                    pieces.append(_Drawn(scan.number, mesh, look, labelled))
            self._fitted[scan.number, sharp] = key, pieces
        return self._fitted[scan.number, sharp][1]

    def _drawn_scan(self, scan: ShownScan, state: ViewState, mode: ViewMode, whole: ShownPart, sharp: bool) -> _Drawn:
        resident = self.resident(scan.number, state)
        labelled = self.labelled(scan.number, state)
        coarse = None if sharp or mode.kind == "surface" else _COARSE_STEP_VOXELS * min(resident.volume.spacing)
        used = labelled
        if labelled is not None and labelled.is_plain:
            used = None
        if used is None and whole.opacity < 1.0:
            used = self.blank_labels(scan.number, resident.volume)
        if mode.kind not in ("surface", "volume"):
            used = None
        occlusion = 1.0 if state.occlusion and sharp else 0.0  # coarse pictures follow the slider of the iso value
        style = self._looks.scan(state, mode, whole, used, coarse, occlusion)
        return _Drawn(scan.number, resident, style, used or labelled)

    def _drawn_labels(self, shown: ShownLabels, state: ViewState, whole: ShownPart, sharp: bool) -> _Drawn:
        """Return a label map as the surface of its own voxels."""
        if shown.number not in self._solid:
            volume = Volume(to_voxels(shown.labels), shown.labels.affine.copy(), hu_range=(0, 1))
            device_volume = DeviceVolume(volume, device=self._device, memory=self.memory)
            self._solid[shown.number] = device_volume, ResampledLabels(shown.labels.voxels, True, {}, ())
        resident, placed = self._solid[shown.number]
        labelled = LabelledLook(shown.labels, placed, tuple(state.parts_of(shown.number)))
        style = self._looks.scan(state, find_modes()["labels"], whole, labelled, None)
        return _Drawn(shown.number, resident, style, labelled)

    def _sliced(self, state: ViewState) -> tuple[DeviceVolume, LabelledLook | None] | None:
        """Return the volume that slices are cut through: the first scan that is shown, else a label map."""
        for scan in self._shown_scans(state) or self.scans:
            return self.resident(scan.number, state), self.labelled(scan.number, state)
        for shown_object in self.objects:
            if isinstance(shown_object, ShownLabels):
                whole = state.whole(shown_object.number)
                assert whole is not None
                drawn = self._drawn_labels(shown_object, state, whole, sharp=True)
                assert isinstance(drawn.subject, DeviceVolume)
                return drawn.subject, drawn.labelled
        return None

    def _take_state(
        self, state: ViewState, size: tuple[int, int], sharp: bool, cancelled: Callable[[], bool]
    ) -> Rendering:
        """Take the picture of a state; of a comparison both sides with one camera, each where it is seen."""
        if state.compare is None:
            return self._take(self._drawn(state, sharp), state, size, cancelled)
        pictures = []
        for side in state.sides:
            _stop(cancelled)
            pictures.append(self._take(self._drawn(side, sharp), side, size, cancelled))
        return join_sides(pictures, state)

    def _take(
        self,
        drawn: list[_Drawn],
        state: ViewState,
        size: tuple[int, int],
        cancelled: Callable[[], bool],
        camera: Camera | None = None,
    ) -> Rendering:
        camera = camera or state.camera
        if not drawn:
            return self._empty(state, size, state.mode, camera)

        def check_on(stage: str, done: int, total: int) -> None:
            _stop(cancelled)

        for item in drawn:
            if isinstance(item.subject, DeviceVolume):
                self.place(item.subject, item.labelled)
        first = drawn[0]
        if len(drawn) == 1 and isinstance(first.subject, DeviceVolume):
            renderer, style = self.renderer(first.subject), first.style

            def take_strip(camera: Camera, size: tuple[int, int]) -> Rendering:
                return renderer.render(style, camera=camera, size=size, background="transparent", progress=check_on)

            # The window of a projection without one is chosen from all of the picture.
            whole = isinstance(style, Projection) and style.window is None
            return take_strip(camera, size) if whole else take_strips(take_strip, camera, size)
        key = tuple((id(each.subject), id(each.style)) for each in drawn)
        if self._scene is None or self._scene[0] != key:
            if self._scene is not None:
                self._scene[1].close()
            objects = [(each.subject, each.style) for each in drawn]
            scene_pictures = ScenePictures(objects, device=self._device, memory=self.memory, takers=self._takers)
            self._scene = key, scene_pictures
        return self._scene[1].take(camera, size, None, check_on)

    def _empty(self, state: ViewState, size: tuple[int, int], mode: str, camera: Camera) -> Rendering:
        width, height = size
        nothing: NDArray[np.float32] = np.full((height, width), np.nan, np.float32)
        image = np.zeros((height, width, 4), np.uint8)
        return Rendering(image, nothing, nothing.copy(), camera, None, mode, {"mode": mode, "warnings": []})


_SURFACE = find_modes()["surface"]


def _find_side(state: ViewState, share: float) -> ViewState:
    """Return what of a comparison is shown at a share of the width from the left; other states as they are."""
    if state.compare is None:
        return state
    left, right = state.sides
    return left if share < state.compare else right


def join_sides(pictures: Sequence[Rendering], state: ViewState) -> Rendering:
    """Return the first of two pictures of one size left of the line of a comparison, and the second right of it."""
    left, right = pictures
    assert state.compare is not None
    column = round(state.compare * left.size[0])

    def join_field(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(left, name)[:, :column], getattr(right, name)[:, column:]], axis=1)

    warnings = dict.fromkeys([*left.report["warnings"], *right.report["warnings"]])
    report = {**right.report, **left.report, "warnings": list(warnings)}
    image = join_field("image")
    return Rendering.with_late_depths(
        lambda: (join_field("depth"), join_field("expected_depth")), image, left.camera, None, left.mode, report
    )


def _key_of(labelled: LabelledLook, number: int) -> str | None:
    return next((part.key for part in labelled.parts if part.number == number), None)


def _stop(cancelled: Callable[[], bool]) -> None:
    if cancelled():
        raise Cancelled
