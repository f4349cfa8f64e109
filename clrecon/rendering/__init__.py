"""Pure numpy: what a picture is made with (transfer functions, lighting) and what comes out (`Rendering`)."""

from clrecon.rendering.looks.lighting import UNSHADED, Lighting
from clrecon.rendering.looks.presets import DEFAULT_PRESET, PRESETS, Preset, find_preset
from clrecon.rendering.looks.transfer_files import load_transfer_function
from clrecon.rendering.looks.transfer_function import TransferFunction
from clrecon.rendering.pictures.picture import Rendering
