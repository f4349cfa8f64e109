"""`VolumeRenderer`: one volume on a device, any number of pictures in any mode, framed by what is shown."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from clrecon.anatomy.surroundings import LEFT_OUT, leave_out_surroundings
from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.grid import AIR_HU, Grid
from clrecon.labels import resample_labels
from clrecon.opencl import Device
from clrecon.operators.rays.picture_buffers import DrawnVolume, Shot
from clrecon.operators.rays.ray_pictures import take_picture, take_with_layers
from clrecon.operators.rays.slices import choose_slices, overlay_slices, overlay_with_layers
from clrecon.operators.rays.surface_pictures import cast_surface
from clrecon.operators.reformat.cut import take_contact_sheet, take_curve, take_cut
from clrecon.operators.resident.device_volume import DeviceVolume, VolumeWorker
from clrecon.rendering import PRESETS, Rendering
from clrecon.rendering.looks.colors import is_transparent
from clrecon.rendering.pictures.annotations import edge_letters
from clrecon.rendering.pictures.label_style import LabelStyle
from clrecon.rendering.pictures.modes import Look, check_known, find_style, make_style
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.sheets import SHEET_SIZE, SheetLayout, lay_out, write_on_tile
from clrecon.rendering.pictures.styles import (
    CurveCut,
    PlaneCut,
    PresetSheet,
    Projection,
    SlicesInSpace,
    Style,
    SurfaceLook,
    VolumeLook,
)
from clrecon.rendering.views.camera import Camera, box_corners
from clrecon.rendering.views.clip import ShownLabels, check_center, find_seen_box
from clrecon.rendering.views.directions import ANTERIOR, DEFAULT_SIZE, checked_size, default_view
from clrecon.rendering.views.reformation import find_plane
from clrecon.system.arguments import DirectionName, ModeName, ViewName, explains_arguments, number_or_nan
from clrecon.system.light_dataclass import replace
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import list_names

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of Python 3.11

_MASKED_BY = ("field_of_view", "remove_table", "region", LEFT_OUT)
"""Entries of the report of a volume of which a part was turned into air, or left out."""

AIR_ROOM_HU = 100.0
"""Cameras of projections and slices fit the voxels at least this far above -1024 HU, the air of a mask."""


def framing_key(volume: Volume, style: Style) -> tuple[object, ...]:
    """Return what of a style decides about `shown_box`; styles with equal keys have the same box."""
    look = _hiding_look(style)
    hidden = None if look is None else (look.labels, look.table[:, 3].tobytes())  # a label map equals only itself
    slices = style.slices if isinstance(style, SlicesInSpace) else None
    return type(style), getattr(style, "clip", None), _band(style, volume), slices, hidden


def shown_box(shown: Volume | DeviceVolume, style: Style) -> Grid:
    """Return the grid that cameras fit: the volume itself, where all or nothing shows, else `find_seen_box`."""
    volume = shown.volume if isinstance(shown, DeviceVolume) else shown
    clip = getattr(style, "clip", None)
    labels = _shown_labels(shown, style)
    if clip is None and labels is None and not any(name in volume.report for name in _MASKED_BY):
        return volume
    slices = choose_slices(volume, style.slices) if isinstance(style, SlicesInSpace) else None
    box = find_seen_box(volume, _band(style, volume), clip=clip, labels=labels, slices=slices)
    return volume if box is None else box


def _hiding_look(style: Style) -> LabelStyle | None:
    """Return the look of the labels if some of them are hidden."""
    look = style.label_style if isinstance(style, VolumeLook | SurfaceLook) else None
    return None if look is None or (look.table[:, 3] > 0.0).all() else look


def _shown_labels(volume: Volume | DeviceVolume, style: Style) -> ShownLabels | None:
    """Return the labels on the grid of the volume if some of them are hidden."""
    look = _hiding_look(style)
    if look is None:
        return None
    placed = volume.bring(look.labels) if isinstance(volume, DeviceVolume) else resample_labels(look.labels, volume)
    return ShownLabels(placed.voxels, look.table[:, 3] > 0.0)


def _band(style: Style, volume: Volume) -> tuple[float, float]:
    """Return the HU that a style shows of a volume, infinite where they have no end."""
    if isinstance(style, Projection) and style.leaves_out and LEFT_OUT in volume.report:
        return -math.inf, volume.report[LEFT_OUT]["highest_hu"]
    if isinstance(style, SurfaceLook):
        return style.iso_value, math.inf
    if isinstance(style, SlicesInSpace):
        return style.lowest_hu, math.inf
    if isinstance(style, VolumeLook):
        hu, opacity = style.function.points[:, 0], style.function.points[:, -1]
        shown = np.flatnonzero(opacity > 0.0)
        if not len(shown):
            return -math.inf, math.inf
        low = -math.inf if shown[0] == 0 else float(hu[shown[0] - 1])
        high = math.inf if shown[-1] == len(hu) - 1 else float(hu[shown[-1] + 1])
        return low, high
    return AIR_HU + AIR_ROOM_HU, math.inf


_SMALLEST_STEP = 0.01
"""Smallest ray step as a share of the smallest spacing; shorter steps only add time."""

_MOST_STEPS = 1 << 15
"""Most ray steps through the diagonal of a volume: float32 counts them, and Mesa's llvmpipe ends loops after 65535
turns."""


class VolumeRenderer(VolumeWorker):
    """A volume on a device, of which pictures are made one after the other.

    The volume is uploaded once where it fits the device as a whole; a larger one goes through in slabs for each
    picture, and gives the same.  Use it as a context manager, or `close` it.

    Parameters
    ----------
    volume : Volume or DeviceVolume
        The voxels must not change as long as the renderer is open.  A `DeviceVolume` is used directly, with its own
        device and memory.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Bytes that may be taken on the device; None is all that it has.

    Raises
    ------
    UsageError
        ``volume`` is not a Volume or holds NaN, or ``memory`` is not a number of bytes.
    DeviceError
        The device does not exist.
    """

    def __init__(
        self, volume: Volume | DeviceVolume, *, device: Device | str | int | None = None, memory: int | None = None
    ):
        super().__init__(volume, device, memory, "a picture")
        self._framed: tuple[tuple[object, ...], Grid] | None = None
        self._inner: VolumeRenderer | None = None
        voxels = self.volume.voxels
        if voxels.dtype.kind == "f" and not np.isfinite(voxels).all():
            raise UsageError("the voxels hold NaN or infinite values: fill them first, for CT with -1024")

    def close(self) -> None:
        """Free the volume on the device; a `DeviceVolume` that was given stays as it is."""
        if self._inner is not None:
            self._inner.close()
        super().close()

    @explains_arguments
    def render(
        self,
        style: Style | ModeName | None = None,
        *,
        camera: Camera | None = None,
        view: ViewName | Sequence[float] | None = None,
        up: str | Sequence[float] | None = None,
        zoom: float | None = None,
        view_angle: float | None = None,
        center: Sequence[float] | None = None,
        size: Sequence[int] | None = None,
        background: str | Sequence[float] = "black",
        progress: Progress | None = None,
        **look: Unpack[Look],
    ) -> Rendering:
        """Make one picture, see the function `render`."""
        style = find_style(style, look)
        if isinstance(style, PointLook):
            raise UsageError("mode points shows a point cloud, and this is a volume: make a cloud of it first")
        if isinstance(style, MeshLook):
            raise UsageError("mode mesh shows a mesh, and this is a volume: extract a surface first")
        seen_from = default_view(style.mode, self.volume) if view is None and camera is None else view
        placement = Place.checked(style, camera, seen_from, up, zoom, view_angle, center)
        progress = progress or ignore_progress
        if isinstance(style, CurveCut):
            return take_curve(self._resident, style, placement.view, placement.up, size, background, progress)
        if size is None:
            size = SHEET_SIZE if style.is_sheet else DEFAULT_SIZE
        size = checked_size(size)
        if isinstance(style, Projection) and style.leaves_out and LEFT_OUT not in self.volume.report:
            return self._within(progress).render(
                style, camera=camera, view=view, up=up, zoom=zoom, view_angle=view_angle, center=center,
                size=size, background=background, progress=progress,
            )  # fmt: skip
        if isinstance(style, PlaneCut):
            return self._cut(style, placement, size, background, progress)
        camera = placement.camera or placement.camera_for(self.frame(style), size)
        if isinstance(style, PresetSheet):
            return self._take_presets(style, camera, size, background, progress)
        shot = Shot(camera, size, None if is_transparent(background) else background, progress)
        if isinstance(style, SlicesInSpace):
            return overlay_slices(self._resident, style, shot)
        assert isinstance(style, VolumeLook | Projection | SurfaceLook)
        step = self._checked_step(style.ray_step)
        if isinstance(style, SurfaceLook):
            return cast_surface(self._resident, style, shot, step)
        return take_picture(self._resident, style, shot, step)

    def _within(self, progress: Progress) -> VolumeRenderer:
        """Return the renderer of the volume without what lies outside of the body, which is kept."""
        if self._inner is None:
            self._resident.make_way()
            volume = leave_out_surroundings(self.volume, progress=progress)
            self._inner = VolumeRenderer(volume, device=self._resident.device, memory=self._resident.memory)
        return self._inner

    @explains_arguments
    def frame(self, style: Style) -> Grid:
        """Return what cameras fit: the volume, or the box of what is left of it where a part is masked, cut or hidden.

        The last box is kept for styles that show the same part of the volume.
        """
        if isinstance(style, Projection) and style.leaves_out and LEFT_OUT not in self.volume.report:
            return self._within(ignore_progress).frame(style)
        key = framing_key(self.volume, style)
        if self._framed is None or self._framed[0] != key:
            self._framed = key, shown_box(self._resident, style)
        return self._framed[1]

    def render_with_layers(
        self,
        style: VolumeLook | SlicesInSpace,
        shot: Shot,
        beside: Mapping[str, int],
        draw: Callable[[DrawnVolume], Rendering],
    ) -> Rendering:
        """Make a picture of the volume with what lies in it.

        Parameters
        ----------
        beside : mapping of str to int
            Bytes of other buffers on the device.
        draw : callable
            Draws the picture; it is called again where the device has no room, or another one takes over.
        """
        if isinstance(style, SlicesInSpace):
            return overlay_with_layers(self._resident, style, shot, beside, draw)
        return take_with_layers(self._resident, style, shot, self._checked_step(style.ray_step), beside, draw)

    def _cut(
        self,
        style: PlaneCut,
        placement: Place,
        size: tuple[int, int],
        background: str | Sequence[float],
        progress: Progress,
    ) -> Rendering:
        plane = placement.camera
        if plane is None:
            plane = find_plane(
                placement.checked_box(self.frame(style)), placement.view, size,
                zoom=placement.zoom, up=placement.up, pixel_mm=style.pixel_mm, center=placement.center,
            )  # fmt: skip
        elif style.pixel_mm is not None:
            raise UsageError("the size of pixels is that of the camera: leave it out, or the camera")
        if style.sheet is not None:
            return take_contact_sheet(self._resident, style, plane, self.frame(style), size, background, progress)
        return take_cut(self._resident, style, plane, size, background, progress)

    def _take_presets(
        self,
        style: PresetSheet,
        camera: Camera,
        size: tuple[int, int],
        background: str | Sequence[float],
        progress: Progress,
    ) -> Rendering:
        """Take a picture with each preset, in tiles that fit what a picture of this size would show.

        The result has no camera and no depths; ``report["tiles"]`` has ``preset``, ``left`` and ``top`` (pixels).
        """
        layout, camera = _lay_out_presets(self.frame(style), camera, size)
        width, height = layout.tile
        edges = edge_letters(camera)
        image = np.zeros((*size[::-1], 4), np.uint8)
        tiles: list[dict[str, Any]] = []
        seconds: Counter[str] = Counter()
        warnings: dict[str, None] = {}
        for number, (preset, (left, top)) in enumerate(zip(PRESETS, layout.corners, strict=True)):
            progress("render", number, len(PRESETS))
            look = make_style(preset=preset, ray_step=style.ray_step, clip=style.clip)
            picture = self.render(look, camera=camera, size=layout.tile, background=background)
            image[top : top + height, left : left + width] = write_on_tile(picture.image, (preset,), edges)
            tiles.append({"preset": preset, "left": left, "top": top})
            seconds.update(picture.report["seconds"])
            warnings |= dict.fromkeys(picture.report["warnings"])
        progress("render", len(PRESETS), len(PRESETS))
        nothing = np.full(size[::-1], np.nan, np.float32)
        report = {
            **{name: picture.report[name] for name in ("device", "driver", "slabs")},
            "mode": style.mode,
            "pixel_mm": camera.pixel_mm(layout.tile) if camera.is_parallel else None,
            "edges": edges,
            "tiles": tiles,
            "tile_size": [width, height],
            "seconds": dict(seconds),
            "warnings": list(warnings),
        }
        sheet = Rendering(image, nothing, nothing, None, None, style.mode, report)
        return sheet if is_transparent(background) else sheet.with_background(background)

    def _checked_step(self, ray_step: float | None) -> float:
        smallest = min(self.volume.spacing)
        diagonal = float(np.linalg.norm(np.ptp(box_corners(self.volume), axis=0)))
        finest = max(_SMALLEST_STEP * smallest, diagonal / _MOST_STEPS)
        if ray_step is None:
            return max(0.5 * smallest, finest)
        step = number_or_nan(ray_step)
        if finest <= step < math.inf:
            return min(step, 2.0 * diagonal)  # one sample, in the middle of the way through the volume
        raise UsageError(
            f"the ray step is a length in mm, at least {finest:.3g} in this volume (a hundredth of its smallest"
            f" spacing, and {_MOST_STEPS:,} through its diagonal), not {ray_step!r}"
        )


def _lay_out_presets(shown: Grid, camera: Camera, size: tuple[int, int]) -> tuple[SheetLayout, Camera]:
    """Return tiles and the camera of each; in perspective they have the shape of the whole sheet."""
    if camera.parallel_scale is None:
        return lay_out(len(PRESETS), size, size), camera
    right, up, _ = camera.basis()
    corners = box_corners(shown)
    extent = float(np.ptp(corners @ right)), float(np.ptp(corners @ up))
    whole = max(extent[0] / size[0], extent[1] / size[1])
    layout = lay_out(len(PRESETS), extent, size, zoom=whole / camera.pixel_mm(size))
    return layout, replace(camera, parallel_scale=0.5 * layout.tile[1] * layout.pixel_mm)


class Place(NamedTuple):
    """The view of a picture as the caller described it."""

    camera: Camera | None
    view: DirectionName | Sequence[float]
    up: str | Sequence[float] | None
    zoom: float
    view_angle: float | None
    center: Sequence[float] | None = None

    @classmethod
    def checked(
        cls,
        style: Style,
        camera: Camera | None,
        view: Any,
        up: str | Sequence[float] | None,
        zoom: float | None,
        view_angle: float | None,
        center: Sequence[float] | None = None,
    ) -> Place:
        """Refuse what has no meaning in the style's mode or beside a camera."""
        if not (camera is None or isinstance(camera, Camera)):
            raise UsageError(f"the camera of a picture is a Camera or None, not {type(camera).__name__}")
        for keyword, value in (("zoom", zoom), ("view_angle", view_angle), ("center", center)):
            if value is not None:
                check_known(style.mode, keyword)
        if camera is not None:
            if isinstance(style, CurveCut):
                raise UsageError("a curved reformation has no camera: view and up say which way one looks at it")
            _check_alone(view=view, up=up, zoom=zoom, view_angle=view_angle, center=center)
        return cls(camera, ANTERIOR if view is None else view, up, 1.0 if zoom is None else zoom, view_angle, center)

    def checked_box(self, shown: Grid) -> Grid:
        """Return the box that cameras fit; refuse a centre outside of it."""
        if self.center is not None:
            check_center(self.center, shown)
        return shown

    def camera_for(self, volume: Grid, size: tuple[int, int]) -> Camera:
        """Return the given camera, or one made from the other parameters."""
        if self.camera is not None:
            return self.camera
        return Camera.fit(
            self.checked_box(volume), self.view, self.zoom,
            up=self.up, view_angle=self.view_angle, size=size, center=self.center,
        )  # fmt: skip


def _check_alone(**placing: Any) -> None:
    """Refuse parameters that place a camera if a camera is given."""
    given = [name for name, value in placing.items() if value is not None]
    if given:
        names = list_names(given)
        raise UsageError(f"a camera says by itself where a picture is taken from: leave out {names}, or the camera")
