"""Slices in space: slices of a volume drawn at their own places; the host's side of cl/rays/slices.cl."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clrecon.errors import UsageError
from clrecon.geometry import Volume
from clrecon.geometry.affine import Float64Array
from clrecon.opencl import Stopwatch, check_budget, kernel_constant, launch, load_program, upload
from clrecon.operators.rays.buffers import PictureBuffers, count_queues
from clrecon.operators.rays.ray_view import RayView
from clrecon.operators.resident.device_volume import DeviceVolume
from clrecon.operators.resident.frame import FieldFrame, volume_box
from clrecon.operators.resident.voxel_types import voxel_variants
from clrecon.rendering import Rendering, TransferFunction
from clrecon.rendering.looks.window import checked_window
from clrecon.rendering.views.camera import Camera
from clrecon.rendering.views.clip import Clip

__all__ = ["DEFAULT_OPACITY", "LOWEST_SHOWN_HU", "choose_slices", "overlay_slices"]

DEFAULT_COUNT = 12
"""Number of slices shown by default: enough to see the body, few enough to see each slice."""

DEFAULT_OPACITY = 0.5
"""Opacity of a slice: the front slices are bright, and the third still shows an eighth of its light."""

LOWEST_SHOWN_HU = -300.0
"""Lower values are transparent, so that the slices behind are visible: air, lung and most things around a patient."""

DEFAULT_WINDOW = (-300.0, 400.0)
"""HU of black and white without a window or a transfer function: soft tissue and bone."""

NODES = kernel_constant("rays/slices.cl", "BINS")
"""Entries of the table of colours."""

SLICES = "slices in space"
"""Purpose by which parts are planned."""

EDGE_ON = 1e-3
"""Cosine between a parallel view and the slices' normal below which the slices are invisible."""


def choose_slices(volume: Volume, slices: int | Sequence[int] | None = None) -> list[int]:
    """Return the numbers k of the slices to show, ascending.

    Parameters
    ----------
    volume : Volume
    slices : int or sequence of int, optional
        An int n: every n-th slice from the first.  A list: those slices.  None: about twelve, evenly spaced.

    Raises
    ------
    UsageError
        An int below 1, an empty list, a slice named twice, or one that the volume does not have.
    """
    nk = volume.shape_ijk[2]
    if slices is None:
        count = min(nk, DEFAULT_COUNT)
        return np.unique(np.rint(np.linspace(0, nk - 1, count)).astype(int)).tolist()
    if isinstance(slices, (int, np.integer)) and not isinstance(slices, bool):
        if slices < 1:
            raise UsageError(f"every {slices}th slice cannot be shown: give 1 or more, or a list of slices")
        return list(range(0, nk, int(slices)))
    try:
        numbers = np.asarray(slices)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.ndim != 1 or not len(numbers) or numbers.dtype.kind not in "iu":
        raise UsageError(f"slices are a number (every n-th) or a list of whole numbers k, not {slices!r}")
    chosen = sorted(numbers.tolist())
    if chosen[0] < 0 or chosen[-1] >= nk:
        outside = chosen[0] if chosen[0] < 0 else chosen[-1]
        raise UsageError(f"slice {outside} is not there: the volume has slices 0 to {nk - 1}")
    if len(set(chosen)) < len(chosen):
        raise UsageError(f"slices are named twice: {slices!r}")
    return chosen


def overlay_slices(
    resident: DeviceVolume,
    camera: Camera,
    size: tuple[int, int],
    *,
    slices: int | Sequence[int] | None = None,
    opacity: float = DEFAULT_OPACITY,
    lowest_hu: float = LOWEST_SHOWN_HU,
    window: Sequence[float] | None = None,
    transfer_function: TransferFunction | None = None,
    clip: Clip | None = None,
    background: str | Sequence[float] | None = None,
) -> Rendering:
    """Show slices of a volume in space, each translucent at its own place: sheared and uneven stacks too.

    A volume that is already on the device is read there.  Else only the shown slices are uploaded, in parts if they do
    not fit together.

    Parameters
    ----------
    resident : DeviceVolume
    camera : Camera
    size : (width, height)
    slices : int or sequence of int, optional
        See `choose_slices`.
    opacity : float
        Opacity of each slice, above 0 to 1.
    lowest_hu : float
        Lower values are transparent.
    window : (low, high), optional
        HU that are black and white.
    transfer_function : TransferFunction, optional
        Gives colours in place of grey; its opacity is not used.
    clip : Clip, optional
    background : str or (float, float, float), optional
        None: transparent.

    Returns
    -------
    Rendering
        ``depth`` is that of the first visible slice.

    Raises
    ------
    UsageError
        As `choose_slices`; an opacity outside of 0 to 1; both a window and a transfer function.
    DeviceError
        Not even one slice fits the device.
    """
    chosen = choose_slices(resident.volume, slices)
    look = _Look.of(opacity, lowest_hu, window, transfer_function)
    job = _Overlay(resident, camera, size, chosen, look, clip)
    return job.run(background)


@dataclass(frozen=True)
class _Look:
    """Colours (NODES, 4) float32 by value; the nearest node to v is ``floor((v - low) * scale + 0.5)``."""

    opacity: float
    lowest: float
    colors: NDArray[np.float32]
    low: float
    scale: float

    @classmethod
    def of(
        cls,
        opacity: float,
        lowest_hu: float,
        window: Sequence[float] | None,
        function: TransferFunction | None,
    ) -> _Look:
        share, lowest = _number(opacity), _number(lowest_hu)
        if not 0.0 < share <= 1.0:
            raise UsageError(f"the opacity of a slice lies above 0 and up to 1, not at {opacity!r}")
        if math.isnan(lowest):
            raise UsageError(f"the lowest HU that slices show is a number, not {lowest_hu!r}")
        if function is not None and window is not None:
            raise UsageError("slices are coloured by a window or by a transfer function, not by both")
        if function is not None:
            low, high = function.range_hu
            colors = function.table(low, high, NODES)
        else:
            low, high = DEFAULT_WINDOW if window is None else checked_window(window)
            colors = np.repeat(np.linspace(0.0, 1.0, NODES)[:, None], 4, axis=1).astype(np.float32)
        return cls(share, lowest, colors, low, (NODES - 1) / (high - low))


def _number(value: float) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


def _sort_slices(volume: Volume, camera: Camera, chosen: Sequence[int]) -> list[int]:
    """Sort slices in the order in which rays cross them.

    All rays share one order: parallel rays go up or down together; rays from a camera go away from its height, up or
    down.
    """
    heights = _heights(volume, volume.slice_origins()[list(chosen)])
    if camera.is_parallel:
        along = heights * np.sign(_heights(volume, camera.basis().forward[None])[0] or 1.0)
    else:
        along = np.abs(heights - _heights(volume, np.array([camera.position]))[0])
    return [chosen[n] for n in np.argsort(along, kind="stable")]


def _heights(volume: Volume, points: Float64Array) -> Float64Array:
    normal = np.cross(volume.affine[:3, 0], volume.affine[:3, 1])
    return np.asarray(points @ (normal / np.linalg.norm(normal)), dtype=np.float64)


def _warn(volume: Volume, camera: Camera) -> list[str]:
    if not camera.is_parallel or abs(_heights(volume, camera.basis().forward[None])[0]) > EDGE_ON:
        return []
    return ["the slices are seen edge-on and do not show: look from another side, such as 30,30, or in perspective"]


class _Overlay:
    """One picture: part after part of the slices, in the order in which rays cross them."""

    def __init__(
        self,
        resident: DeviceVolume,
        camera: Camera,
        size: tuple[int, int],
        chosen: list[int],
        look: _Look,
        clip: Clip | None,
    ):
        self.resident, self.chosen, self.look = resident, chosen, look
        self.order = _sort_slices(resident.volume, camera, chosen)
        box = volume_box(resident.volume)
        planes = None if clip is None else clip.planes
        self.view = RayView.of(resident.volume, camera, size, 1.0, planes=planes, box=box, focus=box)
        self.stopwatch = Stopwatch()
        self.warnings = _warn(resident.volume, camera)

    def run(self, background: str | Sequence[float] | None) -> Rendering:
        """Take the picture, with fewer slices at a time if the device has no room for the planned number."""
        resident, count = self.resident, len(self.chosen)
        picture, states = PictureBuffers.needs(self.view.size)

        def needs(slices: int) -> dict[str, int]:
            own = {"slices": slices * resident.slice_bytes, **picture}
            return own if slices == count else {**own, **states}

        slices = count if resident.is_held else resident.plan(SLICES, count, needs)
        if slices == 0:
            check_budget(resident.device, needs(1), resident.memory)
        return resident.halve(
            SLICES, max(slices, 1), lambda slices: self._take(slices, background), warnings=self.warnings
        )

    def _take(self, slices: int, background: str | Sequence[float] | None) -> Rendering:
        stopwatch, device = self.stopwatch, self.resident.device
        parts = [self.order[first : first + slices] for first in range(0, len(self.order), slices)]
        output = PictureBuffers(device, self.view.size, background, len(parts) > 1)
        for number, part in enumerate(parts):
            self._draw(part, (number == 0) + 2 * (number == len(parts) - 1), output)
        with stopwatch.timed("download"):
            image, depths, means = output.download()
        report = {
            "mode": "slices",
            "device": device.label,
            "driver": device.driver,
            "slices": self.chosen,
            "slice_opacity": self.look.opacity,
            "lowest_shown_hu": self.look.lowest,
            "seconds": dict(stopwatch.seconds),
            "kernel_seconds": dict(stopwatch.by_kernel),
            "warnings": self.warnings,
        }
        return Rendering(image, depths, means, self.view.camera, None, "slices", report)

    def _draw(self, part: Sequence[int], stage: int, output: PictureBuffers) -> None:
        """Draw slices in the given order, and wait."""
        resident, look, view, stopwatch = self.resident, self.look, self.view, self.stopwatch
        device, volume = resident.device, resident.volume
        places = np.zeros((len(part), 4), np.float32)
        places[:, :3] = FieldFrame.of(volume).places(volume.slice_origins()[list(part)])
        if resident.is_held:
            slices_d, places[:, 3] = resident.whole(stopwatch), part
        else:
            slices_d, places[:, 3] = resident.upload(volume.voxels[list(part)], stopwatch), range(len(part))
        ni, nj, _ = volume.shape_ijk
        queues = count_queues(device)
        program = load_program(device, "rays/slices.cl", voxel_variants(volume.voxels.dtype))
        with stopwatch.running(device):  # wait: CPU devices read the host's array
            launch(
                device, program["overlay_slices"], output.items(queues, 1), stopwatch=stopwatch,
                slices=slices_d, places=upload(device, places), colors=upload(device, look.colors),
                view=upload(device, view.table), ni=ni, nj=nj, count=len(part), bins_low=look.low,
                bins_scale=look.scale, opacity=look.opacity, lowest=look.lowest, stage=stage, queues=queues,
                **output.arguments, **view.arguments,
            )  # fmt: skip
