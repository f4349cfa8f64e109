"""`PictureTaker`: a volume on a device, of which it takes all kinds of pictures."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, cast

from clrecon.geometry.grid import Grid
from clrecon.jobs.render.settings import SPINES, LabelLook, RenderSettings
from clrecon.labels.reader import read_all_labels
from clrecon.rendering.looks.colors import is_transparent
from clrecon.rendering.looks.presets import ALL_PRESETS, find_preset
from clrecon.rendering.looks.transfer_files import load_transfer_function
from clrecon.rendering.pictures.label_style import NO_LABEL, list_legend
from clrecon.rendering.pictures.object_looks import MESH_COLORS, MeshLook, PointLook
from clrecon.rendering.pictures.sheets import add_legend, add_scale
from clrecon.rendering.pictures.styles import SPINE, CurveCut, SlicesInSpace, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.centre_line import read_curve_points
from clrecon.rendering.views.clip import check_center
from clrecon.rendering.views.directions import default_view, read_view, say_view
from clrecon.system.base_classes import Closing
from clrecon.system.light_dataclass import dataclass
from clrecon.system.pieces import deal_in_order
from clrecon.system.progress import Progress, ignore_progress

if TYPE_CHECKING:
    from clrecon.geometry import Volume
    from clrecon.geometry.affine import Float64Array
    from clrecon.labels import LabelMap
    from clrecon.mesh import Mesh
    from clrecon.opencl import Device
    from clrecon.points.cloud import PointCloud
    from clrecon.rendering import Lighting, Rendering, TransferFunction
    from clrecon.rendering.views.camera import Camera


def read_function(named: str | None) -> TransferFunction | None:
    """Read the transfer function ``FILE`` or ``FILE:NAME``; None if no file is given."""
    if named is None:
        return None
    path, colon, name = named.rpartition(":")
    if colon and not os.path.exists(named) and os.path.exists(path):
        return load_transfer_function(path, name)
    return load_transfer_function(named)


def read_curve(named: str | None) -> Float64Array | None:
    """Read the points (n, 3) in LPS mm of a centre line; None if no file is given or the spinal canal is meant."""
    if named is None or named in SPINES:
        return None
    return read_curve_points(named)


def read_look(look: LabelLook | None, volume: Volume | None = None, *, follow_links: bool = False) -> LabelMap | None:
    """Read the label map; None if no file is given.  With the scan, a large one is held against its grid first."""
    if look is None:
        return None
    opacities = [label for label in look.opacities if label.strip() != str(NO_LABEL)]
    named = [*look.colors, *opacities]  # they get the voxels that they share with others
    labels = read_all_labels(look.path, named or None, volume=volume, follow_links=follow_links)
    for label in named:
        labels.find(label)
    return labels


@dataclass(frozen=True, eq=False)
class Beside:
    """What is read beside the input; None: `function` of the preset, `curve` of the style."""

    function: TransferFunction | None = None
    curve: Float64Array | None = None
    labels: LabelMap | None = None
    meshes: Sequence[Mesh] = ()


class PictureTaker(Closing):
    """Takes the pictures of settings, and frees the device."""

    def __init__(
        self,
        subject: Volume | PointCloud | Mesh,
        device: Device,
        settings: RenderSettings,
        progress: Progress,
        beside: Beside | None = None,
    ):
        beside = beside or Beside()
        self.meshes = list(beside.meshes)
        self._subject, self.device = subject, device
        self._settings, self._beside = settings, beside
        self.labels, self._progress = beside.labels, progress
        self._takers = [self]
        self.style = settings.style_with(beside.function, beside.curve, beside.labels)
        self.function = beside.function or _shown_function(settings, self.style)
        self.warnings: list[str] = []
        self._stack = ExitStack()
        self._renderer: Any = None
        self._box: Grid | None = None

    def close(self) -> None:
        self._stack.close()

    def share_with(self, devices: Sequence[Device]) -> None:
        """Let other devices take pictures beside this one, each with the subject in its own memory."""
        for device in devices:
            taker = PictureTaker(self._subject, device, self._settings, ignore_progress, self._beside)
            self._takers.append(self._stack.enter_context(taker))

    @property
    def devices(self) -> list[Device]:
        """The devices that take pictures, this one's first."""
        return [taker.device for taker in self._takers]

    @property
    def views(self) -> tuple[str, ...]:
        """The views of the pictures; without any, that from which the slices of this scan show."""
        if self._settings.views or not isinstance(self.style, SlicesInSpace):
            return self._settings.views_used
        return (say_view(default_view(self.style.mode, cast("Volume", self._subject))),)

    @property
    def box(self) -> Grid:
        """The grid that cameras fit: the volume or the box of what is left of it, or the box of the cloud."""
        if self._box is None:
            self._box = self._find_box()
            if self._settings.center is not None:
                check_center(self._settings.center, self._box)
        return self._box

    def _find_box(self) -> Grid:
        from clrecon.operators.rays.point_pictures import cloud_box

        if self._is_scene:
            return cast("Grid", self._open_scene().box)
        if not isinstance(self._subject, Grid):
            return cloud_box(cast("PointCloud", self._subject))
        return cast("Grid", self._open_volume().frame(self.style))

    @property
    def lighting(self) -> Lighting | None:
        shaded = VolumeLook | SurfaceLook | PointLook | MeshLook
        return self.style.light if isinstance(self.style, shaded) else None

    def take_views(self) -> Iterator[Rendering]:
        if len(self._takers) > 1 and not isinstance(self.style, CurveCut):
            for taker in self._takers:
                taker._box = self.box  # found once
        yield from deal_in_order([taker.take_view for taker in self._takers], self.views)

    def take_all(self, cameras: Sequence[Camera]) -> Iterator[Rendering]:
        yield from deal_in_order([taker.take for taker in self._takers], cameras)

    def take_view(self, view: str) -> Rendering:
        settings = self._settings
        if not isinstance(self.style, CurveCut):
            return self.take(settings.camera(self.box, view))
        if self.style.curve == SPINE:
            self._progress("curve", 0, 0)
        return self._render(view=read_view(view), up=settings.up, size=settings.size)

    def take(self, camera: Camera) -> Rendering:
        return self._render(camera=camera, size=self._settings.size_used)

    def _render(self, **view: Any) -> Rendering:
        settings = self._settings
        if self._is_scene:
            picture = self._open_scene().take(view["camera"], view["size"], self._ground)
        elif isinstance(self.style, PointLook):
            picture = self._take_points(self.style, view["camera"], view["size"])
        else:
            picture = self._open_volume().render(self.style, background=settings.background, **view)
        letters = settings.letters and not self.style.is_sheet  # each slice of a sheet has its own
        picture = picture.annotated(
            letters=letters, scale_bar=settings.scale_bar, caption=settings.caption, dpi=settings.dpi
        )
        look = getattr(self.style, "label_style", None)
        if settings.legend and look is not None:
            picture = add_legend(picture, list_legend(look))
        if not isinstance(self.style, MeshLook) or self.style.color_by is None:
            return picture
        scale, _ = self.style.find_scale(cast("Mesh", self._subject).values)
        return add_scale(picture, scale, MESH_COLORS[self.style.color_by])

    def _open_volume(self) -> Any:
        from clrecon.operators.rays.render import VolumeRenderer

        if self._renderer is None:
            opened = VolumeRenderer(cast("Volume", self._subject), device=self.device, memory=self._settings.memory)
            self._renderer = self._stack.enter_context(opened)
        return self._renderer

    def _take_points(self, style: PointLook, camera: Camera, size: tuple[int, int]) -> Rendering:
        from clrecon.operators.rays.point_pictures import PointPictures

        if self._renderer is None:
            opened = PointPictures(cast("PointCloud", self._subject), device=self.device, memory=self._settings.memory)
            self._renderer = self._stack.enter_context(opened)
        picture: Rendering = self._renderer.take(style, camera, size, self._ground)
        return picture

    @property
    def _ground(self) -> str | None:
        background = self._settings.background
        return None if is_transparent(background) else background

    @property
    def _is_scene(self) -> bool:
        return bool(self.meshes) or isinstance(self.style, MeshLook)

    def _open_scene(self) -> Any:
        from clrecon.operators.rays.scene import ScenePictures

        if self._renderer is None:
            looks = self._settings.mesh_looks()
            objects = [(self._subject, self.style), *zip(self.meshes, looks, strict=True)]
            opened = ScenePictures(objects, device=self.device, memory=self._settings.memory)
            self._renderer = self._stack.enter_context(opened)
        return self._renderer


def _shown_function(settings: RenderSettings, style: Style) -> TransferFunction | None:
    """Return the transfer function of a style, or that of the preset that the style was made from."""
    if settings.preset_used not in (None, ALL_PRESETS):
        return find_preset(settings.preset_used).transfer_function
    if isinstance(style, VolumeLook):
        return style.function
    return style.transfer_function if isinstance(style, SlicesInSpace) else None
