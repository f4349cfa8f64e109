"""Loading of Pillow, which reads and writes picture files and draws text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clrecon.errors import UsageError
from clrecon.system.packages import show_unused

if TYPE_CHECKING:
    from PIL import ImageFont


def load_pillow() -> None:
    """Make ``from PIL import ...`` work from here on, where the command line hides Pillow from pydicom."""
    show_unused()
    try:
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise UsageError(f"Pillow cannot be imported ({error}): pictures need it, install it with pip") from error


def load_font(pixels: float) -> ImageFont.FreeTypeFont:
    """Return Pillow's own scalable font, `pixels` high."""
    load_pillow()
    from PIL import ImageFont

    try:
        font = ImageFont.load_default(pixels)
    except ImportError as error:
        raise UsageError("this Pillow was built without FreeType: it cannot draw text of a size") from error
    if not isinstance(font, ImageFont.FreeTypeFont):
        raise UsageError("this Pillow was built without FreeType: it cannot draw text of a size")
    return font
