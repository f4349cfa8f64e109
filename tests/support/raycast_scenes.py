"""What the tests of rays share: volumes with known fields, cameras, and one way to cast by twin and by device."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import conftest
import numpy as np
import pytest
from dicom_series import rotation

from clrecon.geometry import Volume
from clrecon.proof.rays.render import cast_rays
from clrecon.proof.rays.surface import cast_surface
from clrecon.rendering import UNSHADED, Lighting, TransferFunction
from clrecon.rendering.pictures.styles import Projection, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera

TURN = rotation((15.0, -25.0, 40.0))
PLACE = np.array([40.0, -90.0, -600.0])

STEPS = {
    "even": np.diag([0.9, 0.9, 0.9]),
    "anisotropic": np.diag([0.6, 0.45, 1.3]),
    "oblique": TURN @ np.diag([0.7, 0.5, 1.2]),
    "sheared": np.array([[0.7, 0.0, 0.0], [0.0, 0.5, -0.6], [0.0, 0.0, 1.2]]),
    "mirrored": TURN @ np.diag([0.7, -0.5, 1.2]),
}
"""Columns are the steps of i, j, k in mm."""

GRIDS = (*STEPS, "uneven")

GAPS = (1.0,) * 12 + (0.4,) * 6 + (1.9,) * 10 + (1.0,) * 9

Field = Callable[[np.ndarray], np.ndarray]
"""Values (n,) at points (n, 3) in mm from the centre of the volume."""


def centre_of(volume: Volume) -> np.ndarray:
    """The centre of a volume, LPS mm."""
    return volume.ijk_to_lps([(np.array(volume.shape_ijk) - 1) / 2])[0]


def positions(volume: Volume) -> np.ndarray:
    """Voxel centres (nk, nj, ni, 3), mm from the centre of the volume."""
    k, j, i = np.indices(volume.voxels.shape).reshape(3, -1)
    points = volume.ijk_to_lps(np.stack([i, j, k], axis=1)) - centre_of(volume)
    return points.reshape(*volume.voxels.shape, 3)


def fill(volume: Volume, field: Field, dtype: Any = np.float32) -> Volume:
    """A volume on the same grid with the values of a field, rounded where `dtype` is of whole numbers."""
    values = np.asarray(field(positions(volume).reshape(-1, 3)), dtype=np.float64).reshape(volume.voxels.shape)
    return volume.with_voxels(values.astype(dtype) if np.dtype(dtype).kind == "f" else np.rint(values).astype(dtype))


def even_volume(field: Field, steps: str, *, extent: float, dtype: Any = np.float32) -> Volume:
    """`field` in a volume of about `extent` mm along each axis."""
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = STEPS[steps], PLACE
    shape = [int(np.ceil(extent / length)) for length in np.linalg.norm(STEPS[steps], axis=0)]
    return fill(Volume(np.zeros(shape[::-1], np.int8), affine), field, dtype)


def uneven_volume(
    field: Field,
    *,
    shape: tuple[int, int] = (66, 52),
    gaps: Sequence[float] | np.ndarray = GAPS,
    sideways: float = 0.3,
    noise: float = 0.2,
    dtype: Any = np.float32,
) -> Volume:
    """`field` in a turned stack whose slices lie unevenly, sheared along i and j, some `noise` mm beside a line."""
    heights = np.concatenate([[0.0], np.cumsum(gaps)])
    aside = np.outer(heights, (-0.5 * sideways, sideways))
    aside += np.random.default_rng(2).uniform(-noise, noise, aside.shape)
    table = heights[:, None] * TURN[:, 2] + aside @ TURN[:, :2].T + PLACE
    affine = np.eye(4)
    affine[:3, :2] = TURN[:, :2] * (0.7, 0.8)
    affine[:3, 2], affine[:3, 3] = (table[-1] - table[0]) / len(gaps), table[0]
    return fill(Volume(np.zeros((len(table), *shape), np.int8), affine, slice_positions=table), field, dtype)


def make_volume(field: Field, grid: str, *, extent: float = 22.0, dtype: Any = np.float32) -> Volume:
    """`field` in a volume of about `extent` mm along each axis, of one of `GRIDS`."""
    if grid != "uneven":
        return even_volume(field, grid, extent=extent, dtype=dtype)
    gaps = np.resize((1.0, 1.0, 0.4, 0.4, 1.9, 1.0), int(extent))
    return uneven_volume(field, shape=(int(1.3 * extent / 0.8), int(extent / 0.7)), gaps=gaps, dtype=dtype)


def ball(radius: float, ramp: float, *, inside: float = 1000.0, outside: float = -500.0) -> Field:
    """A ball whose edge is smooth over `ramp` mm (3 x^2 - 2 x^3), half way down at `radius`."""

    def field(points: np.ndarray) -> np.ndarray:
        share = np.clip((radius - np.linalg.norm(points, axis=1)) / ramp + 0.5, 0.0, 1.0)
        return outside + (inside - outside) * share**2 * (3.0 - 2.0 * share)

    return field


def ball_chords(radius: float, ramp: float, passing: np.ndarray) -> np.ndarray:
    """Integral of `ball` from 0 outside to 1 inside along lines that pass its centre at distances in mm.

    The ball is a stack of sharp ones of all radii in the ramp, each with its chord 2 sqrt(r^2 - b^2).
    """
    share = (np.arange(200) + 0.5) / 200
    chords = 2.0 * np.sqrt(np.maximum((radius + ramp * (share - 0.5)) ** 2 - passing[..., None] ** 2, 0.0))
    return (chords * 6.0 * share * (1.0 - share)).mean(axis=-1)


def blobs(points: np.ndarray) -> np.ndarray:
    """Something smooth from -1000 to about 1500 HU with structure in all directions."""
    x, y, z = points.T / 3.0
    return 700.0 * np.sin(x) * np.cos(0.8 * y + 0.3) * np.cos(0.7 * z) + 500.0 * np.exp(-(x**2 + y**2 + z**2) / 9.0)


def triple(values: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def look(
    volume: Volume,
    towards: Sequence[float],
    *,
    half_height: float,
    perspective: bool = False,
    up: Sequence[float] = (0.1, 0.2, 1.0),
    distance: float = 200.0,
) -> Camera:
    """At the centre of a volume along a direction; `half_height` mm of it to the top of the picture."""
    centre = centre_of(volume)
    forward = np.array(towards, dtype=np.float64) / np.linalg.norm(towards)
    position = centre - distance * forward
    if perspective:
        angle = 2.0 * np.degrees(np.arctan(half_height / distance))
        return Camera(triple(position), triple(centre), triple(up), view_angle=angle)
    return Camera(triple(position), triple(centre), triple(up), parallel_scale=half_height)


def ways_through(
    volume: Volume,
    camera: Camera,
    size: tuple[int, int],
    *,
    first: Any = 0.0,
    last: Any = None,
    nearest: float = -np.inf,
) -> np.ndarray:
    """Length in mm of each ray within the box of voxels `first` to `last` (default: all), half a voxel around them.

    By slabs in index space (Kay and Kajiya 1986), for even stacks; shape (h, w).  Nothing nearer than `nearest` counts.
    """
    last = np.array(volume.shape_ijk) - 1.0 if last is None else last
    origins, directions = camera.rays(size)
    inverse = np.linalg.inv(volume.affine)
    start = origins @ inverse[:3, :3].T + inverse[:3, 3]
    rate = directions @ inverse[:3, :3].T
    with np.errstate(divide="ignore"):
        ends = np.stack([(first - 0.5 - start) / rate, (last + 0.5 - start) / rate])
    way = ends.max(axis=0).min(axis=-1) - np.maximum(ends.min(axis=0).max(axis=-1), nearest)
    return np.maximum(way, 0.0)


def distances_from(point: np.ndarray, camera: Camera, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """How far each ray passes a point, and how far along the ray that is, mm: both (h, w)."""
    origins, directions = camera.rays(size)
    to_point = point - origins
    along = (to_point * directions).sum(axis=-1)
    return np.linalg.norm(to_point - along[..., None] * directions, axis=-1), along


def premultiplied(image: np.ndarray) -> np.ndarray:
    """An image over black, with its opacity: what two pictures differ by to the eye, float64 of 0 to 255."""
    opacity = image[..., 3:].astype(np.float64)
    return np.concatenate([image[..., :3] * (opacity / 255.0), opacity], axis=-1)


@dataclass
class Shot:
    """A picture from either side: the arrays of `clrecon.Rendering` that truth is asked of."""

    image: np.ndarray
    depth: np.ndarray
    expected_depth: np.ndarray
    values: np.ndarray


class TwinCaster:
    """Casts by the numpy twin."""

    def __call__(
        self,
        volume: Volume,
        mode: str = "dvr",
        transfer_function: TransferFunction | None = None,
        *,
        camera: Camera,
        size: tuple[int, int],
        lighting: Lighting = UNSHADED,
        **settings: Any,
    ) -> Shot:
        if mode == "surface":
            look = SurfaceLook(color="white", lighting=lighting, **settings)
            picture = cast_surface(volume, look, camera, size)
        elif mode == "dvr":
            assert transfer_function is not None
            picture = cast_rays(volume, VolumeLook(transfer_function, lighting=lighting, **settings), camera, size)
        else:
            picture = cast_rays(volume, Projection(mode, **settings), camera, size)  # type: ignore[arg-type]
        return Shot(picture.image(), picture.depth, picture.expected_depth, picture.values)


class DeviceCaster:
    """Casts by `clrecon.render` on a device, over no background; light goes to the modes that have some.

    slabs: Of the last picture, by its report.
    """

    slabs: int

    def __init__(self, device: Any):
        self.device = device

    def __call__(
        self,
        volume: Volume,
        mode: str = "dvr",
        transfer_function: TransferFunction | None = None,
        *,
        lighting: Lighting = UNSHADED,
        **settings: Any,
    ) -> Shot:
        from clrecon.operators.rays.render import render

        if mode == "dvr":
            settings |= {"transfer_function": transfer_function, "lighting": lighting}
        elif mode == "surface":
            settings |= {"color": (1.0, 1.0, 1.0), "lighting": lighting}
        found = render(volume, mode, device=self.device, background="transparent", **settings)  # type: ignore[arg-type]
        self.slabs = found.report["slabs"]
        values = np.full(found.depth.shape, np.nan) if found.values is None else found.values
        return Shot(found.image, found.depth, found.expected_depth, values)


def casters(*twin_marks: pytest.MarkDecorator) -> list[Any]:
    """Parameters for a test: the twin, with these marks, and the device that truths are asked of.

    Where the two are compared as well, a truth of the device is one of the twin, which may wait for a release.
    """
    devices, reason = conftest.Devices.get()
    if not devices and conftest.is_set("CLRECON_REQUIRE_DEVICE"):
        raise pytest.UsageError(f"CLRECON_REQUIRE_DEVICE is set: {reason}")
    on_devices = [
        pytest.param(DeviceCaster(device), id=conftest.device_id(device)) for device in conftest.first_of(devices)
    ]
    return [pytest.param(TwinCaster(), id="twin", marks=twin_marks), *on_devices]
