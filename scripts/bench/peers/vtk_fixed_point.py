"""The peer of pictures on processors: vtkFixedPointVolumeRayCastMapper, set up to do what clrecon does.

Its rays are cast on processor threads into memory of its own, so the peer calls the parts of its ``Render`` up to
there: no OpenGL context, no texture and no window take part.

Differences from clrecon's rays, found in the source (Rendering/Volume of VTK) and by trial: rays run between the outer
voxel centres; samples lie at whole steps from the near plane; HU are rounded to integers before the transfer function;
normals of voxels (in 16 bits) are shaded and the shades interpolated, while clrecon shades the interpolated gradient; a
voxel without a gradient gets ambient light only; rays end at an opacity of 0.992.
"""

from __future__ import annotations

import ctypes
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from peers.vtk_stage import Scene, Stage, vtk_version

PIXEL_SCALE = 32767
"""The mapper's picture has 15 bits a channel."""


class FixedPointPeer:
    """vtkFixedPointVolumeRayCastMapper on `threads` threads, without OpenGL.

    voxels: (nk, nj, ni), shared, not copied.
    """

    name = "vtkFixedPointVolumeRayCastMapper"

    def __init__(self, voxels: NDArray[Any], scene: Scene, threads: int):
        import vtkmodules.vtkRenderingVolumeOpenGL2  # noqa: F401  the mapper's constructor crashes without it

        self.threads = threads
        self.version = vtk_version()
        self._voxels = voxels
        self._stage = Stage(scene)

    def first_frame(self) -> float:
        """Seconds of the first picture of a volume in memory, with a new mapper."""
        from vtkmodules.vtkRenderingVolume import vtkFixedPointVolumeRayCastMapper

        start = perf_counter()
        mapper = vtkFixedPointVolumeRayCastMapper()
        mapper.SetNumberOfThreads(self.threads)
        mapper.SetIntermixIntersectingGeometry(0)
        self._stage.load(self._voxels, mapper)
        self.frame()
        return perf_counter() - start

    def frame(self) -> float:
        """Seconds of a further picture, in the mapper's own memory."""
        mapper, renderer, volume = self._stage.mapper, self._stage.renderer, self._stage.volume
        start = perf_counter()
        mapper.PerImageInitialization(renderer, volume, 0, [0.0] * 3, [0.0] * 3, [0] * 6)
        mapper.PerVolumeInitialization(renderer, volume)
        mapper.PerSubVolumeInitialization(renderer, volume, 0)
        mapper.RenderSubVolume()
        return perf_counter() - start

    def picture(self) -> NDArray[np.uint8]:
        """The last picture on black, shape (h, w, 3), uint8; row 0 is the top."""
        image, scene = self._stage.mapper.GetRayCastImage(), self._stage.scene
        columns, rows = image.GetImageMemorySize()
        used, lines = image.GetImageInUseSize()
        left, bottom = image.GetImageOrigin()
        address = int(image.GetImage().split("_")[1], 16)
        pixels = np.ctypeslib.as_array((ctypes.c_uint16 * (rows * columns * 4)).from_address(address))
        colours = pixels.reshape(rows, columns, 4)[:lines, :used, :3].astype(np.float32)
        picture = np.zeros((scene.height, scene.width, 3), np.uint8)
        picture[bottom : bottom + lines, left : left + used] = np.rint(colours * (255.0 / PIXEL_SCALE))
        return picture[::-1].copy()
