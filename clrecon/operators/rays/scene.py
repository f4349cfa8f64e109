"""Pictures of several objects in one place: meshes, and what is seen with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from clrecon.errors import UsageError
from clrecon.mesh import Mesh
from clrecon.opencl import Device, Stopwatch, check_memory, take_device, work_on
from clrecon.operators.rays.layers import draw_layers
from clrecon.operators.rays.mesh_pictures import box_around, make_part, mesh_corners
from clrecon.operators.rays.triangles import MOST_TRIANGLES
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.mesh_look import MeshLook
from clrecon.rendering.views.camera import Camera
from clrecon.system.closing import Closing
from clrecon.system.progress import Progress

__all__ = ["ScenePictures"]


class ScenePictures(Closing):
    """Meshes of which pictures are made one after the other.

    Use it as a context manager, or `close` it.

    Parameters
    ----------
    meshes : sequence of (Mesh, MeshLook)
        Their arrays must not change as long as this object is open.  Of triangles at the same depth the first is seen.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Bytes that may be taken on the device.

    Raises
    ------
    UsageError
        There is nothing to show, a mesh has a number that cannot be, or `memory` is not a number of bytes.
    DeviceError
        The device does not exist.
    """

    def __init__(
        self,
        meshes: Sequence[tuple[Mesh, MeshLook]],
        *,
        device: Device | str | int | None = None,
        memory: int | None = None,
    ):
        check_memory(memory)
        if not meshes:
            raise UsageError("a picture shows at least one object")
        self.box = box_around([mesh_corners(mesh) for mesh, _ in meshes])
        self._parts = [make_part(mesh, look) for mesh, look in meshes]
        self._triangles = sum(len(part.triangles) for part in self._parts)
        if self._triangles > MOST_TRIANGLES:
            raise UsageError(f"a picture shows at most {MOST_TRIANGLES:,} triangles, these are {self._triangles:,}")
        self.memory = memory
        self._device = take_device(device)

    def close(self) -> None:
        """Free what was made for the pictures."""
        self._parts = []

    @property
    def device(self) -> Device:
        """The device that works."""
        return self._device.current

    def take(
        self,
        camera: Camera,
        size: tuple[int, int],
        background: str | Sequence[float] | None = None,
        progress: Progress | None = None,
    ) -> Rendering:
        """Take one picture.

        Parameters
        ----------
        camera : Camera
        size : (width, height)
        background : str or (float, float, float), optional
            None: transparent.
        progress : callable, optional
            Called as ``progress("render", 0, 0)``.

        Raises
        ------
        UsageError
            Triangles cover too many pixels.
        DeviceError
            Not enough memory, or the device fails.
        """
        stopwatch = Stopwatch()
        if progress is not None:
            progress("render", 0, 0)

        def draw(device: Device, told: list[str]) -> Rendering:
            found = draw_layers(
                device, self._parts, camera, size, background=background, memory=self.memory, stopwatch=stopwatch
            )
            warnings = [*device.warnings, *told]
            if found.open_pixels:
                warnings.append(
                    f"{found.open_pixels:,} pixels have more than {found.layers} translucent surfaces behind each"
                    " other: the rest is left out"
                )
            report: dict[str, Any] = {
                "mode": "mesh",
                "device": device.label,
                "driver": device.driver,
                "triangles": self._triangles,
                "layers": found.layers,
                "seconds": dict(stopwatch.seconds),
                "kernel_seconds": dict(stopwatch.by_kernel),
                "warnings": warnings,
            }
            return Rendering(found.image, found.depth, found.expected_depth, camera, None, "mesh", report)

        return work_on(self._device, draw)
