"""Pure numpy: what a picture is made with (transfer functions, lighting) and what comes out (`Rendering`)."""

from clrecon.rendering.lighting import Lighting
from clrecon.rendering.picture import Rendering
from clrecon.rendering.transfer_function import TransferFunction

__all__ = ["Lighting", "Rendering", "TransferFunction"]
