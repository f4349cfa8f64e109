"""Triangles on a device, and meshes with their looks in the form in which it draws them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.grid import Grid
from clrecon.mesh import Mesh
from clrecon.mesh.triangles import vertex_normals
from clrecon.opencl import Device, Stopwatch, allocate, kernel_number, launch, load_program, upload
from clrecon.operators.primitives.scan import exclusive_scan
from clrecon.operators.rays.picture_buffers import highlight_table
from clrecon.operators.rays.point_pictures import eye_table
from clrecon.rendering import Lighting
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.rendering.views.camera import Camera, box_between
from clrecon.system.light_dataclass import dataclass, field
from clrecon.system.pieces import find_bounds
from clrecon.system.text import format_digits

MOST_TRIANGLES = 2**32 - 2
"""Most triangles of a picture: one number is that of no triangle."""

PIECE = int(kernel_number("rays/triangles.cl", "PIECE"))
"""Pixels along each side of a piece of a large triangle."""

_PIECES_A_LAUNCH = 1 << 20
"""Pieces of large triangles that a launch draws: a fraction of a second, so that graphics drivers do not take it for a
hang."""

MOST_PIECES = 1 << 28
"""Pieces of all large triangles of a mesh: half an hour a layer on two cores."""


_KEPT_SHARE = 8
"""Of a device's memory an eighth at most is for the triangles of a part between two pictures."""


class PartBuffers(NamedTuple):
    """The arrays of a `MeshPart` on a device."""

    vertices_d: Any
    triangles_d: Any
    normals_d: Any
    colors_d: Any


@dataclass(eq=False)
class MeshPart:
    """Triangles with one look, in the form for a device, which keeps them for the next pictures.

    vertices: ndarray, shape (n, 3), float32. Mm from `base`, (3,) float64, LPS mm; finite.
    normals: ndarray, shape (n, 3), float32, or None. LPS, of any length; None: every triangle has its own.
    colors: ndarray, shape (n, 4), uint8, or None. Red, green, blue and 255 of each vertex, in place of `color`.
    opacity: Above 0 and up to 1.
    planes: ndarray, shape (p, 4), float64. Half-spaces in LPS mm that are kept: ``normal . p >= offset``.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    normals: NDArray[np.float32] | None
    color: Sequence[float]
    colors: NDArray[np.uint8] | None
    opacity: float
    lighting: Lighting
    planes: Float64Array
    base: Float64Array
    _sent: tuple[Any, PartBuffers] | None = field(default=None, init=False, repr=False)

    def send(self, device: Device, stopwatch: Stopwatch) -> PartBuffers:
        """Return the arrays on the device, sent now if they are not there."""
        if self._sent is not None and self._sent[0] is device.context:
            return self._sent[1]
        normals, colors = _or_nothing(self.normals, np.float32), _or_nothing(self.colors, np.uint8)
        with stopwatch.timed("upload"):
            buffers = PartBuffers(*(upload(device, each) for each in (self.vertices, self.triangles, normals, colors)))
        self._sent = (device.context, buffers) if self.device_bytes <= device.usable_bytes // _KEPT_SHARE else None
        return buffers

    @property
    def device_bytes(self) -> int:
        beside = (0 if self.normals is None else 12) + (0 if self.colors is None else 4)
        return (24 + beside) * len(self.vertices) + 16 * len(self.triangles)


@dataclass
class LayerKeys:
    """Buffers (height, width) uint32 of a layer, and of the layer before, which is its floor; see the kernels."""

    keys_d: Any
    numbers_d: Any
    floor_keys_d: Any
    floor_numbers_d: Any

    @classmethod
    def of(cls, device: Device, pixels: int) -> LayerKeys:
        return cls(*(allocate(device, 4 * pixels) for _ in range(4)))

    def go_behind(self) -> None:
        """Make the layer the floor of the next one."""
        self.keys_d, self.floor_keys_d = self.floor_keys_d, self.keys_d
        self.numbers_d, self.floor_numbers_d = self.floor_numbers_d, self.numbers_d

    @property
    def arguments(self) -> dict[str, Any]:
        return {
            "keys": self.keys_d,
            "numbers": self.numbers_d,
            "floor_keys": self.floor_keys_d,
            "floor_numbers": self.floor_numbers_d,
        }


class Triangles:
    """A `MeshPart` on a device, before a camera; its triangles are those from `first` on of the picture."""

    def __init__(
        self, device: Device, part: MeshPart, first: int, camera: Camera, size: tuple[int, int], stopwatch: Stopwatch
    ):
        self.device, self.part = device, part
        self.first, self.stopwatch = first, stopwatch
        self._program = load_program(device, "rays/triangles.cl")
        width, height = size
        with stopwatch.timed("upload"):
            self._view_d = upload(device, eye_table(camera, size, part.lighting, part.base))
            self._planes_d = upload(device, _camera_planes(camera, part.planes))
            self._highlights_d = upload(device, highlight_table(part.lighting))
        self._buffers = part.send(device, stopwatch)
        self._placed_d = allocate(device, 12 * len(part.vertices))
        self._picture: dict[str, Any] = {
            "placed": self._placed_d, "triangles": self._buffers.triangles_d, "view": self._view_d, "width": width,
            "height": height, "count": len(part.triangles),
        }  # fmt: skip
        sums_d = allocate(device, 4 * len(part.triangles))
        with stopwatch.running(device):  # wait: CPU devices read the host's arrays
            launch(
                device, self._program["place_vertices"], len(part.vertices),
                vertices=self._buffers.vertices_d, view=self._view_d, placed=self._placed_d, count=len(part.vertices),
            )  # fmt: skip
            launch(device, self._program["count_pieces"], len(part.triangles), pieces=sums_d, **self._picture)
            scanned = exclusive_scan(device, sums_d, len(part.triangles), in_place=True)
        self._sums_d, self._pieces = scanned.offsets_d, scanned.total
        if self._pieces > MOST_PIECES:
            raise UsageError(
                f"{len(part.triangles):,} triangles cover {self._pieces * PIECE**2:.1e} pixels, at most"
                f" {MOST_PIECES * PIECE**2:.1e} are drawn: take a smaller picture, or zoom less"
            )

    def draw(self, layer: LayerKeys, finds_numbers: bool) -> None:
        """Bring depths, or numbers where all depths are known, to the pixels of a layer, without a wait."""
        device = self.device
        common: dict[str, Any] = {
            **self._picture, **layer.arguments, "planes": self._planes_d, "plane_count": len(self.part.planes),
            "first": self.first, "finds_numbers": finds_numbers,
        }  # fmt: skip
        launch(device, self._program["draw_triangles"], len(self.part.triangles), **common)
        for first in range(0, self._pieces, _PIECES_A_LAUNCH):
            end = min(first + _PIECES_A_LAUNCH, self._pieces)
            launch(
                device, self._program["draw_pieces"], end - first,
                sums=self._sums_d, first_piece=first, end_piece=end, **common,
            )  # fmt: skip

    def shade(self, layer: LayerKeys, layer_d: Any, depths_d: Any) -> None:
        """Write colours and depths of a layer where these triangles are seen; the queue is not waited for."""
        part = self.part
        color = np.array([*part.color, part.opacity], np.float32)
        launch(
            self.device, self._program["shade_triangles"], self._picture["width"] * self._picture["height"],
            normals=self._buffers.normals_d, colors=self._buffers.colors_d, highlights=self._highlights_d,
            numbers=layer.numbers_d, keys=layer.keys_d, layer=layer_d, layer_depths=depths_d, color=color,
            has_normals=part.normals is not None, has_colors=part.colors is not None, shaded=part.lighting.shades,
            first=self.first, **self._picture,
        )  # fmt: skip


def _or_nothing(array: NDArray[Any] | None, dtype: Any) -> NDArray[Any]:
    return np.zeros(4, dtype) if array is None else array  # OpenCL has no empty buffers


def _camera_planes(camera: Camera, planes: Float64Array) -> NDArray[np.float32]:
    """Return clip planes in mm of the camera, (p, 4), at least one row."""
    basis = np.array(camera.basis())
    table = np.zeros((max(len(planes), 1), 4), np.float32)
    for row, plane in zip(table, planes, strict=False):
        row[:3] = basis @ plane[:3]
        row[3] = plane[3] - plane[:3] @ np.array(camera.position)
    return table


FARTHEST_MM = 1e9
"""Largest coordinate of a vertex, 1000 km as for cameras, so that the product of two coordinates fits float32."""


def mesh_corners(mesh: Mesh) -> Float64Array:
    """Return the lowest and the highest corner of the box around the triangles of a mesh, (2, 3) in LPS mm."""
    mesh.check()
    if not mesh.triangle_count:
        raise UsageError("the mesh has no triangles: there is nothing to show")
    used = np.zeros(mesh.vertex_count, dtype=bool)
    used[mesh.triangles.ravel()] = True
    vertices = mesh.vertices if used.all() else mesh.vertices[used]
    corners = np.array(find_bounds(vertices), dtype=np.float64)
    if np.abs(mesh.vertices).max() > FARTHEST_MM:
        raise UsageError(
            f"vertices of the mesh lie up to {format_digits(np.abs(mesh.vertices).max())} mm from the origin:"
            f" pictures show what is within {FARTHEST_MM / 1e6:,.0f} kilometres"
        )
    return corners


def box_around(corners: Sequence[Float64Array] | NDArray[np.float64]) -> Grid:
    """Return the box of points, (n, 3), LPS mm, see `box_between`."""
    points = np.concatenate([np.atleast_2d(each) for each in corners])
    return box_between(points.min(axis=0), points.max(axis=0))


def make_part(mesh: Mesh, look: MeshLook) -> MeshPart:
    """Return a mesh with its look; what was checked by `mesh_corners` is not checked again."""
    if mesh.triangle_count > MOST_TRIANGLES:
        raise UsageError(f"a picture shows at most {MOST_TRIANGLES:,} triangles, the mesh has {mesh.triangle_count:,}")
    colors: NDArray[np.uint8] | None = None
    given = look.colors_at(mesh.checked_values())
    if given is not None:
        if len(given) != mesh.vertex_count:
            raise UsageError(f"{len(given)} colours for {mesh.vertex_count} vertices: one a vertex is needed")
        colors = np.full((len(given), 4), 255, np.uint8)
        colors[:, :3] = given
    vertices, base = mesh.vertices, np.zeros(3)
    if vertices.dtype != np.float32:
        base = np.rint(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
        vertices = (vertices - base).astype(np.float32)
    normals: NDArray[np.float32] | None = None
    if not look.flat and look.light.shades:
        normals = vertex_normals(mesh.vertices, mesh.triangles) if mesh.normals is None else mesh.normals
    planes = np.zeros((0, 4)) if look.clip is None else look.clip.planes
    return MeshPart(
        vertices, mesh.triangles, normals, tuple(look.rgb.tolist()), colors, look.opacity, look.light, planes, base
    )
