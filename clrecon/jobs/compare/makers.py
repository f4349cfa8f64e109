"""How each method makes what it makes, and the parts of the time that it takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

from clrecon.geometry import Volume
from clrecon.jobs.compare.request import Request
from clrecon.mesh import Mesh
from clrecon.opencl import Device
from clrecon.points import PointCloud
from clrecon.rendering import Rendering
from clrecon.rendering.views.camera import Camera

PARTS = ("build", "upload", "kernels", "host", "download", "draw")
"""Parts of the time of a method: kernels are built; the volume goes to the device; kernels run; the CPU works (all of
it, where a method has no kernels); results come back; a picture is drawn."""

DEVICE_PARTS = ("build", "upload", "kernels", "download")

TWIN_SIZE = (128, 128)
"""Pixels of ray casting in numpy, which takes seconds for them, and of the device beside it."""

RAYS_PRESET = "bone"


@dataclass
class Scene:
    """The scan of one process, and what is asked of it."""

    volume: Volume
    request: Request
    device: Device | None


@dataclass
class Made:
    """What one run made.

    seconds: By part, without drawing.
    """

    product: Any
    seconds: dict[str, float]
    report: Mapping[str, Any]
    extra: dict[str, float] = field(default_factory=dict)


def make(scene: Scene) -> Made:
    """Run the method once, and time it."""
    maker = _MAKERS[scene.request.method]
    start = perf_counter()
    product, reports = maker(scene)
    total = perf_counter() - start
    seconds = dict.fromkeys(PARTS, 0.0)
    for report in reports:
        own = report.get("seconds", {})
        for part in DEVICE_PARTS:
            seconds[part] += float(own.get(part, 0.0))
    seconds["host"] = max(0.0, total - sum(seconds.values()))
    return Made(product, seconds, _joined(reports))


def _joined(reports: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the last report, with the kernels of all of them."""
    kernels: dict[str, float] = {}
    for report in reports:
        for name, spent in report.get("kernel_seconds", {}).items():
            kernels[name] = kernels.get(name, 0.0) + spent
    return {**reports[-1], "kernel_seconds": kernels}


Product = tuple[Any, list[Mapping[str, Any]]]


def _surface(scene: Scene, method: str, **more: Any) -> Product:
    from clrecon.operators.surface.methods import extract_by_method

    request = scene.request
    mesh = extract_by_method(
        scene.volume, request.iso_value, method, closed=request.closed, device=scene.device, memory=request.memory,
        **more,
    )  # fmt: skip
    return mesh, [mesh.report]


def _vtk(scene: Scene) -> Product:
    from clrecon.jobs.compare.peers import extract_by_vtk

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
    from clrecon.operators.resident.device_volume import DeviceVolume

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
        scene.volume, VolumeLook(RAYS_PRESET), camera=camera, size=size, device=scene.device,
        memory=scene.request.memory,
    )  # fmt: skip


def _rays_cpu(scene: Scene) -> Product:
    return _cast_twin(scene, TWIN_SIZE), [{}]


def _cast_twin(scene: Scene, size: tuple[int, int]) -> Rendering:
    from clrecon.proof.rays.render import cast_rays
    from clrecon.rendering.looks.presets import find_preset

    camera, _ = scene.request.views()["view"]
    preset = find_preset(RAYS_PRESET)
    found = cast_rays(scene.volume, preset.transfer_function, camera, size, lighting=preset.lighting)
    depth = found.depth.astype("float32")
    return Rendering(found.image(), depth, depth, camera)


def _plain(scene: Scene) -> Product:
    """By the name of a method of marching cubes."""
    return _surface(scene, scene.request.method)


_MAKERS: dict[str, Callable[[Scene], Product]] = {
    **dict.fromkeys(("t-mc", "t-mc-soup", "skimage", "i-mc", "g-mc", "s-mc"), _plain),
    "i-mc-golden": lambda scene: _surface(scene, "i-mc", vertex_rule="golden"),
    "vtk-mc": _vtk,
    "vtk-fe": _vtk,
    "cloud": _cloud,
    "cloud-surface": _cloud_surface,
    "rays": _rays,
    "rays-cpu": _rays_cpu,
}


def draw(scene: Scene, product: Any, view: str) -> Any:
    """Draw what a method made.

    view: {"view", "along"}. Name of `Request.views`.

    Returns: ndarray, shape (height, width, 3), uint8. Before black.
    """
    from clrecon.jobs.compare.drawing import draw_mesh, draw_points, flatten

    camera, size = scene.request.views()[view]
    if isinstance(product, Mesh):
        return draw_mesh(product, camera, size, device=scene.device)
    if isinstance(product, PointCloud):
        return draw_points(product, camera, size, device=scene.device)
    if view == "view":
        return flatten(product.image)
    return flatten(_cast(scene, camera, size).image)


def time_small(scene: Scene) -> float:
    """Return the seconds of one picture of `TWIN_SIZE` on the device, the upload included."""
    camera, _ = scene.request.views()["view"]
    start = perf_counter()
    _cast(scene, camera, TWIN_SIZE)
    return perf_counter() - start
