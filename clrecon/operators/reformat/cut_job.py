"""`CutJob`: what slices, curved reformations and contact sheets have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clrecon.labels.resample import check_together, warn_of_place
from clrecon.opencl import Stopwatch
from clrecon.operators.reformat.sample import Reformation, sample_sheet
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.rendering import Rendering
from clrecon.rendering.looks.colors import is_transparent
from clrecon.rendering.looks.window import BONE_WINDOW, checked_window, grey_image
from clrecon.rendering.pictures.label_overlay import describe_overlay, draw_labels, labels_on_sheet
from clrecon.rendering.pictures.styles import CurveCut, PlaneCut
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.plane import Sheet, slab_samples
from clrecon.system.progress import Progress


class CutJob:
    """One picture of sheets through a volume: the device, how samples are combined, labels, and the report."""

    def __init__(self, resident: DeviceVolume, style: PlaneCut | CurveCut, progress: Progress | None):
        self.resident, self.style, self.progress = resident, style, progress
        self.samples = slab_samples(resident.volume, style.thickness)
        self.window = BONE_WINDOW if style.window is None else checked_window(style.window)
        self.stopwatch = Stopwatch()
        self.warnings: list[str] = []
        self.look = style.label_style
        if self.look is not None:
            check_together(self.look.labels, resident.volume)
            self.warnings += [*self.look.labels.warnings, *warn_of_place(self.look.labels, resident.volume)]

    def sample(self, sheet: Sheet) -> Reformation:
        """Return the values of a sheet."""
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
        background: str | Sequence[float],
    ) -> Rendering:
        """Return the picture before its background."""
        if depth is None:
            depth = np.full(values.shape, np.nan, np.float32)
        if numbers is not None and self.look is not None:
            report["labels"] = describe_overlay(numbers, self.look)
        seen = Rendering(image, depth, depth.copy(), camera, values, mode=self.style.mode, report=report)
        return seen if is_transparent(background) else seen.with_background(background)

    def describe(self, made: Reformation, pixel_mm: float) -> dict[str, Any]:
        """Return the report of a picture."""
        return {
            "pixel_mm": pixel_mm,
            "thickness_mm": self.style.thickness,
            "combine": self.style.combine if self.samples.intervals else None,
            "samples_a_pixel": self.samples.intervals + 1,
            "sample_step_mm": self.samples.step if self.samples.intervals else None,
            "window_hu": list(self.window),
            "device": self.resident.device.label,
            "driver": self.resident.device.driver,
            "slabs": made.slabs,
            "device_bytes": made.device_bytes,
            "seconds": dict(self.stopwatch.seconds),
            "kernel_seconds": dict(self.stopwatch.by_kernel),
            "warnings": [*self.resident.device.warnings, *self.warnings],
        }
