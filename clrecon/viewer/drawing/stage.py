"""`Stage`: scans and label maps on the device, and the parts of scans, for all views of a process."""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.body import remove_table
from clrecon.anatomy.noise import choose_smoothing
from clrecon.errors import NoSurfaceError
from clrecon.geometry import Volume
from clrecon.labels import LabelMap
from clrecon.labels.resample import ResampledLabels
from clrecon.mesh import Mesh
from clrecon.mesh.triangles import vertex_normals
from clrecon.opencl import Device
from clrecon.operators.filters.bilateral import filter_bilateral
from clrecon.operators.rays.point_pictures import PointPictures
from clrecon.operators.rays.scene import ScenePictures
from clrecon.operators.rays.volume_renderer import VolumeRenderer
from clrecon.operators.resident.device_volume import DeviceVolume, DeviceWorker
from clrecon.operators.surface.cortex_mesh import fit_cortex
from clrecon.operators.surface.extract import SurfaceExtractor, extract_isosurface
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.object_looks import MeshLook
from clrecon.rendering.pictures.styles import PlaneCut, Style, SurfaceLook, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.system.color_scale import ColorScale
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.progress import Progress, ignore_progress
from clrecon.system.text import format_hu
from clrecon.viewer.drawing.looks import LabelledLook
from clrecon.viewer.model.changes import shift_camera
from clrecon.viewer.model.objects import ShownLabels, ShownMesh, ShownObject, ShownScan, find_modes
from clrecon.viewer.model.parts import FoundParts, find_clusters, find_inner
from clrecon.viewer.model.state import FIT_COLORS, Point, ViewState

_STRIP_PIXELS = 1 << 18
"""Pixels of a strip: some 50 ms of volume rendering on two cores."""

_STRIP_ROWS = 16
"""Rows of a strip are a multiple of this, which tiles of rays fill."""


def take_strips(
    take: Callable[[Camera, tuple[int, int]], Rendering], camera: Camera, size: tuple[int, int]
) -> Rendering:
    """Take the picture of a parallel camera strip by strip, where it is large; others in one."""
    width, height = size
    rows = max(_STRIP_ROWS, _STRIP_PIXELS // width // _STRIP_ROWS * _STRIP_ROWS)
    if not camera.is_parallel or rows >= height:
        return take(camera, size)
    _, up, _ = camera.basis()
    pixel = camera.pixel_mm(size)
    strips = []
    for first in range(0, height, rows):
        end = min(first + rows, height)
        shift = (0.5 * height - 0.5 * (first + end)) * pixel * up
        strip_camera = shift_camera(camera, shift, parallel_scale=0.5 * (end - first) * pixel)
        strips.append(take(strip_camera, (width, end - first)))

    def join_field(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(strip, name) for strip in strips])

    values = None if strips[0].values is None else join_field("values")
    report = {**strips[-1].report, "strips": len(strips)}
    image = join_field("image")
    return Rendering.with_late_depths(
        lambda: (join_field("depth"), join_field("expected_depth")), image, camera, values, strips[0].mode, report
    )


SIDE = 20
"""Voxels along each side of the volume by which kernels are built."""

PICTURE = (8, 8)


def warm_kernels(objects: Sequence[ShownObject], device: Device, progress: Progress | None = None) -> None:
    """Build what the first pictures, the slider and the parts need, on a small volume of each type of voxels."""
    tell = progress or ignore_progress
    done = set()
    for shown in objects:
        if isinstance(shown, ShownScan):
            kind = shown.volume.voxels.dtype, shown.volume.uneven
            if kind not in done:
                done.add(kind)
                _warm_scan(_ball(*kind), device, tell)
    if any(isinstance(each, ShownMesh) for each in objects):
        mesh = Mesh(np.eye(3), [(0, 1, 2)], np.tile([0.0, 0.0, 1.0], (3, 1)))
        with ScenePictures([(mesh, MeshLook())], device=device) as scene:
            scene.take(Camera((0.3, 0.3, 5.0), (0.3, 0.3, 0.3), (0.0, 1.0, 0.0), parallel_scale=1.0), PICTURE)


def _ball(dtype: np.dtype, uneven: bool) -> Volume:
    """Return a ball of 1000 HU in air."""
    places = np.indices((SIDE,) * 3) - 0.5 * (SIDE - 1)
    inside = (places**2).sum(axis=0) < (0.3 * SIDE) ** 2
    voxels = np.where(inside, 1000, -1000).astype(dtype)
    if not uneven:
        return Volume(voxels, np.eye(4))
    heights = np.arange(SIDE, dtype=np.float64) + 0.2 * (np.arange(SIDE) % 2)
    positions = np.stack([np.zeros(SIDE), np.zeros(SIDE), heights], axis=1)
    return Volume(voxels, np.eye(4), slice_positions=positions)


def _warm_scan(volume: Volume, device: Device, tell: Progress) -> None:
    camera = Camera.fit(volume, "anterior", size=PICTURE)
    labels = LabelMap((volume.voxels > 0).astype(np.uint8), np.eye(4))
    with DeviceVolume(volume, device=device) as resident, VolumeRenderer(resident) as renderer:
        styles: list[Style] = [
            SurfaceLook(200.0), PlaneCut(), VolumeLook("bone", jitter=True),
            SurfaceLook(200.0, labels=labels), VolumeLook("bone", jitter=True, labels=labels), PlaneCut(labels=labels),
        ]  # fmt: skip
        for style in styles[:3]:
            tell("build", 0, 0)
            renderer.render(style, camera=camera, size=PICTURE, background="transparent")
        with SurfaceExtractor(resident) as extractor:
            for level in (200.0, 300.0):  # the second uses bricks
                tell("build", 0, 0)
                try:
                    extractor.extract(level)
                except NoSurfaceError:
                    pass
        find_clusters(resident, 1, 200.0, (True, 0.0), tell)
        for style in styles[3:]:
            tell("build", 0, 0)
            renderer.render(style, camera=camera, size=PICTURE, background="transparent")


_TRIANGLES_A_CELL = 2.0
"""Triangles that a surface leaves in each cell that it passes through."""


def coarsen_mesh(mesh: Mesh, triangles: int) -> tuple[Mesh, NDArray[np.int64]]:
    """Return a coarse mesh for pictures: vertices that share a cell become one (Rossignac and Borrel 1993).

    With the row of the first of them for each vertex, whose values it has.
    """
    vertices = mesh.vertices.astype(np.float64)
    cell = float(np.sqrt(_TRIANGLES_A_CELL * mesh.area / triangles))
    low = vertices.min(axis=0)
    counts = np.floor(np.ptp(vertices, axis=0) / max(cell, 1e-9)).astype(np.int64) + 1
    i, j, k = np.floor((vertices - low) / max(cell, 1e-9)).astype(np.int64).T
    _, first, group = np.unique((k * counts[1] + j) * counts[0] + i, return_index=True, return_inverse=True)
    group = group.ravel()
    sizes = np.bincount(group)
    places = np.stack([np.bincount(group, vertices[:, axis]) / sizes for axis in range(3)], axis=1)
    joined = group[mesh.triangles]
    a, b, c = joined.T
    triangles_left = joined[(a != b) & (b != c) & (c != a)]
    points = places.astype(mesh.vertices.dtype)
    used = triangles_left.astype(np.uint32)
    coarse = Mesh(points, used, vertex_normals(points, used), dict(mesh.report), trusted=True)
    coarse.values = {name: values[first] for name, values in mesh.values.items()}
    return coarse, first


COARSE_TRIANGLES, _MOST_FITS = 200_000, 4
"""Meshes with more triangles are drawn by a coarse one while anything moves; fitted surfaces that are kept."""


@dataclass(frozen=True, eq=False)
class FittedScan:
    """The surface of a scan fitted to the bone, and a coarse one, with `find_inner` of each.

    scales: Of the colours of its numbers, by their names.
    """

    sharp: tuple[Mesh, NDArray[np.int64]]
    coarse: tuple[Mesh, NDArray[np.int64]]
    scales: Mapping[str, ColorScale]


def shows_fits(state: ViewState) -> bool:
    return state.fitted and find_modes()[state.mode].kind == "surface"


MOST_FOUND, _MOST_FOUND_BYTES = 6, 1 << 29
"""Sets of parts kept, of all views together, and bytes of their label maps; two are kept whatever their size."""


_ALL_HU = 1e4
"""Differences of a bilateral filter that count: with all of them it is a Gaussian, of sheared and uneven slices too."""


class Stage(DeviceWorker):
    """What is on the device; safe for several threads: `lock` is held while the device works for a view."""

    def __init__(
        self, objects: Sequence[ShownObject], *, device: Device | str | int | None = None, memory: int | None = None
    ):
        self.objects = tuple(objects)
        self.scans = [each for each in objects if isinstance(each, ShownScan)]
        super().__init__(device, memory)
        self.lock = threading.RLock()
        self._bare: dict[int, Volume] = {}
        self._residents: dict[tuple[int, bool, float], DeviceVolume] = {}
        self._smoothing: float | None = None
        self._solid: dict[int, tuple[DeviceVolume, ResampledLabels]] = {}
        self._takers: dict[int, VolumeRenderer | PointPictures] = {}
        self._found: OrderedDict[tuple[int, float, tuple[bool, float]], FoundParts] = OrderedDict()
        self._blank: dict[int, LabelledLook] = {}
        self._fits: OrderedDict[tuple[int, float, tuple[bool, float]], FittedScan] = OrderedDict()

    def close(self) -> None:
        with self.lock:
            for taker in self._takers.values():
                taker.close()
            for resident in (*self._residents.values(), *(each for each, _ in self._solid.values())):
                resident.close()
            for cache in (self._takers, self._residents, self._solid):
                cache.clear()  # type: ignore[attr-defined]

    # Parts

    def find_parts(self, state: ViewState, progress: Progress | None = None) -> list[FoundParts]:
        """Find the parts of all scans without a label map at the iso value, or take those that were found before."""
        found_parts = []
        for scan in self._clustered():
            key = (scan.number, state.iso_value, state.voxels)
            with self.lock:
                known = self._found.get(key)
                if known is None:
                    resident = self.resident(scan.number, state)
            if known is None:  # most of the time is numpy's: other pictures are taken meanwhile
                known = find_clusters(resident, *key, progress, lock=self.lock)
            with self.lock:
                self._found[key] = known
                self._found.move_to_end(key)
                self._drop_found()
            found_parts.append(known)
        return found_parts

    def _drop_found(self) -> None:
        """Drop the parts that were asked for longest ago, where there are many."""

        def too_many() -> bool:
            byte_count = sum(each.labels.voxels.nbytes for each in self._found.values())
            return len(self._found) > MOST_FOUND or byte_count > _MOST_FOUND_BYTES

        while len(self._found) > 2 and too_many():
            self._found.popitem(last=False)

    def has_parts(self, state: ViewState) -> bool:
        """True where the label maps of the parts that the state knows are there."""
        return all(self._found_for(scan, state) is not None for scan in self._clustered())

    def remove_table(self, progress: Progress | None = None) -> dict[int, dict[str, Any]]:
        """Make the scans without table and blankets, once; returns what was taken from each, by number."""
        facts = {}
        for scan in self.scans:
            if scan.number not in self._bare:
                bare = remove_table(scan.volume, progress=progress)
                with self.lock:
                    self._bare[scan.number] = bare
            facts[scan.number] = dict(self._bare[scan.number].report["remove_table"])
        return facts

    def say_table(self) -> str | None:
        """Return what was taken away with the tables, and the way back; None: next to nothing."""
        facts = self.remove_table()
        removed = [(facts[scan.number]["dense_voxels_removed"], scan.volume.spacing) for scan in self.scans]
        ml = sum(voxels * math.prod(spacing) / 1000.0 for voxels, spacing in removed)
        if ml < 0.5:
            return None
        return f"{ml:,.0f} ml of table and blankets taken away: look whether the body is whole (b: show them)"

    @property
    def knows_table(self) -> bool:
        """True once `remove_table` is done."""
        return all(each.number in self._bare for each in self.scans)

    def find_smoothing(self) -> float:
        """Return the standard deviation in mm of the Gaussian that takes the measured noise of the first scan."""
        if self._smoothing is None:
            self._smoothing = round(choose_smoothing(self.scans[0].volume), 2)
        return self._smoothing

    def smooth_scans(self, state: ViewState) -> float:
        """Make the scans of a state smoothed, once; returns `find_smoothing`."""
        mm = self.find_smoothing()
        for scan in self.scans:
            self.resident(scan.number, replace(state, smooth_mm=mm))
        return mm

    # Surfaces fitted to the bone

    def find_fits(self, state: ViewState) -> dict[int, FittedScan | None]:
        """Return the fitted surface of each scan that is shown by its number, None where it is still to be made."""
        return {key[0]: self._fits.get(key) for key in self._fit_keys(state)}

    def has_fits(self, state: ViewState) -> bool:
        return None not in self.find_fits(state).values()

    def find_fit_scale(self, state: ViewState) -> ColorScale | None:
        """Return the scale of the colours of fitted surfaces, the longest of theirs; None where they show no number."""
        fits = [fit for fit in self.find_fits(state).values() if fit is not None]
        if state.color_by is None or not fits or not shows_fits(state):
            return None
        return max((fit.scales[state.color_by] for fit in fits), key=lambda scale: scale.limit)

    def find_offset(self, state: ViewState) -> dict[str, Any] | None:
        """Return how far outside of the bone the iso value lies, for JSON; None before the surface was fitted there.

        mm: Median of the first scan that is shown.  is_good: It is within the error of the fit.
        """
        fit = next(iter(self.find_fits(state).values()), None)
        if fit is None:
            return None
        cortex = fit.sharp[0].report["cortex"]
        outside, error = cortex["outside_mm"], cortex["error_mm"]
        return {
            "mm": round(outside["p50"], 3),
            "range_mm": [round(outside["p5"], 3), round(outside["p95"], 3)],
            "error_mm": round(error["p50"], 3),
            "is_good": abs(outside["p50"]) <= error["p95"],
        }

    def fit_scans(self, state: ViewState, progress: Progress | None = None) -> list[str]:
        """Fit the surfaces of the scans that are shown, where that was not done before; return lines about them."""
        lines = []
        for key in self._fit_keys(state):
            if key not in self._fits:
                fit = self._fit_scan(self.resident(key[0], state).volume, key[0], state.iso_value, progress)
                with self.lock:
                    self._fits[key] = fit
            with self.lock:
                self._fits.move_to_end(key)
                cortex = self._fits[key].sharp[0].report["cortex"]
                while len(self._fits) > max(_MOST_FITS, len(self.objects)):
                    self._fits.popitem(last=False)
            share, walls = 100.0 * cortex["fitted"] / cortex["vertices"], cortex["thickness_mm"]["p50"]
            lines.append(
                f"{self._name(key[0])}: {share:.0f} % of the vertices are fitted to the bone, error"
                f" {cortex['error_mm']['p50']:.2f} mm, walls {walls:.1f} mm (median)"
            )
        return lines

    def _fit_scan(self, volume: Volume, number: int, iso_value: float, progress: Progress | None) -> FittedScan:
        """Fit a surface with a copy of the scan on the device: pictures are taken meanwhile."""
        with DeviceVolume(volume, device=self.device, memory=self.memory) as resident:
            try:
                level = extract_isosurface(resident, iso_value, progress=progress)
                mesh = fit_cortex(level, resident, progress=progress)
            except NoSurfaceError as error:
                subject = f"{self._name(number)} at {format_hu(iso_value)} HU"
                raise NoSurfaceError(f"{subject} is not fitted to the bone: {error}") from error
        coarse, inner = mesh, find_inner(level.vertices, volume, iso_value)
        rows: NDArray[Any] | slice = slice(None)
        if mesh.triangle_count > COARSE_TRIANGLES:
            coarse, rows = coarsen_mesh(mesh, COARSE_TRIANGLES)
        scales: dict[str, ColorScale] = {
            name: MeshLook(color_by=name).find_scale(mesh.values)[0] for name in FIT_COLORS
        }
        return FittedScan((mesh, inner), (coarse, inner[rows]), scales)

    def _fit_keys(self, state: ViewState) -> list[tuple[int, float, tuple[bool, float]]]:
        return [(scan.number, state.iso_value, state.voxels) for scan in self._shown_scans(state)]

    def _shown_scans(self, state: ViewState) -> list[ShownScan]:
        return [scan for scan in self.scans if (whole := state.whole(scan.number)) is not None and whole.visible]

    def _name(self, number: int) -> str:
        return next(each.name for each in self.objects if each.number == number)

    # What is drawn

    def resident(self, number: int, state: ViewState) -> DeviceVolume:
        scan = next(each for each in self.scans if each.number == number)
        with self.lock:
            return self._resident(scan, not state.table and number in self._bare, state.smooth_mm)

    def labelled(self, number: int, state: ViewState) -> LabelledLook | None:
        """Return the label map by which a scan is divided, None where its parts are not known."""
        scan = next(each for each in self.scans if each.number == number)
        with self.lock:
            shown_map = self._map_of(scan.number)
            if shown_map is not None:
                return LabelledLook(shown_map.labels, None, tuple(state.parts_of(shown_map.number)))
            found_parts = self._found_for(scan, state)
            if found_parts is None:
                return None
            return LabelledLook(found_parts.labels, found_parts.placed, tuple(state.parts_of(scan.number)))

    def labels_on(self, resident: DeviceVolume, labelled: LabelledLook) -> NDArray[Any]:
        """Return the numbers of a label map on the grid of a scan; hold `lock`."""
        self.place(resident, labelled)
        return resident.bring(labelled.labels).voxels

    def _clustered(self) -> list[ShownScan]:
        return [each for each in self.scans if self._map_of(each.number) is None]

    def _map_of(self, scan: int) -> ShownLabels | None:
        return next((each for each in self.objects if isinstance(each, ShownLabels) and each.within == scan), None)

    def _resident(self, scan: ShownScan, bare: bool, smooth_mm: float) -> DeviceVolume:
        key = (scan.number, bare, smooth_mm)
        if key not in self._residents:
            if smooth_mm:
                plain = self._resident(scan, bare, 0.0)
                self._residents[key] = filter_bilateral(plain, sigma_mm=smooth_mm, sigma_hu=_ALL_HU)
            else:
                volume = self._bare[scan.number] if bare else scan.volume
                self._residents[key] = DeviceVolume(volume, device=self._device, memory=self.memory)
        return self._residents[key]

    def renderer(self, resident: DeviceVolume) -> VolumeRenderer:
        """Return what takes pictures of a scan; hold `lock` while it works."""
        known = self._takers.get(id(resident))
        if known is None:
            known = self._takers[id(resident)] = VolumeRenderer(resident)
        assert isinstance(known, VolumeRenderer)
        return known

    def _found_for(self, scan: ShownScan, state: ViewState) -> FoundParts | None:
        if state.parts_at is None:
            return None
        return self._found.get((scan.number, state.parts_at, state.parts_voxels))

    def hu_at(self, point: Point) -> float | None:
        """Return the HU of the first scan, trilinear; None outside of it."""
        if not self.scans:
            return None
        volume = self.scans[0].volume
        ijk = volume.lps_to_ijk([point])[0]
        last = np.array(volume.shape_ijk) - 1
        if (np.abs(ijk - 0.5 * last) > 0.5 * last + 0.51).any():  # places are rounded to 0.001 mm
            return None
        ijk = np.clip(ijk, 0, last)
        low = np.minimum(ijk.astype(np.int64), np.maximum(last - 1, 0))
        share = ijk - low
        i, j, k = low
        block = volume.voxels[k : k + 2, j : j + 2, i : i + 2].astype(np.float64)
        for part in share[::-1]:
            block = block[0] + (block[1] - block[0]) * part if len(block) > 1 else block[0]
        return float(block)

    def blank_labels(self, number: int, volume: Volume) -> LabelledLook:
        """Return a map without a label, by which a whole scan is made translucent."""
        if number not in self._blank:
            labels = LabelMap(np.zeros(volume.voxels.shape, np.uint8), volume.affine.copy())
            self._blank[number] = LabelledLook(labels, ResampledLabels(labels.voxels, True, {}, ()), ())
        return self._blank[number]

    def place(self, resident: DeviceVolume, labelled: LabelledLook | None) -> None:
        """Tell a scan where the label map lies that is drawn next; hold `lock`."""
        if labelled is not None and labelled.placed is not None:
            resident.place(labelled.labels, labelled.placed)
