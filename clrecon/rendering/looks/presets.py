"""Rendering presets: transfer function, light, mode and window of one tissue; not the presets of iso values."""

from __future__ import annotations

from clrecon.errors import UsageError
from clrecon.rendering.looks.lighting import UNSHADED, Lighting
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.system.light_dataclass import dataclass, replace
from clrecon.system.text import unknown_name

DEFAULT_PRESET = "bone"
ALL_PRESETS = "all"
"""In place of a name: every preset, side by side."""


@dataclass(frozen=True)
class Preset:
    """A way to make a picture that shows one tissue well.

    mode: "dvr", "mip", "minip" or "drr"; used unless the caller names another: ``x-ray`` alone gives a radiograph.
    window: HU of black and of white in projections ("drr" has none); None: chosen from the picture's own values.
    source: Origin of the ranges.
    """

    name: str
    mode: str
    transfer_function: TransferFunction
    window: tuple[float, float] | None
    source: str

    @property
    def description(self) -> str:
        """One line about what the picture shows."""
        return self.transfer_function.description

    @property
    def lighting(self) -> Lighting:
        """The light that it is made for; `UNSHADED` for no shading."""
        return self.transfer_function.lighting or UNSHADED


# Colours of tissues, as in printed anatomical atlases.
_BLOOD = (0.50, 0.13, 0.10)
_MUSCLE = (0.70, 0.30, 0.24)
_FAT = (0.92, 0.82, 0.62)
_SKIN = (0.90, 0.69, 0.58)
_MARROW = (0.76, 0.48, 0.33)
_SPONGY = (0.89, 0.74, 0.55)
_CORTEX = (0.96, 0.91, 0.80)
_DENSE = (1.00, 0.99, 0.95)
_STEEL = (0.72, 0.80, 0.90)

_SOFT_GRADIENT = 25.0
"""`Lighting.soft_gradient` for bone, HU per mm: its surfaces have 100 to 1000, noise of 10 HU in 0.7 mm 10 to 15."""

_MATT = Lighting(ambient=0.25, diffuse=0.85, specular=0.15, specular_power=12.0, soft_gradient=_SOFT_GRADIENT)
_SOFT = replace(_MATT, soft_gradient=0.3 * _SOFT_GRADIENT)  # where muscle meets fat are 30 to 100 HU per mm
_GLOSSY = Lighting(ambient=0.2, diffuse=0.85, specular=0.25, specular_power=20.0, soft_gradient=_SOFT_GRADIENT)

_Row = tuple[float, tuple[float, float, float], float]

_BONE: list[_Row] = [
    (130.0, _BLOOD, 0.0),
    (220.0, _MARROW, 0.06),
    (330.0, _SPONGY, 0.35),
    (700.0, _CORTEX, 0.8),
    (1300.0, _DENSE, 0.95),
]


def _preset(
    name: str,
    description: str,
    rows: list[_Row],
    source: str,
    *,
    lighting: Lighting = _MATT,
    mode: str = "dvr",
    window: tuple[float, float] | None = None,
) -> Preset:
    points = [(hu, *color, opacity) for hu, color, opacity in rows]
    function = TransferFunction(points, lighting=lighting, name=name, description=description)
    return Preset(name, mode, function, window, source)


_TISSUE = "HU of tissues: Prokop and Galanski, Spiral and Multislice Computed Tomography of the Body"
_WHITE = (1.0, 1.0, 1.0)
_BLACK = (0.0, 0.0, 0.0)

PRESETS: dict[str, Preset] = {
    preset.name: preset
    for preset in (
        _preset(
            "bone",
            "bone, from thin vertebral cortex on; vessels and organs filled with contrast medium are visible too",
            _BONE,
            f"{_TISSUE}; thin vertebral cortex in slices of 4 mm has 150 to 200 HU",
        ),
        _preset(
            "spine",
            "bone with the soft tissue around it faintly visible",
            [
                (-600.0, _SKIN, 0.0),
                (-450.0, _SKIN, 0.04),
                (-250.0, _SKIN, 0.04),
                (-160.0, _SKIN, 0.001),
                (-40.0, _MUSCLE, 0.001),
                (30.0, _MUSCLE, 0.006),
                (120.0, _MUSCLE, 0.006),
                *_BONE[1:],
            ],
            "bone as in the preset of this name; soft tissue so thin that 200 mm of it let half of the light through",
        ),
        _preset(
            "skin",
            "the outside of the body; where the scan ends, fat, muscle and bone in section",
            [
                (-600.0, _SKIN, 0.0),
                (-450.0, _SKIN, 0.4),
                (-300.0, _SKIN, 1.0),
                (-180.0, _SKIN, 1.0),
                (-110.0, _FAT, 1.0),
                (-70.0, _FAT, 1.0),
                (10.0, _MUSCLE, 1.0),
                (120.0, _MUSCLE, 1.0),
                (300.0, _SPONGY, 1.0),
                (700.0, _CORTEX, 1.0),
            ],
            "a blurred edge between air (-1000 HU) and skin (about 0 HU) keeps its place half way",
            lighting=_GLOSSY,
        ),
        _preset(
            "lung",
            "airways, lung and its vessels; the body around it is left out except for the edge of its skin",
            [
                (-970.0, (0.30, 0.55, 0.85), 0.0),
                (-900.0, (0.35, 0.60, 0.90), 0.004),
                (-800.0, (0.60, 0.75, 0.95), 0.008),
                (-650.0, (0.95, 0.85, 0.80), 0.06),
                (-450.0, (0.95, 0.55, 0.45), 0.16),
                (-320.0, (0.90, 0.40, 0.32), 0.12),
                (-200.0, (0.90, 0.40, 0.32), 0.0),
            ],
            "aerated lung has -950 to -500 HU, its vessels pass through -500 to 0 HU in blurred edges",
        ),
        _preset(
            "vessels",
            "vessels with contrast medium in red, and bone of the same HU: without contrast medium, red is bone",
            [
                (120.0, _BLOOD, 0.0),
                (170.0, (0.66, 0.10, 0.08), 0.04),
                (230.0, (0.82, 0.16, 0.11), 0.25),
                (330.0, (0.90, 0.30, 0.20), 0.6),
                (480.0, (0.92, 0.50, 0.36), 0.55),
                (650.0, _SPONGY, 0.6),
                (900.0, _CORTEX, 0.8),
            ],
            f"blood with contrast medium has 150 to 450 HU; {_TISSUE}",
            lighting=_GLOSSY,
        ),
        _preset(
            "muscle",
            "muscles and organs without skin and fat, bone where no muscle covers it",
            [
                (-40.0, _MUSCLE, 0.0),
                (10.0, _MUSCLE, 0.1),
                (60.0, _MUSCLE, 0.45),
                (130.0, (0.78, 0.42, 0.34), 0.6),
                (250.0, _SPONGY, 0.8),
                (700.0, _CORTEX, 0.95),
            ],
            f"muscle has 40 to 70 HU, fat -120 to -60 HU; {_TISSUE}",
            lighting=_SOFT,
        ),
        _preset(
            "metal",
            "screws, rods and implants; bone is as transparent as glass",
            [
                (150.0, _MARROW, 0.0),
                (300.0, _SPONGY, 0.02),
                (1000.0, _CORTEX, 0.08),
                (1800.0, _CORTEX, 0.1),
                (2300.0, _STEEL, 0.7),
                (3000.0, _STEEL, 1.0),
            ],
            "dense cortex and enamel end at about 2000 HU; the 12-bit scale at 3071 HU",
            lighting=_GLOSSY,
        ),
        _preset(
            "x-ray",
            "a radiograph: the attenuation of everything along the ray, summed up (mode drr)",
            [(-1000.0, _WHITE, 0.0), (0.0, _WHITE, 0.004), (1500.0, _WHITE, 0.02)],
            "attenuation is proportional to HU + 1000",
            lighting=UNSHADED,
            mode="drr",
        ),
        _preset(
            "mip",
            "the highest value along the ray: bone, vessels with contrast medium, calcifications (mode mip)",
            [(0.0, _BLACK, 0.0), (1000.0, _WHITE, 0.5)],
            "soft tissue ends at about 100 HU, contrast medium at 500 HU; cortex has 500 to 1500 HU",
            lighting=UNSHADED,
            mode="mip",
            window=(0.0, 1000.0),
        ),
        _preset(
            "minip",
            "the lowest value along the ray: airways, emphysema, gas in the body (mode minip)",
            [(-1000.0, _BLACK, 0.5), (-500.0, _WHITE, 0.0)],
            "air has -1000 HU, emphysema less than -950 HU, aerated lung -950 to -500 HU",
            lighting=UNSHADED,
            mode="minip",
            window=(-1000.0, -500.0),
        ),
    )
}


def find_preset(name: str) -> Preset:
    try:
        return PRESETS[name.lower()]
    except (KeyError, TypeError, AttributeError):
        raise UsageError(
            f"{unknown_name('rendering preset', name, PRESETS)}, or a file with a transfer function"
        ) from None
