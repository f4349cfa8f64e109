"""`render`: a picture of a volume, a cloud, a mesh, or of several of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.operators.rays.point_pictures import PointPictures
from clrecon.operators.rays.scene import ScenePictures, Subject, check_objects
from clrecon.operators.rays.volume_renderer import Place, VolumeRenderer
from clrecon.points.cloud import PointCloud
from clrecon.rendering import Rendering
from clrecon.rendering.looks.colors import is_transparent
from clrecon.rendering.pictures.modes import Look, find_style
from clrecon.rendering.pictures.object_looks import MeshLook, PointLook
from clrecon.rendering.pictures.styles import SlicesInSpace, Style, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.directions import DEFAULT_SIZE, checked_size, default_view
from clrecon.system.arguments import ModeName, ViewName, explains_arguments
from clrecon.system.progress import Progress

if TYPE_CHECKING:
    from typing_extensions import Unpack  # of Python 3.11


@explains_arguments
def render(
    shown: Subject | Sequence[Subject | tuple[Subject, Style]],
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
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
    **look: Unpack[Look],
) -> Rendering:
    """Make a picture of a volume, of a point cloud, of a mesh, or of several of them in one place.

    >>> render(volume, SurfaceLook(300, color="orange"), view="left", size=(800, 600))
    >>> render(volume, "mip", window=(0, 1000))
    >>> render([(scan, VolumeLook("muscle")), (vertebra, MeshLook("orange")), (implant, MeshLook(opacity=0.4))])

    Parameters
    ----------
    shown : Volume, DeviceVolume, PointCloud or Mesh; or a sequence of them
        Of several objects each may be a pair with its style, and ``style`` and ``look`` are refused.  All are in LPS
        mm. One volume of them may be translucent (a `VolumeLook` or `SlicesInSpace`); see ``docs/rendering.md``.
    style : Style or str, optional
        What the picture shows: a `VolumeLook`, `Projection`, `SurfaceLook`, `SlicesInSpace`, `PlaneCut` or `CurveCut`,
        of a point cloud a `PointLook`, of a mesh a `MeshLook`; or the name of a mode, see
        ``clrecon.rendering.pictures.modes.MODES``.  Default: volume rendering of bone, of a cloud its points, and of a
        mesh its triangles.
    camera : Camera, optional
        In place of ``view``, ``up``, ``zoom``, ``view_angle`` and ``center``, which are refused beside it.
    view : str or (azimuth, elevation), optional
        Where the camera stands, default "anterior", of slices in space (30, 30); ``up``, ``zoom``, ``view_angle`` and
        ``center`` (LPS mm) go with it, see `Camera.fit`.  A plane knows axial, coronal and sagittal too.  It fits the
        volume; where a part of that was turned into air or is clipped or hidden, the box of what is left.
    size : (width, height), optional
        Pixels; default 1024 x 1024, and for a `CurveCut` what the curve needs.
    background : str or (float, float, float)
        Colour behind what is shown, or "transparent".
    device : Device, str or int, optional
        See `clrecon.device`.
    memory : int, optional
        Bytes that may be taken on the device; default all that it has.
    progress : callable, optional
        ``progress(stage, done, total)``, called as slabs are finished.
    **look
        In place of a style: ``mode``, ``preset`` and fields of the mode's style, see
        ``clrecon.rendering.pictures.modes.make_style``.

    Returns
    -------
    Rendering

    Raises
    ------
    UsageError
        A value that cannot be; the message lists what can.
    RefusedInputError
        The spinal canal is to be found, and there is none that one could be sure of.
    DeviceError
        No device, not enough memory, or the device fails.
    """
    placing: dict[str, Any] = {"camera": camera, "view": view, "up": up, "zoom": zoom}
    placing |= {"view_angle": view_angle, "center": center}
    if isinstance(shown, Volume) or not isinstance(shown, PointCloud | Mesh | Sequence):
        with VolumeRenderer(shown, device=device, memory=memory) as renderer:
            return renderer.render(style, size=size, background=background, progress=progress, **{**placing, **look})
    objects = _name_objects(shown, style, look)
    placement = Place.checked(objects[0][1], **_with_view(placing, objects))
    size = checked_size(DEFAULT_SIZE if size is None else size)
    ground = None if is_transparent(background) else background
    if isinstance(shown, PointCloud) and isinstance(chosen := objects[0][1], PointLook):
        with PointPictures(shown, device=device, memory=memory) as points:
            return points.take(chosen, placement.camera_for(points.box, size), size, ground, progress)
    with ScenePictures(objects, device=device, memory=memory) as pictures:
        return pictures.take(placement.camera_for(pictures.box, size), size, ground, progress)


def _name_objects(
    shown: PointCloud | Mesh | Sequence[Any], style: Style | str | None, look: Look
) -> list[tuple[Any, Style]]:
    if isinstance(shown, Sequence):
        if style is not None or look:
            raise UsageError("of several objects each has its own style: give pairs (object, style)")
        objects = [_styled(each) for each in shown]
        check_objects(objects)
        return objects
    mode = "points" if isinstance(shown, PointCloud) else "mesh"
    chosen = find_style(mode if style is None and "mode" not in look else style, look)
    if chosen.mode != mode:
        named = "a point cloud" if isinstance(shown, PointCloud) else "a mesh"
        raise UsageError(f"{named} is shown in mode {mode}, not in mode {chosen.mode}")
    return [(shown, chosen)]


def _with_view(placing: dict[str, Any], objects: Sequence[tuple[Any, Style]]) -> dict[str, Any]:
    """Return what places a camera; where no view is named, with one from which slices in space show."""
    if placing["camera"] is None and placing["view"] is None:
        for subject, style in objects:
            if isinstance(style, SlicesInSpace):
                return {**placing, "view": default_view(style.mode, subject)}
    return placing


def _styled(given: Any) -> tuple[Any, Style]:
    if isinstance(given, tuple):
        if len(given) != 2 or not isinstance(given[1], Style):
            raise UsageError("an object of a picture stands alone, or in a pair (object, style)")
        return given
    if isinstance(given, Mesh):
        return given, MeshLook()
    return given, PointLook() if isinstance(given, PointCloud) else VolumeLook()
