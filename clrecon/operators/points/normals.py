"""Normals of points, from their neighbours or from the gradients of a volume at their places."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceMemoryError, UsageError
from clrecon.geometry import Volume
from clrecon.opencl import Device, Stopwatch
from clrecon.operators.points.neighbours import NeighbourSearch, Part, check_neighbours, take_points
from clrecon.operators.resident.device_volume import DeviceVolume, open_volume
from clrecon.operators.resident.tables import voxel_variants
from clrecon.points.cloud import PointCloud, PointStep
from clrecon.system.arguments import as_numbers, explains_arguments, name_parameter
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_share

_GRADIENTS = "gradients"
"""Purpose by which slabs are planned."""

_BELOW, ABOVE = 1, 2
"""Slices below and above a slab that differences over half a voxel need."""

FARTHEST = 2.0**29
"""Farthest place in index steps: what lies beyond has no gradient anyway."""


def find_gradients(
    resident: DeviceVolume,
    points: NDArray[np.floating],
    *,
    stopwatch: Stopwatch,
    progress: Progress = ignore_progress,
    warnings: list[str] | None = None,
) -> NDArray[np.float32]:
    """Find the gradient of a volume at points: (n, 3) float32, HU per mm, LPS.

    Beyond the border the volume is surrounded by its lowest value, at least -1024 HU; farther away the gradient is
    zero. A volume that does not fit the device goes through it slab by slab, with the same result.
    """
    volume, nk = resident.volume, resident.volume.shape_ijk[2]
    places = np.clip(volume.lps_to_ijk(points), -FARTHEST, FARTHEST).astype(np.float32)

    def needs(slices: int) -> dict[str, int]:
        slab_bytes = min(slices + _BELOW + ABOVE, nk) * resident.slice_bytes
        return {"volume": slab_bytes, "places": places.nbytes, "gradients": places.nbytes}

    planned = resident.plan(_GRADIENTS, nk, needs)
    if planned < 1:
        raise DeviceMemoryError(f"no gradients can be found: {ocl.describe_shortage(resident.limits, needs(1))}")
    for attempt in resident.attempts(_GRADIENTS, planned, warnings):
        with attempt as slices:
            gradients = _all_slabs(resident, places, slices, stopwatch, progress)
    return gradients


def _all_slabs(
    resident: DeviceVolume, places: NDArray[np.float32], slices: int, stopwatch: Stopwatch, progress: Progress
) -> NDArray[np.float32]:
    device, volume = resident.device, resident.volume
    ni, nj, nk = volume.shape_ijk
    with stopwatch.timed("build"):
        program = ocl.load_program(device, "points/gradients.cl", voxel_variants(resident.dtype))
    origins = volume.slice_origins(1)
    origins_d = ocl.upload(device, (origins - origins[0]).astype(np.float32))
    places_d = ocl.upload(device, places)
    gradients, gradients_d = ocl.empty_output(device, places.shape, np.float32)
    for first in range(0, nk, slices):
        end = min(first + slices, nk)
        low, high = max(first - _BELOW, 0), min(end + ABOVE, nk)
        if slices >= nk:
            voxels_d, low = resident.whole(stopwatch), 0
        else:
            voxels_d = resident.part(low, high, stopwatch)
        with stopwatch.running(device):
            ocl.launch(
                device, program["find_gradients"], len(places),
                voxels=voxels_d, places=places_d, origins=origins_d, gradients=gradients_d, ni=ni, nj=nj, nk=nk,
                first_k=low, own_first=first, own_end=end, step_i=(*volume.affine[:3, 0], 0.0),
                step_j=(*volume.affine[:3, 1], 0.0), outside=resident.values.lowest, points=len(places),
            )  # fmt: skip
        volume.release_slices(low, high)
        progress("gradients", end, nk)
    return ocl.download(device, gradients, gradients_d)


FEWEST_NEIGHBOURS = 3
"""Three points lie in a plane."""

_DOUBTFUL_SHARE = 0.1
"""Share of doubtful normals above which there is a warning.  Shells of bone have 0.04 where voxels are nearly cubes,
and 0.22 and 0.38 with gaps between slices of 4.25 and 7 mm."""

_HOW = {how: int(ocl.kernel_number("points/normals.cl", f"ORIENT_{how}")) for how in ("NOT", "DOWN", "AWAY")}
_STATES = {
    state: int(ocl.kernel_number("points/normals.cl", f"STATE_{state}"))
    for state in ("SURE", "DOUBTFUL", "UNORIENTED", "NO_PLANE")
}


class PlaneFits:
    """Planes of parts: neighbours_d (places, k) int32, normals_d (3, places), variations_d (places,) float32."""

    def __init__(self, search: NeighbourSearch, stopwatch: Stopwatch):
        self._search, self._stopwatch = search, stopwatch
        device = search.device
        with stopwatch.timed("build"):
            self.program = ocl.load_program(device, "points/normals.cl", {"LANES": device.kernel_variants["LANES"]})
        most = search.most_places
        self.neighbours_d = ocl.allocate(device, 4 * search.k * most)
        self.normals_d, self.variations_d = ocl.allocate(device, 12 * most), ocl.allocate(device, 4 * most)

    @staticmethod
    def needs(points: int) -> dict[str, int]:
        """Return the bytes beside those of the search, for a part of so many points."""
        return {"planes of a part": 16 * points}

    def fit(self, part: Part) -> None:
        search = self._search
        search.find(part, self.neighbours_d)
        lanes = int(search.device.kernel_variants["LANES"])
        ocl.launch(
            search.device, self.program["fit_planes"], -(-part.place_count // lanes),
            **search.coordinates, neighbours=self.neighbours_d, normals=self.normals_d, variations=self.variations_d,
            first_place=part.first_place, place_count=part.place_count, k=search.k,
        )  # fmt: skip


@explains_arguments
def estimate_normals(
    cloud: PointCloud,
    k: int = 16,
    *,
    volume: Volume | DeviceVolume | None = None,
    viewpoint: ArrayLike | None = None,
    device: Device | str | int | None = None,
    memory: int | None = None,
    progress: Progress | None = None,
) -> PointStep:
    """Estimate the normal of each point: the smallest principal axis of its nearest points.

    With a volume normals point towards lower HU, out of bone: against the gradient of the trilinear field, as
    differences over half a voxel to either side.  Where axis and gradient are nearly at a right angle (cosine below
    0.2) the neighbours lie on both sides of something thin; there the gradient itself is taken, and these points are
    counted as doubtful; above a tenth of all there is a warning.  A cloud without a volume gets normals away from a
    viewpoint within, or else normals of either direction, with a warning.

    Parameters
    ----------
    cloud : PointCloud
    k : int
        Neighbours of each point, itself among them; 3 to 128.
    volume : Volume or DeviceVolume, optional
        The CT from which the cloud comes.  A `DeviceVolume` is used directly, with its own device and memory.
    viewpoint : array_like, shape (3,), optional
        A point inside of the object, LPS mm; without a volume alone.
    device : Device, str or int, optional
        See `clrecon.device`; None is the best of the machine.
    memory : int, optional
        Most bytes taken on the device; None is all that it has.
    progress : callable, optional
        Called as ``progress("gradients", slices done, all slices)`` and ``progress("normals", points done, all
        points)``.

    Returns
    -------
    PointStep
        The cloud with ``normals``.  Its facts: ``neighbours``, ``oriented_by`` ("gradient", "viewpoint" or None),
        ``doubtful`` (normals that are the gradient's), ``unoriented`` (of either direction: the gradient is zero
        there), ``without_plane`` (neighbours in a line or at one place; without a gradient these normals are zero),
        ``seconds`` and ``device``.

    Raises
    ------
    UsageError
        The cloud is empty, ``k`` is out of range, or volume and viewpoint are given both.
    DeviceError
        The device has no room for the cloud, or it fails.
    """
    ocl.check_memory(memory)
    points = take_points(cloud)
    k, warnings = check_neighbours(k, len(points), FEWEST_NEIGHBOURS)
    if volume is not None and viewpoint is not None:
        raise UsageError("normals are oriented by a volume or away from a viewpoint, not both: leave out one")
    eye = None if viewpoint is None else _check_viewpoint(viewpoint)
    tell = progress or ignore_progress
    if volume is None:
        for attempt in ocl.with_fallback(ocl.take_device(device)):
            with attempt as (current, notes):
                step = _Run(cloud, k, current, memory, [*warnings, *notes], tell).step(eye)
        return step
    with open_volume(volume, device, memory, "the orientation of normals") as resident:
        for attempt in resident.with_fallback():
            with attempt as (current, notes):
                run = _Run(cloud, k, current, resident.memory, [*warnings, *notes], tell)
                gradients = find_gradients(
                    resident, points, stopwatch=run.stopwatch, progress=tell, warnings=run.warnings
                )
                step = run.step(gradients=gradients)
    return step


def _check_viewpoint(viewpoint: ArrayLike) -> NDArray[np.float64]:
    point = as_numbers("viewpoint", viewpoint)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise UsageError(f"a viewpoint is three numbers in LPS mm, not {viewpoint!r}")
    return point


@dataclass
class _Run:
    cloud: PointCloud
    k: int
    device: Device
    memory: int | None
    warnings: list[str]
    progress: Progress

    def __post_init__(self) -> None:
        self.stopwatch = Stopwatch()

    def step(
        self, viewpoint: NDArray[np.float64] | None = None, gradients: NDArray[np.float32] | None = None
    ) -> PointStep:
        device, stopwatch = self.device, self.stopwatch
        points = self.cloud.points
        n = len(points)
        results = {"normals": 13 * n, "gradients": 0 if gradients is None else 12 * n}
        search = NeighbourSearch(device, points, self.k, {**PlaneFits.needs(n), **results}, self.memory, stopwatch)
        fits = PlaneFits(search, stopwatch)
        normals, normals_d = ocl.empty_output(device, (n, 3), np.float32)
        states, states_d = ocl.empty_output(device, (n,), np.uint8)
        how, seen_from = ("AWAY", viewpoint - search.grid.base) if viewpoint is not None else ("NOT", np.zeros(3))
        gradients_d = normals_d
        if gradients is not None:
            how, gradients_d = "DOWN", ocl.upload(device, gradients)
        for part in search.each_part("normals", self.progress):
            fits.fit(part)
            ocl.launch(
                device, fits.program["orient_normals"], part.place_count, **search.coordinates,
                order=search.grid.order_d, normals=fits.normals_d, gradients=gradients_d, oriented=normals_d,
                states=states_d, viewpoint=(*seen_from, 0.0), how=_HOW[how], first_place=part.first_place,
                place_count=part.place_count,
            )  # fmt: skip
        with stopwatch.timed("download"):
            normals, states = ocl.download(device, normals, normals_d), ocl.download(device, states, states_d)
        return self._describe(normals, states, how)

    def _describe(self, normals: NDArray[np.float32], states: NDArray[np.uint8], how: str) -> PointStep:
        counts = np.bincount(states, minlength=len(_STATES))
        doubtful, unoriented, flat = (int(counts[_STATES[state]]) for state in ("DOUBTFUL", "UNORIENTED", "NO_PLANE"))
        warnings, n = list(self.warnings), len(states)
        if flat:
            warnings.append(
                f"{flat:,} of {n:,} points have their neighbours in a line or at one place: normal (0, 0, 0)"
            )
        if how == "NOT":
            warnings.append("normals have either direction: give a volume or a viewpoint to orient them")
        if doubtful > _DOUBTFUL_SHARE * n:
            warnings.append(
                f"{doubtful:,} of {n:,} normals ({format_share(doubtful / n)}) are doubtful and follow the HU alone:"
                f" the {self.k} nearest points of theirs lie in one slice, or on both sides of something thin; take the"
                f" points of a surface ({name_parameter('kind', 'surface')}), which bring their normals, or thin the"
                " cloud to the largest gap between slices before"
            )
        if how != "NOT" and unoriented:
            warnings.append(f"{unoriented:,} of {n:,} normals have either direction: HU do not change there")
        facts = {
            "neighbours": self.k,
            "oriented_by": {"DOWN": "gradient", "AWAY": "viewpoint", "NOT": None}[how],
            "doubtful": doubtful,
            "unoriented": unoriented,
            "without_plane": flat,
            "seconds": dict(self.stopwatch.seconds),
            "device": self.device.label,
        }
        return PointStep(self.cloud.changed(normals=normals), np.zeros(n, np.uint8), (), facts, tuple(warnings))
