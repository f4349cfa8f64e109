"""Pictures of an iso surface without a mesh: the host's side of cl/rays/surface.cl."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.iso_rule import IsoRule, choose_iso_rule
from clrecon.labels.label_levels import Growth
from clrecon.opencl import launch, upload
from clrecon.operators.rays.openness import Hiding, HollowedPicture
from clrecon.operators.rays.picture_buffers import PictureBuffers, RayView, Shot, count_queues, highlight_table
from clrecon.operators.rays.ray_slabs import LeapMap, RaySlab, find_leaps, slab_labels
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import FieldFrame, enclose, label_variants
from clrecon.rendering import Rendering
from clrecon.rendering.pictures.styles import SurfaceLook
from clrecon.rendering.views.camera import box_corners

_CLOSED_BORDER = 1.0
"""Index steps beyond the outermost voxel centres within which the closed field falls to its outside value."""


def cast_surface(resident: DeviceVolume, style: SurfaceLook, shot: Shot, ray_step: float) -> Rendering:
    """Show where the field first reaches an iso value along each ray; ``depth`` is that of the first hit.

    The field is that of the closed mesh of `extract_isosurface`, so that depths are those of the mesh: surrounded by a
    layer of outside, its surface at the level of `clrecon.geometry.iso_rule.IsoRule`. Between the first sample that is
    inside and the one before, the surface is found to 1e-3 of a step.  A ray that begins inside has its hit at once: on
    a clip plane with the plane's normal, so that cut bone is flat; at a camera inside, with the ray's direction.

    style: With its shadows, a hit has only ambient light if the way from it to the fixed light meets something inside,
        one ray step away or farther; translucent labels let their share through.  A hit in a label with opacity below 1
        is blended, and the ray continues: out of the inside to the next entry, or into the next label. The label of a
        hit is that of the nearest inside voxel of its cell; as in meshes of labels, a voxel without one has that of the
        nearest of the voxels around it.
    ray_step: Distance of samples, mm.  If the volume is processed in slabs, at most one slice.
    """
    rule = choose_iso_rule(resident.volume, style.iso_value, values=resident.values)
    for attempt in resident.with_fallback():
        with attempt as (_, warnings):
            picture = _Job(resident, rule, style, shot, float(ray_step), warnings).run()
    return picture


class _Job(HollowedPicture):
    """One picture, slab after slab."""

    def __init__(
        self, resident: DeviceVolume, rule: IsoRule, look: SurfaceLook, shot: Shot, ray_step: float, warnings: list[str]
    ):
        super().__init__(resident, shot, ray_step, look.label_style, warnings)
        self.rule, self.look = rule, look
        self.style = look.label_style
        self.planes = np.empty((0, 4)) if look.clip is None else look.clip.planes
        self.frame = FieldFrame.of(resident.volume)
        self.hiding_planes = self.planes if len(self.planes) else None
        self.darken_hollows(look.ambient_occlusion, rule.iso_level, self.hiding_planes, self.style)

    def hide_light(self, length_mm: float) -> Hiding:
        table_d = upload(self.resident.device, np.array([0.0, 1.0], np.float32))
        return Hiding(table_d, 2, *_level_nodes(self.rule.iso_level), self.hiding_planes, self.labels, self.style)

    def take(self, slices: int) -> Rendering:
        resident, nk = self.resident, self.resident.volume.shape_ijk[2]
        if slices < nk:
            if self.look.shadows:
                problem = f"shadows need the whole volume on the device, {slices} of its {nk} slices fit"
                raise resident.limits.refusal(problem, "give more memory or leave the shadows out")
            self._shorten_steps()
        self.find_openness(slices)
        output, slabs = self.draw_slabs(slices)
        with self.stopwatch.timed("download"):
            image, late = output.download_image()
        report = self.describe("surface", slabs, iso_value_hu=self.rule.iso_value)
        return Rendering.with_late_depths(late, image, self.shot.camera, None, "surface", report)

    def _shorten_steps(self) -> None:
        """Limit the step to a slice, because a slab holds only one slice before its own."""
        longest = 1.0 / _slices_per_mm(self.resident.volume)
        if self.ray_step > longest:
            self.warnings.append(
                f"the volume goes through in slabs: the ray step is {longest:.3g} mm in place of {self.ray_step:.3g}"
            )
            self.ray_step = longest

    def draw(self, slab: RaySlab, output: PictureBuffers) -> None:
        resident, rule = self.resident, self.rule
        look = self.look
        device, volume = resident.device, resident.volume
        lanes, queues = int(device.kernel_variants["LANES"]), count_queues(device)
        variants, tables = self._tables(slab)
        low_k, high_k = _field_heights(volume, self.frame, (slab.low_k, slab.high_k))
        last = [n - 1 for n in volume.shape_ijk]
        with self.stopwatch.running(device):  # wait: CPU devices read host arrays
            leaps = find_leaps(
                resident, slab, ("surface", rule.iso_level), np.array([False, True]), *_level_nodes(rule.iso_level)
            )
            view = self._view(leaps)
            launch(
                device, resident.program("rays/surface.cl", **variants)["trace_surface"], output.items(queues, lanes),
                view.rays_a_launch(device),
                leaps=leaps.distances_d, view=upload(device, view.table),
                highlights=upload(device, highlight_table(look.light)), last_place=_float4(*last),
                slope=resident.stack.slope, level=rule.iso_level, outside=rule.outside, color=_float4(*look.rgb),
                light_step=self._light_step(), cue=self._cue(), queues=queues,
                **{**slab.arguments, "slab_low": low_k, "slab_high": high_k},
                **tables, **output.arguments, **view.arguments, **resident.stack.arguments,
            )  # fmt: skip

    def _tables(self, slab: RaySlab) -> tuple[dict[str, str], dict[str, Any]]:
        """Return variants of the kernel, and the tables of clip planes and labels for it."""
        device = self.resident.device
        normals = np.zeros((max(1, len(self.planes)), 4), np.float32)
        normals[: len(self.planes), :3] = self.planes[:, :3]
        variants: dict[str, str] = {}
        tables = {"normals": upload(device, normals)}
        if self.labels is not None and self.style is not None:
            near = Growth.of(self.resident.volume, None).table
            variants = {"LABELS": "1", **label_variants(self.labels.voxels.dtype)}
            tables |= {
                "labels": slab_labels(self.resident, slab, self.labels, self.stopwatch),
                "label_colors": upload(device, self.style.table),
                "near": upload(device, near),
                "offsets": len(near),
            }
        self.add_openness(variants, tables)
        return variants, tables

    def _view(self, leaps: LeapMap) -> RayView:
        volume = self.resident.volume
        last = np.array(volume.shape_ijk) - 1.0
        box = enclose(volume, np.full(3, -_CLOSED_BORDER), last + _CLOSED_BORDER)
        focus = (box[1], box[1])
        if leaps.box is not None:
            margin = np.full(3, _CLOSED_BORDER)
            if volume.uneven:  # one slice more in field coordinates, at any height
                aside = np.abs(np.diff(self.frame.places(volume.slice_origins(border=1)), axis=0)).max(axis=0)
                margin = np.array([_CLOSED_BORDER, _CLOSED_BORDER, 0.0]) + aside
            focus = leaps.box[0] - margin, leaps.box[1] + margin
        return RayView.of(
            volume, self.shot.camera, self.shot.size, self.ray_step,
            lighting=self.look.light, planes=self.planes, box=box, focus=focus,
        )  # fmt: skip

    def _light_step(self) -> NDArray[np.float32]:
        """Return field coordinates per mm towards the fixed light, and whether it throws shadows."""
        if self.look.light.direction is None:
            return _float4()
        return _float4(*(self.frame.matrix @ self.look.light.direction), float(self.look.shadows))

    def _cue(self) -> NDArray[np.float32]:
        """Return the depth of full brightness, 1 / mm from it to the farthest corner, and the brightness lost there."""
        if not self.look.depth_cue:
            return _float4()
        corners = box_corners(self.resident.volume) - self.shot.camera.position
        if self.shot.camera.is_parallel:
            depths = corners @ self.shot.camera.basis().forward
        else:
            depths = np.linalg.norm(corners, axis=1)
        return _float4(depths.min(), 1.0 / max(float(np.ptp(depths)), 1e-6), self.look.depth_cue)


def _float4(*numbers: float) -> NDArray[np.float32]:
    vector = np.zeros(4, np.float32)
    vector[: len(numbers)] = numbers
    return vector


def _level_nodes(level: float) -> tuple[float, float]:
    """Return `low` and `scale` of a table of two nodes, whose second is visible.

    A value is nearest to it from half a unit above `low` on, which is the level.  Marking subtracts a hundredth of a
    unit, far more than the errors of float32.
    """
    unit = max(1e-3 * abs(level), 1e-6)
    return level - 0.5 * unit, 1.0 / unit


def _field_heights(volume: Volume, frame: FieldFrame, ks: Sequence[float]) -> list[float]:
    """Return the third field coordinates of slices; infinite ones stay infinite."""
    if not volume.uneven:
        return list(ks)
    return [float(frame.places(volume.ijk_to_lps([(0.0, 0.0, k)]))[0, 2]) if np.isfinite(k) else float(k) for k in ks]


def _slices_per_mm(volume: Volume) -> float:
    """Return the most slices that a ray crosses in a mm."""
    heights = volume.slice_origins(border=1) @ slice_normal(volume.affine)
    return float(1.0 / np.abs(np.diff(heights)).min())
