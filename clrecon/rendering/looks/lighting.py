"""Lighting of shaded pictures, after Phong 1975, "Illumination for computer generated pictures"."""

from __future__ import annotations

from typing import Any

import numpy as np

from clrecon.errors import UsageError
from clrecon.system.arguments import array_or_empty, number_or_nan
from clrecon.system.light_dataclass import dataclass

LEAST_SOFT_GRADIENT = 0.01
"""Least gradient in HU per mm that is shaded; rounding errors of float32 in a flat field are a hundredth of it."""


def _checked_share(name: str, value: Any, low: float, high: float) -> float:
    number = number_or_nan(value)
    if not low <= number <= high:
        raise UsageError(f"the {name} of lighting lies between {low:g} and {high:g}, not at {value!r}")
    return number


@dataclass(frozen=True)
class Lighting:
    """The colour of a surface with unit normal n and colour c, seen from direction v and lit from direction l.

    ``c * (ambient + diffuse * n . l) + specular * (n . h) ** specular_power`` with h halfway between l and v, and n
    turned towards v.  Where n . l is not above 0, only the ambient light remains.  Colours above 1 become 1. Ambient 1
    without diffuse and specular light means no shading (``UNSHADED``).

    In volume rendering n is the direction of the gradient g.  It is unreliable where g is small: in the middle of thin
    bone, and in noise.  There the light changes, with ``s = |g|^2 / (|g|^2 + soft_gradient^2)``, from Phong's formula
    (s = 1) to full diffuse and no specular light (s = 0).

    Attributes
    ----------
    ambient, diffuse, specular : float
        Shares of the light, 0 to 1.
    specular_power : float
        Sharpness of the highlight, 1 to 128.
    soft_gradient : float
        HU per mm, 0 to 10,000: the gradient that gets half of its shading in volume rendering; 0 shades all gradients
        alike, except in flat fields (``LEAST_SOFT_GRADIENT``).
    direction : (float, float, float) or None
        Direction from the patient towards a fixed light, LPS, kept as a unit vector; None is a headlight.

    Raises
    ------
    UsageError
        A number is out of range, or the direction is not three finite numbers or has no length.
    """

    ambient: float = 0.2
    diffuse: float = 0.8
    specular: float = 0.2
    specular_power: float = 15.0
    direction: tuple[float, float, float] | None = None
    soft_gradient: float = 0.0

    def __post_init__(self) -> None:
        for name in ("ambient", "diffuse", "specular"):
            object.__setattr__(self, name, _checked_share(name, getattr(self, name), 0.0, 1.0))
        object.__setattr__(self, "specular_power", _checked_share("specular power", self.specular_power, 1.0, 128.0))
        object.__setattr__(self, "soft_gradient", _checked_share("soft gradient", self.soft_gradient, 0.0, 10_000.0))
        if self.direction is not None:
            object.__setattr__(self, "direction", self._unit(self.direction))

    @staticmethod
    def _unit(direction: Any) -> tuple[float, float, float]:
        vector = array_or_empty(direction)
        if vector.shape != (3,) or not np.isfinite(vector).all() or not vector.any():
            raise UsageError(
                f"the direction of a light is three finite numbers in LPS that are not all 0, not {direction!r}"
            )
        vector = vector / np.abs(vector).max()  # very long and very short vectors (1e200, 1e-200) keep their direction
        x, y, z = (vector / np.linalg.norm(vector)).tolist()
        return x, y, z

    @property
    def shades(self) -> bool:
        """False where the normal has no effect and need not be computed."""
        return self.diffuse > 0.0 or self.specular > 0.0


UNSHADED = Lighting(ambient=1.0, diffuse=0.0, specular=0.0, specular_power=1.0)
"""Shows the colours of the transfer function itself, without light."""
