"""`TransferFunction`: the colour and opacity that each HU has in a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clrecon.geometry.affine import Float64Array

__all__ = ["TransferFunction"]


class TransferFunction:
    """Colour and opacity by HU, linear between points and constant beyond the first and the last.

    Parameters
    ----------
    points : sequence of (hu, red, green, blue, opacity)
        HU ascends; two points at one HU are a step.  Colours and opacity 0 to 1.
    unit_distance : float
        Way in mm through which a sample's opacity is what the points say (VTK's ScalarOpacityUnitDistance): over
        d mm it is ``1 - (1 - opacity) ** (d / unit_distance)``.
    gradient_opacity : sequence of (HU per mm, factor), optional
        Factor on the opacity by magnitude of the gradient, linear between points (Levoy 1988).
    """

    def __init__(
        self,
        points: ArrayLike,
        *,
        unit_distance: float = 1.0,
        gradient_opacity: Sequence[tuple[float, float]] | None = None,
    ):
        self.points = np.array(points, dtype=np.float64)
        self.unit_distance = float(unit_distance)
        self.gradient_opacity = None if gradient_opacity is None else np.array(gradient_opacity, dtype=np.float64)

    @property
    def range_hu(self) -> tuple[float, float]:
        """HU of the first and of the last point."""
        return float(self.points[0, 0]), float(self.points[-1, 0])

    def __call__(self, hu: ArrayLike) -> Float64Array:
        """Red, green, blue and opacity (n, 4), float64, at HU values (n,)."""
        values = np.asarray(hu, dtype=np.float64)
        columns = [np.interp(values, self.points[:, 0], column) for column in self.points[:, 1:].T]
        return np.stack(columns, axis=-1)

    def table(self, low: float, high: float, nodes: int) -> NDArray[np.float32]:
        """Red, green, blue, opacity (nodes, 4), float32, at `nodes` HU evenly from low to high, both included."""
        return self(np.linspace(low, high, nodes)).astype(np.float32)
