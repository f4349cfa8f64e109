"""Pictures by sampling rays, from slab to slab: volume rendering through a transfer function, and projections."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.anatomy.noise import choose_smoothing
from clrecon.anatomy.surroundings import LEFT_OUT, count_left_out
from clrecon.geometry.affine import Float64Array
from clrecon.geometry.iso_rule import takes_parts
from clrecon.opencl import Device, allocate, building_together, kernel_constant, kernel_number, launch, upload
from clrecon.operators.rays import ray_slabs
from clrecon.operators.rays.openness import Hiding, HollowedPicture
from clrecon.operators.rays.picture_buffers import (
    NEAR_ROW,
    Between,
    DrawnVolume,
    LateDepths,
    PictureBuffers,
    RayView,
    Shot,
    count_queues,
    highlight_table,
)
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import FieldFrame, label_variants, volume_box
from clrecon.rendering import Lighting, Rendering, TransferFunction
from clrecon.rendering.looks.piecewise import PARTS, Steepness
from clrecon.rendering.looks.window import (
    checked_window,
    choose_mip_window,
    choose_water_window,
    choose_window,
    grey_image,
)
from clrecon.rendering.pictures.picture import Depths
from clrecon.rendering.pictures.styles import Projection, VolumeLook
from clrecon.rendering.views.camera import Camera
from clrecon.system.light_dataclass import dataclass

NODES = kernel_constant("rays/steep_segments.h", "NODES")
"""Entries of a transfer function's table."""

GRADIENT_NODES = kernel_constant("rays/composite.cl", "GRADIENT_NODES")
"""Entries of the table of opacity factors by magnitude of the gradient."""

_LEAST_DRIFT = 0.02
"""Rays that drift less than this many bricks to the side per brick ahead count as running straight along the row."""

_LOWEST_LOG = -1000.0
"""log2 of the transparency of an opaque sample: 0 in float32; infinity times a length of 0 would give NaN."""


@dataclass(frozen=True)
class TransferTables:
    """A transfer function in tables for one ray step; buffers of (NODES,) float32 where nothing else is said.

    colors_d: int32. Red, green and blue, 10 bits each.
    opacities_d, clears_d: Opacities, `steepness` among them, over one step; transparency of one of its `PARTS`.
    changes_d: Sum of the changes of the opacity, up and down, from the first node to each node; `shown` tells nodes.
    low, scale: Nearest node to v: ``floor((v - low) * scale + 0.5)``.
    factors_d: (GRADIENT_NODES,). Factors on the opacity, by gradient times `factor_scale`; used if it is `weighed`.
    steps_per_unit: Number of ray steps in the unit distance.
    """

    colors_d: Any
    opacities_d: Any
    clears_d: Any
    changes_d: Any
    factors_d: Any
    shown: NDArray[np.bool_]
    low: float
    scale: float
    steepness: Steepness
    factor_scale: float
    steps_per_unit: float
    weighed: bool

    @property
    def shown_ends(self) -> tuple[int, int]:
        """First and last node with opacity; (NODES, -1) if all are transparent."""
        shown = np.flatnonzero(self.shown)
        return (int(shown[0]), int(shown[-1])) if len(shown) else (NODES, -1)

    @property
    def is_one_sided(self) -> bool:
        """True where the visible nodes are the first ones of the table, or the last ones."""
        return int(np.count_nonzero(np.diff(self.shown.astype(np.int8)))) <= 1

    @property
    def arguments(self) -> dict[str, Any]:
        first_shown, last_shown = self.shown_ends
        return {
            "colors": self.colors_d,
            "opacities": self.opacities_d,
            "clears": self.clears_d,
            "changes": self.changes_d,
            "factors": self.factors_d,
            "low": self.low,
            "scale": self.scale,
            "first_shown": first_shown,
            "last_shown": last_shown,
            "narrow": self.steepness.narrow,
            "has_dense": self.steepness.has_dense,
            "one_sided": self.is_one_sided,
            "factor_scale": self.factor_scale,
            "steps_per_unit": self.steps_per_unit,
        }

    @classmethod
    def of(cls, device: Device, function: TransferFunction, ray_step: float) -> TransferTables:
        """Make the tables of `function` for samples every `ray_step` mm."""
        low, high = function.range_hu
        table = function.table(low, high, NODES)
        with np.errstate(divide="ignore"):
            let_through = np.log2(1.0 - table[:, 3].astype(np.float64)) * (ray_step / function.unit_distance)
        let_through = np.maximum(let_through, _LOWEST_LOG)
        red, green, blue = np.rint(1023.0 * table[:, :3].T).astype(np.int32)
        colors = red << 20 | green << 10 | blue
        opacities = (-np.expm1(let_through * np.log(2.0))).astype(np.float32)
        clears = np.exp2(let_through / PARTS).astype(np.float32)
        scale = (NODES - 1) / (high - low)
        steepness = Steepness.of(opacities, scale)
        shown = opacities > 0.0
        factors = np.ones(GRADIENT_NODES, np.float32)
        top = 1.0
        if function.gradient_opacity is not None:
            top = max(float(function.gradient_opacity[-1, 0]), 1.0)
            factors = function.gradient_table(top, GRADIENT_NODES)
        return cls(
            upload(device, colors), upload(device, opacities), upload(device, clears),
            upload(device, steepness.changes.astype(np.float32)), upload(device, factors), shown, low, scale, steepness,
            (GRADIENT_NODES - 1) / top, function.unit_distance / ray_step, function.gradient_opacity is not None,
        )  # fmt: skip


@dataclass(frozen=True)
class MainWay:
    """The main direction of a picture's rays through the bricks of a slab: `ahead` (1 or -1) along `axis`.

    eye: The camera in bricks, and 1; or the direction of all rays in bricks, 1 along `axis`, and 0.
    aside: Distance in bricks from the camera, or drift a brick ahead, from which on rays count as drifting.
    """

    axis: int
    ahead: int
    eye: NDArray[np.float32]
    aside: float

    @classmethod
    def of(cls, resident: DeviceVolume, slab: ray_slabs.RaySlab, camera: Camera) -> MainWay:
        """Find the main way from the ray in the middle."""
        frame, cells = FieldFrame.of(resident.volume), np.array(slab.brick_cells, np.float64)
        forward = frame.matrix @ camera.basis().forward / cells
        axis = int(np.argmax(np.abs(forward)))
        ahead = 1 if forward[axis] > 0.0 else -1
        if camera.is_parallel:
            eye, aside = np.append(forward / np.abs(forward).max(), 0.0), _LEAST_DRIFT
        else:
            eye_cell = (frame.places(np.array([camera.position]))[0] - (0.0, 0.0, slab.first_k)) / cells
            nearest = -eye_cell[axis] if ahead > 0 else eye_cell[axis] - slab.bricks[axis]  # brick on the way
            eye, aside = np.append(eye_cell, 1.0), max(_LEAST_DRIFT * nearest, 0.5)
        return cls(axis, ahead, eye.astype(np.float32), aside)

    @property
    def arguments(self) -> dict[str, Any]:
        return {"main_axis": self.axis, "ahead": self.ahead, "eye": self.eye, "aside": self.aside}


def enter_tiles(
    resident: DeviceVolume, slab: ray_slabs.RaySlab, view: RayView, leaps: ray_slabs.LeapMap, output: PictureBuffers
) -> Any:
    """Return for each tile the distance in mm before which its rays meet nothing visible, on the device."""
    device = resident.device
    lanes = int(device.kernel_variants["LANES"])
    width, height = view.size
    camera = view.camera
    margin = math.ceil(min((resident.stack.index_steps(view.spread) / slab.brick_cells).max(), ray_slabs.FARTHEST))
    entries_d = allocate(device, 4 * output.tiles)
    launch(
        device, resident.program("rays/tiles.cl")["enter_tiles"], -(-output.tiles // lanes),
        leaps=leaps.distances_d, view=upload(device, view.widened()), entries=entries_d, slope=resident.stack.slope,
        first_k=slab.first_k, margin=margin, width=width, height=height, perspective=not camera.is_parallel,
        **slab.brick_arguments, **resident.stack.arguments,
    )  # fmt: skip
    return entries_d


def look_ahead(resident: DeviceVolume, slab: ray_slabs.RaySlab, ray: MainWay, leaps: ray_slabs.LeapMap) -> Any:
    """Return for each brick the empty distance around it, and ahead of it along the main way, on the device."""
    bi, bj, bk = bricks = slab.bricks
    count = math.prod(bricks)
    ways_d = allocate(resident.device, count)
    launch(
        resident.device, resident.program("rays/leaps.cl")["look_ahead"], count // bricks[ray.axis],
        distances=leaps.distances_d, ways=ways_d, bi=bi, bj=bj, bk=bk, **ray.arguments,
    )  # fmt: skip
    return ways_d


AIR_HU = kernel_number("rays/project.cl", "AIR_HU")
"""Value (-1000 HU) that attenuates nothing; lower values are padding, or voxels that a mask removed."""

PROJECTIONS = {
    mode: kernel_constant("rays/project.cl", macro)
    for mode, macro in {"mip": "HIGHEST", "minip": "LOWEST", "mean": "MEAN", "drr": "RADIOGRAPH"}.items()
}
"""Numbers of the modes in the kernel."""


def project_slab(
    resident: DeviceVolume, slab: ray_slabs.RaySlab, view: RayView, mode: str, output: PictureBuffers
) -> None:
    """Add one slab to a projection, "mip", "minip", "mean" or "drr"; `output.means_d` receives the values."""
    variants = {"LEAST_VALUE": f"({AIR_HU:g})"} if mode == "drr" else {}
    device = resident.device
    queues, lanes = count_queues(device), int(device.kernel_variants["LANES"])
    last = np.array([n - 1 for n in resident.volume.shape_ijk] + [0], dtype=np.float32)
    launch(
        device, resident.program("rays/project.cl", **variants)["project_rays"], output.items(queues, lanes),
        view.rays_a_launch(device),
        ranges=ray_slabs.measure_cells(resident, slab), view=upload(device, view.table),
        states=output.states_d, depths=output.depths_d, values=output.means_d, last_place=last,
        which=PROJECTIONS[mode], queues=queues, **slab.arguments, **view.arguments, **resident.stack.arguments,
    )  # fmt: skip


_NO_BODY = "no body was found in the scan: the lowest values are those of all of it, the air around included"


def take_picture(resident: DeviceVolume, style: VolumeLook | Projection, shot: Shot, ray_step: float) -> Rendering:
    for attempt in resident.with_fallback():
        with attempt as (_, warnings):
            picture = _Job(resident, style, shot, ray_step, warnings).run()
    return picture


def take_with_layers(
    resident: DeviceVolume,
    style: VolumeLook,
    shot: Shot,
    ray_step: float,
    beside: Mapping[str, int],
    draw: Callable[[DrawnVolume], Rendering],
) -> Rendering:
    """Picture a volume with what lies in it; `draw` is called again where room is short or another device works."""
    for attempt in resident.with_fallback():
        with attempt as (device, warnings):
            job = _Job(resident, style, shot, ray_step, warnings)
            planned = ray_slabs.plan_ray_slabs(resident, {**beside, **job.beside}, {}, job.labels, job.smoothing)
            for slabs in resident.attempts(ray_slabs.RAYS, planned, job.warnings):
                with slabs as slices:
                    job.find_openness(slices)
                    sample = partial(job.sample_between, slices)
                    picture = draw(DrawnVolume(device, sample, job.near_mm, job.stopwatch, job.warnings))
    return picture


class _Job(HollowedPicture):
    def __init__(
        self, resident: DeviceVolume, style: VolumeLook | Projection, shot: Shot, ray_step: float, warnings: list[str]
    ):
        label_style = style.label_style if isinstance(style, VolumeLook) else None
        super().__init__(resident, shot, ray_step, label_style, warnings)
        self.style = style
        self.lighting = style.light if isinstance(style, VolumeLook) else Lighting()
        self.box = volume_box(resident.volume)
        self.planes = None if style.clip is None else style.clip.planes
        if isinstance(style, VolumeLook) and self.lighting.shades:
            sigma = style.smooth_light
            if sigma is None:
                sigma = resident.keep("smoothing of light", None, 0, lambda: choose_smoothing(resident.volume))
            self.smoothing = ray_slabs.Smoothing.of(resident.volume, sigma)
        if isinstance(style, VolumeLook):
            self.darken_hollows(style.ambient_occlusion, style.function, self.planes, style.label_style)

    def hide_light(self, length_mm: float) -> Hiding:
        assert isinstance(self.style, VolumeLook)
        tables, look = TransferTables.of(self.resident.device, self.style.function, length_mm), self.style.label_style
        return Hiding(tables.opacities_d, NODES, tables.low, tables.scale, self.planes, self.labels, look, grown=True)

    def take(self, slices: int) -> Rendering:
        style = self.style
        self.find_openness(slices)
        output, slabs = self.draw_slabs(slices)
        with self.stopwatch.timed("download"):
            if isinstance(style, Projection):
                values, late = output.download_means()
            else:
                image, late = output.download_image()
        report = self.describe(style.mode, slabs)
        if isinstance(style, Projection):
            return self._finish_projection(style, values, late, report)
        report["unit_distance_mm"] = style.function.unit_distance
        report["smooth_light_mm"] = 0.0 if self.smoothing is None else self.smoothing.sigma_mm
        return Rendering.with_late_depths(late, image, self.shot.camera, None, style.mode, report)

    def draw(self, slab: ray_slabs.RaySlab, output: PictureBuffers) -> None:
        if isinstance(self.style, VolumeLook):
            self._composite(slab, self.style, output)
            return
        with self.stopwatch.running(self.resident.device):  # wait: CPU devices read host arrays
            project_slab(self.resident, slab, self._view(self.box), self.style.kind, output)

    @property
    def near_mm(self) -> float:
        """Where the rays begin, see `VIEW_NEAR` in cl/rays/view.h."""
        return float(self._view(self.box).table[NEAR_ROW, 0])

    def sample_between(self, slices: int, between: Between) -> None:
        """Add what the volume shows between two layers to the states of the rays."""
        style = self.style
        assert isinstance(style, VolumeLook)
        output = PictureBuffers.of_states(self.resident.device, self.shot.size, between.states_d)
        for slab in self.slabs(slices):
            self._composite(slab, style, output, between)

    def _composite(
        self, slab: ray_slabs.RaySlab, style: VolumeLook, output: PictureBuffers, between: Between | None = None
    ) -> None:
        """Blend a slab into the picture, and wait; of a part of the rays, `between`, write only the states."""
        resident, device = self.resident, self.resident.device
        stopwatch = self.stopwatch
        key = (style.function, self.ray_step)
        tables = resident.keep("transfer function", key, 0, lambda: TransferTables.of(device, *key))
        variants = {"GRADIENT_OPACITY": "1"} if tables.weighed else {}
        if tables.steepness.is_steep and takes_parts(resident.volume, self.ray_step):
            variants |= {"TAKES_PARTS": "1"}
        more: dict[str, Any] = {**slab.arguments}
        look = style.label_style
        if self.labels is not None and look is not None:
            variants |= {"LABELS": "1", **label_variants(self.labels.voxels.dtype)}
            more["labels"] = ray_slabs.slab_labels(resident, slab, self.labels, stopwatch, grown=True)
            more["label_colors"] = upload(device, look.table)
        self.add_openness(variants, more)
        if between is not None:
            variants |= {"BETWEEN": "1"}
            more |= {"nearest": between.nearest_d, "farthest": between.farthest_d, "stage": 0}
        with building_together(device):
            for name, of_file in {"rays/leaps.cl": {}, "rays/tiles.cl": {}, "rays/composite.cl": variants}.items():
                resident.program(name, **of_file)
        program = resident.program("rays/composite.cl", **variants)
        with stopwatch.running(device):
            leaps = ray_slabs.find_leaps(resident, slab, key, tables.shown, tables.low, tables.scale)
        nothing = (self.box[1], self.box[1])
        view = self._view(nothing if leaps.box is None else leaps.box)
        queues = count_queues(device)
        last = np.array([n - 1 for n in resident.volume.shape_ijk] + [0], dtype=np.float32)
        with stopwatch.running(device):  # wait: CPU devices read host arrays that are freed here
            entries_d = enter_tiles(resident, slab, view, leaps, output)
            ray = MainWay.of(resident, slab, view.camera)
            ways_d = look_ahead(resident, slab, ray, leaps)
            smoothed_d = ray_slabs.slab_smoothed(resident, slab, self.smoothing)
            launch(
                device, program["composite_rays"], output.items(queues, int(device.kernel_variants["LANES"])),
                view.rays_a_launch(device),
                smoothed=smoothed_d, ways=ways_d, entries=entries_d, view=upload(device, view.table),
                highlights=upload(device, highlight_table(self.lighting)), last_place=last, slope=resident.stack.slope,
                shaded=self.lighting.shades, jitter=style.jitter, queues=queues, **more, **tables.arguments,
                **output.arguments, **view.arguments, **ray.arguments, **resident.stack.arguments,
            )  # fmt: skip

    def _finish_projection(
        self, style: Projection, values: NDArray[np.float32], late: LateDepths, report: dict[str, Any]
    ) -> Rendering:
        is_water = style.kind == "drr"
        volume = self.resident.volume
        empty: NDArray[np.bool_] | None = None
        if style.leaves_out and LEFT_OUT in volume.report:
            left_out = self.resident.keep("left out", None, 0, lambda: count_left_out(volume))
            assert left_out is not None
            empty = ~(values <= volume.report[LEFT_OUT]["highest_hu"])
            values[empty] = np.nan
            report["left_out"] = left_out
            if not left_out["body"]:
                report["warnings"].append(_NO_BODY)
        choose = {"drr": choose_water_window, "mip": choose_mip_window}.get(style.kind, choose_window)
        window = choose(values) if style.window is None else checked_window(style.window)
        report["window_mm_water" if is_water else "window_hu"] = list(window)
        image = grey_image(values, window)
        if is_water:
            image[values <= 0.0, 3] = 0  # nothing attenuates there, inside the volume or beside it

        def read_depths() -> Depths:
            depths = late()
            if empty is not None:
                depths[0][empty] = depths[1][empty] = np.nan
            return depths

        rendering = Rendering.with_late_depths(read_depths, image, self.shot.camera, values, style.kind, report)
        return rendering if self.shot.background is None else rendering.with_background(self.shot.background)

    def _view(self, focus: tuple[Float64Array, Float64Array]) -> RayView:
        return RayView.of(
            self.resident.volume, self.shot.camera, self.shot.size, self.ray_step,
            lighting=self.lighting, planes=self.planes, box=self.box, focus=focus,
        )  # fmt: skip
