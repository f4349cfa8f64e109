"""Smoothing within an error bound, and its filter on a device."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon import opencl as ocl
from clrecon.mesh import Mesh
from clrecon.mesh.refine import smoothing
from clrecon.mesh.refine.smoothing import Filter, Rings, Term
from clrecon.opencl import Device, Program
from clrecon.operators.masks.voxel_mask import zero_words
from clrecon.operators.primitives.union_find import label_components
from clrecon.operators.surface.decimation import follow_crossings
from clrecon.system.arguments import explains_arguments
from clrecon.system.progress import Progress

Float32Array = NDArray[np.float32]


def prepare_smoothing(device: Device) -> Program:
    return ocl.load_program(device, "surface/smoothing.cl")


class DeviceFilter(Filter):
    """A low pass over a surface on a device, with the bits of its twin, which does it where the device has no room."""

    def __init__(self, device: Device, rings: Rings):
        super().__init__(rings)
        self._device, self._count = device, len(rings.weights)
        needs = {"vertices and their steps": 4 * 16 * self._count, "corners": 8 * len(rings.after) + 8 * self._count}
        self._fits = self._count > 0 and not ocl.describe_shortage(ocl.memory_limits(device), needs)

    @cached_property
    def _corners(self) -> dict[str, Any]:
        rings = self._rings
        arrays = {"begin": rings.begin, "after": rings.after, "before": rings.before, "weights": rings.weights}
        return {name: ocl.upload(self._device, array) for name, array in arrays.items()}

    def label(self, triangles: NDArray[np.uint32]) -> tuple[int, NDArray[np.int64]]:
        return label_components(self._device, triangles, self._count) if self._fits else super().label(triangles)

    def measure_bends(self, places: Float32Array) -> tuple[Float32Array, Float32Array]:
        if not self._fits:
            return super().measure_bends(places)
        device, count = self._device, self._count
        (bends, bends_d), (normals, normals_d) = (ocl.empty_output(device, (count, 4), np.float32) for _ in range(2))
        ocl.launch(
            device, prepare_smoothing(device)["measure_bends"], count,
            places=ocl.upload(device, _padded(places)), **self._corners, bends=bends_d, normals=normals_d, count=count,
        )  # fmt: skip
        ocl.download_all(device, (bends, bends_d, 0), (normals, normals_d, 0))
        return bends[:, :3], normals[:, :3]

    def find_steps(self, bends: Float32Array, terms: Sequence[Term]) -> Float32Array:
        if not self._fits:
            return super().find_steps(bends, terms)
        device, count = self._device, self._count
        kernel, bends_d = prepare_smoothing(device)["filter_bends"], ocl.upload(device, _padded(bends))
        later_d, sums_d = (zero_words(device, 4 * count) for _ in range(2))
        corners = {name: self._corners[name] for name in ("begin", "after", "weights")}
        for factor, share in terms:
            ocl.launch(
                device, kernel, count, bends=bends_d, later=later_d, **corners, sums=sums_d,
                factor=factor, share=share, count=count,
            )  # fmt: skip
            later_d, sums_d = sums_d, later_d
        return ocl.download(device, np.empty((count, 4), np.float32), later_d)[:, :3]


def _padded(vectors: Float32Array) -> Float32Array:
    """Return vectors, shape (n, 3), with a fourth component of 0."""
    padded = np.zeros((len(vectors), 4), np.float32)
    padded[:, :3] = vectors
    return padded


@explains_arguments
def smooth_mesh(
    mesh: Mesh,
    iterations: int = 20,
    max_deviation_mm: float | None = None,
    *,
    device: Device | str | int | None = None,
    progress: Progress | None = None,
) -> Mesh:
    """Smooth a surface with a windowed sinc filter (Taubin, Zhang and Golub 1996), which hardly shrinks it.

    A vertex that the filter moves farther than the bound stops there, or a little before: the rest is for the shift
    along the normals that gives each closed component its volume.  Components that cannot have it back take shorter
    steps, such as specks of a few triangles, which the filter draws into a point.  Where triangles would cut each
    other, lose their area or coincide, steps are halved or not made.  Vertices at an open border stay.

    Parameters
    ----------
    mesh : Mesh
    iterations : int
        Degree of the filter; a higher one smooths more.
    max_deviation_mm : float, optional
        No point of the result lies farther than this from the given surface, and no point of that from the result: the
        triangles are the same and no corner moves farther, so no point between them does.  Default:
        a quarter of the shortest voxel step that the report of the mesh names.
    device : Device, str or int, optional
        Filters, and finds triangles that cut each other, see `clrecon.device`.  None: numpy does it, which takes longer
        and needs no device.  The result is the same, bit for bit.
    progress : callable, optional
        Called as ``progress("smooth", steps done, all steps)``.

    Returns
    -------
    Mesh
        The same triangles; normals from the faces; the report is taken over, with ``refinement["smooth"]``:
        ``iterations``, ``max_deviation_mm``, ``roughness_before_mm`` and ``roughness_after_mm`` (root mean square of
        the distances between vertices and the mean of their neighbours), ``vertices_held_back`` (by the bound),
        ``vertices_taken_back`` (from cuts and faces without area, or as their component had lost its volume so) and
        ``components_left`` (not moved, as they would not have kept their volume).

    Raises
    ------
    UsageError
        A value cannot be used, or there is neither a bound nor a voxel size in the report of the mesh.
    NoSurfaceError
        The mesh is empty.
    DeviceError
        The device does not exist, or fails.
    """
    if device is None:
        return smoothing.smooth_mesh(mesh, iterations, max_deviation_mm, progress=progress)
    for attempt in ocl.with_fallback(ocl.take_device(device)):
        with attempt as (current, _):
            smooth = smoothing.smooth_mesh(
                mesh, iterations, max_deviation_mm, progress=progress, make_filter=partial(DeviceFilter, current),
                follow=partial(follow_crossings, current),
            )  # fmt: skip
    return smooth
