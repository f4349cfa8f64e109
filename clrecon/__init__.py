"""CT DICOM in, calibrated bone mesh out, computed on any OpenCL device.

>>> import clrecon
>>> volume = clrecon.read_volume("CT_FOLDER")
>>> mesh = clrecon.extract_isosurface(volume, 250)
>>> mesh.save("bone.stl")

The public names below are imported when they are first used: ``import clrecon`` alone needs no driver and loads
neither pyopencl nor VTK.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clrecon.anatomy.body import mask_field_of_view, remove_table
    from clrecon.anatomy.iso_choice import choose_iso_value
    from clrecon.anatomy.spine_line import find_spine_line
    from clrecon.errors import (
        Cancelled,
        ClreconError,
        DeviceError,
        NoDicomError,
        NoSurfaceError,
        OutputError,
        RefusedInputError,
        UsageError,
    )
    from clrecon.geometry import Volume
    from clrecon.labels import LabelMap, read_labels
    from clrecon.mesh import Mesh
    from clrecon.mesh.compare.distances import compare_meshes
    from clrecon.mesh.refine.decimation import decimate_mesh
    from clrecon.mesh.refine.smoothing import smooth_mesh
    from clrecon.opencl import Device
    from clrecon.operators.rays.render import VolumeRenderer, render
    from clrecon.operators.reformat.cut import cut_slice, reformat_curve
    from clrecon.operators.resident.device_volume import DeviceVolume
    from clrecon.operators.surface.extract import SurfaceExtractor, extract_isosurface, extract_isosurfaces
    from clrecon.operators.surface.label_masks import extract_label_masks
    from clrecon.operators.surface.labels import extract_labels
    from clrecon.reading import list_series, read_volume
    from clrecon.rendering import Lighting, Rendering, TransferFunction, load_transfer_function
    from clrecon.rendering.movies.movie import turntable_cameras, write_animation
    from clrecon.rendering.pictures.styles import (
        CurveCut,
        PlaneCut,
        Projection,
        SlicesInSpace,
        Style,
        SurfaceLook,
        VolumeLook,
    )
    from clrecon.rendering.views.camera import Camera
    from clrecon.rendering.views.centre_line_files import read_curve_points
    from clrecon.rendering.views.clip import Clip

    __version__: str

__all__ = [
    "Camera",
    "Cancelled",
    "Clip",
    "ClreconError",
    "CurveCut",
    "DeviceError",
    "DeviceVolume",
    "LabelMap",
    "Lighting",
    "Mesh",
    "NoDicomError",
    "NoSurfaceError",
    "OutputError",
    "PlaneCut",
    "Projection",
    "RefusedInputError",
    "Rendering",
    "SlicesInSpace",
    "Style",
    "SurfaceExtractor",
    "SurfaceLook",
    "TransferFunction",
    "UsageError",
    "Volume",
    "VolumeLook",
    "VolumeRenderer",
    "__version__",
    "choose_iso_value",
    "compare_meshes",
    "cut_slice",
    "decimate_mesh",
    "device",
    "devices",
    "extract_isosurface",
    "extract_isosurfaces",
    "extract_label_masks",
    "extract_labels",
    "find_spine_line",
    "list_series",
    "load_transfer_function",
    "mask_field_of_view",
    "read_curve_points",
    "read_labels",
    "read_volume",
    "reformat_curve",
    "remove_table",
    "render",
    "smooth_mesh",
    "turntable_cameras",
    "write_animation",
]

_HOMES = {
    "Camera": "clrecon.rendering.views.camera",
    "Cancelled": "clrecon.errors",
    "Clip": "clrecon.rendering.views.clip",
    "ClreconError": "clrecon.errors",
    "CurveCut": "clrecon.rendering.pictures.styles",
    "DeviceError": "clrecon.errors",
    "DeviceVolume": "clrecon.operators.resident.device_volume",
    "LabelMap": "clrecon.labels",
    "Lighting": "clrecon.rendering",
    "Mesh": "clrecon.mesh",
    "NoDicomError": "clrecon.errors",
    "NoSurfaceError": "clrecon.errors",
    "OutputError": "clrecon.errors",
    "PlaneCut": "clrecon.rendering.pictures.styles",
    "Projection": "clrecon.rendering.pictures.styles",
    "RefusedInputError": "clrecon.errors",
    "Rendering": "clrecon.rendering",
    "SlicesInSpace": "clrecon.rendering.pictures.styles",
    "Style": "clrecon.rendering.pictures.styles",
    "SurfaceExtractor": "clrecon.operators.surface.extract",
    "SurfaceLook": "clrecon.rendering.pictures.styles",
    "TransferFunction": "clrecon.rendering",
    "UsageError": "clrecon.errors",
    "Volume": "clrecon.geometry",
    "VolumeLook": "clrecon.rendering.pictures.styles",
    "VolumeRenderer": "clrecon.operators.rays.render",
    "choose_iso_value": "clrecon.anatomy.iso_choice",
    "compare_meshes": "clrecon.mesh.compare.distances",
    "cut_slice": "clrecon.operators.reformat.cut",
    "decimate_mesh": "clrecon.mesh.refine.decimation",
    "extract_isosurface": "clrecon.operators.surface.extract",
    "extract_isosurfaces": "clrecon.operators.surface.extract",
    "extract_label_masks": "clrecon.operators.surface.label_masks",
    "extract_labels": "clrecon.operators.surface.labels",
    "find_spine_line": "clrecon.anatomy.spine_line",
    "list_series": "clrecon.reading",
    "load_transfer_function": "clrecon.rendering",
    "mask_field_of_view": "clrecon.anatomy.body",
    "read_curve_points": "clrecon.rendering.views.centre_line_files",
    "read_labels": "clrecon.labels",
    "read_volume": "clrecon.reading",
    "reformat_curve": "clrecon.operators.reformat.cut",
    "remove_table": "clrecon.anatomy.body",
    "render": "clrecon.operators.rays.render",
    "smooth_mesh": "clrecon.mesh.refine.smoothing",
    "turntable_cameras": "clrecon.rendering.movies.movie",
    "write_animation": "clrecon.rendering.movies.movie",
}


def devices() -> list[Device]:
    """List every OpenCL device of the machine.

    Returns
    -------
    list of clrecon.opencl.Device
        With ``index, name, platform, type, version, driver, memory_bytes``; empty where there is no driver.

    Raises
    ------
    DeviceError
        pyopencl cannot be imported.
    """
    from clrecon.opencl import list_devices

    return list_devices()


def device(name: str | int | None = None) -> Device:
    """Choose an OpenCL device.

    Parameters
    ----------
    name : str or int, optional
        Index, type or part of a name as ``clrecon devices`` shows them.  Without it: what CLRECON_DEVICE says,
        else the best device of the machine.

    Returns
    -------
    clrecon.opencl.Device

    Raises
    ------
    DeviceError
        No device, or none of that name; the message lists what is there.
    """
    from clrecon.opencl import choose_device

    return choose_device(name)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from clrecon.version import package_version

        value: Any = package_version()
    elif name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    else:
        raise AttributeError(f"module 'clrecon' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
