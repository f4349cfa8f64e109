"""Layers of a picture, from front to back: the host's side of cl/rays/layers.cl."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clrecon.opencl import (
    Device,
    Stopwatch,
    allocate,
    check_budget,
    download,
    empty_output,
    kernel_constant,
    launch,
    load_program,
    upload,
)
from clrecon.operators.masks.band_mask import zero_words
from clrecon.operators.rays.buffers import Between
from clrecon.operators.rays.splats import eye_table
from clrecon.operators.rays.triangles import LayerKeys, MeshPart, Triangles
from clrecon.rendering import Lighting
from clrecon.rendering.looks.colors import find_color
from clrecon.rendering.views.camera import Camera
from clrecon.system.progress import Progress, ignore_progress

LAYERS = 16
"""Most layers of a picture."""

COUNTED = kernel_constant("rays/layers.cl", "COUNTED")

PIXEL_BYTES = 16 + 20 + 48 + 12 + 5 + 4
"""Bytes a pixel: keys, a layer, states and marks, the picture, the still, the depth of the layer before."""


class Still(NamedTuple):
    """A picture that was made before: its colours (h, w, 4) uint8, not premultiplied, and depths (h, w) float32."""

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]


class LayeredPicture(NamedTuple):
    """A picture of layers.

    image: ndarray, shape (h, w, 4), uint8
    depth, expected_depth: ndarray, shape (h, w), float32. Mm along the ray; NaN where nothing is.
    layers: Layers that were drawn.
    open_pixels: Pixels that may have further ones, which are left out.
    """

    image: NDArray[np.uint8]
    depth: NDArray[np.float32]
    expected_depth: NDArray[np.float32]
    layers: int
    open_pixels: int


def draw_layers(
    device: Device,
    parts: Sequence[MeshPart],
    camera: Camera,
    size: tuple[int, int],
    *,
    still: Still | None = None,
    volume: Callable[[Between], None] | None = None,
    near_mm: float = 0.0,
    most: int = LAYERS,
    background: str | Sequence[float] | None = None,
    memory: int | None = None,
    stopwatch: Stopwatch | None = None,
    progress: Progress | None = None,
) -> LayeredPicture:
    """Draw triangles, with what lies before, between and behind them.

    parts: The first triangles of the first part have the lowest numbers: of triangles at the same depth they are
        nearer.
    size: (width, height)
    still: A picture of the same camera: one further layer at its depth.
    volume: Adds what a volume shows between two layers to the states of the rays, and waits; called from front to back.
    near_mm: Where the volume's rays begin, see `VIEW_NEAR` in cl/rays/view.h.
    most: Most layers.
    background: str or (float, float, float). None: transparent.
    memory: Bytes that may be taken on the device.
    progress: Called as ``progress("layers", done, most)`` before each layer.
    """
    needs = {"picture": PIXEL_BYTES * size[0] * size[1], "triangles": sum(part.device_bytes for part in parts)}
    check_budget(device, needs, memory)
    job = _Layers(device, parts, camera, size, still, near_mm, stopwatch or Stopwatch())
    return job.run(volume, most, background, progress or ignore_progress)


class _Layers:
    """One picture: its buffers, and its passes."""

    def __init__(
        self,
        device: Device,
        parts: Sequence[MeshPart],
        camera: Camera,
        size: tuple[int, int],
        still: Still | None,
        near_mm: float,
        stopwatch: Stopwatch,
    ):
        self.device, self.size, self.stopwatch, self.near_mm = device, size, stopwatch, near_mm
        self.has_still = still is not None
        self.pixels = size[0] * size[1]
        self.program = load_program(device, "rays/layers.cl")
        self.view_d = upload(device, eye_table(camera, size, Lighting(), np.zeros(3)))
        shown = Still(np.zeros((1, 1, 4), np.uint8), np.zeros((1, 1), np.float32)) if still is None else still
        with stopwatch.timed("upload"):
            self.still_d = upload(device, np.ascontiguousarray(shown.image))
            self.still_depths_d = upload(device, np.ascontiguousarray(shown.depth, np.float32))
        self.triangles: list[Triangles] = []
        first = 0
        for part in parts:
            if len(part.triangles) and len(part.vertices):
                self.triangles.append(Triangles(device, part, first, camera, size, stopwatch))
                first += len(part.triangles)
        is_opaque = all(part.opacity >= 1.0 for part in parts)
        self.is_single = is_opaque and (still is None or bool((shown.image[..., 3] % 255 == 0).all()))
        self.keys = LayerKeys.of(device, self.pixels)
        self.layer_d = allocate(device, 16 * self.pixels)
        self.depths_d, self.nearest_d = allocate(device, 4 * self.pixels), allocate(device, 4 * self.pixels)
        self.states_d, self.marks_d = allocate(device, 32 * self.pixels), allocate(device, 16 * self.pixels)

    def run(
        self,
        volume: Callable[[Between], None] | None,
        most: int,
        background: str | Sequence[float] | None,
        progress: Progress,
    ) -> LayeredPicture:
        device, (width, height) = self.device, self.size
        with self.stopwatch.running(device):
            self._launch("clear_rays", pixels=self.pixels, **self._rays, **self._floors)
        open_pixels, drawn = self.pixels if self.triangles or self.has_still else 0, 0
        is_first = True
        while open_pixels and drawn < most:
            progress("layers", drawn, most)
            self._draw_layer()
            open_pixels = 0 if self.is_single else self._count_open()
            if volume is not None:
                self._sample(volume, is_first)
            with self.stopwatch.running(device):
                self._launch("blend_layer", **self._layer, **self._rays, **self._place, near_mm=self.near_mm)
            drawn, is_first = drawn + 1, False
            self.keys.go_behind()
            self.depths_d, self.nearest_d = self.nearest_d, self.depths_d
        if volume is not None and (is_first or open_pixels):  # else all rays have gone to their ends already
            self._fill(self.depths_d, np.inf)
            self._sample(volume, is_first)
        image, image_d = empty_output(device, (height, width, 4), np.uint8)
        depths, first_d = empty_output(device, (height, width), np.float32)
        means, means_d = empty_output(device, (height, width), np.float32)
        ground = np.zeros(4, np.float32)
        if background is not None:
            ground[:] = *find_color(background), 1.0
        with self.stopwatch.running(device):
            self._launch(
                "finish_rays", image=image_d, depths=first_d, means=means_d, background=ground, near_mm=self.near_mm,
                **self._rays, **self._place,
            )  # fmt: skip
        with self.stopwatch.timed("download"):
            image, depths = download(device, image, image_d), download(device, depths, first_d)
            means = download(device, means, means_d)
        return LayeredPicture(image, depths, means, drawn, open_pixels)

    def _draw_layer(self) -> None:
        """Find the nearest of each pixel behind the floor, with its colour and depth."""
        stopwatch, still = self.stopwatch, {"has_still": self.has_still, "still_depths": self.still_depths_d}
        with stopwatch.running(self.device):
            self._launch("begin_layer", **still, **self.keys.arguments, **self._place)
            for finds_numbers in (False, True):
                for own in self.triangles:
                    own.draw(self.keys, finds_numbers)
            self._launch(
                "show_still", still=self.still_d, numbers=self.keys.numbers_d, keys=self.keys.keys_d,
                pixels=self.pixels, **still, **self._layer,
            )  # fmt: skip
            for own in self.triangles:
                own.shade(self.keys, self.layer_d, self.depths_d)

    def _sample(self, volume: Callable[[Between], None], is_first: bool) -> None:
        if is_first:
            self._fill(self.nearest_d, -np.inf)
        volume(Between(self.states_d, self.nearest_d, self.depths_d))

    def _count_open(self) -> int:
        with self.stopwatch.running(self.device):
            open_d = zero_words(self.device, 1, stopwatch=self.stopwatch)
            items = -(-self.pixels // COUNTED)
            self._launch("count_open", items, keys=self.keys.keys_d, open=open_d, pixels=self.pixels)
        return int(download(self.device, np.zeros(1, np.uint32), open_d)[0])

    def _fill(self, depths_d: Any, depth: float) -> None:
        with self.stopwatch.running(self.device):
            self._launch("fill_depths", depths=depths_d, depth=depth, pixels=self.pixels)

    def _launch(self, kernel: str, items: int | None = None, **arguments: Any) -> None:
        launch(
            self.device, self.program[kernel], self.pixels if items is None else items, stopwatch=self.stopwatch,
            **arguments,
        )  # fmt: skip

    @property
    def _rays(self) -> dict[str, Any]:
        return {"states": self.states_d, "marks": self.marks_d}

    @property
    def _floors(self) -> dict[str, Any]:
        return {"floor_keys": self.keys.floor_keys_d, "floor_numbers": self.keys.floor_numbers_d}

    @property
    def _layer(self) -> dict[str, Any]:
        return {"layer": self.layer_d, "layer_depths": self.depths_d}

    @property
    def _place(self) -> dict[str, Any]:
        return {"view": self.view_d, "width": self.size[0], "height": self.size[1]}
