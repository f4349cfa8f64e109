"""Light on shaded pictures, after Phong 1975, "Illumination for computer generated pictures"."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Lighting"]


@dataclass(frozen=True)
class Lighting:
    """How a surface with unit normal n, seen from v and lit from l, takes its colour c.

    ``c * (ambient + diffuse * |n . l|) + specular * |n . h| ** specular_power`` with h halfway between l and v; both
    sides of a surface are lit.

    Attributes
    ----------
    ambient, diffuse, specular : float
        Shares of the light, 0 to 1.
    specular_power : float
        Sharpness of the highlight, 1 to 128.
    direction : (float, float, float) or None
        From the patient towards a light that stays where it is, LPS; None is a light at the camera.
    """

    ambient: float = 0.2
    diffuse: float = 0.8
    specular: float = 0.2
    specular_power: float = 15.0
    direction: tuple[float, float, float] | None = None
