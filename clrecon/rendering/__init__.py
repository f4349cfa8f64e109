"""Pure numpy: what a picture is made with (transfer functions, lighting) and what comes out (`Rendering`)."""

from clrecon.rendering.lighting import UNSHADED, Lighting
from clrecon.rendering.picture import Rendering
from clrecon.rendering.presets import DEFAULT_PRESET, PRESETS, Preset, find_preset
from clrecon.rendering.transfer_files import load_transfer_function
from clrecon.rendering.transfer_function import TransferFunction

__all__ = [
    "DEFAULT_PRESET",
    "PRESETS",
    "UNSHADED",
    "Lighting",
    "Preset",
    "Rendering",
    "TransferFunction",
    "find_preset",
    "load_transfer_function",
]
