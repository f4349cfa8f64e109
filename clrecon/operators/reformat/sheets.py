"""Sheets through a volume: the values of their pixels, and what slices, curved reformations and contact sheets have in
common.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clrecon import opencl as ocl
from clrecon.errors import DeviceError, DeviceFailedError, UsageError
from clrecon.geometry import Volume, slice_normal
from clrecon.geometry.affine import Float64Array
from clrecon.labels.resample import check_together, warn_of_place
from clrecon.opencl import Device, Program, Stopwatch
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.tables import voxel_variants
from clrecon.rendering import Rendering
from clrecon.rendering.looks.colors import is_transparent
from clrecon.rendering.looks.window import BONE_WINDOW, checked_window, grey_image
from clrecon.rendering.pictures import styles
from clrecon.rendering.pictures.label_style import draw_labels, facts_of_overlay, labels_on_sheet
from clrecon.rendering.pictures.styles import CurveCut, PlaneCut
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.reformation import Sheet, SlabSamples, slab_samples
from clrecon.system.light_dataclass import dataclass
from clrecon.system.progress import Progress, ignore_progress

COMBINATIONS = {
    name: ocl.kernel_constant("reformat/sample.cl", f"COMBINE_{name.upper()}") for name in styles.COMBINATIONS
}
"""How the samples of a slab are combined: the kernel's numbers."""

SAMPLES_A_LAUNCH = 1 << 23
"""Most samples of a launch, which keeps launches short: systems stop kernels that block a display's GPU for seconds."""

_SHEETS = "slices"
"""Purpose by which slabs are planned."""

FARTHEST = 2.0**30
"""Farthest place from the volume in index steps or mm, for fixed-point numbers."""


@dataclass(frozen=True)
class Reformation:
    """Values of the pixels of a sheet, (h, w), HU, NaN where no sample lies within the volume, from `slices` of it."""

    values: NDArray[np.float32]
    slices: int
    slabs: int
    device_bytes: int


def prepare_reformat(device: Device, dtype: DTypeLike = np.int16, *, uneven: bool = False) -> Program:
    """Build the kernel for volumes of `dtype`, with `uneven` for those whose slices no affine places."""
    return ocl.load_program(device, "reformat/sample.cl", {**voxel_variants(dtype), "UNEVEN": str(int(uneven))})


@dataclass(frozen=True)
class _Places:
    """A sheet in fixed-point coordinates of a volume: see the kernel's contract."""

    rows: NDArray[np.int64]
    slices: NDArray[np.int64]
    first: int
    end: int


def _to_fixed(places: Float64Array) -> NDArray[np.int64]:
    return np.rint(places * 2.0**32).astype(np.int64)


def _place_rows(volume: Volume, sheet: Sheet, samples: SlabSamples) -> _Places:
    """Convert the rows of a sheet to coordinates of the volume, and find the slices that they meet."""
    if volume.uneven:
        heights_at = volume.slice_origins()
        normal = slice_normal(volume.affine)
        normal *= np.sign(normal @ (heights_at[-1] - heights_at[0]))
        to_places = np.vstack([np.linalg.pinv(volume.affine[:3, :2]), normal])
        slices = (heights_at - heights_at[0]) @ to_places.T
        origins = (sheet.origins - heights_at[0]) @ to_places.T
    else:
        to_places = np.linalg.inv(volume.affine[:3, :3])
        slices = np.zeros((2, 3))
        origins = volume.lps_to_ijk(sheet.origins)
    steps, depths = sheet.steps @ to_places.T, samples.step * (sheet.normals @ to_places.T)
    last, half = (sheet.width - 1) * steps, samples.intervals // 2 * depths
    corners = np.stack([origins + across + along for across, along in product((0.0 * last, last), (-half, half))])
    if np.abs(corners).max() >= FARTHEST:
        raise UsageError(
            "the picture reaches more than a thousand kilometres beyond the volume: check its place and size"
        )
    low, high = corners[..., 2].min(), corners[..., 2].max()
    nk = volume.shape_ijk[2]
    if volume.uneven:
        layers = np.searchsorted(slices[:, 2], [low, high], side="right") - 1
        first, end = int(max(layers[0], 0)), int(min(layers[1] + 2, nk))
    else:
        first, end = int(np.clip(np.floor(low - 0.5), 0, nk - 1)), int(np.clip(np.floor(high) + 2, 1, nk))
    return _Places(_to_fixed(np.hstack([origins, steps, depths])), _to_fixed(slices), min(first, nk - 1), max(end, 1))


class _Run:
    """One reformation: all rows through one part of the volume after another."""

    def __init__(self, resident: DeviceVolume, sheet: Sheet, samples: SlabSamples, combine: str, stopwatch: Stopwatch):
        self.resident, self.sheet = resident, sheet
        self.samples = samples
        self.device, self.volume = resident.device, resident.volume
        self.combine, self.stopwatch = combine, stopwatch
        self.places = _place_rows(self.volume, sheet, samples)
        self.slices = self.places.end - self.places.first
        self.takes_whole = False

    def needs(self, slices: int) -> dict[str, int]:
        """Return the bytes of every buffer, with `slices` slices of the volume on the device."""
        pixels = self.sheet.width * self.sheet.height
        return {
            "volume": slices * self.resident.slice_bytes,
            "rows": self.places.rows.nbytes + self.places.slices.nbytes,
            "values": 4 * pixels,
            "weights": 4 * pixels,
        }

    def plan(self) -> int:
        """Return the number of slices on the device at a time; all of the volume if that is worth it."""
        resident, nk = self.resident, self.volume.shape_ijk[2]
        self.takes_whole = resident.pays_whole(self.slices) and resident.plan(_SHEETS, nk, self.needs) == nk
        if self.takes_whole:
            return nk
        slices = resident.plan(_SHEETS, self.slices, self.needs)
        if slices < min(2, self.slices):
            shortage = ocl.describe_shortage(resident.limits, self.needs(min(2, self.slices)))
            kind = DeviceFailedError if resident.limits.asked_bytes is None else DeviceError
            raise kind(f"two slices at a time are too much: {shortage}; give more memory or a smaller picture")
        return slices

    def all_slabs(self, slices: int, progress: Progress) -> Reformation:
        """Take the samples of `slices` slices at a time; each slab repeats the last slice of the one before."""
        places, shape = self.places, (self.sheet.height, self.sheet.width)
        takes_whole = self.takes_whole and slices == self.volume.shape_ijk[2]
        with self.stopwatch.timed("build"):
            program = prepare_reformat(self.device, self.resident.dtype, uneven=self.volume.uneven)
        rows_d, slices_d = ocl.upload(self.device, places.rows), ocl.upload(self.device, places.slices)
        values_d, weights_d = (ocl.allocate(self.device, 4 * shape[0] * shape[1]) for _ in range(2))
        count, own_first = 0, places.first
        while count == 0 or own_first < places.end:
            held_end = places.end if takes_whole else min(own_first + slices, places.end)
            own_end = held_end if held_end == places.end else held_end - 1
            if takes_whole:
                voxels_d, first_k = self.resident.whole(self.stopwatch), 0
            else:
                voxels_d, first_k = self.resident.part(own_first, held_end, self.stopwatch), own_first
            with self.stopwatch.running(self.device):
                self._launch_rows(
                    program, voxels=voxels_d, rows=rows_d, slices=slices_d, values=values_d, weights=weights_d,
                    first_k=first_k, own_first=own_first, own_end=own_end, fresh=count == 0,
                )  # fmt: skip
            self.volume.release_slices(own_first, held_end)
            count, own_first = count + 1, own_end
            progress("slabs", own_end - places.first, self.slices)
        with self.stopwatch.timed("download"):
            values = ocl.download(self.device, np.empty(shape, np.float32), values_d)
            weights = ocl.download(self.device, np.empty(shape, np.float32), weights_d)
        empty = weights == 0.0
        if self.combine == "mean":
            values = values / np.where(empty, np.float32(1.0), weights)
        values[empty] = np.nan
        together = slices if takes_whole else min(slices, self.slices)
        return Reformation(values, self.slices, count, sum(self.needs(together).values()))

    def _launch_rows(self, program: Program, **part: Any) -> None:
        """Launch the kernel for all rows; `part` has its arguments other than rows and sizes."""
        height, width = self.sheet.height, self.sheet.width
        ni, nj, nk = self.volume.shape_ijk
        rows = max(1, SAMPLES_A_LAUNCH // (width * (self.samples.intervals + 1)))
        for first in range(0, height, rows):
            count = min(rows, height - first)
            ocl.launch(
                self.device, program["reformat_rows"], count * width, first_row=first, row_count=count, width=width,
                ni=ni, nj=nj, nk=nk, intervals=self.samples.intervals, combine=COMBINATIONS[self.combine], **part,
            )  # fmt: skip


def sample_sheet(
    resident: DeviceVolume,
    sheet: Sheet,
    samples: SlabSamples,
    combine: str = "mean",
    *,
    stopwatch: Stopwatch | None = None,
    progress: Progress = ignore_progress,
    warnings: list[str] | None = None,
) -> Reformation:
    """Return the values of all pixels of a sheet: the trilinear field, combined through a thick slice.

    A volume that is already on the device is read there.  Else only the slices that the sheet meets are uploaded, some
    at a time if they do not fit.  Single samples, `max` and `min` are then equal bit for bit, means up to the rounding
    of their sums.
    """
    if not isinstance(combine, str) or combine not in COMBINATIONS:
        raise UsageError(f"the samples of a slab are combined by one of {', '.join(COMBINATIONS)}, not {combine!r}")
    for attempt in resident.with_fallback():
        with attempt as (_, notes):
            run = _Run(resident, sheet, samples, combine, stopwatch or Stopwatch())
            planned = run.plan()
            for slabs in resident.attempts(_SHEETS, planned, notes, fewest=min(2, planned)):
                with slabs as slices:
                    reformation = run.all_slabs(slices, progress)
    if warnings is not None:
        warnings.extend(notes)
    return reformation


class CutJob:
    """One picture of sheets through a volume: the device, how samples are combined, labels, and the report."""

    def __init__(
        self, resident: DeviceVolume, style: PlaneCut | CurveCut, progress: Progress, background: str | Sequence[float]
    ):
        self.resident, self.style = resident, style
        self.progress, self.background = progress, background
        self.samples = slab_samples(resident.volume, style.thickness)
        self.window = BONE_WINDOW if style.window is None else checked_window(style.window)
        self.stopwatch = Stopwatch()
        self.warnings: list[str] = []
        self.look = style.label_style
        if self.look is not None:
            check_together(self.look.labels, resident.volume)
            self.warnings += [*self.look.labels.warnings, *warn_of_place(self.look.labels, resident.volume)]

    def sample(self, sheet: Sheet) -> Reformation:
        return sample_sheet(
            self.resident, sheet, self.samples, self.style.combine,
            stopwatch=self.stopwatch, progress=self.progress, warnings=self.warnings,
        )  # fmt: skip

    def draw(self, values: NDArray[np.float32], sheet: Sheet) -> tuple[NDArray[np.uint8], NDArray[Any] | None]:
        """Return the grey picture (h, w, 4) of a sheet with its labels drawn, and the label of each pixel, if any."""
        image = grey_image(values, self.window)
        if self.look is None:
            return image, None
        numbers = labels_on_sheet(self.look.labels, sheet)
        tints: Any = self.style.label_opacity
        return draw_labels(image, numbers, self.look, tints), np.where(np.isnan(values), 0, numbers)

    def finish(
        self,
        image: NDArray[np.uint8],
        values: NDArray[np.float32],
        depth: NDArray[np.float32] | None,
        camera: Camera | None,
        numbers: NDArray[Any] | None,
        report: dict[str, Any],
    ) -> Rendering:
        if depth is None:
            depth = np.full(values.shape, np.nan, np.float32)
        if numbers is not None and self.look is not None:
            report["labels"] = facts_of_overlay(numbers, self.look)
        seen = Rendering(image, depth, depth.copy(), camera, values, mode=self.style.mode, report=report)
        return seen if is_transparent(self.background) else seen.with_background(self.background)

    def describe(self, reformation: Reformation, pixel_mm: float) -> dict[str, Any]:
        return {
            "pixel_mm": pixel_mm,
            "thickness_mm": self.style.thickness,
            "combine": self.style.combine if self.samples.intervals else None,
            "samples_a_pixel": self.samples.intervals + 1,
            "sample_step_mm": self.samples.step if self.samples.intervals else None,
            "window_hu": list(self.window),
            "device": self.resident.device.label,
            "driver": self.resident.device.driver,
            "slabs": reformation.slabs,
            "device_bytes": reformation.device_bytes,
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
            "warnings": [*self.resident.device.warnings, *self.warnings],
        }
