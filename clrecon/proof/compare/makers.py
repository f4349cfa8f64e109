"""How each method makes what it makes, VTK's as peers of the page, the parts of the time, and its picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume, is_left_handed
from clrecon.geometry.iso_rule import choose_iso_rule
from clrecon.mesh import Mesh
from clrecon.mesh.triangles import vertex_normals
from clrecon.opencl import Device
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.points.cloud import PointCloud
from clrecon.proof.compare.processes import Request
from clrecon.proof.rays.render import cast_rays
from clrecon.proof.timing import usable_cores
from clrecon.rendering import Rendering
from clrecon.rendering.views.camera import Camera

Image = NDArray[np.uint8]

BACKGROUND = "black"


def draw_mesh(mesh: Mesh, camera: Camera, size: tuple[int, int], *, device: Device | None = None) -> Image:
    """Draw a mesh, shaded by the normals of its triangles alone, so that pictures differ only where surfaces do."""
    from clrecon.operators.rays.render import render
    from clrecon.rendering.pictures.object_looks import MeshLook

    bare = Mesh(mesh.vertices, mesh.triangles)
    picture = render(bare, MeshLook("bone"), camera=camera, size=size, background=BACKGROUND, device=device)
    return flatten(picture.image)


def flatten(image: NDArray[Any]) -> Image:
    """Put a picture with opacity before black: (h, w, 4) uint8, not premultiplied, becomes (h, w, 3) uint8."""
    colour, opacity = image[..., :3].astype(np.uint16), image[..., 3:].astype(np.uint16)
    return ((colour * opacity + 127) // 255).astype(np.uint8)


FILTERS = {"vtk-mc": "vtkMarchingCubes", "vtk-fe": "vtkFlyingEdges3D"}


def extract_by_vtk(volume: Volume, iso_value: float, name: str, closed: bool) -> Mesh:
    """Extract by "vtk-mc" or "vtk-fe", with normals; `closed`: a layer of air; report: ``cells``, ``seconds``."""
    from vtkmodules import vtkFiltersCore
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkSMPTools
    from vtkmodules.vtkCommonDataModel import vtkImageData

    rule = choose_iso_rule(volume, iso_value, closed=closed)
    start = perf_counter()
    voxels = volume.voxels
    if rule.closed:
        voxels = np.pad(voxels, 1, constant_values=voxels.dtype.type(rule.outside))
    nk, nj, ni = voxels.shape
    grid: Any = vtkImageData()
    grid.SetDimensions(ni, nj, nk)
    grid.GetPointData().SetScalars(numpy_to_vtk(np.ascontiguousarray(voxels).reshape(-1)))
    cores = usable_cores()
    vtkSMPTools.SetBackend("STDThread" if cores > 1 else "Sequential")
    vtkSMPTools.Initialize(cores)
    contour: Any = getattr(vtkFiltersCore, FILTERS[name])()
    contour.SetInputData(grid)
    contour.SetValue(0, rule.iso_level)
    contour.ComputeNormalsOn()
    contour.ComputeScalarsOff()
    contour.ComputeGradientsOff()
    contour.Update()
    polydata = contour.GetOutput()
    if not polydata.GetNumberOfPolys():
        raise NoSurfaceError(f"no surface {rule.phrase()}")
    extracted = perf_counter()
    vertices_ijk: NDArray[np.float64] = vtk_to_numpy(polydata.GetPoints().GetData()).astype(np.float64)
    faces = vtk_to_numpy(polydata.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    places = volume.ijk_to_lps(vertices_ijk - rule.border).astype(np.float32)
    # In (i, j, k) its triangles are counter-clockwise as seen from lower values.
    triangles = faces[:, ::-1] if is_left_handed(volume.affine) else faces
    triangles = np.ascontiguousarray(triangles, np.uint32)
    report: dict[str, Any] = {
        "cells": {"visited": (ni - 1) * (nj - 1) * (nk - 1), "all": (ni - 1) * (nj - 1) * (nk - 1)},
        "seconds": {"extract": extracted - start, "place": perf_counter() - extracted},
        "growing": None,
        "warnings": [],
    }
    return Mesh(places, triangles, vertex_normals(places, triangles), report)


PARTS = ("build", "upload", "kernels", "host", "download", "draw")
"""Parts of the time of a method: kernels are built; the volume goes to the device; kernels run; the CPU works (all of
it, where a method has no kernels); results come back; a picture is drawn."""

_DEVICE_PARTS = ("build", "upload", "kernels", "download")

TWIN_SIZE = (128, 128)
"""Pixels of ray casting in numpy, which takes seconds for them, and of the device beside it."""

_RAYS_PRESET: Final = "bone"


@dataclass
class Scene:
    """The scan of one process, and what is asked of it."""

    volume: Volume
    request: Request
    device: Device | None


@dataclass
class Made:
    """What one run made, and its seconds by part, without drawing."""

    product: Any
    seconds: dict[str, float]
    report: Mapping[str, Any]
    extra: dict[str, float] = field(default_factory=dict)


def make_timed(scene: Scene) -> Made:
    """Run the method once, and time it."""
    maker = _MAKERS[scene.request.method]
    start = perf_counter()
    product, reports = maker(scene)
    total = perf_counter() - start
    seconds = dict.fromkeys(PARTS, 0.0)
    for report in reports:
        part_seconds = report.get("seconds", {})
        for part in _DEVICE_PARTS:
            seconds[part] += float(part_seconds.get(part, 0.0))
    seconds["host"] = max(0.0, total - sum(seconds.values()))
    kernels: dict[str, float] = {}
    for report in reports:
        for name, spent in report.get("kernel_seconds", {}).items():
            kernels[name] = kernels.get(name, 0.0) + spent
    return Made(product, seconds, {**reports[-1], "kernel_seconds": kernels})


Product = tuple[Any, list[Mapping[str, Any]]]


def _surface(scene: Scene, method: Any, **more: Any) -> Product:
    from clrecon.operators.surface.methods import extract_by_method

    request = scene.request
    mesh = extract_by_method(
        scene.volume, request.iso_value, method, closed=request.closed, device=scene.device, memory=request.memory,
        **more,
    )  # fmt: skip
    return mesh, [mesh.report]


def _fitted(scene: Scene) -> Product:
    """Marching cubes, and the surface moved onto the bone; the volume goes to the device once."""
    from clrecon.operators.surface.cortex_mesh import fit_cortex
    from clrecon.operators.surface.extract import extract_isosurface

    request = scene.request
    with DeviceVolume(scene.volume, device=scene.device, memory=request.memory) as resident:
        mesh = extract_isosurface(resident, request.iso_value, closed=request.closed)
        fitted = fit_cortex(mesh, resident)
    return fitted, [mesh.report]


def _vtk(scene: Scene) -> Product:
    request = scene.request
    mesh = extract_by_vtk(scene.volume, request.iso_value, request.method, request.closed)
    return mesh, [mesh.report]


def _cloud(scene: Scene) -> Product:
    from clrecon.operators.points.point_extraction import extract_points

    request = scene.request
    cloud = extract_points(scene.volume, request.iso_value, kind="shell", device=scene.device, memory=request.memory)
    return cloud, [cloud.report]


def _cloud_surface(scene: Scene) -> Product:
    """Voxels, their normals, and the surface around them; the volume goes to the device once."""
    from clrecon.operators.points.normals import estimate_normals
    from clrecon.operators.points.point_extraction import extract_points
    from clrecon.operators.points.reconstruct import reconstruct_surface

    request = scene.request
    with DeviceVolume(scene.volume, device=scene.device, memory=request.memory) as resident:
        cloud = extract_points(resident, request.iso_value, kind="shell")
        step = estimate_normals(cloud, volume=resident)
    mesh = reconstruct_surface(step.cloud, device=scene.device, memory=request.memory)
    return mesh, [cloud.report, step.facts, mesh.report]


def _rays(scene: Scene) -> Product:
    picture = _cast(scene, *scene.request.views()["view"])
    return picture, [picture.report]


def _cast(scene: Scene, camera: Camera, size: tuple[int, int]) -> Rendering:
    """Cast rays on the device, the upload of the volume included."""
    from clrecon.operators.rays.render import render
    from clrecon.rendering.pictures.styles import VolumeLook

    return render(
        scene.volume, VolumeLook(_RAYS_PRESET), camera=camera, size=size, device=scene.device,
        memory=scene.request.memory,
    )  # fmt: skip


def _rays_cpu(scene: Scene) -> Product:
    camera, _ = scene.request.views()["view"]
    from clrecon.rendering.pictures.styles import VolumeLook

    cast = cast_rays(scene.volume, VolumeLook(_RAYS_PRESET), camera, TWIN_SIZE)
    depth = cast.depth.astype("float32")
    return Rendering(cast.image(), depth, depth, camera), [{}]


def _plain(scene: Scene) -> Product:
    """By the name of a method of marching cubes."""
    return _surface(scene, scene.request.method)


_MAKERS: dict[str, Callable[[Scene], Product]] = {
    **dict.fromkeys(("t-mc", "t-mc-soup", "skimage", "i-mc", "g-mc", "s-mc"), _plain),
    "i-mc-golden": lambda scene: _surface(scene, "i-mc", vertex_rule="golden"),
    "cortex": _fitted,
    "vtk-mc": _vtk,
    "vtk-fe": _vtk,
    "cloud": _cloud,
    "cloud-surface": _cloud_surface,
    "rays": _rays,
    "rays-cpu": _rays_cpu,
}


def draw(scene: Scene, product: Any, view: str) -> Any:
    """Draw what a method made, before black; `view` is "view" or "along", a name of `Request.views`."""
    camera, size = scene.request.views()[view]
    if isinstance(product, Mesh):
        return draw_mesh(product, camera, size, device=scene.device)
    if isinstance(product, PointCloud):
        from clrecon.operators.rays.point_pictures import PointPictures
        from clrecon.rendering.pictures.object_looks import PointLook

        with PointPictures(product, device=scene.device) as pictures:
            return flatten(pictures.take(PointLook(color="bone"), camera, size, BACKGROUND).image)
    if view == "view":
        return flatten(product.image)
    return flatten(_cast(scene, camera, size).image)


def time_small(scene: Scene) -> float:
    """Return the seconds of one picture of `TWIN_SIZE` on the device, the upload included."""
    camera, _ = scene.request.views()["view"]
    start = perf_counter()
    _cast(scene, camera, TWIN_SIZE)
    return perf_counter() - start
